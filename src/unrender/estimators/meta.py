"""Meta-estimation: a gradient estimate that combines all earlier estimates by finite differences, with its own variance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from unrender.core import arrays, checks, memory, trees
from unrender.core.arrays import Array
from unrender.core.checks import Count, Fraction
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, GradientAtBounds, Variance
from unrender.estimators.coordinates import bounded_with_preconditioner
from unrender.estimators.sample_groups import PIXELS, GradientRequest, GradientSample, check_pixels, draws_pixels
from unrender.images.base import ImageEstimator, PairRequest, Plain, needs_full_views
from unrender.pixels.base import MiniBatch, PixelSampler, RepeatableSampler, learned
from unrender.pixels.uniform import All
from unrender.rendering.renderer import Space
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler, upsampled
from unrender.statistics import meta

_PROPORTIONAL, _DIFFERENCE, _OBSERVED = 0, 1, 2  # streams of a step's random key
_PROPORTIONAL_SPP, _DIFFERENCE_SPP, _COUPLED_SPP = 2, 1, 3


@dataclass(frozen=True)
class MetaState:
    """State between steps: parameters of the last step, {key: meta-estimate and statistics of each element}, and states of the image
    estimator and of the pixel sampler. `step` counts steps of full views, `batches` those of mini-batches since; `free` is 0 for elements
    that stayed at a bound in the last step, see `HeldElements`."""

    parameters: Tree | None
    elements: dict[str, meta.State]
    image: Any
    pixels: Any = None
    step: int = 0
    batches: int = 0
    free: Tree = field(default_factory=dict)

    def starts_anew(self, parameters: Tree) -> bool:
        """Return whether no step preceded with parameters of these shapes."""
        return self.parameters is None or trees.shapes(self.parameters) != trees.shapes(parameters)

    def upsampled(self, upsampler: Upsampler) -> MetaState:
        image, pixels = upsampled(self.image, upsampler), upsampled(self.pixels, upsampler)
        if self.parameters is None:
            return replace(self, image=image, pixels=pixels)
        before = upsampler.tree(self.parameters)
        # Differences are stored per unit of step length, and the length of the same step grows with the number of elements.
        old = _distance(self.parameters, upsampler.parameters)
        new = _distance(before, upsampler.tree(upsampler.parameters))
        ratio = old / new if new > 0 else 1.0

        def moments(key: str, old_state: meta.Moments, factor: float) -> meta.Moments:
            mean = old_state.mean
            if not isinstance(mean, float) and arrays.shape(mean) == arrays.shape(old_state.square):
                mean = upsampler.array(key, mean, 1.0, factor)
            return meta.Moments(
                mean, upsampler.array(key, old_state.square, SQUARES, factor * factor), old_state.weight
            )

        def element(key: str, old_state: meta.State) -> meta.State:
            return meta.State(
                gradient=upsampler.array(key, old_state.gradient, 1.0),
                variance=upsampler.array(key, old_state.variance, SQUARES),
                alpha=upsampler.array(key, old_state.alpha),
                proportional=moments(key, old_state.proportional, 1.0),
                difference=moments(key, old_state.difference, ratio),
                steps=old_state.steps,
            )

        elements = {key: element(key, old_state) for key, old_state in self.elements.items()}
        return replace(self, parameters=before, elements=elements, image=image, pixels=pixels, free={})


def _distance(a: Tree, b: Tree) -> float:
    return math.sqrt(sum(arrays.number(memory.square(a[key] - b[key])) for key in a))


@register
@dataclass(frozen=True)
class MetaEstimator:
    """M_i = α_i (M_{i-1} + ΔF_i) + (1 − α_i) F_i: Eq. 7 of Balint et al. 2023, per element of each parameter.

    The independent form is the paper's. F uses `proportional_spp` samples per pixel, ΔF `difference_spp` other samples. For ΔF, one set of
    paths, traced in the current scene, gives the images and the adjoints of both states. The loss derivative of each state comes from a
    pair of images independent of those paths: the other sample groups or, for one sample per pixel, a separate pair.
    `difference_images="proportional"` takes that pair from F's samples, whose paths are then traced for both states: the loss derivatives
    of ΔF use the mean of `proportional_spp` samples, and ΔF traces its own paths once. F's samples are independent of ΔF's paths, so ΔF is
    unbiased. But F and ΔF then share the noise of an image, and the variance by Eq. 8, which assumes independence, lacks their covariance.

    The coupled form, an extension of the paper, computes F and the previous state's H from the same `spp` samples. M = F + w (M − H) with
    w from their covariance. Each sample serves both terms, at little more than the cost of a plain gradient. With
    `image=RecursiveControlVariate()` the images that the loss sees have a control variate too, from the same passes. For mini-batches
    it is that of the last full views, which costs an additional pass for the intermediate state.

    In path space the two states share directions, weighted by the current state's density: the paper's shift mapping, which reuses BSDF
    samples, in the solid angle measure, where its Jacobian is one. Var ΔF then decreases with the square of the step. If any parameter
    moves geometry, a path of one state is not valid in the other. The difference is then computed in primary sample space, from the
    same random numbers. `info["space"]` states the space of each parameter.

    Gradient and variance are with respect to v, where a parameter is x = φ(S v) with its parameterisation φ and preconditioner S
    (`Estimate.preconditioned`), because a variance per element cannot be mapped by S.

    Bias: none with `statistics="independent"`, a loss whose derivative is linear and plain images, along a path of parameters that does
    not depend on the samples; the path of an optimisation depends on them slightly. With "shared" statistics, the paper's choice, α
    depends on the samples that it weights, which biases the gradient towards zero, mostly at the start. The variance is that of the
    recurrence (15): a zero-centred second moment, so too large where the gradient exceeds the noise of one step. With a control
    variate, successive steps also share its image, which the recurrence does not model. The gradient then has the bias of that image,
    and is somewhat noisier than its variance. The state is reset if a parameter changes its shape.

    Args:
        proportional_spp: samples per pixel and view of F in the independent form, >= 1; 2 by default.
        difference_spp: samples per pixel and view of ΔF in the independent form, >= 1; 1 by default.
        coupled: whether to use the coupled form.
        spp: samples per pixel and view in the coupled form, >= 1; 3 by default; at 1 the adjoint has a second set of paths.
        image: estimator of the image that the loss sees, in the coupled form; the independent form uses plain images.
        pixels: pixel sampler; F and ΔF of the independent form have different samples with the same probabilities.
        space: "path", "primary", or "auto": path space if all parameters share paths.
        beta_proportional: β_F, decay of the mean square of F, in [0, 1).
        beta_difference: β_Δ, decay of the mean square of ΔF / ‖Δπ‖, in [0, 1).
        clip: whether to clamp α to at most 1 / (2 − α_{i-1}) (Eq. 17).
        max_weight: upper bound of α, in (0, 1]; 1 in the paper. With a smaller value, noise decays after about 1 / (1 − max_weight)
            steps. With 1 it persists, and the optimizer cannot average an error that is the same in every step.
        centred: whether to use variances about the mean instead of mean squares. For comparison (Fig. 5).
        decouple: whether to divide ΔF by the step before averaging (Eq. 13). For comparison (Fig. 5).
        statistics: "shared" estimates variances from the samples of the sum; "independent" from as many others, at twice the cost.
        difference_images: images of both states for the loss derivatives of ΔF: "own", or "proportional", F's. The latter requires the
            independent form and full views, `pixels.All()`. In path space it saves a pass if `difference_spp` cannot be divided into
            groups, such as 1; otherwise it saves nothing.
    """

    proportional_spp: Count | None = None
    difference_spp: Count | None = None
    coupled: bool = False
    spp: Count | None = None
    image: ImageEstimator = field(default_factory=Plain)
    space: Space | Literal["auto"] = "auto"
    beta_proportional: Fraction = meta.BETA_PROPORTIONAL
    beta_difference: Fraction = meta.BETA_DIFFERENCE
    clip: bool = True
    max_weight: float = 1.0
    centred: bool = False
    decouple: bool = True
    statistics: Literal["shared", "independent"] = "shared"
    pixels: PixelSampler = field(default_factory=All)
    difference_images: Literal["own", "proportional"] = "own"

    def __post_init__(self):
        checks.fields(self)
        for name, coupled, default in (
            ("proportional_spp", False, _PROPORTIONAL_SPP),
            ("difference_spp", False, _DIFFERENCE_SPP),
            ("spp", True, _COUPLED_SPP),
        ):
            value = getattr(self, name)
            if value is not None:
                if coupled != self.coupled:
                    form = "coupled" if coupled else "independent"
                    raise InputError(f"MetaEstimator: {name} is for the {form} form; give coupled={coupled} with it")
            elif coupled == self.coupled:
                object.__setattr__(self, name, default)
        if not checks.number("MetaEstimator", "max_weight", self.max_weight, above=0.0) <= 1:
            raise InputError(f"MetaEstimator: max_weight must be in (0, 1], got {self.max_weight!r}")
        if not self.coupled and not isinstance(self.image, Plain):
            raise InputError("MetaEstimator: image is for the coupled form; give coupled=True with it")
        if self.difference_images == "proportional" and (self.coupled or not isinstance(self.pixels, All)):
            raise InputError(
                'MetaEstimator: difference_images="proportional" requires the independent form and full views; leave it out, or '
                "give coupled=False and pixels=unrender.pixels.All()"
            )
        if self.statistics == "independent" and not isinstance(self.image, Plain):
            raise InputError(
                'MetaEstimator: statistics="independent" requires plain images, since those of a control variate are correlated'
            )
        fewest = min(n for n in (self.proportional_spp, self.difference_spp, self.spp) if n is not None)
        check_pixels("MetaEstimator", self.pixels, self.image, fewest)
        if self.image.space is not None and self.space not in ("auto", self.image.space):
            raise InputError(
                f'MetaEstimator: space="{self.space}" is not that of {type(self.image).__name__}(space="{self.image.space}")'
            )

    provides = Capabilities(Gradient, Variance)

    def init(self, problem: Problem, parameters: Tree) -> MetaState:
        """Return the state before the first step. Raise `InputError` for a parameter whose values share no paths, with `space="path"`."""
        problem.renderer.prepare(list(parameters), self._space(problem, parameters))
        return MetaState(None, {}, self.image.init(problem, parameters), self.pixels.init(problem, parameters))

    def estimate(self, problem: Problem, parameters: Tree, state: MetaState, key: Key) -> tuple[Estimate, MetaState]:
        """Return an estimate and the next state. `info`: "samples" (paths traced for images and adjoints), "images" per view, "space"
        and "alpha" (the weight of the past) per parameter, and the info of the image estimator, per view."""
        if state.parameters is None or state.starts_anew(parameters):
            elements, previous = {name: meta.init(x) for name, x in parameters.items()}, parameters
            step_norm: Array = 0.0
        else:
            elements, previous = state.elements, state.parameters
            of = problem.coordinates.of
            moved = trees.subtract(of(parameters), of(previous))
            step_norm = arrays.sqrt(sum(memory.square(x) for x in moved.values()))
            del moved
        space = self._space(problem, parameters)
        pair = PairRequest(previous, space, state.step, state.batches)
        take = self._coupled if self.coupled else self._independent
        first, second, step, pixels = take(problem, parameters, state, pair, key)
        observed, samples = None, step.samples
        if self.statistics == "independent":
            again = replace(state, pixels=pixels)
            further = key.fold(_OBSERVED)
            *observed, more, pixels = take(problem, parameters, again, pair, further, first=False)
            samples += more.samples
        rule = meta.update_coupled if self.coupled else meta.update
        # The past has no weight where gradients of other elements were smoothed.
        held = problem.coordinates.held
        kept = {name: S.unchanged(state.free.get(name)) for name, S in held.items()}
        results = {
            name: rule(
                elements[name],
                first[name],
                second[name],
                step_norm,
                beta_proportional=self.beta_proportional,
                beta_difference=self.beta_difference,
                clip=self.clip,
                max_weight=self.max_weight * kept.get(name, 1.0),
                centred=self.centred,
                decouple=self.decouple,
                observed=None if observed is None else (observed[0][name], observed[1][name]),
            )
            for name in parameters
        }
        gradient, variance, alpha = ({name: parts[n] for name, parts in results.items()} for n in range(3))
        elements = {name: parts[3] for name, parts in results.items()}
        del first, second, observed, results
        steps = (state.step + 1, 0) if self._renders_full_views(parameters, state) else (state.step, state.batches + 1)
        free = {name: S.free for name, S in held.items()}
        after = MetaState(parameters, elements, step.image, pixels, *steps, free)
        arrays.evaluate(gradient, variance, alpha, after, step.losses, step.info)
        info = {
            "samples": samples,
            "images": step.images,
            "space": dict.fromkeys(parameters, space),
            "alpha": alpha,
            **step.info,
        }
        loss = sum(arrays.number(value) for value in step.losses)
        fresh = GradientAtBounds({name: step.gradient[name] for name in bounded_with_preconditioner(problem)})
        return Estimate(loss, gradient, (Variance(variance), fresh), info, preconditioned=True), after

    def _space(self, problem: Problem, parameters: Tree) -> Space:
        if self.space != "auto":
            return self.space
        if self.image.space is not None:
            return self.image.space
        known = problem.renderer.parameters()
        return "path" if all(known[key].shares_paths for key in parameters) else "primary"

    def _independent(
        self, problem: Problem, parameters: Tree, state: MetaState, pair: PairRequest, key: Key, first: bool = True
    ) -> tuple[Tree, Tree, GradientSample, Any]:
        """Return F, ΔF from independent samples, the sample of F with the cost of both, and the pixel sampler's next state. `first`:
        see `_sample`."""
        spp, difference_spp = self.proportional_spp or _PROPORTIONAL_SPP, self.difference_spp or _DIFFERENCE_SPP
        fresh = state.starts_anew(parameters)
        at_once = self.difference_images == "proportional" and not fresh
        difference = replace(pair, difference_spp=difference_spp) if at_once else None
        step, pixels = self._sample(problem, parameters, state, spp, key.fold(_PROPORTIONAL), difference, first=first)
        coordinates = problem.coordinates
        slopes, before = coordinates.slopes(parameters), coordinates.slopes(pair.previous)
        F = coordinates.pull_back(step.gradient, slopes)
        if fresh:  # the first step has no difference
            return F, trees.zeros_like(F), step, pixels
        current, previous, samples = step.paired, step.previous, step.samples
        if not at_once:
            again, further = replace(state, pixels=pixels), key.fold(_DIFFERENCE)
            both, pixels = self._sample(problem, parameters, again, difference_spp, further, pair, first=False)
            current, previous, samples = both.gradient, both.previous, samples + both.samples
        now, then = coordinates.pull_back(current, slopes), coordinates.pull_back(previous, before)
        change = trees.subtract(now, then)
        memory.evaluate_in_turn(change)
        return F, change, replace(step, samples=samples), pixels

    def _coupled(
        self, problem: Problem, parameters: Tree, state: MetaState, pair: PairRequest, key: Key, first: bool = True
    ) -> tuple[Tree, Tree, GradientSample, Any]:
        """Return F, H of the previous state from the same samples, their sample, and the pixel sampler's next state. `first`: see
        `_sample`."""
        spp = self.spp or _COUPLED_SPP
        step, pixels = self._sample(problem, parameters, state, spp, key, pair, first=first)
        coordinates = problem.coordinates
        F = coordinates.pull_back(step.gradient, coordinates.slopes(parameters))
        H = coordinates.pull_back(step.previous, coordinates.slopes(pair.previous))
        return F, H, step, pixels

    def _sample(
        self,
        problem: Problem,
        parameters: Tree,
        state: MetaState,
        spp: int,
        key: Key,
        pair: PairRequest | None = None,
        first: bool = True,
    ) -> tuple[GradientSample, Any]:
        """Return a gradient with its own pixel sample, and the pixel sampler's next state. That state only advances for the `first`
        sample of a step."""
        draw_key = key.fold(PIXELS)
        mini_batch = draws_pixels(self.pixels)
        if mini_batch and self._renders_full_views(parameters, state):
            batch, pixels = MiniBatch(None), state.pixels
        elif first or not isinstance(self.pixels, RepeatableSampler):
            batch, pixels = self.pixels.draw(problem, parameters, state.pixels, draw_key)
        else:
            batch, pixels = self.pixels.redraw(problem, state.pixels, draw_key), state.pixels
        request = GradientRequest(parameters, self.image, state.image, spp, key, pair_request=pair, batch=batch)
        step = problem.executor.estimate_gradient(problem, request)
        if first:
            pixels = self.pixels.observe(problem, pixels, problem.coordinates.wrt_u(step.gradient, parameters))
            pixels = learned(self.pixels, problem, pixels, batch.sample, step.draws)
            if mini_batch and batch.sample is None:
                step = replace(step, image=problem.executor.prepare_images(problem, self.image, step.image))
        return step, pixels

    def _renders_full_views(self, parameters: Tree, state: MetaState) -> bool:
        """Return whether a step renders full views: always without mini-batches, else if the image estimator requires it."""
        return not draws_pixels(self.pixels) or needs_full_views(self.image, parameters, state.image, state.batches)
