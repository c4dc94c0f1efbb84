"""Independent tasks, in this process or on workers. A worker's death costs its task alone, which is begun again elsewhere."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender.app.distributed.cluster.connection import Cluster
from unrender.core.errors import InputError, UnrenderError
from unrender.core.text import one_line

_ATTEMPTS = 3
_GRACE_SECONDS = 4.0
"""After an interrupt, for tasks to save what they have reached."""


@dataclass(frozen=True)
class Ended:
    """A task that came to an end.

    Attributes:
        key: its own.
        value: what its function returned; None where it failed.
        message: why it failed, one line; "" where it did not.
        attempts: how often it was begun.
    """

    key: Any
    value: Any
    message: str = ""
    attempts: int = 1


class Executor(Protocol):
    """Carries out tasks: calls of one function."""

    @property
    def slots(self) -> int:
        """How many tasks may be under way."""
        ...

    @property
    def pending(self) -> int:
        """How many are begun and have not been returned by `wait`."""
        ...

    def start(self, key: Any, *arguments: Any) -> None:
        """Begin a task, where `pending` is below `slots`."""
        ...

    def wait(self, seconds: float) -> list[Ended]:
        """Tasks that have come to an end, in the order in which they were begun; [] where none has after so many seconds.

        An interrupt (`KeyboardInterrupt`) passes through once the tasks under way have been told to stop.
        """
        ...


@dataclass
class InProcess:
    """One task at a time, in this process, carried out by `wait`.

    Attributes:
        function: of the arguments given to `start`.
    """

    function: Callable[..., Any]
    slots: int = 1
    _next: list[tuple[Any, tuple[Any, ...]]] = field(default_factory=list)

    @property
    def pending(self) -> int:
        return len(self._next)

    def start(self, key: Any, *arguments: Any) -> None:
        self._next.append((key, arguments))

    def wait(self, seconds: float) -> list[Ended]:
        """See `Executor.wait`. Waits for as long as the task takes."""
        if not self._next:
            return []
        key, arguments = self._next.pop(0)
        try:
            return [Ended(key, self.function(*arguments))]
        except Exception as error:  # one task's, whatever it is
            return [Ended(key, None, _reason(error))]


@dataclass
class _Begun:
    """A task under way: its key, its arguments, how often it was begun."""

    key: Any
    arguments: tuple[Any, ...]
    attempts: int


class OnWorkers:
    """Tasks on a cluster's workers, each in a process of its own.

    Where the process or its machine dies, the task is begun again, at most twice.

    Args:
        cluster: connected.
        function: of a module that the workers can import; of arguments and a result that can be serialised.
    """

    def __init__(self, cluster: Cluster, function: Callable[..., Any]):
        self._ray, self._head = cluster.ray, cluster.head
        self._remote = cluster.ray.remote(function).options(
            **cluster.resources, max_retries=0, scheduling_strategy="SPREAD", name="unrender"
        )
        self.slots = cluster.share.count
        self._begun: dict[Any, _Begun] = {}

    @property
    def pending(self) -> int:
        return len(self._begun)

    def start(self, key: Any, *arguments: Any) -> None:
        self._start(_Begun(key, arguments, 1))

    def wait(self, seconds: float) -> list[Ended]:
        """See `Executor.wait`. Raises `InputError` where the cluster's head node is lost."""
        self._head.check()
        try:
            ready = set(self._ray.wait(list(self._begun), num_returns=1, timeout=seconds)[0])
            if ready:  # all that have ended by now
                ready |= set(self._ray.wait(list(self._begun), num_returns=len(self._begun), timeout=0)[0])
            ended = [self._end(reference) for reference in list(self._begun) if reference in ready]
            return [one for one in ended if one is not None]
        except KeyboardInterrupt:
            self._cancel()
            raise

    def saved(self) -> list[Ended]:
        """After an interrupt: the tasks that ended in good order, before it or because of it."""
        ready = self._ray.wait(list(self._begun), num_returns=len(self._begun), timeout=0)[0] if self._begun else []
        found = []
        for reference in ready:
            task = self._begun.pop(reference)
            with contextlib.suppress(self._ray.exceptions.RayError):
                found.append(Ended(task.key, self._ray.get(reference), "", task.attempts))
        return found

    def _start(self, task: _Begun) -> None:
        self._begun[self._remote.remote(*task.arguments)] = task

    def _end(self, reference: Any) -> Ended | None:
        """What became of a task; None for one that is begun again."""
        errors = self._ray.exceptions
        task = self._begun.pop(reference)
        try:
            return Ended(task.key, self._ray.get(reference), "", task.attempts)
        except errors.RayTaskError as error:
            return Ended(task.key, None, _reason(error.cause or error), task.attempts)
        except errors.LocalRayletDiedError as error:  # nothing can be begun any more
            raise InputError(
                "workers: Ray's node on this machine is lost; start the command again: what had ended is kept, and "
                "unrender sweep DIR goes on"
            ) from error
        except errors.RayError as error:
            if task.attempts < _ATTEMPTS:
                self._start(_Begun(task.key, task.arguments, task.attempts + 1))
                return None
            return Ended(task.key, None, f"its worker died {task.attempts} times: {_death(error)}", task.attempts)

    def _cancel(self) -> None:
        """Tell all tasks to stop, and wait for a few seconds until they have."""
        with contextlib.suppress(Exception):
            for reference in self._begun:
                self._ray.cancel(reference)
            until = time.monotonic() + _GRACE_SECONDS
            waiting = list(self._begun)
            self._ray.wait(waiting, num_returns=len(waiting), timeout=max(until - time.monotonic(), 0))


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, UnrenderError):
        return one_line(text)
    return one_line(f"{type(error).__name__}: {text[:300]}" if text else type(error).__name__)


def _death(error: BaseException) -> str:
    """Ray's words, without what they say of its logs."""
    first = " ".join(str(error).split()).split(". ")[0]
    return one_line(first[:200])
