"""Denoised images: what the loss sees, and what it must not know."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.core.random import Key
from unrender.images import denoising
from unrender.images.base import ImageEstimator, PairRequest, needs_full_views
from unrender.scene.batches import FullView

Denoised, Plain, CV = ur.images.Denoised, ur.images.Plain, ur.images.RecursiveControlVariate
OIDN = pytest.param(
    "oidn", marks=pytest.mark.skipif(importlib.util.find_spec("pyoidn") is None, reason="pyoidn is not installed")
)
SIZE = 16


def problem(loss: Any = None, noise: float = 0.8) -> ur.Problem:
    """Four lamps over a wall, each lighting a smooth patch of it in its own colour: pictures that look like pictures."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    patches = [np.exp(-8 * ((x - a) ** 2 + (y - b) ** 2)) for a in (0.25, 0.75) for b in (0.25, 0.75)]
    tints = np.random.default_rng(0).uniform(0.3, 1, (4, 3))
    matrix = np.stack([(p[..., None] * t).reshape(-1) for p, t in zip(patches, tints, strict=True)], axis=1)
    truth = np.array([0.8, 0.3, 0.6, 0.9])
    renderer = AnalyticRenderer({"lamps": truth}, matrix, 0.05, noise, shape=(SIZE, SIZE))
    return ur.Problem(
        renderer,
        [ur.Parameter("lamps", initial=0.5, bounds=(0, 2))],
        [ur.View(renderer.exact({"lamps": truth}))],
        loss or ur.losses.L2(),
        truth={"lamps": truth},
    )


@pytest.mark.parametrize("by", ["variation", OIDN])
def test_the_image_is_nearer_the_truth_and_biased(by: Any) -> None:
    asked = problem()
    exact = asked.renderer.exact(asked.initial())  # pyright: ignore[reportAttributeAccessIssue]

    def images(image: Any) -> np.ndarray:
        state = image.init(asked, asked.initial())
        return np.stack(
            [
                image.estimate(asked, asked.initial(), state, FullView(asked, 0), 2, 2, Key(s))[0].mean()
                for s in range(40)
            ]
        )

    noisy, clean = images(Plain()), images(Denoised(by=by))
    assert np.mean((clean - exact) ** 2) < 0.5 * np.mean((noisy - exact) ** 2)
    z = (clean.mean(0) - exact) / (clean.std(0, ddof=1) / np.sqrt(len(clean)))
    assert np.abs(z).max() > 6, "the docstring says that it is biased"


@pytest.mark.parametrize("inner", [Plain(), CV()], ids=["plain", "control variate"])
@pytest.mark.parametrize("groups", [2, 3])
def test_no_group_is_weighted_by_an_image_that_knows_it(inner: Any, groups: int) -> None:
    """With one group's samples exchanged, the image that weighs its adjoint stays bit for bit, and all the others change."""
    import dataclasses

    asked = problem()
    image = Denoised(inner, by="variation", groups=3)
    state = image.init(asked, asked.initial())
    for step in range(3):
        found, kept = image.estimate(asked, asked.initial(), state, FullView(asked, 0), 6, groups, Key(0, step))
        state = image.advance(asked.initial(), state, (kept,))
    assert found.images.shape[0] == found.paths.groups == groups
    others = found.others()
    assert others.shape == found.images.shape
    for group in range(groups):
        exchanged = found.images.copy()
        exchanged[group] *= np.random.default_rng(1).uniform(0.5, 1.5, exchanged[group].shape)
        after = dataclasses.replace(found, images=exchanged).others()
        for other in range(groups):
            if other == group:
                np.testing.assert_allclose(after[other], others[other], rtol=1e-6)
            else:
                assert not np.allclose(after[other], others[other], rtol=1e-3)


@pytest.mark.parametrize(
    ("most", "asked", "got"),
    [(2, 16, 2), (4, 16, 4), (4, 6, 3), (3, 16, 2), (2, 1, 1), (2, 9, 3), (2, 7, 7), (4, 2, 2)],
)
def test_samples_form_few_groups(most: int, asked: int, got: int) -> None:
    problem_ = problem()
    image = Denoised(by="variation", groups=most)
    state = image.init(problem_, problem_.initial())
    found, _ = image.estimate(problem_, problem_.initial(), state, FullView(problem_, 0), asked, asked, Key(0))
    assert found.images.shape[0] == got


def test_the_previous_state_is_denoised_alike() -> None:
    asked = problem()
    image = Denoised(by="variation")
    pair_request = PairRequest(asked.initial(), "path")
    found, _ = image.estimate(
        asked, asked.initial(), image.init(asked, asked.initial()), FullView(asked, 0), 4, 4, Key(0), pair_request
    )
    np.testing.assert_array_equal(found.previous_others(), found.others())


@pytest.mark.parametrize(
    "estimator",
    [
        lambda by: ur.PathGradient(Denoised(by=by), spp=4),
        slow(lambda by: ur.PathGradient(Denoised(CV(), by=by), spp=2)),
        slow(lambda by: ur.PathGradient(Denoised(CV(), by=by), spp=1)),
        slow(lambda by: ur.MetaEstimator(coupled=True, spp=2, image=Denoised(CV(), by=by))),
    ],
    ids=["plain", "control variate", "own paths", "coupled"],
)
@pytest.mark.parametrize("by", ["variation", OIDN])
def test_a_descent_comes_near_the_truth(estimator: Any, by: Any) -> None:
    found = ur.optimize(problem(), estimator(by), ur.optimizers.Adam(0.03), steps=60)
    errors = [record["parameter_error"]["lamps"] for record in found.history if "parameter_error" in record]
    assert errors[-1] < 0.35 * errors[0]
    assert found.skipped == 0


def test_what_is_not_finite_is_seen() -> None:
    asked = problem()
    image = Denoised(by="variation")
    found, _ = image.estimate(
        asked, asked.initial(), image.init(asked, asked.initial()), FullView(asked, 0), 2, 2, Key(0)
    )
    found.images[0, 3, 3] = np.nan
    assert np.isnan(found.mean()).any()
    assert np.isnan(found.others()[1]).any()


def test_negative_pixels_are_denoised_as_positive_ones_are() -> None:
    """Pictures of normals, and those of films whose filters have negative lobes."""
    asked = problem()
    filtered = Denoised(by="variation")._filter(asked)
    noise = np.random.default_rng(0).normal(0.0, 0.1, (SIZE, SIZE, 3))
    picture = (0.6 + noise).astype(np.float32)
    np.testing.assert_allclose(filtered(-picture), -np.asarray(filtered(picture)), rtol=1e-5)
    assert np.mean(filtered(picture - 0.6)) == pytest.approx(np.mean(picture - 0.6), abs=1e-3)


def test_what_makes_no_sense_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ur.InputError, match="groups"):
        Denoised(groups=1)
    for bad in (Plain, Denoised()):
        with pytest.raises(ur.InputError, match="inner"):
            Denoised(bad)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ur.InputError, match="did you mean"):
        ur.estimate(problem(), ur.PathGradient(Denoised(by="oidm")))  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(denoising.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ur.InputError, match=r"pip install 'unrender\[denoise\]'"):
        ur.estimate(problem(), ur.PathGradient(Denoised(by="oidn")))


@pytest.mark.slow
@pytest.mark.mitsuba
def test_mitsuba_images_too() -> None:
    """On the device: image, adjoint and memory of a path-traced scene."""
    asked = ur.gallery.problem("poster", resolution=16, texture_resolution=4, reference_spp=16)
    estimator = ur.PathGradient(Denoised(CV(), by="variation"), spp=4)
    found = ur.optimize(asked, estimator, ur.optimizers.Adam(0.05), steps=15)
    errors = [record["parameter_error"] for record in found.history if "parameter_error" in record]
    assert max(errors[-1].values()) < 0.7 * max(errors[0].values())


class Wrapper:
    """An image estimator from before `needs_whole_views` became `needs_full_views`."""

    def __init__(self, inner: Any):
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        if name == "needs_full_views":
            raise AttributeError(name)
        return getattr(self.inner, name)


class Heir(ImageEstimator):
    """The same as a subclass of the protocol, whose own `needs_full_views` returns None."""

    def needs_whole_views(self, parameters: Any, state: Any, batches: int) -> bool:
        return batches == 1


def test_the_former_name_of_a_method_warns() -> None:
    words = "needs_whole_views is now needs_full_views"
    with pytest.warns(DeprecationWarning, match=words):
        assert needs_full_views(Heir(), {}, None, 1)  # pyright: ignore[reportAbstractUsage]
    image: Any = Wrapper(CV())
    estimator = ur.PathGradient(image=image, spp=4, pixels=ur.pixels.Uniform(16))
    with pytest.warns(DeprecationWarning, match=words):
        result = ur.optimize(problem(), estimator, ur.optimizers.Adam(0.02), steps=4)
    expected = ur.optimize(problem(), replace(estimator, image=CV()), ur.optimizers.Adam(0.02), steps=4)
    np.testing.assert_array_equal(result.parameters["lamps"], expected.parameters["lamps"])
