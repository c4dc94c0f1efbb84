"""What workers remember of views, as the driver knows it: by number, with what it takes to make it again."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from unrender.app.distributed.messages import Call
from unrender.app.distributed.outbox import Sent
from unrender.runs.folder.state import Packed

_MOST_STEPS = 512
_MOST_BYTES = 1 << 28
"""Steps, and bytes of their parameters, that a share that was lost repeats at most; or as many bytes as a collection has, where these are
more: then collections send no more than steps do."""


@dataclass(eq=False)
class Recipe:
    """How what is remembered after a step was made.

    Attributes:
        number: the memory's.
        base: of the memory before the step; None where nothing was remembered, or what came of the step is stored.
        call: that makes it of that; None where it is stored.
        sent: the arrays of the call.
        stored: what each share remembers, where it was collected.
        steps, bytes: to be repeated from the last stored one on.
    """

    number: int
    base: Recipe | None = None
    call: Call | None = None
    sent: dict[int, Sent] = field(default_factory=dict)
    stored: tuple[Packed, ...] | None = None
    steps: int = 0
    bytes: int = 0

    def store(self, packed: tuple[Packed, ...]) -> None:
        """Keep what was collected; nothing before it will be repeated."""
        self.stored, self.base, self.call, self.sent = packed, None, None, {}
        self.steps = self.bytes = 0

    def is_long(self, size: int) -> bool:
        """Whether it is time to collect.

        Args:
            size: bytes of the last collection; 0 before there was one.
        """
        return self.steps >= _MOST_STEPS or self.bytes >= max(_MOST_BYTES, size)

    def chain(self) -> list[Recipe]:
        """The recipes from the last stored one, or the first step, to this."""
        found: list[Recipe] = [self]
        while found[-1].stored is None and found[-1].base is not None:
            found.append(found[-1].base)
        return found[::-1]


class Memory:
    """Stands for what workers remember of all views, in the state of an image estimator. Workers drop it when it is gone.

    No dataclass: Dr.Jit would look for arrays in it.

    Args:
        recipe: of what it stands for.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe

    @property
    def number(self) -> int:
        """By which workers know it."""
        return self.recipe.number


class Memories:
    """All that are alive."""

    def __init__(self) -> None:
        self._numbers: Iterator[int] = itertools.count()
        self._alive: weakref.WeakValueDictionary[int, Memory] = weakref.WeakValueDictionary()

    def after(self, base: Memory | None, call: Call, sent: dict[int, Sent]) -> tuple[Memory, Call]:
        """What will be remembered after a call, and the call that says so."""
        number = next(self._numbers)
        call = replace(call, result=number)
        before = None if base is None else base.recipe
        steps, size = (1, 0) if before is None else (before.steps + 1, before.bytes)
        size += sum(one.value.nbytes for one in sent.values())
        return self._noted(Recipe(number, before, call, sent, None, steps, size)), call

    def stored(self, packed: tuple[Packed, ...]) -> Memory:
        """What each share is to remember."""
        return self._noted(Recipe(next(self._numbers), stored=packed))

    def is_alive(self, number: int) -> bool:
        """Whether anybody still refers to it."""
        return number in self._alive

    def _noted(self, recipe: Recipe) -> Memory:
        memory = Memory(recipe)
        self._alive[recipe.number] = memory
        return memory
