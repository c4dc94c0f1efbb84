"""A command names what it does as it does it, and says in the end where the time went."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest

import unrender as ur
from unrender.app.cli import arguments
from unrender.core import phases
from unrender.display.terminal import Console
from unrender.gallery import specification
from unrender.runs.progress import Progress

QUICK = ("--final-spp", 4)


def test_every_phase_is_named_in_its_order_and_its_time_told(unrender, problem: Path, mitsuba_variant: str) -> None:
    words = ["run", "problem.toml", "--steps", 2, "--out", "result", "--variant", mitsuba_variant, *QUICK]
    answer = unrender(*words)
    assert answer.status == 0, answer.error
    lines = answer.out.splitlines()
    assert lines[0] == "loading"  # the first word, before anything that takes time
    named = [
        line
        for line in lines
        if line in ("loading", "planning", "compiling", "final pictures", "page") or line.startswith("step 2/2")
    ]
    told = [line.partition("  ")[0] for line in named]
    assert told == ["loading", "planning", "compiling", "step 2/2", "final pictures", "page"]
    (time,) = (line for line in lines if line.startswith("time "))
    assert "loading" in time or "compiling" in time  # those that are a hundredth of all, however fast the machine
    assert "s in all" in " ".join(answer.out.split())
    (error,) = (line for line in lines if line.startswith("image error"))
    assert "noise removed" in error
    assert "±" in error or "below" in error
    record = json.loads((problem.parent / "result" / "run.json").read_text())
    assert list(record["phases"])[:3] == ["loading", "planning", "compiling"]
    assert record["phases"]["loading"] > 0
    page = (problem.parent / "result" / "report.html").read_text()
    assert "without the pictures" in page
    assert "compiling" in page


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "quad", "-s", "lr=1"], "no option lr"),
        (["run", "quad", "-m", "nothing"], "unknown method nothing"),
        (["run", "quad", "--variant", "nothing"], "--variant nothing"),
        (["run", "quad", "--out", "problem.toml"], "--out problem.toml: a file"),
        (["compare", "quad", "-s", "lr=1"], "no option lr"),
    ],
)
def test_options_are_refused_before_anything_is_loaded(unrender, problem: Path, words: list[str], message: str) -> None:
    answer = unrender(*words)
    assert answer.status == 2
    assert message in answer.error
    assert not answer.out


@pytest.mark.usefixtures("short_ends")
def test_what_will_hardly_do_is_said_before_the_first_step(unrender, problem: Path, mitsuba_variant: str) -> None:
    words = ["run", "problem.toml", "--steps", 1, "--out", "result", "--variant", mitsuba_variant, *QUICK]
    answer = unrender(*words, "-m", "rcv", "-s", "learning_rate=2")
    assert answer.status == 5  # and it did make the picture worse
    note = answer.out.index("note: parameter wall.bsdf.reflectance.value: a learning_rate of 2 crosses its range")
    assert note < answer.out.index("compiling")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["-m", "adaptive", "-s", "pixels=99999999"], "99999999 pixels a step, but all views together have 24"),
        (["-s", "lr=0.1"], "method auto has no option lr; did you mean learning_rate?"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused_in_one_line(
    unrender, problem: Path, mitsuba_variant: str, settings: list[str], message: str
) -> None:
    answer = unrender("run", "problem.toml", "--steps", 1, "--variant", mitsuba_variant, *settings)
    assert answer.refuses(message)
    assert not (problem.parent / "out").exists()


def test_a_sensor_under_a_shared_path_names_the_methods(problem: Path, mitsuba_variant: str) -> None:
    del mitsuba_variant
    made, scene = problem.parent / "pose.toml", problem.parent / "wall.xml"
    scene.write_text(scene.read_text().replace("<sensor ", '<sensor id="sensor" '))
    text = problem.read_text().replace("wall.bsdf.reflectance.value", "sensor.rotation.y").replace("truth", "# truth")
    made.write_text(text)
    with pytest.raises(ur.InputError, match="--method smoothed"):
        ur.optimize(ur.Problem.from_file(made), "rcv", steps=1)


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_references_are_rendered_anew_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mitsuba_variant: str
) -> None:
    del mitsuba_variant
    monkeypatch.setenv("UNRENDER_CACHE_DIR", str(tmp_path))
    rendered = []
    render = specification._render
    monkeypatch.setattr(specification, "_render", lambda *given: rendered.append(given) or render(*given))
    options = {"resolution": "4", "texture_resolution": "2", "reference_spp": "1"}
    for cached in (False, True, True):
        arguments.open_problem("indirect-room", options, cached)
    assert len(rendered) == 2


def test_a_terminal_gets_a_bar_for_each_phase_that_leaves_nothing_behind() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=80)
    with Progress(console) as progress:
        with phases.phase("loading"), phases.phase("reference images") as advance:
            advance(0.25)
        with pytest.raises(ValueError), phases.phase("compiling"):
            raise ValueError
    shown = screen.getvalue()
    assert all(name in shown for name in ("loading", "reference images", "compiling"))
    assert list(progress.seconds) == ["loading", "reference images", "compiling"]
    assert progress.elapsed >= sum(progress.seconds.values())
    assert phases._listeners.get() == ()


def test_elsewhere_a_phase_is_one_line_and_its_progress_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("unrender.runs.progress.time.perf_counter", lambda: now[0])
    screen = io.StringIO()
    with Progress(Console(file=screen)):
        with phases.phase("loading"), phases.phase("loading"):
            pass
        with phases.phase("reference images") as advance:
            for step in range(100):
                now[0] += 0.1
                advance(step / 100)
    lines = screen.getvalue().splitlines()
    assert lines[:2] == ["loading", "reference images"]
    assert 3 <= len(lines[2:]) <= 5
    assert lines[2].startswith("reference images ")
    assert lines[2].endswith("%")
