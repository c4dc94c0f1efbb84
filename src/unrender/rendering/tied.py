"""Ties: one unknown that sets several parameters of a scene, each times a constant factor."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError, KeyedError
from unrender.core.text import did_you_mean, in_words
from unrender.core.trees import Tree
from unrender.rendering.picture_factors import WithParameter
from unrender.rendering.renderer import ParameterInfo, Renderer, RenderSession, ReplacedMesh, SampleRequest
from unrender.rendering.wrapper import DerivedRenderer, DerivedSession, combined, unwrapped

_ENCODED = ("normal", "direction")  # Roles whose values represent vectors. Heights are numbers.


@dataclass(frozen=True)
class Tie:
    """One unknown and the scene parameters that it sets: each is a constant factor times its value.

    Args:
        key: name of the unknown.
        factors: {key of a parameter of the scene: factor, not 0}.

    Raises:
        InputError: no member, or a factor that is 0 or not finite.
    """

    key: str
    factors: Mapping[str, float]

    def __post_init__(self):
        if not self.factors:
            raise InputError("expected at least one key")
        for member, factor in self.factors.items():
            if not math.isfinite(checks.real(factor)) or factor == 0:
                raise InputError(f"{member}: expected a finite factor other than 0, got {in_words(factor)}")

    def info(self, known: Mapping[str, ParameterInfo]) -> ParameterInfo:
        """Return the description of the unknown. Raise `KeyedError` if the members are incompatible."""
        for member in self.factors:
            if member not in known:
                raise KeyedError(self.key, f"the scene has no parameter {member}{did_you_mean(member, known)}")
            if known[member].welded:
                raise KeyedError(
                    self.key, f"{member}: vertex positions cannot be tied; place the mesh as instances of a shapegroup"
                )
            if not (known[member].perturbable or known[member].differentiable):
                raise KeyedError(self.key, f"{member} cannot be recovered: {known[member].reason}")
        infos = [known[member] for member in self.factors]
        first = next(iter(self.factors))
        for member, info in zip(self.factors, infos, strict=True):
            if info.shape != infos[0].shape:
                raise KeyedError(
                    self.key, f"{member} has the shape {info.shape}, {first} {infos[0].shape}; expected equal shapes"
                )
            encodings = {one.role if one.role in _ENCODED else "value" for one in (info, infos[0])}
            meanings = {meaning for one in infos if (meaning := _meaning(one))}
            if info.conversion != infos[0].conversion or len(encodings) > 1 or len(meanings) > 1:
                raise KeyedError(
                    self.key, f"{member} and {first} read their values differently; expected parameters of one kind"
                )
        low, high = self._limits(infos)
        places = zip(infos, self.factors.values(), strict=True)
        singular = {info.singular / factor for info, factor in places if info.singular is not None}
        if len(singular) > 1:
            ends = " and ".join(f"{place:g}" for place in sorted(singular))
            raise KeyedError(self.key, f"with these factors images are singular at {ends}; expected equal factors")
        return replace(
            infos[0],
            **combined(infos),
            lowest=low,
            highest=high,
            singular=next(iter(singular), None),
            resizable=all(info.resizable for info in infos),
            light=all(info.light for info in infos),
            axial=False,  # lights of different directions determine a turn of all together
            forward=None,
            brightness=infos[0].brightness if len({info.brightness for info in infos}) == 1 else "",
            of_expression=any(info.of_expression for info in infos),
            length=max(info.length for info in infos),
        )

    def _limits(self, infos: Iterable[ParameterInfo]) -> tuple[float | None, float | None]:
        lows, highs = [], []
        for info, factor in zip(infos, self.factors.values(), strict=True):
            ends = [None if end is None else end / factor for end in (info.lowest, info.highest)]
            low, high = ends if factor > 0 else reversed(ends)
            lows.append(-np.inf if low is None else low)
            highs.append(np.inf if high is None else high)
        low, high = max(lows), min(highs)
        if low >= high:
            raise KeyedError(
                self.key, f"with these factors no range of values is within the ranges of {' and '.join(self.factors)}"
            )
        return (float(low) if np.isfinite(low) else None), (float(high) if np.isfinite(high) else None)


def _meaning(info: ParameterInfo) -> str:
    """Return the quantity of a parameter; "" for one that may share its values with others, as a weight may with a colour."""
    if info.rigid or info.nonlinear:
        return "angle" if info.angle else "pose" if info.rigid else "form"
    return info.brightness or ("medium" if info.scattering == "medium" else "")


def with_ties(renderer: Renderer, ties: Iterable[Tie]) -> Renderer:
    """Return the renderer with these unknowns in place of their members.

    Return the renderer itself if it has these ties already, and the renderer of the scene if `ties` is empty. If the
    ties change, parameters of photographs around the renderer are dropped.

    Raises `KeyedError` if the members of a tie are incompatible, or two ties share a member.
    """
    ties, base = tuple(ties), unwrapped(renderer, WithParameter)
    held = base.ties if isinstance(base, TiedRenderer) else ()
    if held == ties:
        return renderer
    scene = base.inner if isinstance(base, TiedRenderer) else base
    return TiedRenderer(scene, ties) if ties else scene


class TiedRenderer(DerivedRenderer):
    """A renderer whose unknowns are ties. Images, gradients and tangents are as unbiased as the inner renderer's.

    Args:
        ties: unknowns that set several parameters each.
    """

    def __init__(self, inner: Renderer, ties: tuple[Tie, ...]):
        self.ties, self.factors = ties, {tie.key: tie.factors for tie in ties}
        known, owner = inner.parameters(), dict[str, str]()
        super().__init__(inner, self.factors, {tie.key: tie.info(known) for tie in ties})
        for tie in ties:
            for member in tie.factors:
                if member in owner:
                    raise KeyedError(tie.key, f"{member} is tied to {owner[member]} already")
                owner[member] = tie.key
            if tie.key in known and tie.key not in tie.factors:
                raise KeyedError(
                    tie.key, f"{tie.key} is a parameter of the scene itself; expected one of keys, or another name"
                )

    def values(self, keys: list[str]) -> Tree:
        """Return the scene's own values. The value of a tie is that of its first member over the member's factor."""
        first = {key: next(iter(factors.items())) for key, factors in self.factors.items()}
        inner = self.inner.values([first[key][0] if key in first else key for key in keys])
        return {key: inner[first[key][0]] * (1 / first[key][1]) if key in first else inner[key] for key in keys}

    def session(self, inner: RenderSession, differentiable: frozenset[str]) -> RenderSession:
        return TiedSession(self, inner)

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> Renderer:
        return super().with_meshes(meshes, self.expanded(keys))

    def around(self, inner: Renderer) -> TiedRenderer:
        return TiedRenderer(inner, self.ties)

    def scene_values(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return {key of the inner renderer: value} for values of these keys."""
        scaled = {}
        for key, value in values.items():
            factors = self.factors.get(key, {key: 1.0})
            scaled |= {member: _scaled(value, factor) for member, factor in factors.items()}
        return scaled


class TiedSession(DerivedSession):
    """A session that renders and differentiates with respect to ties."""

    def __init__(self, renderer: TiedRenderer, inner: RenderSession):
        super().__init__(inner, renderer.factors)
        self._renderer = renderer

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        return self._inner.image_batch(self._renderer.scene_values(parameters), request)

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        return self._renderer.scene_values(tangents)

    def _inside(self, own: Tree) -> Tree:
        return self._renderer.scene_values(own)

    def _gradient(self, parameters: Tree, inner_gradient: Tree, paths: Any) -> Tree:
        gradient: Tree = {}
        for key in parameters:
            factors = self._renderer.factors.get(key, {key: 1.0})
            parts = [inner_gradient[member] * factor for member, factor in factors.items() if member in inner_gradient]
            if parts:
                gradient[key] = sum(parts[1:], parts[0])
        return gradient


def _scaled(value: Any, factor: float) -> Any:
    """Return a value times a factor. A value that is broadcast over a batch remains broadcast."""
    if factor == 1:
        return value
    if isinstance(value, np.ndarray) and value.ndim and len(value) > 1 and value.strides[0] == 0:
        return np.broadcast_to(value[0] * factor, value.shape)
    return value * factor
