"""What photographs have beside a scene: response, exposure, vignetting and corrections of their cameras' poses, around a renderer."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.camera_poses import POSES, PosedCameras
from unrender.rendering.exposure import EXPOSURE, ExposedRenderer
from unrender.rendering.picture_factors import WithParameter
from unrender.rendering.renderer import Renderer
from unrender.rendering.response import RESPONSE, RespondingRenderer
from unrender.rendering.tied import TiedRenderer
from unrender.rendering.vignetting import VIGNETTING, VignettedRenderer

__all__ = [
    "OF_PHOTOGRAPHS",
    "check_response",
    "member_values",
    "scene_renderer",
    "scene_values",
    "sensors_with_rows",
    "with_photographs",
]

OF_PHOTOGRAPHS = (POSES, VIGNETTING, EXPOSURE, RESPONSE)
"""Keys of parameters that no scene has, from the inside out."""


def check_response(names: Collection[str]) -> None:
    """Raise `InputError` where exposures are unknown beside a response."""
    if RESPONSE in names and EXPOSURE in names:
        raise InputError(
            f"{RESPONSE}: with {EXPOSURE} unknown, too, a response is undetermined up to a power of radiance; leave out one of them"
        )


def scene_renderer(renderer: Renderer) -> Renderer:
    """Return what renders the scene alone, without ties and parameters of photographs."""
    renderer = _without_photographs(renderer)
    return renderer.inner if isinstance(renderer, TiedRenderer) else renderer


def member_values(renderer: Renderer, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the values with the members of ties in place of these."""
    base = _without_photographs(renderer)
    return base.scene_values(values) if isinstance(base, TiedRenderer) else dict(values)


def _without_photographs(renderer: Renderer) -> Renderer:
    while isinstance(renderer, WithParameter):
        renderer = renderer.inner
    return renderer


def sensors_with_rows(renderer: Renderer) -> tuple[int, ...] | None:
    """The sensors that have exposures or corrections, in the order of their rows; None where none has."""
    while isinstance(renderer, WithParameter):
        if isinstance(renderer, (ExposedRenderer, PosedCameras)):
            return tuple(renderer.rows)
        renderer = renderer.inner
    return None


def with_photographs(renderer: Renderer, keys: Collection[str], sensors: Sequence[int]) -> Renderer:
    """The renderer with those parameters of photographs that are among the keys.

    Args:
        renderer: of a scene; or one that has these parameters, whose rows are kept where `sensors` are among them: they are of some of its
            views then.
        keys: of all parameters.
        sensors: of the views.

    Raises:
        InputError: poses are among the keys, and the sensors cannot be moved; or both response and exposure are.
    """
    check_response(keys)
    wanted = [key for key in OF_PHOTOGRAPHS if key in keys]
    if not wanted:
        return renderer
    rows = sensors_with_rows(renderer)
    if set(wanted) <= renderer.parameters().keys() and (rows is None or set(rows) >= set(sensors)):
        return renderer
    found = _without_photographs(renderer)
    if POSES in wanted:
        found = PosedCameras(found, list(sensors))
    if VIGNETTING in wanted:
        found = VignettedRenderer(found)
    if EXPOSURE in wanted:
        found = ExposedRenderer(found, sensors)
    return RespondingRenderer(found) if RESPONSE in wanted else found


def scene_values(renderer: Renderer, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the values that a scene can hold: without response, exposures and vignetting, with the poses of its cameras and all members of
    ties."""
    found = {key: value for key, value in values.items() if key not in OF_PHOTOGRAPHS}
    while isinstance(renderer, WithParameter):
        if isinstance(renderer, PosedCameras) and POSES in values:
            found |= renderer.corrections.poses(np.asarray(values[POSES]))
        renderer = renderer.inner
    return renderer.scene_values(found) if isinstance(renderer, TiedRenderer) else found
