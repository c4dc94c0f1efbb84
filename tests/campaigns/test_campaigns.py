"""Long campaigns of power cuts, kills and signals. `UNRENDER_CAMPAIGN=N` sets the number of faults of each kind; else
they are skipped. `UNRENDER_CAMPAIGN_SEED` chooses other moments.

    UNRENDER_CAMPAIGN=50 python -m pytest -o faulthandler_timeout=0 tests/campaigns -s

Power cuts and killed nodes need root: for an ext4 file system on a loop device, and for network namespaces.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.campaigns import cuts, kills, signal_moments, sweep_kills, worker_kills
from tests.campaigns.cluster_machines import Link, Machines
from tests.campaigns.machine import Victims

COUNT = int(os.environ.get("UNRENDER_CAMPAIGN", "0"))
STEPS = 60
SEED = int(os.environ.get("UNRENDER_CAMPAIGN_SEED", "0"))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not COUNT, reason="set UNRENDER_CAMPAIGN to the number of faults"),
]
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root")


@pytest.fixture(scope="module")
def victims() -> Iterator[Victims]:
    with Victims() as process:
        yield process


@needs_root
@pytest.mark.parametrize("method", cuts.METHODS)
def test_a_power_cut_loses_nothing_after_the_last_checkpoint(method: str, victims: Victims, tmp_path: Path) -> None:
    summary = cuts.campaign(victims, tmp_path, method, COUNT, random.Random(SEED))
    print(method, summary)
    for outcome in ("resumed", "same_bits", "from_the_last_checkpoint", "nothing_left_over"):
        assert summary[outcome] == summary["cuts"], summary["rows"]


@pytest.mark.parametrize(
    ("command", "method"),
    [*((command, "plain") for command in kills.COMMANDS), *itertools.product(("run", "resume"), ("rcv", "coupled"))],
)
def test_a_killed_command_leaves_a_folder_that_goes_on(
    command: str, method: str, victims: Victims, tmp_path: Path
) -> None:
    summary = kills.campaign(victims, tmp_path, command, COUNT, method)
    print(command, method, summary)
    assert summary["killed"] > 0
    assert summary["wrong"] == []


@needs_root
@pytest.mark.parametrize("method", worker_kills.METHODS)
def test_a_distributed_run_survives_kills_and_a_slow_worker(method: str, tmp_path: Path) -> None:
    dice = random.Random(SEED)
    with Link() as link, Machines(link) as machines:
        summary = list(worker_kills.campaign(machines, tmp_path / method, method, COUNT, STEPS, dice))[-1]
        slow = worker_kills.straggler(machines, tmp_path / method, method, STEPS, dice)
    print(method, summary, slow)
    assert summary["right"] == summary["kills"] > 0, summary
    assert slow["right"], slow


def test_a_sweep_on_workers_survives_kills(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    rows = sweep_kills.campaign(tmp_path, COUNT, random.Random(SEED))
    assert [row for row in rows if row["wrong"]] == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("command", signal_moments.COMMANDS)
def test_a_signal_at_any_moment_ends_a_command_in_one_line(
    command: str, number: signal.Signals, tmp_path: Path
) -> None:
    if command == "distributed":
        pytest.importorskip("ray")
    rows = signal_moments.campaign(tmp_path / command, command, number, COUNT, random.Random(SEED))
    assert len(rows) == COUNT
    assert [row for row in rows if row["wrong"]] == []
