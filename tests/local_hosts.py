"""All shares of a distributed run in this process."""

from __future__ import annotations

from collections.abc import Mapping

from unrender.app.distributed.messages import Call, Reply
from unrender.app.distributed.share import ViewShare
from unrender.runs.folder.state import Packed


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
        return [("this machine", 0)] * self.count

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        return {index: self._shares[index].run(call) for index, call in calls.items()}

    def emptied(self) -> set[int]:
        return set()

    def store(self, share: int, number: int, packed: Packed) -> bool:
        self._shares[share].store(number, packed)
        return True

    def fetch(self, number: int) -> dict[int, Packed]:
        return {index: share.fetch(number) for index, share in enumerate(self._shares)}

    def movable(self) -> list[int]:
        return []

    def move(self, share: int) -> None:
        del share
