"""Samples that are not finite: where they came from, and what becomes of them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from unrender.rendering.mitsuba.integrators.emitters import mis_weight


def test_weights_of_huge_densities_are_finite_and_sum_to_one() -> None:
    densities = np.array([0, 1e-15, 1, 2, 1e19, 1e30, np.inf], np.float32)
    a, b = (mi.Float(x.ravel()) for x in np.meshgrid(densities, densities))
    weight, other = mis_weight(a, b).numpy(), mis_weight(b, a).numpy()
    assert np.isfinite(weight).all()
    some = np.maximum(a.numpy(), b.numpy()) > 0
    np.testing.assert_allclose((weight + other)[some], 1, atol=1e-6)
    # A lamp seen edge-on: the density's square is no single-precision number.
    assert mis_weight(mi.Float(1e20), mi.Float(0)).numpy()[0] == 1
    np.testing.assert_allclose(mis_weight(mi.Float(2), mi.Float(1)).numpy()[0], 0.8, rtol=1e-6)
