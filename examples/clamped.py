from dataclasses import dataclass, field, replace

import unrender as ur
from unrender.core import arrays, checks
from unrender.images.base import ImageEstimator


@ur.register
@dataclass(frozen=True)
class Clamped(ImageEstimator):
    """Radiance up to a limit, against fireflies. Biased where the true image is brighter.

    Args:
        inner: makes the image.
        limit: the largest radiance, > 0.
    """

    inner: ImageEstimator = field(default_factory=ur.images.Plain)
    limit: float = 10.0

    def __post_init__(self):
        checks.number("Clamped", "limit", self.limit, above=0.0)

    @property
    def space(self):
        return self.inner.space

    @property
    def pixelwise(self):
        return self.inner.pixelwise

    def init(self, problem, parameters):
        return self.inner.init(problem, parameters)

    def estimate(self, problem, parameters, state, frame, spp, groups, key, pair_request=None):
        estimate, update = self.inner.estimate(problem, parameters, state, frame, spp, groups, key, pair_request)
        return replace(estimate, filter=lambda image: arrays.minimum(image, self.limit)), update

    def needs_full_views(self, parameters, state, batches):
        return self.inner.needs_full_views(parameters, state, batches)

    def prepare(self, problem, state):
        return self.inner.prepare(problem, state)

    def advance(self, parameters, state, update):
        return self.inner.advance(parameters, state, update)
