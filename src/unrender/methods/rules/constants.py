"""The numbers that the rules of `auto` use."""

from __future__ import annotations

from dataclasses import dataclass

from unrender.preconditioners import Sobolev

__all__ = ["CONSTANTS", "Constants"]


@dataclass(frozen=True)
class Constants:
    """Numbers that the rules of `auto` use, each with its source.

    A name such as `suite` is that of a benchmark: `python -m benchmarks suite`. A commit says what was measured by hand. "By hand" alone
    means that no measurement is on record.
    """

    learning_rate: float = 0.1
    """First steps as a share of a parameter's range or size. Source: `suite`."""
    paths: int = 1 << 15
    """Path budget of a step. Source: by hand (8b0c56a)."""
    spp: tuple[int, int] = (2, 16)
    """Limits of the samples per pixel of a step. Source: fact 21 of the design, variance of the leave-one-out gradient by spp."""
    most_pixels: int = 1 << 19
    """Pixels of all views up to which a step renders them all. Source: by hand."""
    drawn: int = 1 << 15
    """Pixels of a step where there are more. Source: `photographs`, 25.2 dB on 57 views (af62c5a)."""
    drawn_paths: int = 1 << 17
    """Path budget of a step of drawn pixels. Source: as for `drawn`."""

    memory: float = 0.97
    """Largest weight of control variates, for losses that noise biases. Source: `suite`."""
    linear_memory: float = 0.95
    """Likewise, for losses with a linear derivative: about 20 steps. Source: `suite` (09833e0)."""
    tolerance: float = 2.0
    """κ of `PathGradient`: residuals within κ of their noise are damped. Source: the fixed point of `wall` (be9837c)."""
    newton_tolerance: float = 2.0
    """κ of Gauss-Newton steps where losses are linear, since 0 is not allowed there. Source: by hand."""
    fresh_from: int = 12
    """Step from which fresh gradients show whether detail is smoothed away. Source: `suite`, `painting` (7526aba)."""
    correlation: float = Sobolev().correlation
    """Longest smoothing of Sobolev gradients, as a share of a side. Source: `suite`."""

    number_size: int = 4
    """Most elements of a number or colour. Source: fact, a colour has three channels and a spectrum of this library four."""
    number_share: float = 0.3
    """First rate of a bounded number, over that of a texture. Source: 0.5 to 0.8 of the final error on three problems (4e93f49)."""
    margins: float = 10.0
    """Distance from its bound, in margins, from which a positive value moves as its logarithm. Source: by hand (b1f36e3)."""
    albedo_share: float = 0.2
    """First rate of an albedo beside an unknown extinction, over that of other grids: images show their product, and the extinction has
    further to go. Source: `smoke` in `suite` (2173766)."""
    normals_share: float = 0.1
    """First rate of a normal map, over that of a texture: at the full rate the surface turns by ten degrees a step. Source: `photographs`
    (af62c5a)."""

    coarse: tuple[tuple[int, tuple[int, ...]], ...] = ((16, (8, 20)), (8, (14,)))
    """Cells along the shortest side of a grid, and the steps before which its resolution doubles. Source: `suite` (32fe3c3)."""

    mesh_share: float = 4.0
    """First steps of vertices as a share of the mesh's radius, over `learning_rate`. Source: `shapes.equal_time`."""
    vertices_per_strength: float = 192.0
    """λ of large steps is the number of vertices over this. Steps then are smooth over the same share of any mesh, since √λ is a number of
    edges. Source: `shapes.equal_time`; 13 for 2500 vertices, and 19 in Nicolet et al. 2021."""
    strengths: tuple[float, float] = (1.0, 64.0)
    """Limits of λ. Source: by hand (f8ad915)."""
    mesh_time: float = 15.0
    """Steps after which the rate of vertices is 1/√2 of the first. Larger first steps are unstable. Source: `shapes.equal_time`
    (2b82256)."""
    many_views: int = 4
    """Views from which a step of a mesh renders half of them. Source: `shapes.pixel_batches`."""
    most_views: int = 8
    """Most views of such a step. Source: `shapes.pixel_batches`."""

    sigma: float = 0.2
    """Width of the smoothing of what is perturbed, in its units. Source: `shapes.poses`."""
    perturbed_share: float = 0.5
    """First rate of what is perturbed, over its width. Source: `shapes.poses`."""
    perturbed: int = 16
    """Perturbed renders per view and step. Source: `higher_order.table2`."""
    perturbed_spp: int = 2
    """Samples per pixel of a perturbed render. Source: `higher_order.rendering_noise`."""
    annealing: tuple[float, float] = (25.0, 0.1)
    """Half-life in steps and floor of the width. Source: `shapes.poses`."""

    camera_share: float = 0.1
    """First steps of cameras by path gradients, in units of the world and radians, over `learning_rate`. Source: by hand (776f95c)."""
    most_elements: int = 1 << 10
    """Elements of poses of cameras up to which there is a matrix. Source: its cost, by hand (47c5292)."""
    image_paths: int = 1 << 21
    """Path budget of the images of a Gauss-Newton step of cameras. Source: by hand (47c5292)."""
    image_spp: tuple[int, int] = (8, 256)
    """Limits of its samples per pixel. Source: by hand (47c5292)."""
    per_derivative: int = 8
    """Samples of its images over those of its derivative images. Source: by hand (47c5292)."""
    fewest_derivative: int = 4
    """Fewest samples of its derivative images. Source: by hand (47c5292)."""

    few_numbers: int = 24
    """Elements of all numbers up to which they take Gauss-Newton steps. Source: their cost, by hand (7adae11)."""
    number_paths: int = 1 << 16
    """Path budget of the images of such a step. Source: lamps, lens and frosted glass in 12 s (7adae11)."""
    number_spp: tuple[int, int] = (4, 256)
    """Limits of its samples per pixel. Source: as for `number_paths`."""
    difference_paths: int = 1 << 19
    """Path budget of all its derivative images; 32 times as many are too expensive. Source: as for `number_paths`."""
    difference_spp: tuple[int, int] = (2, 8)
    """Limits of their samples per pixel. Source: as for `number_paths`."""
    trial_spp: int = 4
    """Samples per pixel of the derivative images that are tried at the start. Source: as for `explained`."""
    explained: float = 0.1
    """Share of the loss that derivative images at the start must explain. Source: 0.22 to 0.34 for a block that overlaps, at most 0.003
    on the plateaus of `box2`, `mug` and `shadow` (7c39b33)."""
    explained_light: float = 0.005
    """The same share where lights alone move. Source: 0.016 for `stage-lights`, which arrives; 0 for a light that misses the view."""

    pose_shift: float = 1.0 / 12.0
    """First shift of the differences of poses, as a share of the smallest picture's side. Source: a block in a room .25 away."""
    pose_reach: float = 2.0
    """Largest width of the differences of poses over `sigma`. Source: as for `pose_shift`."""
    light_reach: float = 0.5
    """Likewise, of poses of lights alone. Source: `stage-lights`, error of seven numbers after 60 steps."""
    noise_limit: float = 3.0
    """Variance of a pixel over the median, from which on it counts less in Gauss-Newton steps. Source: `stage-lights`: error 0.04 of the
    start's instead of 0.29, since the softbox's visible edge is noisier than all else."""
    pose_averaging: float = 3.0
    """`averaging` of poses, whose first models are of far away. Source: as for `pose_shift`."""
    pose_images: float = 2.0
    """Paths of the images of poses over those of their derivative images. Source: as for `pose_shift`."""
    block_images: float = 0.5
    """Likewise in a block, while textures change the images. Source: the block with all else in the room unknown."""
    block_every: int = 2
    """Steps of textures for one of a block, at most. Source: as for `block_images`."""
    block_wait: int = 8
    """Steps of textures before the first of a block. Source: as for `block_images`."""
    path_cost: float = 4.0
    """Cost of a path with its gradient over that of a path alone. Source: by hand."""


CONSTANTS = Constants()
