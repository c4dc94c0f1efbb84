"""Rules for cameras and for a few numbers: Gauss-Newton steps from perturbed renders, and path gradients of cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from unrender import pixels
from unrender.core import arrays, trees
from unrender.core.random import Key
from unrender.core.text import listed
from unrender.core.trees import Tree
from unrender.estimators.capabilities import Hessian, HessianNoise
from unrender.estimators.derivative_images import LAUNCH, cost
from unrender.estimators.gauss_newton import GaussNewton
from unrender.estimators.hybrid import HybridGradient
from unrender.estimators.path import PathGradient
from unrender.estimators.path_then_newton import PathThenNewton
from unrender.estimators.variable_projection import IMAGES, can_be_eliminated
from unrender.images.base import Plain
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.methods.base import measure
from unrender.methods.plan import Plan
from unrender.methods.rules.starts import best_start, stands_out
from unrender.methods.rules.traits import Traits, choose_sampler, samples_per_pixel, within
from unrender.methods.smoothed import widths_of
from unrender.optimizers.averaged_newton import AveragedNewton
from unrender.optimizers.partitioned import Partitioned, Successive
from unrender.optimizers.recipes import Adam
from unrender.scene.executor import LocalExecutor
from unrender.scene.problem import Problem
from unrender.scene.render import limited_spp
from unrender.schedules import Exponential
from unrender.statistics.scores import positive_inverse

_TRIAL, _LEAST_EIGENVALUE = 3, 0.01
"""Stream of the random numbers of `_explained`, and relative eigenvalue below which its matrix counts as singular or as noise."""
_WIDER = 4  # factor of the samples of a second trial, whose pictures may have caustics


def cameras(traits: Traits) -> Plan | None:
    """Return Gauss-Newton steps if poses of sensors are unknown, with or without lenses; else None."""
    constants, problem = traits.constants, traits.problem
    of_cameras = traits.only_cameras or traits.cameras_and_lenses
    if not of_cameras or not traits.newton_suits or traits.elements > constants.most_elements:
        return None
    spp = traits.options.spp or limited_spp(constants.image_paths, problem.pixels, constants.image_spp)
    spp, derivative_spp = max(spp, 2), max(spp // constants.per_derivative, constants.fewest_derivative)
    reason = f"Gauss-Newton steps for cameras from perturbed renders {_samples(spp, derivative_spp)}; the mean of all steps' models"
    widths = widths_of(traits.options.sigma, problem, traits.poses)
    largest = {key: constants.pose_reach * width for key, width in widths.items()}
    estimator = GaussNewton(spp, derivative_spp, tolerance=_damping(traits), largest=largest)
    return Plan(problem, estimator, AveragedNewton(), reasons=(reason,))


def cameras_by_paths(traits: Traits) -> Plan | None:
    """Return path gradients of sensors if an image or pixels are requested, or Gauss-Newton steps are unsuitable; else None."""
    if not traits.only_cameras or not all(info.differentiable for info in traits.infos.values()):
        return None
    sampler, sampler_reason = choose_sampler(traits)
    spp = samples_per_pixel(traits, sampler)
    rate = traits.constants.camera_share * traits.options.learning_rate
    image = RecursiveControlVariate("primary") if traits.options.image == "rcv" else Plain()
    reason = f"path gradients of cameras, {spp} samples per pixel, Adam, first rate {rate:.3g}, halved every 30 steps"
    rates = {"*": rate} | {key: rate * info.length for key, info in traits.infos.items() if info.length != 1.0}
    descent = Adam(rates if len(rates) > 1 else rate, beta_2=0.99, schedule=Exponential(30, 0.01))
    return Plan(
        traits.problem,
        PathGradient(image, sampler, spp),
        descent,
        reasons=tuple(filter(None, (reason, sampler_reason))),
    )


def few_numbers(traits: Traits) -> Plan | None:
    """Return Gauss-Newton steps if few numbers are unknown, and one is a light's or changes the form of the image; else None.

    Numbers of a BSDF or medium, such as a roughness, count if some unknown has no path gradient, or if the film is small. Poses of lights
    may be combined with other numbers, such as intensities. They take a smoothed loss if derivative images at the start do not explain the
    residual, its picture is no better than those around it, and no better start is found. A shape on such a plateau takes these steps from
    the best of some places, if derivative images explain something there. So does any number without a path gradient, since a smoothed loss
    is far noisier.
    """
    constants, problem, keys = traits.constants, traits.problem, tuple(traits.infos)
    nonlinear = traits.poses or [key for key, info in traits.infos.items() if info.nonlinear] or _of_scattering(traits)
    nonlinear = nonlinear or [key for key, info in traits.infos.items() if not info.differentiable]
    shapes = _moves_shapes(traits, keys)
    mixed = shapes and len(traits.poses) < len(keys)
    if not (nonlinear or traits.lights) or mixed or not traits.newton_suits or not _few(traits, keys):
        return None
    estimator = _estimator(traits, keys, constants.pose_images if shapes else constants.number_images)
    estimator = replace(estimator, remember=traits.elements * problem.pixels <= constants.averaged_values)
    estimator = _by_channel(traits, estimator)
    plateau = False
    if traits.poses:
        spp = limited_spp(constants.number_paths, problem.pixels, (constants.trial_spp, constants.trial_spp))
        trial = replace(estimator, derivative_spp=spp, coarse=None, noise_limit=None, remember=False, scores=False)
        trial = replace(trial, largest=widths_of(traits.options.sigma, problem, traits.poses))
        least = constants.explained if shapes else constants.explained_light
        if not problem.loss.linear:
            return None
        # Noise hides what many lights explain; the loss smoothed over all of them rose.
        explained = traits.elements > constants.few_numbers or _explained(problem.initial(), problem, trial) > least
        plateau = not (explained or measure(problem, (stands_out,), lambda: stands_out(problem, traits.poses)))
    estimator = replace(estimator, shift=constants.pose_last_shift) if shapes else estimator
    why = f"are not linear in {listed(nonlinear)}" if nonlinear else f"are linear in {listed(traits.lights)}"
    reason = f"{_reason(traits, keys, estimator)}: pictures {why}"
    plan = Plan(problem, estimator, _optimizer(traits, keys), reasons=(reason,))
    made = best_start(traits, keys, plan, plateau and shapes)
    if plateau and shapes:
        # Wide differences, with which steps begin, may reach where narrow ones do not.
        paths = {"spp": _WIDER * trial.spp, "derivative_spp": _WIDER * trial.derivative_spp}
        wide = replace(trial, coarse=estimator.coarse, **paths)
        trials = ((trial, least), (wide, constants.explained_wide))
        plateau = not any(_explained(made.configured().start(), problem, one) > share for one, share in trials)
    elif plateau:
        plateau = made is plan
    if plateau:
        traits.notes.append(
            f"pictures at the start, and at other values, say little about {listed(traits.poses)}: the run may end far from them; give "
            "other initial values, or bounds"
        )
        return plan if shapes else None
    return made


def with_separate_block(traits: Traits, keys: tuple[str, ...], plan: Plan) -> Plan | None:
    """Return a path-gradient plan with a separate block of these unknowns; None if Gauss-Newton steps do not suit them.

    Args:
        keys: Keys of the unknowns of the block.
    """
    constants, problem = traits.constants, traits.problem
    own = any(problem.unknowns[key].preconditioner is not None for key in keys)
    if not _few(traits, keys) or own or not problem.loss.linear or not isinstance(plan.estimator, PathGradient):
        return None
    estimator = _estimator(traits, keys, constants.block_images if _moves_shapes(traits, keys) else 0.0)
    eliminated = _eliminated(traits, keys, plan)
    images = 2 * _elements(traits, keys) + (IMAGES if eliminated else 0)
    traced = images * estimator.derivative_spp + estimator.spp
    every = within((1, constants.block_every), round(traced / (constants.path_cost * plan.estimator.spp)))
    # A texture that is fitted to a picture of a wrong lamp, lens or camera takes over its error.
    shapes = any(traits.infos[key].shape_pose for key in keys)
    wait = constants.block_wait[any(key not in keys for key in traits.lights)] if shapes else 0
    optimizer = _optimizer(traits, keys)
    if any(traits.infos[key].rigid and traits.infos[key].viewpoint for key in keys):
        optimizer, every = replace(optimizer, trust_radius=constants.camera_trust), 1
    times = "" if every == 1 else f", every {every} steps"
    textures = f"; {listed(eliminated)} eliminated from their steps" if eliminated else ""
    after = f", after {wait} steps of the others" if wait else ""
    reason = f"{_reason(traits, keys, estimator)}{times}{after}: {listed(keys)}{textures}"
    made = replace(
        plan,
        problem=problem,
        estimator=HybridGradient(plan.estimator, estimator, keys, wait=wait, every=every, eliminated=eliminated),
        optimizer=Partitioned(keys, optimizer, plan.optimizer),
        reasons=(reason, *plan.reasons),
    )
    return best_start(traits, keys, made)


def then_newton(traits: Traits, plan: Plan) -> Plan:
    """Return a plan of path gradients with Gauss-Newton steps after them if few numbers are unknown, else the plan itself."""
    constants, problem, keys = traits.constants, traits.problem, tuple(traits.infos)
    averaged = traits.elements * problem.pixels <= constants.averaged_values
    path, local = plan.estimator, isinstance(problem.executor, LocalExecutor)
    if not (isinstance(path, PathGradient) and isinstance(path.pixels, pixels.All) and averaged and local):
        return plan
    # One number, and images with a control variate of L1, end as near by path gradients.
    suits = traits.elements > 1 and problem.loss.linear and traits.newton_suits and not traits.poses
    if not (suits and _few(traits, keys)):
        return plan
    newton = replace(
        _estimator(traits, keys, 0.0),
        spp=max(traits.options.spp or limited_spp(constants.number_paths, problem.pixels, constants.number_spp), 2),
        derivative_spp=limited_spp(constants.number_paths // traits.elements, problem.pixels, constants.difference_spp),
        remember=True,
        derivative_noise=constants.derivative_noise,
    )
    newton = _by_channel(traits, newton)
    reason = f"later {_reason(traits, keys, newton)}, from when path gradients no longer agree"
    return replace(
        plan,
        estimator=PathThenNewton(path, newton),
        optimizer=Successive(plan.optimizer, _optimizer(traits, keys)),
        reasons=(*plan.reasons, reason),
    )


def _by_channel(traits: Traits, estimator: GaussNewton) -> GaussNewton:
    """Return the estimator with weights by channel if all unknowns are numbers of BSDFs and brightnesses, without media."""
    media = any(info.scattering == "medium" for info in traits.infos.values())
    if media or not _only_scattering_and_brightness(traits):
        return estimator
    return replace(estimator, noise_limit=traits.constants.bsdf_noise_limit, by_channel=True)


def _explained(first: Tree, problem: Problem, estimator: GaussNewton) -> float:
    """Return the result of `_predicted`, of equal arguments once for all plans of a check."""
    key = (repr(estimator), *(arrays.numpy(value).tobytes() for value in first.values()))
    return measure(problem, key, lambda: _predicted(first, problem, estimator))


def _predicted(first: Tree, problem: Problem, estimator: GaussNewton) -> float:
    """Return the fraction of the loss that the quadratic model at some values predicts to remove.

    It is near 0 on a plateau, where no derivative image resembles the residual. Noise does not bias it: gradients and images come from
    two independent estimates. The loss must have a linear derivative, such as L2.
    """
    state, estimates, losses, images = estimator.init(problem, first), [], [], []
    for step in range(2):
        estimate, state = estimator.estimate(problem, first, state, Key(0, step, stream=_TRIAL))
        estimates.append(estimate)
        losses.append(estimate.loss)
        images.append(estimate.info["images"])
    mean = sum(
        arrays.number(problem.loss_value(view, 0.5 * (image + images[1][view]))) for view, image in images[0].items()
    )
    loss = 2.0 * mean - 0.5 * sum(losses)
    hessian, added = (
        np.mean([arrays.numpy(estimate.require("explained", kind).matrix) for estimate in estimates], axis=0)
        for kind in (Hessian, HessianNoise)
    )
    one, other = (trees.ravel(estimate.gradient) for estimate in estimates)
    # A light that no view sees, or curvature that is noise, must not hide what the others explain.
    seen = np.diag(hessian) > _LEAST_EIGENVALUE * np.diag(added)
    if loss <= 0.0 or not np.isfinite(hessian).all() or not seen.any():
        return 0.0
    inverse = positive_inverse(hessian[np.ix_(seen, seen)], _LEAST_EIGENVALUE)
    return float(0.5 * one[seen] @ inverse @ other[seen] / loss)


def _eliminated(traits: Traits, keys: tuple[str, ...], plan: Plan) -> tuple[str, ...]:
    """Return the textures that a block of lights, cameras and lenses eliminates: reflectances and radiances, in their own coordinates and
    without a prior.

    Poses of shapes are left out. Edges show them, and where their own textures explain the rest, little but edges remains. The noise of the
    response, which both halves of the derivative images share, then narrows the widths until all is noise: the place of a painting beside
    its texture ended .018 away in place of .006, that of a ball .0013 in place of .0032.
    """
    unknowns, elements = plan.configured().unknowns, _elements(traits, keys)
    if not all(traits.infos[key].light or traits.infos[key].viewpoint for key in keys):
        return ()
    return tuple(
        key
        for key, unknown in unknowns.items()
        if key not in keys
        and traits.infos[key].brightness
        and can_be_eliminated(unknown)
        and elements * unknown.initial.size <= traits.constants.eliminated_values
    )


def _of_scattering(traits: Traits) -> list[str]:
    """Return the keys of numbers of BSDFs and media, on small films; none where path gradients were measured to be as good.

    One number alone is such a case: a roughness ended two to six times as far from the truth (`benchmarks/limit/notes.md`).
    """
    keys = [key for key, info in traits.infos.items() if info.scattering]
    small = traits.elements > 1 and traits.elements * traits.problem.pixels <= traits.constants.bsdf_pixels
    measured = traits.problem.loss.linear and _only_scattering_and_brightness(traits)
    return keys if keys and ((small and measured) or traits.unreachable) else []


def _only_scattering_and_brightness(traits: Traits) -> bool:
    """Return whether some unknowns shape BSDFs or media, and all others are colours, opacities, weights, or brightnesses of lights."""
    infos = traits.infos.values()
    others = all(info.scattering or info.lobe or info.brightness for info in infos)
    return others and any(info.scattering for info in infos)


def _few(traits: Traits, keys: tuple[str, ...]) -> bool:
    """Return whether these unknowns are few numbers that can be perturbed at low cost."""
    constants, shapes, elements = traits.constants, traits.problem.shapes(), _elements(traits, keys)
    small = all(len(shapes[key]) <= 1 and math.prod(shapes[key]) <= constants.number_size for key in keys)
    infos = [traits.infos[key] for key in keys]
    reached = all(info.perturbable for info in infos)
    without_paths = any(info.light and info.rigid and not info.differentiable for info in infos)
    most = constants.moved_lights if without_paths else constants.few_numbers
    costly = elements > most or elements * traits.problem.pixels > 8 * constants.difference_paths
    return small and reached and not costly


def _estimator(traits: Traits, keys: tuple[str, ...], images: float) -> GaussNewton:
    """Return the estimator of these unknowns; `images` is the least ratio of paths of the images to those of the derivative images."""
    constants, problem, elements = traits.constants, traits.problem, _elements(traits, keys)
    moved = [key for key in keys if key in traits.poses]
    poses = [key for key in moved if not traits.infos[key].light]
    fewest, most = constants.difference_spp
    if images >= 1.0 and moved and not poses and len(moved) == len(keys):  # all differences of a view share a launch
        most = max(most, LAUNCH * len(problem.views) // (elements * problem.pixels))
    differences = limited_spp(constants.difference_paths // (2 * elements), problem.pixels, (fewest, most))
    renders, least = 2 * elements * differences * problem.pixels, constants.block_paths
    if images >= 1.0:  # no block: states that differ in poses only are rendered together
        renders, least = cost(renders, 4 if len(moved) == len(keys) else 4 * elements), constants.number_paths
    paths = max(least, round(renders * images))
    spp = traits.options.spp or limited_spp(paths, problem.pixels, constants.number_spp)
    side = min(min(size) for size in problem.sizes)
    reach = constants.pose_reach if poses else constants.light_reach
    shift = constants.camera_shift if any(traits.infos[key].viewpoint for key in poses) else constants.pose_shift
    return GaussNewton(
        max(spp, 2),
        differences,
        tolerance=_damping(traits),
        coarse=max(shift * side, 1.0) if poses else None,
        largest={key: reach * width for key, width in widths_of(traits.options.sigma, problem, moved).items()},
        noise_limit=None if poses else constants.noise_limit,
    )


def _optimizer(traits: Traits, keys: tuple[str, ...]) -> AveragedNewton:
    linear = tuple(key for key in traits.lights if key in keys)
    if _moves_shapes(traits, keys):
        return AveragedNewton(averaging=traits.constants.pose_averaging, linear=linear)
    settles = not any(traits.infos[key].rigid or traits.infos[key].of_expression for key in keys)
    return AveragedNewton(settled_averaging=traits.constants.number_averaging if settles else None, linear=linear)


def _moves_shapes(traits: Traits, keys: tuple[str, ...]) -> bool:
    return any(key in traits.poses and not traits.infos[key].light for key in keys)


def _elements(traits: Traits, keys: tuple[str, ...]) -> int:
    shapes = traits.problem.shapes()
    return sum(math.prod(shapes[key]) for key in keys)


def _reason(traits: Traits, keys: tuple[str, ...], estimator: GaussNewton) -> str:
    elements = _elements(traits, keys)
    numbers = f"{elements} number{'s' * (elements > 1)}"
    return (
        f"Gauss-Newton steps for {numbers} from perturbed renders {_samples(estimator.spp, estimator.derivative_spp)}"
    )


def _samples(spp: int, derivative_spp: int) -> str:
    return f"({spp} samples per pixel of the image, {derivative_spp} of each perturbed render)"


def _damping(traits: Traits) -> float:
    """Return κ of Gauss-Newton steps, which is positive."""
    requested = 0.0 if traits.problem.loss.linear else traits.options.tolerance
    return requested or traits.constants.newton_tolerance
