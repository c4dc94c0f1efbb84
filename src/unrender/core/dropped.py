"""Count of values that are dropped because they are not finite, with a warning."""

from __future__ import annotations

import logging

_log = logging.getLogger("unrender")


class DropReport:
    """Counter of dropped values. Logs a warning at the first one and at every tenfold count.

    Attributes:
        count: number of values dropped so far.
        total: number of values seen so far.
    """

    def __init__(self) -> None:
        self.count, self.total = 0, 0
        self._reported = 0

    def add(self, dropped: int, of: int, reason: str) -> None:
        """Record that `dropped` of `of` values were not finite; `reason` names them in the warning."""
        self.count += dropped
        self.total += of
        if self.count >= max(1, 10 * self._reported):
            self._reported = self.count
            _log.warning("%s; %d of %d so far were dropped", reason, self.count, self.total)
