"""The count of values that are left out because they are not finite, and the warning that reports it."""

from __future__ import annotations

import logging

_log = logging.getLogger("unrender")


class DropReport:
    """Count dropped values and log a warning at the first one and at every tenfold count.

    Attributes:
        count: values dropped so far.
        total: values seen so far.
    """

    def __init__(self) -> None:
        self.count, self.total = 0, 0
        self._reported = 0

    def add(self, dropped: int, of: int, reason: str) -> None:
        """Add `dropped` of `of` values; `reason` says in a few words what was not finite."""
        self.count += dropped
        self.total += of
        if self.count >= max(1, 10 * self._reported):
            self._reported = self.count
            _log.warning("%s; %d of %d so far were dropped", reason, self.count, self.total)
