"""The benchmark of other pipelines, without them: what it says when none is given, and the clock that hangs on their loops."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.peers import run as peers
from benchmarks.peers.drivers.recorder import BudgetSpentError, Recorder, difference


def test_without_a_checkout_one_line_says_what_to_do() -> None:
    with pytest.raises(SystemExit, match=r"clone github\.com/.*--weier FOLDER --weier-python") as left:
        next(peers.run(svbrdf=Path("somewhere")))
    assert "\n" not in str(left.value)


def test_the_recorder_counts_processor_time_without_the_first_step_and_without_keeping(tmp_path: Path) -> None:
    def busy(seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    def texture() -> dict[str, np.ndarray]:
        busy(0.02)
        return {"a": np.full((1, 2, 3), recorder.steps)}

    recorder = Recorder(seconds=0.06, points=2)
    busy(0.05)  # of the first step

    def descent() -> None:
        for _ in range(100):
            recorder.step(texture)
            busy(0.01)

    with pytest.raises(BudgetSpentError):
        descent()
    assert 0.06 <= recorder.clock < 0.09
    assert recorder.steps == 7
    recorder.write(tmp_path / "found.npz", check=0.5)
    with np.load(tmp_path / "found.npz") as found:
        assert found["steps"].tolist() == [1, 4, 7]
        assert found["texture/a"].shape == (3, 1, 2, 3)
        assert float(found["texture/a"][-1, 0, 0, 0]) == 7


def test_the_recorder_ends_after_so_many_steps() -> None:
    recorder = Recorder(seconds=1e9, points=1, steps=2)
    recorder.step(dict)
    with pytest.raises(BudgetSpentError):
        recorder.step(dict)


def test_noise_is_no_part_of_the_difference_of_pictures() -> None:
    noise = {seed: np.random.default_rng(seed).normal(0, 1, (64, 64, 3)) for seed in (1, 2)}
    picture = np.full((64, 64, 3), 2.0)
    found = difference(lambda _, seed: picture * 1.1 + noise[seed], [picture])
    # (1.1 - 1)², and the mean of a product of two noises over 12288 numbers, of standard error 1 / 111, over 4
    assert found**2 == pytest.approx(0.1**2, abs=4 * (1 / 111 + 2 * 0.2 / 111) / 4)
