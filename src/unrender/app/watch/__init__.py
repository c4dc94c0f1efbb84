"""The live page of runs: their current state, on this machine only, with buttons to pause, resume and stop them."""

from unrender.app.watch.server import Address, application, serve

__all__ = ["Address", "application", "serve"]
