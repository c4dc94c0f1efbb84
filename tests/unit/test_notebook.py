"""How problems and results are shown: one line of text, HTML in notebooks, a figure, a bar."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.analytic import AnalyticRenderer
from unrender import optimizers
from unrender.core import phases
from unrender.core.errors import InputError
from unrender.display import formatting, notebook
from unrender.display.notebook import NotebookBar
from unrender.estimators.path import PathGradient
from unrender.runs.optimize import optimize
from unrender.runs.result import Result
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.references import View

HOSTILE = '<script>alert("x")</script>'


class Outline(HTMLParser):
    """Tags, the sources of images, and whether tags are balanced."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("img", "line", "path"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def problem(key: str = "map", name: str = "wall") -> Problem:
    rng = np.random.default_rng(0)
    truth = {key: rng.uniform(0.3, 0.9, (3, 5, 1)), "number": np.array(0.5)}
    renderer = AnalyticRenderer(truth, rng.random((6 * 8 * 3, 16)), 0.1, 0.1, shape=(6, 8))
    views = [View(renderer.exact(truth))]
    unknown = [Parameter(key, initial=0.5, bounds=(0, 1)), Parameter("number", initial=0.2)]
    return Problem(renderer, unknown, views, truth=truth, name=name)


@pytest.fixture(scope="module")
def result() -> Result:
    return optimize(problem(), PathGradient(), optimizers.Adam(0.05), steps=30)


def test_representations_are_one_short_line(result: Result) -> None:
    assert repr(problem()) == "Problem('wall': map (3, 5, 1), number (); 1 view of 8x6; L2())"
    text = repr(result)
    assert re.fullmatch(
        r"Result\('wall', .*: 30 steps in [\d.]+ m?s, parameter error 0\.\d+ → 0\.\d+, finished\)", text
    )
    assert "\n" not in text
    assert len(text) < 200


def test_html_is_complete_in_itself_with_pictures_and_curves(result: Result) -> None:
    for shown, pictures in ((problem(), 3), (result, 3)):
        outline = Outline(shown._repr_html_())
        assert outline.open == []
        assert "script" not in outline.tags
        assert outline.tags.count("img") == pictures
        assert all(source.startswith("data:image/png;base64,") for source in outline.sources)
    assert outline.tags.count("svg") == 2
    assert result._repr_html_().count("<path") >= 3  # two parameters' errors and the loss


def test_numbers_are_shown_with_the_standard_errors_of_the_runs_noise(result: Result) -> None:
    shown = replace(result, standard_error={"number": np.array(0.012)})._repr_html_()
    value = formatting.number(float(result.parameters["number"]))
    assert f"{value} ± 0.012 (truth {formatting.number(float(result.truth['number']))})" in shown
    assert f"{value} (truth" in result._repr_html_()


def test_names_cannot_bring_code_along() -> None:
    made = problem(key=HOSTILE, name=HOSTILE)
    shown = made._repr_html_() + optimize(made, PathGradient(), optimizers.Adam(), steps=2)._repr_html_()
    assert "<script" not in shown
    assert "&lt;script&gt;" in shown


def test_a_result_without_a_step_or_a_truth_is_shown() -> None:
    values = {"wall": np.full(3, 0.5, np.float32)}
    empty = Result(values, values, [], 0.0, 0.0, "interrupted")
    assert "0 steps" in repr(empty)
    assert Outline(empty._repr_html_()).open == []


class Shell:
    """A notebook's shell, as far as it is asked, and what a cell showed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, kind: str = "ZMQInteractiveShell"):
        self.shown: list[str] = []
        shell = type(kind, (), {})()
        module: Any = SimpleNamespace(get_ipython=lambda: shell)
        display: Any = SimpleNamespace(HTML=lambda text: text, display=self._display)
        monkeypatch.setitem(sys.modules, "IPython", module)
        monkeypatch.setitem(sys.modules, "IPython.display", display)

    def _display(self, html: str, display_id: bool) -> Any:
        assert display_id
        self.shown.append(html)
        return SimpleNamespace(update=self.shown.append)


def test_a_notebook_gets_a_bar_that_ends_as_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    shell = Shell(monkeypatch)
    optimize(problem(), PathGradient(), optimizers.Adam(0.05), steps=30)
    assert "<progress" in shell.shown[0]
    assert "compiling" in shell.shown[0]
    assert re.search(r">30 steps in [\d.]+ m?s", shell.shown[-1])
    assert "<progress" not in shell.shown[-1]


def test_no_bar_where_none_is_wanted_or_nobody_sees_it(monkeypatch: pytest.MonkeyPatch) -> None:
    shell = Shell(monkeypatch)
    optimize(problem(), PathGradient(), optimizers.Adam(0.05), steps=2, progress=False)
    assert shell.shown == []
    terminal = Shell(monkeypatch, "TerminalInteractiveShell")
    optimize(problem(), PathGradient(), optimizers.Adam(0.05), steps=2)
    assert terminal.shown == []


def test_phases_are_shown_escaped_and_the_bar_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    shell = Shell(monkeypatch)
    with notebook.shown(), phases.phase("<reference>") as advance:
        advance(0.5)
    assert "&lt;reference&gt;" in shell.shown[0]
    assert shell.shown[-1] == ""


def test_a_bar_is_not_replaced_oftener_than_one_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    shell = Shell(monkeypatch)
    bar = NotebookBar()
    for step in range(1000):
        bar.show(f"step {step}", step / 1000)
    assert len(shell.shown) < 20
    assert 'value="0.0000"' in shell.shown[0]


def test_a_bar_on_a_terminal_on_request(capsys: pytest.CaptureFixture[str]) -> None:
    optimize(problem(), PathGradient(), optimizers.Adam(0.05), steps=2, progress=True)
    assert "compiling" in capsys.readouterr().out


def test_an_error_in_a_notebook_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A chain of causes too. Where IPython is not installed, by what it would print."""
    assert InputError("no such key")._render_traceback_() == ["InputError: no such key"]
    shells = pytest.importorskip("IPython.core.interactiveshell", reason="needs IPython: pip install 'unrender[docs]'")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    shell = shells.InteractiveShell()
    shell.run_cell("from unrender.core.errors import InputError")
    shell.run_cell(
        "try:\n    1 / 0\nexcept ZeroDivisionError as error:\n    raise InputError('no such key') from error"
    )
    shell.history_manager.end_session()
    assert capsys.readouterr().out.strip() == "InputError: no such key"
