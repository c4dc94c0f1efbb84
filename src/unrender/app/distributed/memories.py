"""The workers' memories of views as the driver tracks them: by number, with the steps that restore them."""

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
    """Steps that restore the memory after a step.

    Attributes:
        number: number of the memory.
        base: recipe of the memory before the step; None without memory, or if the result is stored.
        call: call that computes it from `base`; None if it is stored.
        sent: arrays of the call.
        stored: the memory of each share, if it was collected.
        steps, bytes: steps to repeat since the last stored memory, and their bytes.
    """

    number: int
    base: Recipe | None = None
    call: Call | None = None
    sent: dict[int, Sent] = field(default_factory=dict)
    stored: tuple[Packed, ...] | None = None
    steps: int = 0
    bytes: int = 0

    def store(self, packed: tuple[Packed, ...]) -> None:
        """Store a collected memory, so that earlier steps need not be repeated."""
        self.stored, self.base, self.call, self.sent = packed, None, None, {}
        self.steps = self.bytes = 0

    def is_long(self, size: int) -> bool:
        """Return whether the memory should be collected.

        Args:
            size: bytes of the last collection; 0 before there was one.
        """
        return self.steps >= _MOST_STEPS or self.bytes >= max(_MOST_BYTES, size)

    def chain(self) -> list[Recipe]:
        """Return the recipes from the last stored one, or the first step, to this one."""
        recipes: list[Recipe] = [self]
        while recipes[-1].stored is None and recipes[-1].base is not None:
            recipes.append(recipes[-1].base)
        return recipes[::-1]


class Memory:
    """Placeholder of the workers' memory of all views in the state of an image estimator. Workers drop the memory when this object
    dies.

    This is not a dataclass, since Dr.Jit would search it for arrays.

    Args:
        recipe: recipe of the memory.
    """

    def __init__(self, recipe: Recipe):
        self.recipe = recipe

    @property
    def number(self) -> int:
        """The number by which workers identify the memory."""
        return self.recipe.number


class Memories:
    """The memories that are in use."""

    def __init__(self) -> None:
        self._numbers: Iterator[int] = itertools.count()
        self._alive: weakref.WeakValueDictionary[int, Memory] = weakref.WeakValueDictionary()

    def after(self, base: Memory | None, call: Call, sent: dict[int, Sent]) -> tuple[Memory, Call]:
        """Return the memory after a call, and the call with its number."""
        number = next(self._numbers)
        call = replace(call, result=number)
        before = None if base is None else base.recipe
        steps, size = (1, 0) if before is None else (before.steps + 1, before.bytes)
        size += sum(one.value.nbytes for one in sent.values())
        return self._noted(Recipe(number, before, call, sent, None, steps, size)), call

    def stored(self, packed: tuple[Packed, ...]) -> Memory:
        """Return a memory that each share has to load."""
        return self._noted(Recipe(next(self._numbers), stored=packed))

    def is_alive(self, number: int) -> bool:
        """Return whether the memory is still referenced."""
        return number in self._alive

    def _noted(self, recipe: Recipe) -> Memory:
        memory = Memory(recipe)
        self._alive[recipe.number] = memory
        return memory
