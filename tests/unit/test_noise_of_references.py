"""Differences that only the noise of references with few samples per pixel would explain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.estimators.fresh_pictures import Residuals
from unrender.runs import verification

SIDE, SPP = 32, 1024
DEVIATION = 10.0 ** np.random.default_rng(4).uniform(-1, 1, (4, 4)).repeat(8, axis=0).repeat(8, axis=1).reshape(-1, 1)
"""Standard deviation of a sample of each pixel: neighbours mostly have the same one."""


def told(reference_error: np.ndarray, seed: int, short: bool = False) -> verification.Misfit | None:
    noise = np.random.default_rng(seed).standard_t(6, (2, SIDE * SIDE, 3)) * DEVIATION / np.sqrt(1.5 * SPP)
    same = np.full((SIDE * SIDE, 3), 7.0), np.ones(SIDE * SIDE), [(SIDE, SIDE)]
    return verification.as_few_samples(Residuals(noise - reference_error, *same), SPP, short)


@pytest.mark.parametrize("samples", [8, 128, 1024])
def test_noise_of_references_is_told_by_its_number_of_samples(samples: int) -> None:
    counts = []
    for seed in range(10):
        noise = np.random.default_rng(100 + seed).standard_t(6, (SIDE * SIDE, 3)) * DEVIATION
        difference = told(noise / np.sqrt(1.5 * samples), seed)
        assert (difference is not None) is (samples < 16)
        if difference is not None:
            assert difference.causes == (verification.STEPS, verification.NOISE)
            counts.append(float(difference.line.partition("references with ")[2].split()[0]))
    assert not counts or np.mean(counts) == pytest.approx(samples, rel=0.2)


def test_a_wrong_picture_whose_neighbours_differ_is_told() -> None:
    """It is 4 % of the picture, and on average no more than the noise of references with 128 samples, but much more in quiet pixels."""
    wrong = 0.3 * np.random.default_rng(5).choice((-1.0, 1.0), (SIDE * SIDE, 1))
    assert np.mean(np.square(DEVIATION)) / np.mean(np.square(wrong)) > 128
    for seed in range(10):
        assert told(wrong, seed) is not None
        assert told(wrong, seed, short=True) is None


@pytest.mark.parametrize(("turned", "share", "causes"), [(0, 0.9, 1), (1, 0.9, 1), (0, 0.2, 2), (0, 0.0, 2)])
def test_a_pattern_is_not_the_noise_of_references(turned: int, share: float, causes: int) -> None:
    """A refracted checkerboard of 14 % of the picture left a wrong index of refraction its standard error. Some of it beside noise may."""
    y, x = np.indices((SIDE, SIDE)) // 2
    pattern = (np.where((y + x) % 2, -1.0, 1.0) if turned else np.where(x % 2, -1.0, 1.0)).reshape(-1, 1)
    for seed in range(10):
        noise = np.random.default_rng(100 + seed).standard_t(6, (SIDE * SIDE, 3)) / np.sqrt(1.5)
        wrong = np.sqrt(share) * pattern + np.sqrt(1.0 - share) * noise
        difference = told(wrong, seed)
        assert difference is not None
        assert len(difference.causes) == causes
        assert ("pattern" in difference.line) is (causes == 1)


def test_a_run_whose_reference_has_another_pattern_is_told(tmp_path: Path) -> None:
    side, generator = 16, np.random.default_rng(6)
    matrix, truth = generator.random((side * side * 3, 4)), np.full(4, 0.5)
    renderer = AnalyticRenderer({"x": truth}, matrix, noise=0.1, shape=(side, side))
    reference = np.asarray(renderer.exact({"x": truth}))
    pattern = 0.1 * generator.choice((-1.0, 1.0), (side, side, 1))
    unknown = ur.Parameter("x", initial=np.full(4, 0.2), bounds=(0.0, 1.0))
    parts = ur.PathGradient(spp=4), ur.optimizers.Adam(0.02)
    lines = []
    for name, picture in (("right", reference), ("wrong", reference + pattern)):
        problem = ur.Problem(renderer, [unknown], [ur.View(picture.astype(np.float32))])
        result = ur.optimize(problem, *parts, steps=150, run_directory=tmp_path / name)
        assert result.status == "finished"
        lines.append([line for line in result.warnings if verification.DIFFERS in line])
    assert not lines[0]
    assert "as the noise of references with" in "".join(lines[1])
