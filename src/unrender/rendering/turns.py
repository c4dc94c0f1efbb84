"""Views of one scene that know different rotations of its distant lights, as sensors of one scene: they share launches."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.rendering.renderer import Renderer
from unrender.rendering.worlds import WorldsRenderer
from unrender.rendering.wrapper import RendererWrapper

_ROTATION = "rotation"
Vector = tuple[float, ...]


@dataclass(frozen=True)
class Turns:
    """Rotations of distant lights for each sensor of a scene.

    Attributes:
        sensors: index of the described sensor that each sensor repeats; the described sensors come first, in their order.
        rotations: (id of a light, its rotation vector for each sensor, in radians).
    """

    sensors: tuple[int, ...]
    rotations: tuple[tuple[str, tuple[Vector, ...]], ...]


@runtime_checkable
class TurnsLights(Protocol):
    """A renderer whose distant lights can have a rotation for each sensor.

    Attributes:
        turns: the present rotations; None for the lights as described.
        turnable: ids of the lights that can be turned.
    """

    turns: Turns | None
    turnable: Collection[str]

    def with_turns(self, turns: Turns | None, keys: Collection[str]) -> Renderer:
        """Return a renderer of the same scene with these rotations, for the parameters `keys`."""
        ...


def turns_of(
    renderer: TurnsLights, count: int, worlds: Sequence[tuple[int, Mapping[str, Any]]], keys: Collection[str]
) -> tuple[Turns, list[int]] | None:
    """Return rotations for which each view is a sensor, and the sensors of the views; None if views differ by more or by nothing.

    `worlds` are described sensor (of `count`) and known values of each view; unknown `keys` cannot be turned too.
    """
    lights = list(dict.fromkeys(key.rpartition(".")[0] for _, known in worlds for key in known))
    poses = {f"{light}.{name}" for light in lights for name in (_ROTATION, *(f"{_ROTATION}.{axis}" for axis in "xyz"))}
    turned = all(key.endswith(f".{_ROTATION}") and _is_vector(x) for _, known in worlds for key, x in known.items())
    others = {*poses, *(f"{light}.to_world" for light in lights)}
    if not lights or not turned or not set(lights) <= set(renderer.turnable) or others & set(keys):
        return None
    still = (0.0, 0.0, 0.0)
    rows: list[tuple[Vector, ...] | None] = [None] * count
    sensors, located = list(range(count)), []
    for sensor, known in worlds:
        row = tuple(tuple(map(float, known.get(f"{light}.{_ROTATION}", still))) for light in lights)
        same = (n for n, own in enumerate(sensors) if own == sensor and rows[n] in (None, row))
        if (index := next(same, None)) is None:
            index = len(sensors)
            sensors.append(sensor)
            rows.append(row)
        rows[index] = row
        located.append(index)
    full = [(still,) * len(lights) if row is None else row for row in rows]
    return Turns(
        tuple(sensors), tuple((light, tuple(row[n] for row in full)) for n, light in enumerate(lights))
    ), located


def with_scene(renderer: Renderer, scene: Renderer) -> Renderer:
    """Return the wrappers of a renderer, without worlds, around another renderer of its scene."""
    if isinstance(renderer, WorldsRenderer):
        return with_scene(renderer.inner, scene)
    return renderer.around(with_scene(renderer.inner, scene)) if isinstance(renderer, RendererWrapper) else scene


def _is_vector(value: Any) -> bool:
    try:
        vector = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return False
    return vector.shape == (3,) and bool(np.isfinite(vector).all())
