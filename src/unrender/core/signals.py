"""What those who handle signals agree upon."""

from __future__ import annotations

__all__ = ["GRACEFUL"]

GRACEFUL = "unrender_graceful"
"""Attribute of a handler of SIGTERM in whose place a run may put its own, which ends the run after the present step."""
