"""Rules by kind of unknown for path gradients: textures, volumes, positive numbers, meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from unrender.core.text import grouped, listed
from unrender.methods.rules.brightness import start_factors
from unrender.methods.rules.first_rates import logarithms
from unrender.methods.rules.traits import Traits
from unrender.optimizers.base import Optimizer
from unrender.optimizers.recipes import Adam
from unrender.preconditioners import LargeSteps, grid
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.parameter import ParameterSettings
from unrender.schedules import InverseRoot

_GRID = 4
"""Dimensions of a grid, (Z, Y, X, C)."""


@dataclass(frozen=True)
class Part:
    """Part of a plan for the unknowns of one kind.

    Attributes:
        keys: Keys of the unknowns.
        reason: Description of the choice; "" if there is no such unknown.
        settings: Settings of unknowns by key.
        smoothed: Whether they use Sobolev gradients.
        optimizer: Function from the smallest of their first learning rates to a separate optimizer; None for the common one.
    """

    keys: tuple[str, ...] = ()
    reason: str = ""
    settings: Mapping[str, ParameterSettings] = field(default_factory=dict)
    smoothed: bool = False
    optimizer: Callable[[float], Optimizer] | None = None


def textures(traits: Traits) -> Part:
    """Use Sobolev gradients for textures, grids and values at vertices without their own preconditioner."""
    keys = tuple(
        key
        for key, unknown in traits.problem.unknowns.items()
        if traits.options.smooth
        and unknown.preconditioner is None
        and (grid.is_map(unknown.shape()) or (traits.infos[key].mesh is not None and not traits.infos[key].welded))
    )
    return Part(keys, f"Sobolev gradients of {listed(keys)}", smoothed=True) if keys else Part()


def unconnected_values(traits: Traits) -> Part:
    """Use one rate for all elements of long lists without neighbours, such as vertex normals, of which pictures show some hardly."""
    keys = tuple(
        key
        for key, unknown in traits.problem.unknowns.items()
        if len(unknown.shape()) == 1 and unknown.initial.size > traits.constants.few_numbers
        if traits.infos[key].mesh is None and key not in traits.block
    )
    return Part(keys, f"one rate for all elements of {listed(keys)}") if keys else Part()


def volumes(traits: Traits) -> Part:
    """Use coarse resolutions in the first steps for grids without detail at the start, because a few cells have less noise.

    Textures are excluded, because smoothed gradients have the same effect, and so are grids in problems with meshes.
    """
    doubling, allowed = {}, traits.options.coarse and not traits.meshes
    for key, unknown in traits.problem.unknowns.items() if allowed else ():
        shape, start = unknown.shape(), unknown.initial
        candidates = [
            steps for cells, steps in traits.constants.coarse if len(shape) == _GRID and min(shape[:-1]) >= cells
        ]
        own = unknown.coarse_to_fine is not None or unknown.preconditioner is not None
        if candidates and not own and traits.infos[key].resizable and not (start != start[:1, :1, :1]).any():
            doubling[key] = candidates[0]
    steps = {key: f"resolution doubled by step {' and '.join(map(str, each))}" for key, each in doubling.items()}
    settings = {
        key: ParameterSettings(coarse_to_fine=CoarseToFine(each, states="carry")) for key, each in doubling.items()
    }
    return Part(tuple(doubling), f"coarse to fine: {grouped(steps)}", settings) if doubling else Part()


def positive_values(traits: Traits) -> Part:
    """Optimise positive numbers, colours and textures without an upper bound as their logarithms."""
    positive, known = logarithms(traits.problem, traits.constants), traits.problem.unknowns
    parameterisations = {key: u.parameterisation for key, u in known.items() if u.parameterisation is not None}
    moved = {key: "log" for key in positive if traits.options.parameterise and key not in traits.rates}
    named = {key: type(own).__name__.lower() for key, own in parameterisations.items()} | moved
    settings = {key: ParameterSettings(parameterisation=name) for key, name in moved.items()}
    return Part(tuple(named), f"parameterised as {grouped(named)}", settings) if named else Part()


def lights(traits: Traits) -> Part:
    """Start lights whose brightness is far from the references' at a multiple of their initial values."""
    positive = positive_values(traits).settings
    keys = [key for key in traits.lights if key in positive and key not in traits.block]
    factors = start_factors(traits.problem, keys, traits.constants)
    named = {key: f"{factor:.3g} times the initial values" for key, factor in factors.items()}
    settings = {key: ParameterSettings(start_factor=factor) for key, factor in factors.items()}
    return Part(tuple(factors), f"lights start by least squares: {grouped(named)}", settings) if factors else Part()


def meshes(traits: Traits) -> Part:
    """Use large steps for vertices, with one learning rate for all that decays with the root of the steps."""
    keys, constants = traits.meshes, traits.constants
    if not keys:
        return Part()
    fewest = min(traits.problem.unknowns[key].initial.size // 3 for key in keys)
    strength = float(np.clip(fewest / constants.vertices_per_strength, *constants.strengths))
    reason = f"large steps of {listed(keys)}: one rate for all vertices, λ {strength:.2g}"
    settings = {key: ParameterSettings(preconditioner=LargeSteps(strength)) for key in keys}
    schedule = InverseRoot(constants.mesh_time)
    return Part(keys, reason, settings, optimizer=lambda rate: Adam(rate, schedule=schedule, uniform=True))


KINDS: tuple[Callable[[Traits], Part], ...] = (textures, unconnected_values, volumes, positive_values, lights, meshes)
"""Rules in the order of their reasons."""
