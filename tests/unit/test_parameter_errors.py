"""Errors of parameters: numbers by their difference, normals and directions by their angle, cells by whether they are seen."""

from __future__ import annotations

import numpy as np
import pytest

from unrender.rendering import parameter_errors
from unrender.rendering.parameter_errors import PLAIN, ErrorMeasure

NORMAL, DIRECTION = ErrorMeasure("normal"), ErrorMeasure("direction")


def tilted(degrees: float, length: float = 1.0) -> np.ndarray:
    """A vector at an angle to z."""
    angle = np.radians(degrees)
    return length * np.array([np.sin(angle), 0.0, np.cos(angle)], np.float32)


def normal_map(degrees: np.ndarray, length: float = 1.0) -> np.ndarray:
    """(H, W, 3) values of a normal map whose normals have these angles to z."""
    vectors = np.stack([tilted(angle, length) for angle in degrees.reshape(-1)])
    return (0.5 * vectors + 0.5).reshape(*degrees.shape, 3)


def test_numbers_have_the_root_mean_square_difference():
    assert PLAIN.error(np.array([1.0, 2.0]), np.array([4.0, 6.0])) == pytest.approx(np.sqrt(12.5))
    assert (PLAIN.name, PLAIN.unit, PLAIN.text(0.25)) == ("RMSE", "", "0.25")


def test_heights_have_the_standard_deviation_of_the_difference():
    height, truth = ErrorMeasure("height"), np.arange(6.0).reshape(2, 3, 1)
    assert height.error(truth + 5.0, truth) == pytest.approx(0.0, abs=1e-12)
    assert height.error(3.0 * truth, truth) == pytest.approx(2.0 * np.std(truth))
    where = np.array([[True, True, False], [False, False, False]])
    assert height.error(3.0 * truth, truth, where) == pytest.approx(1.0)
    assert (height.unit, parameter_errors.title([height, PLAIN])) == ("", "Parameter error (RMSE)")


def test_ratios_have_the_difference_after_the_best_factor_of_each_vector():
    ratios, truth = ErrorMeasure("ratios"), np.array([[1.0, 2.0, 2.0], [3.0, 0.0, 4.0]])
    assert ratios.error(truth * [[0.5], [7.0]], truth) == pytest.approx(0.0, abs=1e-12)
    assert ratios.error(np.array([[2.0, 0.0]]), np.array([[1.0, 1.0]])) == pytest.approx(np.sqrt(0.5))
    assert ratios.error(np.zeros((1, 2)), np.array([[1.0, 1.0]])) == pytest.approx(1.0)
    assert (ratios.name, ratios.unit) == ("RMSE up to a factor", "")
    assert parameter_errors.from_record(ratios.record()) == ratios


@pytest.mark.parametrize("length", [0.3, 1.0, 2.5])
def test_a_normal_map_has_the_mean_angle_whatever_the_length_of_its_normals(length: float):
    angles = np.array([[0.0, 10.0], [20.0, 90.0]])
    flat = normal_map(np.zeros((2, 2)))
    assert NORMAL.error(normal_map(angles, length), flat) == pytest.approx(30.0, abs=1e-4)
    assert NORMAL.text(30.0) == "30°"
    assert NORMAL.name_with_median(normal_map(angles, length), flat) == "mean angle; median 15°"
    # What counts lengths would see an error where there is none.
    same = NORMAL.error(normal_map(angles, length), normal_map(angles))
    assert same == pytest.approx(0.0, abs=1e-4)
    counted = PLAIN.error(normal_map(angles, length), normal_map(angles))
    assert counted is not None
    assert (counted > 0.1) == (length != 1.0)


def test_small_angles_are_not_lost_to_rounding():
    found = DIRECTION.error(tilted(0.01).astype(np.float64), tilted(0.0).astype(np.float64))
    assert found == pytest.approx(0.01, rel=1e-4)


def test_directions_may_be_flat_and_those_without_a_length_count_as_right_angles():
    values = np.concatenate([tilted(40.0, 3.0), np.zeros(3)])
    assert DIRECTION.error(values, np.concatenate([tilted(0.0)] * 2)) == pytest.approx(65.0, abs=1e-4)


def test_cells_that_are_not_seen_are_left_out():
    truth, values = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
    values[0, 0] = 3.0
    where = np.ones((2, 3), bool)
    assert PLAIN.error(values, truth, where) == pytest.approx(np.sqrt(9 / 6))
    where[0, 0] = False
    assert PLAIN.error(values, truth, where) == 0.0
    assert PLAIN.error(values, truth, np.zeros((2, 3), bool)) is None
    angles = np.array([[90.0, 10.0, 10.0], [10.0, 10.0, 10.0]])
    assert NORMAL.error(normal_map(angles), normal_map(0 * angles), where) == pytest.approx(10.0, abs=1e-4)


def test_repeated_columns_do_not_count():
    around, truth = ErrorMeasure(repeated=1), np.zeros((2, 5, 1))
    values = truth.copy()
    values[:, [0, -1]] = 7.0
    assert around.error(values, truth) == 0.0
    values[:, 1] = 3.0
    assert around.error(values, truth) == pytest.approx(np.sqrt(3.0))
    where = np.ones((2, 5), bool)
    where[:, 1] = False
    assert around.error(values, truth, where) == 0.0


def test_other_shapes_have_no_error():
    assert PLAIN.error(np.zeros(3), np.zeros(4)) is None
    assert PLAIN.error(np.zeros((2, 2, 1)), np.zeros((2, 2, 1)), np.ones((3, 2), bool)) is None


@pytest.mark.parametrize("measure", [PLAIN, NORMAL, DIRECTION, ErrorMeasure("value", 1)])
def test_a_record_gives_the_measure_back(measure: ErrorMeasure):
    assert parameter_errors.from_record(measure.record()) == measure


@pytest.mark.parametrize(
    "record", [None, 3, {}, {"role": "colour"}, {"role": ["normal"]}, {"repeated": -1}, {"repeated": True}]
)
def test_a_malformed_record_is_the_plain_measure(record: object):
    assert parameter_errors.from_record(record) == PLAIN


def test_charts_tell_what_they_show():
    assert parameter_errors.title([PLAIN]) == "Parameter error (RMSE)"
    assert parameter_errors.title([]) == "Parameter error (RMSE)"
    assert parameter_errors.title([NORMAL]) == "Parameter error (mean angle in °)"
    assert parameter_errors.title([NORMAL, PLAIN]) == "Parameter error (RMSE, or mean angle in °)"


def test_cells_of_vectors_are_selected_vector_by_vector():
    truth = np.stack([tilted(0.0)] * 3)
    values = np.stack([tilted(0.0), tilted(30.0), tilted(60.0)])
    where = np.array([True, True, False])
    for shape in ((3, 3), (9,)):
        error = DIRECTION.error(values.reshape(shape), truth.reshape(shape), where)
        assert error == pytest.approx(15.0, abs=1e-4)
    for misfit in (np.ones((3, 3), bool), np.ones(9, bool), np.array(True)):
        assert DIRECTION.error(values, truth, misfit) is None
