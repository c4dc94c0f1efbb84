"""Views dealt to shares within one process: whose steps sum up to one process's, whatever is lost on the way. Nothing here needs Ray."""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.contract import analytic
from tests.local_hosts import LocalHosts
from tiers import quick
from unrender.app.cli.run import variant_again
from unrender.app.distributed import assignment
from unrender.app.distributed.assignment import assign, total
from unrender.app.distributed.cluster import Workers, share
from unrender.app.distributed.executor import DistributedExecutor
from unrender.app.distributed.messages import Call, Reply
from unrender.app.distributed.share import ViewShare
from unrender.app.distributed.transfer import packed, unpacked
from unrender.core import arrays
from unrender.runs.resume import load_run

RCV = ur.images.RecursiveControlVariate
VIEWS = 5
ESTIMATORS = {
    "plain": lambda: ur.PathGradient(spp=2),
    "rcv": lambda: ur.PathGradient(RCV(), spp=2, fresh_from=8),
    "coupled": lambda: ur.MetaEstimator(coupled=True, spp=2, image=RCV()),
    "meta, images of F": lambda: ur.MetaEstimator(difference_images="proportional"),
    "adaptive": lambda: ur.PathGradient(pixels=ur.pixels.Adaptive(40, refresh=5, samples=256, denoiser="none"), spp=2),
    "rcv of mini-batches": lambda: ur.PathGradient(
        RCV(whole_views=3, learn_from_draws=False), pixels=ur.pixels.Uniform(40), spp=2
    ),
}


def shares_of(problem: ur.Problem, shares: Sequence[tuple[int, ...]]) -> tuple[ViewShare, ...]:
    def one(views: tuple[int, ...]) -> ViewShare:
        given = [problem.original_views[view] for view in views]
        return ViewShare(ur.Problem(problem.renderer, problem.parameters, given, problem.loss), views)

    return tuple(one(views) for views in shares)


class Pickler(pickle.Pickler):
    """As much of cloudpickle's as plain values need."""

    def reducer_override(self, obj: Any) -> Any:
        return NotImplemented


WITHOUT_RAY = SimpleNamespace(cloudpickle=SimpleNamespace(CloudPickler=Pickler, loads=pickle.loads))


class Losing(LocalHosts):
    """Loses the last share, with all that it holds, whenever `lose` says so of the number of calls so far."""

    def __init__(self, problem: ur.Problem, shares: Sequence[tuple[int, ...]], lose: Sequence[int]):
        super().__init__(shares_of(problem, shares))
        self.problem, self.views, self.lose, self.calls, self.pilots = problem, shares, lose, 0, 0

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        self.calls += 1
        self.pilots += any(call.pilot is not None for call in calls.values())
        replies = super().run(calls)
        if self.calls in self.lose:
            last = max(calls)
            self._shares = (
                *self._shares[:last],
                *shares_of(self.problem, self.views)[last : last + 1],
                *self._shares[last + 1 :],
            )
            del replies[last]
        return replies


class Crowded(LocalHosts):
    """The first two shares live on one worker, which at some calls dies when the first share has replied, but not the second."""

    def __init__(self, problem: ur.Problem, shares: Sequence[tuple[int, ...]], die: Sequence[int]):
        super().__init__(shares_of(problem, shares))
        self.problem, self.views, self.die, self.calls, self.lost = problem, shares, die, 0, set[int]()

    def dead(self, replies: dict[int, Any]) -> dict[int, Any]:
        self.calls += 1
        if self.calls not in self.die:
            return replies
        self._shares = (*shares_of(self.problem, self.views[:2]), *self._shares[2:])
        self.lost = {0, 1}
        return {share: reply for share, reply in replies.items() if share != 1 or 0 not in replies}

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        return self.dead(super().run(calls))

    def store(self, share: int, number: int, packed: Any) -> bool:
        return share in self.dead({share: super().store(share, number, packed)})

    def fetch(self, number: int) -> dict[int, Any]:
        return self.dead(super().fetch(number))

    def emptied(self) -> set[int]:
        found, self.lost = self.lost, set()
        return found


def dealt(problem: ur.Problem, count: int, lose: Sequence[int] = ()) -> ur.Problem:
    shares = assign([16] * len(problem.views), count)
    return problem.with_parts(executor=DistributedExecutor(problem, shares, Losing(problem, shares, lose)))


def descend(problem: ur.Problem, name: str, **options: Any) -> ur.Result:
    adam = ur.optimizers.Adam(learning_rate=0.02)
    return ur.optimize(problem, ESTIMATORS[name](), adam, steps=options.pop("steps", 12), progress=False, **options)


def apart(a: ur.Result, b: ur.Result) -> float:
    return max(float(np.abs(a.parameters[key] - b.parameters[key]).max()) for key in a.parameters)


def test_views_are_dealt_by_their_pixels() -> None:
    assert assign([16] * 5, 2) == ((0, 2, 4), (1, 3))
    assert assign([100, 10, 10, 80], 2) == ((0,), (1, 2, 3))
    assert assign([1, 1], 4) == ((0,), (1,))


def test_sums_are_in_double_precision_and_in_order() -> None:
    parts = [{"x": np.array([value], np.float32)} for value in (1e8, 1.0, -1e8)]
    assert total(parts)["x"] == 1.0  # in single precision it would be 0
    assert total(parts)["x"].dtype == np.float64
    assert arrays.sum_in_double([part["x"] for part in parts]).dtype == np.float32
    assert arrays.sum_in_double([part["x"] for part in parts]) == 1.0
    assert total([{}, {}]) == {}


@pytest.mark.parametrize("name", quick(ESTIMATORS, "plain", "coupled", "adaptive"))
def test_any_number_of_shares_descends_as_one_process(name: str) -> None:
    problem = analytic.problem(ur.losses.L1(), views=VIEWS)
    alone = descend(problem, name)
    assert apart(alone, descend(problem, name, seed=1)) > 1e-3
    for count in (1, 2, 4):
        together = descend(dealt(problem, count), name)
        assert apart(alone, together) < 1e-12
        assert together.history[-1]["loss"] == pytest.approx(alone.history[-1]["loss"], rel=1e-9)
        assert (
            together.history[-1]["samples"] == alone.history[-1]["samples"]
            or "mini-batches" in name
            or name == "adaptive"
        )


def test_importance_maps_come_from_the_workers() -> None:
    problem = analytic.problem(ur.losses.L1(), views=VIEWS)
    together = dealt(problem, 3)
    descend(together, "adaptive")
    hosts = together.executor._hosts  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert hosts.pilots == 3 * (1 + 3)  # three patterns of signs, in the warm-up and every five of twelve steps


def test_auto_chooses_the_same_whoever_has_the_views() -> None:
    given = analytic.problem(views=VIEWS)
    positive = [ur.Parameter("colour", bounds=(0, float("inf"))), ur.Parameter("map")]
    problem = ur.Problem(given.renderer, positive, given.original_views, ur.losses.L1())
    alone, together = (ur.optimize(one, "auto", steps=6, progress=False) for one in (problem, dealt(problem, 2)))
    assert "reparameterised=('colour',)" in alone.settings["optimizer"]
    assert apart(alone, together) < 1e-12


@pytest.mark.parametrize("name", ["plain", "rcv", "coupled", "rcv of mini-batches", "adaptive"])
def test_a_share_that_is_lost_changes_nothing(name: str) -> None:
    problem = analytic.problem(ur.losses.L1(), views=VIEWS)
    whole, broken = dealt(problem, 2), dealt(problem, 2, lose=(5, 9, 10, 16))
    assert apart(descend(whole, name), descend(broken, name)) == 0
    assert broken.executor.traffic.lost == 4  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert (broken.executor.traffic.repeated > 0) == (name not in ("plain", "adaptive"))  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]


@pytest.mark.parametrize("name", quick(["plain", "rcv", "rcv of mini-batches"], "rcv of mini-batches"))
def test_a_worker_that_dies_between_the_replies_of_its_shares_changes_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So that memories are collected and stored, too.
    monkeypatch.setattr("unrender.app.distributed.worker_state._MOST_STEPS", 4)
    problem = analytic.problem(ur.losses.L1(), views=VIEWS)
    shares = assign([16] * VIEWS, 3)
    whole = descend(dealt(problem, 3), name)
    for die in (2, 5, 8, 11):
        hosts = Crowded(problem, shares, (die, die + 1, die + 5))
        again = problem.with_parts(executor=DistributedExecutor(problem, shares, hosts))
        assert apart(whole, descend(again, name)) == 0


def test_memories_are_collected_no_more_often_than_their_size_warrants(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = analytic.problem(views=VIEWS)
    step = sum(np.asarray(value).nbytes for value in problem.initial().values())
    monkeypatch.setattr("unrender.app.distributed.worker_state._MOST_BYTES", 3 * step)
    together, collected = dealt(problem, 2), list[int]()
    hosts: Any = together.executor._hosts  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    fetch = hosts.fetch
    monkeypatch.setattr(hosts, "fetch", lambda number: collected.append(number) or fetch(number))
    descend(together, "rcv", steps=30)
    size = 11 * 8 * 16 * 3 * VIEWS  # eleven images of a view
    assert len(collected) == 1  # after three steps; the next one would be after as many steps as the images have bytes
    assert 2 * 30 * step < size
    assert hosts.calls > 30


def test_exposures_of_all_views_are_sent_to_each_share() -> None:
    given = analytic.problem(views=3)
    bright = [
        ur.View(np.asarray(view.reference) * 2.0**stop, view.sensor)
        for stop, view in zip((-1, 0, 1), given.views, strict=True)
    ]
    unknown = [ur.Parameter("colour", initial=0.5, bounds=(0, 1)), ur.Parameter("exposure")]
    problem = ur.Problem(given.renderer, unknown, bright)
    shares = assign([16] * 3, 2)
    held = [ViewShare(unpacked(packed(problem, views, WITHOUT_RAY), WITHOUT_RAY), views) for views in shares]
    together = problem.with_parts(executor=DistributedExecutor(problem, shares, LocalHosts(tuple(held))))
    alone = descend(problem, "plain")
    assert np.ptp(alone.parameters["exposure"], axis=0).min() > 0.05
    assert apart(alone, descend(together, "plain")) < 1e-12


def test_files_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = analytic.problem()
    np.save(tmp_path / "view.npy", np.asarray(given.views[0].reference))
    np.save(tmp_path / "mask.npy", np.ones(analytic.SHAPE))
    np.save(tmp_path / "map.npy", np.full((2, 2, 1), 0.25))
    monkeypatch.chdir(tmp_path)
    problem = ur.Problem(
        given.renderer, [ur.Parameter("map", initial=Path("map.npy"))], [ur.View("view.npy", mask="mask.npy")]
    )
    blob = packed(problem, (0,), WITHOUT_RAY)
    monkeypatch.chdir("/")
    found = unpacked(blob, WITHOUT_RAY)
    assert np.array_equal(np.asarray(found.views[0].reference), np.asarray(problem.views[0].reference))
    assert found.initial_values()["map"].max() == 0.25


def test_the_workers_of_a_resumed_run_have_the_variant_that_they_had(tmp_path: Path) -> None:
    problem = analytic.problem(views=2)
    shares = assign([16] * 2, 2)
    executor = DistributedExecutor(problem, shares, LocalHosts(shares_of(problem, shares)), variant="cuda_ad_rgb")
    descend(problem.with_parts(executor=executor), "plain", steps=1, run_directory=tmp_path / "dealt")
    descend(problem, "plain", steps=1, run_directory=tmp_path / "alone")
    before, never = (load_run(tmp_path / name, steps=2).record for name in ("dealt", "alone"))
    assert before.variant != "cuda_ad_rgb"  # the driver's
    assert variant_again(None, before) == "cuda_ad_rgb"
    assert variant_again("llvm_ad_rgb", before) == "llvm_ad_rgb"
    assert variant_again(None, never) == "auto"


def test_a_share_that_is_lost_again_and_again_ends_the_run_with_one_line() -> None:
    problem = dealt(analytic.problem(views=VIEWS), 2, lose=range(1, 1000))
    with pytest.raises(ur.InputError, match=r"views 1, 3 were lost 5 times in one step"):
        descend(problem, "rcv")


def test_only_what_changed_is_sent() -> None:
    given = analytic.problem(views=2)
    rates = [ur.Parameter("colour", learning_rate=0.02), ur.Parameter("map", learning_rate=1e-30)]
    problem = dealt(ur.Problem(given.renderer, rates, given.original_views), 1)
    executor = problem.executor
    assert isinstance(executor, DistributedExecutor)
    ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(learning_rate=1.0), steps=3, progress=False)
    assert executor.traffic.sent == 3 * 8  # the colour alone
    assert executor.traffic.received == 7 * 8


def test_what_cannot_be_dealt_is_refused_in_one_line() -> None:
    smoothed, adam = ur.SmoothedDerivatives(sigma=0.1, samples=4), ur.optimizers.Adam(learning_rate=0.1)
    with pytest.raises(ur.InputError, match="SmoothedDerivatives renders all views"):
        ur.optimize(dealt(analytic.problem(views=2), 2), smoothed, adam, steps=1)
    with pytest.raises(ur.InputError, match="HybridGradient renders all views"):
        ur.optimize(dealt(analytic.problem(views=2), 2), ur.estimators.HybridGradient(keys=("colour",)), adam, steps=1)
    for refused, words in (
        (ur.PathGradient(differential_bsdf=True), "differential_bsdf is not supported by workers"),
        (ur.PathGradient(emitters="adaptive"), 'emitters="adaptive" is not supported by workers'),
        (
            ur.PathGradient(spp=4, pixels=ur.pixels.AdaptiveCounts()),
            r"pixels=AdaptiveCounts\(...\) is not supported by workers",
        ),
    ):
        with pytest.raises(ur.InputError, match=words):
            ur.optimize(dealt(analytic.problem(views=2), 2), refused, adam, steps=1)
        with pytest.raises(ur.InputError, match=words):
            ur.estimate(dealt(analytic.problem(views=2), 2), refused)
    memory, drawn = ur.images.RecursiveControlVariate(), ur.pixels.Uniform(8)
    remembering = ur.MetaEstimator(coupled=True, image=memory, pixels=drawn)
    with pytest.raises(ur.InputError, match="a control variate of images and mini-batches of pixels at once"):
        ur.optimize(dealt(analytic.problem(views=2), 2), remembering, adam, steps=1)
    with (
        pytest.raises(ur.InputError, match="one view, which cannot be distributed to 2"),
        ur.app.distribute(analytic.problem(), 2),
    ):
        pass


@pytest.mark.parametrize("own", ["llvm_ad_rgb", "llvm_ad_spectral", None])
@pytest.mark.parametrize("name", ["scalar_spectral", "scalar_rgb", "llvm_spectral", "llvm", "", "cuda_ad_mono", None])
def test_workers_have_a_supported_variant(name: Any, own: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unrender.app.distributed.distribute.current", lambda: own)
    with (
        pytest.raises(ur.InputError, match=r"^workers: .*expected 'auto', 'cuda_ad_rgb'.*'llvm_ad_spectral'$"),
        ur.app.distribute(analytic.problem(views=2), 2, variant=name),
    ):
        pass


def test_cores_are_shared_by_as_many_workers_as_there_are_views(monkeypatch: pytest.MonkeyPatch) -> None:
    def connect(workers: Workers, name: str, store_bytes: int, most: int) -> Any:
        assert store_bytes == 256 << 20
        raise ur.InputError(str(share([(16, 0)], workers.count, gpu=False, most=most)))

    monkeypatch.setattr("unrender.app.distributed.distribute.connect", connect)
    with (
        pytest.raises(ur.InputError, match=r"count=4, cpus=4\.0"),
        ur.app.distribute(analytic.problem(views=4), "auto"),
    ):
        pass


def test_what_does_not_fit_a_worker_is_refused_with_what_would() -> None:
    problem = analytic.problem(views=4)
    shares = ((0, 1), (2, 3))
    parameters, images = assignment.needed(problem, (0, 1), has_memory=True)
    room = sum(parameters.values()) + images
    assignment.check(problem, shares, [("a", room), ("b", 0)], has_memory=True)
    with pytest.raises(ur.InputError, match=r"but b has .* 1 would fit: use at least 4 workers"):
        assignment.check(problem, shares, [("a", room), ("b", room - 1)], has_memory=True)
    with pytest.raises(ur.InputError, match=r"parameter map \(2 × 2 × 1\) is .*, but a has .*would fit"):
        assignment.check(problem, shares, [("a", 100), ("b", 100)], has_memory=False)


def test_a_grid_that_fits_no_worker_is_refused_with_the_grid_that_would() -> None:
    def problem(*shape: int) -> Any:
        return SimpleNamespace(
            shapes=lambda: {"smoke.sigma_t.data": shape, "smoke.albedo.data": (2, 2, 2, 3)},
            renderer=SimpleNamespace(resolutions=lambda: [(64, 64)]),
            views=[ur.View(np.zeros((64, 64, 3)))] * 2,
        )

    room = [("a", 10**9), ("b", 10**9)]
    with pytest.raises(ur.InputError) as refused:
        assignment.check(problem(512, 512, 512, 1), ((0,), (1,)), room, has_memory=False)
    assert "parameter smoke.sigma_t.data (512 × 512 × 512 × 1) is 4.29 GB in each worker" in str(refused.value)
    told = re.search(r"but a has 1 GB for it: \((\d+) × (\d+) × (\d+) × 1\) would fit$", str(refused.value))
    assert told is not None
    largest = [int(n) for n in told.groups()]
    assignment.check(problem(*largest, 1), ((0,), (1,)), room, has_memory=False)
    with pytest.raises(ur.InputError, match="would fit"):
        assignment.check(problem(*(n + 1 for n in largest), 1), ((0,), (1,)), room, has_memory=False)
