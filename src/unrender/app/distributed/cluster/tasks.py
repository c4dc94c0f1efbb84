"""Independent tasks, in this process or on workers. A worker's death affects its task only, which is restarted elsewhere."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from unrender.app.distributed.cluster.connection import Cluster
from unrender.core.errors import InputError, UnrenderError
from unrender.core.text import one_line

_ATTEMPTS = 3
_GRACE_SECONDS = 4.0  # time for tasks to save their state after an interrupt, in seconds


@dataclass(frozen=True)
class Ended:
    """A completed task: the value of its function, None if it failed, the reason of the failure in one line or "", and the number of
    starts."""

    key: Any
    value: Any
    message: str = ""
    attempts: int = 1


class Executor(Protocol):
    """Carries out tasks: calls of one function."""

    @property
    def slots(self) -> int:
        """Return the maximum number of concurrent tasks."""
        ...

    @property
    def pending(self) -> int:
        """The number of tasks that are started and have not been returned by `wait`."""
        ...

    def start(self, key: Any, *arguments: Any) -> None:
        """Start a task, if `pending` is below `slots`."""
        ...

    def wait(self, seconds: float) -> list[Ended]:
        """Return completed tasks in the order of their start; [] if none completes within `seconds`.

        An interrupt (`KeyboardInterrupt`) propagates after the running tasks were cancelled.
        """
        ...


@dataclass
class InProcess:
    """Executor that runs one task at a time in this process, in `wait`."""

    function: Callable[..., Any]
    slots: int = 1
    _next: list[tuple[Any, tuple[Any, ...]]] = field(default_factory=list)

    @property
    def pending(self) -> int:
        return len(self._next)

    def start(self, key: Any, *arguments: Any) -> None:
        self._next.append((key, arguments))

    def wait(self, seconds: float) -> list[Ended]:
        """Run the next task and return it. Blocks until the task ends."""
        if not self._next:
            return []
        key, arguments = self._next.pop(0)
        try:
            return [Ended(key, self.function(*arguments))]
        except Exception as error:  # any failure affects one task only
            return [Ended(key, None, _reason(error))]


@dataclass
class _Begun:
    """A running task: its key, its arguments, and its number of starts."""

    key: Any
    arguments: tuple[Any, ...]
    attempts: int


class OnWorkers:
    """Executor that runs an importable function on a cluster's workers, each task in its own process.

    If the process or its machine dies, the task is restarted, at most twice.
    """

    def __init__(self, cluster: Cluster, function: Callable[..., Any]):
        self._cluster, self._ray = cluster, cluster.ray
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
        """Return completed tasks. Raise `InputError` if the cluster's head node is lost."""
        self._cluster.head.check()
        try:
            ready = self._cluster.wait(list(self._begun), 1, seconds)
            if ready:  # all completed tasks
                ready |= self._cluster.wait(list(self._begun), len(self._begun))
            ended = [self._end(reference) for reference in list(self._begun) if reference in ready]
            return [one for one in ended if one is not None]
        except KeyboardInterrupt:
            self._cancel()
            raise

    def saved(self) -> list[Ended]:
        """Return, after an interrupt, the tasks that ended regularly, before it or because of it."""
        ready = self._cluster.wait(list(self._begun), len(self._begun))
        ended = []
        for reference in [reference for reference in self._begun if reference in ready]:
            task = self._begun.pop(reference)
            with contextlib.suppress(self._ray.exceptions.RayError):
                ended.append(Ended(task.key, self._cluster.get(reference), "", task.attempts))
        return ended

    def _start(self, task: _Begun) -> None:
        self._begun[self._remote.remote(*task.arguments)] = task

    def _end(self, reference: Any) -> Ended | None:
        """Return a completed task; None for one that is restarted."""
        errors = self._ray.exceptions
        task = self._begun.pop(reference)
        try:
            return Ended(task.key, self._cluster.get(reference), "", task.attempts)
        except errors.RayTaskError as error:
            return Ended(task.key, None, _reason(error.cause or error), task.attempts)
        except errors.LocalRayletDiedError as error:  # nothing can be begun any more
            raise InputError(
                "workers: Ray's node on this machine is lost; finished trials are kept: start the command again, or "
                "continue with unrender sweep DIR"
            ) from error
        except errors.RayError as error:
            if task.attempts < _ATTEMPTS:
                self._start(_Begun(task.key, task.arguments, task.attempts + 1))
                return None
            death = one_line(" ".join(str(error).split()).split(". ")[0][:200])  # without Ray's references to logs
            return Ended(task.key, None, f"its worker died {task.attempts} times: {death}", task.attempts)

    def _cancel(self) -> None:
        with contextlib.suppress(Exception):
            for reference in self._begun:
                self._ray.cancel(reference)
            self._cluster.wait(list(self._begun), len(self._begun), _GRACE_SECONDS)


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, UnrenderError):
        return one_line(text)
    return one_line(f"{type(error).__name__}: {text[:300]}" if text else type(error).__name__)
