# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Gradients of media against finite differences, in voxels that are empty, thin, dense, and as dense as the majorant.

The finite differences are of pairs: both sides on one set of paths, so that their noise is small. Each side is unbiased, whatever
its majorant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from fog import DARK, DEPTH, KIND, LEVELS, SIZE, cloud, fog, media_keys, scene, two_media, voxels
from scipy import stats
from zscores import z_scores

from unrender.rendering.mitsuba.integrators import differential_tracking
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

SPP = 64
WEIGHT = np.random.default_rng(2).uniform(0.2, 1.8, (1, SIZE, SIZE, 3))


@dataclass(frozen=True)
class Direction:
    """A derivative to check: of the parameter `key` along `along`, by steps of `step`, to both sides or upwards only."""

    key: str
    name: str
    along: np.ndarray
    step: float
    upwards: bool = False


def directions(key: str, value: np.ndarray) -> list[Direction]:
    """Kinds of voxels each for itself; of colours each channel."""
    found = []
    if key.endswith("sigma_t.data"):
        for number, (name, level) in enumerate(LEVELS.items()):
            step = {"empty": 0.04, "thin": 0.01}.get(name, 0.1)
            found.append(Direction(key, name, (number == KIND) * np.ones_like(value), step, level == 0))
    elif key.endswith(("albedo.data", "emission.data")):
        for number, name in ((1, "thin"), (3, "dense")):
            for dark in (True, False):
                along = (number == KIND) * (dark == DARK) * np.ones_like(value)
                found.append(Direction(key, f"{name}, {'black' if dark else 'grey'}", along, 0.05, dark))
    elif ".emission_" in key:
        found.append(Direction(key, "dense", (KIND == 3) * np.ones_like(value), 0.05))
    else:
        for channel in range(value.size):
            along = np.zeros(value.size)
            along[channel] = 1
            found.append(Direction(key, f"channel {channel}", along.reshape(value.shape), 0.02))
    return found


def derivative(renderer: MitsubaRenderer, session: Any, current: dict[str, Any], way: Direction, seed: int) -> float:
    """One noisy finite difference, without bias to second order in the step."""
    value = np.array(current[way.key]).astype(np.float64)

    def difference(high: float, low: float, seed: int) -> float:
        above, below = ({**current, way.key: renderer.array(value + s * way.step * way.along)} for s in (high, low))
        pair = session.image_pair(above, below, SampleRequest(0, 4 * SPP, seed), "path")
        change = np.array(pair.images).astype(np.float64) - np.array(pair.previous)
        return float((change * WEIGHT).sum()) / (way.step * (high - low))

    if way.upwards:
        return 2 * difference(1, 0, seed) - difference(2, 0, seed + 1)
    return difference(1, -1, seed)


def scores(renderer: MitsubaRenderer, gradients: Callable[[int], dict[str, Any]], runs: int) -> dict[str, float]:
    """z scores of `gradients(seed)`, averaged over seeds, against finite differences."""
    keys = list(renderer.values(media_keys(renderer)))
    current = renderer.values(keys)
    ways = [way for key in keys for way in directions(key, np.array(current[key]))]
    rows = []
    for run in range(runs):
        gradient = gradients(1000 + run)
        rows.append([float((np.array(gradient[way.key]).astype(np.float64) * way.along).sum()) for way in ways])
    found = np.array(rows)
    session, verdicts = renderer.prepare(keys, "path"), {}
    for number, way in enumerate(ways):
        seeds = range(5000, 5000 + 2 * max(8, runs // 4), 2)
        expected = np.array([derivative(renderer, session, current, way, seed) for seed in seeds])
        a = found[:, number]
        variance = expected.var(ddof=1) / len(expected) + a.var(ddof=1) / len(a)
        t = (a.mean() - expected.mean()) / np.sqrt(variance)
        freedom = variance**2 / (
            (expected.var(ddof=1) / len(expected)) ** 2 / (len(expected) - 1)
            + (a.var(ddof=1) / len(a)) ** 2 / (len(a) - 1)
        )
        verdicts[f"{way.key} {way.name}"] = float(np.sign(t) * stats.norm.isf(max(stats.t.sf(abs(t), freedom), 1e-300)))
    return verdicts


def limit(count: int, level: float = 2.7e-3) -> float:
    """The bound on the largest of `count` scores, three standard errors if there were one, after Šidák."""
    return float(stats.norm.isf((1 - (1 - level) ** (1 / count)) / 2))


def own(renderer: MitsubaRenderer) -> Callable[[int], dict[str, Any]]:
    """Gradients by path replay, differential ratio tracking included."""
    keys = media_keys(renderer)
    session = renderer.prepare(keys, "path")
    current = renderer.values(keys)
    weight = renderer.array(WEIGHT)
    return lambda seed: session.adjoint(current, session.image(current, SampleRequest(0, SPP, seed)).paths, weight)


SCENES: dict[str, Callable[[], dict[str, Any]]] = {
    "voxels": lambda: scene(voxels()),
    "coloured fog": lambda: scene(fog(phase={"type": "hg", "g": 0.3})),
    "two media": two_media,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_gradients_of_media_agree_with_finite_differences(name: str) -> None:
    renderer = MitsubaRenderer(SCENES[name](), DEPTH)
    found = scores(renderer, own(renderer), 60)
    assert max(map(abs, found.values())) < limit(len(found)), found


def test_the_gradient_of_black_voxels_is_the_slope_of_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick twin of the tests below. Single scattering is linear in the albedo, so a long step has no bias."""
    renderer, runs = MitsubaRenderer(scene(voxels(), lights="sky"), 2), 6
    (key,) = (key for key in media_keys(renderer) if key.endswith("albedo.data"))
    current = renderer.values([key])
    (way,) = (way for way in directions(key, np.array(current[key])) if way.name == "dense, black")
    raised = {key: renderer.array(np.array(current[key]) + 0.5 * way.along)}
    session, slopes = renderer.prepare([key], "path"), []
    for seed in range(runs):
        pair = session.image_pair(raised, current, SampleRequest(0, 4 * SPP, 5000 + seed), "path")
        change = np.array(pair.images).astype(np.float64) - np.array(pair.previous)
        slopes.append([(change * WEIGHT).sum() / 0.5])

    def score(renderer: MitsubaRenderer) -> float:
        gradients = own(renderer)
        found = [[np.sum(np.array(gradients(seed)[key], np.float64) * way.along)] for seed in range(runs)]
        return abs(float(z_scores(np.array(found), np.array(slopes))[0]))

    assert score(renderer) < limit(1)
    monkeypatch.setattr(differential_tracking, "mis_density", lambda segment, t: segment.near * 0)
    # Collisions alone find no derivative where nothing scatters.
    assert score(MitsubaRenderer(scene(voxels(), lights="sky"), 2)) > limit(1)


@pytest.mark.slow
def test_gradients_of_voxels_agree_with_finite_differences() -> None:
    """Single scattering."""
    renderer = MitsubaRenderer(scene(voxels(), lights="sky"), 2)
    found = scores(renderer, own(renderer), 32)
    assert max(map(abs, found.values())) < limit(len(found)), found


@pytest.mark.slow
def test_without_differential_ratio_tracking_black_and_empty_voxels_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the test above can fail: collisions alone find no derivative where nothing collides or scatters."""
    monkeypatch.setattr(differential_tracking, "mis_density", lambda segment, t: segment.near * 0)
    renderer = MitsubaRenderer(scene(voxels(), lights="sky"), 2)
    found = scores(renderer, own(renderer), 64)
    wrong = {name for name, z in found.items() if abs(z) > limit(len(found))}
    assert any("empty" in name for name in wrong), found
    assert any("dense, black" in name for name in wrong), found
    assert not any("middling" in name for name in wrong), found


@pytest.mark.slow
def test_the_variance_of_a_difference_of_gradients_falls_with_the_square_of_the_step() -> None:
    """Both states share a path, collisions and all, and the point that differential ratio tracking keeps."""
    renderer = MitsubaRenderer(scene(cloud(), lights="sky"), 4)
    keys = media_keys(renderer)[:2]
    session = renderer.prepare(keys, "path")
    current, weight = renderer.values(keys), renderer.array(WEIGHT)
    steps, variances = (0.1, 0.03, 0.01), []
    for step in steps:
        previous = {key: renderer.array(np.array(value) * (1 - step)) for key, value in current.items()}
        rows = []
        for seed in range(16):
            paths = session.image_pair(current, previous, SampleRequest(0, 16, seed), "path").paths
            a, b = session.adjoint_pair(current, previous, paths, weight, weight)
            rows.append(np.concatenate([(np.array(a[key]) - np.array(b[key])).ravel() for key in keys]))
        variances.append(np.var(rows, axis=0, ddof=1).sum())
    assert float(np.polyfit(np.log(steps), np.log(variances), 1)[0]) == pytest.approx(2, abs=0.25)


@pytest.mark.slow
def test_the_previous_state_s_gradient_is_its_own() -> None:
    """In the mean over seeds, against the ordinary adjoint there; a planted tenth is seen."""
    renderer = MitsubaRenderer(scene(cloud(), lights="sky"), 4)
    keys = media_keys(renderer)[:2]
    session = renderer.prepare(keys, "path")
    current, weight = renderer.values(keys), renderer.array(WEIGHT)
    previous = {key: renderer.array(np.array(value) * 0.7) for key, value in current.items()}

    def sums(gradient: dict[str, Any]) -> list[float]:
        return [float(np.array(gradient[key]).astype(np.float64).sum()) for key in keys]

    shared, own = [], []
    for seed in range(32):
        paths = session.image_pair(current, previous, SampleRequest(0, 32, 2 * seed), "path").paths
        shared.append(sums(session.adjoint_pair(current, previous, paths, weight, weight)[1]))
        own.append(
            sums(session.adjoint(previous, session.image(previous, SampleRequest(0, 32, 2 * seed + 1)).paths, weight))
        )
    a, b = np.array(shared), np.array(own)
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 32)
    assert (np.abs(a.mean(0) - b.mean(0)) < 4 * error).all()
    assert (np.abs(1.1 * a.mean(0) - b.mean(0)) > 4 * error).all(), "too noisy to see a tenth"
