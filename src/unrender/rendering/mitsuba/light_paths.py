"""Depth, Russian roulette and emitter visibility of light paths, from the settings of a scene's integrator."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from unrender.core.errors import InputError
from unrender.rendering.mitsuba.scene_graph import children, class_name

DEFAULT_DEPTH = 6
"""Default maximum path length in segments, if neither the user nor the scene gives one."""
LONGEST_DEPTH = 64
"""Maximum path length in segments for a scene whose integrator has no limit."""
_ROULETTE = 5

_OF_SURFACES = ("PathIntegrator", "DirectIntegrator", "PRBIntegrator", "BasicPRBIntegrator")
"""Integrators that ignore media."""
_SAME = (
    *_OF_SURFACES,
    "PathProjectiveIntegrator",
    "DirectProjectiveIntegrator",
    "VolumetricSimplePathIntegrator",
    "VolumetricPathIntegrator",
    "VolumetricMisPathIntegrator",
    "PRBVolpathIntegrator",
)
"""Integrators whose light paths equal those of this package."""
_VOLUMETRIC = _SAME[-4:]
"""Integrators for participating media. They do not count segments that end on masks and null surfaces."""
_DIRECT = ("DirectIntegrator", "DirectProjectiveIntegrator")
_NESTING = ("AOVIntegrator", "MomentIntegrator")
_UNLIMITED = 2**31


@dataclass(frozen=True)
class LightPaths:
    """Settings of the light paths.

    Attributes:
        max_depth: maximum path length in segments, >= 1.
        rr_depth: depth from which Russian roulette may terminate a path, >= 1.
        hide_emitters: whether emitters are invisible to camera rays.
        aov: property of the first surface that is rendered in place of radiance, see `AovKernel`; "" for radiance.
        notices: one line for each setting of the scene that is not used.
    """

    max_depth: int = DEFAULT_DEPTH
    rr_depth: int = _ROULETTE
    hide_emitters: bool = False
    aov: str = ""
    notices: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: mi.Scene, volumetric: bool, max_depth: int | None) -> LightPaths:
        """Return the settings of a scene, with the scene's own depth if `max_depth` is None. Raises `InputError` if emitters are hidden in
        a scene with media."""
        integrator = scene.integrator()
        if integrator is None:
            return cls(max_depth or DEFAULT_DEPTH)
        integrator = _light_transport(integrator)
        kind, text = _kind(integrator), str(integrator)
        requested, own = max_depth, _depth(kind, text)
        if max_depth is None:
            max_depth = min(own or DEFAULT_DEPTH, LONGEST_DEPTH if own == _UNLIMITED else _UNLIMITED)
        hidden = bool(getattr(integrator, "hide_emitters", False))
        if hidden and volumetric:
            raise InputError("hide_emitters is not supported with participating media; leave it out")
        notices = _notices(kind, own, requested, max_depth, volumetric)
        return cls(max_depth, max(1, _number("rr_depth", text) or _ROULETTE), hidden, notices=notices)


def _notices(kind: str, own: int | None, requested: int | None, max_depth: int, volumetric: bool) -> tuple[str, ...]:
    depth = "" if own is None else f", max_depth {'unlimited' if own == _UNLIMITED else own}"
    if kind not in _SAME:
        reason = "as max_depth says" if requested is not None else "give max_depth for another number"
        return (f"the scene's integrator ({kind}{depth}) is not used: paths have up to {max_depth} segments, {reason}",)
    notices = []
    if requested is not None and own != requested:
        notices.append(
            f"the scene's integrator ({kind}{depth}) is not used: paths have up to {max_depth} segments, as max_depth says"
        )
    if requested is None and own == _UNLIMITED:
        notices.append(
            f"the scene's integrator ({kind}) has no limit of depth: paths have up to {max_depth} segments; "
            "give max_depth for another number"
        )
    if volumetric and kind in _OF_SURFACES:
        notices.append(f"the scene's integrator ({kind}) ignores participating media, which are rendered here")
    return tuple(notices)


def mask_notices(scene: mi.Scene, bsdfs: Iterable[Any], keys: Collection[str]) -> list[str]:
    """Return one notice for a scene whose references Mitsuba's path integrator may render too dark.

    In Mitsuba 3.9.1 `path` returns 0 for a path that passes through surfaces alone and leaves the scene, unless it shows an environment.
    So light that a mask reflects is lost where such a path passes through it. `prb`, `volpath` and `direct` count it.
    """
    integrator = scene.integrator()
    traced = integrator if integrator is None else _light_transport(integrator)
    if traced is not None and _kind(traced) != "PathIntegrator":
        return []
    if scene.environment() is not None and not getattr(traced, "hide_emitters", False):
        return []
    masks = [mi.traverse(bsdf) for bsdf in bsdfs if bsdf.class_name() == "MaskBSDF"]
    opacities = [np.array(mask[key]) for mask in masks for key in ("opacity.value", "opacity.data") if key in mask]
    values = [value / 255.0 if value.dtype == np.uint8 else value for value in opacities]
    unknown = masks and any(key.split(".")[-2:][0] == "opacity" for key in keys)
    if not unknown and not any(((value > 0) & (value < 1)).any() for value in values):
        return []
    return [
        "Mitsuba's path integrator renders masks with nothing behind them too dark: it drops the light that they reflect; render "
        "references with prb"
    ]


def null_notices(scene: mi.Scene, bsdfs: Iterable[Any], volumetric: bool, max_depth: int) -> list[str]:
    """Return one notice if the scene's integrator counts fewer segments than the kernel for scenes without participating media."""
    integrator = scene.integrator()
    kind = "" if integrator is None else _kind(_light_transport(integrator))
    passed = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)
    if volumetric or kind not in _VOLUMETRIC or not passed or max_depth >= LONGEST_DEPTH:
        return []
    return [
        f"the scene's integrator ({kind}) does not count segments that end on masks and null surfaces, which count here; "
        "render references with prb, or give a larger max_depth"
    ]


def _light_transport(integrator: Any) -> Any:
    """Return the integrator that traces paths: the innermost first one of nesting integrators."""
    while _kind(integrator) in _NESTING and (inner := children(integrator)):
        integrator = inner[0][1]
    return integrator


def _kind(integrator: Any) -> str:
    """Return the name of the class. Those of Mitsuba's own integrators in Python are in the description alone."""
    name = class_name(integrator)
    return name if name in _NESTING else str(integrator).partition("[")[0].strip()


def _depth(kind: str, text: str) -> int | None:
    """Return the maximum path length in segments: `_UNLIMITED` without a limit, None if it is unknown."""
    if kind in _DIRECT:
        return 2
    depth = _number("max_depth", text)
    return _UNLIMITED if depth is not None and not 0 <= depth < _UNLIMITED else depth


def _number(name: str, text: str) -> int | None:
    match = re.search(rf"\b{name}\s*=\s*(-?\d+)", text)
    return int(match[1]) if match else None
