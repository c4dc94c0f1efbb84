# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Majorant supergrids bias nothing: images against `volpath`, pairs against separate renders, gradients against one majorant."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fog import DEPTH, SIZE, fog, media_keys, scene, voxels
from test_volume_gradients import limit, own, scores
from test_volume_pair import changed, runs, volpath
from zscores import agree, check_pair

from unrender.rendering.mitsuba.integrators import majorant_supergrid
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

RUNS, SPP = 24, 64
VOXELS = 20


def sparse() -> dict[str, Any]:
    """A grid of much empty space and few dense voxels, turned, of three channels, that repeats beyond its borders."""
    rng = np.random.default_rng(4)
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, VOXELS)] * 3, indexing="ij")
    density = (20 * np.clip(0.4 - np.sqrt((x - 0.2) ** 2 + y**2 + z**2), 0, 1) + (np.abs(z + 0.8) < 0.06))[..., None]
    to = mi.ScalarTransform4f
    place = to().rotate([0, 0, 1], 25).translate([-1, -1, -1]).scale(2)
    grid = {"type": "gridvolume", "raw": True, "to_world": place, "wrap_mode": "repeat"}
    extinction = mi.VolumeGrid((density * [0.5, 0.75, 1.0]).astype(np.float32))
    albedo = mi.VolumeGrid(rng.uniform(0.3, 0.9, (8, 8, 8, 3)).astype(np.float32))
    return {
        "type": "heterogeneous",
        "scale": 2.0,
        "sigma_t": {**grid, "grid": extinction},
        "albedo": {**grid, "grid": albedo},
    }


def several() -> dict[str, Any]:
    """A medium with a majorant supergrid, and before it a ball of one without."""
    ball = {"type": "sphere", "center": [0, -2.1, 0.9], "radius": 0.5, "bsdf": {"type": "null"}, "interior": fog()}
    return {**scene(sparse(), lights="lamp sky point"), "ball": ball}


@pytest.mark.slow
def test_images_agree_with_volpath_and_majorants_that_are_too_low_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = MitsubaRenderer(several(), DEPTH)
    assert renderer.pair.majorants(previous=False, both=False)
    expected = volpath(renderer)
    assert agree(runs(renderer.prepare([], None).image({}, SampleRequest(0, RUNS * SPP, 1, RUNS)).images), expected)
    monkeypatch.setattr(majorant_supergrid, "_MARGIN", 0.5)
    wrong = MitsubaRenderer(several(), DEPTH)
    assert not agree(runs(wrong.prepare([], None).image({}, SampleRequest(0, RUNS * SPP, 1, RUNS)).images), expected), (
        "majorants of half the extinction went unseen"
    )


@pytest.mark.slow
def test_both_images_of_a_pair_agree_with_separate_renders() -> None:
    renderer = MitsubaRenderer(several(), DEPTH)
    keys = media_keys(renderer)
    session = renderer.prepare(keys, "path")
    current, previous = changed(renderer, keys)
    check_pair(session, current, previous, RUNS, SPP, fault=1.03)


@pytest.mark.slow
def test_a_cell_that_is_empty_in_one_state_only_is_lost_in_neither() -> None:
    renderer = MitsubaRenderer(scene(sparse()), DEPTH)
    key = next(key for key in renderer.parameters() if key.endswith("sigma_t.data"))
    session = renderer.prepare([key], "path")
    full = np.array(renderer.values([key])[key])
    half = np.arange(VOXELS) < VOXELS // 2
    states = [{key: renderer.array(full * half[:, None, None, None])}, {key: renderer.array(full)}]
    for current, previous in (states, states[::-1]):
        check_pair(session, current, previous, RUNS, SPP)


@pytest.mark.slow
def test_gradients_of_voxels_agree_with_finite_differences_cell_by_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty, thin, dense ones, and those at the majorant of their cell."""
    monkeypatch.setattr(majorant_supergrid, "_FINE", 2)
    renderer = MitsubaRenderer(scene(voxels(), lights="sky"), 2)
    found = scores(renderer, own(renderer), 32)
    assert renderer.pair.majorants(previous=False, both=True)
    assert max(map(abs, found.values())) < limit(len(found)), found


@pytest.mark.slow
def test_gradients_are_those_of_one_majorant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a sparse grid, summed over empty cells, borders of density, and the core; both states of a pair."""
    weight = np.random.default_rng(2).uniform(0.2, 1.8, (1, SIZE, SIZE, 3))

    def sums(fine: int) -> np.ndarray:
        monkeypatch.setattr(majorant_supergrid, "_FINE", fine)
        renderer = MitsubaRenderer(scene(sparse(), lights="sky"), 3)
        assert bool(renderer.pair.majorants(previous=False, both=False)) == (fine < VOXELS)
        keys = [key for key in media_keys(renderer) if key.endswith("sigma_t.data")]
        session = renderer.prepare(keys, "path")
        current = renderer.values(keys)
        previous = {keys[0]: current[keys[0]] * 0.9}
        values = np.array(current[keys[0]]).sum(axis=-1)
        parts = [values == 0, (values > 0) & (values < 3), values >= 3]
        rows = []
        for seed in range(24):
            paths = session.image_pair(current, previous, SampleRequest(0, 32, seed + fine), "path").paths
            both = session.adjoint_pair(current, previous, paths, renderer.array(weight), renderer.array(weight))
            gradients = [np.array(gradient[keys[0]]).astype(np.float64).sum(axis=-1) for gradient in both]
            rows.append([float(gradient[part].sum()) for gradient in gradients for part in parts])
        return np.array(rows)

    ours, one = sums(16), sums(1000)
    error = np.sqrt((ours.var(0, ddof=1) + one.var(0, ddof=1)) / 24)
    score = np.abs(ours.mean(0) - one.mean(0)) / error
    assert (score < 4).all(), score
    assert (np.abs(1.6 * ours.mean(0) - one.mean(0)) > 4 * error).all(), "too noisy to see six tenths"
