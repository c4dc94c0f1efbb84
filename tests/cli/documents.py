"""Code blocks of Markdown pages, and how each language is held to be true.

A page's blocks run in order, in an empty folder. A comment before a block says what differs from the rule of its language:

    <!-- test: file room.xml -->        it is the content of that file
    <!-- test: edit room.toml OLD NEW --> before it, OLD becomes NEW in that file
    <!-- test: skip, REASON -->         it is not executed

and one comment anywhere, `<!-- test: after guide/texture.md -->`, runs the blocks of another page first; with `files of` in place of
`after`, the run folders of that page are removed.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from unrender.app.cli.main import main
from unrender.core.errors import InputError
from unrender.io.toml_lines import tomllib

ROOT = Path(__file__).resolve().parents[2]
FENCE = re.compile(
    r"(?:<!-- test: (?P<marker>[^\n]*?) -->\n)?"
    r"^(?P<fence>```+)(?P<language>[^\n`]*)\n(?P<text>.*?)^(?P=fence)[ ]*$",
    re.MULTILINE | re.DOTALL,
)
AFTER = re.compile(r"^<!-- test: (?:after|files of) (\S+) -->$", re.MULTILINE)
FILES = re.compile(r"^<!-- test: files of ", re.MULTILINE)
DIRECTIVES = {"{toctree}", "{eval-rst}", "{include}", "{container}"}
SMALL = {"resolution": "16", "texture_resolution": "8", "reference_spp": "4"}


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, text, the comment before it, and where it stands."""

    language: str
    text: str
    marker: str
    place: str


def blocks(page: Path) -> list[Block]:
    """Every block of a page but the site's own directives."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        language = match["language"].strip().removeprefix("{code-cell}").strip()
        if language.split(" ")[0] in DIRECTIVES:
            continue
        line = text.count("\n", 0, match.start("fence")) + 1
        found.append(Block(language, match["text"], match["marker"] or "", f"{page.relative_to(ROOT)}:{line}"))
    return found


def previous_pages(page: Path) -> Iterator[Path]:
    """The pages whose blocks run first."""
    for name in AFTER.findall(page.read_text(encoding="utf-8")):
        yield ROOT / "docs" / name
    if FILES.search(page.read_text(encoding="utf-8")):
        shutil.rmtree("out", ignore_errors=True)


class Runner:
    """Runs the blocks of one page, in the current folder. Python blocks share the namespace of `module`, which whoever runs them adds to
    `sys.modules`, where checkpoints look for the classes of states."""

    def __init__(self, name: str, output: Any):
        self.module = types.ModuleType(f"page_{re.sub(r'[^a-z]', '_', name)}")
        self.output = output

    def run(self, block: Block) -> None:
        """Hold one block to be true."""
        verb, _, rest = block.marker.partition(" ")
        if verb == "skip,":
            assert rest.strip(), f"{block.place}: a block is skipped for a reason"
            return
        if verb == "file":
            Path(rest).write_text(block.text, encoding="utf-8")
        elif verb == "edit":
            name, old, new = shlex.split(rest)
            text = Path(name).read_text(encoding="utf-8")
            assert old in text, f"{block.place}: {name} has no {old}"
            Path(name).write_text(text.replace(old, new), encoding="utf-8")
        else:
            assert not verb, f"{block.place}: unknown marker {block.marker}"
        ways = {
            "python": self.python, "toml": self.toml, "xml": self.xml, "sh": self.sh, "console": self.console,
            "text": self.text,
        }  # fmt: skip
        assert block.language in ways, f"{block.place}: no rule for the language {block.language!r}"
        ways[block.language](block)

    def python(self, block: Block) -> None:
        """Execute it."""
        self.output()
        exec(
            compile("\n" * int(block.place.rpartition(":")[2]) + block.text, block.place, "exec"), self.module.__dict__
        )

    def text(self, block: Block) -> None:
        """What the Python block before it printed; `...` stands for anything."""
        out, _ = self.output()
        assert matches(block.text, out), f"{block.place}: printed\n{out}"

    def xml(self, block: Block) -> None:
        """Well formed."""
        ElementTree.fromstring(block.text)

    def toml(self, block: Block) -> None:
        """A problem that opens, or a part of one whose fields are known."""
        check_toml(block.text, block.place, Path(block.marker.partition(" ")[2]) if block.marker else None)

    def sh(self, block: Block) -> None:
        """Commands, with small budgets."""
        for line in logical_lines(block.text):
            status = command(line, block.place)
            _, error = self.output()
            assert status == 0, f"{block.place}: {line}: status {status}: {error}"

    def console(self, block: Block) -> None:
        """Commands after `$`, and what each says."""
        for shown in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
            line, _, expected = shown.partition("\n")
            self.output()
            command(line, block.place)
            out, error = self.output()
            assert matches(expected, out + error), f"{block.place}: {line} said\n{out}{error}"


def matches(expected: str, said: str) -> bool:
    """Equal up to white space; `...` stands for anything."""
    parts = [re.escape(" ".join(part.split())) for part in expected.split("...")]
    return re.fullmatch(r"\s*" + r".*".join(parts) + r"\s*", " ".join(said.split()), re.DOTALL) is not None


def check_toml(text: str, place: str, file: Path | None = None) -> None:
    """A whole problem opens; of a part of one, each field exists and has the right type.

    What is missing in a part is filled in with a scene that does not exist: that it is missing is then the first complaint.
    """
    from unrender.app.stages import stages_file
    from unrender.scene.problem import Problem

    if file is not None and stages_file.is_stages(file):
        stages_file.read(file)
        return
    if file is not None:
        Problem.from_file(file)
        return
    given = tomllib.loads(text)
    head = "" if "scene" in given else 'scene = "nowhere.xml"\n'
    tail = "" if "parameters" in given else '\n[[parameters]]\nkey = "some.key"\n'
    tail += "" if "views" in given else '\n[[views]]\nreference = "nowhere.exr"\n'
    whole = Path("part.toml")
    whole.write_text(head + text + tail, encoding="utf-8")
    scene = given.get("scene", "nowhere.xml")
    with pytest.raises(InputError) as complaint:
        Problem.from_file(whole)
    said = str(complaint.value)
    assert scene in said or "vgg16.safetensors" in said, f"{place}: {said}"


def logical_lines(text: str) -> Iterator[str]:
    """Commands without comments and empty lines."""
    for line in text.splitlines():
        bare = re.sub(r"(^|\s)#.*", "", line).strip()
        if bare:
            yield bare


def command(line: str, place: str) -> int:
    """Run a command line, or hold it to be a possible one where running it makes no sense in a test. The exit status."""
    words = shlex.split(line.removesuffix("&"))
    if words[0] == "make":
        targets = re.findall(r"^([\w\-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        assert words[1] in targets, f"{place}: the Makefile has no {words[1]}"
        return 0
    if words[0] == "mitsuba":
        import mitsuba as mi

        mi.load_file(words[-1])
        return 0
    if words[0] == "echo":
        return subprocess.run(["sh", "-c", line], check=False).returncode
    assert words[0] == "unrender", f"{place}: no rule for the command {words[0]}"
    check_options(words, place)
    synopsis = any(re.fullmatch(r"\[.*|.*\]|[A-Z]{3,}", word) for word in words)
    alone = words[1] in ("watch", "sweep") or "--workers" in words  # by their options alone
    return 0 if synopsis or alone else main(small(words[1:]))


def check_options(words: list[str], place: str) -> None:
    """Every option that a line names exists."""
    from typer.main import get_command

    from unrender.app.cli.app import app

    commands: Mapping[str, Any] = get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    assert words[1] in commands, f"{place}: no command {words[1]}"
    known = {option for parameter in commands[words[1]].params for option in parameter.opts + parameter.secondary_opts}
    for word in words[2:]:
        name = word.strip("[]").partition("=")[0]
        if re.fullmatch(r"--?[a-z][a-z\-]*", name):
            assert name in known, f"{place}: {words[1]} has no option {name}"


def small(arguments: list[str]) -> list[str]:
    """The same command with the smallest budgets, by its own options."""
    verb, words = arguments[0], list(arguments)
    further = "6" if "--steps" in words else "4"  # a finished run is resumed only with a larger budget
    budgets = {"run": ["--steps", "2"], "resume": ["--steps", further], "compare": ["--seconds", "0.2", "--seeds", "1"]}
    if verb not in budgets:
        return words
    for option in ("--steps", "--seconds", "--seeds"):
        while option in words:
            at = words.index(option)
            del words[at : at + 2]
    words += budgets[verb]
    if verb != "resume":
        words += ["--final-spp", "2"]
        from unrender import gallery

        if words[1] in gallery.names():
            options = {option.name for option in gallery.options(words[1])}
            words += [word for name, value in SMALL.items() if name in options for word in ("-p", f"{name}={value}")]
    return words
