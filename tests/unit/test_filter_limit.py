"""The Cramér-Rao limit of a film's filter: closed forms of the amplification."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.mitsuba
def test_the_amplification_of_a_tent_is_that_of_its_transfer_function() -> None:
    """A tent has the weights 1/8, 3/4, 1/8 on texels as wide as pixels. Its transfer function is 3/4 + cos(ω) / 4."""
    from benchmarks.filter_limit import amplification, shares

    tent = shares(1 - np.abs(np.linspace(-1, 1, 2001)), 1.0, side=128)
    np.testing.assert_allclose(tent[60, 59:62], [0.125, 0.75, 0.125], atol=1e-5)
    frequency = 2 * np.pi * (np.arange(4096) + 0.5) / 4096
    expected = np.mean((0.75 + np.cos(frequency) / 4) ** -2)
    assert amplification(tent) == pytest.approx(expected, rel=0.02)


@pytest.mark.mitsuba
def test_a_box_amplifies_nothing() -> None:
    from benchmarks.filter_limit import amplification, shares

    assert amplification(shares(np.ones(101), 0.5, side=8)) == pytest.approx(1.0, rel=1e-2)
