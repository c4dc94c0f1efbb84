"""Runs taken up again: the same as if never interrupted, and refused where something is not as it was."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.core import tables
from unrender.core.errors import InputError
from unrender.optimizers.recipes import ChainState
from unrender.optimizers.transforms.averages import MeanDirection
from unrender.optimizers.transforms.scale import MeanSquare
from unrender.runs.folder.state import Packed, check_alike, pack, unpack
from unrender.runs.reopen import problem_of
from unrender.scene.fingerprint import differences, fingerprint

pytestmark = pytest.mark.usefixtures("short_ends")

WALL = "wall.bsdf.reflectance.value"
SCENE = """<scene version="3.0.0">
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 2" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="6"/><integer name="height" value="4"/><rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant" id="sky"/>
    <shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>
</scene>
"""
PROBLEM = f"""\
scene = "wall.xml"
loss = "L2"
max_depth = 2
[[parameters]]
key = "{WALL}"
initial = [0.5, 0.4, 0.3]
[[views]]
reference = "photo.exr"
"""


class Stop(ur.protocols.Callback):
    """Interrupts after some steps, as a second Ctrl-C does."""

    def __init__(self, step: int):
        self.step = step

    def on_step(self, run, record):
        if run.step == self.step:
            raise KeyboardInterrupt


def interrupted(problem: ur.Problem, folder: Path, steps: int = 8, at: int = 5, **options: Any) -> None:
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(
            problem, ur.PathGradient(spp=2), ur.optimizers.Adam(0.05), steps, callbacks=[Stop(at)],
            run_directory=folder, checkpoint_every=2, **options,
        )  # fmt: skip


@pytest.fixture
def wall(tmp_path: Path) -> Path:
    """problem.toml of a wall under an even sky."""
    (tmp_path / "wall.xml").write_text(SCENE)
    (tmp_path / "problem.toml").write_text(PROBLEM)
    mi.Bitmap(np.full((4, 6, 3), 0.6, np.float32)).write(str(tmp_path / "photo.exr"))
    return tmp_path / "problem.toml"


# ---------------------------------------------------------------------- the same


def test_a_resumed_run_is_the_uninterrupted_one(wall: Path) -> None:
    """On one view of 24 pixels, too few for more than one thread."""
    whole = ur.optimize(ur.Problem.from_file(wall), ur.PathGradient(spp=2), ur.optimizers.Adam(0.05), 8)
    folder = wall.parent / "run"
    interrupted(ur.Problem.from_file(wall), folder)
    told: list[int] = []

    class Listen(ur.protocols.Callback):
        def on_start(self, run):
            told.append(run.step)

    result = ur.resume(folder, callbacks=[Listen()])
    np.testing.assert_array_equal(result.parameters[WALL], whole.parameters[WALL])
    assert told == [4]
    assert result.resumed == [4]
    for before, after in zip(whole.history, result.history, strict=True):
        for name in ("step", "loss", "samples", "gradient_noise"):
            assert before[name] == after[name]
    seconds = [record["seconds"] for record in result.history]
    assert seconds == sorted(seconds)
    assert result.name == whole.name == "problem"
    assert json.loads((folder / "run.json").read_text())["resumed"] == [4]


def test_the_clock_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    parts = ur.PathGradient(spp=2), ur.optimizers.Adam()
    first = ur.optimize(ur.gallery.problem("exponential"), *parts, seconds=0.05, run_directory=folder)
    with pytest.raises(InputError, match=r"finished, after .* to continue, give --steps \d+ or --seconds \d+, "):
        ur.resume(folder, seconds=0.04)
    second = ur.resume(folder, seconds=0.1)
    assert second.stopped == "seconds"
    assert first.seconds < 0.1 <= second.seconds < 0.1 + 0.5
    assert second.history[: len(first.history)] == first.history


def test_before_the_first_checkpoint_a_run_begins_anew(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    interrupted(ur.gallery.problem("exponential"), folder, at=1)
    result = ur.resume(folder)
    assert result.resumed == [0]
    assert [record["step"] for record in result.history] == list(range(8))


def test_a_spoilt_checkpoint_is_passed_over(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    interrupted(ur.gallery.problem("exponential"), folder)
    state = folder / "checkpoints" / "00000004" / "state.safetensors"
    state.write_bytes(state.read_bytes()[:-1])
    result = ur.resume(folder)
    assert result.resumed == [2]
    assert "skipped" in result.warnings[0]
    assert "00000004/state.safetensors: expected" in result.warnings[0]


def test_a_run_that_died_while_it_drew_its_pictures_gets_them(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    whole = ur.optimize(
        ur.gallery.problem("exponential"), ur.PathGradient(spp=2), ur.optimizers.Adam(), 4, run_directory=folder
    )
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "status": "running"}))
    (folder / "pictures.npz").unlink()
    again = ur.resume(folder)
    assert again.parameters == whole.parameters
    assert (folder / "pictures.npz").exists()


def test_a_finished_run_wants_more(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    parts = ur.PathGradient(spp=2), ur.optimizers.Adam()
    ur.optimize(ur.gallery.problem("exponential"), *parts, 4, run_directory=folder)
    for steps in (None, 4, 1):
        with pytest.raises(InputError, match=r"finished, after 4 steps .*; to continue, give --steps 8 or --seconds "):
            ur.resume(folder, steps=steps)
    whole = ur.optimize(ur.gallery.problem("exponential"), *parts, 9)
    assert ur.resume(folder, steps=9).parameters == whole.parameters
    with pytest.raises(InputError, match="steps must be a whole number of at least 1, got -3"):
        ur.resume(folder, steps=-3)


def test_fewer_steps_than_are_done_are_refused(tmp_path: Path) -> None:
    interrupted(ur.gallery.problem("exponential"), tmp_path / "run")
    with pytest.raises(InputError, match="4 steps are done, expected a budget of more, got steps=2"):
        ur.resume(tmp_path / "run", steps=2)


# ---------------------------------------------------------------------- not as it was


def _edit(path: Path, old: str, new: str) -> None:
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


CHANGES = {
    "the scene": (
        lambda d: _edit(d / "wall.xml", '"constant" id="sky"/>', '"constant" id="sky"><rgb name="radiance" value="2"/></emitter>'),
        ["scene: sky has changed", "file wall.xml has changed"],
    ),
    "a space in the scene": (lambda d: _edit(d / "wall.xml", "</scene>", " </scene>"), ["file wall.xml has changed"]),
    "the loss": (lambda d: _edit(d / "problem.toml", "L2", "L1"), ["loss was L2(), is L1()"]),
    "the start": (lambda d: _edit(d / "problem.toml", "0.3]", "0.31]"), [f"parameter {WALL}: initial has changed"]),
    "the reference": (
        lambda d: mi.Bitmap(np.full((4, 6, 3), 0.7, np.float32)).write(str(d / "photo.exr")),
        ["view 0: reference has changed"],
    ),
    "the method": (lambda d: _edit(d / "run" / "method.toml", "beta_1 = 0.9", "beta_1 = 0.5"), ["optimizer was Adam("]),
    "the seed": (lambda d: _edit(d / "run" / "method.toml", "seed = 0", "seed = 1"), ["seed was 0, is 1"]),
}  # fmt: skip


@pytest.mark.parametrize("name", quick(CHANGES, "a space in the scene", "the method"))
def test_what_changed_is_shown_and_can_be_forced(wall: Path, name: str) -> None:
    folder = wall.parent / "run"
    interrupted(ur.Problem.from_file(wall), folder)
    change, told = CHANGES[name]
    change(wall.parent)
    before = (folder / "history.jsonl").read_bytes(), (folder / "run.json").read_bytes()
    with pytest.raises(InputError) as caught:
        ur.resume(folder)
    assert str(caught.value).startswith(f"run folder {folder}: changed since: ")
    for what in told:
        assert what in str(caught.value)
    assert before == ((folder / "history.jsonl").read_bytes(), (folder / "run.json").read_bytes())
    result = ur.resume(folder, force=True)
    assert result.steps == 8
    assert "resumed with force although changed since: " in result.warnings[0]


def test_a_run_whose_unknowns_are_others_now_says_so(wall: Path) -> None:
    """Its answer was about a learning rate of an unknown parameter."""
    folder = wall.parent / "run"
    parts = ur.PathGradient(spp=2), ur.optimizers.Adam({WALL: 0.05, "*": 0.05})
    ur.optimize(ur.Problem.from_file(wall), *parts, 2, run_directory=folder)
    _edit(wall, f'{WALL}"\ninitial = [0.5, 0.4, 0.3]', 'sky.radiance.value"\ninitial = 0.5')
    with pytest.raises(InputError, match=rf"changed since: parameter {WALL}.* is gone; .*; start a new run"):
        ur.resume(folder, steps=4)


def test_other_versions_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    interrupted(ur.gallery.problem("exponential"), folder)
    for manifest in folder.glob("checkpoints/*/manifest.json"):
        _edit(manifest, '"unrender": "', '"unrender": "0.0.')
    with pytest.raises(InputError, match=r"changed since: unrender was 0\.0\..*, is "):
        ur.resume(folder)
    assert ur.resume(folder, force=True).steps == 8


@pytest.mark.slow
def test_other_options_and_missing_fields_are_refused(wall: Path) -> None:
    folder = wall.parent / "run"
    parts = ur.PathGradient(spp=2), ur.optimizers.ScheduleFree()
    ur.optimize(ur.Problem.from_file(wall), *parts, 4, run_directory=folder, checkpoint_every=4)
    manifest = folder / "checkpoints" / "00000004" / "manifest.json"
    _edit(manifest, ", noise_sample=False", ", noise_sample=True")
    with pytest.raises(InputError, match="changed since: estimator was "):
        ur.resume(folder, steps=6)
    _edit(manifest, ", noise_sample=True", ", noise_sample=False")
    first = re.search(r', "firsts": {"dict": \[.*?\]\]}', manifest.read_text())
    assert first is not None
    _edit(manifest, first.group(), "")
    with pytest.raises(InputError, match="is of another version of unrender"):
        ur.resume(folder, steps=6)


@pytest.mark.slow
def test_a_parameter_of_another_shape_cannot_be_forced(tmp_path: Path) -> None:
    options = {"resolution": 8, "reference_spp": 4}
    problems = [ur.gallery.problem("indirect-room", texture_resolution=n, **options) for n in (4, 5)]
    folder = tmp_path / "run"
    interrupted(problems[0], folder, steps=3, at=3)
    with pytest.raises(InputError, match="initial has changed"):
        ur.resume(folder, problems[1])
    with pytest.raises(
        InputError,
        match=r"checkpoint of step 2: parameters.*expected shape \(5, 5, 3\), got \(4, 4, 3\); start the run again",
    ):
        ur.resume(folder, problems[1], force=True)
    assert ur.resume(folder).steps == 3


# ---------------------------------------------------------------------- problems and parts made again


def test_a_problem_file_that_is_gone_is_made_again_from_the_folder(wall: Path) -> None:
    folder = wall.parent / "run"
    whole = ur.optimize(ur.Problem.from_file(wall), ur.PathGradient(spp=2), ur.optimizers.Adam(0.05), 8)
    interrupted(ur.Problem.from_file(wall), folder)
    wall.unlink()
    np.testing.assert_array_equal(ur.resume(folder).parameters[WALL], whole.parameters[WALL])


def test_a_plain_number_of_the_scene_counts() -> None:
    def made(refraction: float) -> ur.Problem:
        scene = {
            "type": "scene",
            "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 6}},
            "lens": {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": refraction}},
            "wall": {"type": "rectangle"},
        }
        return ur.Problem(scene, [ur.Parameter("wall.bsdf.reflectance.value")], [ur.View(np.zeros((6, 4, 3)))])

    assert differences(fingerprint(made(1.5)), fingerprint(made(1.5))) == []
    assert differences(fingerprint(made(1.5)), fingerprint(made(1.6))) == ["scene: lens has changed"]


@pytest.mark.slow
def test_a_problem_of_an_xml_scene_is_made_again_with_its_arrays(wall: Path) -> None:
    rng = np.random.default_rng(1)
    made = ur.Problem(
        wall.parent / "wall.xml",
        [ur.Parameter(WALL, initial=np.array([0.1, 0.2, 0.3], np.float32), bounds=(None, 0.9), learning_rate=0.01)],
        [ur.View(rng.uniform(0, 255, (4, 6, 3)).astype(np.uint8), weight=2.0, mask=rng.uniform(0, 1, (4, 6)))],
        ur.losses.Huber(delta=0.3),
        truth={WALL: 0.6},
    )
    folder = wall.parent / "run"
    interrupted(made, folder)
    again = problem_of(folder)
    assert differences(fingerprint(made), fingerprint(again)) == []
    np.testing.assert_array_equal(again.truth[WALL], made.truth[WALL])
    assert ur.resume(folder).steps == 8


@pytest.mark.slow
def test_a_problem_made_in_python_is_to_be_handed_in(tmp_path: Path) -> None:
    from mitsuba import cornell_box

    folder = tmp_path / "run"

    def scene() -> dict[str, Any]:
        found = cornell_box()
        found["sensor"]["film"].update(width=4, height=4)
        return found

    def made() -> ur.Problem:
        return ur.Problem(
            scene, [ur.Parameter("red.reflectance.value", 0.4)], [ur.View(np.full((4, 4, 3), 0.2))], None, 2
        )

    interrupted(made(), folder)
    with pytest.raises(InputError, match=r"made in Python; pass it, as unrender\.resume"):
        ur.resume(folder)
    assert ur.resume(folder, made()).steps == 8


def test_a_part_that_no_file_can_say_is_to_be_handed_in(tmp_path: Path) -> None:
    adam = ur.optimizers.Adam(0.01, schedule=lambda step: 0.99**step)
    folder = tmp_path / "run"
    parts = ur.PathGradient(spp=2), adam
    whole = ur.optimize(ur.gallery.problem("exponential"), *parts, 8)
    ur.optimize(ur.gallery.problem("exponential"), *parts, 4, run_directory=folder)
    with pytest.raises(InputError, match=r"optimizer: it cannot be stored in a file .*schedule is function.*pass it"):
        ur.resume(folder, steps=8)
    assert ur.resume(folder, steps=8, optimizer=adam).parameters == whole.parameters


def test_components_become_tables_and_come_back() -> None:
    schedules = ur.optimizers.schedules
    for component in (
        ur.optimizers.Newton(trust_radius=None, inner_optimizer=ur.optimizers.Adam(schedule=schedules.Warmup(3, schedules.Cosine(9)))),
        ur.SmoothedDerivatives({"*": 0.1, "mug.rotation.y": 0.6}, order="hvp", schedule=schedules.Exponential(5, 0.1)),
        ur.MetaEstimator(coupled=True, image=ur.images.RecursiveControlVariate()),
        ur.preconditioners.LargeSteps(3.0, wrap=(False, True)),
    ):  # fmt: skip
        assert tables.component(json.loads(json.dumps(tables.table(component)))) == component


# ---------------------------------------------------------------------- states


@dataclass(frozen=True)
class Foreign:
    """A state of no module of the package."""

    number: int


def test_states_come_back_as_they_were() -> None:
    rng = np.random.default_rng(0)
    texture = mi.TensorXf(rng.random((2, 3), np.float32))
    state: dict[Any, Any] = {
        "adam": ChainState(3, {"k": 0.1}, (MeanDirection({"k": texture}), MeanSquare({"k": mi.TensorXf(0.0)}))),
        "shared": (texture, [None, True, float("nan"), float("-inf"), 1 << 70, "text"]),
        "flat": (mi.Float([1, 2]), mi.UInt32([1, 4_000_000_000]), mi.Bool([True, False])),
        "host": (np.zeros((0, 3), np.int32), np.float32(3), np.arange(6).reshape(2, 3).T),
        7: mi.TensorXu(np.arange(4, dtype=np.uint32).reshape(2, 2)),  # pyright: ignore[reportCallIssue]
    }
    packed = pack(state)
    again = unpack(Packed(json.loads(json.dumps(packed.skeleton)), packed.tensors))
    assert list(again) == list(state)
    assert again["shared"][0] is again["adam"].of(MeanDirection).first_moment["k"]
    np.testing.assert_array_equal(again["shared"][0].numpy(), texture.numpy())
    assert again["adam"].of(MeanSquare).second_moment["k"].shape == ()
    assert repr(again["shared"][1]) == repr(state["shared"][1])
    for before, after in zip((*state["flat"], state[7]), (*again["flat"], again[7]), strict=True):
        assert type(before) is type(after)
        np.testing.assert_array_equal(before.numpy(), after.numpy())
    for before, after in zip(state["host"], again["host"], strict=True):
        assert (type(before), before.dtype, before.shape) == (type(after), after.dtype, after.shape)
        np.testing.assert_array_equal(before, after)
    check_alike(again, [state])


def test_states_of_other_packages_do_not_come_back() -> None:
    with pytest.raises(InputError, match="Foreign' is not a state"):
        unpack(pack(Foreign(1)))


@pytest.mark.parametrize("other", [{"a": np.zeros((2, 3))}, {"a": np.zeros(2)}, {"b": np.zeros((2, 2))}, {"a": 1}, ()])
def test_states_of_another_form_are_told(other: Any) -> None:
    with pytest.raises(InputError, match="state"):
        check_alike(other, [{"a": np.zeros((2, 2))}])
    check_alike({"a": np.zeros((5, 2))}, [{"a": np.zeros((2, 2))}])
    check_alike({"a": np.float64(2)}, [{"a": 0.0}])  # what a state counts by NumPy's numbers once it has been moved on


def test_what_comes_later_is_let_in() -> None:
    """Such as tables that an estimator makes after twenty steps, when a warm-up takes two."""
    check_alike({"a": ChainState(0, {}, ())}, [{"a": None}, {"a": ()}])
    with pytest.raises(InputError, match="expected NoneType or int, got str"):
        check_alike({"a": "text"}, [{"a": None}, {"a": 3}])


def test_a_moved_folder_is_taken_up(tmp_path: Path) -> None:
    interrupted(ur.gallery.problem("exponential"), tmp_path / "run")
    shutil.move(tmp_path / "run", tmp_path / "there")
    assert ur.resume(tmp_path / "there").steps == 8


def test_a_number_in_place_of_an_optional_state_is_told() -> None:
    """A scene with one emitter has no state of emitters: a damaged checkpoint with a number there ended in an AttributeError."""
    estimator, problem = ur.PathGradient(spp=2), ur.gallery.problem("exponential")
    state = estimator.init(problem, problem.initial())
    assert state.emitters is None
    check_alike(state, [state])
    with pytest.raises(InputError, match=r"emitters: expected EmitterState, got int"):
        check_alike(dataclasses.replace(state, emitters=3), [state])
