"""What the methods may ask of a renderer. They see nothing else of it.

Mitsuba answers in `rendering/mitsuba/`; `rendering/numpy/` answers with known integrals and known gradients. Arrays are the renderer's
own (`mi.TensorXf`, `np.ndarray`); parameters are dictionaries {key: array} and are never changed in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.io.file_conversion import PLAIN, FileConversion
from unrender.rendering.parameter_errors import Role

Space = Literal["path", "primary"]
"""Where two states share samples: one set of paths, or one set of random numbers."""

LossWeights = Callable[[Array], Array]
"""From an image (H, W, 3) to the derivative of the loss by each of its elements."""


@dataclass(frozen=True)
class ParameterInfo:
    """What a renderer says of one of its parameters.

    Attributes:
        shape: of the array that stands for it.
        differentiable: whether `adjoint` can return its gradient.
        shares_paths: whether one set of paths serves two values of it (path space). A renderer may relate those of a moving mesh.
        reason: why it is not differentiable or cannot share paths; else "".
        lowest, highest: the limits of what makes physical sense, or None.
        singular: value between these at which images are singular, such as 1 for an index of refraction, and which is not crossed.
        perturbable: whether it can be rendered at other values, all that `image_batch` needs.
        compiled: whether it is a plain number, which kernels are compiled with: neither differentiable nor perturbable.
        rigid: whether it moves a shape, light or sensor as a whole: few numbers, with plateaus and many minima of the loss.
        light: whether what it moves as a whole is a light.
        viewpoint: whether it is a sensor's pose or lens.
        sensor: index of the only sensor whose images it changes; None where it may change others'.
        mesh: of values at the V vertices of a mesh, (n V,), what gives the mesh as loaded: positions (V, 3) and faces (F, 3); else None.
        welded: whether they are its positions, which vertices at the same place share.
        resizable: whether it may be rendered at other resolutions than its own, (H, W, C) or (Z, Y, X, C).
        conversion: what the renderer does to a file's values when it loads such a parameter.
        role: what the values stand for: numbers, normals or directions. Of the last two, errors are angles.
        brightness: what the picture is proportional to: "light" of an emitter, "reflectance" of a surface; else "".
        nonlinear: whether the picture changes its form with it, not its brightness: positions, lenses, skies, indices.
    """

    shape: tuple[int, ...]
    differentiable: bool = True
    shares_paths: bool = True
    reason: str = ""
    lowest: float | None = None
    highest: float | None = None
    singular: float | None = None
    perturbable: bool = True
    compiled: bool = False
    resizable: bool = False
    rigid: bool = False
    light: bool = False
    viewpoint: bool = False
    sensor: int | None = None
    mesh: Callable[[], tuple[np.ndarray, np.ndarray]] | None = field(default=None, compare=False, repr=False)
    welded: bool = False
    conversion: FileConversion = PLAIN
    role: Role = "value"
    brightness: Literal["", "light", "reflectance"] = ""
    nonlinear: bool = False

    @property
    def moving_mesh(self) -> Callable[[], tuple[np.ndarray, np.ndarray]] | None:
        """`mesh`, where the values are its positions; else None."""
        return self.mesh if self.welded else None


@dataclass(frozen=True)
class SampleRequest:
    """Which samples to take.

    Attributes:
        sensor: index of the sensor.
        spp: samples per pixel, in all groups together; a multiple of `groups`.
        seed: an integer in [0, 2**32), from `Key.uint32()`.
        groups: how many independent images the samples are split into.
        pixels: flat pixel indices (row-major), or None for the whole film.
        sensors: of each chosen pixel, in place of `sensor`; None where all are of that one.
        positions: of each chosen pixel among those that the seed is for, by which its random numbers are drawn: a part of a mini-batch
            is rendered as the whole would be. None where these are all.
        emitters: the probability with which a connection takes each emitter, (E,), sum 1, see `EmitterSession`; None for the scene's own.
        both_gradients: of a pair, whether `adjoint_pair` will be asked for, and not `adjoint` alone. To know it saves memory and time.
    """

    sensor: int
    spp: int
    seed: int
    groups: int = 1
    pixels: Array | None = None
    sensors: Array | None = None
    positions: Array | None = None
    emitters: np.ndarray | None = None
    both_gradients: bool = False


@dataclass(frozen=True)
class Rendering:
    """The answer to a `SampleRequest`.

    Attributes:
        images: the mean of each group's samples: (groups, H, W, 3), or (groups, N, 3) for N chosen pixels.
        previous: likewise for the previous parameters on the same samples; None unless a pair was asked for.
        paths: the renderer's own; hand it to `adjoint` to walk the same paths again.
    """

    images: Array
    previous: Array | None
    paths: Any


def differentiated(keys: Iterable[str], derivatives: bool | AbstractSet[str]) -> frozenset[str]:
    """The keys with respect to which `Renderer.prepare` is asked for derivatives."""
    if isinstance(derivatives, bool):
        return frozenset(keys) if derivatives else frozenset()
    return frozenset(keys) & frozenset(derivatives)


class RenderSession(Protocol):
    """Images and derivatives with respect to the parameters that it was prepared for, from `Renderer.prepare`.

    Its methods are pure: equal arguments give equal results, to the bit, whatever was rendered in between by this session or another of
    the same renderer; arguments do not change. Where float atomics make the order of a sum free, so are its last bits. A parameter that
    is left out has the scene's own value, and no derivative.
    """

    def image(self, parameters: Tree, request: SampleRequest) -> Rendering:
        """Render. Unbiased."""
        ...

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        """Render many states with the same random numbers: {key: (B, *shape)}, NumPy, to images (B, H, W, 3), all pixels
        in one group. Unbiased each. An array that is broadcast along its first axis (`numpy.broadcast_to`) tells that all states share
        the value: a renderer may then do with fewer launches."""
        ...

    def image_pair(self, current: Tree, previous: Tree, request: SampleRequest, space: Space) -> Rendering:
        """Render two states with the same samples: one set of paths (`"path"`) or one set of random numbers
        (`"primary"`). Where shapes move, the former are related paths. Both images are unbiased."""
        ...

    def adjoint(self, parameters: Tree, paths: Any, weights: Array) -> Tree:
        """The gradient of the mean over groups g of sum(weights[g] * images[g]), on the paths of a rendering; `weights` has the
        shape of its images.

        Unbiased where `weights[g]` is independent of group g.
        """
        ...

    def adjoint_pair(
        self, current: Tree, previous: Tree, paths: Any, weights: Array, weights_previous: Array
    ) -> tuple[Tree, Tree]:
        """`adjoint` of both states of an `image_pair`, on its paths and in its space (of moving shapes, the previous state's from the same
        random numbers): the gradient of sum(weights[g] * images[g])
        with respect to `current`, and of sum(weights_previous[g] * previous[g]) with respect to `previous`.
        """
        ...

    def tangent_moment(self, parameters: Tree, paths: Any, tangents: Tree) -> Array:
        """The mean over a pixel's samples of (Σ_k v_k ∂f/∂θ_k)², for the tangents v, on the paths of a rendering: of the shape of its
        images where it has several groups, each from its own samples; of one image where it has one group.

        Over tangents that are independent and ±1 its expectation is Σ_k E[(∂f/∂θ_k)²], the second moment of all the single-parameter
        derivatives of a path. Where `adjoint` has a part that no path has, of borders that move, the square of the pixel's derivative by
        that part is added, its noise included.
        """
        ...


@runtime_checkable
class CountingSession(Protocol):
    """A session that can count what its paths cost."""

    def vertices(self, parameters: Tree, request: SampleRequest) -> Array:
        """The mean number of vertices of a pixel's paths, the camera's not counted, from samples of the request: of the shape of one of its
        images, all channels alike. A path that meets nothing has none."""
        ...


@dataclass(frozen=True)
class EmitterMoments:
    """What the connections of some paths to E emitters tell: sums over connections of a value y each, by the emitter that was drawn.

    Attributes:
        sums: Σ y, float64 (E,).
        squares: Σ y², float64 (E,).
    """

    sums: np.ndarray
    squares: np.ndarray

    def __add__(self, other: EmitterMoments) -> EmitterMoments:
        return EmitterMoments(self.sums + other.sums, self.squares + other.squares)


@runtime_checkable
class EmitterSession(Protocol):
    """A session whose connections can take emitters with probabilities that a `SampleRequest` gives. Images and gradients are as unbiased
    as with the scene's own, as long as none is zero of an emitter that the scene would take."""

    def emitters(self) -> np.ndarray:
        """The scene's own probabilities of its E emitters, (E,), sum 1. Raises `InputError` where it has several and cannot take others."""
        ...

    def emitter_moments(
        self, parameters: Tree, paths: Any, tangents: Tree, weights: Array, noise: Array
    ) -> EmitterMoments:
        """On the paths of a rendering whose request had `emitters`, of each connection that adds f to a sample of a pixel (S samples)

            y = (Σ_c w_c Σ_k v_k ∂f_c/∂θ_k)² / S² + Σ_c (n_c f_c)² / S²        over the channels c,

        for the tangents v, the weights w of `adjoint` and others, n, both of the shape of the rendering's images. Over independent
        tangents of ±1, E[Σ y] of the first part is the second moment of what single connections add to `adjoint`'s gradient, summed
        over connections and elements.
        """
        ...


def drawing_emitters(session: RenderSession) -> EmitterSession:
    """The session, where it is an `EmitterSession`. Raises `InputError` where it is none."""
    if not isinstance(session, EmitterSession):
        raise InputError("what renders these parameters draws emitters in its own way alone")
    return session


def counted_vertices(session: RenderSession, parameters: Tree, request: SampleRequest) -> Array:
    """See `CountingSession.vertices`: ones where the session does not count."""
    if isinstance(session, CountingSession):
        return session.vertices(parameters, request)
    return session.image(parameters, replace(request, groups=1)).images[0] * 0.0 + 1.0


class Renderer(Protocol):
    """A scene with parameters that can be rendered and differentiated. A description: rendering changes nothing in it."""

    def parameters(self) -> Mapping[str, ParameterInfo]:
        """Every parameter of the scene by key."""
        ...

    def values(self, keys: list[str]) -> Tree:
        """The scene's own values, as loaded."""
        ...

    def resolutions(self) -> list[tuple[int, int]]:
        """(height, width) of each sensor's film."""
        ...

    def array(self, values: np.ndarray) -> Array:
        """This renderer's array with these values."""
        ...

    def prepare(
        self, keys: list[str], space: Space | None, derivatives: bool | AbstractSet[str] = True
    ) -> RenderSession:
        """What renders the scene at other values of these parameters. Cheap when asked again with the same arguments.

        `space` is only checked: the paths of a rendering may be replayed by any session for the same parameters with derivatives.

        Args:
            keys: the parameters that will change.
            space: where two states will share samples; None if they will not.
            derivatives: whether derivatives will be asked for, or with respect to which of the keys. What `adjoint` returns for the
                others is of no account, and they may be left out.

        Raises `InputError` for a parameter that is unknown, not differentiable where its derivative is asked for, or not perturbable;
        with `space="path"` for one whose values cannot share paths.
        """
        ...


class StockLoop(Protocol):
    """One step of the loop that people have, by the functions of a renderer's own Python interface."""

    def gradient(
        self, parameters: Tree, sensor: int, spp: int, seeds: tuple[int, int], weigh: LossWeights
    ) -> tuple[Array, Tree]:
        """The image (H, W, 3) of a sensor, and the gradient of the loss whose derivative at that image `weigh` gives.

        Args:
            parameters: the current ones.
            sensor: its index.
            spp: samples per pixel of the image, and as many of the adjoint.
            seeds: of the image and of the adjoint, in [0, 2**32).
            weigh: the derivative of the loss at the image.
        """
        ...


@dataclass(frozen=True, eq=False)
class ReplacedMesh:
    """What a shape is to be.

    Attributes:
        vertices, faces: (V, 3), and (F, 3) of numbers of vertices.
        uv: (V, 2) texture coordinates; None where the shape has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None


@dataclass(frozen=True)
class PictureFormat:
    """What a film stores of its pixels.

    Attributes:
        colour: "rgb" (linear), "luminance" or "xyz". Images of the renderer are RGB; with "luminance" all three channels are the luminance.
        signed: whether pixels may be below 0: by a filter with negative lobes, or because the renderer's images are not of light.
    """

    colour: Literal["rgb", "luminance", "xyz"] = "rgb"
    signed: bool = False


@runtime_checkable
class WithFormats(Protocol):
    """A renderer whose films have formats of their own."""

    def formats(self) -> Sequence[PictureFormat]:
        """The format of each sensor's film."""
        ...


def format_of(renderer: Any, sensor: int) -> PictureFormat:
    """Return the format of a sensor's film; RGB of any sign where the renderer has no films."""
    return renderer.formats()[sensor] if isinstance(renderer, WithFormats) else PictureFormat(signed=True)


@dataclass(frozen=True)
class Camera:
    """A sensor that can be moved.

    Attributes:
        rotation, translation: keys of its pose parameters, (3,) each: a rotation vector about where it stands, in radians, and a shift
            in units of the world.
        place: where it stands, (3,).
    """

    rotation: str
    translation: str
    place: np.ndarray


@runtime_checkable
class WithCameras(Protocol):
    """A renderer that knows where its sensors stand."""

    def cameras(self) -> Mapping[int, Camera]:
        """{sensor: its camera}, of those that can be moved."""
        ...


@runtime_checkable
class Remeshable(Protocol):
    """A renderer whose meshes can be replaced."""

    def with_meshes(self, meshes: Mapping[str, ReplacedMesh], keys: Iterable[str]) -> Renderer:
        """Another one, of the same scene with these meshes for shapes by their ids, for these keys of parameters."""
        ...


@runtime_checkable
class DifferentialBsdfRenderer(Protocol):
    """A renderer that can sample directions in proportion to the derivative of a BSDF."""

    def with_differential_bsdf(self) -> Renderer:
        """The same one, whose adjoints and squared tangents of one state do so for roughness. Its `prepare` raises `InputError` where none
        of the parameters is one that this serves. As unbiased; images, pairs and adjoints of pairs are the same. Cheap when asked again."""
        ...


def with_differential_bsdf(renderer: Renderer) -> Renderer:
    """See `DifferentialBsdfRenderer`. Raises `InputError` for a renderer that is none."""
    if not isinstance(renderer, DifferentialBsdfRenderer):
        raise InputError("differential_bsdf: this renderer samples no BSDF by its derivative: leave it out")
    return renderer.with_differential_bsdf()


@runtime_checkable
class StockRenderer(Protocol):
    """A renderer that people write loops with; see `StockLoop`."""

    def stock(self) -> StockLoop:
        """Such a loop. Cheap when asked again."""
        ...
