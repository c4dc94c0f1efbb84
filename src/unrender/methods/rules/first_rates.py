"""First learning rates of parameters from their ranges and sizes, and the choice of parameters to optimise as logarithms."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

from unrender.methods.rules.constants import CONSTANTS, Constants
from unrender.scene.bounds import MARGIN, open_scale
from unrender.scene.problem import Problem

_ALBEDO, _EXTINCTION, _NORMALS = ".albedo.", ".sigma_t.", ".normalmap."
"""Parts of keys of a medium's grids, and of a normal map."""
_TEXELS = ".data"
"""End of the key of a texture's data."""
_TEXTURE = 3
"""Dimensions of a texture, (H, W, C)."""


def logarithms(problem: Problem, constants: Constants = CONSTANTS) -> list[str]:
    """Return the keys of positive numbers, colours and textures without an upper bound: radiances, environment maps.

    Excluded are parameters with their own learning rate, which is in the parameter's units, and grids, parts of which may have to be 0.
    """
    return [
        key
        for key, unknown in problem.unknowns.items()
        if (low := unknown.bounds[0]) is not None
        and unknown.bounds[1] is None
        and unknown.learning_rate is None
        and unknown.parameterisation is None
        and (unknown.initial.ndim == _TEXTURE or _is_number(unknown.initial, constants))
        and (unknown.initial > low + constants.margins * MARGIN * open_scale(unknown.initial)).all()
    ]


def first_rates(problem: Problem, share: float, constants: Constants = CONSTANTS) -> Mapping[str, float]:
    """Return {key: first learning rate} of each parameter, `share` times its size.

    The size is the range between two bounds, else the root mean square of the initial values, or 1 if they are 0. It is divided by the
    root of the number of unknown textures of the same material, which share residuals and would together overshoot. For vertices it is
    `mesh_share` times the mesh's radius. Numbers with two bounds, normal maps, and albedos of media with an unknown extinction have a
    share of it (`Constants`). With a parameterisation, it is the size in u.
    """
    rates: dict[str, float] = {}
    initial = {key: unknown.initial for key, unknown in problem.unknowns.items()}
    materials = {key: _owner(key) for key, x in initial.items() if key.endswith(_TEXELS) and x.ndim == _TEXTURE}
    textures = Counter(materials.values())
    for key, unknown in problem.unknowns.items():
        value, (low, high) = unknown.initial, unknown.bounds
        if low is not None and high is not None:
            size = high - low
        else:
            size = float(np.sqrt(np.mean(np.square(value, dtype=np.float64)))) or 1.0
        if unknown.faces is not None:
            size = constants.mesh_share * _radius(value)
        if _ALBEDO in key and key.replace(_ALBEDO, _EXTINCTION) in problem.unknowns:
            size *= constants.albedo_share
        elif _is_number(value, constants) and low is not None and high is not None:
            size *= constants.number_share
        if _NORMALS in key:
            size *= constants.normals_share
        if key in materials:
            size /= math.sqrt(textures[materials[key]])
        if unknown.transform is not None:
            middle = (low + high) / 2 if low is not None and high is not None else (low or 0.0) + size
            size /= float(unknown.transform.slope(np.float64(middle)))
        rates[key] = share * size
    return rates


def _owner(key: str) -> str:
    """Return the material of a texture from the key of its data."""
    return key.rsplit(".", 2)[0]


def _is_number(value: np.ndarray, constants: Constants) -> bool:
    """Return whether it is a single number or a colour."""
    return value.ndim <= 1 and value.size <= constants.number_size


def _radius(positions: np.ndarray) -> float:
    """Return the root mean square distance of vertices (3 V,) from their mean; 1 if it is 0."""
    vertices = positions.reshape(-1, 3).astype(np.float64)
    return float(np.sqrt(np.mean(np.sum(np.square(vertices - vertices.mean(axis=0)), axis=1)))) or 1.0
