"""Views dealt to workers of Ray, and dealt runs resumed."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.campaigns.stand_in import stand_ins
from tests.contract import analytic
from tests.unit.test_dealing import ESTIMATORS, VIEWS, apart, dealt, descend
from unrender.app.distributed.cluster import Workers, connect
from unrender.app.distributed.executor import DistributedExecutor
from unrender.app.distributed.messages import Call
from unrender.app.distributed.ray_hosts import RayHosts
from unrender.backend import variant


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "rcv", "coupled"])
def test_a_dealt_run_is_resumed_to_the_same_bits(name: str, tmp_path: Path) -> None:
    problem = analytic.problem(ur.losses.L1(), views=VIEWS)
    whole = descend(dealt(problem, 2), name, run_directory=tmp_path / "whole", checkpoint_every=4)
    descend(dealt(problem, 2), name, steps=8, run_directory=tmp_path / "half", checkpoint_every=4)
    again: dict[str, Any] = {"estimator": ESTIMATORS[name](), "optimizer": ur.optimizers.Adam(learning_rate=0.02)}
    resumed = ur.resume(tmp_path / "half", dealt(problem, 2), steps=12, **again)
    assert apart(whole, resumed) == 0
    assert apart(whole, ur.resume(tmp_path / "half", dealt(problem, 3), steps=13, **again)) > 0
    descend(dealt(problem, 4), name, steps=8, run_directory=tmp_path / "alone")
    assert apart(whole, ur.resume(tmp_path / "alone", problem, steps=12, **again)) < 1e-12


class Kill(ur.protocols.Callback):
    """Ends the process of the last share, as the system does where memory is short."""

    def on_step(self, run: Any, record: Any) -> None:
        if run.step == 6:
            hosts = run.problem.executor._hosts
            assert isinstance(hosts, RayHosts)
            os.kill(hosts._of[-1].place.process, signal.SIGKILL)  # pyright: ignore[reportOptionalMemberAccess]


@pytest.mark.slow
def test_two_workers_descend_as_one_process_and_a_kill_changes_nothing() -> None:
    pytest.importorskip("ray")
    variant.use_threads(1)
    room = ur.gallery.problem("indirect-room", resolution=16, texture_resolution=8, reference_spp=16)
    image = np.asarray(room.views[0].reference)
    views = [ur.View(image * (1 + 0.1 * index)) for index in range(4)]
    problem = ur.Problem(room.renderer, room.parameters, views, room.loss, room.max_depth)

    def run(problem: ur.Problem, *callbacks: ur.protocols.Callback) -> dict[str, np.ndarray]:
        estimator = ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2)
        adam = ur.optimizers.Adam(learning_rate=0.02)
        return ur.optimize(problem, estimator, adam, steps=12, progress=False, callbacks=callbacks).parameters

    alone = run(problem)
    lines: list[str] = []
    with ur.app.distribute(problem, workers=2, threads=1, tell=lines.append) as together:
        whole = run(together)
        broken = run(together, Kill())
        executor = together.executor
        assert isinstance(executor, DistributedExecutor)
        assert executor.traffic.lost == 1
    assert len(lines) == 1
    assert "of views 1, 3: lost; others take over" in lines[0]
    for key, value in alone.items():
        assert np.array_equal(whole[key], broken[key])
        assert np.abs(whole[key] - value).max() < 1e-5 * np.abs(value).max()


@pytest.mark.slow
@pytest.mark.parametrize("disk", [True, False])
def test_a_full_object_store_costs_time_and_a_full_disk_is_one_line(
    disk: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    if not disk:
        monkeypatch.setenv("RAY_local_fs_capacity_threshold", "0.0")  # Ray's: as if nothing were left of it
    values = np.ones(6_000_000, np.float32)
    with connect(Workers(2), variant.LLVM, store_bytes=80 << 20) as cluster, stand_ins(0.0):
        hosts = RayHosts(cluster, ((0,), (1,)), (b"", b""), 1)
        call = Call({"x": 0}, ur.images.Plain(), None, 1, ur.Key(0), arrays={0: values})  # two replies of 48 MB
        if not disk:
            with pytest.raises(ur.InputError, match=r"worker of views \d on .*: OutOfDiskError: Local disk is full$"):
                hosts.run({0: call, 1: call})
            return
        replies = hosts.run({0: call, 1: call})
        assert [float(replies[share].gradient["x"].sum()) for share in range(2)] == [6e6, 12e6]
