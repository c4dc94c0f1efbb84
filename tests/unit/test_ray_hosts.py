"""Workers that die or do not start, as `RayHosts` sees them, by a stand-in for Ray: no process, no waiting. Ray itself: tests/render."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.app.distributed.actor import Place
from unrender.app.distributed.cluster import Cluster, Share
from unrender.app.distributed.messages import Call, Reply
from unrender.app.distributed.ray_hosts import RayHosts
from unrender.core.random import Key


class Died(Exception):
    """What Ray raises for calls of an actor that is gone."""


class Other(Exception):
    """What it raises in other cases, none of which arise here."""


class Full(Exception):
    """What it raises where the object store has no room."""


@dataclasses.dataclass(eq=False)
class Reference:
    """What a call will return."""

    actor: Actor
    name: str
    share: int


class Actor:
    """A worker; its methods are remote at once.

    Args:
        ready: the second at which it answers for the first time; None for never.
        ray: that it belongs to.
    """

    def __init__(self, ray: Ray, number: int, ready: float | None):
        self.ray, self.number, self.ready = ray, number, ready
        self.dead, self.dies_in, self.pace = False, -1, 0.1
        self.dropped: list[int] = []

    def __getattr__(self, name: str) -> Any:
        def remote(*arguments: Any) -> Reference:
            share = arguments[0] if arguments else -1
            if name == "drop":
                self.dropped.append(share)
            return Reference(self, name, share)

        return SimpleNamespace(remote=remote)


class Ray:
    """As much of Ray as `RayHosts` uses. Time passes by waiting alone.

    Args:
        ready: of the workers in the order of their starts, see `Actor`; the last is of all that follow.
    """

    def __init__(self, ready: Sequence[float | None]):
        self.now, self.actors, self._ready, self.full = 0.0, list[Actor](), ready, False
        names = (
            "ObjectLostError",
            "WorkerCrashedError",
            "NodeDiedError",
            "GetTimeoutError",
            "RayTaskError",
        )
        names = (*names, "TaskUnschedulableError", "ObjectFetchTimedOutError")
        self.exceptions = SimpleNamespace(RayActorError=Died, RayError=Full, **dict.fromkeys(names, Other))

    def remote(self, **_: Any) -> Callable[[type], Any]:
        def start(*_: Any) -> Actor:
            number = len(self.actors)
            self.actors.append(Actor(self, number, self._ready[min(number, len(self._ready) - 1)]))
            return self.actors[-1]

        return lambda _: SimpleNamespace(remote=start)

    def wait(self, references: list[Any], num_returns: int = 1, timeout: float = 0.0) -> tuple[list[Any], list[Any]]:
        times = sorted(one.actor.ready for one in references if one.actor.ready is not None)
        late = times[num_returns - 1] if len(times) >= num_returns else float("inf")
        self.now = max(self.now, min(self.now + timeout, late))
        done = [one for one in references if one.actor.ready is not None and one.actor.ready <= self.now]
        return done, [one for one in references if one not in done]

    def get(self, reference: Any, timeout: float) -> Any:
        actor = reference.actor
        if reference.name == "run" and actor.dies_in == reference.share:
            actor.dead = True
        if actor.dead:
            raise Died
        if reference.name == "place":
            return Place("here", actor.number, 0)
        return Reply({}, {}, {}, {}, 0, {}, {}, actor.pace) if reference.name == "run" else None

    def put(self, value: Any) -> Any:
        if self.full:
            raise Full("no room\nand much more")
        return value

    def kill(self, actor: Actor) -> None:
        actor.dead = True


def hosts(ray: Ray, shares: int, told: list[str]) -> RayHosts:
    views = tuple((index,) for index in range(shares))
    cluster = Cluster(ray, "llvm_ad_rgb", Share(shares, 1.0, 0.0), None)
    return RayHosts(cluster, views, (b"",) * shares, 1, told.append)


CALL = Call({}, ur.images.Plain(), None, 1, Key(0))


def test_all_shares_of_a_worker_that_dies_are_empty_though_one_has_replied() -> None:
    ray = Ray([0.0, 0.0, 0.0, None])
    found = hosts(ray, 3, [])
    calls = dict.fromkeys(range(3), CALL)
    assert len(found.run(calls)) == 3
    assert found.emptied() == set()
    ray.actors[2].dies_in = 2
    assert sorted(found.run(calls)) == [0, 1]
    assert found.emptied() == {2}
    ray.actors[0].dies_in = 2  # it holds shares 0 and 2 now
    assert sorted(found.run(calls)) == [0, 1]
    assert found.emptied() == {0, 2}
    assert found.emptied() == set()
    assert len(found.run(calls)) == 3


def test_workers_that_do_not_start_are_waited_for_together_and_join_later() -> None:
    ray = Ray([1.0, 100.0, None, None])
    found = hosts(ray, 4, told := [])
    assert ray.now == 60
    assert told == ["workers: 1 of 4 were ready within 60 s; 3 may join later"]
    assert found.emptied() == set()
    assert found.movable() == []
    ray.now = 101.0
    assert found.movable() == [3, 2]
    found.move(3)
    assert found.movable() == [2]
    assert len(found.run(dict.fromkeys(range(4), CALL))) == 4
    assert not ray.actors[1].dead
    found.move(2)
    assert [len(worker.shares) for worker in found._workers] == [2, 2]
    assert found.movable() == []


def test_no_worker_that_starts_is_one_line() -> None:
    ray = Ray([None])
    with pytest.raises(ur.InputError, match="none was ready within 60 s"):
        hosts(ray, 3, [])
    assert ray.now == 60
    assert all(actor.dead for actor in ray.actors)


def test_a_straggler_loses_its_views_and_another_worker_is_started_in_its_place() -> None:
    ray = Ray([0.0, 0.0, 0.0, 5.0])
    found = hosts(ray, 3, told := [])
    calls = dict.fromkeys(range(3), CALL)
    ray.actors[1].pace = 1.0
    for _ in range(8):
        assert found.movable() == []
        found.run(calls)
    assert found.movable() == [1]
    found.move(1)
    assert told == ["worker of views 1 on here: 1 s a step, far above the others: moved to here"]
    assert found.emptied() == {1}
    assert (ray.actors[1].dead, ray.actors[1].dropped) == (True, [])
    assert len(found.run(calls)) == 3
    assert found.movable() == []
    ray.now = 5.0
    assert found.movable() == [1]
    found.move(1)
    assert [len(worker.shares) for worker in found._workers] == [1, 1, 1]
    assert ray.actors[0].dropped == [1]


def test_stragglers_are_replaced_a_few_times_at_most() -> None:
    ray = Ray([0.0])
    found = hosts(ray, 2, [])
    for _ in range(100):
        for share in found.movable():
            found.move(share)
        for actor in ray.actors[1:]:
            actor.pace = 1.0
        found.run(dict.fromkeys(range(2), CALL))
    assert len(ray.actors) == 5
    assert [len(worker.shares) for worker in found._workers] == [2]


def test_a_share_that_can_move_nowhere_stays() -> None:
    ray = Ray([0.0, 0.0, None])
    found = hosts(ray, 2, [])
    calls = dict.fromkeys(range(2), CALL)
    ray.actors[1].pace = 1.0
    for _ in range(8):
        found.run(calls)
    assert found.movable() == [1]
    ray.actors[0].dies_in = 0
    assert sorted(found.run(calls)) == [1]
    found.move(1)  # whose worker is the only one by now
    assert not ray.actors[1].dead
    assert len(found.run(calls)) == 2


def test_a_share_whose_new_worker_dies_at_once_stays_with_the_old_one() -> None:
    ray = Ray([0.0, 100.0, None])
    found = hosts(ray, 3, [])
    ray.now = 101.0
    assert found.movable() == [2]
    ray.actors[1].dead = True
    found.move(2)
    assert ray.actors[0].dropped == []
    assert len(found.run(dict.fromkeys(range(3), CALL))) == 3


def test_a_full_object_store_is_one_line() -> None:
    ray = Ray([0.0])
    found = hosts(ray, 2, [])
    ray.full = True
    with pytest.raises(ur.InputError, match=r"^workers: Full: no room$"):
        found.run({share: dataclasses.replace(CALL, arrays={0: np.ones(3)}) for share in range(2)})
