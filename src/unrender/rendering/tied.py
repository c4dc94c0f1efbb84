"""One unknown that stands for several parameters of a scene: a renderer around another one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.core import checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.core.trees import Tree
from unrender.rendering.picture_factors import WithParameter
from unrender.rendering.renderer import (
    ParameterInfo,
    Renderer,
    RenderSession,
    ReplacedMesh,
    SampleRequest,
    Space,
    differentiated,
)
from unrender.rendering.wrapper import RendererWrapper, SessionWrapper

__all__ = ["Tie", "TieError", "TiedRenderer", "with_ties"]


class TieError(InputError):
    """What is wrong with a tie.

    Args:
        key: name of the unknown.
        what: one line.
    """

    def __init__(self, key: str, what: str):
        super().__init__(what)
        self.key = key


@dataclass(frozen=True)
class Tie:
    """One unknown and the parameters of the scene that follow it: each is a factor times its value.

    Args:
        key: name of the unknown.
        factors: {key of a parameter of the scene: factor, not 0}.

    Raises:
        InputError: no member, or a factor that is 0 or no finite number.
    """

    key: str
    factors: Mapping[str, float]

    def __post_init__(self):
        if not self.factors:
            raise InputError("expected at least one key")
        for member, factor in self.factors.items():
            checks.number("keys", member, factor)
            if factor == 0:
                raise InputError(f"{member}: expected a factor other than 0")

    def info(self, known: Mapping[str, ParameterInfo]) -> ParameterInfo:
        """Return what a renderer says of the unknown. Raises `TieError` where the members do not go together."""
        for member in self.factors:
            if member not in known:
                raise TieError(self.key, f"the scene has no parameter {member}{did_you_mean(member, known)}")
            if known[member].welded:
                raise TieError(
                    self.key, f"{member}: vertex positions cannot be tied; place the mesh as instances of a shapegroup"
                )
            if not (known[member].perturbable or known[member].differentiable):
                raise TieError(self.key, f"{member} cannot be recovered: {known[member].reason}")
        infos = [known[member] for member in self.factors]
        first = next(iter(self.factors))
        for member, info in zip(self.factors, infos, strict=True):
            if info.shape != infos[0].shape:
                raise TieError(
                    self.key, f"{member} has the shape {info.shape}, {first} {infos[0].shape}; expected equal shapes"
                )
            if info.conversion != infos[0].conversion or info.role != infos[0].role:
                raise TieError(
                    self.key, f"{member} and {first} read their values differently; expected parameters of one kind"
                )
        low, high = self._limits(infos)
        sensors = {info.sensor for info in infos}
        return replace(
            infos[0],
            differentiable=all(info.differentiable for info in infos),
            shares_paths=all(info.shares_paths for info in infos),
            reason=next((info.reason for info in infos if info.reason), ""),
            lowest=low,
            highest=high,
            perturbable=all(info.perturbable for info in infos),
            resizable=all(info.resizable for info in infos),
            rigid=any(info.rigid for info in infos),
            light=all(info.light for info in infos),
            viewpoint=any(info.viewpoint for info in infos),
            sensor=sensors.pop() if len(sensors) == 1 else None,
            nonlinear=any(info.nonlinear for info in infos),
        )

    def _limits(self, infos: Iterable[ParameterInfo]) -> tuple[float | None, float | None]:
        """Return the range in which every member is within its own."""
        lows, highs = [], []
        for info, factor in zip(infos, self.factors.values(), strict=True):
            ends = [None if end is None else end / factor for end in (info.lowest, info.highest)]
            low, high = ends if factor > 0 else reversed(ends)
            lows.append(-np.inf if low is None else low)
            highs.append(np.inf if high is None else high)
        low, high = max(lows), min(highs)
        return (float(low) if np.isfinite(low) else None), (float(high) if np.isfinite(high) else None)


def with_ties(renderer: Renderer, ties: Iterable[Tie]) -> Renderer:
    """Return the renderer with these unknowns in place of their members; itself where it has these already, or there are none.

    Parameters of photographs around a renderer with other ties are left out.

    Raises `TieError` where the members of one do not go together, or one has a member of another.
    """
    ties, base = tuple(ties), renderer
    while isinstance(base, WithParameter):
        base = base.inner
    held = base.ties if isinstance(base, TiedRenderer) else ()
    if held == ties:
        return renderer
    scene = base.inner if isinstance(base, TiedRenderer) else base
    return TiedRenderer(scene, ties) if ties else scene


class TiedRenderer(RendererWrapper):
    """A renderer whose unknowns are ties. Images, gradients and tangents are as unbiased as the inner renderer's.

    Args:
        inner: renders the scene.
        ties: unknowns that stand for several parameters.
    """

    def __init__(self, inner: Renderer, ties: tuple[Tie, ...]):
        super().__init__(inner)
        self.ties = ties
        self.max_depth = getattr(inner, "max_depth", 6)
        known, taken = inner.parameters(), dict[str, str]()
        infos = {tie.key: tie.info(known) for tie in ties}
        for tie in ties:
            for member in tie.factors:
                if member in taken:
                    raise TieError(tie.key, f"{member} is tied to {taken[member]} already")
                taken[member] = tie.key
            if tie.key in known and tie.key not in tie.factors:
                raise TieError(
                    tie.key, f"{tie.key} is a parameter of the scene itself; expected one of keys, or another name"
                )
        self._info = {**{key: info for key, info in known.items() if key not in taken}, **infos}

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """See `Renderer.parameters`. Members of ties are none of their own."""
        return self._info

    def values(self, keys: list[str]) -> Tree:
        """See `Renderer.values`: of a tie, the value of its first member over that factor."""
        first = {tie.key: next(iter(tie.factors.items())) for tie in self.ties}
        inner = self.inner.values([first[key][0] if key in first else key for key in keys])
        return {key: inner[first[key][0]] * (1 / first[key][1]) if key in first else inner[key] for key in keys}

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        """See `Renderer.prepare`."""
        wanted = differentiated(keys, derivatives)
        inner = self.inner.prepare(self.expanded(keys), space, frozenset(self.expanded(wanted)))
        return TiedSession(self, inner)

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> Renderer:
        return super().with_meshes(meshes, self.expanded(keys))

    def _around(self, inner: Renderer) -> TiedRenderer:
        return TiedRenderer(inner, self.ties)

    def expanded(self, keys: Iterable[str]) -> list[str]:
        """Return the parameters of the inner renderer that these keys stand for."""
        factors = {tie.key: list(tie.factors) for tie in self.ties}
        return [member for key in keys for member in factors.get(key, [key])]

    def scene_values(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return {key of the inner renderer: value} for values of these keys."""
        found = {}
        for key, value in values.items():
            tie = next((tie for tie in self.ties if tie.key == key), None)
            factors = {key: 1.0} if tie is None else tie.factors
            found |= {member: _scaled(value, factor) for member, factor in factors.items()}
        return found


class TiedSession(SessionWrapper):
    """Images and derivatives with respect to ties. See `RenderSession`."""

    def __init__(self, renderer: TiedRenderer, inner: RenderSession):
        super().__init__(inner)
        self._renderer = renderer
        self._ties = {tie.key: tie.factors for tie in renderer.ties}
        self._known: list[tuple[Array, Tree]] = []

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        return self._inner.image_batch(self._renderer.scene_values(parameters), request)

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        return self._renderer.scene_values(tangents)

    def _state(self, parameters: Tree) -> Tree:
        """Return the values of the scene's parameters: the same arrays for the same value, which the scene need not set again."""
        found: Tree = {}
        for key, value in parameters.items():
            if key not in self._ties:
                found[key] = value
                continue
            members = next((tree for given, tree in self._known if given is value), None)
            if members is None:
                members = {member: _scaled(value, factor) for member, factor in self._ties[key].items()}
                self._known = [*self._known[1 - 2 * len(self._ties) :], (value, members)]
            found |= members
        return found

    def _gradient(self, parameters: Tree, found: Tree, paths: Any) -> Tree:
        """Return the gradient by the unknowns: of a tie, the members' by their factors, summed."""
        gathered: Tree = {}
        for key in parameters:
            factors = self._ties.get(key, {key: 1.0})
            parts = [found[member] * factor for member, factor in factors.items() if member in found]
            if parts:
                gathered[key] = sum(parts[1:], parts[0])
        return gathered


def _scaled(value: Any, factor: float) -> Any:
    """Return a value times a factor; a value that all states of a batch share stays one."""
    if factor == 1:
        return value
    if isinstance(value, np.ndarray) and value.ndim and len(value) > 1 and value.strides[0] == 0:
        return np.broadcast_to(value[0] * factor, value.shape)
    return value * factor
