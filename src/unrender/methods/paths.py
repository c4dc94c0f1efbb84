"""Methods on path gradients: `plain`, `rcv` (Nicolet et al. 2023), `adaptive`, `meta` and `coupled` (Balint et al. 2023), and `stock`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, FiniteFloat, NonNegativeInt, PositiveFloat, PositiveInt

from unrender.core import lazy
from unrender.core.registry import register
from unrender.methods.base import SCHEDULE_HELP, Options, parse_schedule

if TYPE_CHECKING:
    from unrender import estimators, images, optimizers, pixels
    from unrender.estimators.base import Estimator
    from unrender.images.base import ImageEstimator
    from unrender.optimizers.base import Optimizer
    from unrender.pixels.base import PixelSampler
else:  # options are checked without Dr.Jit
    estimators, images, optimizers, pixels = lazy.modules("estimators", "images", "optimizers", "pixels")


class AdamOptions(Options):
    """Options of methods that use Adam."""

    learning_rate: PositiveFloat = Field(0.01, description="learning rate of parameters without their own")
    beta_1: FiniteFloat = Field(0.9, ge=0, lt=1, description="decay of Adam's mean gradient")
    beta_2: FiniteFloat = Field(0.999, ge=0, lt=1, description="decay of Adam's mean squared gradient")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)
    one_rate: bool = Field(
        False, description="whether all elements of a parameter share one step scale, for mesh vertices"
    )

    def optimizer(self) -> Optimizer:
        """Return Adam with these options."""
        schedule = parse_schedule(self.schedule)
        return optimizers.Adam(self.learning_rate, self.beta_1, self.beta_2, schedule=schedule, uniform=self.one_rate)


class SamplingOptions(AdamOptions):
    """Options of the path sampling of `PathGradient`."""

    emitters: Literal["scene", "adaptive"] = Field(
        "scene",
        description="how a path selects one of several emitters: by the scene's weights, or by the gradient's variance",
    )
    differential_bsdf: bool = Field(
        False,
        description="whether derivatives with respect to the alpha of rough conductors use separate antithetic pairs of paths",
    )

    def sampling(self) -> dict[str, Any]:
        """Return these options as arguments of `PathGradient`."""
        return {"emitters": self.emitters, "differential_bsdf": self.differential_bsdf}


class PathOptions(SamplingOptions):
    """Options of methods that use path gradients."""

    spp: PositiveInt = Field(8, description="samples per pixel; from 2 on, the adjoint shares their paths")
    adjoint_spp: PositiveInt | None = Field(None, description="samples per pixel of an adjoint with separate paths")
    counts: Literal["equal", "adaptive"] = Field(
        "equal",
        description="samples of each pixel: spp, or spp on average with more where the gradient's variance is high",
    )
    denoise: bool = Field(False, description="whether the loss uses denoised images (biased; extra unrender[denoise])")

    def estimator(self, image: ImageEstimator) -> Estimator:
        """Return the path gradient of the loss at this image estimator's images."""
        sampler = pixels.AdaptiveCounts() if self.counts == "adaptive" else pixels.All()
        image_estimator = images.Denoised(image) if self.denoise else image
        return estimators.PathGradient(image_estimator, sampler, self.spp, self.adjoint_spp, **self.sampling())


@register(name="plain", position=1)
class PlainMethod(PathOptions):
    """a new rendering at each step, leave-one-out sample groups, Adam"""

    def build(self) -> tuple[Estimator, Optimizer]:
        return self.estimator(images.Plain()), self.optimizer()


@register(name="rcv", position=2)
class RecursiveControlVariateMethod(PathOptions):
    """recursive control variates, which reuse earlier renderings of the image (Nicolet et al. 2023), Adam"""

    spp: PositiveInt = Field(2, description="samples per pixel; from 2 on, the adjoint shares their paths")
    space: Literal["path", "primary"] = Field(
        "path",
        description="what two steps share: paths (materials, emitters, meshes), or random numbers (any parameter)",
    )
    alpha: FiniteFloat = Field(0.9, ge=0, lt=1, description="decay of the means in the control weight")
    beta: FiniteFloat = Field(0.999, ge=0, lt=1, description="decay of the covariances in the control weight")
    max_weight: FiniteFloat = Field(
        1.0,
        gt=0,
        le=1,
        description="upper bound of the control weight: 0.95 forgets errors of the image after about 20 steps",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        image = images.RecursiveControlVariate(self.space, self.alpha, self.beta, max_weight=self.max_weight)
        return self.estimator(image), self.optimizer()


@register(name="adaptive", position=5)
class AdaptiveMethod(SamplingOptions):
    """pixel mini-batches from all views, sampled where the gradient's variance is high, Adam"""

    pixels: PositiveInt = Field(4096, description="pixels per step, sampled from all pixels of all views")
    scheme: Literal["adaptive", "loss", "uniform"] = Field(
        "adaptive",
        description="pixel probabilities: by the gradient's variance, in proportion to the loss derivative, or uniform",
    )
    spp: PositiveInt = Field(
        2, description="samples per pixel of the mini-batch; from 2 on, the adjoint shares their paths"
    )
    levels: NonNegativeInt = Field(0, description="coarser resolutions in the probabilities of the scheme adaptive")
    refresh: PositiveInt = Field(20, description="steps between estimates of the probabilities")
    uniform: PositiveFloat | None = Field(
        None, le=1, description="fraction of uniform samples; by default it is chosen from the samples"
    )
    image: Literal["plain", "rcv"] = Field(
        "plain", description="image estimator: a new rendering, or rcv's control variate, with some steps of full views"
    )
    whole_views: PositiveInt = Field(20, description="steps between two steps of full views, with the image rcv")

    def build(self) -> tuple[Estimator, Optimizer]:
        image = (
            images.Plain() if self.image == "plain" else images.RecursiveControlVariate(whole_views=self.whole_views)
        )
        return estimators.PathGradient(image, self._sampler(), self.spp, **self.sampling()), self.optimizer()

    def _sampler(self) -> PixelSampler:
        guided: dict[str, Any] = {"refresh": self.refresh}
        if self.uniform is not None:
            guided["uniform"] = self.uniform
        if self.scheme == "adaptive":
            return pixels.Adaptive(self.pixels, self.levels, **guided)
        if self.scheme == "loss":
            return pixels.LossProportional(self.pixels, **guided)
        return pixels.Uniform(self.pixels)


@register(name="stock", position=8)
class StockMethod(AdamOptions):
    """the loop of Mitsuba's tutorials, for comparison: mi.render with prb, dr.backward, Adam"""

    spp: PositiveInt = Field(16, description="samples per pixel of the image, and as many of the adjoint")

    def build(self) -> tuple[Estimator, Optimizer]:
        return estimators.StockGradient(self.spp), self.optimizer()


class MetaCommonOptions(Options):
    """Options of `meta` and `coupled`."""

    optimizer: Literal["meta-adam", "adam"] = Field(
        "meta-adam", description="optimizer; adam, which assumes independent gradients, is for comparison"
    )
    learning_rate: PositiveFloat = Field(0.002, description="learning rate of parameters without their own")
    schedule: str | None = Field(None, description=SCHEDULE_HELP)
    space: Literal["auto", "path", "primary"] = Field(
        "auto", description="what two steps share: paths, random numbers, or paths if all parameters allow it"
    )
    beta_proportional: FiniteFloat = Field(
        0.99, ge=0, lt=1, description="decay of the mean square of the gradient samples"
    )
    beta_difference: FiniteFloat = Field(
        0.9, ge=0, lt=1, description="decay of the mean square of their differences per step length"
    )
    max_weight: FiniteFloat = Field(
        1.0,
        gt=0,
        le=1,
        description="upper bound of the weight of the past: 0.9 forgets noise of the gradient after about 10 steps",
    )

    def built_optimizer(self) -> Optimizer:
        """Return the optimizer with these options."""
        schedule = parse_schedule(self.schedule)
        if self.optimizer == "adam":
            return optimizers.Adam(self.learning_rate, schedule=schedule)
        return optimizers.MetaAdam(self.learning_rate, schedule=schedule)

    def shared(self) -> dict[str, Any]:
        """Return the arguments that both forms of `MetaEstimator` share."""
        return {name: getattr(self, name) for name in ("space", "beta_proportional", "beta_difference", "max_weight")}


@register(name="meta", position=3)
class MetaMethod(MetaCommonOptions):
    """meta-estimation: earlier gradients are reused, updated by finite differences (Balint et al. 2023), MetaAdam"""

    proportional_spp: PositiveInt = Field(2, description="samples per pixel of the gradient itself")
    difference_spp: PositiveInt = Field(1, description="samples per pixel of its change since the last step")
    difference_images: Literal["own", "proportional"] = Field(
        "own",
        description="images for the loss derivatives of the change: from separate samples, or from the gradient's",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        spp, images = (self.proportional_spp, self.difference_spp), self.difference_images
        return estimators.MetaEstimator(*spp, difference_images=images, **self.shared()), self.built_optimizer()


@register(name="coupled", position=4)
class CoupledMethod(MetaCommonOptions):
    """meta-estimation with every sample in both of its terms, MetaAdam"""

    spp: PositiveInt = Field(3, description="samples per pixel, each for the gradient and for its change")
    image: Literal["plain", "rcv"] = Field(
        "plain",
        description="image estimator: a new rendering, or rcv's control variate (in path space, unless space is primary)",
    )

    def build(self) -> tuple[Estimator, Optimizer]:
        image = images.Plain()
        if self.image == "rcv":
            image = images.RecursiveControlVariate("primary" if self.space == "primary" else "path")
        return estimators.MetaEstimator(
            coupled=True, spp=self.spp, image=image, **self.shared()
        ), self.built_optimizer()
