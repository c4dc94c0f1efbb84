"""A problem: what it takes, what it refuses and in which words, and the arithmetic of its loss."""

from __future__ import annotations

import contextlib
import copy
import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drjit.llvm.ad import Array3f

from tests.analytic import AnalyticRenderer
from unrender import losses, methods
from unrender.backend.variant import unsupported
from unrender.core import registry
from unrender.core.errors import InputError
from unrender.images.denoising import choose
from unrender.io import write_grid
from unrender.preconditioners import LargeSteps
from unrender.rendering.renderer import ParameterInfo
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View
from unrender.scene.render import render

MASKED: Any = np.ma.masked_greater([0.0, 1.0], 0.5)
HEIGHT, WIDTH = 4, 5
PIXELS = HEIGHT * WIDTH * 3


class Renderer(AnalyticRenderer):
    """With a colour, a texture, a number, and one parameter that has no gradient."""

    def __init__(self, sensors: int = 2):
        values = {
            "wall.value": np.array([0.2, 0.4, 0.6]),
            "floor.data": np.full((2, 2, 3), 0.5),
            "lamp.scale": np.array(2.0),
            "lens.eta": np.array(1.5),
        }
        matrix = np.random.default_rng(0).random((PIXELS, 3 + 12 + 1 + 1))
        super().__init__(values, matrix, shape=(HEIGHT, WIDTH), sensors=sensors)

    def parameters(self) -> dict[str, ParameterInfo]:
        known = dict(super().parameters())
        known["wall.value"] = ParameterInfo((3,), lowest=0.0, highest=1.0)
        known["floor.data"] = ParameterInfo((2, 2, 3), lowest=0.0, highest=1.0)
        known["lens.eta"] = ParameterInfo((), False, False, "it bends rays", perturbable=False)
        return known


REFERENCE = np.random.default_rng(1).random((HEIGHT, WIDTH, 3)).astype(np.float32)
WALL = Parameter("wall.value")
VIEW = View(REFERENCE)


def problem(parameters: Any = (WALL,), views: Any = (VIEW,), **more: Any) -> Problem:
    return Problem(Renderer(), parameters, views, **more)


# ------------------------------------------------------------------ what it makes of its input


def test_takes_the_scenes_own_values_and_physical_bounds_by_default():
    made = problem([WALL, Parameter("lamp.scale")])
    np.testing.assert_allclose(made.initial()["wall.value"], [0.2, 0.4, 0.6])
    assert [unknown.bounds for unknown in made.unknowns.values()] == [(0.0, 1.0), (None, None)]
    assert made.learning_rates == {}
    assert all(unknown.preconditioner is None for unknown in made.unknowns.values())
    assert made.truth == {}
    assert made.notices == []


@pytest.mark.parametrize(
    ("key", "initial", "expected"),
    [
        ("wall.value", 0.25, [0.25] * 3),
        ("wall.value", [0.1, 0.2, 0.3], [0.1, 0.2, 0.3]),
        ("wall.value", np.float64(0.25), [0.25] * 3),
        ("floor.data", 0.25, np.full((2, 2, 3), 0.25)),
        ("floor.data", (0.1, 0.2, 0.3), np.tile([0.1, 0.2, 0.3], (2, 2, 1))),
        ("floor.data", Array3f(0.5, 0.25, 0.125), np.tile([0.5, 0.25, 0.125], (2, 2, 1))),
        ("floor.data", np.arange(12).reshape(2, 2, 3) / 12, np.arange(12).reshape(2, 2, 3) / 12),
        ("lamp.scale", 3, 3.0),
        ("lamp.scale", [3.0], 3.0),
    ],
)
def test_initial_fills_the_parameters_shape(key: str, initial: Any, expected: Any):
    found = problem([Parameter(key, initial)]).initial()[key]
    assert np.shape(found) == np.shape(expected)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_initial_is_a_copy_each_time():
    given = np.full((2, 2, 3), 0.5)
    made = problem([Parameter("floor.data", given)])
    given[:] = 0.1
    made.initial()["floor.data"][:] = 0.9
    np.testing.assert_allclose(made.initial()["floor.data"], 0.5)


def test_initial_is_moved_into_the_bounds_and_says_so():
    made = problem([Parameter("wall.value", [-1.0, 0.5, 2.0], bounds=(0.1, 0.9))])
    np.testing.assert_allclose(made.initial()["wall.value"], [0.1, 0.5, 0.9])
    assert made.notices == [
        "parameter wall.value: 2 of 3 initial values moved into the bounds [0.1, 0.9]: -1 to 0.1, 2 to 0.9"
    ]


@pytest.mark.parametrize(("initial", "bounds"), [(7.0, (0.1, 4.0)), (None, (3.0, 4.0)), (np.float32(0), (1.0, None))])
def test_a_number_is_moved_into_its_bounds_too(initial: Any, bounds: Any):
    made = problem([Parameter("lamp.scale", initial, bounds=bounds)])
    low, high = bounds
    given = 2 if initial is None else initial
    assert made.initial()["lamp.scale"].shape == ()
    assert made.initial()["lamp.scale"] == (low if initial is None or initial < low else high)
    assert made.notices == [
        f"parameter lamp.scale: 1 of 1 initial values moved into the bounds [{low:g}, {'open' if high is None else f'{high:g}'}]"
        f": {given:g} to {made.initial()['lamp.scale']:g}"
    ]


@pytest.mark.parametrize(
    ("truth", "values"),
    [
        ([-1.0, 0.5, 2.0], "2 of 3 values outside the bounds [0.1, 0.9], which no run can reach: -1, 2"),
        ([0.1, 0.9, 0.5], ""),
    ],
)
def test_a_truth_outside_the_bounds_is_named(truth: list[float], values: str) -> None:
    made = problem([Parameter("wall.value", 0.5, bounds=(0.1, 0.9))], truth={"wall.value": truth})
    assert made.notices == ([f"parameter wall.value: truth has {values}"] if values else [])


def test_a_word_is_no_value() -> None:
    with pytest.raises(
        InputError, match=r"initial: rough: no such file; expected a number, a colour, or a picture or grid file"
    ):
        problem([Parameter("wall.value", "rough")])


def test_of_many_values_outside_the_bounds_the_furthest_is_named() -> None:
    made = problem([Parameter("wall.value", [1.5, 2.0, 0.5], bounds=(0.1, 0.9))], truth={"wall.value": [3.0, 1.5, 0.5]})
    moved, outside = made.notices
    assert moved.endswith("2 of 3 initial values moved into the bounds [0.1, 0.9]: such as 2 to 0.9")
    assert outside.endswith("2 of 3 values outside the bounds [0.1, 0.9], which no run can reach: such as 3")


@pytest.mark.parametrize(
    ("bounds", "kept"),
    [((None, None), (None, None)), ((0, None), (0.0, None)), ((-np.inf, 2.5), (None, 2.5)), ([0, np.inf], (0.0, None)),
     (np.array([0.0, 2.5]), (0.0, 2.5)), ((np.float32(0), np.int64(2)), (0.0, 2.0)), ((-1e300, 1e300), (None, None)),
     ((0, 10**400), (0.0, None))],
)  # fmt: skip
def test_given_bounds_replace_the_physical_ones(bounds: Any, kept: Any):
    assert problem([Parameter("wall.value", bounds=bounds)]).unknowns["wall.value"].bounds == kept


def test_keeps_rates_and_preconditioners_by_key():
    smooth = LargeSteps(5.0)
    made = problem([Parameter("wall.value", learning_rate=1), Parameter("floor.data", preconditioner=smooth)])
    assert made.learning_rates == {"wall.value": 1.0}
    assert [unknown.preconditioner for unknown in made.unknowns.values()] == [None, smooth]


def test_references_are_float32_and_alpha_is_dropped():
    rgba = np.concatenate([REFERENCE, np.zeros((HEIGHT, WIDTH, 1))], axis=2)
    grey = REFERENCE[..., 0].astype(np.float64)
    made = problem(views=[View(rgba), View(grey, sensor=1)])
    assert [view.reference.dtype for view in made.views] == [np.float32] * 2  # pyright: ignore
    np.testing.assert_array_equal(made.views[0].reference, REFERENCE)
    np.testing.assert_array_equal(made.views[1].reference, np.repeat(REFERENCE[..., :1], 3, axis=2))
    assert [notice[:32] for notice in made.notices] == [
        "view 1: reference has one channe",
        "view 0: reference has alpha, whi",
    ]
    (notice,) = problem(views=[View(rgba), View(rgba)]).notices
    assert notice == "references of 2 views have alpha, which is left out; if it is a mask, give it as the view's mask"


def test_a_black_file_and_alpha_of_floats_say_so(tmp_path):
    rgba = np.concatenate([REFERENCE, np.ones((HEIGHT, WIDTH, 1))], axis=2)
    assert problem(views=[View(rgba)]).notices == []
    np.save(tmp_path / "black.npy", np.zeros((HEIGHT, WIDTH, 3), np.float32))
    (notice,) = problem(views=[View(tmp_path / "black.npy")]).notices
    assert notice == "view 0: reference is 0 at every pixel; check the file, or leave the view out"


def test_eight_bit_values_are_linearised_and_it_says_so():
    made = problem(views=[View(np.full((HEIGHT, WIDTH, 3), 188, np.uint8))])
    np.testing.assert_allclose(np.asarray(made.views[0].reference), 0.5029, atol=1e-4)  # sRGB 188 is half the light
    assert made.notices == ["view 0: reference 8-bit sRGB, linearised"]


def test_eight_bit_masks_are_taken_as_they_are():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[0] = 51
    made = problem(views=[View(REFERENCE, mask=mask)])
    np.testing.assert_allclose(np.asarray(made.views[0].mask), mask / 255)
    assert made.notices == []


def test_the_alpha_of_an_image_is_its_mask():
    """Its colours were, which are white everywhere: no pixel was left out."""
    mask = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    mask[..., 3] = np.arange(WIDTH)
    made = problem(views=[View(REFERENCE, mask=mask), View(REFERENCE, mask=mask / np.float32(255))])
    for view in made.views:
        np.testing.assert_allclose(np.asarray(view.mask), mask[..., 3] / 255)
    assert made.notices == [f"view {n}: mask is the alpha of the image" for n in range(2)]


def test_a_constant_alpha_is_no_mask():
    """It replaced the mask in the colours, so that all pixels counted. An alpha of 0 everywhere is still refused."""
    seen = np.arange(WIDTH) % 2
    mask = np.full((HEIGHT, WIDTH, 4), 254, np.uint8)
    mask[..., :3] = 255 * seen[:, None]
    halved = np.where(mask == 254, np.float32(0.5), mask / np.float32(255))
    made = problem(views=[View(REFERENCE, mask=mask), View(REFERENCE, mask=halved)])
    for view in made.views:
        np.testing.assert_array_equal(np.asarray(view.mask), np.broadcast_to(seen, (HEIGHT, WIDTH)))
    assert made.notices == []
    mask[..., 3] = 0
    with pytest.raises(InputError, match="it is 0 everywhere"):
        problem(views=[View(REFERENCE, mask=mask)])


def test_a_reference_with_saturated_pixels_says_so():
    """Of integers alone: floating-point values have no white."""
    levels = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    levels[1, 2, 0] = 255
    told = (
        "view 0: 5.0% of the reference's pixels are saturated: set the loss Censored, which treats them as lower bounds"
    )
    assert told in problem(views=View(levels)).notices
    assert told not in problem(views=View(levels), loss=losses.Censored()).notices
    elsewhere = np.ones((HEIGHT, WIDTH), np.float32)
    elsewhere[1, 2] = 0
    assert not any("saturated" in notice for notice in problem(views=View(levels, mask=elsewhere)).notices)
    assert problem(views=View((levels / 255).astype(np.float32))).notices == []
    levels[1, 2, 0] = 254
    assert not any("saturated" in notice for notice in problem(views=View(levels)).notices)


def test_the_former_name_of_the_original_views_warns() -> None:
    problem = Problem(Renderer(), [Parameter("wall.value", 0.5)], [View(np.zeros((HEIGHT, WIDTH, 3)))])
    with pytest.warns(DeprecationWarning, match=r"given_views is now Problem\.original_views"):
        assert problem.given_views is problem.original_views


def test_one_view_or_parameter_may_be_given_bare():
    made = problem(WALL, VIEW)
    assert (len(made.parameters), len(made.views)) == (1, 1)


def test_truth_takes_what_initial_takes():
    made = problem([WALL, Parameter("floor.data")], truth={"floor.data": [0.1, 0.2, 0.3]})
    assert made.truth["floor.data"].shape == (2, 2, 3)
    point = {"wall.value": np.zeros(3), "floor.data": made.truth["floor.data"] + np.array([0.0, 0.0, 0.3])}
    assert made.parameter_error(point) == {"floor.data": pytest.approx(0.3 / np.sqrt(3), rel=1e-5)}


def test_replaced_is_the_same_scene_with_what_was_given_anew():
    """Of one loaded scene; what is not given stays, truths of what is unknown no more go."""
    truth = {"wall.value": [0.1, 0.2, 0.3], "floor.data": 0.4}
    made = problem([WALL, Parameter("floor.data")], truth=truth, name="room", loss=losses.L1())
    brighter = made.replaced(parameters=[Parameter("wall.value", initial=0.9), Parameter("lamp.scale")])
    assert brighter.renderer is made.renderer
    assert (brighter.name, brighter.loss, brighter.max_depth) == ("room", losses.L1(), made.max_depth)
    assert list(brighter.truth) == ["wall.value"]
    np.testing.assert_allclose(brighter.initial()["wall.value"], 0.9)
    np.testing.assert_array_equal(brighter.views[0].reference, REFERENCE)

    other = made.replaced(views=[View(REFERENCE + 1, sensor=1)], loss=losses.L2(), truth={}, name="other")
    assert (other.name, other.loss, other.truth, other.parameters) == ("other", losses.L2(), {}, made.parameters)
    np.testing.assert_array_equal(other.views[0].reference, REFERENCE + 1)
    with pytest.raises(InputError, match="parameters: expected at least one Parameter"):
        made.replaced(parameters=[])
    with pytest.raises(InputError, match="the scene has no parameter"):
        made.replaced(parameters=[Parameter(["wall.value"])])  # pyright: ignore[reportArgumentType]


# ------------------------------------------------------------------ the loss


@pytest.mark.parametrize("loss", [losses.L1(), losses.L2(), losses.RelativeL2(), losses.Huber()])
def test_loss_derivative_is_the_derivative_of_the_total(loss: losses.Loss):
    rng = np.random.default_rng(2)
    mask = rng.random((HEIGHT, WIDTH))
    made = problem(views=[View(REFERENCE, weight=2.5, mask=mask), View(REFERENCE, sensor=1)], loss=loss)
    for view in (0, 1):
        image = REFERENCE + rng.normal(0, 0.3, REFERENCE.shape)
        slope = made.loss_derivative(view, image)
        assert slope.shape == image.shape
        for place in [(0, 0, 0), (3, 4, 2), (1, 2, 1)]:
            step = np.zeros_like(image)
            step[place] = 1e-5
            difference = made.loss_value(view, image + step) - made.loss_value(view, image - step)
            assert slope[place] == pytest.approx(difference / 2e-5, rel=1e-5, abs=1e-9)


def test_loss_is_the_weighted_mean_over_pixels_and_channels():
    mask = np.zeros((HEIGHT, WIDTH))
    mask[0, 0] = 0.5
    made = problem(views=[View(REFERENCE, weight=3.0, mask=mask)])
    assert made.loss_value(0, REFERENCE.astype(float) + 2.0) == pytest.approx(3.0 * 0.5 * 4.0 / (HEIGHT * WIDTH))
    assert problem().loss_value(0, REFERENCE.astype(float) + 2.0) == pytest.approx(4.0)


# ------------------------------------------------------------------ what it refuses

BAD_PARAMETERS: list[tuple[Parameter, str]] = [
    (Parameter("wall.valu"), r"parameters\[0\]\.key: the scene has no parameter wall.valu; did you mean wall.value\?"),
    (Parameter("paint.data"), r"the scene has no parameter paint.data; did you mean floor.data\?"),
    (Parameter("zzz"), r"the scene has no parameter zzz; it has wall.value, floor.data, lamp.scale"),
    (Parameter("lens.eta"), r"lens.eta cannot be recovered: it bends rays"),
    (Parameter("wall.value", [1.0, 2.0]), r"parameter wall.value: initial: expected .* got an array of shape \(2,\)"),
    (
        Parameter("floor.data", np.zeros((3, 2, 3))),
        r"initial: expected .*\(2, 2, 3\), got an array of shape \(3, 2, 3\)",
    ),
    (Parameter("lamp.scale", [1.0, 2.0, 3.0]), r"initial: expected a number, got an array of shape \(3,\)"),
    (Parameter("wall.value", np.ma.masked_equal([0.1, 0.2, 0.3], 0.2)), "initial: a masked array has values"),
    (Parameter("wall.value", float("nan")), "initial: must be finite"),
    (Parameter("wall.value", [0.1, float("inf"), 0.2]), "initial: must be finite"),
    (Parameter("wall.value", 1e300), "initial: must be finite"),
    (Parameter("wall.value", "no-such-picture.png"), "initial: no-such-picture.png: no such file"),
    (Parameter("wall.value", [[0.1], [0.2, 0.3]]), "initial: expected a number, a colour"),
    (Parameter("wall.value", True), "initial: expected a number, a colour"),
    (Parameter("wall.value", 1j), "initial: expected a number, a colour"),  # pyright: ignore
    (Parameter("wall.value", bounds=(1.0, 0.0)), "bounds: low must be less than high, got 1 and 0"),
    (Parameter("wall.value", bounds=(1.0, 1.0)), "bounds: low must be less than high"),
    (
        Parameter("wall.value", bounds=(-5.0, -1.0)),
        r"bounds: no range of values is within \[-5, -1\] and its range \[0, ",
    ),
    (
        Parameter("wall.value", bounds=(-5.0, 0.0)),
        r"bounds: no range of values is within \[-5, 0\] and its range \[0, ",
    ),
    (Parameter("wall.value", bounds=(np.inf, None)), "bounds: low must be less than high"),
    (Parameter("wall.value", bounds=(1e39, None)), r"with numbers up to 3.4e\+38 between, got 1e\+39 and None"),
    (
        Parameter("wall.value", bounds=MASKED),
        "bounds: a masked array has values that do",
    ),
    (Parameter("wall.value", bounds=(0.0, float("nan"))), "bounds: expected two numbers or None, got nan"),
    (Parameter("wall.value", bounds=(0.0,)), "bounds: expected"),  # pyright: ignore
    (Parameter("wall.value", bounds="01"), "bounds: expected"),  # pyright: ignore
    (Parameter("wall.value", learning_rate=0.0), "learning_rate: expected a number above 0, got 0.0"),
    (Parameter("wall.value", learning_rate=float("nan")), "learning_rate: expected a number above 0, got nan"),
    (Parameter("wall.value", preconditioner=LargeSteps(1.0)), "wall.value: preconditioner: LargeSteps needs a texture"),
    (Parameter("floor.data", preconditioner=LargeSteps), "preconditioner: expected one of"),  # pyright: ignore
]


@pytest.mark.parametrize(("parameter", "message"), BAD_PARAMETERS)
def test_refuses_parameters(parameter: Parameter, message: str):
    with pytest.raises(InputError, match=message) as caught:
        problem([parameter])
    assert "\n" not in str(caught.value)


def nan_at(row: int, column: int) -> np.ndarray:
    picture = REFERENCE.copy()
    picture[row, column, 1] = np.nan
    return picture


BAD_VIEWS = [
    (View(REFERENCE, sensor=2), r"view 0: sensor: expected 0 to 1, got 2"),
    (View(REFERENCE, sensor=-1), r"sensor: expected 0 to 1, got -1"),
    (View(REFERENCE, sensor=0.0), r"sensor: expected 0 to 1, got 0.0"),  # pyright: ignore
    (View(REFERENCE, weight=0.0), r"weight: expected a number above 0, got 0.0"),
    (View(REFERENCE, weight=float("inf")), r"weight: expected a number above 0, got inf"),
    (View(REFERENCE[:3]), r"view 0: reference: 5x3 pixels \(width x height\), but the sensor's film is 5x4"),
    (
        View(np.zeros((HEIGHT, WIDTH, 2))),
        r"reference: expected an array of shape \(H, W, 3\) with red, green and blue, or .*, got \(4, 5, 2\)",
    ),
    (View(np.zeros((0, WIDTH, 3))), r"reference: expected an array of shape \(H, W, 3\)"),
    (View(np.ma.masked_less(REFERENCE, 0.5)), r"reference: a masked array has values that do not count: fill it"),
    (View(nan_at(2, 3)), r"reference: 1 pixel is NaN or infinite, the first in row 2, column 3"),
    (View(np.full((HEIGHT, WIDTH, 3), "a")), r"reference: expected an array of numbers"),
    (View(REFERENCE.astype(complex)), r"reference: expected an array of real numbers"),
    (View("nowhere.exr"), r"view 0: reference: nowhere.exr: no such file"),
    (View(None), r"view 0: reference: expected"),  # pyright: ignore
    (View(REFERENCE, mask=np.ones((HEIGHT, WIDTH + 1))), r"view 0: mask: 6x4 pixels"),
    (View(REFERENCE, mask=np.full((HEIGHT, WIDTH), 2.0)), r"mask: expected values from 0 to 1, got 2 to 2"),
    (View(REFERENCE, mask=np.full((HEIGHT, WIDTH), -0.5)), r"mask: expected values from 0 to 1"),
    (View(REFERENCE, mask=np.full((HEIGHT, WIDTH, 3), (1.0, 0.5, 0.2))), r"mask: it has colours; expected one channel"),
    (View(REFERENCE, mask=np.zeros((HEIGHT, WIDTH))), r"mask: it is 0 everywhere"),
    (
        View(REFERENCE, mask=np.eye(HEIGHT, WIDTH, dtype=np.uint8)),
        r"mask: its largest value is 0.0039: expected 1 where",
    ),
]


@pytest.mark.parametrize(("view", "message"), BAD_VIEWS)
def test_refuses_views(view: View, message: str):
    with pytest.raises(InputError, match=message) as caught:
        problem(views=[view])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"parameters": []}, "parameters: expected at least one Parameter, got none"),
        ({"parameters": ["wall.value"]}, r"parameters\[0\]: expected a Parameter, got str"),
        ({"parameters": "wall.value"}, "parameters: expected a list of Parameter, got str"),
        ({"parameters": [WALL, Parameter("floor.data"), WALL]}, r"parameters\[2\]\.key: wall.value is given twice"),
        ({"views": []}, "views: expected at least one View, got none"),
        ({"views": [REFERENCE]}, r"views\[0\]: expected a View, got ndarray"),
        ({"loss": losses.L1}, "loss: expected one of unrender.losses"),
        ({"loss": "L1"}, "loss: expected one of unrender.losses"),
        ({"max_depth": 0}, "max_depth: expected a whole number of at least 1, got 0"),
        ({"max_depth": -1}, "max_depth: expected a whole number of at least 1, got -1; for Mitsuba's -1"),
        ({"max_depth": 2.5}, "max_depth: expected a whole number of at least 1, got 2.5"),
        ({"truth": {"wall.valu": 0.5}}, r"truth\.wall\.valu: not one of the parameters; did you mean wall.value\?"),
        ({"truth": {"wall.value": [0.5, 0.5]}}, r"truth\.wall\.value: expected"),
    ],
)
def test_refuses(arguments: dict[str, Any], message: str):
    with pytest.raises(InputError, match=message) as caught:
        problem(**arguments)
    assert "\n" not in str(caught.value)


def test_refuses_a_scene_that_is_none():
    with pytest.raises(InputError, match=r"scene: expected an \.xml file, a Mitsuba dictionary or a function, got int"):
        Problem(3, [WALL], [VIEW])  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("size", [None, (HEIGHT, WIDTH)])
def test_pixel_weights_are_the_mask_or_ones(size: tuple[int, int] | None) -> None:
    reference, mask = np.zeros((HEIGHT, WIDTH, 3)), np.random.default_rng(1).random((HEIGHT, WIDTH))
    np.testing.assert_array_equal(View(reference).pixel_weights(size), np.ones((HEIGHT, WIDTH)))
    np.testing.assert_array_equal(View(reference, mask=mask).pixel_weights(size), mask)
    assert View(reference).pixel_weights(HEIGHT * WIDTH).shape == (HEIGHT * WIDTH,)


def test_tensors_of_pytorch_may_require_gradients() -> None:
    torch = pytest.importorskip("torch")
    value = torch.full((3,), 0.25, requires_grad=True)
    picture = torch.full((HEIGHT, WIDTH, 3), 0.25, requires_grad=True)
    made = problem([Parameter("wall.value", value)], [View(picture)], truth={"wall.value": value})
    assert made.initial_values()["wall.value"].tolist() == made.truth["wall.value"].tolist() == [0.25, 0.25, 0.25]
    assert np.asarray(made.views[0].reference).tolist() == np.full((HEIGHT, WIDTH, 3), 0.25).tolist()
    assert np.array_equal(render(made, {"wall.value": value}), render(made))


def test_a_vector_of_drjit_is_a_value_to_render() -> None:
    """It was refused, "expected shape (3,), got (3, 1)", and taken as an initial value."""
    made = problem([Parameter("wall.value", (0.5, 0.25, 0.125))])
    assert np.array_equal(render(made, {"wall.value": Array3f(0.5, 0.25, 0.125)}), render(made))  # type: ignore[dict-item]


def test_a_deep_copy_is_the_problem_itself() -> None:
    made = problem([Parameter("wall.value")])
    assert copy.deepcopy({"problem": made})["problem"] is made


def test_parameters_of_arrays_can_be_compared() -> None:
    made = Parameter("wall.value", initial=np.ones(3))
    assert made == made
    assert made != Parameter("wall.value", initial=np.ones(3))


@pytest.mark.mitsuba
@pytest.mark.parametrize(
    "wrong",
    [10**5000, [10**5000], {"a": 10**5000}, [10**400] * 3, np.ones((2, 2))],
    ids=["number", "list", "table", "float", "array"],
)
def test_values_that_python_neither_prints_converts_nor_compares_are_one_line(wrong: Any, tmp_path: Path):
    """As values of every argument and option. Python prints at most 4300 digits, a float has 308, and an array has no truth value."""

    def attempt(make: Any, *given: Any, **options: Any) -> None:
        with contextlib.suppress(InputError):
            make(*given, **options)

    for name in inspect.signature(Parameter).parameters:
        attempt(lambda name=name: problem([Parameter(**{"key": "wall.value", name: wrong})]))
    for name in inspect.signature(View).parameters:
        attempt(lambda name=name: problem(views=[View(**{"reference": REFERENCE, name: wrong})]))
    for name in ("max_depth", "loss", "truth", "surfaces", "expressions", "name"):
        attempt(problem, **{name: wrong})
    attempt(problem, truth={"wall.value": wrong})
    for name in ("parameters", "spp", "seed", "view", "per_pass"):
        attempt(render, problem(), **{name: wrong})
    attempt(render, problem(), {"wall.value": wrong})
    attempt(choose, wrong)
    attempt(unsupported, wrong)
    attempt(write_grid, tmp_path / "a.vol", wrong)
    attempt(write_grid, tmp_path / "a.vol", np.ones((1, 1, 1)), [wrong] * 6)
    with pytest.raises(InputError, match="got list with an integer of more than 4300 digits"):
        problem([Parameter("wall.value", initial=[10**5000])])
    with pytest.raises(InputError, match="prior: near must have finite numbers"):
        problem([Parameter("wall.value", prior={"near": 10**400, "std": 1})])
    for method in map(methods.method, methods.methods()):
        for name in method.options.model_fields:
            attempt(method.configure, {name: wrong})
    tables = ("largest", "weights", "others")  # only mappings and components are taken
    for made_by in (each for kind in registry.KINDS if kind != "method" for each in registry.components(kind).values()):
        known = inspect.signature(made_by).parameters
        needed = {
            name: 1 for name, of in known.items() if of.default is of.empty and of.kind is of.POSITIONAL_OR_KEYWORD
        }
        for name in known.keys() - set(tables):
            attempt(made_by, **{**needed, name: wrong})


def test_methods_refuse_other_views_images_and_keys() -> None:
    """An image (H, W, 1) would broadcast to a value that looks right."""
    made = problem(truth={"wall.value": [0.1, 0.2, 0.3]})
    for method in (made.reference, made.mask, made.test_weights):
        with pytest.raises(InputError, match=r"view must be at most 0, got 1"):
            method(1)
    for method in (made.loss_value, made.loss_derivative, made.loss_values):
        with pytest.raises(InputError, match=r"shape of the reference, \(4, 5, 3\), got \(4, 5, 1\)"):
            method(0, REFERENCE[..., :1])
    wrong: Any
    for wrong in ({"wal.value": 0.5}, None):
        with pytest.raises(InputError, match=r"parameter_error: expected values of \['wall.value'\], got "):
            made.parameter_error(wrong)
