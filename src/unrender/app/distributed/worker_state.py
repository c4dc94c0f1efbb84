"""State of the workers as the main process tracks it: numbered memories, with the steps that restore them, and parameters sent once."""

from __future__ import annotations

import itertools
import weakref
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unrender.app.distributed.messages import Call, References
from unrender.core import arrays
from unrender.core.trees import Tree
from unrender.runs.folder.state import Packed

_MOST_STEPS = 512
_MOST_BYTES = 1 << 28
"""Maximum steps, and bytes of their parameters, that a lost share repeats. The bytes of a collection count if they are more, so that
collections do not send more than steps."""


@dataclass(eq=False)
class Recipe:
    """Steps that restore the memory after a step.

    Attributes:
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
        """Return whether the memory should be collected; `size` is the bytes of the last collection, 0 before there was one."""
        return self.steps >= _MOST_STEPS or self.bytes >= max(_MOST_BYTES, size)

    def chain(self) -> list[Recipe]:
        """Return the recipes from the last stored one, or the first step, to this one."""
        recipes: list[Recipe] = [self]
        while recipes[-1].stored is None and recipes[-1].base is not None:
            recipes.append(recipes[-1].base)
        return recipes[::-1]


class Memory:
    """Placeholder of the workers' memory of all views in the state of an image estimator. Workers drop the memory when this object dies.

    This is not a dataclass, since Dr.Jit would search it for arrays.
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


_RECENT = 4
"""Number of recent arrays per parameter that are recognised: the current one, and those in states of earlier steps."""


@dataclass(eq=False)
class Sent:
    """An array as workers have it, with its value on the host."""

    number: int
    value: np.ndarray


class Outbox:
    """Assigns numbers to arrays, and recognises arrays that have one."""

    def __init__(self) -> None:
        self._count = 0
        self._known: OrderedDict[int, tuple[Any, Sent]] = OrderedDict()
        self._last: dict[str, Sent] = {}

    def numbered(self, tree: Tree) -> dict[str, Sent]:
        """Return the tree in the form that workers receive."""
        return {key: self._sent(key, value) for key, value in tree.items()}

    def once(self, tree: Tree) -> dict[str, Sent]:
        """Return a tree that is sent in full for one call."""
        return {key: Sent(self._next(), arrays.numpy(value)) for key, value in tree.items()}

    def values(self, tree: Mapping[str, Sent]) -> References:
        """Return the numbers of a tree."""
        return {key: sent.number for key, sent in tree.items()}

    def _sent(self, key: str, value: Any) -> Sent:
        if (entry := self._known.get(id(value))) is not None:
            self._known.move_to_end(id(value))
            return entry[1]
        host = arrays.numpy(value)
        last = self._last.get(key)
        if last is None or not np.array_equal(last.value, host):
            last = Sent(self._next(), host)
        return self._note(key, value, last)

    def _note(self, key: str, exact: Any, sent: Sent) -> Sent:
        self._known[id(exact)] = exact, sent  # hold a reference, so that its id is not reused
        self._last[key] = sent
        while len(self._known) > _RECENT * len(self._last):
            self._known.popitem(last=False)
        return sent

    def _next(self) -> int:
        self._count += 1
        return self._count
