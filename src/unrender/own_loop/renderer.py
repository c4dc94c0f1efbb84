"""`unrender.Renderer`: images for a loop of one's own, and the way back from their loss to the parameters."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unrender.core import arrays, frameworks
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.random import Key
from unrender.core.trees import Tree, add, numpy
from unrender.images.base import ImageEstimator
from unrender.images.plain import Plain
from unrender.losses import Loss
from unrender.own_loop import saved
from unrender.own_loop.options import Options, open_scene, problem_of
from unrender.own_loop.saved import RendererState
from unrender.own_loop.stream import Batch, Rendered, Stream
from unrender.own_loop.values import Exchange, Given
from unrender.pixels.all import All
from unrender.pixels.base import PixelSampler
from unrender.scene.problem import Problem
from unrender.scene.render import render as render_view
from unrender.scene.validation import longest_path

_MINI_BATCHES = "mini-batches"


class Renderer:
    """A differentiable renderer for a loop of one's own, with one's own loss and optimizer, in Dr.Jit, PyTorch or NumPy.

    In Dr.Jit and PyTorch a call is differentiable, and stands where `mi.render` stood:

        renderer = ur.Renderer(scene, ["red.reflectance.value"], image=ur.images.RecursiveControlVariate(), spp=4)
        for step in range(steps):
            image = renderer(parameters)

    and in NumPy, or with derivatives of one's own,

        image = renderer.render(parameters)
        gradient = renderer.backward(derivative)

    `parameters` is {key: array}: a dictionary, an optimizer of Dr.Jit, `mi.SceneParameters`; or the array itself where there is one key.
    Images are linear RGB with the film's reconstruction filter; gradients have the types of the parameters. What a step renders is a
    function of the parameters and of `seed`, and each step draws anew.

    Image and adjoint come from independent samples. With `groups=1` the image is (H, W, 3), and the adjoint has paths of its own: three
    traces a step, as in `mi.render`. With `groups` of 2 or more the image is (groups, H, W, 3), each from the samples of all *other*
    groups, for a loss that is the mean over them (as `mean((image - reference) ** 2)` is): two traces. The gradient is unbiased
    for a given derivative, so for a loss whose derivative is linear in the image; otherwise it is biased by the image's noise, which a
    control variate reduces step by step.

    With `coupled=True` the product of the image's Jacobian with the given derivative has that of the last step as its control variate
    (`MetaEstimator(coupled=True)` where the loss lives outside): less noise of the adjoint's paths, a small bias toward zero, and
    `variance` beside the gradient.

    With pixel mini-batches the image is the rows (N, 3) of some pixels of all sensors; `batch` says which, `gather` takes the
    same of the references, and sums of `batch.weights` times a loss per element are unbiased for its mean. Now and then, for
    a control variate, they are all pixels.

    Args:
        scene: an .xml file, a Mitsuba dictionary, a function that returns one, or a loaded `mi.Scene`. A loaded scene has one state: it is
            set to what was last rendered, and control variates and `coupled` refuse it.
        keys: the parameters, as `mi.traverse` names them.
        image: what the loss sees: `images.Plain()`, `RecursiveControlVariate()` or `Denoised()`.
        pixels: `pixels.All()`, or a mini-batch by `Uniform`, or by `LossProportional` or `Adaptive`, which need `references`.
        spp: samples per pixel and step, >= 1; a multiple of `groups`.
        adjoint_spp: of the adjoint's own paths, >= 1; None for `spp`.
        groups: sample groups of the image, >= 1.
        coupled: whether gradients keep those of earlier steps.
        sensor: index of the scene's sensor, whose image a call returns; or several, for a tuple of images.
        references: for guided mini-batches alone: the image that the sensor should see, file or (H, W, 3); of several sensors, a list.
        loss: for guided mini-batches alone: one of `unrender.losses`, near to the loop's own; None is L2. Neither biases the gradient.
        max_depth: longest light path in segments, >= 1; None for that of the scene's own integrator.
        seed: of all random numbers, >= 0.

    Attributes:
        batch: the pixels of the last render, with mini-batches.
        variance: of the last gradient, {key: array} in NumPy, with `coupled=True`; summed over sensors.

    Raises `InputError` for options that do not go together, parameters that have no path gradient, arrays of another shape.
    """

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
        sensors = (sensor,) if single else tuple(sensor)
        given = () if references is None else (references,) if single else tuple(references)
        if not sensors or len(set(sensors)) < len(sensors) or (given and len(given) != len(sensors)):
            raise InputError(
                f"Renderer: expected different sensors, each with a reference if any has one, got {sensor!r}"
            )
        options = (image or Plain(), pixels or All(), spp, adjoint_spp, groups, coupled, sensors, single)
        self._options = Options(names, *options, max_depth or longest_path(port), seed, given, loss)
        self._port, self._scene = port, scene
        self._streams: dict[str, Stream] = {}
        self._step = 0
        self._last: tuple[Given, list[tuple[Stream, Rendered]]] | None = None
        self._thread: threading.Thread | None = None
        self._variances: list[Tree] = []
        for name in self._names(None):
            self._stream(name)
        self._exchange = Exchange(port, names)

    # ------------------------------------------------------------------ rendering

    def __call__(self, values: Any = None, sensor: int | None = None) -> Any:
        """The image, or the tuple of images, attached to the derivative graph of `values` in Dr.Jit and PyTorch; in NumPy as `render`.

        Args:
            values: see the class; None for the scene's own.
            sensor: another sensor than the renderer's; each keeps a state of its own. Not with mini-batches.
        """
        given, done, images = self._render(values, sensor)

        def backward(derivatives: tuple[Any, ...]) -> Tree:
            return self._backward(done, derivatives)

        match given.framework:
            case "numpy":
                attached = images
            case "drjit":
                from unrender.own_loop import drjit_operation

                attached = drjit_operation.apply(backward, images, self._exchange.attached(given))
            case "torch":
                attached = self._with_torch(given, images, backward)
        return attached[0] if self._alone(sensor) else attached

    def render(self, values: Any = None, sensor: int | None = None) -> Any:
        """The image, or the tuple of images, of the kind of `values` and detached from them; `backward` takes it from here.

        Args:
            values, sensor: see `__call__`.
        """
        _, _, images = self._render(values, sensor)
        return images[0] if self._alone(sensor) else images

    def backward(self, derivative: Any) -> dict[str, Any]:
        """{key: gradient} of a loss from its derivative by the image of the last `render`; of several images, a tuple of derivatives.

        Raises `InputError` where nothing was rendered, or the derivative has another shape than the image.
        """
        if self._last is None:
            raise InputError("Renderer: backward comes after render")
        self._check_thread("backward")
        given, done = self._last
        derivatives = tuple(derivative) if isinstance(derivative, (tuple, list)) else (derivative,)
        if len(derivatives) != len(done):
            raise InputError(f"Renderer: expected {len(done)} derivatives, one for each image, got {len(derivatives)}")
        return self._exchange.gradient(self._backward(done, derivatives), given)

    def preview(self, values: Any = None, spp: int = 64, sensor: int | None = None, seed: int = 0) -> np.ndarray:
        """A picture (H, W, 3) of `values`, NumPy, plain and whole, that leaves the renderer as it was."""
        chosen = self._options.sensors[0] if sensor is None else sensor
        problem = problem_of(self._port, self._options, (chosen,), self._scene)
        return render_view(problem, numpy(self._exchange.tree(self._exchange.read(values))), 0, spp, seed)

    # ------------------------------------------------------------------ mini-batches

    @property
    def batch(self) -> Batch:
        """The pixels of the last render, arrays of the kind of its values. Raises `InputError` where it was of whole images."""
        if self._last is None or (batch := self._last[1][0][1].batch) is None:
            raise InputError("Renderer: there is no mini-batch; it has pixels=All(), or nothing was rendered yet")
        self._check_thread("batch")
        given = self._last[0]
        if given.framework == "drjit":
            return batch
        found = Batch(arrays.numpy(batch.sensors), arrays.numpy(batch.pixels), arrays.numpy(batch.weights))
        if given.framework == "numpy":
            return found
        import torch  # pyright: ignore[reportMissingImports]

        like = next(value for value in given.values.values() if frameworks.is_torch(value))
        whole = [torch.from_numpy(part.astype(np.int64)).to(like.device) for part in (found.sensors, found.pixels)]
        return Batch(whole[0], whole[1], frameworks.to_torch(found.weights, like))

    def gather(self, images: Any) -> Any:
        """The pixels of the last render, (N, C), of an image (H, W, C) or, with several sensors, of a list of them; unchanged where the
        render was of whole images.

        Args:
            images: of the kind of the values that were rendered; NumPy's become such.
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
            if frameworks.shape(image)[:2] != size or len(frameworks.shape(image)) != 3:
                raise InputError(f"Renderer: expected an image {(*size, 3)}, got {frameworks.shape(image)}")
        if frameworks.is_torch(batch.weights) or not arrays.is_drjit(batch.weights):
            flat = [image.reshape(-1, frameworks.shape(image)[2]) for image in several]
            starts = np.cumsum([0, *(len(rows) for rows in flat)])[:-1]
            if frameworks.is_torch(batch.weights):
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
        """See the class; None without `coupled`, or before the first gradient."""
        if not self._variances:
            return None
        total = self._variances[0]
        for other in self._variances[1:]:
            total = add(total, other)
        return numpy(total)

    @property
    def state(self) -> RendererState:
        """All that decides what the next steps do, beside the parameters: a frozen dataclass of arrays."""
        return RendererState(self._step, self._options.seed, {name: one.state for name, one in self._streams.items()})

    def save(self, path: str | Path) -> Path:
        """Write the state to a file, so that a renderer of the same options that loads it goes on as this one would, bit for bit where
        sums have an order (see `optimize`). Returns the path. Raises `InputError` where it cannot be written."""
        return saved.write(Path(path), self.state, self._options.describe())

    def load(self, path: str | Path) -> None:
        """Go on from a state that `save` wrote. Raises `InputError` for a file that is damaged, or of other options."""
        found = saved.read(Path(path), self._options.describe(), self.state)
        streams = {name: self._stream(name) for name in found.streams}
        for name, stream in streams.items():
            stream.state = found.streams[name]
        for name in set(self._streams) - set(streams):
            del self._streams[name]
        self._step, self._last, self._variances = found.step, None, []
        self._options = saved.with_seed(self._options, found.seed)

    # ------------------------------------------------------------------ the two passes

    @exclusive("Renderer")
    def _render(self, values: Any, sensor: int | None) -> tuple[Given, list[tuple[Stream, Rendered]], tuple[Any, ...]]:
        given = self._exchange.read(values)
        parameters = self._exchange.tree(given)
        key, done, images = Key(self._options.seed, self._step), [], []
        for name in self._names(sensor):
            stream = self._stream(name)
            number = 0 if name == _MINI_BATCHES else int(name)
            rendered, image = stream.render(parameters, key.fold(number))
            done.append((stream, rendered))
            images.append(self._exchange.image(image, given))
        self._step += 1
        self._last, self._thread = (given.detached(), done), threading.current_thread()
        return given, done, tuple(images)

    @exclusive("Renderer")
    def _backward(self, done: list[tuple[Stream, Rendered]], derivatives: Sequence[Any]) -> Tree:
        total: Tree | None = None
        self._variances = []
        for (stream, rendered), derivative in zip(done, derivatives, strict=True):
            found = stream.backward(rendered, self._exchange.derivative(derivative, rendered.shape))
            total = found if total is None else add(total, found)
            self._variances += [] if stream.variance is None else [stream.variance]
        if total is None:
            raise InputError("Renderer: nothing was rendered")
        arrays.evaluate(total)
        return total

    def _check_thread(self, what: str) -> None:
        """Raise `InputError` where another thread has rendered last: what is asked for belongs to its image."""
        if self._thread is not threading.current_thread():
            raise InputError(
                f"Renderer: {what} in another thread than the last render, whose image it would belong to; give each thread a Renderer"
            )

    def _with_torch(self, given: Given, images: tuple[Any, ...], backward: Callable[..., Tree]) -> tuple[Any, ...]:
        from unrender.own_loop import torch_operation

        tensors = {key: value for key, value in given.values.items() if frameworks.is_torch(value)}
        alike = {key: value.detach() for key, value in tensors.items()}
        device = images[0].device

        def gradients(derivatives: tuple[Any, ...]) -> list[Any]:
            found = backward(derivatives)
            return [frameworks.to_torch(arrays.numpy(found[key]), x).to("cpu") for key, x in alike.items()]

        on_host = tuple(image.to("cpu") for image in images)
        return tuple(x.to(device) for x in torch_operation.apply(gradients, on_host, list(tensors.values())))

    # ------------------------------------------------------------------ sensors

    def _alone(self, sensor: int | None) -> bool:
        return sensor is not None or self._options.single or not self._options.all_pixels

    def _names(self, sensor: int | None) -> list[str]:
        if not self._options.all_pixels:
            if sensor is not None:
                raise InputError("Renderer: a mini-batch is of all sensors; give them at construction, sensor=[...]")
            return [_MINI_BATCHES]
        return [str(one) for one in (self._options.sensors if sensor is None else [sensor])]

    def _stream(self, name: str) -> Stream:
        if name not in self._streams:
            sensors = self._options.sensors if name == _MINI_BATCHES else (_sensor(name),)
            self._streams[name] = Stream(self._problem(sensors), self._options)
        return self._streams[name]

    def _problem(self, sensors: tuple[int, ...]) -> Problem:
        return problem_of(self._port, self._options, sensors, self._scene)

    def __repr__(self) -> str:
        shown: Mapping[str, Any] = self._options.describe()
        return f"Renderer({', '.join(f'{name}={value}' for name, value in shown.items())}, step={self._step})"


def _sensor(name: str) -> int:
    try:
        return int(name)
    except ValueError as error:
        raise InputError(f"Renderer: sensor must be a whole number, got {name!r}") from error
