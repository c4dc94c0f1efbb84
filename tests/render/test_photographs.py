"""The gallery's photographs are scikit-image's, read and resized without importing it."""

from __future__ import annotations

import typing

import numpy as np
import pytest

from unrender.gallery import parts


@pytest.mark.parametrize("name", typing.get_args(parts.Photograph))
def test_photographs_are_those_of_scikit_image(name: parts.Photograph) -> None:
    import skimage.data

    np.testing.assert_array_equal(parts._read(name), getattr(skimage.data, name)())


@pytest.mark.parametrize("resolution", [7, 60, 90])
def test_they_are_resized_as_scikit_image_does(resolution: int) -> None:
    from skimage.transform import resize

    picture = np.random.default_rng(0).random((60, 60, 3))
    expected = resize(picture, (resolution, resolution), anti_aliasing=resolution < 60)
    # Sums of another order differ in the last digit.
    np.testing.assert_allclose(parts._resized(picture, resolution), expected, rtol=1e-13)
