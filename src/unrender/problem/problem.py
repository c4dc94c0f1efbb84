"""What is to be recovered, from which images, under which loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.core.trees import Tree
from unrender.io import images, scene_files
from unrender.losses import L2, Loss
from unrender.preconditioners.base import Preconditioner
from unrender.problem import coarse_to_fine, values
from unrender.problem.coarse_to_fine import CoarseToFine
from unrender.problem.errors import FieldError
from unrender.problem.parameter import Parameter
from unrender.problem.references import References
from unrender.problem.view import View
from unrender.rendering.renderer import ParameterInfo, Renderer

Bounds = tuple[float | None, float | None]


@runtime_checkable
class _Renderer(Renderer, Protocol): ...


@runtime_checkable
class _Preconditioner(Preconditioner, Protocol): ...


@runtime_checkable
class _Loss(Loss, Protocol): ...


class Problem:
    """A scene, what in it is unknown, and the pictures that tell.

    Everything is checked and read here, once; afterwards a problem does not change.

    Args:
        scene: an .xml file, a Mitsuba dictionary, a function that returns one, or a `Renderer`.
        parameters: the unknowns, at least one, with different keys.
        views: the pictures, at least one.
        loss: per pixel and channel; None is L2(). The total is the sum over views of weight * mean over pixels and
            channels of mask * loss.
        max_depth: longest light path in segments, >= 1 (1: emitters seen directly, 2: direct light).
        truth: {key: value} of parameters whose true value is known, to measure the error; values as for
            `Parameter.initial`.
        name: for people; None takes the scene file's.

    Attributes:
        parameters: tuple of `Parameter`, as given.
        views: tuple of `View`, their reference a float32 array (H, W, 3), their mask (H, W) or None.
        renderer: what renders the scene.
        given_views: tuple of `View`, as given.
        origin: where it came from, to make it again: {"scene": path of the XML}, with "file", the path of the problem file, where there is
            one; {"gallery": name, "options": {...}}; empty where only the program that made it can make it again.
        notices: one line for each thing done to the input that its giver should know of.
        bounds: {key: (low, high)}, the parameter's own or the physical range that the renderer knows; None is open.
        learning_rates: {key: rate} of the parameters that have their own.
        preconditioners: {key: preconditioner} of the parameters that have one.
        coarse_to_fine: {key: `CoarseToFine`} of the parameters that are coarse at first.
        references: the views' pictures, looked up pixel by pixel.
        truth: {key: array} of the parameters' shapes.

    Raises:
        InputError: in one line, which field is wrong and what was expected.
    """

    def __init__(
        self,
        scene: str | Path | dict[str, Any] | Callable[[], Any] | Renderer,
        parameters: Sequence[Parameter],
        views: Sequence[View],
        loss: Loss | None = None,
        max_depth: int = 6,
        *,
        truth: Mapping[str, Any] | None = None,
        name: str | None = None,
    ):
        if isinstance(max_depth, bool) or not isinstance(max_depth, int) or max_depth < 1:
            raise FieldError(("max_depth",), f"expected a whole number of at least 1, got {max_depth!r}")
        self.loss: Loss = L2() if loss is None else loss
        if isinstance(self.loss, type) or not isinstance(self.loss, _Loss):
            raise FieldError(("loss",), f"expected one of unrender.losses, such as L2(), got {self.loss!r}")
        self.max_depth = max_depth
        self.parameters = _sequence(parameters, Parameter, "parameters")
        self.given_views = _sequence(views, View, "views")
        self.origin: dict[str, Any] = {"scene": str(Path(scene).resolve())} if isinstance(scene, (str, Path)) else {}
        self.name = name or (Path(scene).stem if isinstance(scene, (str, Path)) else "problem")
        self.notices: list[str] = []
        self.renderer: Renderer = _open(scene, max_depth)

        known = self.renderer.parameters()
        self.bounds: dict[str, Bounds] = {}
        self.learning_rates: dict[str, float] = {}
        self.preconditioners: dict[str, Preconditioner] = {}
        self.coarse_to_fine: dict[str, CoarseToFine] = {}
        self._initial: dict[str, np.ndarray] = {}
        for index, parameter in enumerate(self.parameters):
            self._take_parameter(index, parameter, known)
        self.views = tuple(self._take_view(index, view) for index, view in enumerate(self.given_views))
        self.truth = {key: self._take_truth(key, value) for key, value in (truth or {}).items()}
        self.references = References(self.views, self.renderer.array)
        self._references: dict[int, Array] = {}
        self._masks: dict[int, Array | None] = {}

    @classmethod
    def from_file(cls, path: str | Path) -> Problem:
        """The problem that a TOML file describes. Raises `InputError` that names the line."""
        from unrender.problem.toml_file import read

        return read(path)

    # ------------------------------------------------------------------ what methods ask

    def initial(self) -> Tree:
        """Where the descent starts: the renderer's arrays, inside the bounds, at the scene's own resolutions."""
        return {key: self.renderer.array(value) for key, value in self._initial.items()}

    def start(self, step: int = 0) -> Tree:
        """`initial()` at the resolutions that parameters have at a step."""
        coarse = {key: way.coarsened(self._initial[key], step) for key, way in self.coarse_to_fine.items()}
        return {key: self.renderer.array(coarse.get(key, value)) for key, value in self._initial.items()}

    def shapes(self, step: int | None = None) -> dict[str, tuple[int, ...]]:
        """Of each parameter at a step; None for the scene's own."""
        found = {key: value.shape for key, value in self._initial.items()}
        if step is None:
            return found
        return found | {key: way.shape(found[key], step) for key, way in self.coarse_to_fine.items()}

    def full(self, parameters: Mapping[str, Array]) -> dict[str, np.ndarray]:
        """The parameters as NumPy arrays, those that are still coarse interpolated at the scene's own resolution."""
        found = {key: arrays.numpy(value) for key, value in parameters.items()}
        for key, way in self.coarse_to_fine.items():
            if key in found and found[key].shape in way.shapes(self._initial[key].shape):
                found[key] = way.refined(found[key], self._initial[key].shape)
        return found

    def reference(self, view: int) -> Array:
        """The view's picture as the renderer's array (H, W, 3)."""
        if view not in self._references:
            self._references[view] = self.renderer.array(np.asarray(self.views[view].reference))
        return self._references[view]

    def mask(self, view: int) -> Array | None:
        """The view's mask as the renderer's array (H, W, 1), or None where every pixel counts."""
        if view not in self._masks:
            mask = self.views[view].mask
            self._masks[view] = None if mask is None else self.renderer.array(np.asarray(mask)[..., None])
        return self._masks[view]

    def loss_value(self, view: int, image: Array) -> Array:
        """The view's share of the loss at an image (H, W, 3): weight * mean(mask * loss), a lazy scalar."""
        return arrays.mean(self._values(image, self.reference(view), self.mask(view))) * self.views[view].weight

    def loss_values(self, view: int, images: Array) -> Array:
        """`loss_value` of each of many images (B, H, W, 3): (B,), lazy."""
        reference, mask = arrays.add_first_axis(self.reference(view)), self.mask(view)
        values = self._values(images, reference, None if mask is None else arrays.add_first_axis(mask))
        return arrays.mean_over_rest(values) * self.views[view].weight

    def loss_derivative(self, view: int, image: Array) -> Array:
        """∂(total loss)/∂(pixel) at an image (H, W, 3): weight * mask * loss' / (H * W * 3)."""
        reference, mask = self.reference(view), self.mask(view)
        slope = self.loss.derivative(self._through(image, reference, mask), reference)
        factor = self.views[view].weight / math.prod(arrays.shape(reference))
        return (slope if mask is None else slope * mask) * factor

    def _values(self, image: Array, reference: Array, mask: Array | None) -> Array:
        values = self.loss.value(self._through(image, reference, mask), reference)
        return values if mask is None or not self.loss.pixelwise else values * mask

    def _through(self, image: Array, reference: Array, mask: Array | None) -> Array:
        """What a loss sees: where its pixels count for themselves, the image; else the reference where the mask is 0."""
        return image if mask is None or self.loss.pixelwise else reference + mask * (image - reference)

    def precondition(self, tree: Tree) -> Tree:
        """S x for each parameter that has a preconditioner S, x for the others."""
        maps = self.preconditioners
        return {key: maps[key].apply(x) if key in maps else x for key, x in tree.items()}

    def parameter_error(self, parameters: Mapping[str, Array]) -> dict[str, float]:
        """Root mean square error against the truth, for each key whose truth is known. Waits for the device."""
        found = self.full({key: parameters[key] for key in self.truth})
        return {
            key: float(np.sqrt(np.mean(np.square(found[key] - truth, dtype=np.float64))))
            for key, truth in self.truth.items()
        }

    # ------------------------------------------------------------------ taking in what was given

    def _take_parameter(self, index: int, parameter: Parameter, known: Mapping[str, ParameterInfo]) -> None:
        key, owner = parameter.key, f"parameter {parameter.key}"

        def wrong(field: str, what: str | Exception) -> FieldError:
            return FieldError(("parameters", index, field), str(what), f"{owner}: {field}")

        place = ("parameters", index, "key")
        if not isinstance(key, str) or key not in known:
            raise FieldError(place, f"the scene has no parameter {key}{_near_key(str(key), known)}")
        if key in self._initial:
            raise FieldError(place, f"{key} is given twice")
        info = known[key]
        if not info.differentiable and not info.perturbable:
            raise FieldError(place, f"{key} cannot be recovered: {info.reason}")
        try:
            low, high = self.bounds[key] = _bounds(parameter.bounds, info)
        except InputError as error:
            raise wrong("bounds", error) from error
        if parameter.learning_rate is not None:
            rate = parameter.learning_rate
            if not _is_number(rate) or rate <= 0:
                raise wrong("learning_rate", f"expected a number above 0, got {rate!r}")
            self.learning_rates[key] = float(rate)
        if (preconditioner := parameter.preconditioner) is not None:
            if isinstance(preconditioner, type) or not isinstance(preconditioner, _Preconditioner):
                raise wrong("preconditioner", f"expected one of unrender.preconditioners, got {preconditioner!r}")
            try:
                preconditioner.check(key, info.shape)
            except InputError as error:
                raise wrong("preconditioner", str(error).removeprefix(f"{key}: preconditioner ")) from error
            self.preconditioners[key] = preconditioner
        if parameter.coarse_to_fine is not None:
            try:
                way = coarse_to_fine.of(parameter.coarse_to_fine)
                if not info.resizable:
                    raise InputError("its resolution is fixed; expected the data of a bitmap texture or a grid volume")
                way.check(info.shape)
                if preconditioner is not None:
                    preconditioner.check(key, way.shape(info.shape, 0))
            except InputError as error:
                raise wrong("coarse_to_fine", error) from error
            self.coarse_to_fine[key] = way
        try:
            if parameter.initial is None:
                start, notice = arrays.numpy(self.renderer.values([key])[key]).astype(np.float32), ""
                if not np.isfinite(start).all():
                    raise InputError("the scene's own value is not finite; give another")
            else:
                start, notice = values.fill(parameter.initial, info.shape)
        except InputError as error:
            raise wrong("initial", error) from error
        if notice:
            self.notices.append(f"{owner}: initial {notice}")
        inside = np.clip(start, low, high) if (low, high) != (None, None) else start
        if (moved := int(np.sum(inside != start))) > 0:
            what = f"{moved} of {start.size} initial values moved into the bounds [{low}, {high}]"
            self.notices.append(f"{owner}: {what}")
        self._initial[key] = inside.astype(np.float32)

    def _take_view(self, index: int, view: View) -> View:
        owner = f"view {index}"

        def wrong(field: str, what: str | Exception) -> FieldError:
            return FieldError(("views", index, field), str(what), f"{owner}: {field}")

        sizes = self.renderer.resolutions()
        if isinstance(view.sensor, bool) or not isinstance(view.sensor, int) or not 0 <= view.sensor < len(sizes):
            have = f"0 to {len(sizes) - 1}" if len(sizes) > 1 else "0, the only sensor"
            raise wrong("sensor", f"expected {have}, got {view.sensor!r}")
        if not _is_number(view.weight) or view.weight <= 0:
            raise wrong("weight", f"expected a number above 0, got {view.weight!r}")
        height, width = sizes[view.sensor]
        try:
            picture = images.read(view.reference)
            _check_size(picture.values, height, width, view.sensor)
        except InputError as error:
            raise wrong("reference", error) from error
        if picture.notice:
            self.notices.append(f"{owner}: reference {picture.notice}")
        reference = np.array(np.broadcast_to(picture.values, (height, width, 3)))
        mask = None
        if view.mask is not None:
            try:
                mask = images.read(view.mask, linearise=False).values
                _check_size(mask, height, width, view.sensor)
                mask = mask.mean(axis=2)
                if mask.min() < 0 or mask.max() > 1:
                    raise InputError(f"expected values from 0 to 1, got {mask.min():g} to {mask.max():g}")
                if not mask.any():
                    raise InputError("it is 0 everywhere: no pixel would count")
            except InputError as error:
                raise wrong("mask", error) from error
        return replace(view, reference=reference, mask=mask, weight=float(view.weight))

    def _take_truth(self, key: str, value: Any) -> np.ndarray:
        if key not in self._initial:
            raise FieldError(("truth", key), f"not one of the parameters{did_you_mean(key, self._initial)}")
        try:
            array, notice = values.fill(value, self._initial[key].shape)
        except InputError as error:
            raise FieldError(("truth", key), str(error)) from error
        if notice:
            self.notices.append(f"parameter {key}: truth {notice}")
        return array


def _open(scene: Any, max_depth: int) -> Renderer:
    if isinstance(scene, _Renderer) and not isinstance(scene, type):
        return scene
    if not isinstance(scene, (str, Path, dict)) and not callable(scene):
        got = type(scene).__name__
        raise FieldError(("scene",), f"expected an .xml file, a Mitsuba dictionary or a function, got {got}")
    from unrender.backend.variant import ensure

    try:
        if isinstance(scene, (str, Path)) and Path(scene).is_file() and Path(scene).suffix.lower() == ".xml":
            scene_files.of(Path(scene))  # refuses what Mitsuba would include from elsewhere
    except InputError as error:
        raise FieldError(("scene",), str(error).removeprefix("scene ")) from error
    ensure()
    from unrender.rendering.mitsuba.renderer import MitsubaRenderer

    try:
        return MitsubaRenderer(scene, max_depth)
    except InputError as error:
        raise FieldError(("scene",), str(error).removeprefix("scene: ").removeprefix("scene ")) from error


def _sequence(given: Any, kind: type, name: str) -> tuple[Any, ...]:
    items = (given,) if isinstance(given, kind) else given
    if isinstance(items, (str, bytes, Mapping)) or not isinstance(items, Sequence):
        raise FieldError((name,), f"expected a list of {kind.__name__}, got {type(given).__name__}")
    if not items:
        raise FieldError((name,), f"expected at least one {kind.__name__}, got none")
    for index, item in enumerate(items):
        if not isinstance(item, kind):
            what = f"expected a {kind.__name__}, got {type(item).__name__}"
            raise FieldError((name, index), what)
    return tuple(items)


def _bounds(given: Any, info: ParameterInfo) -> Bounds:
    if given is None:
        return info.lowest, info.highest
    if isinstance(given, (str, bytes)) or not isinstance(given, Sequence) or len(given) != 2:
        raise InputError(f"expected (low, high), either may be None, got {given!r}")
    for side in given:
        if side is not None and (isinstance(side, bool) or not isinstance(side, (int, float)) or math.isnan(side)):
            raise InputError(f"expected two numbers or None, got {side!r}")
    low, high = (None if side is None else float(side) for side in given)
    if low == math.inf or high == -math.inf:
        raise InputError(f"low must be less than high, got {low} and {high}")
    low, high = None if low == -math.inf else low, None if high == math.inf else high
    if low is not None and high is not None and low >= high:
        raise InputError(f"low must be less than high, got {low:g} and {high:g}")
    return low, high


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool) and math.isfinite(x)


def _check_size(values: np.ndarray, height: int, width: int, sensor: int) -> None:
    if values.shape[:2] != (height, width):
        raise InputError(
            f"{values.shape[1]}x{values.shape[0]} pixels (width x height), "
            f"but the film of sensor {sensor} is {width}x{height}"
        )


def _near_key(key: str, known: Mapping[str, ParameterInfo]) -> str:
    able = [name for name, info in known.items() if info.differentiable or info.perturbable]
    # Mitsuba may call an owner by its shape where people think of its material: the rest of the key tells as much.
    alike = [name for name in able if name.endswith("." + key.partition(".")[2])] if "." in key else []
    if near := did_you_mean(key, alike, 0.0) or did_you_mean(key, able) or did_you_mean(key, known):
        return near
    return f"; it has {', '.join(able[:6])}{' and others' if len(able) > 6 else ''}" if able else ""
