"""Parameters sent to workers: each array is sent once, in full or as a float16 difference."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from unrender.app.distributed.messages import Difference, References
from unrender.core import arrays
from unrender.core.trees import Tree

_RECENT = 4
"""Number of recent arrays per parameter that are recognised: the current one, and those in states of earlier steps."""
_MOST = 65504.0
"""The largest float16."""


@dataclass(eq=False)
class Sent:
    """An array as workers have it.

    Attributes:
        number: its number.
        value: its value on the host.
        difference: difference from an earlier one; None if it is sent in full.
    """

    number: int
    value: np.ndarray
    difference: Difference | None = None

    def payload(self, present: set[int]) -> np.ndarray | Difference:
        """Return the data that a worker with these arrays needs to obtain this one."""
        if self.difference is not None and self.difference.base in present:
            return self.difference
        return self.value


class Outbox:
    """Assigns numbers to arrays, and recognises arrays that have one.

    Args:
        compress: whether an array is sent as its float16 difference from the previous one of the same parameter. Workers then have
            a value that differs from the driver's by at most half a unit in the 11th bit of that difference. The next difference refers
            to the workers' value, so errors do not accumulate. `snapshot` contains what the next steps of a run depend on.
    """

    def __init__(self, compress: bool = False):
        self.compress = compress
        self._count = 0
        self._known: OrderedDict[int, tuple[Any, Sent]] = OrderedDict()
        self._last: dict[str, tuple[Any, Sent]] = {}

    def numbered(self, tree: Tree) -> dict[str, Sent]:
        """Return the tree in the form that workers receive."""
        return {key: self._sent(key, value) for key, value in tree.items()}

    def once(self, tree: Tree) -> dict[str, Sent]:
        """Return a tree that is sent in full for one call."""
        return {key: Sent(self._next(), arrays.numpy(value)) for key, value in tree.items()}

    def values(self, tree: Mapping[str, Sent]) -> References:
        """Return the numbers of a tree."""
        return {key: sent.number for key, sent in tree.items()}

    def snapshot(self) -> dict[str, Any] | None:
        """Return the last arrays and the workers' values of them; None if they are equal."""
        if not self.compress:
            return None
        return {key: {"exact": exact, "sent": sent.value} for key, (exact, sent) in self._last.items()}

    def restore(self, saved: Mapping[str, Any] | None) -> None:
        """Continue from a `snapshot`."""
        self._known.clear()
        self._last.clear()
        for key, pair in (saved or {}).items():
            self._note(key, pair["exact"], Sent(self._next(), np.asarray(pair["sent"])))

    def _sent(self, key: str, value: Any) -> Sent:
        if (entry := self._known.get(id(value))) is not None:
            self._known.move_to_end(id(value))
            return entry[1]
        host = arrays.numpy(value)
        last = self._last.get(key)
        if last is not None and last[1].value.shape == host.shape:
            base = last[1]
            if np.array_equal(base.value, host):
                return self._note(key, value, base)
            change = host - base.value
            if self.compress and np.abs(change).max() < _MOST:
                difference = Difference(base.number, change.astype(np.float16))
                return self._note(key, value, Sent(self._next(), difference.applied(base.value), difference))
        return self._note(key, value, Sent(self._next(), host))

    def _note(self, key: str, exact: Any, sent: Sent) -> Sent:
        self._known[id(exact)] = exact, sent  # hold a reference, so that its id is not reused
        self._last[key] = exact, sent
        while len(self._known) > _RECENT * len(self._last):
            self._known.popitem(last=False)
        return sent

    def _next(self) -> int:
        self._count += 1
        return self._count
