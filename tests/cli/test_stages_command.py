"""Stages as a user runs them: each from where the one before it ended, resumed to the same end, and files of stages that are wrong."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import typer

from conftest import KEY, Unrender
from unrender.app.cli import stages
from unrender.app.cli.signals import DOUBTFUL
from unrender.app.stages import stages_file
from unrender.app.stages.stage_problem import StagedProblem
from unrender.core.errors import InputError
from unrender.display.terminal import Console
from unrender.losses import L2
from unrender.rendering.renderer import ParameterInfo
from unrender.runs.folder import checkpoint, method_file, reader
from unrender.runs.folder.lock import Lock
from unrender.scene.parameter import Parameter

STAGES = f"""\
problem = "problem.toml"
method = "plain"
settings = {{ spp = 2, learning_rate = 0.02 }}

[[stages]]
name = "colour"
unknowns = ["{KEY}"]

[[stages]]
name = "light"
unknowns = ["sky.radiance.value"]
settings = {{ spp = 4 }}

[[stages]]
name = "all"
unknowns = ["{KEY}", "sky.radiance.value"]
share = 2
"""
RUN = (
    "run",
    "stages.toml",
    "--steps",
    16,
    "--out",
    "result",
    "--threads",
    1,
    "--checkpoint-every",
    2,
    "--final-spp",
    2,
)


@pytest.fixture
def staged(problem: Path, mitsuba_variant: str) -> Path:
    """The wall and its sky as unknowns of three stages: stages.toml."""
    assert mitsuba_variant
    scene = problem.with_name("wall.xml")
    sky = '<emitter type="constant" id="sky"><rgb name="radiance" value="0.9"/></emitter>'
    scene.write_text(scene.read_text().replace('<emitter type="constant"/>', sky))
    problem.write_text(
        problem.read_text().replace("[[views]]", '[[parameters]]\nkey = "sky.radiance.value"\n[[views]]')
    )
    (problem.parent / "stages.toml").write_text(STAGES)
    return problem.parent


def values(folder: Path, which: str = "parameters") -> dict[str, np.ndarray]:
    with np.load(folder / f"{which}.npz") as found:
        return dict(found)


@pytest.mark.slow
def test_each_stage_begins_where_the_one_before_it_ended_and_a_killed_one_comes_to_the_same_end(
    unrender: Unrender, staged: Path
) -> None:
    answer = unrender(*RUN)
    assert answer.status == 0, answer.error
    folders = stages_file.run_folders(Path("result"))
    assert [folder.name for folder in folders] == ["1-colour", "2-light", "3-all"]
    records = [json.loads((folder / "run.json").read_text()) for folder in folders]
    assert [(record["status"], record["steps"], record["seed"]) for record in records] == [
        ("finished", 4, 0),
        ("finished", 4, 1),
        ("finished", 8, 2),
    ]
    colour, light, both = (values(folder) for folder in folders)
    start = values(folders[2], "initial")
    assert np.array_equal(start[KEY], colour[KEY])
    assert np.array_equal(start["sky.radiance.value"], light["sky.radiance.value"])
    assert not np.array_equal(both[KEY], colour[KEY])
    assert np.abs(colour[KEY] - 0.2).max() > 0.02, "the first stage moved nothing"
    # What the second stage does not move is part of its scene.
    _, _, written = Path("result/scenes/2-light/scene.xml").read_text().partition('name="reflectance" value="')
    assert np.float32(written.split(",")[0].split()[0]) == colour[KEY][0]

    # Killed in the second stage, after its first checkpoint.
    shutil.copytree("result", "killed")
    killed = Path("killed")
    shutil.rmtree(killed / "3-all")
    shutil.rmtree(killed / "scenes")
    folder = killed / "2-light"
    (folder / "run.json").write_text(json.dumps({**records[1], "status": "running"}))
    for path in (folder / checkpoint.FOLDER).iterdir():
        if path.name > "00000002":
            shutil.rmtree(path)
    answer = unrender("resume", "killed")
    assert answer.status == 0, answer.error
    assert "finished: killed/1-colour" in answer.out
    assert json.loads((folder / "run.json").read_text())["resumed"] == [2]
    for mine, whole in zip(stages_file.run_folders(killed), folders, strict=True):
        for key, value in values(whole).items():
            assert np.array_equal(values(mine)[key], value), f"{mine}: {key}"
    # Each is an ordinary run folder.
    assert unrender("report", "result/2-light").status == 0


@pytest.mark.slow
def test_a_stage_is_judged_with_what_earlier_ones_found(unrender: Unrender, staged: Path) -> None:
    """The colour of the first stage is part of the second one's scene; the photographs of the stages' problem are held out."""
    # The second of two sensors is held out, and shows a wall that fills its picture, too.
    scene = staged / "wall.xml"
    head, sensor, rest = scene.read_text().partition('<sensor type="perspective">')
    first, end, rest = rest.partition("</sensor>")
    wide = first.replace('value="6"', 'value="8"')
    scene.write_text(head + sensor + first + end + sensor + wide + end + rest)
    photo = np.broadcast_to(np.array([0.3, 0.6, 0.5], np.float32), (4, 8, 3))
    mi.Bitmap(np.ascontiguousarray(photo)).write(str(staged / "wide.exr"))
    held_out = (
        (staged / "problem.toml")
        .read_text()
        .replace("photo.exr", "wide.exr")
        .replace("[[views]]", "[[views]]\nsensor = 1")
    )
    (staged / "held-out.toml").write_text(held_out)
    (staged / "stages.toml").write_text(STAGES.partition('[[stages]]\nname = "all"')[0])
    assert unrender(*RUN[:-2]).status == 0
    folders = stages_file.run_folders(Path("result"))
    # Nobody asked for pictures of the first stage: one sample for each pixel, and no page.
    assert [method_file.read(folder / "method.toml").final_spp for folder in folders] == [1, None]
    assert [(folder / "report.html").is_file() for folder in folders] == [False, True]
    colour, light = (values(Path("result") / name) for name in ("1-colour", "2-light"))
    assert np.abs(colour[KEY] - 0.2).max() > 0.02, "the first stage moved nothing"
    answer = unrender("judge", "result", "--spp", 1024)
    assert answer.status == 0, answer.error
    found = json.loads(Path("result/2-light/judge/judge.json").read_text())
    assert found["held_out"] == str(staged / "held-out.toml")

    def srgb(x: np.ndarray) -> np.ndarray:
        return 1.055 * x ** (1 / 2.4) - 0.055

    shown = colour[KEY] * light["sky.radiance.value"]
    expected = -10 * np.log10(np.mean((srgb(shown) - srgb(photo[0, 0])) ** 2))
    assert found["mean"]["psnr"] == pytest.approx(expected, abs=0.1)
    for command in (("export", "result"), ("report", "result")):
        answer = unrender(*command)
        assert answer.status == 0, answer.error
    assert Path("result/2-light/scene/scene.xml").is_file()


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"problem.toml"', '"nothing.toml"', "nothing.toml: no such file"),
        ('name = "light"', 'name = "colour"', "stages.toml:10: stages[1].name: colour is given twice"),
        ('name = "light"', 'name = "../light"', "stages.toml:10: stages[1].name: expected lower-case letters, digits"),
        ("share = 2", "share = 0", "stages.toml:17: stages[2].share: expected a number above 0, got 0"),
        (
            "share = 2",
            "share = " + "9" * 400,
            "stages.toml:17: stages[2].share: expected a number above 0, got an integer of 1329 bits",
        ),
        ("share = 2", "shares = 2", "stages.toml:17: stages[2].shares: no such field; did you mean share?"),
        ("spp = 4", "ssp = 4", "stages.toml: stage light: method plain has no option ssp; did you mean spp?"),
        ('"plain"', '"plane"', "did you mean plain?"),
        ("[[stages]]", "[[stage]]", "stages.toml:5: stage: no such field; did you mean stages?"),
        (f'unknowns = ["{KEY}"]', "", "stages.toml:5: stages[0].unknowns: missing, expected a list"),
        ("sky.radiance.value", "sky.radiance", "stage light: sky.radiance is no parameter of"),
    ],
)
def test_a_file_that_is_wrong_is_one_line(unrender: Unrender, staged: Path, old: str, new: str, line: str) -> None:
    assert old in STAGES
    (staged / "stages.toml").write_text(STAGES.replace(old, new))
    answer = unrender(*RUN)
    assert answer.refuses(line)
    assert not (staged / "result").exists()


def test_options_that_stand_in_the_file_are_refused(unrender: Unrender, staged: Path) -> None:
    assert "--set spp: not supported with stages" in unrender(*RUN, "--set", "spp=2").error
    assert "--method: not supported with stages" in unrender(*RUN, "--method", "rcv").error
    assert "--no-cache: not supported with stages; leave it out" in unrender(*RUN, "--no-cache").error
    assert "--insecure: requires --workers" in unrender("resume", ".", "--insecure").error
    assert not (staged / "result").exists()


@pytest.mark.parametrize(("words", "seed"), [((), 7), (("--seed", 0), 0), (("--seed", 3), 3)])
def test_a_typed_seed_replaces_that_of_the_file(
    unrender: Unrender, staged: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[Any, ...], seed: int
) -> None:
    """Also a seed of 0, the option's default."""
    (staged / "stages.toml").write_text("seed = 7\n" + STAGES)
    seeds: list[int] = []

    def stop(run: stages.StagesRun, *_: object) -> None:
        seeds.append(run.stages.seed)
        run.lock.release()

    monkeypatch.setattr(stages, "run_remaining", stop)
    answer = unrender(*RUN, *words)
    assert (answer.status, seeds) == (0, [seed]), answer.error


def test_folders_in_use_are_left_alone(unrender: Unrender, staged: Path) -> None:
    """Neither a run in stages, nor a stage that another process goes on with, loses its folders."""
    out = staged / "result"
    for name in ("1-colour", "2-light"):
        (out / name).mkdir(parents=True)
        (out / name / "run.json").write_text("{}")
    written = STAGES.replace("problem.toml", str(staged / "problem.toml"))
    (out / "stages.toml").write_text(written)
    for held in (out, out / "2-light"):
        lock = Lock(held)
        lock.acquire()
        try:
            answer = unrender(*RUN, "--overwrite")
        finally:
            lock.release()
        assert answer.status == 2
        assert "in use by process" in answer.error
        assert all((out / name / "run.json").is_file() for name in ("1-colour", "2-light"))
        assert (out / "stages.toml").read_text() == written


def test_a_folder_that_holds_the_users_own_file_is_no_run(unrender: Unrender, staged: Path) -> None:
    """As an import's: it is neither written to, nor gone on with, nor taken apart into run folders."""
    (staged / "other").mkdir()
    (staged / "other" / "stages.toml").write_text(STAGES)
    (staged / "scenes").mkdir()
    for out, line in (
        (".", "--out .: the folder of stages.toml itself"),
        ("other", "--out other: its stages.toml is that of no run"),
    ):
        answer = unrender("run", "stages.toml", "--out", out, "--overwrite")
        assert (answer.status, answer.error.count("\n")) == (2, 1)
        assert line in answer.error
    assert "other: not a run in stages" in unrender("resume", "other").error
    assert stages_file.run_folders(staged / "other") == [staged / "other"]
    assert stages_file.stage_of(staged / "other" / "1-colour") is None
    assert (staged / "stages.toml").read_text() == STAGES
    assert (staged / "scenes").is_dir()
    assert sorted(path.name for path in (staged / "other").iterdir()) == ["stages.toml"]


def test_resume_complains_of_a_file_of_stages_that_is_malformed(unrender: Unrender, staged: Path) -> None:
    (staged / "result").mkdir()
    for text, line in (
        ("[[stages]\n", "result/stages.toml:1: not valid TOML"),
        (STAGES.replace("name", "nam"), "stages.toml:6: stages[0].nam: no such field"),
    ):
        (staged / "result" / "stages.toml").write_text(text)
        answer = unrender("resume", "result")
        assert answer.status == 2
        assert line in answer.error


def test_a_run_that_was_killed_before_its_first_record_goes_on_with_its_options(
    unrender: Unrender, staged: Path, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str
) -> None:
    seen: list[stages.StagesRun] = []
    monkeypatch.setattr(stages, "_run_stages", lambda run, *_: seen.append(run))
    assert unrender(*RUN, "--variant", mitsuba_variant).status == 0
    dr.set_thread_count(2)
    answer = unrender("resume", "result")
    assert answer.status == 0, answer.error
    assert dr.thread_count() == 1
    assert seen[1].options == seen[0].options == stages_file.RunOptions(mitsuba_variant, 1, 2, 2)
    assert seen[1].stages.steps == 16
    file = staged / "result" / "stages.toml"
    file.write_text(file.read_text().replace("threads = 1", "threads = 0"))
    assert (
        "run.threads: expected a whole number of at least 1, below 2**32, got 0" in unrender("resume", "result").error
    )


@pytest.mark.parametrize(
    "command",
    ["compare stages.toml", "sweep stages.toml --over spp=1,2 --method plain --out result", "export stages.toml"],
)
def test_other_commands_say_that_it_is_a_file_of_stages(unrender: Unrender, staged: Path, command: str) -> None:
    answer = unrender(*command.split())
    assert (answer.status, answer.error.count("\n")) == (2, 1)
    assert "stages.toml: a file of stages, which only `unrender run` accepts; expected a problem file" in answer.error
    assert not (staged / "out").exists()


def test_a_key_that_the_scene_between_stages_has_under_another_name_is_refused(staged: Path) -> None:
    """Exported scenes drop ids that begin with an underscore, as Mitsuba's own do."""
    for file in ("wall.xml", "problem.toml"):
        (staged / file).write_text(
            (staged / file).read_text().replace("wall.bsdf", "_wall.bsdf").replace('"wall"', '"_wall"')
        )
    first = stages_file.Stage("light", ("sky.radiance.value",))
    stage = stages_file.Stage("colour", (f"_{KEY}",))
    whole = StagedProblem.read(stages_file.Stages(staged / "problem.toml", (first, stage), steps=1))
    for _ in range(2):  # what was written is not taken the second time
        with pytest.raises(InputError, match=rf"stage colour: _{KEY} is called \S+ in the scene with"):
            whole.of_stage(stage, {"sky.radiance.value": np.full(3, 0.5, np.float32)}, staged / "scene")
    assert not (staged / "scene").exists()


def test_a_transform_that_a_later_stage_cannot_export_is_refused_at_once(staged: Path) -> None:
    """It was refused when the second stage began, after the time of the first. A single stage exports nothing."""
    scene = staged / "wall.xml"
    turned = '<transform name="to_world"><rotate x="1" y="1" angle="50"/></transform>'
    scene.write_text(scene.read_text().replace("</scene>", f'<shape type="sphere" id="ball">{turned}</shape></scene>'))
    first, second = stages_file.Stage("light", ("sky.radiance.value",)), stages_file.Stage("colour", (KEY,))
    StagedProblem.read(stages_file.Stages(staged / "problem.toml", (first,), steps=1))
    with pytest.raises(InputError, match="ball: to_world: cannot be exported: it rotates about an axis whose length"):
        StagedProblem.read(stages_file.Stages(staged / "problem.toml", (first, second), steps=1))


def test_an_exposure_stays_an_unknown(unrender: Unrender, staged: Path) -> None:
    problem = staged / "problem.toml"
    problem.write_text(problem.read_text().replace("[[views]]", '[[parameters]]\nkey = "exposure"\n[[views]]'))
    (staged / "stages.toml").write_text(STAGES.replace(f'["{KEY}"]', f'["{KEY}", "exposure"]'))
    answer = unrender(*RUN)
    assert answer.status == 2
    assert 'stage light: "exposure" is an unknown of stage colour' in answer.error


def test_budgets_are_split_by_shares() -> None:
    shares = (1.0, 1.0, 5.0)
    made = tuple(stages_file.Stage(f"s{index}", ("a",), share) for index, share in enumerate(shares))
    for steps in (3, 7, 10, 100):
        found = stages_file.split(stages_file.Stages(Path("p"), made, steps=steps, seconds=14.0))
        assert sum(each for each, _ in found if each) == max(steps, 3)
        assert min(each for each, _ in found if each) >= 1
        assert [seconds for _, seconds in found] == [2.0, 2.0, 10.0]


def test_a_stage_loses_the_time_that_was_spent_before_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With each of its seconds for itself, a run of 6 s took 9: loading and the end of each stage were extra."""
    clock, began = [100.0], []
    monkeypatch.setattr(stages.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(stages, "reader", SimpleNamespace(read=lambda _: SimpleNamespace(parameters={})))
    monkeypatch.setattr("unrender.app.cli.run.conclude", lambda *_, **more: None)

    def run_stage(run: Any, index: int, values: Any, console: Any, progress: Any) -> tuple[None, None]:
        began.append(progress.budget_began)
        clock[0] = began[-1] + (2.0, 12.0, 1.0)[index]
        return None, None

    monkeypatch.setattr(stages, "_run_stage", run_stage)
    made = tuple(stages_file.Stage(f"s{index}", ("a",), share) for index, share in enumerate((2.0, 5.0, 1.0)))
    several = stages_file.Stages(Path("p"), made, seconds=16.0, run=stages_file.RunOptions())
    run: Any = SimpleNamespace(stages=several, out=tmp_path, options=several.run)
    stages._run_stages(run, Console(file=io.StringIO()), SimpleNamespace(budget_began=97.0))  # pyright: ignore
    assert began == [97.0, 99.0, 109.0]


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    stage = stages_file.Stage("one", ("a", "b.c"), 2.0, 4, "rcv", {"spp": 4, "space": "path"})
    made = stages_file.Stages(
        tmp_path / "problem.toml", (stage, stages_file.Stage("two", ("a",))), "auto", {"smooth": False}, 7, None, 3
    )
    (tmp_path / "stages.toml").write_text(stages_file.text(made, "A note"))
    assert stages_file.read(tmp_path / "stages.toml") == made
    assert made.settings_of(stage) == {"smooth": "false", "spp": "4", "space": "path"}


def test_a_doubtful_stage_before_a_resume_is_doubtful_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = tuple(stages_file.Stage(name, ("x",)) for name in ("one", "two"))
    planned = stages_file.Stages(tmp_path / "problem.toml", both, run=stages_file.RunOptions())
    statuses = {"1-one": "does not fit", "2-two": "finished"}
    for name in statuses:
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").touch()
    monkeypatch.setattr(reader, "read_run_record", lambda folder: SimpleNamespace(status=statuses[folder.name]))
    monkeypatch.setattr(reader, "read", lambda folder: SimpleNamespace(parameters={}))
    run: Any = stages.StagesRun(planned, None, tmp_path, "", "", None)  # type: ignore[arg-type]
    with pytest.raises(typer.Exit) as left:
        stages._run_stages(run, Console(file=io.StringIO()), SimpleNamespace(budget_began=0.0))  # type: ignore[arg-type]
    assert left.value.exit_code == DOUBTFUL


def test_a_prior_around_the_initial_value_is_refused_in_a_later_stage(staged: Path) -> None:
    """Its centre would be the result of the stage before, which the references have moved."""
    problem = staged / "problem.toml"
    problem.write_text(
        problem.read_text().replace(f'key = "{KEY}"', f'key = "{KEY}"\nprior = {{ near = "initial", std = 0.1 }}')
    )
    with pytest.raises(InputError, match=r'stage all: the prior of .* is near = "initial"'):
        StagedProblem.read(stages_file.read(staged / "stages.toml"))


def test_a_resume_after_all_stages_have_ended_is_refused(
    unrender: Unrender, staged: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would do nothing, whatever the new budget, and say nothing about that."""
    out = staged / "result"
    stages_file.write(stages_file.read(staged / "stages.toml"), out)
    for folder in stages_file.run_folders(out):
        folder.mkdir()
        (folder / "run.json").touch()
    monkeypatch.setattr(reader, "read_run_record", lambda _: SimpleNamespace(status="finished"))
    before = (out / "stages.toml").read_text()
    for words in ((), ("--steps", 600)):
        answer = unrender("resume", "result", *words)
        assert answer.refuses("result: all stages have ended; to continue the last one, give --steps or --seconds")
        assert "unrender resume result/3-all" in answer.error
    assert (out / "stages.toml").read_text() == before


def test_views_whose_scene_has_none_of_the_unknowns_are_left_out_of_a_stage(staged: Path) -> None:
    """Also where such a view comes first, whose scene holds no result of the stage before."""
    (staged / "other.xml").write_text((staged / "wall.xml").read_text().replace('id="sky"', 'id="lamp"'))
    problem = staged / "problem.toml"
    other = '[[views]]\nreference = "photo.exr"\nscene = "other.xml"\n[[views]]'
    problem.write_text(problem.read_text().replace("[[views]]", other))
    colour, light = stages_file.Stage("colour", (KEY,)), stages_file.Stage("light", ("sky.radiance.value",))
    whole = StagedProblem.read(stages_file.Stages(problem, (light, colour), steps=2))
    half = np.full(3, 0.5, np.float32)
    first = whole.of_stage(light, {KEY: half}, staged / "one")
    assert [view.scene for view in first.original_views] == [None]
    assert "view 0 is left out: its scene has none of the unknowns of this stage" in first.notices
    second = whole.of_stage(colour, {"sky.radiance.value": half}, staged / "two")
    assert len(second.original_views) == 2
    assert not any("left out" in notice for notice in second.notices)


def test_a_later_stage_begins_at_the_resolution_of_the_result_before() -> None:
    """Its coarse start would lose the details that the stage before has found."""
    given, known = {"map": Parameter("map", coarse_to_fine=[50])}, {"map": ParameterInfo((16, 16, 3), resizable=True)}
    problem = StagedProblem(Path(), given, (), L2(), None, {}, "", known, {}, frozenset(), ())
    stage, found = stages_file.Stage("all", ("map",)), np.zeros((16, 16, 3), np.float32)
    assert problem._parameter("map", stage, None).coarse_to_fine == [50]
    assert problem._parameter("map", stage, found).coarse_to_fine is None


@pytest.mark.slow
def test_a_shared_setting_without_effect_in_a_stage_is_told(unrender: Unrender, staged: Path) -> None:
    """It was dropped in silence, also where no stage has a use for it."""
    head, _, _ = (staged / "stages.toml").read_text().partition('[[stages]]\nname = "light"')
    head = head.replace('"plain"', '"auto"').replace("spp = 2, learning_rate = 0.02", "spp = 2, coarse = false")
    (staged / "stages.toml").write_text(head)
    answer = unrender(*RUN)
    assert answer.status == 0, answer.error
    assert "setting coarse=false: it has no effect in this stage, and is left out" in answer.out
    assert "setting spp" not in answer.out
