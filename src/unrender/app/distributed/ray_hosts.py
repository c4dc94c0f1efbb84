"""Shares in Ray actors: what is lost, hangs or lags is noticed, and lives elsewhere from then on."""

from __future__ import annotations

import bisect
import collections
import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from unrender.app.distributed.actor import Place, ViewWorker
from unrender.app.distributed.cluster import Cluster
from unrender.app.distributed.messages import Call, Reply
from unrender.core.errors import InputError, UnrenderError
from unrender.core.text import one_line
from unrender.runs.folder.state import Packed

_POLL, _PATIENCE, _ANSWER = 1.0, 4.0, 8.0
"""Seconds between looks; without a reply until a worker is asked whether it is there; and until it has to have said so."""
_START = 60.0
"""Seconds that all workers together at first, or one where none is left, may take to be there."""
_LONGEST, _MANY_TIMES = 1800.0, 50.0
"""Seconds that a step may take at most, and times its usual ones, a minute more: a worker that answers, but never ends."""
_COMPILING = 3
"""Steps of a share in a new place, until its kernels are compiled."""
_LAGGING, _IN_A_ROW, _LEAST = 4.0, 5, 0.05
"""Times the others' median, steps in a row, and seconds, from which a worker counts as lagging."""
_SUCCESSORS = 3
"""Workers that are started in place of ones that lagged, at most: where a machine is slow, the next one there lags, too."""


@dataclass(eq=False)
class _Worker:
    """An actor.

    Attributes:
        handle: Ray's.
        place: where it runs; None until it is ready.
        first: the reference to its first answer.
        shares: that it holds.
    """

    handle: Any
    first: Any
    place: Place | None = None
    shares: set[int] = field(default_factory=set)


@dataclass
class _Lag:
    """How a share's worker keeps up: its mean seconds a step of late, for how many steps they were far above the others', and the most
    that is usual."""

    steps: int = 0
    seconds: float = 0.0
    behind: int = 0
    usual: float | None = None


class RayHosts:
    """`Hosts` of Ray: an actor for each share. Where one dies, or answers no more, a survivor takes its shares over, and another actor is
    started, to which they go when it is ready. Shares of an actor that lags go to another that does not.

    Args:
        cluster: that is connected.
        shares: the views of each.
        blobs: the problem of each, see `transfer.packed`.
        threads: of each worker; None for its share of the processor.
        tell: is told what happens, a line each.

    Raises:
        InputError: no worker starts, or the problem cannot be made there.
    """

    def __init__(
        self,
        cluster: Cluster,
        shares: tuple[tuple[int, ...], ...],
        blobs: tuple[bytes, ...],
        threads: int | None = None,
        tell: Callable[[str], None] = lambda line: None,
    ):
        self._cluster, self._ray, self._views, self._blobs, self._tell = cluster, cluster.ray, shares, blobs, tell
        self._threads = threads or cluster.share.threads
        self._lags = [_Lag() for _ in shares]
        self._emptied: set[int] = set()
        self._successors = 0
        self._starting: list[_Worker] = []
        self._workers = [self._start() for _ in shares]
        self._of: list[_Worker] = []
        self._await_all()
        if not self._workers:
            raise InputError(
                f"workers: none was ready within {_START:g} s: the cluster has no room for one, or cannot run unrender"
            )
        self._of = [self._workers[index % len(self._workers)] for index in range(len(shares))]
        for index, worker in enumerate(self._of):
            worker.shares.add(index)
        self._collected({index: self._holding(index) for index in range(len(shares))})
        self._emptied.clear()  # nothing was in them

    @property
    def count(self) -> int:
        return len(self._views)

    def room(self) -> list[tuple[str, int]]:
        """See `Hosts.room`: workers of one machine, or of one GPU, share what it has."""
        places = [worker.place or Place("?", 0, 0) for worker in self._of]
        together = collections.Counter((place.machine, place.gpu) for place in places)
        return [(place.machine, place.free // together[place.machine, place.gpu]) for place in places]

    def close(self) -> None:
        """End all workers."""
        for worker in [*self._workers, *self._starting]:
            self._kill(worker)
        self._workers, self._starting = [], []

    # ------------------------------------------------------------------ Hosts

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        common = self._put({share: call.arrays for share, call in calls.items()})
        references = {
            share: self._called(share, "run", share, replace(call, arrays={}), common[share])
            for share, call in calls.items()
        }
        replies: dict[int, Reply] = self._collected(references)
        self._observe(replies)
        return replies

    def emptied(self) -> set[int]:
        found, self._emptied = self._emptied, set()
        return found

    def store(self, share: int, number: int, packed: Packed) -> bool:
        return share in self._collected({share: self._called(share, "store", share, number, packed)})

    def fetch(self, number: int) -> dict[int, Packed]:
        return self._collected({share: self._called(share, "fetch", share, number) for share in range(self.count)})

    def movable(self) -> list[int]:
        """See `Hosts.movable`: one share of a worker that lags; else those of workers that have two more than another, until none has."""
        for worker in [worker for worker in self._starting if self._is_done(worker)]:
            self._starting.remove(worker)
            if worker.place is not None:
                self._workers.append(worker)
        if len(self._workers) < 2:
            return []
        if behind := [share for share in range(self.count) if self._lags[share].behind >= _IN_A_ROW]:
            return behind[:1]
        loads, found = [sorted(worker.shares) for worker in self._workers], list[int]()
        while len(most := max(loads, key=len)) > len(least := min(loads, key=len)) + 1:
            least.insert(0, most.pop())
            found.append(least[0])
        return found

    def move(self, share: int) -> None:
        """See `Hosts.move`. Nothing where the share has moved meanwhile, or there is nowhere else."""
        if share not in self.movable():
            return
        old, lag = self._of[share], self._lags[share]
        lagged = lag.behind >= _IN_A_ROW
        new = min((w for w in self._workers if w is not old), key=lambda w: (self._is_behind(w), len(w.shares)))
        if lagged:
            self._tell(
                f"{self._named(share)}: {lag.seconds:.2g} s a step, far above the others: moved to {_where(new)}"
            )
        self._lags[share] = _Lag()
        old.shares.discard(share)
        self._hold(share, new)
        if self._of[share] is old or old not in self._workers:
            return  # the new one was lost meanwhile, or the old one
        if old.shares or not lagged:
            old.handle.drop.remote(share)
            return
        self._workers.remove(old)
        self._kill(old)
        if self._successors < _SUCCESSORS:
            self._successors += 1
            self._starting.append(self._start())

    def _is_behind(self, worker: _Worker) -> bool:
        return any(self._lags[share].behind >= _IN_A_ROW for share in worker.shares)

    # ------------------------------------------------------------------ replies, and what does not come

    def _put(self, arrays: Mapping[int, dict[int, Any]]) -> dict[int, Any]:
        """What is sent to each share: by way of the object store, once for all that lack the same, where there are several."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for share, values in arrays.items():
            groups.setdefault((*sorted(values),), []).append(share)
        found: dict[int, Any] = {}
        for members in groups.values():
            one: Any = arrays[members[0]]
            if one and len(members) > 1:
                one = self._guarded(lambda one=one: self._ray.put(one))
            found |= dict.fromkeys(members, one)
        return found

    def _called(self, share: int, name: str, *arguments: Any) -> Any:
        """The reference to what a share's worker will answer. Large arguments go by way of the object store, too."""
        return self._guarded(lambda: getattr(self._of[share].handle, name).remote(*arguments))

    def _guarded(self, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except self._ray.exceptions.RayError as error:
            raise InputError(f"workers: {_reason(error)}") from error

    def _collected(self, references: Mapping[int, Any]) -> dict[int, Any]:
        """What came of calls to shares; without those of workers that were lost, whose shares live elsewhere afterwards."""
        found: dict[int, Any] = {}
        open_ = dict(references)
        started = last = time.monotonic()
        lost: list[_Worker] = []
        while open_:
            self._cluster.head.check()
            waiting = list(open_.values())
            done = self._ray.wait(waiting, num_returns=1, timeout=_POLL)[0]
            if done:  # all that are there by now: one at a time would take time by the square of their number
                done = set(self._ray.wait(waiting, num_returns=len(waiting), timeout=0)[0])
            for share in [share for share, reference in open_.items() if reference in done]:
                last = time.monotonic()
                try:
                    found[share] = self._ray.get(open_.pop(share), timeout=_ANSWER)
                except Exception as error:
                    self._judge(share, error, lost)
            now = time.monotonic()
            late = [share for share in open_ if now - started > self._limit(share)]
            if open_ and not done and now - last > _PATIENCE:
                late += self._silent(open_)
                last = time.monotonic()
            for share in set(late):
                lost.append(self._of[share])
                open_ = {other: reference for other, reference in open_.items() if self._of[other] is not lost[-1]}
        for worker in dict.fromkeys(lost):
            self._replace(worker)
        return found

    def _limit(self, share: int) -> float:
        usual = self._lags[share].usual
        return _LONGEST if usual is None else 60.0 + _MANY_TIMES * usual

    def _silent(self, shares: Mapping[int, Any]) -> list[int]:
        """Shares whose worker does not say that it is there."""
        asked = {share: self._of[share].handle.alive.options(concurrency_group="answers").remote() for share in shares}
        done, _ = self._ray.wait(list(asked.values()), num_returns=len(asked), timeout=_ANSWER)
        return [share for share, reference in asked.items() if reference not in done]

    def _judge(self, share: int, error: Exception, lost: list[_Worker]) -> None:
        """Whether an error means that a worker is lost; raise `InputError` where it means anything else."""
        kinds = self._ray.exceptions
        cause = getattr(error, "cause", None)
        if isinstance(cause, UnrenderError):
            raise InputError(str(cause)) from error
        gone = (kinds.RayActorError, kinds.ObjectLostError, kinds.WorkerCrashedError, kinds.NodeDiedError)
        gone = (*gone, kinds.GetTimeoutError, kinds.TaskUnschedulableError, kinds.ObjectFetchTimedOutError)
        if not isinstance(error, gone):
            raise InputError(f"{self._named(share)}: {_reason(error)}") from error
        lost.append(self._of[share])

    # ------------------------------------------------------------------ workers

    def _start(self) -> _Worker:
        cluster = self._cluster
        actor = self._ray.remote(
            **cluster.resources, max_restarts=0, max_task_retries=0, concurrency_groups={"answers": 1}
        )(ViewWorker)
        handle = actor.remote(cluster.variant, self._threads)
        return _Worker(handle, handle.place.remote())

    def _is_done(self, worker: _Worker, timeout: float = 0.0) -> bool:
        """Whether a worker that was started is ready, or will never be; its `place` tells which."""
        done, _ = self._ray.wait([worker.first], timeout=timeout)
        if not done:
            return False
        with contextlib.suppress(self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError):
            try:
                worker.place = self._ray.get(worker.first, timeout=_ANSWER)
            except self._ray.exceptions.RayTaskError as error:
                raise InputError(f"workers: {_reason(error)}") from error
        return True

    def _await(self, worker: _Worker) -> None:
        """Wait until a worker is ready; it is given up where that takes too long."""
        if not self._is_done(worker, _START) or worker.place is None:
            self._kill(worker)

    def _await_all(self) -> None:
        """Wait for all workers at once; those that are not ready by then may come later, and get shares from those that are."""
        self._ray.wait([worker.first for worker in self._workers], num_returns=len(self._workers), timeout=_START)
        started, self._workers = self._workers, []
        for worker in started:
            if not self._is_done(worker):
                self._starting.append(worker)
            elif worker.place is not None:
                self._workers.append(worker)
            else:
                self._kill(worker)
        if not self._workers:
            self.close()
        elif len(self._workers) < len(started):
            self._tell(
                f"workers: {len(self._workers)} of {len(started)} were ready within {_START:g} s; "
                f"{len(self._starting)} may join later"
            )

    def _replace(self, worker: _Worker) -> None:
        """Give the shares of a worker that was lost to others; nothing where that is done already."""
        if not worker.shares:
            return
        shares, worker.shares = sorted(worker.shares), set()
        place = "" if worker.place is None else f" ({worker.place.machine}, process {worker.place.process})"
        if worker in self._workers:
            self._workers.remove(worker)
        self._kill(worker)
        self._starting.append(self._start())
        if not self._workers:
            first = self._starting[-1]
            self._await(first)
            self._starting.remove(first)
            if first.place is None:
                raise InputError(
                    "workers: all were lost, and no other could be started; unrender resume goes on from the last checkpoint"
                )
            self._workers.append(first)
        views = ", ".join(str(view) for share in shares for view in self._views[share])
        self._tell(f"worker{place} of views {views}: lost; others take over")
        for share in shares:
            new = min(self._workers, key=lambda other: len(other.shares))
            self._lags[share] = _Lag()
            self._hold(share, new)

    def _hold(self, share: int, worker: _Worker) -> bool:
        """Let a worker hold a share; where it is lost meanwhile, another does, and the answer is false."""
        self._of[share : share + 1] = [worker]
        self._emptied.add(share)
        worker.shares.add(share)
        return share in self._collected({share: self._holding(share)})

    def _holding(self, share: int) -> Any:
        return self._called(share, "hold", share, self._views[share], self._blobs[share])

    def _kill(self, worker: _Worker) -> None:
        with contextlib.suppress(Exception):
            self._ray.kill(worker.handle)

    # ------------------------------------------------------------------ who lags

    def _observe(self, replies: Mapping[int, Reply]) -> None:
        if len(replies) < len(self._of):
            return
        for share, reply in replies.items():
            lag = self._lags[share]
            lag.steps += 1
            lag.seconds = reply.seconds if lag.steps <= _COMPILING else 0.8 * lag.seconds + 0.2 * reply.seconds
        ordered, compiled = sorted(lag.seconds for lag in self._lags), min(lag.steps for lag in self._lags) > _COMPILING
        for share, reply in replies.items():
            lag = self._lags[share]
            others = self._median_of_others(self._of[share], ordered)
            far = others is not None and lag.seconds > max(_LAGGING * others, _LEAST)
            lag.behind = lag.behind + 1 if far and compiled else 0
            lag.usual = reply.seconds if lag.usual is None else max(reply.seconds, 0.9 * lag.usual)

    def _median_of_others(self, worker: _Worker, ordered: list[float]) -> float | None:
        """The median seconds a step of shares on other workers; None where there is none.

        Args:
            worker: whose shares are left out.
            ordered: of all shares, ascending.
        """
        others = list(ordered)
        for share in worker.shares:
            del others[bisect.bisect_left(others, self._lags[share].seconds)]
        return others[(len(others) - 1) // 2] if others else None

    def _named(self, share: int) -> str:
        return f"worker of views {', '.join(map(str, self._views[share]))} on {_where(self._of[share])}"


def _where(worker: _Worker) -> str:
    return "a new machine" if worker.place is None else worker.place.machine


def _reason(error: Exception) -> str:
    """What Ray says, in one line: the last of its traceback."""
    cause = getattr(error, "cause", None) or error
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    return one_line(f"{type(cause).__name__}: {lines[0] if lines else ''}"[:300])
