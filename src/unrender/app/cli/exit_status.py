"""Exit statuses of the command."""

from __future__ import annotations

__all__ = ["DOUBTFUL", "ENVIRONMENT", "FAILED", "INPUT", "INTERRUPTED", "TERMINATED", "WORDS"]

INPUT, ENVIRONMENT, FAILED, DOUBTFUL = 2, 3, 4, 5
"""Invalid input; the machine lacks something; the run was given up; the check by fresh pictures failed."""
INTERRUPTED, TERMINATED = 130, 143
"""Ctrl-C, and SIGTERM: 128 and the number of the signal, as shells and schedulers expect."""
WORDS = {
    FAILED: "the run failed: it was given up, and what was finite is kept",
    DOUBTFUL: "the result is doubtful: see the warnings",
    INTERRUPTED: "interrupted",
    TERMINATED: "terminated",
}
"""The line on standard error for those that no error comes with."""
