"""Sampled directions are weighted so that their mean is the integral of the BSDF, also where a BSDF rejects some of its samples."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tiers import quick
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
