"""Views that see other values or other scenes than the problem's, as sensors of one renderer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words, listed
from unrender.io import parameter_values
from unrender.io.toml_lines import FieldError
from unrender.rendering import AOVS
from unrender.rendering.expressions import are_storable, expression_layer
from unrender.rendering.photographs import scene_members, scene_renderer
from unrender.rendering.picture_format import AovRenderer
from unrender.rendering.renderer import ParameterInfo, Renderer
from unrender.rendering.turns import TurnsLights, turns_of, with_scene
from unrender.rendering.worlds import World, with_worlds, worlds_of
from unrender.scene.references import View
from unrender.scene.view_checks import check_sensor


def known_keys(views: Sequence[View]) -> list[str]:
    """Return the names for which at least one view has its own value."""
    held = [key for view in views if isinstance(view.known, Mapping) for key in view.known]
    return list(dict.fromkeys(key for key in held if isinstance(key, str)))


def of_views(
    renderer: Renderer, views: Sequence[View], keys: Sequence[str], opened: Callable[[Any], Renderer]
) -> tuple[Renderer, tuple[View, ...]]:
    """Return a renderer in which each view's world is a sensor, and the views with these sensors.

    `opened` is the function from a scene to its renderer; called once for equal scenes. Raises `FieldError` if a sensor, key or value is
    invalid, or a scene has none of the unknown keys.
    """
    for index, view in enumerate(views):
        if isinstance(view.known, Mapping) and not all(isinstance(key, str) for key in view.known):
            what = f"expected values by key of the scene, got {in_words(view.known)}"
            raise FieldError(("views", index, "with"), what, f"view {index}: known")
    renderer, sensors = _turned(renderer, views, keys)
    if sensors:
        return renderer, tuple(
            replace(view, sensor=sensor, known=None) for view, sensor in zip(views, sensors, strict=True)
        )
    scenes: list[tuple[Any, Renderer]] = []
    worlds: dict[int, World] = {}
    for index, view in enumerate(views):
        own = scene_renderer(renderer)
        if not view.own_world:
            continue
        if view.scene is not None:
            own = next((made for scene, made in scenes if scene is view.scene or _equal(scene, view.scene)), None)
            if own is None:
                own = _opened(index, view, keys, scene_renderer(renderer), opened)
                scenes.append((view.scene, own))
            check_sensor(index, view, len(own.resolutions()))
        if view.aov is not None:
            own = _with_aov(index, view.aov, own)
        worlds[index] = World(
            own, view.sensor, _values(index, {} if view.known is None else view.known, own.parameters(), keys)
        )
    made, sensors = with_worlds(renderer, list(worlds.values()), len(worlds) < len(views))
    located = dict(zip(worlds, sensors, strict=True))
    return made, tuple(
        replace(view, sensor=located[index], known=None, scene=None, aov=None) if index in located else view
        for index, view in enumerate(views)
    )


def _turned(renderer: Renderer, views: Sequence[View], keys: Sequence[str]) -> tuple[Renderer, list[int]]:
    """Return a renderer in which each view is a sensor, and these sensors, if views differ by rotations of distant lights alone.

    Otherwise the lights are as described, and there are no sensors.
    """
    own = scene_renderer(renderer)
    turns = own.turns if isinstance(own, TurnsLights) else None
    count = len(set(turns.sensors)) if turns else len(own.resolutions())
    for index, view in enumerate(views):
        if view.scene is None:
            check_sensor(index, view, count)
    if not isinstance(own, TurnsLights):
        return renderer, []
    alike = all(
        view.scene is None and view.aov is None and isinstance({} if view.known is None else view.known, Mapping)
        for view in views
    )
    layer = expression_layer(renderer)
    used = [*keys, *(() if layer is None else (one.key for one in layer.expressions))]
    found = turns_of(own, count, [(view.sensor, view.known or {}) for view in views], used) if alike else None
    if found and len(found[0].sensors) > count:  # a copy of a sensor does not follow unknowns of its camera
        known = {**own.parameters(), **renderer.parameters()}
        if any(key in known and known[key].viewpoint for key in used):
            found = None
    turned = own.with_turns(None if found is None else found[0], used)
    return renderer if turned is own else with_scene(renderer, turned), [] if found is None else found[1]


def is_storable(renderer: Renderer, views: Sequence[View]) -> bool:
    """Return whether a problem file can contain the expressions of a renderer and the scenes of views."""
    return are_storable(renderer) and all(v.scene is None or isinstance(v.scene, (str, Path)) for v in views)


def requested_depth(renderer: Renderer, views: Sequence[View], max_depth: int) -> int | None:
    """Return the `max_depth` with which the scenes of views are opened again: None if each view's own scene has its integrator's."""
    own = any(view.scene is not None for view in views)
    return getattr(scene_renderer(renderer), "requested_depth", max_depth) if own else max_depth


def check_determined(
    views: Sequence[View], located: Sequence[View], renderer: Renderer, unknowns: Sequence[str]
) -> None:
    """Raise `FieldError` for an unknown on which no view depends. Arguments as for `unseen`; `unknowns` are keys, in order."""
    for index, key in enumerate(unknowns):
        reasons = unseen(views, located, renderer, key)
        if not all(map(all, reasons)):
            continue
        if all(reason == _KNOWN for of_view in reasons for reason in of_view):
            what = f"{key} is known in all views, so none determines it; leave it out of one, or of the unknowns"
            raise FieldError(("views", 0, "with"), what, "view 0: known")
        shown = dict.fromkeys(f"view {n} {of_view[0]}" for n, of_view in enumerate(reasons))
        what = f"no view depends on {key}: {listed(list(shown))}; add a view that does, or leave it out of the unknowns"
        raise FieldError(("parameters", index, "key"), what)


def unseen(views: Sequence[View], located: Sequence[View], renderer: Renderer, key: str) -> list[list[str]]:
    """Return, for each view and each parameter of the scene that an unknown sets, why the view does not depend on it; "" if it may.

    Args:
        views: Views as passed.
        located: Views with the sensors of `renderer`, see `of_views`.
        renderer: Renderer with all wrappers.
        key: Key of the unknown. All views depend on one of photographs.
    """
    members = scene_members(renderer, key)
    if not all(member in scene_renderer(renderer).parameters() for member in members):
        return [[""] for _ in views]
    states = worlds_of(renderer, [view.sensor for view in located])
    return [[_unseen(member, *pair) for member in members] for pair in zip(views, states, strict=True)]


_KNOWN = "knows it"


def _unseen(member: str, view: View, world: World) -> str:
    """Return the reason why a view does not depend on a parameter of the scene; "" if it may."""
    known = world.renderer.parameters()
    if member in (view.known or {}):
        return _KNOWN
    if member not in known:
        return "has a scene without it"
    if not known[member].shown:
        return f"has the aov {view.aov}, which does not show it"
    sensor = known[member].sensor
    return "" if sensor in (None, world.sensor) else f"has sensor {world.sensor}, and it moves sensor {sensor}"


def _equal(one: Any, other: Any) -> bool:
    return isinstance(one, (str, Path)) and isinstance(other, (str, Path)) and Path(one) == Path(other)


def _opened(
    index: int, view: View, keys: Sequence[str], first: Renderer, opened: Callable[[Any], Renderer]
) -> Renderer:
    place = ("views", index, "scene")
    try:
        own = scene_renderer(opened(view.scene))
    except FieldError as error:
        raise FieldError(place, error.what, f"view {index}: scene") from error
    known, others = own.parameters(), first.parameters()
    if not any(key in known for key in keys):
        raise FieldError(place, f"it has none of the unknowns, such as {keys[0]}", f"view {index}: scene")
    for key in keys:
        if key in known and key in others and known[key].shape != others[key].shape:
            what = f"{key} has the shape {known[key].shape} there, {others[key].shape} in the problem's scene"
            raise FieldError(place, what, f"view {index}: scene")
    return own


def _with_aov(index: int, name: Any, own: Renderer) -> Renderer:
    place, owner = ("views", index, "aov"), f"view {index}: aov"
    if not isinstance(name, str) or name not in AOVS:
        raise FieldError(place, f"expected one of {', '.join(AOVS)}, got {in_words(name)}", owner)
    if isinstance(own, AovRenderer):
        with FieldError.at(place, owner):
            return own.with_aov(name)
    raise FieldError(place, "this renderer has radiance only; leave it out", owner)


def _values(
    index: int, known_values: Any, known: Mapping[str, ParameterInfo], unknowns: Sequence[str]
) -> dict[str, np.ndarray]:
    place, owner = ("views", index, "with"), f"view {index}: known"
    if not isinstance(known_values, Mapping):
        raise FieldError(place, f"expected a table of values by key, got {in_words(known_values)}", owner)
    values = {}
    for key, value in known_values.items():
        if key not in known:
            derived = "; give the parameters of the scene that this unknown sets" if key in unknowns else ""
            what = f"the scene has no parameter {key}{derived or did_you_mean(str(key), known)}"
            raise FieldError(place, what, owner)
        info = known[key]
        if not info.perturbable:
            raise FieldError(place, f"{key} cannot have a value of its own: {info.reason}", owner)
        try:
            filled, _ = parameter_values.fill(value, info.shape, info.conversion)
        except InputError as error:
            raise FieldError(place, f"{key}: {error}", owner) from error
        if not arrays.all_within(filled, info.lowest, info.highest):
            raise FieldError(
                place,
                f"{key}: expected {' and '.join(checks.limits(info.lowest, info.highest))}, got {in_words(value)}",
                owner,
            )
        values[key] = np.asarray(filled, np.float32)
    return values
