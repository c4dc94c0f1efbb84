"""Constants of the rules of `auto`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Constants:
    """Constants of the rules of `auto`, each with its source.

    A name such as `suite` is that of a benchmark: `python -m benchmarks suite`. A commit contains the values measured by hand. "By hand"
    alone means that no measurement is on record.
    """

    learning_rate: float = 0.1
    """First learning rate relative to a parameter's range or size. Source: `suite`."""
    paths: int = 1 << 15
    """Path budget of a step. Source: by hand (8b0c56a)."""
    spp: tuple[int, int] = (2, 16)
    """Limits of the samples per pixel of a step. Source: fact 21 of the design, variance of the leave-one-out gradient by spp."""
    most_pixels: int = 1 << 19
    """Number of pixels of all views up to which a step renders all of them. Source: by hand."""
    short_batch: tuple[int, int] = (1 << 12, 4)
    """Least pixels and samples per pixel of a mini-batch where the time of a budget is short. Source: `indirect-room`, L2, 128², 131,072
    paths, by hand: error .42 with 8 such steps, .47 with 16 of 2 samples, .50 with 4 steps of all pixels; L1 diverges."""
    batch_pixels: int = 1 << 15
    """Size of the pixel mini-batch for more pixels. Source: `photographs`, 25.2 dB on 57 views (af62c5a)."""
    batch_paths: int = 1 << 17
    """Path budget of a step with a mini-batch. Source: as for `batch_pixels`."""

    memory: float = 0.97
    """Largest weight of control variates, for losses that noise biases. Source: `suite`."""
    linear_memory: float = 0.95
    """Largest weight of control variates for losses with a linear derivative: about 20 steps. Source: `suite` (09833e0)."""
    tolerance: float = 2.0
    """κ of `PathGradient`: residuals within κ of their noise are damped. Source: the fixed point of `wall` (be9837c)."""
    newton_tolerance: float = 2.0
    """κ of Gauss-Newton steps for linear losses, because 0 is not allowed there. Source: by hand."""
    fresh_from: int = 12
    """Step from which new gradients are used to test whether detail is smoothed away. Source: `suite`, `painting` (7526aba)."""
    correlation: float = 0.125
    """Largest smoothing length of Sobolev gradients relative to a side, that of `Sobolev`. Source: `suite`."""

    number_size: int = 4
    """Largest number of elements of a number or colour. Source: fact, a colour has three channels and a spectrum of this library four."""
    number_share: float = 0.3
    """First learning rate of a bounded number relative to that of a texture. Source: 0.5 to 0.8 of the final error on three problems
    (4e93f49)."""
    margins: float = 10.0
    """Distance from its bound, in margins, from which a positive value is optimised as its logarithm. Source: by hand (b1f36e3)."""
    far_light: float = 3.0
    """Ratio of a light's brightness to that of the references from which its start is scaled. Source: by hand, radiances and environment
    maps that start at 0.1 and 10 times the truth."""
    sky_deviation: float = 0.7
    """Standard deviation of the logarithms of an environment map's texels around their start, in its pull.

    Source: a wall, a ball, a lamp and a sky, 440 steps: error of the sky's lower half 0.19, 0.28 without the pull, 0.23 at the start.
    `light` at 48², 150 steps: 0.385 with 1, 0.396 without the pull, 0.407 with 0.5.
    """
    albedo_share: float = 0.2
    """First learning rate of an albedo with an unknown extinction, relative to that of other grids.

    Images show their product, and the extinction has further to go. Source: `smoke` in `suite` (2173766).
    """
    normals_share: float = 0.1
    """First learning rate of a normal map relative to that of a texture. At the full rate the surface turns by ten degrees per step.

    Source: `photographs` (af62c5a).
    """

    coarse: tuple[tuple[int, tuple[int, ...]], ...] = ((16, (8, 20)), (8, (14,)))
    """Cells along the shortest side of a grid, and the steps at which its resolution doubles. Source: `suite` (32fe3c3)."""

    mesh_share: float = 4.0
    """First steps of vertices relative to the mesh's radius and to `learning_rate`. Source: `shapes.equal_time`."""
    vertices_per_strength: float = 192.0
    """Ratio of the number of vertices to λ of large steps.

    Steps are then smooth over the same fraction of any mesh, because √λ is a number of edges. Source: `shapes.equal_time`; 13 for 2500
    vertices, and 19 in Nicolet et al. 2021.
    """
    strengths: tuple[float, float] = (1.0, 64.0)
    """Limits of λ. Source: by hand (f8ad915)."""
    mesh_time: float = 15.0
    """Step at which the learning rate of vertices is 1/√2 of the first.

    Larger first steps are unstable. Source: `shapes.equal_time` (2b82256).
    """
    many_views: int = 4
    """Number of views from which a step of a mesh renders half of them. Source: `shapes.pixel_batches`."""
    most_views: int = 8
    """Largest number of views of such a step. Source: `shapes.pixel_batches`."""

    perturbed_share: float = 0.5
    """First learning rate of perturbed parameters relative to their width. Source: `shapes.poses`."""
    perturbed: int = 16
    """Perturbed renders per view and step. Source: `higher_order.table2`."""
    perturbed_spp: int = 2
    """Samples per pixel of a perturbed render. Source: `higher_order.rendering_noise`."""
    annealing: tuple[float, float] = (25.0, 0.1)
    """Half-life in steps and floor of the width. Source: `shapes.poses`."""

    camera_share: float = 0.1
    """First steps of cameras by path gradients, in lengths at the camera and radians, over `learning_rate`. Source: by hand (776f95c)."""
    most_elements: int = 1 << 10
    """Number of elements of camera poses up to which the matrix is formed. Source: its cost, by hand (47c5292)."""
    image_paths: int = 1 << 21
    """Path budget of the images of a Gauss-Newton step of cameras. Source: by hand (47c5292)."""
    image_spp: tuple[int, int] = (8, 256)
    """Limits of the samples per pixel of these images. Source: by hand (47c5292)."""
    per_derivative: int = 8
    """Ratio of samples of the images to those of the derivative images. Source: by hand (47c5292)."""
    fewest_derivative: int = 4
    """Smallest number of samples of the derivative images. Source: by hand (47c5292)."""

    few_numbers: int = 24
    """Number of elements of all numbers up to which they take Gauss-Newton steps. Source: their cost, by hand (7adae11)."""
    moved_lights: int = 64
    """The same number if a light's pose without a path gradient is among them. Source: `shapes.lights`, 32 places of spotlights: RMS
    error 0.15 to 0.03, where the method `smoothed` ends at 0.27."""
    bsdf_pixels: int = 3 << 12
    """Elements times pixels up to which numbers of BSDFs and media with path gradients take such steps.

    Source: `limit`, `numbers` at 16²; on 32² as good at the end and earlier, on 48² with seven numbers and 96² as good and later. Nine
    numbers of a principled BSDF on 32²: 0.80 of the start's error after 2 s, 1.21 by path gradients (`suite.numbers`).
    """
    number_paths: int = 1 << 17
    """Least path budget of the images of such a step, for which starting two renders takes an eighth of the time. Source:
    `suite.numbers`."""
    number_spp: tuple[int, int] = (4, 256)
    """Limits of the samples per pixel of these images. Source: as for `number_paths`."""
    number_images: float = 1.0
    """Least ratio of the time of these images to that of their derivative images, see `derivative_images.cost`.

    Source: `suite.numbers`, geometric mean of the errors of three seeds after 1 s: `two lamps` 0.0094 in place of 0.0116, `lamps` 0.0096 in
    place of 0.0137. A step of nine numbers takes a tenth more time.
    """
    difference_paths: int = 1 << 19
    """Path budget of all derivative images of such a step; 32 times as many are too expensive. Source: as for `number_paths`."""
    difference_spp: tuple[int, int] = (2, 8)
    """Limits of the samples per pixel of the derivative images; for poses of lights at least those that take the time of starting a render.
    Source: as for `number_paths`; `shapes.lights`, `sunsky`: largest error from one picture 0.013 rad, with 8 samples 0.022."""
    trial_spp: int = 4
    """Samples per pixel of the trial derivative images at the start. Source: as for `explained`."""
    explained: float = 0.1
    """Fraction of the loss that derivative images at the start must explain.

    Source: 0.22 to 0.34 for a block that overlaps, at most 0.003 on the plateaus of `box2`, `mug` and `shadow` (7c39b33).
    """
    explained_wide: float = 0.03
    """The same fraction by wide differences, with which steps of shapes begin; below it a line says that the run may end far away. Source:
    0.08 to 0.12 for a glass ball that these steps find; at most 0.0004 on the plateaus of `box2`, `mug` and `shadow`."""
    explained_light: float = 0.005
    """The same fraction if only lights move. Source: 0.016 for `stage-lights`, which converges; 0 for a light that misses the view."""

    pose_shift: float = 1.0 / 12.0
    """First shift of the differences of poses relative to the smallest image's side. Source: a block in a room .25 away."""
    pose_last_shift: float = 0.1
    """Last shift of the differences of shapes alone, in pixels of the whole image, of which a shape changes a part: with 0.3 a block moved
    by pixels. Source: `pose` of `few_numbers`, 12 references of 1,024 samples per pixel: the height ends 0.0012 away and at a z of standard
    deviation 1.0, with 0.3 0.0036 and 1.9; `box10` 0.00003 of the start, with 0.3 0.00004."""
    camera_shift: float = 1.0 / 48.0
    """The same shift for cameras beside textures. Source: a camera .12 and .036 rad away, 64²: .009 and .003 rad after 40 steps, .28 and
    .017 with twice the shift and a trust region of 2 widths."""
    camera_trust: float = 0.5
    """Trust region of such cameras in widths. Source: on 48² the rotation ends at .7 of the start's error, at 2.7 with 2 widths."""
    pose_reach: float = 2.0
    """Largest width of the differences of poses relative to the smoothing width. Source: as for `pose_shift`."""
    light_reach: float = 0.5
    """The same ratio for poses of lights alone. Source: `stage-lights`, error of seven numbers after 60 steps."""
    noise_limit: float = 3.0
    """Ratio of a pixel's variance to the median from which it has less weight in Gauss-Newton steps. Source: `stage-lights`: error 0.04 of
    the start's instead of 0.29, because the softbox's visible edge is noisier than all else. Pixels have equal weights for poses of shapes,
    which edges show: error after 3 s 0.0005 instead of 0.046 on `bunny`, 0.0003 instead of 0.011 on `box10` (`higher_order.table2`)."""
    bsdf_noise_limit: float = 0.3
    """The same ratio for the channels of pixels, if all unknowns are numbers of BSDFs and brightnesses. Source: `limit`, `numbers` at 16².

    Poses of `stage-lights` end further away with it, since noisy bright pixels lead the first steps; and so do three numbers of a fog, 0.38
    of the start's error in place of 0.24 (`suite.numbers`).
    """
    derivative_noise: float = 1.0
    """`GaussNewton.derivative_noise` after path gradients, where derivative images take most of a step. Source: by hand."""
    averaged_values: int = 1 << 19
    """Elements times pixels up to which the derivative images of such steps are averaged over steps. Source: memory, 12 MiB."""
    pose_averaging: float = 3.0
    """`averaging` of poses, whose first models are far from the solution. Source: as for `pose_shift`."""
    number_averaging: float = 1.0
    """`settled_averaging` of numbers other than poses and those of expressions. Source: 0.81 of the error after 32 steps on five rows of
    `suite.numbers`. With it `pose` ends at 0.081 of the start's error, `lenses` at 0.94 after 60 steps; without it at 0.054 and 0.17."""
    pose_images: float = 2.0
    """Ratio of the paths of the images of poses to those of their derivative images. Source: as for `pose_shift`."""
    block_paths: int = 1 << 16
    """Least path budget of the images of a block. Source: lamps, lens and frosted glass in 12 s (7adae11)."""
    block_images: float = 0.5
    """The same ratio for a block, while textures change the images. Source: the block with all else in the room unknown."""
    block_every: int = 2
    """Largest number of steps of textures per step of a block, 1 for cameras. Source: as for `block_images`."""
    block_wait: tuple[int, int] = (8, 20)
    """Numbers of steps of the others before the first step of a block of shapes, without and with unknown lights among them.

    Poses make up for lights that are far from the solution. A block beside a wall, a metal, a lamp and a sky (50 steps, seeds 0 to 7) ends
    .001 to .03 rad from the truth after 20 steps; after 8, it is 1.4 to 1.5 rad away in 4 of 8 runs. Beside a texture alone, 20 steps
    increase the texture's error after 50 steps, .029 to .040. Lamps, cameras, lenses and materials begin at once: a lamp beside a texture
    ends .002 away after 40 steps, .16 after such steps.
    """
    eliminated_values: int = 1 << 22
    """Elements of a block times texels up to which the block eliminates a texture. Source: memory, 16 MiB."""
    path_cost: float = 4.0
    """Cost of a path with its gradient relative to that of a path alone. Source: by hand."""


CONSTANTS = Constants()
