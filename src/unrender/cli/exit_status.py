"""Exit statuses of the command."""

from __future__ import annotations

__all__ = ["ENVIRONMENT", "FAILED", "INPUT", "INTERRUPTED", "TERMINATED", "WORDS"]

INPUT, ENVIRONMENT, FAILED = 2, 3, 4
"""What the user gave is wrong; this machine cannot; a run was given up."""
INTERRUPTED, TERMINATED = 130, 143
"""Ctrl-C, and SIGTERM: 128 and the number of the signal, as shells and schedulers expect."""
WORDS = {
    FAILED: "the run failed: it was given up, and what was finite is kept",
    INTERRUPTED: "interrupted",
    TERMINATED: "terminated",
}
"""The line on standard error for those that no error comes with."""
