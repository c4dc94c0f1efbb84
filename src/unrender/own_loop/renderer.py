"""`unrender.Renderer`: images for a user-written loop, and gradients from derivatives of its loss."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, checks
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.core.text import in_words
from unrender.core.trees import Tree, add, numpy
from unrender.images.base import ImageEstimator, Plain
from unrender.losses import Loss
from unrender.own_loop import values
from unrender.own_loop.options import Options, open_scene, problem_of
from unrender.own_loop.stream import Batch, Rendered, RendererState, Stream, read_state, write_state
from unrender.own_loop.values import Exchange, LoopParameters, with_drjit, with_torch
from unrender.pixels.base import PixelSampler
from unrender.pixels.uniform import All
from unrender.scene.bounds import off_ends
from unrender.scene.render import render as render_view
from unrender.scene.validation import longest_path

_MINI_BATCHES = "mini-batches"


class Renderer:
    """A differentiable renderer for a user-written loop, loss and optimizer, in Dr.Jit, PyTorch or NumPy.

    In Dr.Jit and PyTorch a call is differentiable, and replaces `mi.render`:

        renderer = ur.Renderer(scene, ["red.reflectance.value"], image=ur.images.RecursiveControlVariate(), spp=4)
        for step in range(steps):
            image = renderer(parameters)

    In NumPy, or with a separately computed loss derivative:

        image = renderer.render(parameters)
        gradient = renderer.backward(derivative)

    `parameters` is {key: array}: a dictionary, an optimizer of Dr.Jit, `mi.SceneParameters`, or the array itself if there is one key.
    Images are linear RGB with the film's reconstruction filter. Gradients have the types of the parameters. A step's image is a function
    of the parameters and `seed`; each step uses new random numbers.

    Image and adjoint come from independent samples. With `groups=1` the image is (H, W, 3), and the adjoint has separate paths: three
    traces per step, as in `mi.render`. With `groups` of 2 or more the image is (groups, H, W, 3), each from the samples of all *other*
    groups, for a loss that is a mean over them (such as `mean((image - reference) ** 2)`): two traces. The gradient is unbiased for a
    fixed derivative, and so for a loss whose derivative is linear in the image. Otherwise the image's noise biases it, which a control
    variate reduces step by step.

    With `coupled=True` the previous step's gradient is a control variate of the current one (`MetaEstimator(coupled=True)` with an
    external loss). This reduces the noise of the adjoint's paths, adds a small bias toward zero, and provides `variance`.

    With pixel mini-batches the image is the rows (N, 3) of some pixels of all sensors. `batch` identifies them, and `gather` selects the
    same pixels of the references. Sums of `batch.weights` times an elementwise loss are unbiased estimates of its mean. With a control
    variate, some steps render all pixels.

    Args:
        scene: an .xml file, a Mitsuba dictionary, a function that returns one, or a loaded `mi.Scene`. A loaded scene has one state,
            which is set to the last rendered parameters; control variates and `coupled` refuse it.
        keys: the parameters, as named in `mi.traverse`.
        image: image estimator: `images.Plain()`, `RecursiveControlVariate()` or `Denoised()`.
        pixels: `pixels.All()`, or a mini-batch by `Uniform`, or by `LossProportional` or `Adaptive`, which need `references`.
        spp: samples per pixel and step, >= 1; a multiple of `groups`.
        adjoint_spp: samples per pixel of the adjoint's separate paths, >= 1; None for `spp`.
        groups: sample groups of the image, >= 1.
        coupled: whether the previous gradient is a control variate.
        sensor: index of the scene's sensor whose image a call returns; several indices for a tuple of images.
        references: for guided mini-batches only: target image of the sensor, a file or (H, W, 3); a list for several sensors.
        loss: for guided mini-batches only: one of `unrender.losses`, similar to the loop's loss; None is L2. Neither biases the gradient.
        max_depth: maximum path length in segments, >= 1; None for that of the scene's integrator.
        seed: seed of all random numbers, >= 0.

    Attributes:
        batch: pixels of the last render, with mini-batches.
        variance: variance of the last gradient, {key: array} in NumPy, with `coupled=True`; summed over sensors.

    Raises `InputError` for incompatible options, parameters without a path gradient, and arrays of another shape.
    """

    @exclusive("Renderer")
    def __init__(
        self,
        scene: Any,
        keys: Sequence[str],
        image: ImageEstimator | None = None,
        pixels: PixelSampler | None = None,
        spp: int = 4,
        *,
        adjoint_spp: int | None = None,
        groups: int = 1,
        coupled: bool = False,
        sensor: int | Sequence[int] = 0,
        references: Any = None,
        loss: Loss | None = None,
        max_depth: int | None = None,
        seed: int = 0,
    ):
        port, names = open_scene(scene, keys, max_depth)
        single = not isinstance(sensor, Sequence)
        sensors = tuple(checks.integer("Renderer", "sensor", one, 0) for one in ((sensor,) if single else sensor))
        targets = () if references is None else (references,) if single else tuple(references)
        if not sensors or len(set(sensors)) < len(sensors) or (targets and len(targets) != len(sensors)):
            raise InputError(
                f"Renderer: expected different sensors, each with a reference if any has one, got {in_words(sensor)}"
            )
        parts = Plain() if image is None else image, All() if pixels is None else pixels
        options = (*parts, spp, adjoint_spp, groups, coupled, sensors, single)
        self._options = Options(names, *options, max_depth or longest_path(port), seed, targets, loss)
        self._port, self._scene = port, scene
        self._streams: dict[str, Stream] = {}
        self._step = 0
        self._last: tuple[LoopParameters, list[tuple[Stream, Rendered]]] | None = None
        self._thread: threading.Thread | None = None
        self._variances: list[Tree] = []
        for name in self._names(None):
            self._stream(name)
        self._exchange = Exchange(port, names)

    # ------------------------------------------------------------------ rendering

    def __call__(self, values: Any = None, sensor: int | None = None) -> Any:
        """Return the image, or the tuple of images, attached to the derivative graph of `values` in Dr.Jit and PyTorch; as `render` in
        NumPy.

        Args:
            values: parameters, see the class; None for the scene's.
            sensor: another sensor than the renderer's; each sensor has its own state. Not supported with mini-batches.
        """
        inputs, records, images = self._render(values, sensor)

        def backward(derivatives: tuple[Any, ...]) -> Tree:
            return self._backward(records, derivatives)

        match inputs.framework:
            case "numpy":
                attached = images
            case "drjit":
                attached = with_drjit(backward, images, self._exchange.attached(inputs))
            case "torch":
                attached = self._with_torch(inputs, images, backward)
        return attached[0] if self._alone(sensor) else attached

    def render(self, values: Any = None, sensor: int | None = None) -> Any:
        """Return the image, or the tuple of images, detached and in the framework of `values`. Call `backward` for the gradient.

        Args:
            values, sensor: see `__call__`.
        """
        _, _, images = self._render(values, sensor)
        return images[0] if self._alone(sensor) else images

    def backward(self, derivative: Any) -> dict[str, Any]:
        """Return {key: gradient} from the loss derivative with respect to the last rendered image; for several images, a tuple of
        derivatives.

        Raises `InputError` if nothing was rendered, or the derivative has another shape than the image.
        """
        if self._last is None:
            raise InputError("Renderer: call render before backward")
        self._check_thread("backward")
        inputs, records = self._last
        derivatives = tuple(derivative) if isinstance(derivative, (tuple, list)) else (derivative,)
        if len(derivatives) != len(records):
            raise InputError(
                f"Renderer: expected {len(records)} derivatives, one for each image, got {len(derivatives)}"
            )
        return self._exchange.gradient(self._backward(records, derivatives), inputs)

    def preview(self, values: Any = None, spp: int = 64, sensor: int | None = None, seed: int = 0) -> np.ndarray:
        """Return an image (H, W, 3) in NumPy, without a control variate. The renderer's state is unchanged.

        Args:
            values: parameters, see the class; None for the scene's.
            spp: samples per pixel, >= 1.
            sensor: index of a sensor; None for the renderer's first one.
            seed: seed of the image, independent of the renderer's.
        """
        chosen = self._options.sensors[0] if sensor is None else checks.integer("Renderer", "sensor", sensor, 0)
        problem = problem_of(self._port, self._options, (chosen,), self._scene)
        return render_view(problem, numpy(self._exchange.tree(self._exchange.read(values))), 0, spp, seed)

    # ------------------------------------------------------------------ mini-batches

    @property
    def batch(self) -> Batch:
        """Pixels of the last render, in the framework of its values. Raises `InputError` without mini-batches, or before a render."""
        if self._last is None or (batch := self._last[1][0][1].batch) is None:
            raise InputError("Renderer: there is no mini-batch; it has pixels=All(), or nothing was rendered yet")
        self._check_thread("batch")
        inputs = self._last[0]
        if inputs.framework == "drjit":
            return batch
        on_host = Batch(arrays.numpy(batch.sensors), arrays.numpy(batch.pixels), arrays.numpy(batch.weights))
        if inputs.framework == "numpy":
            return on_host
        import torch  # pyright: ignore[reportMissingImports]

        like = next(value for value in inputs.values.values() if values.is_torch(value))
        indices = [
            torch.from_numpy(part.astype(np.int64)).to(like.device) for part in (on_host.sensors, on_host.pixels)
        ]
        return Batch(indices[0], indices[1], values.to_torch(on_host.weights, like))

    def gather(self, images: Any) -> Any:
        """Return the pixels of the last render, (N, C), from an image (H, W, C), or from a list of images with several sensors.

        Without mini-batches the images are returned unchanged.

        Args:
            images: in the framework of the rendered values, or NumPy.

        Raises `InputError` for another number or size of images, or before the first render.
        """
        if self._options.all_pixels:
            return images
        batch = self.batch
        several = images if isinstance(images, (tuple, list)) else [images]
        if len(several) != len(self._options.sensors):
            raise InputError(
                f"Renderer: expected {len(self._options.sensors)} images, one for each sensor, got {len(several)}"
            )
        sizes = [self._port.resolutions()[sensor] for sensor in self._options.sensors]
        for image, size in zip(several, sizes, strict=True):
            if values.shape_of(image)[:2] != size or len(values.shape_of(image)) != 3:
                raise InputError(f"Renderer: expected an image {(*size, 3)}, got {values.shape_of(image)}")
        if values.is_torch(batch.weights) or not arrays.is_drjit(batch.weights):
            flat = [image.reshape(-1, values.shape_of(image)[2]) for image in several]
            starts = np.cumsum([0, *(len(rows) for rows in flat)])[:-1]
            if values.is_torch(batch.weights):
                import torch  # pyright: ignore[reportMissingImports]

                rows = torch.cat([torch.as_tensor(rows).to(batch.weights) for rows in flat])
                return rows[torch.from_numpy(starts).to(batch.pixels)[batch.sensors] + batch.pixels]
            return np.concatenate(flat)[starts[batch.sensors] + batch.pixels]
        flat = [arrays.rows(image if arrays.is_drjit(image) else self._port.array(image)) for image in several]
        starts = np.cumsum([0, *(arrays.shape(rows)[0] for rows in flat)])[:-1]
        row = arrays.gather(arrays.like_integers(starts, batch.weights), batch.sensors) + batch.pixels
        return arrays.gather_rows(arrays.concatenate(flat), row)

    # ------------------------------------------------------------------ state

    @property
    def variance(self) -> dict[str, np.ndarray] | None:
        """Variance of the last gradient, see the class; None without `coupled`, or before the first gradient."""
        if not self._variances:
            return None
        total = self._variances[0]
        for other in self._variances[1:]:
            total = add(total, other)
        return numpy(total)

    @property
    def state(self) -> RendererState:
        """Everything apart from the parameters that determines the next steps: a frozen dataclass of arrays."""
        return RendererState(self._step, self._options.seed, {name: one.state for name, one in self._streams.items()})

    def save(self, path: str | Path) -> Path:
        """Write the state to a file and return its path. Raises `InputError` if it cannot be written.

        A renderer with the same options that loads it continues as this one would, bit for bit where sums have a fixed order (see
        `optimize`).
        """
        return write_state(checks.path("Renderer.save", path, "a file"), self.state, self._options.describe())

    def load(self, path: str | Path) -> None:
        """Continue from a state that `save` wrote, with its step and seed.

        Raises `InputError` for a damaged file, or one with other options.
        """
        loaded = read_state(checks.path("Renderer.load", path, "a file"), self._options.describe(), self.state)
        streams = {name: self._stream(name) for name in loaded.streams}
        for name, stream in streams.items():
            stream.state = loaded.streams[name]
        for name in set(self._streams) - set(streams):
            del self._streams[name]
        self._step, self._last, self._variances = loaded.step, None, []
        self._options = replace(self._options, seed=loaded.seed)

    # ------------------------------------------------------------------ the two passes

    @exclusive("Renderer")
    def _render(
        self, values: Any, sensor: int | None
    ) -> tuple[LoopParameters, list[tuple[Stream, Rendered]], tuple[Any, ...]]:
        inputs = self._exchange.read(values)
        parameters = self._exchange.tree(inputs)
        self._exchange.warn_outside(parameters)
        parameters = off_ends(parameters, self._exchange.known)
        key, records, images = Key(self._options.seed, self._step), [], []
        for name in self._names(sensor):
            stream = self._stream(name)
            number = 0 if name == _MINI_BATCHES else int(name)
            rendered, image = stream.render(parameters, key.fold(number))
            records.append((stream, rendered))
            images.append(self._exchange.image(image, inputs))
        self._step += 1
        self._last, self._thread = (inputs.detached(), records), threading.current_thread()
        return inputs, records, tuple(images)

    @exclusive("Renderer")
    def _backward(self, records: list[tuple[Stream, Rendered]], derivatives: Sequence[Any]) -> Tree:
        total: Tree | None = None
        self._variances = []
        for (stream, rendered), derivative in zip(records, derivatives, strict=True):
            gradient = stream.backward(rendered, self._exchange.derivative(derivative, rendered.shape))
            total = gradient if total is None else add(total, gradient)
            self._variances += [] if stream.variance is None else [stream.variance]
        if total is None:
            raise InputError("Renderer: nothing was rendered")
        arrays.evaluate(total)
        return total

    def _check_thread(self, what: str) -> None:
        """Raise `InputError` if another thread rendered last: the request belongs to its image."""
        if self._thread is not threading.current_thread():
            raise InputError(
                f"Renderer: {what} in another thread than the last render, to whose image it belongs; use one Renderer per thread"
            )

    def _with_torch(
        self, inputs: LoopParameters, images: tuple[Any, ...], backward: Callable[..., Tree]
    ) -> tuple[Any, ...]:
        tensors = {key: value for key, value in inputs.values.items() if values.is_torch(value)}
        detached = LoopParameters("torch", {key: value.detach() for key, value in tensors.items()})
        device = images[0].device

        def gradients(derivatives: tuple[Any, ...]) -> list[Any]:
            return [x.to("cpu") for x in self._exchange.gradient(backward(derivatives), detached).values()]

        on_host = tuple(image.to("cpu") for image in images)
        return tuple(x.to(device) for x in with_torch(gradients, on_host, list(tensors.values())))

    # ------------------------------------------------------------------ sensors

    def _alone(self, sensor: int | None) -> bool:
        return sensor is not None or self._options.single or not self._options.all_pixels

    def _names(self, sensor: int | None) -> list[str]:
        if not self._options.all_pixels:
            if sensor is not None:
                raise InputError("Renderer: a mini-batch contains all sensors; pass them at construction, sensor=[...]")
            return [_MINI_BATCHES]
        sensors = self._options.sensors if sensor is None else [checks.integer("Renderer", "sensor", sensor, 0)]
        return [str(one) for one in sensors]

    def _stream(self, name: str) -> Stream:
        if name not in self._streams:
            sensors = self._options.sensors if name == _MINI_BATCHES else (_sensor(name),)
            problem = problem_of(self._port, self._options, sensors, self._scene)
            self._streams[name] = Stream(problem, self._options)
        return self._streams[name]

    def __repr__(self) -> str:
        shown: Mapping[str, Any] = self._options.describe()
        return f"Renderer({', '.join(f'{name}={value}' for name, value in shown.items())}, step={self._step})"


def _sensor(name: str) -> int:
    try:
        return int(name)
    except ValueError as error:
        raise InputError(f"Renderer: sensor must be a whole number, got {name!r}") from error
