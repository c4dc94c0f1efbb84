"""Where shares live, as the driver sees it; and the simplest such place, this process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from unrender.app.distributed.messages import Call, Reply
from unrender.app.distributed.share import ViewShare
from unrender.runs.folder.state import Packed


class Hosts(Protocol):
    """Holds shares, and may lose them."""

    @property
    def count(self) -> int:
        """How many shares."""
        ...

    def room(self) -> list[tuple[str, int]]:
        """The machine that each share lives on, and bytes of memory that it may have; 0 for unknown."""
        ...

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        """The replies of shares to their calls, all at once; without those that were lost meanwhile, which hold nothing any more but are
        there again. Raises `InputError` where they cannot be."""
        ...

    def emptied(self) -> set[int]:
        """Shares that have been lost since this was last asked, also those whose reply had come: they hold nothing any more."""
        ...

    def store(self, share: int, number: int, packed: Packed) -> bool:
        """See `ViewShare.store`; false where the share was lost."""
        ...

    def fetch(self, number: int) -> dict[int, Packed]:
        """See `ViewShare.fetch`, of all shares; without those that were lost."""
        ...

    def movable(self) -> list[int]:
        """Shares that had better live elsewhere."""
        ...

    def move(self, share: int) -> None:
        """Let a share live elsewhere, where it holds nothing yet."""
        ...


class LocalHosts:
    """All shares in this process, one after the other.

    Args:
        shares: to be held.
    """

    def __init__(self, shares: tuple[ViewShare, ...]):
        self._shares = shares

    @property
    def count(self) -> int:
        return len(self._shares)

    def room(self) -> list[tuple[str, int]]:
        """See `Hosts.room`: not looked at, since the whole problem is here anyhow."""
        return [("this machine", 0)] * self.count

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        return {index: self._shares[index].run(call) for index, call in calls.items()}

    def emptied(self) -> set[int]:
        """See `Hosts.emptied`: none."""
        return set()

    def store(self, share: int, number: int, packed: Packed) -> bool:
        self._shares[share].store(number, packed)
        return True

    def fetch(self, number: int) -> dict[int, Packed]:
        return {index: share.fetch(number) for index, share in enumerate(self._shares)}

    def movable(self) -> list[int]:
        """See `Hosts.movable`: none."""
        return []

    def move(self, share: int) -> None:
        del share
