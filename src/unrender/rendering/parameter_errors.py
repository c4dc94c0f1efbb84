"""The error of a parameter, in terms of what its values stand for: numbers, normals or directions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from unrender.core import periodic

Role = Literal["value", "normal", "direction"]
"""What the values of a parameter stand for: numbers; a normal map, n = 2 x - 1; vectors of which the direction counts."""

_MOST_COLUMNS = 8
"""Repeated columns that a record may name."""
_SHORTEST = 1e-12
"""Length below which a vector has no direction; its angle counts as 90°."""


@dataclass(frozen=True)
class ErrorMeasure:
    """How far values are from the truth.

    Numbers have the root mean square difference. Normals and directions have the mean angle in degrees after normalisation, since images
    tell nothing of their lengths.

    Attributes:
        role: what the values stand for; arrays of normals and directions have the vectors' components last, or are flat.
        repeated: number of columns at each end that repeat others and do not count, see `core.periodic`.
    """

    role: Role = "value"
    repeated: int = 0

    @property
    def name(self) -> str:
        """What the error is, in a few words."""
        return "RMSE" if self.role == "value" else "mean angle"

    @property
    def unit(self) -> str:
        """The unit of the error, "" for that of the values."""
        return "" if self.role == "value" else "°"

    def text(self, error: float) -> str:
        """Return an error with its unit, to four digits."""
        return f"{error:.4g}{self.unit}"

    def error(self, values: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float | None:
        """Return the error over all elements, or over those cells where `where` holds; None where shapes differ or nothing is left.

        Args:
            values: of the parameter.
            truth: of the same shape.
            where: (...) without the last axis, truth values; None for everywhere.
        """
        if values.shape != truth.shape or values.size == 0:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            errors = self._squares(values, truth) if self.role == "value" else self._angles(values, truth)
        if where is not None:
            if where.ndim < 1 or values.shape[: where.ndim] != where.shape:
                return None
            errors = errors[self._unknown(where)]
        if errors.size == 0:
            return None
        mean = float(np.mean(errors, dtype=np.float64))
        return mean if self.role != "value" else float(np.sqrt(mean))

    def name_with_median(self, values: np.ndarray, truth: np.ndarray) -> str:
        """Return `name`, of angles with their median, which few wrong vectors do not move."""
        if self.role == "value" or values.shape != truth.shape or values.size == 0:
            return self.name
        return f"{self.name}; median {self.text(float(np.median(self._angles(values, truth))))}"

    def _squares(self, values: np.ndarray, truth: np.ndarray) -> np.ndarray:
        return np.square(self._unknown(values - truth), dtype=np.float64)

    def _angles(self, values: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """The angle between the vectors of each cell, in degrees."""
        found, wanted = (self._vectors(self._unknown(x)) for x in (values, truth))
        lengths = np.linalg.norm(found, axis=-1) * np.linalg.norm(wanted, axis=-1)
        across = np.linalg.norm(np.cross(found, wanted), axis=-1)
        angles = np.degrees(np.arctan2(across, np.sum(found * wanted, axis=-1)))
        return np.where(lengths > _SHORTEST, angles, 90.0)

    def _vectors(self, x: np.ndarray) -> np.ndarray:
        vectors = np.asarray(x, np.float64)
        vectors = vectors if vectors.ndim > 1 else vectors.reshape(-1, 3)
        return 2.0 * vectors - 1.0 if self.role == "normal" else vectors

    def _unknown(self, x: np.ndarray) -> np.ndarray:
        return periodic.interior(x, self.repeated)

    def record(self) -> dict[str, Any]:
        """Return the measure in JSON's types, see `from_record`."""
        return asdict(self)


PLAIN = ErrorMeasure()
"""The root mean square difference of all elements."""


def from_record(given: Any) -> ErrorMeasure:
    """Return the measure that `ErrorMeasure.record` describes; the plain one for what is malformed or missing."""
    if not isinstance(given, Mapping):
        return PLAIN
    role, repeated = given.get("role", "value"), given.get("repeated", 0)
    if role not in get_args(Role) or type(repeated) is not int or not 0 <= repeated <= _MOST_COLUMNS:
        return PLAIN
    return ErrorMeasure(role, repeated)


def title(measures: Iterable[ErrorMeasure]) -> str:
    """Return what the axis of a chart of parameter errors is."""
    roles = {measure.name for measure in measures}
    if roles <= {PLAIN.name}:
        return "Parameter error (RMSE)"
    return f"Parameter error ({'RMSE, or ' if PLAIN.name in roles else ''}mean angle in °)"
