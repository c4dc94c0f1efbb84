"""The perceptual loss: the network's sizes, its derivative, its weights' files, masks, batches, and a descent."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender import losses
from unrender.core import tables
from unrender.losses import perceptual

torch: Any = None
SIZES = {0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256)}
"""Inputs and outputs of the first convolutions, by their numbers in torchvision's vgg16().features."""
DEEP = {17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512)}


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Pictures this small are slower on several threads. PyTorch is imported here, not at collection by every test process."""
    global torch
    torch = pytest.importorskip("torch")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def tensors(sizes: dict[int, tuple[int, int]] = SIZES) -> dict[str, Any]:
    """Random weights under which signals neither die nor explode."""
    made = torch.Generator().manual_seed(0)
    found = {"classifier.0.weight": torch.zeros(1)}
    for number, (inputs, outputs) in sizes.items():
        found[f"features.{number}.weight"] = (
            torch.randn(outputs, inputs, 3, 3, generator=made) * (2 / (9 * inputs)) ** 0.5
        )
        found[f"features.{number}.bias"] = 0.1 * torch.randn(outputs, generator=made)
    return found


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "vgg16.pth"
    torch.save(tensors(), path)
    return path


@pytest.fixture(scope="module")
def loss(weights: Path) -> losses.Perceptual:
    return losses.Perceptual(weights, strength=3.0)


def pair(*shape: int) -> tuple[np.ndarray, np.ndarray]:
    image, reference = np.random.default_rng(0).uniform(0.05, 1.5, (2, *shape, 3))
    return image, reference


def total(loss: losses.Perceptual, image: np.ndarray, reference: np.ndarray) -> float:
    return float(loss.value(image, reference).mean())


def test_the_derivative_is_that_of_the_value(loss: losses.Perceptual) -> None:
    image, reference = pair(6, 5)
    slope = loss.derivative(image, reference) / image.size
    assert slope.shape == image.shape
    rng = np.random.default_rng(1)
    for _ in range(8):
        direction = rng.normal(size=image.shape) * rng.choice([1, 0], image.shape, p=[0.1, 0.9])
        step = 1e-6 * direction
        central = (total(loss, image + step, reference) - total(loss, image - step, reference)) / 2e-6
        assert float((slope * direction).sum()) == pytest.approx(central, rel=1e-4, abs=1e-9)


def test_the_value_is_the_mean_of_squared_differences_of_features(weights: Path) -> None:
    """The first layer by hand: a convolution and a rectifier of normalised sRGB."""
    image, reference = pair(3, 4)
    given = tensors()

    def features(linear: np.ndarray) -> np.ndarray:
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        x = (srgb - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        x = np.pad(x, ((1, 1), (1, 1), (0, 0)))
        kernel = given["features.0.weight"].numpy().astype(float)
        patches = np.stack([[x[i : i + 3, j : j + 3] for j in range(4)] for i in range(3)])
        return np.maximum(np.einsum("hwijc,ocij->hwo", patches, kernel) + given["features.0.bias"].numpy(), 0)

    expected = 2.0 * np.mean((features(image) - features(reference)) ** 2)
    found = losses.Perceptual(weights, layers=("relu1_1",), strength=2.0)
    assert total(found, image, reference) == pytest.approx(expected, rel=1e-6)
    assert total(found, reference, reference) == 0.0


def test_every_layer_of_the_network_has_its_place(tmp_path: Path) -> None:
    """All thirteen convolutions take torchvision's names and sizes, and each halving comes where it should."""
    path = tmp_path / "all.pth"
    torch.save({name: tensor.half() for name, tensor in tensors(SIZES | DEEP).items()}, path)
    loss = losses.Perceptual(path, layers=tuple(perceptual.LAYERS))
    network = loss._network(np.dtype(np.float32))
    with torch.no_grad():
        shapes = [tuple(x.shape[1:]) for x in network.features(torch.rand(1, 16, 32, 3))]
    widths = [64] * 2 + [128] * 2 + [256] * 3 + [512] * 6
    assert [shape[0] for shape in shapes] == widths
    assert [shape[1:] for shape in shapes] == [
        (16 // 2**b, 32 // 2**b) for b in (0, 0, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4)
    ]


def test_batches_are_images_one_by_one(loss: losses.Perceptual) -> None:
    images, reference = pair(3, 5, 4)[0], pair(5, 4)[1]
    values, slopes = loss.value(images, reference[None]), loss.derivative(images, reference)
    assert values.shape == slopes.shape == images.shape
    for image, value, slope in zip(images, values, slopes, strict=True):
        np.testing.assert_allclose(value, loss.value(image, reference), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(slope, loss.derivative(image, reference), rtol=1e-6, atol=1e-12)


@pytest.mark.mitsuba
def test_the_device_agrees_with_numpy(loss: losses.Perceptual) -> None:
    import mitsuba as mi

    image, reference = (x.astype(np.float32) for x in pair(5, 4))
    for function in (loss.value, loss.derivative):
        found = function(mi.TensorXf(image), mi.TensorXf(reference))
        assert isinstance(found, mi.TensorXf)
        np.testing.assert_allclose(found.numpy(), function(image, reference), rtol=1e-4, atol=1e-5)


def test_below_0_and_at_the_reference_nothing_pulls(loss: losses.Perceptual) -> None:
    image, reference = pair(4, 4)
    image[1, 2] = -0.5
    slope = loss.derivative(image, reference)
    assert np.isfinite(slope).all()
    assert not slope[1, 2].any()
    assert not loss.derivative(reference, reference).any()
    assert np.isfinite(loss.derivative(np.zeros_like(image), reference)).all()
    assert not loss.linear
    assert not loss.pixelwise


def asked(loss: Any, mask: np.ndarray | None = None) -> ur.Problem:
    """Colours of four smooth patches."""
    y, x = np.mgrid[0:8, 0:8] / 8
    patches = [np.exp(-9 * ((x - a) ** 2 + (y - b) ** 2)) for a in (0.2, 0.7) for b in (0.2, 0.7)]
    matrix = np.stack([np.kron(p.reshape(-1, 1), np.eye(3)[:, [c]]).ravel() for p in patches for c in range(3)], axis=1)
    truth = np.random.default_rng(0).uniform(0.2, 0.9, (4, 3))
    renderer = AnalyticRenderer({"colours": truth}, matrix, 0.05, noise=0.2, shape=(8, 8))
    view = ur.View(renderer.exact({"colours": truth}), mask=mask)
    return ur.Problem(renderer, [ur.Parameter("colours", 0.5, (0, 1))], [view], loss, truth={"colours": truth})


def test_a_descent_recovers_colours(weights: Path) -> None:
    loss = losses.Perceptual(weights, ("relu1_2", "relu2_2"))
    found = ur.optimize(asked(loss), ur.PathGradient(spp=16, adjoint_spp=1), ur.optimizers.Adam(0.04), steps=40)
    errors = [record["parameter_error"]["colours"] for record in found.history if "parameter_error" in record]
    assert errors[-1] < 0.3 * errors[0]


@pytest.mark.parametrize("kind", ["binary", "soft"])
def test_a_problems_derivative_is_exact_under_a_mask(loss: losses.Perceptual, kind: str) -> None:
    mask = np.random.default_rng(3).uniform(0, 1, (8, 8))
    mask = (mask > 0.4).astype(float) if kind == "binary" else mask
    problem = asked(loss, mask)
    image = pair(8, 8)[0]
    slope = problem.loss_derivative(0, image)
    assert not slope[mask == 0].any()
    for place in ((0, 0, 0), (3, 4, 1), (7, 7, 2), (5, 1, 0)):
        step = np.zeros_like(image)
        step[place] = 1e-6
        central = (problem.loss_value(0, image + step) - problem.loss_value(0, image - step)) / 2e-6
        assert slope[place] == pytest.approx(central, rel=1e-3, abs=1e-9)
    images = pair(3, 8, 8)[0]
    np.testing.assert_allclose(problem.loss_values(0, images), [problem.loss_value(0, i) for i in images], rtol=1e-9)


def test_weights_as_safetensors_are_the_same(loss: losses.Perceptual, tmp_path: Path) -> None:
    pytest.importorskip("safetensors")
    from safetensors.torch import save_file

    path = tmp_path / "vgg16.safetensors"
    save_file(tensors(), path)
    image, reference = pair(4, 4)
    same = losses.Perceptual(path, strength=3.0)
    assert total(same, image, reference) == total(loss, image, reference)


def _truncated(folder: Path) -> Path:
    torch.save(tensors(), folder / "w.pth")
    (folder / "w.pth").write_bytes((folder / "w.pth").read_bytes()[:5000])
    return folder / "w.pth"


def _saved(folder: Path, value: Any) -> Path:
    torch.save(value, folder / "w.pth")
    return folder / "w.pth"


def _written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


BAD_FILES = [
    (lambda f: f / "nowhere.pth", "No such file"),
    (lambda f: f, "not a file"),
    (_truncated, "cannot be read"),
    (lambda f: _written(f / "w.pth", b""), "cannot be read"),
    (lambda f: _written(f / "w.safetensors", b"\xff" * 40), "cannot be read"),
    (lambda f: _written(f / "w.safetensors", (2**60).to_bytes(8, "little") + b"{}"), "cannot be read"),
    (lambda f: _saved(f, [1, 2]), "expected named tensors, found a list"),
    (lambda f: _saved(f, {"a": torch.zeros(2)}), "has no features.0.weight"),
    (
        lambda f: _saved(f, tensors() | {"features.2.weight": torch.zeros(64, 3, 3, 3)}),
        "features.2.weight must be of shape",
    ),
    (lambda f: _saved(f, tensors() | {"features.2.bias": "none"}), "features.2.bias must be of shape"),
    (lambda f: _saved(f, tensors() | {"features.0.bias": torch.full((64,), torch.nan)}), "not finite"),
    (lambda f: _saved(f, {"features.0.weight": _Hostile()}), "cannot be read"),
]


class _Hostile:
    """Would write a file when unpickled."""

    def __reduce__(self) -> Any:
        return (open, ("hostile-was-here", "w"))


@pytest.mark.parametrize(("make", "message"), BAD_FILES)
def test_bad_weights_are_one_line(make: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ur.InputError, match=f"Perceptual: weights .*{message}") as caught:
        losses.Perceptual(make(tmp_path))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "hostile-was-here").exists()


def test_bad_options_are_named(weights: Path, loss: losses.Perceptual) -> None:
    for bad, message in (
        ({"layers": ("relu3_4",)}, "there is no 'relu3_4'; did you mean relu3_3"),
        ({"layers": "relu1_1"}, "layers must be a list"),
        ({"layers": ()}, "layers must be a list"),
        ({"strength": 0}, "strength"),
        ({"weights": 3}, "weights must be a file"),
    ):
        with pytest.raises(ur.InputError, match=message):
            losses.Perceptual(**{"weights": weights, **bad})
    with pytest.raises(ur.InputError, match="3x8 is too small for the layer relu3_3"):
        loss.value(*pair(8, 3))


def test_without_pytorch_or_torchvision_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    perceptual._load.cache_clear()
    monkeypatch.setitem(sys.modules, "torchvision.models", None)
    with pytest.raises(ur.InputError, match="torchvision is not installed; give a file of weights"):
        losses.Perceptual()
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ur.InputError, match=r"needs PyTorch: pip install 'unrender\[torch\]'$"):
        losses.Perceptual()


@pytest.mark.mitsuba
def test_a_problem_file_names_it(weights: Path, tmp_path: Path) -> None:
    made = tables.component({"type": "Perceptual", "weights": str(weights), "layers": ["relu1_2"]}, "loss")
    assert made == losses.Perceptual(str(weights), ("relu1_2",))
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>'
        '<integer name="height" value="4"/></film></sensor><emitter type="constant" id="sky"/></scene>'
    )
    np.save(tmp_path / "photo.npy", np.ones((4, 4, 3)))
    (tmp_path / "vgg16.pth").write_bytes(weights.read_bytes())
    (tmp_path / "problem.toml").write_text(
        'scene = "scene.xml"\nloss = { type = "Perceptual", weights = "vgg16.pth" }\n[[parameters]]\n'
        'key = "sky.radiance.value"\n[[views]]\nreference = "photo.npy"\n'
    )
    found = ur.Problem.from_file(tmp_path / "problem.toml").loss
    assert isinstance(found, losses.Perceptual)
    assert found.weights == str(tmp_path / "vgg16.pth")
    (tmp_path / "vgg16.pth").unlink()
    with pytest.raises(ur.InputError, match=r"problem.toml:2: loss: Perceptual: weights .*vgg16.pth: No such file"):
        ur.Problem.from_file(tmp_path / "problem.toml")
