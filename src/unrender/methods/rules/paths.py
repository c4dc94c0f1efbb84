"""Rules for path gradients, for perturbed renders in combination with them, and for a smoothed loss without them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from unrender import pixels
from unrender.core.text import grouped, listed
from unrender.estimators.hybrid import HybridGradient, beyond_paths
from unrender.estimators.path import PathGradient
from unrender.estimators.smoothed import SmoothedDerivatives
from unrender.images.plain import Plain
from unrender.methods.base import method
from unrender.methods.plan import Plan
from unrender.methods.rules import sampling
from unrender.methods.rules.first_rates import first_rates
from unrender.methods.rules.kinds import KINDS, unconnected_values
from unrender.methods.rules.newton import with_separate_block
from unrender.methods.rules.traits import Traits, refusal
from unrender.methods.smoothed import parse_widths, widths_of
from unrender.optimizers.base import Optimizer
from unrender.optimizers.partitioned import Partitioned
from unrender.optimizers.recipes import ScheduleFree
from unrender.optimizers.transforms.agreement_rate import FEWEST_ELEMENTS
from unrender.preconditioners import Sobolev
from unrender.rendering.partial import PartialDerivatives
from unrender.scene.parameter import ParameterSettings
from unrender.schedules import Exponential


def paths_and_perturbed(traits: Traits) -> Plan | None:
    """Return path gradients combined with perturbed renders of unknowns without them; None if all or none have path gradients."""
    constants, problem, sigma = traits.constants, traits.problem, traits.options.sigma
    keys = beyond_paths(traits.infos, list(traits.infos))
    others = problem.with_parts(renderer=PartialDerivatives(problem.renderer, frozenset(keys)))
    if not 0 < len(keys) < len(traits.infos) or refusal(others):
        return None
    if plan := with_separate_block(traits, tuple(keys), paths(replace(traits, problem=others, block=tuple(keys)))):
        return plan
    rates = {key: constants.perturbed_share * width for key, width in widths_of(sigma, problem, keys).items()}
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
    plan = method("smoothed").plan(traits.problem, {"sigma": traits.options.sigma})
    return replace(plan, reasons=(reason,))


def paths(traits: Traits) -> Plan:
    """Return path gradients with the parts for each kind of unknown."""
    problem, options = traits.problem, traits.options
    parts = [kind(traits) for kind in KINDS]
    settings = _merged(traits, [part.settings for part in parts])
    configured = problem.configured(settings)
    rates = {**first_rates(configured, options.learning_rate, traits.constants), **traits.rates}
    rates = {key: rate for key, rate in rates.items() if key not in traits.block}
    sampler, reason = sampling.sampler(traits)
    image, image_reason = sampling.image(traits, sampler)
    spp = sampling.samples_per_pixel(traits, sampler)
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
    measured = renders_all and any(
        u.initial.size >= FEWEST_ELEMENTS for key, u in problem.unknowns.items() if key in rates and key not in apart
    )
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
