"""Lights, shapes and children of blends that equal each other but for unknowns, so that a run may end with each in the other's place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from unrender.core.text import listed
from unrender.methods.rules.traits import Traits
from unrender.rendering.renderer import ParameterInfo
from unrender.scene.bounds import ends_of
from unrender.scene.problem import Problem

_MOTIONS = ("translation", "rotation", "scale")
"""Parts of the keys of poses, after the name of what they move."""
_WEIGHT, _CHILDREN = ".weight.", ("bsdf", "phase")
"""Part of the key of a blend's weight; prefixes of the names of its children, such as bsdf_0."""
_POSITION = "position"  # last part of the keys of positions of lights without a pose
_NORMALS, _TRANSFORM, _ROUNDING = "_normals", "to_", 1e-4
"""Last part of the keys of normals, and its beginning for transforms, which are not compared; largest difference of equal positions,
relative to a shape's size."""


def exchangeable(traits: Traits) -> list[str]:
    """Return a line about lights or shapes that may end in each other's place; [] for none.

    The loss there may exceed that of the truth by less than noise, so pictures of other starts do not tell (`shapes.lights`).
    """
    place = "may end in each other's place, where the picture is nearly the same; the start decides"
    alike = _names(exchangeable_pairs(traits.problem, shapes=True))
    return [f"{listed(alike)} {place}"] if alike else []


def exchangeable_lights(problem: Problem) -> list[str]:
    """Return the names of lights that another light of the same kind equals but for the unknown coordinates of its pose or position."""
    return _names(exchangeable_pairs(problem))


def exchangeable_pairs(problem: Problem, shapes: bool = False) -> list[tuple[str, str]]:
    """Return the pairs of the names of such lights; with `shapes`, also shapes of equal form and material at unknown places."""
    infos = problem.renderer.parameters()
    moved: dict[str, set[str]] = {}
    for key in problem.shapes():
        if (name := _moved(infos, key, shapes)) is not None:
            moved.setdefault(name, set()).add(key.removeprefix(name))
    return [pair for pair in combinations(moved, 2) if _alike(problem, *pair, moved)]


def exchangeable_children(problem: Problem) -> dict[tuple[str, str], str]:
    """Return {names of the children: key of the weight w} of blends whose children equal each other but for unknowns of both.

    Exchanged, with 1 − w in place of w, they give the same picture, unless bounds keep w on one side of a half.
    """
    infos, unknown = problem.renderer.parameters(), problem.shapes()
    found: dict[tuple[str, str], str] = {}
    for weight in (key for key in unknown if _WEIGHT in key):
        low, high = ends_of(problem.unknowns[weight].bounds)
        if not low < 0.5 < high:
            continue
        for child in _CHILDREN:
            one, other = (f"{weight.partition(_WEIGHT)[0]}.{child}_{index}" for index in (0, 1))
            parts, others = ({key.removeprefix(x) for key in infos if key.startswith(f"{x}.")} for x in (one, other))
            if parts != others:
                continue
            pairs = [(one + part, other + part) for part in parts]
            unknowns = {sum(key in unknown for key in pair) for pair in pairs}
            if 2 in unknowns and 1 not in unknowns and _interchangeable(problem, pairs):
                found[one, other] = weight
    return found


def ambiguous_blends(problem: Problem) -> list[str]:
    """Return a line for each blend whose children may be exchanged, see `exchangeable_children`."""
    return [
        f"{listed(pair)}: the pictures are the same with each in the other's place, and 1 - x in place of {weight}; the start decides, so "
        "fix one of these, or narrow the weight's bounds to one side of a half"
        for pair, weight in exchangeable_children(problem).items()
    ]


def _names(pairs: Sequence[tuple[str, str]]) -> list[str]:
    return list(dict.fromkeys(name for pair in pairs for name in pair))


def _moved(infos: Mapping[str, ParameterInfo], key: str, shapes: bool) -> str | None:
    """Return the name of the light, or shape, that a parameter moves; None for others."""
    if infos[key].rigid:
        return owner(key) if infos[key].light or (shapes and infos[key].shape_pose) else None
    name, _, leaf = key.rpartition(".")
    shines = leaf == _POSITION and any(infos[k].brightness == "light" for k in infos if k.startswith(f"{name}."))
    return name if shines else None


def _alike(problem: Problem, one: str, other: str, moved: Mapping[str, set[str]]) -> bool:
    """Return whether two lights or shapes have the same unknown coordinates and parameters, and equal or unknown light or materials."""
    infos = problem.renderer.parameters()
    parts = [{key.removeprefix(name) for key in infos if key.startswith(f"{name}.")} for name in (one, other)]
    if moved[one] != moved[other] or parts[0] != parts[1]:
        return False
    shape = any(infos[one + part].shape_pose for part in moved[one])
    placed = any(part.startswith(f".{_MOTIONS[0]}") for part in moved[one])  # otherwise each turns at its own place
    if shape and (not placed or any(part.rpartition(".")[2].startswith(_TRANSFORM) for part in parts[0])):
        return False
    counted = [
        part for part in parts[0] if (infos[one + part].brightness == "light" or shape) and not infos[one + part].rigid
    ]
    pairs = [(one + part, other + part) for part in counted if not part.endswith(_NORMALS)]
    return _interchangeable(problem, pairs, [(one + part, other + part) for part in moved[one]])


def _interchangeable(problem: Problem, pairs: Sequence[tuple[str, str]], moved: Sequence[tuple[str, str]] = ()) -> bool:
    """Return whether parameters are unknown or equal to their partners, and bounds of unknown ones, `moved` too, have a common value."""
    infos = problem.renderer.parameters()
    fixed = [pair for pair in pairs if not any(key in problem.shapes() for key in pair)]
    values = problem.renderer.values([key for pair in fixed for key in pair])
    if not all(_equal(np.asarray(values[key]), np.asarray(values[twin]), infos[key].welded) for key, twin in fixed):
        return False
    known = {key: ends_of(unknown.bounds) for key, unknown in problem.unknowns.items() if not infos[key].rigid}
    both = [(known[key], known[twin]) for key, twin in (*pairs, *moved) if {key, twin} <= known.keys()]
    return all(max(a[0], b[0]) <= min(a[1], b[1]) for a, b in both)


def _equal(one: np.ndarray, other: np.ndarray, vertices: bool) -> bool:
    """Return whether two values are equal, up to a common shift for positions (V * 3,)."""
    if not vertices:
        return np.array_equal(one, other)
    centred = [x.reshape(-1, 3) - x.reshape(-1, 3).mean(axis=0) for x in (one, other)]
    return one.shape == other.shape and np.allclose(*centred, atol=_ROUNDING * float(np.abs(centred[0]).max()))


def owner(key: str) -> str:
    """Return the name of what a key of a pose moves."""
    parts = key.split(".")
    return ".".join(parts[: next((i for i, part in enumerate(parts) if part in _MOTIONS), len(parts))])
