"""Meta-estimation: a gradient estimate that combines all earlier ones, updated by finite differences, with its own variance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from unrender.core import arrays, checks, memory, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.registry import register
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate
from unrender.estimators.capabilities import Capabilities, Gradient, PastWeight, Variance
from unrender.estimators.sample_groups import PIXELS, GradientRequest, GradientSample, check_pixels, draws_pixels
from unrender.images.base import ImageEstimator, PairRequest
from unrender.images.plain import Plain
from unrender.pixels.all import All
from unrender.pixels.base import MiniBatch, PixelSampler, RepeatableSampler, learned
from unrender.rendering.renderer import Space
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler, upsampled
from unrender.statistics import meta

_PROPORTIONAL, _DIFFERENCE, _OBSERVED = 0, 1, 2  # streams of a step's key
_PROPORTIONAL_SPP, _DIFFERENCE_SPP, _COUPLED_SPP = 2, 1, 3


@dataclass(frozen=True)
class MetaState:
    """State between steps.

    Attributes:
        parameters: of the last step; None before the first.
        elements: {key: meta-estimate and statistics of each element of its gradient}; empty before the first step.
        image: the image estimator's, in the coupled form.
        pixels: the pixel sampler's.
        step: how many steps of whole views were made; see `PairRequest.step`.
        batches: steps with pixel mini-batches since the last of whole views.
    """

    parameters: Tree | None
    elements: dict[str, meta.State]
    image: Any
    pixels: Any = None
    step: int = 0
    batches: int = 0

    def upsampled(self, upsampler: Upsampler) -> MetaState:
        """See `Upsamplable`: gradients, their moments and the previous parameters are interpolated."""
        image, pixels = upsampled(self.image, upsampler), upsampled(self.pixels, upsampler)
        if self.parameters is None:
            return replace(self, image=image, pixels=pixels)
        before = upsampler.tree(self.parameters)
        # Differences are kept per unit of a step's length, and the same step is longer where it has more elements.
        old = _distance(self.parameters, upsampler.parameters)
        new = _distance(before, upsampler.tree(upsampler.parameters))
        ratio = old / new if new > 0 else 1.0

        def moments(key: str, given: meta.Moments, factor: float) -> meta.Moments:
            mean = upsampler.array(key, given.mean, 1.0, factor) if given.has_mean else given.mean
            return meta.Moments(mean, upsampler.array(key, given.square, SQUARES, factor * factor), given.weight)

        def element(key: str, given: meta.State) -> meta.State:
            return meta.State(
                gradient=upsampler.array(key, given.gradient, 1.0),
                variance=upsampler.array(key, given.variance, SQUARES),
                alpha=upsampler.array(key, given.alpha),
                proportional=moments(key, given.proportional, 1.0),
                difference=moments(key, given.difference, ratio),
                steps=given.steps,
            )

        elements = {key: element(key, given) for key, given in self.elements.items()}
        return replace(self, parameters=before, elements=elements, image=image, pixels=pixels)


def _distance(a: Tree, b: Tree) -> float:
    """The Euclidean distance of two trees."""
    return math.sqrt(sum(arrays.number(memory.square(a[key] - b[key])) for key in a))


@register
@dataclass(frozen=True)
class MetaEstimator:
    """M_i = α_i (M_{i-1} + ΔF_i) + (1 − α_i) F_i: Eq. 7 of Balint et al. 2023, per element of each parameter.

    The independent form is the paper's. F comes from `proportional_spp` samples per pixel. ΔF comes from `difference_spp`
    others: one set of paths, traced in the current scene, gives the images and the adjoints of both states, and the loss
    derivative of each state comes from a pair of images independent of those paths (the other sample groups; for one sample per
    pixel, a pair of its own). `difference_images="proportional"` takes that pair from F's samples: the loss derivatives of ΔF are at the
    mean of their `proportional_spp`, whose paths are traced for both states, and ΔF traces its own paths once. F's samples are independent
    of ΔF's paths, so that ΔF stays unbiased; but F and ΔF then share the noise of an image, and Eq. 8, which takes them for independent,
    tells the variance without their covariance.

    The coupled form, beyond the paper, takes F and the previous state's H from the same `spp` samples and computes
    M = F + w (M − H), with w from their covariance: each sample serves both terms, at little more than the cost of a plain one. With
    `image=RecursiveControlVariate()` the images that the loss sees have a control variate too, from the same passes; of mini-batches it is
    that of the last whole views, and a pass for the state in between comes with it.

    In path space the two states share directions, weighted by the current state's density: the paper's shift mapping, which
    reuses BSDF samples, in the solid angle measure, where its Jacobian is one. Var ΔF then falls with the square of the step.
    Where any parameter moves geometry, a path of one state is not valid in the other, and the whole difference is taken in
    primary sample space, from the same random numbers: `info["space"]` says which was taken, for each parameter.

    Gradient and variance are by v where a parameter is x = φ(S v) with its parameterisation and preconditioner
    (`Estimate.preconditioned`): a variance per element does not pass through S.

    Bias: none with `statistics="independent"`, a loss whose derivative is linear and plain images, along a path of parameters that does not
    depend on the samples; a descent's own path depends on them a little. With "shared" statistics, the paper's choice, α
    depends on the samples that it weighs, which biases the gradient toward zero, most at the start. The variance is that of the
    recurrence (15): a zero-centred second moment, so too large where the gradient exceeds the noise of one step. With a control
    variate, successive steps also share its image, which the recurrence does not model: the gradient is biased as that image is, and
    somewhat noisier than its variance says. The state starts anew when a parameter changes its shape.

    Args:
        proportional_spp: samples per pixel and view of F in the independent form, >= 1; 2 where none is given.
        difference_spp: of ΔF in the independent form, >= 1; 1 where none is given.
        coupled: take the coupled form.
        spp: samples per pixel and view in the coupled form, >= 1; 3 where none is given; at 1 the adjoint gets a second set of paths.
        image: estimates the image that the loss sees, in the coupled form; the independent form uses plain images.
        pixels: the pixels of a step; F and ΔF of the independent form draw their own, with the same probabilities.
        space: "path", "primary", or "auto": path space where all parameters share paths.
        beta_proportional: β_F, decay of the mean square of F, in [0, 1).
        beta_difference: β_Δ, decay of the mean square of ΔF / ‖Δπ‖, in [0, 1).
        clip: hold α below 1 / (2 − α_{i-1}) (Eq. 17).
        max_weight: upper bound of α, in (0, 1]; 1 in the paper. Below, noise is forgotten after some 1 / (1 − max_weight) steps. With 1 it
            lasts as long as the run, and the optimizer cannot average what stays the same from step to step.
        centred: variances about the mean in place of mean squares. For comparison (Fig. 5).
        decouple: divide ΔF by the step before averaging (Eq. 13). For comparison (Fig. 5).
        statistics: "shared" estimates variances from the samples that it sums; "independent" from as many more, at twice the cost.
        difference_images: of both states, at which the loss derivatives of ΔF are: "own", or "proportional", F's. That is for the
            independent form and whole views, `pixels.All()`. In path space it saves a pass where `difference_spp` cannot be divided into
            groups, as 1 cannot; elsewhere it saves nothing.
    """

    proportional_spp: int | None = None
    difference_spp: int | None = None
    coupled: bool = False
    spp: int | None = None
    image: ImageEstimator = field(default_factory=Plain)
    space: Space | Literal["auto"] = "auto"
    beta_proportional: float = meta.BETA_PROPORTIONAL
    beta_difference: float = meta.BETA_DIFFERENCE
    clip: bool = True
    max_weight: float = 1.0
    centred: bool = False
    decouple: bool = True
    statistics: Literal["shared", "independent"] = "shared"
    pixels: PixelSampler = field(default_factory=All)
    difference_images: Literal["own", "proportional"] = "own"

    def __post_init__(self):
        for name, coupled, default in (
            ("proportional_spp", False, _PROPORTIONAL_SPP),
            ("difference_spp", False, _DIFFERENCE_SPP),
            ("spp", True, _COUPLED_SPP),
        ):
            given = getattr(self, name)
            if given is not None:
                checks.integer("MetaEstimator", name, given, at_least=1)
                if coupled != self.coupled:
                    form = "coupled" if coupled else "independent"
                    raise InputError(f"MetaEstimator: {name} is for the {form} form; give coupled={coupled} with it")
            elif coupled == self.coupled:
                object.__setattr__(self, name, default)
        for name in ("beta_proportional", "beta_difference"):
            checks.number("MetaEstimator", name, getattr(self, name), above=0.0, below=1.0, inclusive=True)
        if not checks.number("MetaEstimator", "max_weight", self.max_weight, above=0.0) <= 1:
            raise InputError(f"MetaEstimator: max_weight must be in (0, 1], got {self.max_weight!r}")
        for name, choices in (
            ("space", ("auto", "path", "primary")),
            ("statistics", ("shared", "independent")),
            ("difference_images", ("own", "proportional")),
        ):
            if getattr(self, name) not in choices:
                raise InputError(
                    f"MetaEstimator: {name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}"
                )
        if not self.coupled and not isinstance(self.image, Plain):
            raise InputError("MetaEstimator: image is for the coupled form; give coupled=True with it")
        if self.difference_images == "proportional" and (self.coupled or not isinstance(self.pixels, All)):
            raise InputError(
                'MetaEstimator: difference_images="proportional" is for the independent form and whole views; leave it out, or '
                "give coupled=False and pixels=unrender.pixels.All()"
            )
        if self.statistics == "independent" and not isinstance(self.image, Plain):
            raise InputError(
                'MetaEstimator: statistics="independent" goes with plain images; those of a control variate share their memory'
            )
        fewest = min(n for n in (self.proportional_spp, self.difference_spp, self.spp) if n is not None)
        check_pixels("MetaEstimator", self.pixels, self.image, fewest)
        if self.image.space is not None and self.space not in ("auto", self.image.space):
            raise InputError(
                f'MetaEstimator: space="{self.space}" is not that of {type(self.image).__name__}(space="{self.image.space}")'
            )

    @property
    def provides(self) -> Capabilities:
        """A gradient, its variance, and the weight of earlier ones in it."""
        return Capabilities(Gradient, Variance, PastWeight)

    def init(self, problem: Problem, parameters: Tree) -> MetaState:
        """See `Estimator.init`. Raises `InputError` for a parameter whose values share no paths, with `space="path"`."""
        problem.renderer.prepare(list(parameters), self._space(problem, parameters))
        return MetaState(None, {}, self.image.init(problem, parameters), self.pixels.init(problem, parameters))

    def estimate(self, problem: Problem, parameters: Tree, state: MetaState, key: Key) -> tuple[Estimate, MetaState]:
        """See `Estimator.estimate`. `info`: "samples" (paths traced for images and adjoints), "images" per view, "space" and
        "alpha" (the weight of the past) per parameter, and the info of the image estimator, per view."""
        fresh = state.parameters is None or trees.shapes(state.parameters) != trees.shapes(parameters)
        if fresh or state.parameters is None:
            elements, previous = {name: meta.init(x) for name, x in parameters.items()}, parameters
            step_norm: Array = 0.0
        else:
            elements, previous = state.elements, state.parameters
            of = problem.coordinates.of
            moved = trees.subtract(of(parameters), of(previous))
            step_norm = arrays.sqrt(sum(memory.square(x) for x in moved.values()))
            del moved
        space = self._space(problem, parameters)
        pair_request = PairRequest(previous, space, state.step, state.batches)
        take = self._coupled if self.coupled else self._independent
        first, second, step, pixels = take(problem, parameters, state, pair_request, fresh, key)
        observed, samples = None, step.samples
        if self.statistics == "independent":
            again = replace(state, pixels=pixels)
            further = key.fold(_OBSERVED)
            *observed, more, pixels = take(problem, parameters, again, pair_request, fresh, further, first=False)
            samples += more.samples
        rule = meta.update_coupled if self.coupled else meta.update
        found = {
            name: rule(
                elements[name],
                first[name],
                second[name],
                step_norm,
                beta_proportional=self.beta_proportional,
                beta_difference=self.beta_difference,
                clip=self.clip,
                max_weight=self.max_weight,
                centred=self.centred,
                decouple=self.decouple,
                observed=None if observed is None else (observed[0][name], observed[1][name]),
            )
            for name in parameters
        }
        gradient, variance, alpha = ({name: parts[n] for name, parts in found.items()} for n in range(3))
        elements = {name: parts[3] for name, parts in found.items()}
        del first, second, observed, found
        steps = (state.step + 1, 0) if self._whole(parameters, state) else (state.step, state.batches + 1)
        after = MetaState(parameters, elements, step.image, pixels, *steps)
        arrays.evaluate(gradient, variance, alpha, after, step.losses, step.info)
        info = {
            "samples": samples,
            "images": step.images,
            "space": dict.fromkeys(parameters, space),
            "alpha": alpha,
            **step.info,
        }
        loss = sum(arrays.number(value) for value in step.losses)
        return Estimate(loss, gradient, (Variance(variance), PastWeight(alpha)), info, preconditioned=True), after

    def _space(self, problem: Problem, parameters: Tree) -> Space:
        if self.space != "auto":
            return self.space
        if self.image.space is not None:
            return self.image.space
        known = problem.renderer.parameters()
        return "path" if all(known[key].shares_paths for key in parameters) else "primary"

    def _independent(
        self,
        problem: Problem,
        parameters: Tree,
        state: MetaState,
        pair_request: PairRequest,
        fresh: bool,
        key: Key,
        first: bool = True,
    ) -> tuple[Tree, Tree, GradientSample, Any]:
        """F, ΔF from independent samples, the sample of F with the cost of both, and the pixel sampler's next state. `first`: as for
        `_sample`."""
        spp, difference_spp = self.proportional_spp or _PROPORTIONAL_SPP, self.difference_spp or _DIFFERENCE_SPP
        at_once = self.difference_images == "proportional" and not fresh
        asked = replace(pair_request, difference_spp=difference_spp) if at_once else None
        step, pixels = self._sample(problem, parameters, state, spp, key.fold(_PROPORTIONAL), asked, first=first)
        coordinates = problem.coordinates
        slopes, before = coordinates.slopes(parameters), coordinates.slopes(pair_request.previous)
        F = coordinates.pull_back(step.gradient, slopes)
        if fresh:  # no change to be estimated
            return F, trees.zeros_like(F), step, pixels
        current, previous, samples = step.paired, step.previous, step.samples
        if not at_once:
            again, further = replace(state, pixels=pixels), key.fold(_DIFFERENCE)
            pair, pixels = self._sample(problem, parameters, again, difference_spp, further, pair_request, first=False)
            current, previous, samples = pair.gradient, pair.previous, samples + pair.samples
        now, then = coordinates.pull_back(current, slopes), coordinates.pull_back(previous, before)
        difference = trees.subtract(now, then)
        memory.evaluate_in_turn(difference)
        return F, difference, replace(step, samples=samples), pixels

    def _coupled(
        self,
        problem: Problem,
        parameters: Tree,
        state: MetaState,
        pair_request: PairRequest,
        fresh: bool,
        key: Key,
        first: bool = True,
    ) -> tuple[Tree, Tree, GradientSample, Any]:
        """F, H of the previous state from the same samples, their sample, and the pixel sampler's next state. `first`: as for `_sample`."""
        del fresh
        spp = self.spp or _COUPLED_SPP
        step, pixels = self._sample(problem, parameters, state, spp, key, pair_request, first=first)
        coordinates = problem.coordinates
        F = coordinates.pull_back(step.gradient, coordinates.slopes(parameters))
        H = coordinates.pull_back(step.previous, coordinates.slopes(pair_request.previous))
        return F, H, step, pixels

    def _sample(
        self,
        problem: Problem,
        parameters: Tree,
        state: MetaState,
        spp: int,
        key: Key,
        pair_request: PairRequest | None = None,
        first: bool = True,
    ) -> tuple[GradientSample, Any]:
        """A gradient of pixels of its own, and the pixel sampler's next state. Where it is not the `first` of a step, that state stays: the
        step has been counted, and its gradient observed."""
        draw_key = key.fold(PIXELS)
        drawn = draws_pixels(self.pixels)
        if drawn and self._whole(parameters, state):
            batch, pixels = MiniBatch(None), state.pixels
        elif first or not isinstance(self.pixels, RepeatableSampler):
            batch, pixels = self.pixels.draw(problem, parameters, state.pixels, draw_key)
        else:
            batch, pixels = self.pixels.redraw(problem, state.pixels, draw_key), state.pixels
        request = GradientRequest(parameters, self.image, state.image, spp, key, pair_request=pair_request, batch=batch)
        step = problem.executor.estimate_gradient(problem, request)
        if first:
            pixels = self.pixels.observe(problem, pixels, problem.coordinates.wrt_u(step.gradient, parameters))
            pixels = learned(self.pixels, problem, pixels, batch.sample, step.draws)
            if drawn and batch.sample is None:
                step = replace(step, image=problem.executor.prepare_images(problem, self.image, step.image))
        return step, pixels

    def _whole(self, parameters: Tree, state: MetaState) -> bool:
        """Whether a step renders whole views: all do, or the image estimator needs them."""
        return not draws_pixels(self.pixels) or self.image.needs_whole_views(parameters, state.image, state.batches)
