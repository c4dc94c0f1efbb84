"""LargeSteps against a direct sparse solve, and the properties that descent relies on."""

import drjit as dr
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import kernels
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.preconditioners import LargeSteps

SHAPES = [(7, 5, 3), (1, 9, 1), (12, 12, 4), (4, 5, 6, 1), (3, 1, 7, 2), (2, 2, 2, 3)]


def matrix(strength, grid, wrap):
    """I + λ L, neighbour by neighbour."""
    cells = list(np.ndindex(*grid))
    number = {cell: i for i, cell in enumerate(cells)}
    result = scipy.sparse.lil_matrix(scipy.sparse.identity(len(cells)))
    for cell in cells:
        for axis, size in enumerate(grid):
            after = list(cell)
            after[axis] += 1
            if after[axis] == size:
                if not wrap[axis]:
                    continue
                after[axis] = 0
            i, j = number[cell], number[tuple(after)]
            for a, b, sign in [(i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)]:
                result[a, b] += sign * strength
    return result.tocsc()


def data(shape, seed=7):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("wrap", [False, True, "first"])
@pytest.mark.parametrize("strength", [0.0, 0.7, 25.0, 1000])
@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_direct_solve(shape, strength, wrap):
    axes = (True,) + (False,) * (len(shape) - 2) if wrap == "first" else (wrap,) * (len(shape) - 1)
    x = data(shape)
    factor = scipy.sparse.linalg.splu(matrix(strength, shape[:-1], axes))
    expected = factor.solve(x.reshape(-1, shape[-1]).astype(float))
    actual = LargeSteps(strength, axes if wrap == "first" else wrap).apply(x)
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, expected.reshape(shape), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_symmetric_smoothing_and_true_to_constants(shape, wrap):
    preconditioner = LargeSteps(8.0, wrap)
    x, y = data(shape, 8), data(shape, 9)
    sx, sy = preconditioner.apply(x), preconditioner.apply(y)
    assert np.vdot(sx, y) == pytest.approx(np.vdot(x, sy), abs=1e-4)
    assert 0 < np.vdot(x, sx) <= np.vdot(x, x)
    np.testing.assert_allclose(preconditioner.apply(np.full(shape, 0.75, np.float32)), 0.75, rtol=1e-5)
    np.testing.assert_allclose(sx.sum(axis=tuple(range(x.ndim - 1))), x.sum(axis=tuple(range(x.ndim - 1))), atol=1e-4)


def test_the_kernel_falls_off_over_the_root_of_the_strength():
    """Along one axis S is exp(-r / √λ) far from the borders, for λ well above 1."""
    impulse = np.zeros((1, 401, 1), np.float32)
    impulse[0, 200] = 1.0
    kernel = LargeSteps(100.0).apply(impulse)[0, 200:260, 0]
    np.testing.assert_allclose(kernel[:-10] / kernel[10:], np.e, rtol=5e-3)


def test_channels_do_not_mix():
    x = data((6, 5, 3))
    x[..., 1] = 0.0
    smooth = LargeSteps(5.0).apply(x)
    np.testing.assert_array_equal(smooth[..., 1], 0.0)
    np.testing.assert_allclose(smooth[..., 2:], LargeSteps(5.0).apply(x[..., 2:]), atol=1e-6)


@pytest.mark.mitsuba
@pytest.mark.parametrize("shape", [(7, 5, 3), (4, 5, 6, 1)])
def test_device_agrees_with_numpy(shape):
    import mitsuba as mi

    x = data(shape)
    actual = LargeSteps(10.0).apply(mi.TensorXf(x))
    assert isinstance(actual, mi.TensorXf)
    assert actual.shape == shape
    np.testing.assert_array_equal(arrays.numpy(actual), LargeSteps(10.0).apply(x))


@pytest.mark.mitsuba
def test_where_numpy_puts_the_result_compiles_no_kernels():
    """Dr.Jit shares NumPy's memory and tells aligned from unaligned."""
    import mitsuba as mi

    x, compiled, rooms = mi.TensorXf(data((7, 5, 3))), [], []
    for step in range(24):
        rooms.append(np.empty(5 + 16 * step, np.uint8))  # so that the next array lies elsewhere
        smooth = LargeSteps(10.0).apply(x)
        with kernels.recorded() as new:
            dr.eval(smooth * 3.21 + 1.23)
        compiled += new
    assert len(compiled) == 24
    assert not any(compiled[1:])


def test_arguments_stay_as_they_were_and_strides_do_not_matter():
    x = data((6, 8, 3))
    kept = x.copy()
    flipped = LargeSteps(4.0).apply(x[::-1, ::2])
    np.testing.assert_array_equal(x, kept)
    np.testing.assert_array_equal(flipped, LargeSteps(4.0).apply(x[::-1, ::2].copy()))


def test_one_object_serves_several_shapes():
    preconditioner = LargeSteps(3.0)
    for shape in [(4, 4, 1), (8, 8, 1), (4, 4, 1)]:
        assert preconditioner.apply(data(shape)).shape == shape
    assert preconditioner == LargeSteps(3.0)
    assert hash(LargeSteps(3.0, [True, False])) == hash(LargeSteps(3.0, (True, False)))  # type: ignore


@pytest.mark.parametrize("shape", [(), (3,), (100, 3), (1, 1, 3), (1, 1, 1, 1), (4, 4, 0), (2, 2, 2, 2, 3)])
def test_shapes_that_do_not_suit(shape):
    with pytest.raises(
        InputError, match=r"^wall\.data: preconditioner LargeSteps needs a texture \(H, W, C\) or a grid"
    ):
        LargeSteps(10.0).check("wall.data", shape)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LargeSteps(-1.0), "LargeSteps: strength must be a finite number >= 0, got -1.0"),
        (lambda: LargeSteps("10"), "LargeSteps: strength must be a finite number >= 0, got '10'"),  # type: ignore
        (
            lambda: LargeSteps(1.0, wrap=1),  # type: ignore
            "LargeSteps: wrap must be true, false, or one of these per axis, got 1",
        ),
        (
            lambda: LargeSteps(1.0, wrap=()),
            "LargeSteps: wrap must be true, false, or one of these per axis, got ()",
        ),
        (
            lambda: LargeSteps(1.0, wrap=(True,)).check("sky.data", (4, 8, 3)),
            "sky.data: preconditioner LargeSteps: wrap must have 2 entries for shape (4, 8, 3), got 1",
        ),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value) == message
