"""Errors of parameter values by their role: numbers, heights, ratios, normals or directions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from unrender.core import periodic

Role = Literal["value", "height", "ratios", "normal", "direction"]
"""Meaning of a parameter's values: numbers, heights of which only differences matter, vectors of which only the ratios of their elements
matter, a normal map (n = 2 x - 1), or vectors of which only the direction matters."""

_MOST_COLUMNS = 8  # maximum number of repeated columns that a record may state
_SHORTEST = 1e-12
"""Minimum length of a vector that has a direction. A shorter vector has an angle of 90°, and no factor."""


@dataclass(frozen=True)
class ErrorMeasure:
    """Error measure between values and the ground truth.

    The error of numbers is the root mean square difference, that of heights the standard deviation of the difference. The error of
    ratios is the root mean square difference after each vector is multiplied by its best factor. The error of
    normals and directions is the mean angle in degrees after normalisation, since images do not depend on their lengths.

    Attributes:
        role: meaning of the values. Arrays of ratios have their vectors on the last axis. Arrays of normals and directions have the
            vectors' components there, or are flat.
        repeated: number of columns at each end that repeat others and are ignored, see `core.periodic`.
    """

    role: Role = "value"
    repeated: int = 0

    @property
    def is_angle(self) -> bool:
        return self.role in ("normal", "direction")

    @property
    def name(self) -> str:
        names = {"height": "RMSE without the mean", "ratios": "RMSE up to a factor"}
        return "mean angle" if self.is_angle else names.get(self.role, "RMSE")

    @property
    def unit(self) -> str:
        """Unit of the error; "" if it is the unit of the values."""
        return "°" if self.is_angle else ""

    def text(self, error: float) -> str:
        """Return an error with its unit, with four significant digits."""
        return f"{error:.4g}{self.unit}"

    def error(self, values: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float | None:
        """Return the error over all elements, or over the cells that `where` selects.

        Return None if the shapes differ, `where` does not fit, or no element remains.

        Args:
            truth: ground truth, of the same shape.
            where: booleans over leading axes of `values`; None for all cells. A cell of normals or directions is a vector.
        """
        if values.shape != truth.shape or values.size == 0:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = _fitted(values, truth) if self.role == "ratios" else values
            errors = (
                self._angles(values, truth) if self.is_angle else np.asarray(self._unknown(scaled - truth), np.float64)
            )
        if where is not None:
            cells = self._unknown(where)
            if cells.ndim < 1 or errors.shape[: cells.ndim] != cells.shape:
                return None
            errors = errors[cells]
        if errors.size == 0:
            return None
        if self.is_angle:
            return float(np.mean(errors, dtype=np.float64))
        with np.errstate(over="ignore", invalid="ignore"):
            mean = errors.mean() if self.role == "height" else 0.0
            return float(np.sqrt(np.mean(np.square(errors - mean))))

    def name_with_median(self, values: np.ndarray, truth: np.ndarray) -> str:
        """Return `name`; for angles, add their median, which is robust to outliers."""
        if not self.is_angle or values.shape != truth.shape or values.size == 0:
            return self.name
        return f"{self.name}; median {self.text(float(np.median(self._angles(values, truth))))}"

    def _angles(self, values: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Return the angle between the vectors of each cell, in degrees."""
        vectors, reference = (self._vectors(self._unknown(x)) for x in (values, truth))
        lengths = np.linalg.norm(vectors, axis=-1) * np.linalg.norm(reference, axis=-1)
        cross = np.linalg.norm(np.cross(vectors, reference), axis=-1)
        angles = np.degrees(np.arctan2(cross, np.sum(vectors * reference, axis=-1)))
        return np.where(lengths > _SHORTEST, angles, 90.0)

    def _vectors(self, x: np.ndarray) -> np.ndarray:
        vectors = np.asarray(x, np.float64)
        vectors = vectors if vectors.ndim > 1 else vectors.reshape(-1, 3)
        return 2.0 * vectors - 1.0 if self.role == "normal" else vectors

    def _unknown(self, x: np.ndarray) -> np.ndarray:
        return periodic.interior(x, self.repeated)

    def record(self) -> dict[str, Any]:
        """Return the measure as JSON types, the inverse of `from_record`."""
        return asdict(self)


def _fitted(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return each vector of the last axis times the factor that brings it closest to the true one."""
    vectors, reference = (np.asarray(x, np.float64) for x in (values, truth))
    products, squares = ((vectors * x).sum(axis=-1, keepdims=True) for x in (reference, vectors))
    return vectors * (products / np.maximum(squares, _SHORTEST**2))


PLAIN = ErrorMeasure()
"""Root mean square difference of all elements."""


def from_record(record: Any) -> ErrorMeasure:
    """Return the measure that `ErrorMeasure.record` describes, or `PLAIN` if the record is malformed or missing."""
    if not isinstance(record, Mapping):
        return PLAIN
    role, repeated = record.get("role", "value"), record.get("repeated", 0)
    if role not in get_args(Role) or type(repeated) is not int or not 0 <= repeated <= _MOST_COLUMNS:
        return PLAIN
    return ErrorMeasure(role, repeated)


def title(measures: Iterable[ErrorMeasure]) -> str:
    """Return the axis title of a chart of parameter errors."""
    roles = {"mean angle" if measure.is_angle else PLAIN.name for measure in measures}
    if roles <= {PLAIN.name}:
        return "Parameter error (RMSE)"
    return f"Parameter error ({'RMSE, or ' if PLAIN.name in roles else ''}mean angle in °)"
