"""Text of others: on a terminal, on a page, in a message."""

from __future__ import annotations

import ast
import io
import time
from pathlib import Path

import pytest
from jinja2 import DictLoader
from rich.markup import escape
from rich.progress import Progress, TextColumn
from rich.table import Table

from unrender.app.report import html
from unrender.core.errors import InputError, VariantError
from unrender.core.text import (
    LONGEST_LINE,
    did_you_mean,
    grouped,
    listed,
    names_in,
    one_line,
    printable,
    shorten,
    visible,
)
from unrender.display.terminal import Console, columns, echo

EVIL = {
    "ESC": "\x1b]0;owned\x07\x1b[2J",
    "C1": "\x9b2J\x9d0;owned\x9c",
    "line breaks": "a\nb\r\x0b\x0cc\x85\u2028d",
    "directions": "\u202eowned\u2066",
    "no Unicode": "a\udc80",
    "zero": "\0owned",
}


@pytest.mark.parametrize("name", EVIL)
def test_what_does_not_print_is_shown(name: str):
    shown = visible(EVIL[name])
    assert shown.isprintable()
    assert visible(shown) == shown
    assert ast.literal_eval(f"'{shown}'") == EVIL[name]
    assert visible("Wände – 壁 🧱") == "Wände – 壁 🧱"


def test_line_breaks_may_be_kept():
    assert visible("a\n\tb\x1b", "\n\t") == "a\n\tb\\x1b"


def test_long_text_loses_its_middle():
    text = "".join(chr(97 + n % 26) for n in range(5000))
    short = shorten(text, 200)
    assert len(short) == 200
    assert short.startswith(text[:100])
    assert short.endswith(text[-60:])
    assert shorten("abc", 200) == "abc"
    assert len(one_line("\x1b" * 10**6)) == LONGEST_LINE
    assert len(printable("A" * 5000)) == 60
    assert printable(type("Evil", (), {"__repr__": lambda _: "\x1b[2J"})()) == "\\x1b[2J"


@pytest.mark.parametrize("kind", [InputError, VariantError])
@pytest.mark.parametrize("name", EVIL)
def test_errors_are_one_printable_line(kind: type[Exception], name: str):
    line = str(kind(f"{EVIL[name]}: expected a name"))
    assert line.isprintable()
    assert line.endswith(": expected a name")
    assert len(str(kind("A" * 5000))) <= LONGEST_LINE


@pytest.mark.parametrize("name", EVIL)
def test_a_console_prints_no_control_characters(name: str):
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=60, highlight=False, color_system=None)
    text = EVIL[name]
    table = Table(text)
    table.add_row(text, escape(text))
    console.print(f"[bold]{escape(text)}[/]", soft_wrap=True)
    console.print(text, markup=False)
    console.print(table)
    assert "\x1b" not in _without_styles(file.getvalue())
    assert all(letter.isprintable() or letter in "\n\t" for letter in _without_styles(file.getvalue()))


def _without_styles(text: str) -> str:
    for style in ("\x1b[1m", "\x1b[0m"):
        text = text.replace(style, "")
    return text


def test_a_progress_bar_moves_and_prints_no_control_characters():
    """Its own commands reach the terminal, those in its text do not."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=60)
    with Progress(TextColumn("{task.description}", markup=False), console=console, auto_refresh=False) as bar:
        bar.add_task(EVIL["ESC"] + EVIL["C1"])
        bar.refresh()
        bar.refresh()
    said = file.getvalue()
    assert "owned" in said
    assert "\x1b]" not in said
    assert "\x1b[2J" not in said
    assert "\x9b" not in said
    assert "\x1b[2K" in said


def test_echo_prints_no_control_characters(capsys: pytest.CaptureFixture[str]):
    echo(Path(f"a/{EVIL['ESC']}"))
    assert "\x1b" not in capsys.readouterr().out


def test_all_commands_print_by_that_console():
    folder = Path(html.__file__).parents[1] / "cli"
    sources = {path.name: path.read_text() for path in folder.glob("*.py")}
    assert [name for name, text in sources.items() if "from rich.console" in text] == []
    assert [
        name for name, text in sources.items() if "typer.echo(" in text and name not in ("terminal.py", "app.py")
    ] == []


@pytest.mark.parametrize("name", EVIL)
def test_pages_hold_no_control_characters(name: str):
    template = "<p title='{{ x }}'>{{ x }} {{ x|upper }} {% for part in [x] %}{{ part }}{% endfor %}</p>"
    page = html.environment(DictLoader({"page": template})).get_template("page").render(x=EVIL[name] + "<b>")
    assert all(letter.isprintable() or letter in "\n\t" for letter in page)
    assert "<b>" not in page


def test_suggestions_take_no_time():
    began = time.process_time()
    assert did_you_mean("A" * 5000, ["A" * 4999]) == ""
    assert did_you_mean("a" * 100, (f"{n:0100d}" for n in range(400_000))) == ""
    assert did_you_mean("wall", ["wal", "x" * 10**6]) == "; did you mean wal?"
    assert time.process_time() - began < 1


def test_exchanged_neighbouring_letters_are_the_nearest_name():
    assert did_you_mean("wiht", ["weight", "with"]) == "; did you mean with?"
    assert did_you_mean("relu3_4", ["relu4_3", "relu3_3"]) == "; did you mean relu3_3?"


def test_long_lists_of_names_are_cut():
    eight = [f"lamp{n}" for n in range(8)]
    assert listed(eight) == ", ".join(eight)
    assert listed([*eight, "lamp8"]) == "lamp0, lamp1, lamp2, lamp3 and 5 more"
    assert grouped({"wall": "0.1", "roughness": "0.05", "floor": "0.1"}) == "0.1 (wall, floor), 0.05 (roughness)"


@pytest.mark.parametrize(("key", "width"), [("wall.bsdf.reflectance.data", 30), (f"{'mesh.' * 17}data", 80)])
def test_a_table_has_its_values_beside_keys_of_any_length(key: str, width: int) -> None:
    """Where the output is no terminal, it has 80 columns, and the keys of nested materials may be as long."""
    table = columns()
    table.add_row(key, "error 0.3366 before")
    printed = Console(file=io.StringIO(), width=width)
    printed.print(table)
    text = "".join(printed.file.getvalue().split())  # pyright: ignore[reportAttributeAccessIssue]
    assert "0.3366" in text
    assert sorted(text) == sorted(f"{key}error0.3366before")


def test_names_in_a_text_are_whole_ones() -> None:
    known = ["ball", "ball.x", "bigball", "ball-2", "lamp"]
    assert names_in("bigball: it moves; ball.x and ball-2, lamps", known) == {"bigball", "ball.x", "ball-2"}
    assert names_in("ball.y: a", known) == set()
    assert names_in("of ball.\nlamp: b", known) == {"ball", "lamp"}
    assert names_in("ball", []) == set()
