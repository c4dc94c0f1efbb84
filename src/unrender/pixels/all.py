"""Every pixel of every view, every step."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class All:
    """Look at the whole film of each view at each step."""
