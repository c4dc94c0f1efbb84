"""The slices of plan.toml."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from unrender.io import toml_lines

_TOY_TESTS = {"unit": "losses", "contract": "tolerance", "render": "grids", "statistical": "grey_box_chain_rule"}


@dataclass(frozen=True)
class Command:
    """One process. A command that has ended is not run again.

    Attributes:
        words: "doctor", "tests" with a folder, or a benchmark with its options.
        minutes: expected on a GPU; an estimate.
    """

    words: str
    minutes: float

    @property
    def name(self) -> str:
        """What runs: "doctor", "tests" or a benchmark."""
        return shlex.split(self.words)[0]

    def arguments(self, toy: bool) -> list[str]:
        """Return the words after the name.

        Args:
            toy: benchmarks take the sizes of their `QUICK` and keep the options that are names; tests are those of one file.
        """
        given = shlex.split(self.words)[1:]
        if self.name == "tests":
            file = f"/test_{_TOY_TESTS[given[0]]}.py" if toy else ""
            return ["-m", "mitsuba and not slow", f"tests/{given[0]}{file}"]
        if not toy or self.name == "doctor":
            return given
        kept, option = ["--quick"], ""
        for word in given:
            if word.startswith("--"):
                option = word
            elif not word.replace(".", "", 1).isdigit():
                kept += [option, word] if option else [word]
                option = ""
        return kept


@dataclass(frozen=True)
class Slice:
    """A part of the plan.

    Attributes:
        name: on the command line.
        what: it shows; with the paper's figure where it is one's.
        commands: run in this order.
    """

    name: str
    what: str
    commands: tuple[Command, ...]

    @property
    def minutes(self) -> float:
        """Expected in all."""
        return sum(command.minutes for command in self.commands)


def _slices(file: Path) -> tuple[Slice, ...]:
    found = []
    for name, (what, *lines) in toml_lines.parse(file.read_text(encoding="utf-8"), str(file)).items():
        pairs = (line.split(" ", 1) for line in lines)
        found.append(Slice(name, what, tuple(Command(words, float(minutes)) for minutes, words in pairs)))
    return tuple(found)


SLICES = _slices(Path(__file__).with_name("plan.toml"))
