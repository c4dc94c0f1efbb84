# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportAttributeAccessIssue=false, reportReturnType=false

"""From pixels to camera rays, from path radiance back to pixels: one box filter, independent samples.

The film's own reconstruction filter is not used. Per-pixel statistics need pixels whose samples are their own, so every
pixel is the plain mean over its square (a box filter of one pixel).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def rays(sensor: Any, sampler: Any, seed: Any, spp: int, pixels: Any, count: int) -> tuple[Any, Any]:
    """Camera rays, samples of a pixel side by side.

    Args:
        sensor: `mitsuba.Sensor`.
        sampler: `mitsuba.Sampler` ('independent'); seeded here.
        seed: `mi.UInt32` of width 1.
        spp: rays per pixel.
        pixels: `mi.UInt32` of flat indices, or None for all pixels in order.
        count: how many pixels.

    Returns:
        `mi.RayDifferential3f` and its weight per lane; count * spp lanes.
    """
    film = sensor.film()
    width, height = int(film.crop_size()[0]), int(film.crop_size()[1])
    sampler.seed(seed, count * spp)
    index = dr.arange(mi.UInt32, count * spp) // spp
    if pixels is not None:
        index = dr.gather(mi.UInt32, pixels, index)
    y = index // width
    position = mi.Point2f(index - y * width, y) + sampler.next_2d()
    time = sensor.shutter_open() + (
        sampler.next_1d() * sensor.shutter_open_time() if sensor.shutter_open_time() > 0 else 0
    )
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    ray, weight = sensor.sample_ray_differential(
        mi.Float(time), 0.5, mi.Point2f(position.x / width, position.y / height), aperture
    )
    ray.scale_differential(spp**-0.5)
    return ray, weight


def develop(radiance: Any, spp: int, groups: int, shape: tuple[int, ...]) -> Any:
    """The mean of each pixel's samples, per group.

    Args:
        radiance: `mi.Spectrum`, evaluated, lanes ordered as `rays` makes them.
        spp: samples per pixel, in all groups.
        groups: the samples of a pixel are cut into that many equal runs.
        shape: of one image, (H, W, 3) or (N, 3).

    Returns:
        `mi.TensorXf` (groups, *shape). Sums in a fixed order: equal seeds give equal bits.
    """
    size = spp // groups
    sums = [dr.block_sum(radiance[c], size) if size > 1 else radiance[c] for c in range(3)]
    count = dr.width(sums[0])
    pixels = count // groups
    index = dr.arange(mi.UInt32, count)
    group = index // pixels
    index = (index - group * pixels) * groups + group
    channels = mi.Color3f(*(dr.gather(mi.Float, sums[c], index) for c in range(3)))
    return mi.TensorXf(dr.ravel(channels) / size, (groups, *shape))


def expose(weights: Any, spp: int, count: int) -> Any:
    """The adjoint of `develop` averaged over the groups: each lane's share of its pixel's and group's weight.

    Args:
        weights: `mi.TensorXf` (groups, H, W, 3) or (groups, N, 3).
        spp: samples per pixel, in all groups.
        count: how many pixels.

    Returns:
        `mi.Spectrum` per lane: weights[group, pixel] / spp.
    """
    lane = dr.arange(mi.UInt32, count * spp)
    pixel = lane // spp
    group = (lane - pixel * spp) // (spp // weights.shape[0])
    index = (group * count + pixel) * 3
    return mi.Spectrum(*(dr.gather(mi.Float, weights.array, index + c) for c in range(3))) / spp
