"""Parameters of photographs around the renderer of a scene: response, exposure, vignetting and camera poses."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.camera_poses import POSES, PosedCameras
from unrender.rendering.exposure import EXPOSURE, VIGNETTING, ExposedRenderer, VignettedRenderer
from unrender.rendering.expressions import ExpressionRenderer
from unrender.rendering.picture_factors import WithParameter
from unrender.rendering.renderer import Renderer
from unrender.rendering.response import RESPONSE, RespondingRenderer
from unrender.rendering.tied import TiedRenderer
from unrender.rendering.worlds import WorldsRenderer
from unrender.rendering.wrapper import layers, unwrapped

OF_PHOTOGRAPHS = (POSES, VIGNETTING, EXPOSURE, RESPONSE)
"""Keys of the photographs' parameters, from the innermost renderer to the outermost. No scene has these keys."""


def check_response(names: Collection[str]) -> None:
    """Raise `InputError` if both the response and the exposures are unknown."""
    if RESPONSE in names and EXPOSURE in names:
        raise InputError(
            f"{RESPONSE}: if {EXPOSURE} is unknown too, the response is undetermined up to a power of radiance; leave out one"
        )


def scene_renderer(renderer: Renderer) -> Renderer:
    """Return the renderer of the scene alone, without ties, expressions, parameters of photographs and worlds of single views."""
    return unwrapped(renderer, (WithParameter, TiedRenderer, ExpressionRenderer, WorldsRenderer))


def scene_members(renderer: Renderer, key: str) -> list[str]:
    """Return the keys of the scene's parameters that an unknown sets: its own, those of its tie, or those of its expressions."""
    keys = [key]
    for layer in layers(renderer):
        if isinstance(layer, (TiedRenderer, ExpressionRenderer)):
            keys = layer.expanded(keys)
    return keys


def member_values(renderer: Renderer, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the values with each tie replaced by its members, and unknowns of expressions by the parameters that depend on them."""
    base = unwrapped(renderer, WithParameter)
    expanded = dict(values)
    while isinstance(base, (TiedRenderer, ExpressionRenderer)):
        expanded, base = base.scene_values(expanded), base.inner
    return expanded


def sensors_with_rows(renderer: Renderer) -> tuple[int, ...] | None:
    """Return the indices of the sensors that have rows of exposures or poses, in the order of the rows; None if there are no such rows."""
    wrappers = (layer for layer in layers(renderer) if isinstance(layer, (ExposedRenderer, PosedCameras)))
    return next((tuple(layer.rows) for layer in wrappers), None)


def with_photographs(renderer: Renderer, keys: Collection[str], sensors: Sequence[int]) -> Renderer:
    """Return the renderer with the parameters of photographs that are among the keys.

    Args:
        renderer: renderer of a scene, with or without these parameters. If it has them and its rows include all `sensors`, it is returned
            unchanged: the views are a subset of its views.
        sensors: indices of the views' sensors.

    Raises:
        InputError: the keys include the poses, and a sensor cannot be moved or there are fewer than 3. Or they include both response and
            exposure.
    """
    check_response(keys)
    camera_keys = [key for key in OF_PHOTOGRAPHS if key in keys]
    if not camera_keys:
        return renderer
    rows = sensors_with_rows(renderer)
    if set(camera_keys) <= renderer.parameters().keys() and (rows is None or set(rows) >= set(sensors)):
        return renderer
    wrapped = unwrapped(renderer, WithParameter)
    if POSES in camera_keys:
        wrapped = PosedCameras(wrapped, list(sensors))
    if VIGNETTING in camera_keys:
        wrapped = VignettedRenderer(wrapped)
    if EXPOSURE in camera_keys:
        wrapped = ExposedRenderer(wrapped, sensors)
    return RespondingRenderer(wrapped) if RESPONSE in camera_keys else wrapped


def scene_values(renderer: Renderer, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the values that a scene can store: camera poses and the members of ties, without response, exposure and vignetting."""
    scene = {key: value for key, value in values.items() if key not in OF_PHOTOGRAPHS}
    for layer in layers(renderer):
        if isinstance(layer, PosedCameras) and POSES in values:
            scene |= layer.corrections.poses(np.asarray(values[POSES]))
    return member_values(renderer, scene)
