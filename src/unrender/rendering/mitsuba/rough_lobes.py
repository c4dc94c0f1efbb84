"""Rough conductors with unknown roughness, which differential BSDF sampling supports, and their tables for the integrators."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.rendering.mitsuba.integrators.differential_bsdf import DISTRIBUTIONS, DifferentialBsdf
from unrender.rendering.mitsuba.scene_pair import ScenePair

_ROLES = ("alpha", "alpha_u", "alpha_v", "roughness")


class RoughLobes:
    """Roughness parameters that `DifferentialBsdf` supports: those of isotropic rough conductors, one-sided or two-sided with equal sides.

    Other parameters use standard BSDF sampling.

    Args:
        pair: both loads of the scene.
        keys: parameters with a derivative; None to disable differential sampling.
        geometric: whether parameters move shapes.

    Attributes:
        differential: sampler of the BSDF derivatives; None if disabled.
        tables: {"rough": entry of `DISTRIBUTIONS` by registry ids of the current scene's BSDFs, 0 for others and at the end}, or empty.

    Raises `InputError` if no parameter is supported, with the reason for each roughness, and in scenes that other kernels trace: with
    media, or with moving shapes.
    """

    def __init__(self, pair: ScenePair, keys: Sequence[str] | None, geometric: bool):
        self.differential: DifferentialBsdf | None = None
        self.tables: dict[str, Any] = {}
        if keys is None:
            return
        if pair.volumetric or geometric:
            reason_of_scene = "the scene has media" if pair.volumetric else "a parameter moves shapes"
            raise InputError(f"differential_bsdf: {reason_of_scene}, which it does not support; leave it out")
        kinds, reasons = {}, []
        for key in keys:
            bsdf, kind, reason = _lobe(pair.current_parameters, key)
            if bsdf is not None:
                kinds[int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf)).numpy()[0])] = kind  # pyright: ignore[reportAttributeAccessIssue]
            elif reason:
                reasons.append(f"{key} {reason}")
        if not kinds:
            raise InputError(
                "differential_bsdf: expected the alpha of an isotropic roughconductor, bare or two-sided, among the parameters: "
                + ("; ".join(reasons) or f"got {', '.join(keys)}")
            )
        table = np.zeros(max(kinds) + 2, np.uint32)
        for number, kind in kinds.items():
            table[number] = DISTRIBUTIONS[kind][0]
        self.differential, self.tables = (
            DifferentialBsdf(dict.fromkeys(kinds.values())),
            {"rough": arrays.owned(table, mi.UInt32)},
        )


def _lobe(parameters: mi.SceneParameters, key: str) -> tuple[Any, str, str]:
    """Return (outermost BSDF, name of the distribution, "") of a supported roughness; else (None, "", reason), with "" for other
    parameters."""
    if key not in parameters.properties or not set(key.split(".")) & set(_ROLES):
        return None, "", ""
    node, chain = parameters.properties[key][2], []
    while node is not None and node in parameters.hierarchy:
        chain.append(node)
        node = parameters.hierarchy[node][0]
    bsdfs = [node for node in chain if isinstance(node, mi.BSDF)]
    names = [bsdf.class_name() for bsdf in bsdfs]
    if not bsdfs:
        return None, "", ""
    if names[0] != "RoughConductor":
        return None, "", f"belongs to another BSDF ({names[0]})"
    if names[1:] not in ([], ["TwoSidedBRDF"]):
        return None, "", f"is inside a {names[1]}"
    if "alpha" not in key.split("."):
        return None, "", "is anisotropic"
    if any(name.startswith("brdf_1.") for name in mi.traverse(bsdfs[-1]).keys()):  # noqa: SIM118 (iterating gives pairs)
        return None, "", "belongs to one of two different sides"
    kind = re.search(r"distribution = (\w+)", str(bsdfs[0]))
    if kind is None or kind.group(1) not in DISTRIBUTIONS:
        return None, "", "has a distribution that is neither GGX nor Beckmann's"
    return bsdfs[-1], kind.group(1), ""
