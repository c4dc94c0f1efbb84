"""Shares in Ray actors. Lost, hanging or slow actors are detected, and their shares move to others."""

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
"""Seconds between polls, without a reply before a worker is pinged, and before a pinged worker must have answered."""
_START = 60.0  # maximum start time in seconds of all initial workers together, or of one if none is left
_LONGEST, _MANY_TIMES = 1800.0, 50.0
"""Maximum duration of a step in seconds, and relative to its usual duration plus a minute, for a worker that answers but hangs."""
_COMPILING = 3  # number of steps of a share on a new worker until its kernels are compiled
_LAGGING, _IN_A_ROW, _LEAST = 4.0, 5, 0.05
"""Factor of the others' median, consecutive steps, and minimum seconds from which a worker counts as lagging."""
_SUCCESSORS = 3  # maximum number of workers that replace lagging ones, since the next worker on a slow machine lags too


@dataclass(eq=False)
class _Worker:
    """An actor: Ray's handle, the reference to its first answer, its place or None until it is ready, and the shares that it holds."""

    handle: Any
    first: Any
    place: Place | None = None
    shares: set[int] = field(default_factory=set)


@dataclass
class _Lag:
    """Timing of a share's worker: recent mean seconds per step, the number of steps far above the others', and the maximum usual
    duration."""

    steps: int = 0
    seconds: float = 0.0
    behind: int = 0
    usual: float | None = None


class RayHosts:
    """`Hosts` of Ray: an actor for each share. If an actor dies or stops responding, another one takes over its shares. A replacement
    is started, to which they move when it is ready. Shares of a lagging actor move to another one.

    Args:
        blobs: the problem of each share, see `transfer.packed`.
        threads: threads of each worker; None for its share of the processor.
        tell: function that receives one-line messages on events.

    Raises:
        InputError: no worker starts, or the problem cannot be built there.
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
        self._emptied.clear()  # new shares have no memory to restore

    @property
    def count(self) -> int:
        return len(self._views)

    def room(self) -> list[tuple[str, int]]:
        """Return the machine and available bytes of each share. Workers of one machine, or of one GPU, share its memory."""
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
        emptied, self._emptied = self._emptied, set()
        return emptied

    def store(self, share: int, number: int, packed: Packed) -> bool:
        return share in self._collected({share: self._called(share, "store", share, number, packed)})

    def fetch(self, number: int) -> dict[int, Packed]:
        return self._collected({share: self._called(share, "fetch", share, number) for share in range(self.count)})

    def movable(self) -> list[int]:
        """Return one share of a lagging worker, or else the shares whose move would balance the numbers of shares per worker."""
        for worker in [worker for worker in self._starting if self._is_done(worker)]:
            self._starting.remove(worker)
            if worker.place is not None:
                self._workers.append(worker)
        if len(self._workers) < 2:
            return []
        if behind := [share for share in range(self.count) if self._lags[share].behind >= _IN_A_ROW]:
            return behind[:1]
        loads, movable = [sorted(worker.shares) for worker in self._workers], list[int]()
        while len(most := max(loads, key=len)) > len(least := min(loads, key=len)) + 1:
            least.insert(0, most.pop())
            movable.append(least[0])
        return movable

    def move(self, share: int) -> None:
        """Move a share. Do nothing if it has moved meanwhile, or there is no other worker."""
        if share not in self.movable():
            return
        old, lag = self._of[share], self._lags[share]
        lagged = lag.behind >= _IN_A_ROW
        behind = {share for share, each in enumerate(self._lags) if each.behind >= _IN_A_ROW}
        others = (worker for worker in self._workers if worker is not old)
        new = min(others, key=lambda worker: (not behind.isdisjoint(worker.shares), len(worker.shares)))
        if lagged:
            self._tell(
                f"{self._named(share)}: {lag.seconds:.2g} s a step, far above the others: moved to {_where(new)}"
            )
        self._lags[share] = _Lag()
        old.shares.discard(share)
        self._hold(share, new)
        if self._of[share] is old or old not in self._workers:
            return  # the new or the old worker was lost meanwhile
        if old.shares or not lagged:
            old.handle.drop.remote(share)
            return
        self._workers.remove(old)
        self._kill(old)
        if self._successors < _SUCCESSORS:
            self._successors += 1
            self._starting.append(self._start())

    # ------------------------------------------------------------------ replies and lost workers

    def _put(self, arrays: Mapping[int, dict[int, Any]]) -> dict[int, Any]:
        """Return the arrays to send to each share. Arrays that several shares lack are put into the object store once."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for share, values in arrays.items():
            groups.setdefault((*sorted(values),), []).append(share)
        references: dict[int, Any] = {}
        for members in groups.values():
            one: Any = arrays[members[0]]
            if one and len(members) > 1:
                one = self._guarded(lambda one=one: self._ray.put(one))
            references |= dict.fromkeys(members, one)
        return references

    def _called(self, share: int, name: str, *arguments: Any) -> Any:
        """Return the reference to the answer of a share's worker. Ray stores large arguments in the object store."""
        return self._guarded(lambda: getattr(self._of[share].handle, name).remote(*arguments))

    def _guarded(self, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except self._ray.exceptions.RayError as error:
            raise InputError(f"workers: {_reason(error)}") from error

    def _collected(self, references: Mapping[int, Any]) -> dict[int, Any]:
        """Return the results of calls to shares, without those of lost workers, whose shares are on other workers afterwards."""
        results: dict[int, Any] = {}
        open_ = dict(references)
        started = last = time.monotonic()
        lost: list[_Worker] = []
        while open_:
            self._cluster.head.check()
            waiting = list(open_.values())
            done = self._cluster.wait(waiting, 1, _POLL)
            if done:  # fetch all available results, since one at a time would take quadratic time
                done = self._cluster.wait(waiting, len(waiting))
            for share in [share for share, reference in open_.items() if reference in done]:
                last = time.monotonic()
                try:
                    results[share] = self._cluster.get(open_.pop(share), _ANSWER)
                except Exception as error:
                    self._classify_error(share, error, lost)
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
        return results

    def _limit(self, share: int) -> float:
        usual = self._lags[share].usual
        return _LONGEST if usual is None else 60.0 + _MANY_TIMES * usual

    def _silent(self, shares: Mapping[int, Any]) -> list[int]:
        calls = {share: self._of[share].handle.alive.options(concurrency_group="answers").remote() for share in shares}
        done = self._cluster.wait(list(calls.values()), len(calls), _ANSWER)
        return [share for share, reference in calls.items() if reference not in done]

    def _classify_error(self, share: int, error: Exception, lost: list[_Worker]) -> None:
        """Add the worker to `lost` if the error means that it is lost; raise `InputError` otherwise."""
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
        """Return whether a worker is ready or has failed, which its `place` distinguishes."""
        if not self._cluster.wait([worker.first], seconds=timeout):
            return False
        with contextlib.suppress(self._ray.exceptions.RayActorError, self._ray.exceptions.GetTimeoutError):
            try:
                worker.place = self._cluster.get(worker.first, _ANSWER)
            except self._ray.exceptions.RayTaskError as error:
                raise InputError(f"workers: {_reason(error)}") from error
        return True

    def _await_all(self) -> None:
        """Wait for all workers at once; those that are not ready by then may come later, and get shares from those that are."""
        self._cluster.wait([worker.first for worker in self._workers], len(self._workers), _START)
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
        """Move the shares of a lost worker to others; do nothing if this is already done."""
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
            ready = self._is_done(first, _START) and first.place is not None
            self._starting.remove(first)
            if not ready:
                self._kill(first)
                raise InputError(
                    "workers: all were lost, and no other could be started; run unrender resume to continue from the last checkpoint"
                )
            self._workers.append(first)
        views = ", ".join(str(view) for share in shares for view in self._views[share])
        self._tell(f"worker{place} of views {views}: lost; others take over")
        for share in shares:
            new = min(self._workers, key=lambda other: len(other.shares))
            self._lags[share] = _Lag()
            self._hold(share, new)

    def _hold(self, share: int, worker: _Worker) -> bool:
        """Assign a share to a worker; return False if that is lost meanwhile and another worker takes over."""
        self._of[share : share + 1] = [worker]
        self._emptied.add(share)
        worker.shares.add(share)
        return share in self._collected({share: self._holding(share)})

    def _holding(self, share: int) -> Any:
        return self._called(share, "hold", share, self._views[share], self._blobs[share])

    def _kill(self, worker: _Worker) -> None:
        with contextlib.suppress(Exception):
            self._ray.kill(worker.handle)

    # ------------------------------------------------------------------ lagging workers

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
        """Return the median seconds per step of shares on other workers, from the `ordered` ones of all; None if there are none."""
        others = list(ordered)
        for share in worker.shares:
            del others[bisect.bisect_left(others, self._lags[share].seconds)]
        return others[(len(others) - 1) // 2] if others else None

    def _named(self, share: int) -> str:
        return f"worker of views {', '.join(map(str, self._views[share]))} on {_where(self._of[share])}"


def _where(worker: _Worker) -> str:
    return "a new machine" if worker.place is None else worker.place.machine


def _reason(error: Exception) -> str:
    """Return the last line of Ray's traceback, as one line."""
    cause = getattr(error, "cause", None) or error
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    return one_line(f"{type(cause).__name__}: {lines[0] if lines else ''}"[:300])
