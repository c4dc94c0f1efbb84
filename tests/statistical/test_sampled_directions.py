"""Sampled directions are weighted so that their mean is the integral of the BSDF, also where a BSDF rejects some of its samples."""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from zscores import Agreement, agree, z_scores

import unrender as ur
from tiers import quick
from unrender.estimators.base import as_numpy
from unrender.rendering.mitsuba.integrators import specular

COUNT = 1 << 20
RED: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.4, 0.3]}}
GLASS: dict[str, Any] = {"type": "roughdielectric", "alpha": 0.3}
THIN: dict[str, Any] = {"type": "principledthin", "spec_trans": 0.5, "diff_trans": 0.5, "roughness": 0.5}
BLACK: dict[str, Any] = {"type": "roughconductor", "alpha": 0.4, "specular_reflectance": 0.0}


def blend(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    return {"type": "blendbsdf", "weight": 0.5, "one": one, "other": other}


BSDFS: dict[str, dict[str, Any]] = {
    "glass": GLASS,
    "blend with glass": blend(RED, GLASS),
    "principled": {"type": "principled", "spec_trans": 0.5, "eta": 1.5, "roughness": 0.5, "clearcoat": 0.6},
    "thin": THIN,
    "metal": {"type": "roughconductor", "alpha": 0.5},
    "blend with a black lobe": blend(RED, BLACK),
    "two sides": {"type": "twosided", "one": blend(RED, {"type": "roughplastic", "alpha": 0.4})},
}


def interaction(cosine: float) -> mi.SurfaceInteraction3f:
    si: Any = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
    si.sh_frame, si.n = mi.Frame3f(mi.Vector3f(0, 0, 1)), mi.Normal3f(0, 0, 1)
    return si


def compare(name: str, cosine: float) -> float:
    """Return by how many standard errors the mean weight differs from the integral over uniform directions."""
    bsdf: Any = mi.load_dict(BSDFS[name])
    si, ctx, rng = interaction(cosine), mi.BSDFContext(), mi.PCG32(size=COUNT, initstate=3)  # pyright: ignore[reportCallIssue]
    numbers = [rng.next_float32() for _ in range(5)]
    bs, weight = bsdf.sample(ctx, si, numbers[0], mi.Point2f(*numbers[1:3]))
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    smooth = ~delta & specular.on_its_side(si, bs)
    value, pdf = bsdf.eval_pdf(ctx, si, bs.wo, smooth)
    (found,) = specular.sampling_weights([value], pdf, weight, smooth, delta, bs.pdf)
    wo = mi.warp.square_to_uniform_sphere(mi.Point2f(*numbers[3:]))
    expected = bsdf.eval(ctx, si, wo) * (4 * dr.pi)
    one, other = (np.array(x)[0].astype(np.float64) for x in (found, expected))
    error = np.sqrt((one.var() + other.var()) / COUNT)
    return float((one.mean() - other.mean()) / max(error, 1e-9))


@pytest.mark.parametrize("name", quick(BSDFS, "two sides", "blend with glass", "principled", "thin"))
def test_the_mean_weight_is_the_integral(name: str) -> None:
    """Of four directions, from both sides."""
    scores = [compare(name, cosine) for cosine in (0.9, 0.3, -0.3, -0.9)]
    assert np.abs(scores).max() < 4.2, scores  # 28 comparisons


@pytest.mark.parametrize("name", ["glass", "blend with glass", "principled"])
def test_directions_on_the_wrong_side_are_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(specular, "on_its_side", lambda si, bs: mi.Bool(True))
    monkeypatch.setattr(specular, "_SAME_DENSITY", -1.0)
    assert max(compare(name, cosine) for cosine in (-0.3, -0.9)) > 5


def test_directions_that_a_thin_sheet_rejects_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(specular, "_SAME_DENSITY", -1.0)
    assert compare("thin", 0.3) > 4.2


# ------------------------------------------------------------------ lobes chosen by their energy, as from Mitsuba 3.10 on

TINT, LEVEL = "wall.bsdf.tint", 1e-3


def register_adaptive(consistent: bool = True) -> None:
    """Register "adaptive": a diffuse and a glossy lobe, each sampled in proportion to what it reflects, so that probabilities depend on an
    unknown. `principled` samples its lobes so from Mitsuba 3.10 on. The planted fault is a density of lobes with equal probabilities."""

    class Adaptive(mi.BSDF):
        def __init__(self, properties: Any):
            super().__init__(properties)
            self.tint = mi.Color3f(0.6, 0.3, 0.2)
            self.parts: list[Any] = [
                mi.load_dict({"type": "diffuse", "reflectance": 1.0}),
                mi.load_dict({"type": "roughconductor", "alpha": 0.4, "specular_reflectance": 0.5}),
            ]
            self.m_components = [mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection]
            self.m_components = [kind | mi.BSDFFlags.FrontSide for kind in self.m_components]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: Any) -> None:
            callback.put("tint", self.tint, mi.ParamFlags.Differentiable)

        def share(self) -> Any:
            return dr.mean(self.tint) / (dr.mean(self.tint) + 0.5)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
            first = sample1 < self.share()
            (one, _), (other, _) = (
                part.sample(ctx, si, sample1, sample2, active & chosen)
                for part, chosen in zip(self.parts, (first, ~first), strict=True)
            )
            bs = dr.select(first, one, other)
            bs.sampled_component = dr.select(first, mi.UInt32(0), mi.UInt32(1))
            value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
            active &= bs.pdf > 0
            return bs, dr.select(active, value / bs.pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            one, other = (part.eval(ctx, si, wo, active) for part in self.parts)
            return self.tint * one + other

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            one, other = (part.pdf(ctx, si, wo, active) for part in self.parts)
            share = self.share() if consistent else mi.Float(0.5)
            return share * one + (1 - share) * other

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return "Adaptive[]"

    mi.register_bsdf("adaptive", Adaptive)


def corner() -> dict[str, Any]:
    """Two walls that light each other, under a sky and a lamp."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    camera = mi.ScalarTransform4f().look_at([2, 2, 2], [0, 0.5, 0], [0, 1, 0])
    picture = np.random.default_rng(0).uniform(0.1, 1, (4, 8, 3)).astype(np.float32)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": camera, "film": film},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2), "bsdf": RED},
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 1, -1]),
            "bsdf": {"type": "adaptive"},
        },
        "lamp": {"type": "point", "position": [1, 2, 1], "intensity": 3.0},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(picture)},
    }


def gradients_agree() -> Agreement:
    """Return whether path gradients of the tint are the slope of the L2 loss, whose pictures are Mitsuba's."""
    start, width, path = np.array([0.6, 0.3, 0.2]), 0.05, mi.load_dict({"type": "path", "max_depth": 3})
    loaded = mi.load_dict(corner())
    known: Any = mi.traverse(loaded)

    def picture(tint: np.ndarray, spp: int, seed: int) -> np.ndarray:
        known[TINT] = mi.Color3f(*map(float, tint))
        known.update()
        return np.array(mi.render(loaded, integrator=path, spp=spp, seed=mi.UInt32(seed)), np.float64)

    reference = picture(np.array([0.3, 0.6, 0.5]), 1024, 999)
    expected = np.zeros((8, 3))
    for seed, index in np.ndindex(expected.shape):
        ends = []
        for sign in (width, -width):
            there = start + sign * np.eye(3)[index]
            one, other = (picture(there, 256, 2 * seed + half) - reference for half in (0, 1))
            ends.append(np.mean(one * other))
        expected[seed, index] = (ends[0] - ends[1]) / (2 * width)
    problem = ur.Problem(
        corner, [ur.Parameter(TINT, initial=start)], [ur.View(reference.astype(np.float32))], max_depth=3
    )
    point, estimator = problem.initial(), ur.PathGradient(spp=256)
    estimate = partial(estimator.estimate, problem, point, estimator.init(problem, point))
    found = np.stack([as_numpy(estimate(ur.Key(seed))[0]).gradient[TINT] for seed in range(16)])
    z = z_scores(found.astype(np.float64), expected)
    return Agreement(bool(np.abs(z).max() < stats.norm.isf((1 - (1 - LEVEL) ** (1 / 3)) / 2)), f"{z}")


@pytest.mark.slow
def test_probabilities_of_lobes_that_depend_on_the_unknown_do_not_bias_the_gradient() -> None:
    register_adaptive()
    assert gradients_agree()


@pytest.mark.slow
def test_a_density_that_is_not_the_sampled_one_is_seen() -> None:
    register_adaptive(consistent=False)
    assert not gradients_agree()


def test_both_states_of_a_pair_are_right_though_one_chooses_the_lobes() -> None:
    """The paths of a pair are sampled with the current tint."""
    register_adaptive()
    problem = ur.Problem(
        corner, [ur.Parameter(TINT, initial=0.5)], [ur.View(np.ones((8, 8, 3), np.float32))], max_depth=3
    )
    now, before = ({TINT: np.array(x, np.float32)} for x in ([0.9, 0.8, 0.9], [0.1, 0.05, 0.2]))
    pairs = [ur.render_pair(problem, now, before, spp=256, seed=seed) for seed in range(12)]
    for state, values in enumerate((now, before)):
        own = [ur.render(problem, values, spp=256, seed=100 + seed) for seed in range(12)]
        assert agree(np.stack([pair[state] for pair in pairs]), np.stack(own), size=2)
