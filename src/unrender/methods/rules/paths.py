"""Rules for path gradients by kind of unknown, for perturbed renders in combination with them, and for a smoothed loss without them.

First learning rates follow from the unknowns' ranges and sizes. Factors of unknown lights at the start are least squares, since images
are linear in them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from unrender import pixels
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.text import grouped, listed
from unrender.estimators.hybrid import HybridGradient, beyond_paths
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.images.base import Plain
from unrender.methods.base import method
from unrender.methods.plan import Plan
from unrender.methods.rules.constants import CONSTANTS, Constants
from unrender.methods.rules.newton import cameras, cameras_by_paths, few_numbers, then_newton, with_separate_block
from unrender.methods.rules.traits import Traits, choose_image, choose_sampler, refusal, samples_per_pixel
from unrender.methods.smoothed import first_steps, parse_widths
from unrender.optimizers.base import Optimizer
from unrender.optimizers.partitioned import Partitioned
from unrender.optimizers.recipes import Adam, ScheduleFree
from unrender.optimizers.transforms.agreement_rate import FEWEST_ELEMENTS
from unrender.preconditioners import LargeSteps, Sobolev, grid
from unrender.rendering.partial import PartialDerivatives
from unrender.scene.bounds import MARGIN, open_scale
from unrender.scene.coarse_to_fine import CoarseToFine
from unrender.scene.parameter import ParameterSettings
from unrender.scene.problem import Problem
from unrender.scene.render import power_of_two, render, selected_views
from unrender.schedules import Exponential, InverseRoot
from unrender.statistics.debiased import normal_equations

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


_KINDS: tuple[Callable[[Traits], Part], ...] = (textures, unconnected_values, volumes, positive_values, lights, meshes)
"""Rules in the order of their reasons."""


def paths_and_perturbed(traits: Traits) -> Plan | None:
    """Return path gradients combined with perturbed renders of unknowns without them; None if all or none have path gradients."""
    constants, problem, sigma = traits.constants, traits.problem, traits.options.sigma
    keys = beyond_paths(traits.infos, list(traits.infos))
    others = problem.with_parts(renderer=PartialDerivatives(problem.renderer, frozenset(keys)))
    if not 0 < len(keys) < len(traits.infos) or refusal(others):
        return None
    if plan := with_separate_block(traits, tuple(keys), paths(replace(traits, problem=others, block=tuple(keys)))):
        return plan
    rates = {key: constants.perturbed_share * width for key, width in first_steps(sigma, problem, keys).items()}
    plan = paths(replace(traits, problem=others, rates=rates))
    smoothing = SmoothedDerivatives(
        parse_widths(sigma, problem, keys),
        constants.perturbed,
        spp=constants.perturbed_spp,
        schedule=Exponential(*constants.annealing),
        debiased=True,
    )
    reason = f"perturbed renders of {', '.join(f'{key}: {traits.infos[key].reason}' for key in keys)}"
    estimator = HybridGradient(plan.estimator, smoothing, tuple(keys))
    return replace(plan, problem=problem, estimator=estimator, reasons=(reason, *plan.reasons))


def perturbed(traits: Traits) -> Plan | None:
    """Return derivatives of a smoothed loss if path gradients are unavailable; else None."""
    if not traits.unreachable:
        return None
    reason = f"derivatives of a smoothed loss (method smoothed): {traits.unreachable}"
    plan = method("smoothed").configure({"sigma": traits.options.sigma}).plan(traits.problem)
    return replace(plan, reasons=(reason,))


def paths_then_newton(traits: Traits) -> Plan:
    """Return path gradients, with Gauss-Newton steps after them for few numbers."""
    return then_newton(traits, paths(traits))


RULES = (cameras, cameras_by_paths, few_numbers, paths_and_perturbed, perturbed, paths_then_newton)


def paths(traits: Traits) -> Plan:
    """Return path gradients with the parts for each kind of unknown."""
    problem, options = traits.problem, traits.options
    parts = [kind(traits) for kind in _KINDS]
    settings = _merged(traits, [part.settings for part in parts])
    configured = problem.configured(settings)
    rates = {**first_rates(configured, options.learning_rate, traits.constants), **traits.rates}
    rates = {key: rate for key, rate in rates.items() if key not in traits.block}
    sampler, reason = choose_sampler(traits)
    image, image_reason = choose_image(traits, sampler)
    spp = samples_per_pixel(traits, sampler)
    smoothed = tuple(key for part in parts if part.smoothed for key in part.keys)
    own, pulled = [part for part in parts if part.optimizer], _pulled(traits, settings)
    apart = {key for part in own for key in part.keys}
    optimizer: Optimizer = ScheduleFree(
        {"*": options.learning_rate, **{key: rate for key, rate in rates.items() if key not in apart}},
        preconditioner=Sobolev(correlation=options.correlation) if smoothed else None,
        preconditioned=smoothed,
        wiener=not isinstance(sampler, pixels.Uniform),
        reparameterised=tuple(key for key, own in configured.unknowns.items() if own.transform is not None),
        uniform=unconnected_values(traits).keys,
        pulled=pulled,
    )
    for part in own:
        if part.optimizer is not None:
            optimizer = Partitioned(part.keys, part.optimizer(min(rates[key] for key in part.keys)), optimizer)
    plain, renders_all = isinstance(image, Plain), isinstance(sampler, pixels.All)
    biased = problem.loss.pixelwise and not problem.loss.linear
    tolerance = options.tolerance if biased and isinstance(sampler, (pixels.All, pixels.Views)) else 0.0
    own_rates = {key: rate for key, rate in problem.learning_rates.items() if key not in traits.block}
    first = grouped({key: f"{rate:.3g}" for key, rate in (rates | own_rates).items()})
    reasons = (
        f"{'a fresh rendering each step' if plain else 'recursive control variates'}, {spp} samples per pixel: {image_reason}",
        reason,
        f"{type(problem.loss).__name__} damped where noise exceeds the residual" if tolerance else "",
        *(part.reason for part in parts),
        f"a weak pull to their start, for texels that the pictures hardly show: {listed(list(pulled))}"
        if pulled
        else "",
        f"{'schedule-free Adam' if len(apart) < len(rates) else 'Adam'}, first rate {first}",
    )
    fresh_from = traits.constants.fresh_from if smoothed and renders_all and not plain else 0
    # Optimizers of parts take no sample: beside poses, longer first steps of textures were as often worse as better.
    alone = not (own or traits.block or traits.rates)
    measured = renders_all and alone and any(problem.unknowns[key].initial.size >= FEWEST_ELEMENTS for key in rates)
    estimator = PathGradient(image, sampler, spp, tolerance=tolerance, fresh_from=fresh_from, noise_sample=measured)
    return Plan(problem, estimator, optimizer, settings, tuple(filter(None, reasons)))


def _pulled(traits: Traits, settings: Mapping[str, ParameterSettings]) -> dict[str, float]:
    """Return {key: weight} of the environment maps that are optimised as logarithms, see `PullToStart`."""
    problem = traits.problem
    weight = (2.0 if problem.loss.linear else 1.0) / (3.0 * problem.pixels * traits.constants.sky_deviation**2)
    keys = (key for key in traits.lights if problem.unknowns[key].measure.repeated and settings[key].parameterisation)
    return dict.fromkeys(keys, weight)


def _merged(traits: Traits, settings: list[Mapping[str, ParameterSettings]]) -> dict[str, ParameterSettings]:
    """Return the settings of all parts by unknown."""
    merged: dict[str, ParameterSettings] = {}
    for key in traits.infos:
        chosen = [vars(part[key]) for part in settings if key in part and key not in traits.block]
        values = {name: value for own in chosen for name, value in own.items() if value is not None}
        merged[key] = ParameterSettings(**values)
    return merged


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
    return key.rsplit(".", 2)[0]


def _is_number(value: np.ndarray, constants: Constants) -> bool:
    """Return whether it is a single number or a colour."""
    return value.ndim <= 1 and value.size <= constants.number_size


def _radius(positions: np.ndarray) -> float:
    """Return the root mean square distance of vertices (3 V,) from their mean; 1 if it is 0."""
    vertices = positions.reshape(-1, 3).astype(np.float64)
    return float(np.sqrt(np.mean(np.sum(np.square(vertices - vertices.mean(axis=0)), axis=1)))) or 1.0


_SEEDS = (11, 12)
"""Seeds of two independent halves."""
_MOST_PIXELS = 1 << 19
"""Maximum number of pixels of the views, of which the first is always rendered."""
_PATHS, _SPP = 1 << 17, (2, 64)
"""Path budget of the images of one state, and limits of their samples per pixel."""
_LIMIT = 1e4
"""Largest factor, and reciprocal of the smallest."""
_BETTER = 0.25
"""Ratio of the mean square residuals with and without the factors below which the factors are used."""


def start_factors(problem: Problem, keys: Sequence[str], constants: Constants) -> dict[str, float]:
    """Return {key: factor} of the lights' initial values if one is far from 1 and factors reduce the residual well, else {}.

    With D_k, the image of light k alone, f minimises ‖I + Σ (f_k − 1) D_k − R‖². Its normal equations are products of two independent
    halves, so noise does not bias them. The other unknowns are at their start, so factors are no better than these.

    A start that is ten times too bright costs Adam more steps than one that is ten times too dark: its second moments remember the first
    gradients, which are a hundred times as large as the later ones.

    The problem's own loss must be less, too. A saturated reference, for example, says nothing against a brighter image.

    Args:
        keys: Keys of unknown lights.
        constants: Constants of the rules; `far_light` is the least ratio that counts as far.
    """
    if not keys or not problem.loss.pixelwise:
        return {}
    try:
        factors, change, less = _least_squares(problem, keys)
    except (InputError, np.linalg.LinAlgError):  # a value that the renderer rejects
        return {}
    far = max((max(f, 1.0 / f) for f in factors.values() if f > 0.0), default=1.0) > constants.far_light
    usable = all(math.isfinite(f) and 1.0 / _LIMIT < f < _LIMIT for f in factors.values())
    return factors if usable and far and change < _BETTER and less else {}


def _least_squares(problem: Problem, keys: Sequence[str]) -> tuple[dict[str, float], float, bool]:
    """Return the factors, the ratio of the mean square residuals with and without them, and whether the loss is less with them."""
    start, selected = problem.initial_values(), selected_views(problem)
    ends = np.cumsum([math.prod(problem.sizes[view]) for view in selected])
    most = max(int((ends <= _MOST_PIXELS).sum()), 1)
    views, pixels = selected[:most], int(ends[most - 1])
    spp = power_of_two(min(max(_PATHS // pixels, _SPP[0]), _SPP[1]))
    states: list[Mapping[str, np.ndarray]] = [start, *({**start, key: 2.0 * start[key]} for key in keys)]
    count = len(keys)
    matrix, vector, squares, means = np.zeros((count, count)), np.zeros(count), 0.0, {}
    for view in views:
        own = problem.views[view]
        weight = own.weight * own.pixel_weights(problem.sizes[view]).reshape(*problem.sizes[view], 1)
        halves = [np.stack([render(problem, x, view, spp, seed) for x in states]).astype(np.float64) for seed in _SEEDS]
        reference = np.asarray(own.reference)
        finite = np.asarray(np.isfinite(np.stack(halves)).all(axis=(0, 1, -1)))[..., None]
        halves = [np.where(finite, images, reference) for images in halves]  # neither residual nor light in the others
        means[view] = (halves[0] + halves[1]) / 2.0
        residuals = [reference - images[0] for images in halves]
        parts = normal_equations([images[1:] - images[0] for images in halves], residuals, weight)
        matrix, vector = matrix + parts[0], vector + parts[1]
        squares += float((residuals[0] * residuals[1] * weight).sum())
    step = np.linalg.solve(matrix, vector)
    after = squares - 2.0 * float(step @ vector) + float(step @ matrix @ step)
    factors = {key: 1.0 + float(x) for key, x in zip(keys, step, strict=True)}
    less = _loss(problem, means, step) < _loss(problem, means, np.zeros(count))
    return factors, max(after, 0.0) / squares if squares > 0.0 else 1.0, less


def _loss(problem: Problem, images: Mapping[int, np.ndarray], step: np.ndarray) -> float:
    """Return the loss of views from the images of all states and the change of each light's factor."""
    changed = {view: of[0] + np.tensordot(step, of[1:] - of[0], 1) for view, of in images.items()}
    return sum(arrays.number(problem.loss_value(view, problem.renderer.array(x))) for view, x in changed.items())
