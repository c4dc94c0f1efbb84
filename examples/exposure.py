import numpy as np

import unrender as ur
from unrender.core.errors import InputError
from unrender.rendering.renderer import ParameterInfo, Rendering

GAIN = "gain"


class ExposureRenderer:
    """One pixel whose samples are g x for a gain g and noise x of mean 1, uniform in [0.5, 1.5]: known mean, known derivative."""

    def __init__(self, gain=0.5):
        self.gain = gain

    def parameters(self):
        return {GAIN: ParameterInfo((), lowest=0.0)}

    def values(self, keys):
        return {key: np.array(self.gain) for key in keys}

    def resolutions(self):
        return [(1, 1)]

    def array(self, values):
        return np.array(values, np.float64)

    def prepare(self, keys, space, derivatives=True):
        """A session for these parameters; this renderer has no state, and is one itself."""
        for key in keys:
            if key != GAIN:
                raise InputError(f"parameter {key}: the scene has none of that name; it has {GAIN}")
        return self

    def image(self, parameters, request):
        film = (1, 1) if request.pixels is None else (len(request.pixels),)
        shape = (request.groups, *film, request.spp // request.groups)
        noise = np.random.default_rng(request.seed).uniform(0.5, 1.5, shape).mean(axis=-1)
        noise = np.repeat(noise[..., None], 3, axis=-1)
        return Rendering(parameters[GAIN] * noise, None, noise)

    def image_batch(self, parameters, request):
        unit = self.image({GAIN: 1.0}, request).images.mean(axis=0)
        return np.reshape(parameters[GAIN], (-1, 1, 1, 1)) * unit

    def image_pair(self, current, previous, request, space):
        sample = self.image(current, request)
        return Rendering(sample.images, previous[GAIN] * sample.paths, sample.paths)

    def adjoint(self, parameters, paths, weights):
        return {GAIN: np.array((weights * paths).sum() / len(paths))}

    def adjoint_pair(self, current, previous, paths, weights, weights_previous):
        return self.adjoint(current, paths, weights), self.adjoint(previous, paths, weights_previous)

    def tangent_moment(self, parameters, paths, tangents):
        return (paths[0] * float(tangents[GAIN])) ** 2


def problem(gain=0.5):
    """A problem: the gain from the pixel's mean."""
    return ur.Problem(
        ExposureRenderer(), [ur.Parameter(GAIN, initial=1.0)], [ur.View(np.full((1, 1, 3), gain))], truth={GAIN: gain}
    )
