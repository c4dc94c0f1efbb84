"""A live page of runs: what they look like now, on this machine alone, with buttons to pause, resume and stop them."""

from unrender.app.watch.server import Address, application, serve

__all__ = ["Address", "application", "serve"]
