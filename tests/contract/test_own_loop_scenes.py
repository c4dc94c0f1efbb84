"""`unrender.Renderer` in loops of Dr.Jit, on Mitsuba's scenes: described, loaded, and left to their owner."""

from __future__ import annotations

import gc
import threading
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from backends import LAMP, TEXTURE, surface

import unrender as ur
from kernels import recorded
from tiers import slow
from unrender.core.errors import InputError

CV = ur.images.RecursiveControlVariate
KEYS = [TEXTURE, LAMP]
START = np.full((4, 4, 3), 0.5, np.float32)
GLOW = np.array([9.0, 8.0, 7.0], np.float32)
REFERENCE = np.full((8, 8, 3), 0.3, np.float32)


def attached() -> dict[str, Any]:
    """Parameters of a Dr.Jit loop: a tensor and a colour."""
    values = {TEXTURE: mi.TensorXf(START), LAMP: mi.Color3f(*GLOW.tolist())}
    dr.enable_grad(values)
    return values


def loss(image: Any) -> Any:
    return dr.mean(dr.square(image - mi.TensorXf(REFERENCE)), axis=None)


def explicit(renderer: ur.Renderer, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    image = renderer.render(values)
    return renderer.backward(2 * (image - REFERENCE) / image.size)


@pytest.fixture(params=["described", slow("loaded")])
def scene(request: pytest.FixtureRequest) -> Any:
    return surface if request.param == "described" else mi.load_dict(surface())


def test_a_call_is_differentiable(scene: Any) -> None:
    """Its gradient is that of the explicit form, in the types of the parameters, through operations before and after it."""
    values = attached()
    dr.backward(3 * loss(ur.Renderer(scene, KEYS, groups=2, seed=3)({**values, TEXTURE: values[TEXTURE] * 0.8})))
    found = explicit(ur.Renderer(scene, KEYS, groups=2, seed=3), {TEXTURE: START * np.float32(0.8), LAMP: GLOW})
    assert isinstance(dr.grad(values[LAMP]), mi.Color3f)
    np.testing.assert_allclose(dr.grad(values[TEXTURE]).numpy(), 2.4 * found[TEXTURE], rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(np.ravel(dr.grad(values[LAMP]).numpy()), 3 * found[LAMP], rtol=1e-4)
    assert np.abs(found[TEXTURE]).max() > 1e-5


@pytest.mark.slow
def test_two_images_of_one_loss(scene: Any) -> None:
    """Each goes back with its own parameters, of which some are equal."""
    values = attached()
    renderer = ur.Renderer(scene, KEYS, spp=4, seed=3)
    dr.backward(loss(renderer(values)) + loss(renderer({**values, TEXTURE: values[TEXTURE] * 0.8})))
    again = ur.Renderer(scene, KEYS, spp=4, seed=3)
    one = explicit(again, {TEXTURE: START, LAMP: GLOW})
    two = explicit(again, {TEXTURE: START * np.float32(0.8), LAMP: GLOW})
    expected = one[TEXTURE] + 0.8 * two[TEXTURE]
    np.testing.assert_allclose(dr.grad(values[TEXTURE]).numpy(), expected, rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(np.ravel(dr.grad(values[LAMP]).numpy()), one[LAMP] + two[LAMP], rtol=1e-4)


@pytest.mark.parametrize("changed", [[TEXTURE], slow([LAMP]), slow([TEXTURE, LAMP])])
def test_a_loaded_scene_that_others_change_meanwhile(changed: list[str]) -> None:
    """As a loop does that still says `params.update(optimizer)`."""
    loaded = mi.load_dict(surface())
    params, gradients = mi.traverse(loaded), []
    for meddle in (False, True):
        renderer, values = ur.Renderer(loaded, KEYS, seed=3), attached()
        value = loss(renderer(values))
        if meddle:
            for key in changed:
                params[key] = dr.detach(values[key]) * 0.3
            params.update()
        dr.backward(value)
        gradients.append(dr.grad(values[TEXTURE]).numpy())
    np.testing.assert_allclose(*gradients, rtol=1e-4, atol=1e-8)
    assert np.abs(gradients[0]).max() > 1e-5


def test_a_loaded_scene_has_one_state() -> None:
    loaded = mi.load_dict(surface())
    refused: list[dict[str, Any]] = [{"image": CV()}, {"image": CV("primary")}, {"coupled": True}]
    for options in refused:
        with pytest.raises(InputError, match=r"a loaded mi\.Scene has one state"):
            ur.Renderer(loaded, KEYS, **options)
    renderer = ur.Renderer(loaded, TEXTURE, spp=64)
    image = renderer.render(START)
    shown = np.array(mi.render(loaded, spp=256, integrator=mi.load_dict({"type": "path", "max_depth": 6})))
    assert np.mean(image) == pytest.approx(np.mean(shown), rel=0.2)  # it shows what was last rendered
    problem = ur.Problem(loaded, [ur.Parameter(TEXTURE, initial=0.5)], [ur.View(REFERENCE)])
    with pytest.raises(InputError, match=r"a loaded mi\.Scene has one state"):
        ur.optimize(problem, ur.PathGradient(CV(), spp=2), ur.optimizers.Adam(), steps=1)
    assert ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(), steps=2).steps == 2


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_parameters_of_dr_jit_that_are_not_finite_are_one_line(bad: float) -> None:
    """As those of NumPy: a later message would blame the loss."""
    values = START.copy()
    values[1, 2, 0] = bad
    for one in (mi.TensorXf(values), values):
        with pytest.raises(
            InputError, match=rf"^parameter .*: expected finite numbers, got {bad} at \(1, 2, 0\), one of 1 of 48"
        ):
            ur.Renderer(surface, [TEXTURE], spp=1)({TEXTURE: one})


def test_a_scene_of_another_variant_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A problem that is used after another `ur.use` was a traceback."""
    problem: Any = ur.Problem(surface, [ur.Parameter(TEXTURE, initial=0.5)], [ur.View(REFERENCE)])
    monkeypatch.setattr(problem.renderer.pair.loaded(), "variant", "llvm_ad_spectral")
    with pytest.raises(InputError, match=r"scene: it was loaded under llvm_ad_spectral, and .*; call unrender\.use\("):
        ur.optimize(problem, "plain", steps=1, progress=False)
    with pytest.raises(InputError, match="it was loaded under llvm_ad_spectral"):
        problem.initial()  # under a scalar variant it has no arrays
    Foreign = type("Scene", (), {"__module__": "mitsuba.scalar_rgb"})
    with pytest.raises(InputError, match="loaded under another variant than"):
        ur.Renderer(Foreign(), KEYS)


@pytest.mark.parametrize("by_call", [slow(False), True], ids=["explicit", "differentiable"])
def test_two_threads_draw_what_each_draws_alone(by_call: bool) -> None:
    """Renderers of two threads take turns: neither raises, and no random sequence depends on the other.

    `drjit.backward` of one thread beside another's kernels may wait for ever, within Dr.Jit. So those steps hold a lock, as the guide asks.
    """
    backward = threading.Lock()

    def descend(seed: int, found: dict[int, Any]) -> None:
        renderer = ur.Renderer(surface(), KEYS, groups=2, seed=seed)
        found[seed] = []
        for _ in range(3):
            if by_call:
                with backward:
                    values = attached()
                    dr.backward(loss(renderer(values)))
                    gradient = dr.grad(values[LAMP]).numpy()
            else:
                gradient = explicit(renderer, {TEXTURE: START, LAMP: GLOW})[LAMP]
            found[seed].append(np.ravel(gradient))

    alone: dict[int, Any] = {}
    together: dict[int, Any] = {}
    for seed in (1, 2):
        descend(seed, alone)
    threads = [threading.Thread(target=descend, args=(seed, together)) for seed in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for seed in (1, 2):
        assert len(together[seed]) == 3
        np.testing.assert_array_equal(together[seed], alone[seed])
    assert not np.array_equal(alone[1], alone[2])


def test_the_tutorials_loop_with_three_lines_changed() -> None:
    """Beside a scene of the user's own; the error falls, no kernel is new after the first steps."""
    own: Any = mi.load_dict(surface())
    texture: Any = mi.traverse(own)[TEXTURE]
    truth = texture.numpy()
    reference = mi.TensorXf(
        np.array(mi.render(own, spp=1024, integrator=mi.load_dict({"type": "path", "max_depth": 3})))
    )
    renderer = ur.Renderer(surface, [TEXTURE], image=CV(), spp=4, groups=2, max_depth=3)
    optimizer = mi.ad.Adam(lr=0.04)
    optimizer[TEXTURE] = mi.TensorXf(START * 0.1)

    def steps(count: int) -> None:
        for _ in range(count):
            image = renderer(optimizer)
            dr.backward(dr.mean(dr.square(image - reference), axis=None))
            optimizer.step()
            optimizer[TEXTURE] = dr.clip(optimizer[TEXTURE], 0, 1)

    steps(6)
    with recorded() as new:
        steps(4)
    assert new
    assert not any(new)
    steps(40)
    error = np.median(np.abs(optimizer[TEXTURE].numpy() - truth))  # some texels hide behind the ball
    assert error < 0.5 * np.median(np.abs(START * 0.1 - truth))


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_coupled_gradients_and_saved_states(tmp_path: Path) -> None:
    """In a Dr.Jit loop too; a renderer that loads the state goes on as the first."""

    def step(renderer: ur.Renderer, number: int) -> np.ndarray:
        values = {TEXTURE: mi.TensorXf(START * np.float32(1 - 0.02 * number))}
        dr.enable_grad(values)
        dr.backward(loss(renderer(values)))
        return dr.grad(values[TEXTURE]).numpy()

    options: dict[str, Any] = {"image": CV(), "coupled": True, "spp": 2, "max_depth": 3}
    first, second = ur.Renderer(surface, [TEXTURE], seed=1, **options), ur.Renderer(surface, [TEXTURE], **options)
    for number in range(3):
        step(first, number)
    second.load(first.save(tmp_path / "state"))
    for number in range(3, 5):
        np.testing.assert_array_equal(step(first, number), step(second, number))
    variance = first.variance
    assert variance is not None
    assert (variance[TEXTURE] > 0).any()


@pytest.mark.slow
def test_mini_batches_of_two_sensors() -> None:
    renderer = ur.Renderer(
        surface, [TEXTURE], pixels=ur.pixels.Uniform(32), sensor=[0, 1], spp=2, groups=2, max_depth=3
    )
    value = {TEXTURE: mi.TensorXf(START)}
    dr.enable_grad(value)
    image = renderer(value)
    assert image.shape == (2, 32, 3)
    reference = renderer.gather([mi.TensorXf(REFERENCE), REFERENCE * 2])
    assert set(np.round(np.unique(reference.numpy()), 4)) == {np.float32(0.3), np.float32(0.6)}
    dr.backward(dr.sum(renderer.batch.weights * dr.square(image - reference), axis=None) / 2)
    assert np.abs(dr.grad(value[TEXTURE]).numpy()).max() > 0


@pytest.mark.slow
def test_forward_mode_says_that_there_is_none() -> None:
    value = mi.TensorXf(START)
    dr.enable_grad(value)
    image = ur.Renderer(surface, [TEXTURE], max_depth=3)(value)
    with pytest.raises(RuntimeError, match=r"forward-mode derivatives are not supported"):
        dr.forward_from(value)
    del image


@pytest.mark.slow
@pytest.mark.parametrize("framework", ["drjit", "torch"])
def test_many_steps_leak_nothing(framework: str) -> None:
    """Neither variables of Dr.Jit nor memory. Objects of other tests may add some variables once, but a leak adds to every span."""
    torch = pytest.importorskip("torch") if framework == "torch" else None
    renderer = ur.Renderer(surface, [TEXTURE], image=CV(), spp=2, groups=2, max_depth=3)
    reference = mi.TensorXf(REFERENCE)
    value: Any = mi.TensorXf(START) if torch is None else torch.from_numpy(START.copy()).requires_grad_()
    counts, memory = [], []
    for step in range(800):
        if torch is None:
            value = mi.TensorXf(dr.detach(value))
            dr.enable_grad(value)
            dr.backward(dr.mean(dr.square(renderer(value) - reference), axis=None))
            value = value - 0.01 * dr.grad(value)
            dr.eval(value)
        else:
            value.grad = None
            ((renderer(value) - torch.from_numpy(REFERENCE)) ** 2).mean().backward()
            with torch.no_grad():
                gradient: Any = value.grad
                value -= 0.01 * gradient
        if step in (200, 500, 799):
            gc.collect()
            counts.append(len(str(dr.whos(as_string=True)).splitlines()))
            status = Path("/proc/self/status")
            memory.append(int(status.read_text().split("VmRSS:")[1].split()[0]) if status.exists() else 0)
    assert min(np.diff(counts)) <= 2
    assert memory[-1] <= memory[0] + 4096  # KiB
