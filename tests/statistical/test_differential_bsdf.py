# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Roughness derivatives by antithetic pairs of paths: the same mean as the ordinary adjoint's and as finite differences, less variance."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zoo import DEPTH, SIZE, scene
from zscores import z_scores

import unrender as ur
from tiers import slow
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.methods.base import method
from unrender.rendering.mitsuba.integrators.differential_bsdf import RoughLobe
from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import Renderer, SampleRequest, with_differential_bsdf

RUNS, SPP = 48, 32


def texture(values: Any) -> dict[str, Any]:
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.asarray(values, np.float32)),
        "raw": True,
        "filter_type": "bilinear",
    }


def metal(alpha: Any = 0.1, distribution: str = "ggx") -> dict[str, Any]:
    return {"type": "roughconductor", "alpha": alpha, "distribution": distribution, "eta": 0.2, "k": 3.9}


def key_of(renderer: MitsubaRenderer, role: str = "alpha") -> str:
    return next(key for key in renderer.parameters() if f".{role}." in key and key.endswith((".value", ".data")))


def gradients(
    renderer: Renderer, parameters: dict[str, Any], runs: int = RUNS, seed: int = 0, size: int = SIZE, spp: int = SPP
) -> dict[str, np.ndarray]:
    """(runs, n) of Σ weight · image, by independent samples, for each key."""
    session = renderer.prepare(list(parameters), None)
    weight = renderer.array(np.random.default_rng(1).uniform(0.5, 1.5, (1, size, size, 3)))
    found: dict[str, list[np.ndarray]] = {key: [] for key in parameters}
    for run in range(runs):
        paths = session.image(parameters, SampleRequest(0, spp, Key(seed, run).uint32())).paths
        for key, gradient in session.adjoint(parameters, paths, weight).items():
            found[key].append(np.array(gradient, np.float64).ravel())
    return {key: np.array(rows) for key, rows in found.items()}


def worst(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """The largest |z| of two sets of independent estimates, and its limit after Šidák."""
    z = z_scores(a, b)
    return float(np.abs(z).max()), float(stats.norm.isf((1 - (1 - 1e-3) ** (1 / z.size)) / 2))


def plant_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on the outer part of a pair weighs a tenth too much."""
    weight = RoughLobe.weight

    def wrong(lobe: RoughLobe, wo: Any) -> Any:
        found = weight(lobe, wo)
        return dr.select(found > 0, 1.1 * found, found)

    monkeypatch.setattr(RoughLobe, "weight", wrong)


CASES = [(name, alpha) for name in ("ggx", "beckmann") for alpha in (0.02, 0.1, 0.3)]


@pytest.mark.parametrize("case", [(), *map(slow, CASES)], ids=str)
def test_the_gradient_is_unbiased_and_less_noisy(case: tuple[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """In the quick tier, of fewer bounces and pixels."""
    depth, runs, size, spp = (DEPTH, RUNS, SIZE, SPP) if case else (2, 16, 12, 64)
    distribution, alpha = case or CASES[1]
    description = scene(metal(alpha, distribution))
    description["sensor"]["film"] |= {"width": size, "height": size}
    renderer = MitsubaRenderer(description, depth)
    values = renderer.values([key_of(renderer)])
    (ordinary,), (ours,) = (
        list(gradients(of, values, runs, seed, size, spp).values())
        for seed, of in enumerate((renderer, with_differential_bsdf(renderer)))
    )
    z, limit = worst(ordinary, ours)
    assert z < limit
    assert np.var(ours) < 0.5 * np.var(ordinary)

    plant_a_fault(monkeypatch)
    renderer = MitsubaRenderer(description, depth)
    (wrong,) = gradients(with_differential_bsdf(renderer), values, runs, 2, size, spp).values()
    assert worst(ours, wrong)[0] > limit


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.3])
def test_it_is_the_finite_difference_of_images(alpha: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of images from equal random numbers, which differ little: central differences over α ± 5 %."""
    renderer = MitsubaRenderer(scene(metal(alpha)), DEPTH)
    key, step = key_of(renderer), 0.05 * alpha
    session = renderer.prepare([key], None, derivatives=False)
    weight = np.random.default_rng(1).uniform(0.5, 1.5, (SIZE, SIZE, 3))
    differences = []
    for run in range(64):
        states = {key: np.array([alpha + step, alpha - step])}
        images = np.array(session.image_batch(states, SampleRequest(0, 64, Key(7, run).uint32())), np.float64)
        differences.append([((images[0] - images[1]) * weight).sum() / (2 * step)])
    (ours,) = gradients(with_differential_bsdf(renderer), renderer.values([key]), 64).values()
    z, limit = worst(np.array(differences), ours)
    assert z < limit

    plant_a_fault(monkeypatch)
    renderer = MitsubaRenderer(scene(metal(alpha)), DEPTH)
    (wrong,) = gradients(with_differential_bsdf(renderer), renderer.values([key]), 64).values()
    assert worst(np.array(differences), wrong)[0] > limit


@pytest.mark.slow
@pytest.mark.parametrize("sides", ["one", "two"])
def test_textures_and_other_parameters_keep_their_gradients(sides: str) -> None:
    """Each texel of a map of roughness, a reflectance and a floor's colour beside it, seen from both sides where there are two."""
    values = np.random.default_rng(4).uniform(0.05, 0.3, (2, 2, 1))
    material: dict[str, Any] = {**metal(texture(values)), "specular_reflectance": texture(np.full((1, 1, 3), 0.8))}
    if sides == "two":
        material = {"type": "twosided", "one": material}
    description = scene(material)
    if sides == "two":  # an open bowl's inside, seen through its missing half: normals turned inward
        description["ball"] |= {"flip_normals": True}
    renderer = MitsubaRenderer(description, DEPTH)
    keys = [key_of(renderer), key_of(renderer, "specular_reflectance"), "floor.bsdf.reflectance.data"]
    start = renderer.values(keys)
    ordinary, ours = (
        gradients(of, start, seed=seed) for seed, of in enumerate((renderer, with_differential_bsdf(renderer)))
    )
    for key in keys:
        z, limit = worst(ordinary[key], ours[key])
        assert np.abs(ordinary[key].mean(axis=0)).max() > 0
        assert z < limit, key
    (mean_ordinary, mean_ours) = (of[keys[0]].var(axis=0).sum() for of in (ordinary, ours))
    assert mean_ours < 0.7 * mean_ordinary


@pytest.mark.slow
def test_two_vertices_of_one_path_and_a_mirror_before_them() -> None:
    """A rough ball beside a rough floor, seen in a mirror too: the first vertex has the pair, later ones the ordinary derivative."""
    description = scene(metal(0.15))
    description["floor"]["bsdf"] = metal(0.2, "beckmann")
    description["mirror"] = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at([-1.6, 0.6, 1.2], [0, 0, 0.6], [0, 0, 1])
        @ mi.ScalarTransform4f().scale(1.2),
        "bsdf": {"type": "conductor"},
    }
    renderer = MitsubaRenderer(description, DEPTH)
    start = renderer.values([key for key in renderer.parameters() if key.endswith("alpha.value")])
    assert len(start) == 2
    ordinary, ours = (
        gradients(of, start, seed=seed) for seed, of in enumerate((renderer, with_differential_bsdf(renderer)))
    )
    for key in start:
        z, limit = worst(ordinary[key], ours[key])
        assert z < limit, key
        assert np.var(ours[key]) < 0.7 * np.var(ordinary[key])


def test_the_tangent_moment_is_the_squared_product_of_the_paths_own_gradient() -> None:
    size = 6
    description = scene(metal(0.2))
    description["sensor"]["film"] |= {"width": size, "height": size}
    renderer = with_differential_bsdf(MitsubaRenderer(description, DEPTH))
    values = renderer.values([key_of(renderer)])  # pyright: ignore[reportArgumentType]
    session = renderer.prepare(list(values), None)
    paths = session.image(values, SampleRequest(0, 1, 7)).paths
    found = np.array(session.tangent_moment(values, paths, values))
    expected = np.zeros_like(found)
    for place in np.ndindex(found.shape):
        weights = np.zeros((1, *found.shape))
        weights[0][place] = 1.0
        gradient = session.adjoint(values, paths, renderer.array(weights))
        expected[place] = sum(np.sum(np.array(gradient[key]) * np.array(x)) for key, x in values.items()) ** 2
    assert (expected > 0).sum() > 10
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5 * expected.max())


def problem(material: dict[str, Any] | None = None, key: str = "", **scenery: Any) -> ur.Problem:
    description = scene(metal(0.1) if material is None else material) | scenery
    renderer = MitsubaRenderer(description, DEPTH)
    return ur.Problem(
        description,
        [ur.Parameter(key or key_of(renderer), 0.15)],
        [ur.View(np.full((SIZE, SIZE, 3), 0.4, np.float32))],
        max_depth=DEPTH,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"pixels": ur.pixels.Uniform(128), "spp": 4},
        {"pixels": ur.pixels.Adaptive(128, refresh=1000, samples=512), "spp": 4},
        {"image": ur.images.RecursiveControlVariate(), "spp": 4},
    ],
    ids=["uniform", "adaptive", "rcv"],
)
def test_mini_batches_and_control_variates(options: dict[str, Any]) -> None:
    """The gradient of the loss at the start, by `PathGradient` with and without: their difference, from the same images, has mean 0.

    Both share the images since all gradients of a run share what its control variate remembers.
    """
    given, rows = problem(), {}
    at = given.initial()
    for differential in (False, True):
        estimator = ur.PathGradient(**options, differential_bsdf=differential)
        state = estimator.init(given, at)
        found = []
        for run in range(160):
            estimate, state = estimator.estimate(given, at, state, Key(run))
            found.append(np.concatenate([np.array(g, np.float64).ravel() for g in estimate.gradient.values()]))
        rows[differential] = np.array(found)
    difference = rows[True] - rows[False]
    error = difference.std(axis=0, ddof=1) / np.sqrt(len(difference))
    assert np.abs(difference.mean(axis=0) / error).max() < stats.norm.isf(1e-3 / 2)
    assert np.abs(rows[True].mean(axis=0) / error).max() > stats.norm.isf(1e-3 / 2)
    assert np.var(rows[True]) < 0.8 * np.var(rows[False])


REFUSED = {
    "no roughness": (
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
        "ball.bsdf.reflectance.value",
        "got",
    ),
    "plastic": ({"type": "pplastic", "alpha": 0.1}, "ball.bsdf.alpha.value", "roughconductor"),
    "principled": (
        {"type": "principled", "roughness": 0.4},
        "ball.bsdf.roughness.value",
        r"another BSDF \(Principled\)",
    ),
    "anisotropic": ({**metal(), "alpha_u": 0.1, "alpha_v": 0.2}, "ball.bsdf.alpha_u.value", "anisotropic"),
    "two sides": (
        {"type": "twosided", "a": metal(), "b": metal(0.2)},
        "ball.bsdf.brdf_0.alpha.value",
        "one of two different sides",
    ),
    "bumps": (
        {"type": "bumpmap", "t": texture(np.zeros((2, 2, 1))), "b": metal()},
        "ball.bsdf.nested_bsdf.alpha.value",
        "BumpMap",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_served_is_refused(name: str) -> None:
    material, key, words = REFUSED[name]
    material = dict(material)
    if name == "anisotropic":
        del material["alpha"]
    renderer = with_differential_bsdf(MitsubaRenderer(scene(material), DEPTH))
    known = [k for k in renderer.parameters() if k.endswith(key.partition("bsdf.")[2]) and k.startswith("ball")]
    with pytest.raises(InputError, match=f"differential_bsdf.*{words}"):
        renderer.prepare(known, None)


def test_moving_shapes_media_and_other_renderers_are_refused() -> None:
    renderer = MitsubaRenderer(scene(metal()), DEPTH, ["ball.translation"])
    key = key_of(renderer)
    with pytest.raises(InputError, match="moves shapes"):
        with_differential_bsdf(renderer).prepare([key, "ball.translation"], None)
    with_differential_bsdf(renderer).prepare([key, "ball.translation"], None, {key})
    fog = {"type": "cube", "interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}
    foggy = MitsubaRenderer({**scene(metal()), "fog": fog}, DEPTH)
    with pytest.raises(InputError, match="media"):
        with_differential_bsdf(foggy).prepare([key_of(foggy)], None)
    with pytest.raises(InputError, match="does not support differential BSDF sampling"):
        ur.PathGradient(differential_bsdf=True).init(ur.gallery.problem("quad"), {})
    with pytest.raises(InputError, match="leave out one of them"):
        ur.PathGradient(differential_bsdf=True, emitters="adaptive")


def test_methods_have_the_option() -> None:
    for name in ("plain", "rcv", "adaptive"):
        estimator, _ = method(name).start({"differential_bsdf": "true"})
        assert isinstance(estimator, ur.PathGradient)
        assert estimator.differential_bsdf
