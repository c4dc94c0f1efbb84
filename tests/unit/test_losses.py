"""Losses against closed forms and finite differences, in NumPy and on the device."""

import numpy as np
import pytest

from unrender import losses
from unrender.core import arrays, registry
from unrender.core.errors import InputError

ALL = [losses.L1(), losses.L2(), losses.RelativeL2(), losses.RelativeL2(0.5), losses.Huber(), losses.Huber(2.0)]
ALL += [
    made_by()
    for made_by in registry.components("loss").values()
    if made_by not in {type(loss) for loss in ALL} | {losses.Perceptual}
]
REFERENCE = np.array([0.0, 0.2, 1.0, 3.0])


@pytest.mark.parametrize(
    ("loss", "value", "derivative"),
    [
        (losses.L1(), [0.5, 0.2, 0.0, 2.0], [1, -1, 0, 1]),
        (losses.L2(), [0.25, 0.04, 0.0, 4.0], [1.0, -0.4, 0.0, 4.0]),
        (losses.RelativeL2(0.01), [25.0, 0.8, 0.0, 4 / 9.01], [100.0, -8.0, 0.0, 4 / 9.01]),
        (losses.Censored(losses.L1(), 1.0), [0.5, 0.2, 0.0, 0.0], [1, -1, 0, 0]),
        (losses.Censored(losses.L2(), 3.0), [0.25, 0.04, 0.0, 0.0], [1.0, -0.4, 0.0, 0.0]),
        (losses.Huber(1.0), [0.125, 0.02, 0.0, 1.5], [0.5, -0.2, 0.0, 1.0]),
    ],
)
def test_closed_form(loss, value, derivative):
    image = np.array([0.5, 0.0, 1.0, 5.0])
    np.testing.assert_allclose(loss.value(image, REFERENCE), value, atol=1e-12)
    np.testing.assert_allclose(loss.derivative(image, REFERENCE), derivative, atol=1e-12)


@pytest.mark.parametrize("loss", ALL, ids=repr)
def test_derivative_is_that_of_the_value(loss):
    random = np.random.default_rng(1)
    image, reference = random.uniform(0, 4, (2, 1000))
    step = 1e-6
    central = (loss.value(image + step, reference) - loss.value(image - step, reference)) / (2 * step)
    np.testing.assert_allclose(loss.derivative(image, reference), central, atol=1e-6 * np.abs(central).max())


@pytest.mark.parametrize("loss", ALL, ids=repr)
def test_linear_says_whether_image_noise_biases_the_derivative(loss):
    """Two equally likely images around the true one: the mean derivative equals the derivative at the mean, or not."""
    true, noise = REFERENCE + 0.05, np.array([0.5, 1.0, 2.0, 4.0])
    mean = 0.5 * (loss.derivative(true + noise, REFERENCE) + loss.derivative(true - noise, REFERENCE))
    unbiased = np.allclose(mean, loss.derivative(true, REFERENCE), atol=1e-9)
    assert unbiased == loss.linear


@pytest.mark.mitsuba
@pytest.mark.parametrize("loss", ALL, ids=repr)
def test_device_agrees_with_numpy(loss):
    import mitsuba as mi

    random = np.random.default_rng(2)
    image, reference = random.uniform(0, 4, (2, 5, 4, 3)).astype(np.float32)
    image[0] = reference[0]
    for function in (loss.value, loss.derivative):
        expected = function(image, reference)
        actual = function(mi.TensorXf(image), mi.TensorXf(reference))
        assert isinstance(actual, mi.TensorXf)
        np.testing.assert_allclose(arrays.numpy(actual), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("bad", [0, -1.0, float("nan"), float("inf"), True, "1", None])
@pytest.mark.parametrize(("loss", "name"), [(losses.RelativeL2, "epsilon"), (losses.Huber, "delta")])
def test_bad_constants_are_named(loss, name, bad):
    with pytest.raises(InputError, match=f"{loss.__name__}: {name} must be a finite number > 0, got "):
        loss(bad)


def test_a_saturated_pixel_is_pulled_up_and_never_down():
    loss = losses.Censored(losses.L2(), 0.9)
    image, reference = np.array([0.5, 1.5, 0.5, 1.5]), np.array([1.0, 1.0, 0.8, 0.8])
    np.testing.assert_allclose(loss.derivative(image, reference), [-1.0, 0.0, -0.6, 1.4])
    with pytest.raises(InputError, match="Censored: loss must be one of"):
        losses.Censored(losses.L1)  # pyright: ignore[reportArgumentType]  # the class
    with pytest.raises(InputError, match="white"):
        losses.Censored(white=0)
