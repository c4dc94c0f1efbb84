"""`unrender.Renderer` in loops of NumPy and PyTorch, on a renderer whose images and gradients are known."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import unrender as ur
from tests.analytic import AnalyticRenderer
from tiers import slow
from unrender.core.errors import InputError
from unrender.gallery.analytic import ExponentialRenderer
from unrender.own_loop.stream import Rendered

CV = ur.images.RecursiveControlVariate
Uniform, Adaptive = ur.pixels.Uniform, ur.pixels.Adaptive
KEYS = ["colour", "map"]
START = {"colour": np.full(3, 0.5), "map": np.full((2, 2, 1), 0.5)}


def scene(noise: float = 0.5, sensors: int = 1) -> AnalyticRenderer:
    rng = np.random.default_rng(0)
    truth = {"colour": rng.uniform(0.3, 0.9, 3), "map": rng.uniform(0.3, 0.9, (2, 2, 1))}
    return AnalyticRenderer(truth, rng.uniform(0, 1, (48, 7)), 0.1, noise, sensors=sensors)


REFERENCE = scene().exact(scene().values(KEYS))
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "other adjoint spp": {"spp": 2, "adjoint_spp": 5},
    "two groups": {"groups": 2, "spp": 2},
    "four groups": {"groups": 4},
    "control variate": {"image": CV()},
    "control variate, two groups": {"image": CV(), "groups": 2},
    "uniform pixels": {"pixels": Uniform(24), "spp": 2},
    "uniform pixels, two groups": {"pixels": Uniform(24), "groups": 2},
    "uniform pixels, control variate": {"pixels": Uniform(24), "image": CV(whole_views=2), "groups": 2},
    "pixels by loss": {"pixels": ur.pixels.LossProportional(24, denoiser="none"), "references": REFERENCE},
    "adaptive pixels": {"pixels": Adaptive(24, denoiser="none", refresh=2), "references": REFERENCE},
}
COUPLED: dict[str, dict[str, Any]] = {
    "coupled": {"coupled": True},
    "coupled, control variate": {"coupled": True, "image": CV()},
}


def derivative(renderer: ur.Renderer, image: Any) -> Any:
    """Of the mean of (image − reference)², over groups too."""
    difference = image - renderer.gather(REFERENCE)
    mini_batch = image.shape[-2:] != REFERENCE.shape[1:] or image.shape[-3:] != REFERENCE.shape
    if not mini_batch:
        return 2 * difference / image.size
    return 2 * difference * renderer.batch.weights / (image.shape[0] if image.ndim == 3 else 1)


def exact_gradient(at: dict[str, np.ndarray]) -> np.ndarray:
    port = scene()
    return (2 * (port.exact(at) - REFERENCE) / REFERENCE.size).reshape(-1) @ port.matrix


def drifted(step: int) -> dict[str, np.ndarray]:
    return {key: value - 0.05 * step for key, value in START.items()}


def flat(gradient: dict[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(g) for g in gradient.values()])


def after_a_drift(options: dict[str, Any], runs: int, steps: int = 5) -> np.ndarray:
    """(runs, n): the last gradient of loops of their own, whose parameters drift."""
    rows = []
    for seed in range(runs):
        renderer = ur.Renderer(scene(), KEYS, seed=seed, **options)
        found: dict[str, Any] = {}
        for step in range(steps):
            image = renderer.render(drifted(step))
            found = renderer.backward(derivative(renderer, image))
        rows.append(flat(found))
    return np.array(rows)


def worst_z(rows: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    z = (rows.mean(0) - exact) / (rows.std(0, ddof=1) / np.sqrt(len(rows)))
    return float(np.abs(z).max()), float(stats.norm.isf((1 - (1 - 1e-3) ** (1 / z.size)) / 2))


QUICK = ("two groups", "control variate, two groups")


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in OPTIONS])
def test_gradients_are_unbiased(name: str) -> None:
    rows = after_a_drift(OPTIONS[name], 120)
    exact = exact_gradient(drifted(4))
    worst, limit = worst_z(rows, exact)
    assert worst < limit
    assert worst_z(rows * 1.25, exact)[0] > limit, "a planted bias of 25 % went unseen"


def test_coupled_gradients_have_less_noise_and_say_how_much() -> None:
    """Where the image has little noise left: then it is the adjoint's, which the recursion reduces."""
    plain, coupled, told = [], [], []
    for seed in range(40):
        given = np.random.default_rng(1).normal(size=REFERENCE.shape)  # the same derivative at every step
        for rows, keep in ((plain, False), (coupled, True)):
            renderer = ur.Renderer(scene(), KEYS, seed=seed, coupled=keep)
            found: dict[str, Any] = {}
            for step in range(8):
                renderer.render(drifted(step // 4))
                found = renderer.backward(given)
            rows.append(flat(found))
            if keep:
                assert renderer.variance is not None
                told.append(flat(renderer.variance))
            else:
                assert renderer.variance is None
    measured = np.var(coupled, axis=0).sum()
    assert measured < 0.45 * np.var(plain, axis=0).sum()
    assert measured < np.mean(told, axis=0).sum()  # a second moment, so no less than the variance
    exact = given.reshape(-1) @ scene().matrix  # pyright: ignore[reportPossiblyUnboundVariable]
    shrunk = np.mean(coupled, axis=0) @ exact / (exact @ exact)
    assert 0.9 < shrunk < 1.01  # the bias that the docstring admits


@pytest.mark.parametrize("name", [*OPTIONS, *COUPLED])
def test_a_saved_state_goes_on_bit_for_bit(name: str, tmp_path: Path) -> None:
    options = (OPTIONS | COUPLED)[name]

    def step(renderer: ur.Renderer, number: int) -> list[np.ndarray]:
        image = renderer.render(drifted(number))
        return [image, flat(renderer.backward(derivative(renderer, image)))]

    first = ur.Renderer(scene(), KEYS, seed=7, **options)
    for number in range(3):
        step(first, number)
    first.save(tmp_path / "state")
    expected = [x for number in range(3, 6) for x in step(first, number)]
    other = ur.Renderer(scene(), KEYS, **options)  # of another seed, which is the state's from now on
    other.load(tmp_path / "state")
    for one, two in zip(expected, [x for number in range(3, 6) for x in step(other, number)], strict=True):
        np.testing.assert_array_equal(one, two)
    fresh = ur.Renderer(scene(), KEYS, seed=7, **options)
    assert not np.array_equal(step(fresh, 3)[0], expected[0])


def test_a_state_that_does_not_fit_is_one_line(tmp_path: Path) -> None:
    renderer = ur.Renderer(scene(), KEYS, image=CV())
    renderer.render(START)
    path = renderer.save(tmp_path / "state")
    whole = path.read_bytes()
    with pytest.raises(
        InputError, match=r"state: it is of a Renderer with image=.RecursiveControlVariate.*this one has 'Plain"
    ):
        ur.Renderer(scene(), KEYS).load(path)
    with pytest.raises(InputError, match="with spp=4, this one has 2"):
        ur.Renderer(scene(), KEYS, image=CV(), spp=2).load(path)
    for number, damaged in enumerate(
        (b"", whole[:40], whole[:-8], b"\x10" + whole[1:], whole.replace(b'"format"', b'"tamrof"'))
    ):
        (tmp_path / f"damaged{number}").write_bytes(damaged)
        with pytest.raises(InputError) as caught:
            renderer.load(tmp_path / f"damaged{number}")
        assert "\n" not in str(caught.value)
    for old, new in (
        (b"RecursiveControlVariateState", b"RecursiveControlVariateStatf"),
        (b'\\"step\\": 1', b'\\"step\\":-1'),
    ):
        assert old in whole
        (tmp_path / "forged").write_bytes(whole.replace(old, new))
        with pytest.raises(InputError, match="forged"):
            renderer.load(tmp_path / "forged")
    with pytest.raises(InputError, match="nowhere"):
        renderer.load(tmp_path / "nowhere")
    renderer.load(path)


def test_several_sensors_have_a_state_each() -> None:
    both = ur.Renderer(scene(sensors=2), KEYS, image=CV(), sensor=[0, 1], seed=2)
    images = both.render(START)
    assert isinstance(images, tuple)
    assert not np.array_equal(*images)
    total = both.backward(tuple(np.ones_like(image) for image in images))
    parts = []
    for sensor in (0, 1):
        one = ur.Renderer(scene(sensors=2), KEYS, image=CV(), sensor=sensor, seed=2)
        np.testing.assert_array_equal(one.render(START), images[sensor])
        parts.append(flat(one.backward(np.ones_like(images[sensor]))))
    np.testing.assert_allclose(flat(total), parts[0] + parts[1], rtol=1e-12)
    # One that is asked for in the call begins anew, and goes on from there.
    one = ur.Renderer(scene(sensors=2), KEYS, image=CV(), seed=2)
    assert one.render(START, sensor=1).shape == REFERENCE.shape
    assert set(one.state.streams) == {"0", "1"}
    with pytest.raises(InputError, match="sensor must be 0 to 1, got 2"):
        one.render(START, sensor=2)
    assert one.preview(START, sensor=np.int64(1)).shape == REFERENCE.shape  # pyright: ignore[reportArgumentType]


def test_a_mini_batch_says_its_pixels() -> None:
    renderer = ur.Renderer(scene(sensors=2), KEYS, pixels=Uniform(40), sensor=[0, 1], seed=1)
    with pytest.raises(InputError, match="nothing was rendered yet"):
        _ = renderer.batch
    numbers = [np.arange(48).reshape(4, 4, 3) + 100.0 * sensor for sensor in (0, 1)]
    totals = []
    for _ in range(40):
        image = renderer.render(START)
        batch = renderer.batch
        assert image.shape == (40, 3)
        assert set(batch.sensors) == {0, 1}
        rows = renderer.gather(numbers)
        np.testing.assert_array_equal(rows[:, 0], 100 * batch.sensors.astype(float) + 3 * batch.pixels.astype(float))
        totals.append((batch.weights * rows).sum())
    assert np.mean(totals) == pytest.approx(np.mean(numbers), abs=4 * np.std(totals) / np.sqrt(len(totals)))
    with pytest.raises(InputError, match="expected 2 images"):
        renderer.gather(numbers[0])
    with pytest.raises(InputError, match="mini-batch contains all sensors"):
        renderer.render(START, sensor=1)
    whole = ur.Renderer(scene(), KEYS, pixels=Uniform(8), image=CV())
    assert whole.render(START).shape == (16, 3)  # the control variate's first step
    assert whole.batch.weights.sum() == pytest.approx(1 / 3)
    assert whole.gather(numbers[0]).tolist() == numbers[0].reshape(16, 3).tolist()
    assert whole.render(START).shape == (8, 3)


def test_a_preview_leaves_the_renderer_as_it_was() -> None:
    renderers = [ur.Renderer(scene(), KEYS, image=CV(), seed=4) for _ in range(2)]
    for renderer in renderers:
        renderer.render(START)
    assert renderers[0].preview(START, spp=4096) == pytest.approx(scene().exact(START), abs=0.05)
    np.testing.assert_array_equal(*(renderer.render(START) for renderer in renderers))


def test_values_come_in_several_forms() -> None:
    one = AnalyticRenderer({"map": np.ones((2, 2, 1))}, np.ones((48, 4)))
    alone = [ur.Renderer(one, "map", seed=1).render(x) for x in (np.full((2, 2, 1), 0.5), {"map": [[[0.5]] * 2] * 2})]
    np.testing.assert_array_equal(*alone)
    np.testing.assert_array_equal(*(ur.Renderer(one, "map", seed=1).render(x) for x in (None, np.ones((2, 2, 1)))))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ur.Renderer(scene(), ["colur"]), "the scene has no parameter colur"),
        (lambda: ur.Renderer(scene(), []), "keys must be a list of scene parameters"),
        (lambda: ur.Renderer(scene(), KEYS, spp=0), "spp must be a whole number of at least 1, got 0"),
        (lambda: ur.Renderer(scene(), KEYS, spp=4, groups=3), "groups must divide spp, 4, got 3"),
        (lambda: ur.Renderer(scene(), KEYS, groups=2, adjoint_spp=1), "adjoint_spp needs groups=1"),
        (lambda: ur.Renderer(scene(), KEYS, groups=2, coupled=True), "coupled=True needs groups=1"),
        (lambda: ur.Renderer(scene(), KEYS, pixels=Uniform(8), coupled=True), r"use pixels=unrender.pixels.All\(\)"),
        (lambda: ur.Renderer(scene(), KEYS, pixels=Adaptive(8)), "Adaptive samples pixels by their loss derivative; set ref"),
        (lambda: ur.Renderer(scene(), KEYS, pixels=ur.pixels.AdaptiveCounts()), "which only optimize\\(\\) knows"),
        (lambda: ur.Renderer(scene(), KEYS, pixels=8), "pixels must be one of unrender.pixels"),  # pyright: ignore[reportArgumentType]
        (lambda: ur.Renderer(scene(), KEYS, image=CV), "image must be one of unrender.images"),  # pyright: ignore[reportArgumentType]
        (lambda: ur.Renderer(scene(), KEYS, sensor=3), "sensor must be 0, the only one, got 3"),
        (lambda: ur.Renderer(scene(), KEYS, sensor=[0, 0]), "different sensors"),
        (lambda: ur.Renderer(3, KEYS), "scene: expected an .xml file"),
        (lambda: ur.Renderer(scene(), KEYS).backward(REFERENCE), "call render before backward"),
        (lambda: ur.Renderer(scene(), KEYS).render({"colour": START["colour"]}), "no value for parameter map"),
        (lambda: ur.Renderer(scene(), KEYS).render(START["colour"]), r"expected \{key: array\} for colour, map"),
        (lambda: ur.Renderer(scene(), KEYS).render({**START, "colour": np.ones(4)}), r"colour: expected shape \(3,\), got \(4,\)"),
        (lambda: ur.Renderer(scene(), KEYS).render({**START, "colour": ["a"] * 3}), "colour: expected an array of numbers"),
        (lambda: ur.Renderer(scene(), KEYS).render({**START, "colour": [[1], []]}), "colour: .*, got rows of different lengths$"),
        (lambda: ur.Renderer(scene(), KEYS).render({**START, "colour": bytearray(b"abc")}), "colour: expected linear values"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_one_line(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_derivative_of_another_shape_is_refused() -> None:
    renderer = ur.Renderer(scene(), KEYS, groups=2)
    renderer.render(START)
    with pytest.raises(InputError, match=r"derivative of the loss by the image, \(2, 4, 4, 3\), got \(4, 4, 3\)"):
        renderer.backward(REFERENCE)
    with pytest.raises(InputError, match="expected 1 derivatives, one for each image, got 2"):
        renderer.backward([REFERENCE, REFERENCE])


# ---------------------------------------------------------------------- PyTorch


def tensors(torch: Any) -> dict[str, Any]:
    return {key: torch.tensor(value, requires_grad=True) for key, value in START.items()}


@pytest.mark.parametrize("name", ["plain", "control variate, two groups", "uniform pixels, control variate", "coupled"])
def test_pytorch_has_the_gradients_of_numpy(name: str) -> None:
    torch = pytest.importorskip("torch")
    options = (OPTIONS | COUPLED)[name]
    given, reference = tensors(torch), torch.tensor(REFERENCE)
    differentiable, explicit = (ur.Renderer(scene(), KEYS, seed=5, **options) for _ in range(2))
    for _ in range(4):
        image = differentiable(given)
        rows = differentiable.gather(reference)
        if "pixels" in options:
            weights = differentiable.batch.weights
            assert weights.dtype == torch.float64
            loss = (weights * (image - rows) ** 2).sum() / image.shape[0]
        else:
            loss = ((image - rows) ** 2).mean()
        for value in given.values():
            value.grad = None
        loss.backward()
        seen = explicit.render(START)
        np.testing.assert_array_equal(image.detach().numpy(), seen)
        found = explicit.backward(derivative(explicit, seen))
        for key, value in given.items():
            assert value.grad is not None
            np.testing.assert_allclose(value.grad.numpy(), found[key], rtol=1e-12)


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_a_number_may_have_axes_of_length_one(shape: tuple[int, ...]) -> None:
    """The output of a network is (1,) or (1, 1): its gradient has the same shape."""
    torch = pytest.importorskip("torch")
    number = AnalyticRenderer({"alpha": np.full((), 0.5)}, np.ones((48, 1)), 0.1, 0.0)
    for coupled in (False, True):
        renderer = ur.Renderer(number, ["alpha"], coupled=coupled)
        alpha = torch.full(shape, 0.4, requires_grad=True)
        (renderer(alpha) ** 2).sum().backward()
        assert alpha.grad is not None
        assert alpha.grad.shape == shape
        image = renderer.render(np.full(shape, 0.4))
        assert renderer.backward(2 * image)["alpha"].shape == shape


def test_pytorch_differentiates_what_comes_before_and_after() -> None:
    torch = pytest.importorskip("torch")
    x = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    renderer = ur.Renderer(scene(noise=0.0), KEYS)
    fixed = torch.tensor(START["map"])
    image = renderer({"colour": x * torch.ones(3, dtype=torch.float64), "map": fixed})
    assert fixed.grad is None
    (image**2).sum().backward()
    slope = scene().matrix[:, :3].sum(axis=1)
    assert x.grad is not None
    assert x.grad.item() == pytest.approx((2 * scene().exact(START).reshape(-1) * slope).sum())
    with torch.no_grad():
        assert not renderer(tensors(torch)).requires_grad
    single = renderer({key: value.float().requires_grad_() for key, value in tensors(torch).items()})
    assert single.dtype == torch.float32
    images = ur.Renderer(scene(sensors=2), KEYS, sensor=[0, 1])(tensors(torch))
    images[1].sum().backward()  # the other has no derivative


def test_the_graph_before_a_render_goes_with_its_step() -> None:
    """Neither the renderer nor its node keep it, though the renderer may be asked for its pixels still."""
    torch = pytest.importorskip("torch")
    renderer = ur.Renderer(scene(), KEYS, pixels=Uniform(8))
    weight = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    colour = weight * torch.ones(3, dtype=torch.float64)
    before = weakref.ref(colour)
    gc.disable()
    try:
        renderer({"colour": colour, "map": torch.tensor(START["map"])}).sum().backward()
        del colour
        assert before() is None
    finally:
        gc.enable()
    assert weight.grad is not None
    assert renderer.batch.weights.shape == (8, 1)


def test_pytorch_and_drjit_are_not_mixed() -> None:
    torch = pytest.importorskip("torch")
    from drjit.scalar import ArrayXf

    with pytest.raises(InputError, match=r"arrays of Dr\.Jit and of PyTorch are mixed"):
        ur.Renderer(scene(), KEYS)({"colour": ArrayXf([0.5] * 3), "map": torch.tensor(START["map"])})


@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("control variate, two groups", 60),
        slow("control variate, two groups", 600),
        slow("coupled", 600),
        slow("uniform pixels, control variate", 600),
    ],
)
def test_a_loop_keeps_nothing_of_its_steps(name: str, steps: int) -> None:
    """No step's graph outlives it, without the garbage collector, and nothing grows."""
    torch = pytest.importorskip("torch")
    renderer = ur.Renderer(scene(), KEYS, **(OPTIONS | COUPLED)[name])
    given = tensors(torch)
    gc.collect()
    gc.disable()
    try:
        objects = []
        for step in range(steps):
            (renderer(given) ** 2).mean().backward()
            with torch.no_grad():
                for value in given.values():
                    value -= 1e-4 * value.grad
                    value.grad = None
            if step in (steps // 4, steps - 1):
                objects.append(len(gc.get_objects()))
        assert sum(type(x) is Rendered for x in gc.get_objects()) <= 2
        assert objects[1] <= objects[0] + 50
    finally:
        gc.enable()


# ---------------------------------------------------------------------- what is refused


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_derivative_that_is_not_finite_is_one_line(bad: float) -> None:
    renderer = ur.Renderer(scene(), KEYS)
    image = renderer.render(START)
    given = np.ones_like(image)
    given[0, 1, 2] = bad
    line = rf"derivative of the loss by the image is not finite, {bad} at \(0, 1, 2\), one of 1 of {image.size} values"
    with pytest.raises(InputError, match=line):
        renderer.backward(given)
    assert all(np.isfinite(g).all() for g in renderer.backward(np.ones_like(image)).values())


def test_values_that_would_be_ignored_are_one_line() -> None:
    renderer = ur.Renderer(scene(), ["colour"])
    with pytest.raises(InputError, match=r"Renderer: colour2 is not one of its parameters; did you mean colour\?"):
        renderer.render({"colour": START["colour"], "colour2": START["colour"]})
    with pytest.raises(
        InputError, match="map is not one of its parameters; it was created for colour, and would ignore it"
    ):
        renderer.render(START)

    class Optimizer:
        """As of Dr.Jit: a mapping that is no dictionary, with a variable that is nothing of the scene's."""

        def __init__(self, **values: Any) -> None:
            self.values = values

        def keys(self) -> Any:
            return self.values.keys()

        def __getitem__(self, key: str) -> Any:
            return self.values[key]

    renderer.render(Optimizer(colour=START["colour"], latent=np.zeros(3)))
    with pytest.raises(InputError, match="map is not one of its parameters"):
        renderer.render(Optimizer(**START))


@pytest.mark.parametrize("value", [None, [None, 0.1, 0.2], [0.1, np.nan, 0.2], "red", {}])
def test_values_that_are_no_numbers_are_one_line(value: Any) -> None:
    renderer = ur.Renderer(scene(), ["colour"])
    with pytest.raises(InputError, match="parameter colour: expected ") as raised:
        renderer.render({"colour": value})
    assert "\n" not in str(raised.value)
    renderer.render({"colour": START["colour"]})
    with pytest.raises(InputError, match="Renderer: "):
        renderer.backward(None)


def test_backward_of_another_threads_image_is_one_line() -> None:
    renderer = ur.Renderer(scene(), KEYS)
    image = renderer.render(START)
    thread = threading.Thread(target=renderer.render, args=(START,))
    thread.start()
    thread.join()
    with pytest.raises(
        InputError, match=r"backward in another thread than the last render.*use one Renderer per thread"
    ):
        renderer.backward(np.ones_like(image))
    image = renderer.render(START)
    renderer.backward(np.ones_like(image))


@pytest.mark.parametrize("framework", ["numpy", "torch"])
def test_values_outside_their_physical_range_are_warned_of_once(framework: str) -> None:
    """The optimizer of a loop knows no bounds. Where it leaves them, images mean nothing."""
    make: Any = float if framework == "numpy" else pytest.importorskip("torch").tensor
    renderer = ur.Renderer(ExponentialRenderer(lowest=0.05), ["rate"])
    renderer(make(0.05))
    with pytest.warns(
        UserWarning, match="Renderer: rate is expected to be at least 0.05, and has values outside: clip"
    ):
        renderer(make(0.04))
    renderer(make(-1.0))  # warnings are errors
