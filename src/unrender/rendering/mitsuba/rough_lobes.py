"""The rough conductors whose roughness is unknown: which parameters these are, and how integrators know them."""

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
    """The parameters that are the roughness of an isotropic rough conductor, bare or two-sided with the same on both sides: what
    `DifferentialBsdf` serves. Others are differentiated like everything else.

    Args:
        pair: both loads of the scene.
        keys: the parameters with a derivative; None where nothing is sampled so.
        geometric: whether parameters move shapes.

    Attributes:
        differential: what samples them, None where nothing is sampled so.
        tables: {"rough": by registry ids of the current scene's BSDFs the entry of `DISTRIBUTIONS`, 0 for others; the last entry is 0}, or
            nothing.

    Raises `InputError` where none is served, with the reason for each roughness, and where other kernels trace the paths: in media, and
    where shapes move.
    """

    def __init__(self, pair: ScenePair, keys: Sequence[str] | None, geometric: bool):
        self.differential: DifferentialBsdf | None = None
        self.tables: dict[str, Any] = {}
        if keys is None:
            return
        if pair.volumetric or geometric:
            why = "the scene has media" if pair.volumetric else "a parameter moves shapes"
            raise InputError(f"differential_bsdf: {why}, where roughness is not sampled so: leave it out")
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
    """(the outermost BSDF, name of the distribution, "") of a roughness that is served; else (None, "", why), "" for others."""
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
        return None, "", f"lies under {names[1]}"
    if "alpha" not in key.split("."):
        return None, "", "is anisotropic"
    if any(name.startswith("brdf_1.") for name in mi.traverse(bsdfs[-1]).keys()):  # noqa: SIM118 (iterating gives pairs)
        return None, "", "lies on one side of two that differ"
    kind = re.search(r"distribution = (\w+)", str(bsdfs[0]))
    if kind is None or kind.group(1) not in DISTRIBUTIONS:
        return None, "", "has a distribution that is neither GGX nor Beckmann's"
    return bsdfs[-1], kind.group(1), ""
