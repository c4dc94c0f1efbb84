"""Parameters on their way to workers: each array is sent once, whole or as a float16 difference."""

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
"""Arrays of each parameter that are known again: the current one, and those that states of earlier steps hold."""
_MOST = 65504.0
"""The largest float16."""


@dataclass(eq=False)
class Sent:
    """An array as workers have it.

    Attributes:
        number: its name.
        value: on the host.
        difference: from an earlier one; None where it is sent whole.
    """

    number: int
    value: np.ndarray
    difference: Difference | None = None

    def payload(self, present: set[int]) -> np.ndarray | Difference:
        """What a worker that has these arrays needs in order to have this one."""
        if self.difference is not None and self.difference.base in present:
            return self.difference
        return self.value


class Outbox:
    """Numbers arrays, and knows again those that it has numbered.

    Args:
        compress: whether an array is sent as its float16 difference from the one sent before it of the same parameter. Workers then have
            a value that differs from the driver's by half a unit in the 11th bit of that difference; the next difference is from what
            they have, so errors do not add up. What a run's next steps depend on is in `snapshot`.
    """

    def __init__(self, compress: bool = False):
        self.compress = compress
        self._count = 0
        self._known: OrderedDict[int, tuple[Any, Sent]] = OrderedDict()
        self._last: dict[str, tuple[Any, Sent]] = {}

    def numbered(self, tree: Tree) -> dict[str, Sent]:
        """The tree as workers are to have it."""
        return {key: self._sent(key, value) for key, value in tree.items()}

    def once(self, tree: Tree) -> dict[str, Sent]:
        """A tree that is sent for one call alone, whole."""
        return {key: Sent(self._next(), arrays.numpy(value)) for key, value in tree.items()}

    def values(self, tree: Mapping[str, Sent]) -> References:
        """The tree by number."""
        return {key: sent.number for key, sent in tree.items()}

    def snapshot(self) -> dict[str, Any] | None:
        """The last arrays, and what workers have in their place; None where these are the same."""
        if not self.compress:
            return None
        return {key: {"exact": exact, "sent": sent.value} for key, (exact, sent) in self._last.items()}

    def restore(self, saved: Mapping[str, Any] | None) -> None:
        """Go on from a `snapshot`."""
        self._known.clear()
        self._last.clear()
        for key, pair in (saved or {}).items():
            self._note(key, pair["exact"], Sent(self._next(), np.asarray(pair["sent"])))

    def _sent(self, key: str, value: Any) -> Sent:
        if (found := self._known.get(id(value))) is not None:
            self._known.move_to_end(id(value))
            return found[1]
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
        self._known[id(exact)] = exact, sent  # held, so that its id is not given to another
        self._last[key] = exact, sent
        while len(self._known) > _RECENT * len(self._last):
            self._known.popitem(last=False)
        return sent

    def _next(self) -> int:
        self._count += 1
        return self._count
