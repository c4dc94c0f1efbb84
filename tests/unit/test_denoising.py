"""Denoisers: less noise, the same light, any size, and one line for what cannot be."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.backend import variant
from unrender.images import denoising
from unrender.images.denoising import denoise

OIDN = pytest.param(
    "oidn", marks=pytest.mark.skipif(importlib.util.find_spec("pyoidn") is None, reason="pyoidn is not installed")
)
OPTIX = pytest.param(
    "optix",
    marks=pytest.mark.skipif(
        variant.gpu_problem() is not None or denoising._failure_of_optix() is not None, reason="no GPU with weights"
    ),
)
KINDS = [OIDN, OPTIX, "variation"]


@pytest.fixture(autouse=True)
def _gpu(request: pytest.FixtureRequest) -> None:
    if "by" in request.fixturenames and request.getfixturevalue("by") == "optix":
        ur.use(variant.CUDA)


def noisy(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).gamma(4.0, 0.25, shape).astype(np.float32)


@pytest.mark.parametrize("by", KINDS)
@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("fast", [False, True])
def test_noise_goes_and_the_light_stays(by: Any, channels: tuple[int, ...], fast: bool) -> None:
    """A step from 1 to 3 under noise: nearer the truth than the noise left it, on both sides of the edge."""
    truth = np.where(np.arange(64) < 32, 1.0, 3.0)[None, :].repeat(64, axis=0)
    truth = np.broadcast_to(truth.reshape(64, 64, *[1] * len(channels)), (64, 64, *channels))
    image = truth * noisy(truth.shape)
    found = denoise(image, by=by, fast=fast)
    assert found.shape == image.shape
    assert found.dtype == np.float32
    assert np.mean((found - truth) ** 2) < 0.3 * np.mean((image - truth) ** 2)
    assert found[:, :32].mean() == pytest.approx(image[:, :32].mean(), rel=0.1)
    assert found[:, 32:].mean() == pytest.approx(image[:, 32:].mean(), rel=0.1)


@pytest.mark.parametrize("by", KINDS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (4, 4, 3), (5, 3, 3), (31, 33), (40, 8, 3)])
def test_any_size_keeps_its_light(by: Any, shape: tuple[int, ...]) -> None:
    flat = np.full(shape, 0.7, np.float32)
    np.testing.assert_allclose(denoise(flat, by=by), flat, rtol=0.05)
    image = noisy(shape)
    assert denoise(image, by=by).mean() == pytest.approx(image.mean(), rel=0.15)


@pytest.mark.parametrize("by", KINDS)
def test_scale_does_not_matter_and_calls_repeat(by: Any) -> None:
    image = noisy((33, 20, 3))
    found = denoise(image, by=by)
    assert np.array_equal(found, denoise(image, by=by))
    for scale in (1e-12, 1e6):
        np.testing.assert_allclose(denoise(image * scale, by=by) / scale, found, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("by", KINDS)
def test_black_stays_black_and_below_0_counts_as_0(by: Any) -> None:
    assert not denoise(np.zeros((4, 4, 3)), by=by).any()
    assert not denoise(np.full((4, 4), -1.0), by=by).any()
    image = noisy((16, 16)) - 0.5
    assert (denoise(image, by=by) >= 0).all()
    assert np.array_equal(denoise(image, by=by), denoise(np.maximum(image, 0), by=by))


def test_what_makes_no_sense_is_refused() -> None:
    good = np.ones((4, 4, 3))
    for bad, what in (
        (np.ones(4), "shape"),
        (np.ones((4, 4, 2)), "shape"),
        (np.ones((0, 4)), "shape"),
        (np.full((4, 4), np.nan), "finite"),
        (np.full((4, 4), 1e39), "finite"),
        (np.array([["a"]]), "numbers"),
        (np.ones((2, 2), complex), "numbers"),
        ([[1.0], []], "rows of different lengths"),
    ):
        with pytest.raises(ur.InputError, match=what):
            denoise(bad, by="variation")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ur.InputError, match="did you mean oidn"):
        denoise(good, by="oid")  # pyright: ignore[reportArgumentType]


def test_without_a_denoiser_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant, "current", lambda: variant.LLVM)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ur.InputError, match=r"pip install 'unrender\[denoise\]'$"):
        denoise(np.ones((4, 4)))
    with pytest.raises(ur.InputError, match="cuda_ad_rgb"):
        denoise(np.ones((4, 4)), by="optix")
    monkeypatch.setattr(variant, "current", lambda: variant.CUDA)
    monkeypatch.setattr(denoising, "_failure_of_optix", lambda: None)
    assert denoising.choose() == "optix"
    monkeypatch.setattr(denoising, "_failure_of_optix", lambda: "no weights")
    with pytest.raises(ur.InputError, match="denoiser optix: no weights; oidn runs on the CPU"):
        denoising.choose("optix")
    with pytest.raises(ur.InputError, match="needs pyoidn"):
        denoising.choose()
    assert denoise(np.ones((4, 4)), by="variation").shape == (4, 4)
