"""Rules for cameras and for a few numbers: Gauss-Newton steps by perturbed renders, and cameras by path gradients."""

from __future__ import annotations

import math
from dataclasses import replace

from unrender.core.text import listed
from unrender.estimators.gauss_newton import GaussNewton, explained
from unrender.estimators.path import PathGradient
from unrender.images.plain import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.plan import Plan
from unrender.methods.rules import sampling
from unrender.methods.rules.traits import Traits
from unrender.methods.smoothed import widths_of
from unrender.optimizers.adam import Adam
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.schedules import Exponential

__all__ = ["cameras", "cameras_by_paths", "few_numbers"]


def cameras(traits: Traits) -> Plan | None:
    """Return Gauss-Newton steps where poses of sensors alone are unknown; else None."""
    constants, problem = traits.constants, traits.problem
    if not traits.only_cameras or not traits.newton_suits or traits.elements > constants.most_elements:
        return None
    spp = traits.options.spp or sampling.within(constants.image_spp, constants.image_paths // problem.pixels)
    spp, derivative_spp = max(spp, 2), max(spp // constants.per_derivative, constants.fewest_derivative)
    reason = (
        f"Gauss-Newton steps of cameras by perturbed renders, {spp} samples per pixel of the image, {derivative_spp} of those; "
        "the mean of all steps' models"
    )
    estimator = GaussNewton(spp, derivative_spp, tolerance=_damping(traits))
    return Plan(problem, estimator, AveragedNewton(), reasons=(reason,))


def cameras_by_paths(traits: Traits) -> Plan | None:
    """Return path gradients of sensors: where an image or pixels are asked for, and where there is no Gauss-Newton step."""
    if not traits.only_cameras or not all(info.differentiable for info in traits.infos.values()):
        return None
    sampler, drawn = sampling.sampler(traits)
    spp = sampling.samples_per_pixel(traits, sampler)
    rate = traits.constants.camera_share * traits.options.learning_rate
    image = RecursiveControlVariate("primary") if traits.options.image == "rcv" else Plain()
    reason = f"path gradients of cameras, {spp} samples per pixel, Adam, first rate {rate:.3g}, halved every 30 steps"
    descent = Adam(rate, beta_2=0.99, schedule=Exponential(30, 0.01))
    return Plan(
        traits.problem, PathGradient(image, sampler, spp), descent, reasons=tuple(filter(None, (reason, drawn)))
    )


def few_numbers(traits: Traits) -> Plan | None:
    """Return Gauss-Newton steps where few numbers are unknown and the image changes its form with one of them; else None.

    Poses of shapes take them where derivative images at the start explain the residual: on a plateau a smoothed loss is needed.
    """
    constants, problem, infos, elements = traits.constants, traits.problem, traits.infos, traits.elements
    shapes = problem.shapes().values()
    small = all(len(shape) <= 1 and math.prod(shape) <= constants.number_size for shape in shapes)
    reached = all(info.perturbable and not (info.rigid and info.viewpoint) for info in infos.values())
    nonlinear = traits.poses or [key for key, info in infos.items() if info.nonlinear]
    mixed = 0 < len(traits.poses) < len(infos)
    costly = elements > constants.few_numbers or elements * problem.pixels > 4 * constants.difference_paths
    if not small or not reached or not nonlinear or mixed or costly or not traits.newton_suits:
        return None
    spp = traits.options.spp or sampling.within(constants.number_spp, constants.number_paths // problem.pixels)
    differences = sampling.within(
        constants.difference_spp, constants.difference_paths // (2 * elements * problem.pixels)
    )
    largest = widths_of(traits.options.sigma, traits.poses)
    trial = GaussNewton(max(spp, 2), constants.trial_spp, largest=largest)
    if traits.poses and (not problem.loss.linear or not explained(problem, trial) > constants.explained):
        return None
    reason = (
        f"Gauss-Newton steps of {elements} number{'s' * (elements > 1)} by perturbed renders, {trial.spp} samples per pixel of the image, "
        f"{differences} of those: pictures change their form with {listed(nonlinear)}"
    )
    estimator = replace(trial, derivative_spp=differences, tolerance=_damping(traits))
    return Plan(problem, estimator, AveragedNewton(), reasons=(reason,))


def _damping(traits: Traits) -> float:
    """Return κ of Gauss-Newton steps, which is above 0."""
    asked = 0.0 if traits.problem.loss.linear else traits.options.tolerance
    return asked or traits.constants.newton_tolerance
