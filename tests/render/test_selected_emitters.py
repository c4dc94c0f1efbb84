# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Path gradients whose connections take emitters by the gradient's variance: in descents, and where they cannot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

import unrender as ur
from kernels import recorded
from tiers import quick
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.estimators.emitter_selection import EmitterState
from unrender.gallery import parts
from unrender.runs.folder.state import pack, unpack

CV = ur.images.RecursiveControlVariate
SIDE = 12
FLOOR = "floor.bsdf.reflectance.data"


def cells(count: int, **more: Any) -> dict[str, Any]:
    """A textured floor under the first of many lamps; walls part it from the others."""
    pixels = np.random.default_rng(0).uniform(0.2, 0.9, (8, 8, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}
    found: dict[str, Any] = {
        "type": "scene",
        "camera": parts.camera((0.5, 0.9, 0.5), (0.5, 0, 0.499), 50.0, SIDE),
        "floor": parts.rectangle((0.5, 0, 0.5), (0.5, 0, 0), (0, 0, -0.5), {"type": "diffuse", "reflectance": texture}),
        **more,
    }
    for cell in range(count):
        lamp = parts.rectangle(
            (cell + 0.5, 0.95, 0.5), (0.1, 0, 0), (0, 0, 0.1), parts.diffuse(0.0), emitter=parts.light(10.0)
        )
        wall = parts.rectangle((cell + 1.0, 0.5, 0.5), (0, 0, 9), (0, 5, 0), parts.twosided(parts.diffuse(0.3)))
        found |= {f"lamp{cell}": lamp, f"wall{cell}": wall}
    return found


def problem(count: int = 4, keys: tuple[str, ...] = (FLOOR,), **more: Any) -> ur.Problem:
    reference = np.random.default_rng(1).uniform(0.0, 0.5, (SIDE, SIDE, 3)).astype(np.float32)
    return ur.Problem(
        lambda: cells(count, **more), [ur.Parameter(key) for key in keys], [ur.View(reference)], max_depth=3
    )


def adaptive(**options: Any) -> ur.PathGradient:
    return ur.PathGradient(**{"spp": 4, "emitters": "adaptive", **options})


def estimates(asked: ur.Problem, estimator: Any, count: int, first: int = 0) -> tuple[np.ndarray, Any]:
    """(count, n) gradients at the start, and the state after them."""
    at = asked.initial()
    state, found = estimator.init(asked, at), []
    for step in range(first, first + count):
        estimate, state = estimator.estimate(asked, at, state, Key(0, step))
        found.append(np.concatenate([np.ravel(arrays.numpy(value)) for value in estimate.gradient.values()]))
    return np.array(found, np.float64), state


def test_of_forty_lamps_the_one_that_lights_the_floor_is_taken() -> None:
    asked = problem(40)
    uniform, _ = estimates(asked, ur.PathGradient(spp=4), 60)
    rows, state = estimates(asked, adaptive(), 70)
    chosen = state.emitters.probabilities
    assert chosen.shape == (40,)
    assert chosen[0] > 0.2
    assert chosen.min() >= 0.1 / 40 - 1e-12
    ratio = rows[10:].var(axis=0, ddof=1).sum() / uniform.var(axis=0, ddof=1).sum()
    assert ratio < 0.4
    # With the probabilities of a state that has learnt nothing it is one, within the error of the same number of gradients.
    again, _ = estimates(asked, ur.PathGradient(spp=4), 60, first=1000)
    assert again.var(axis=0, ddof=1).sum() / uniform.var(axis=0, ddof=1).sum() > 0.6


CASES: dict[str, Any] = {
    "plain": lambda choice: ur.PathGradient(spp=4, emitters=choice),
    "control variate": lambda choice: ur.PathGradient(CV(), spp=2, emitters=choice),
    "control variate, primary space": lambda choice: ur.PathGradient(CV(space="primary"), spp=2, emitters=choice),
    "pixels": lambda choice: ur.PathGradient(pixels=ur.pixels.Adaptive(64, denoiser="none"), spp=2, emitters=choice),
    "control variate, pixels": lambda choice: ur.PathGradient(
        CV(whole_views=5), ur.pixels.Uniform(64), spp=2, emitters=choice
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_gradients_are_unbiased(name: str) -> None:
    """An environment map among area lights; in parts of the texture, from the steps at which it has learnt something."""
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.full((8, 16, 3), 0.3, np.float32))}
    asked = problem(3, sky=sky)
    parts_of = []
    for estimator, runs, first in ((CASES[name]("adaptive"), 240, 0), (ur.PathGradient(spp=16), 60, 5000)):
        rows, state = estimates(asked, estimator, runs, first)
        parts_of.append(rows[5:].reshape(len(rows) - 5, 2, 4, 2, 4, 3).sum(axis=(2, 4)).reshape(len(rows) - 5, -1))
        if first == 0:
            assert isinstance(state.emitters, EmitterState)
            assert np.abs(state.emitters.probabilities - state.emitters.start).max() > 0.02
    mine, plain = parts_of
    # Control variates relate the steps: means of 47 in a row are nearly independent.
    mine = mine.reshape(5, 47, -1).mean(axis=1)
    error = np.sqrt(mine.var(axis=0, ddof=1) / len(mine) + plain.var(axis=0, ddof=1) / len(plain))
    limit = stats.t.isf((1 - (1 - 1e-3) ** (1 / mine.shape[1])) / 2, len(mine) - 1)
    z = np.abs(mine.mean(axis=0) - plain.mean(axis=0)) / error
    assert z.max() < limit
    assert (np.abs(1.3 * mine.mean(axis=0) - plain.mean(axis=0)) / error).max() > limit, "a planted error went unseen"


@pytest.mark.cpu("atomic additions of a GPU have no order")
@pytest.mark.usefixtures("one_thread")
def test_one_emitter_leaves_nothing_to_choose() -> None:
    asked = problem(1)
    mine, state = estimates(asked, adaptive(), 2)
    own, _ = estimates(asked, ur.PathGradient(spp=4), 2)
    assert state.emitters is None
    np.testing.assert_array_equal(mine, own)


def test_where_no_connection_tells_anything_the_scene_s_own_probabilities_stay() -> None:
    """Paths of one segment have none."""
    asked = replace_depth(problem(3), 1)
    _, state = estimates(asked, adaptive(), 6)
    np.testing.assert_array_equal(state.emitters.probabilities, np.full(3, 1 / 3))


def replace_depth(asked: ur.Problem, depth: int) -> ur.Problem:
    reference = np.asarray(asked.views[0].reference)
    return ur.Problem(lambda: cells(3), [ur.Parameter(FLOOR)], [ur.View(reference)], max_depth=depth)


@pytest.mark.slow
def test_the_scene_s_sampling_weights_are_where_it_starts() -> None:
    def weighted() -> dict[str, Any]:
        scene = cells(3)
        scene["lamp0"]["emitter"]["sampling_weight"] = 6.0
        scene["lamp2"]["emitter"]["sampling_weight"] = 0.0
        return scene

    reference = np.zeros((SIDE, SIDE, 3), np.float32)
    asked = ur.Problem(weighted, [ur.Parameter(FLOOR)], [ur.View(reference)], max_depth=3)
    _, state = estimates(asked, adaptive(), 3)
    np.testing.assert_allclose(state.emitters.start, [6 / 7, 1 / 7, 0])
    assert state.emitters.probabilities[2] == 0


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", quick(list(CASES), "control variate, pixels"))
def test_a_state_that_was_packed_goes_on_as_it_was(name: str) -> None:
    asked, at = problem(3), problem(3).initial()
    estimator = CASES[name]("adaptive")
    _, state = estimates(asked, estimator, 22)
    packed = pack(state)
    again = unpack(packed, (estimator.init(asked, at),))
    for step in range(22, 24):
        one, state = estimator.estimate(asked, at, state, Key(0, step))
        other, again = estimator.estimate(asked, at, again, Key(0, step))
        np.testing.assert_array_equal(arrays.numpy(one.gradient[FLOOR]), arrays.numpy(other.gradient[FLOOR]))
        np.testing.assert_array_equal(state.emitters.probabilities, again.emitters.probabilities)


class Stop(ur.protocols.Callback):
    """Interrupts after some steps."""

    def on_step(self, run, record):
        if run.step == 7:
            raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.cpu("atomic additions of a GPU have no order")
@pytest.mark.usefixtures("one_thread", "short_ends")
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path: Path) -> None:
    asked = ur.gallery.problem("mirror-trio", resolution=16, reference_spp=16)
    whole = ur.optimize(asked, adaptive(), ur.optimizers.Adam(0.02), 12)
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(
            asked, adaptive(), ur.optimizers.Adam(0.02), 12, callbacks=[Stop()], run_directory=tmp_path / "run",
            checkpoint_every=3,
        )  # fmt: skip
    result = ur.resume(tmp_path / "run")
    assert result.resumed == [6]
    for key, value in whole.parameters.items():
        np.testing.assert_array_equal(result.parameters[key], value)


@pytest.mark.slow
def test_no_kernel_is_made_anew_after_the_warm_up() -> None:
    asked, estimator = problem(3), adaptive()
    at = asked.initial()
    state = estimator.init(asked, at)

    def steps(first: int, last: int, state: Any) -> Any:
        for step in range(first, last):
            found, state = estimator.estimate(asked, at, state, Key(0, step))
            arrays.evaluate(found.gradient)
        return state

    state = steps(0, 6, state)
    with recorded() as new:
        state = steps(6, 24, state)
    assert new
    assert not any(new)


def test_what_cannot_take_other_probabilities_is_refused() -> None:
    def refused(asked: ur.Problem, words: str) -> None:
        with pytest.raises(InputError, match=words):
            adaptive().init(asked, asked.initial())

    fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
    cloud = {"type": "sphere", "center": [0.5, 0.3, 0.5], "radius": 0.1, "bsdf": {"type": "null"}, "interior": fog}
    refused(problem(2, cloud=cloud), "participating media")
    refused(problem(2, keys=("wall0.translation",)), "shapes or sensors move")
    refused(problem(2, keys=("camera.translation",)), "shapes or sensors move")
    moving = problem(2, keys=("camera.translation",))
    session = moving.renderer.prepare(["camera.translation"], None)
    from unrender.rendering.renderer import SampleRequest

    with pytest.raises(InputError, match="shapes or sensors move"):
        session.image(moving.initial(), SampleRequest(0, 4, 0, emitters=np.array([0.3, 0.7])))


@pytest.mark.slow
def test_unknown_exposures_keep_it() -> None:
    """The pictures' own factors weigh what connections tell of the scene."""
    asked = problem(4)
    reference = np.asarray(asked.views[0].reference)
    exposed = ur.Problem(
        lambda: cells(4),
        [ur.Parameter(FLOOR), ur.Parameter("exposure")],
        [ur.View(reference), ur.View(reference)],
        max_depth=3,
    )
    _, state = estimates(exposed, adaptive(), 6)
    assert state.emitters.probabilities[0] > 0.3


def test_beside_perturbed_renders_it_looks_at_the_parameters_of_paths() -> None:
    lamp = "lamp0.emitter.radiance.value"
    smoothed = ur.SmoothedDerivatives(0.3, samples=4)
    asked = problem(4, keys=(FLOOR, lamp))
    _, state = estimates(asked, ur.estimators.HybridGradient(adaptive(), smoothed, keys=(lamp,)), 6)
    assert state.path.emitters.probabilities[0] > 0.3
