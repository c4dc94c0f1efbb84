"""Stages as TOML files.

    problem = "problem.toml"                   # all unknowns, views and the loss
    method = "auto"                            # default method of the stages
    settings = { pixels = 16384 }              # default settings of the method
    steps = 600                                # total of all stages; or seconds
    seed = 0

    [[stages]]
    name = "light-and-colour"
    unknowns = ["asset.bsdf.base_color.data", "light.data"]
    share = 2.0                                # of the steps or seconds, relative to the other stages
    coarser = 4                                # factor by which textures have fewer texels per side

    [[stages]]
    name = "all"
    unknowns = ["asset.bsdf.base_color.data", "asset.bsdf.roughness.data", "light.data"]

Paths are relative to the file. Only `problem`, `name` and `unknowns` are required. In the folder of a run, the file also has
a table [run] with the options of the run, which `unrender resume` uses.
"""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tomli_w
from pydantic import ConfigDict, Field, StrictFloat, StrictInt, StrictStr
from pydantic.dataclasses import dataclass

from unrender.core import lazy
from unrender.core.errors import InputError
from unrender.io import bounded_files, files, toml_lines
from unrender.io.toml_lines import Place

if TYPE_CHECKING:
    from unrender.runs.folder import schema
else:  # a file is told to have stages without Dr.Jit
    schema = lazy.Module("runs.folder.schema")

FILE = "stages.toml"
"""Name of the file in the folder of an import, and in that of a run in stages."""
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}")
_MOST = 99
_CONFIG = ConfigDict(extra="forbid")
_Positive = Annotated[StrictFloat | Annotated[StrictInt, Field(lt=1 << 63)], Field(gt=0, allow_inf_nan=False)]
_Setting = StrictStr | StrictInt | StrictFloat | bool
_Count = Annotated[StrictInt, Field(ge=1, lt=1 << 32)]
_COUNT = "a whole number of at least 1, below 2**32"


@dataclass(frozen=True, config=_CONFIG)
class Stage:
    """One run of several. `settings` are in addition to those of all stages."""

    name: StrictStr = Field(description="lower-case letters, digits and dashes, at most 40")
    unknowns: tuple[StrictStr, ...] = Field(
        description="a list of at least one key of the problem's parameters", min_length=1
    )
    share: _Positive = Field(default=1.0, description="a number above 0")
    coarser: Annotated[StrictInt, Field(ge=1, le=64)] = Field(default=1, description="a whole number from 1 to 64")
    method: StrictStr | None = Field(default=None, description="the name of a method, see `unrender methods`")
    settings: dict[StrictStr, _Setting] = Field(
        default={}, description="a table of the method's options, such as { spp = 4 }"
    )


@dataclass(frozen=True, config=_CONFIG)
class RunOptions:
    """Options of a run in stages that do not affect its results, see `optimize` and `RunAnnotations`."""

    variant: StrictStr = Field(default="auto", description="a variant of Mitsuba")
    threads: _Count | None = Field(default=None, description=_COUNT)
    checkpoint_every: _Count | None = Field(default=None, description=_COUNT)
    final_spp: _Count | None = Field(default=None, description=_COUNT)


@dataclass(frozen=True, config=_CONFIG)
class Stages:
    """Consecutive runs of one problem, each of which starts at the result of the previous one, with consecutive seeds.

    `steps` and `seconds` are the total budget of all stages; `run` is None outside of the folder of a run.
    """

    problem: Path = Field(description="the path of a problem file")
    stages: tuple[Stage, ...] = Field(description="at least one [[stages]] table", min_length=1, max_length=_MOST)
    method: StrictStr = Field(default="auto", description="the name of a method, see `unrender methods`")
    settings: dict[StrictStr, _Setting] = Field(
        default={}, description="a table of the method's options, such as { spp = 4 }"
    )
    steps: Annotated[StrictInt, Field(ge=1)] | None = Field(default=None, description="a whole number of at least 1")
    seconds: _Positive | None = Field(default=None, description="a number above 0")
    seed: Annotated[StrictInt, Field(ge=0)] = Field(default=0, description="a whole number of at least 0")
    run: RunOptions | None = Field(default=None, description="a table of a run's options")

    def settings_of(self, stage: Stage) -> dict[str, str]:
        """Return the settings of the method in a stage, as on the command line."""
        both = {**self.settings, **stage.settings}
        return {key: str(value).lower() if isinstance(value, bool) else str(value) for key, value in both.items()}


TABLES = {"": Stages, "stages": Stage}
"""Models of the tables of a file of stages, by name; "" is the file itself."""


def is_stages(path: Path) -> bool:
    """Return whether a TOML file describes stages, not a problem; False for a file that cannot be read, whose error a later reader
    reports."""
    content = _parsed(path)
    return bool({"stages", "problem"} & content.keys()) and "scene" not in content


def is_of_run(path: Path) -> bool:
    """Return whether a file of stages is one that `write` wrote to the folder of a run; False for a file that cannot be read."""
    problem = _parsed(path).get("problem")
    return is_stages(path) and isinstance(problem, str) and Path(problem).is_absolute()


def _parsed(path: Path) -> dict[str, Any]:
    try:
        return toml_lines.parse(bounded_files.read_text(path, toml_lines.LARGEST), str(path))
    except (InputError, OSError):
        return {}


def read(path: str | Path) -> Stages:
    """Read a TOML file of stages. Raises `InputError`, "stages.toml:12: stages[0].share: ...", with the expected value."""
    file = Path(path)
    stages, content = toml_lines.read(file, Stages, {"stages": Stage, "run": RunOptions})
    known: set[str] = set()
    for index, stage in enumerate(stages.stages):
        place: Place = ("stages", index, "name")
        what = ""
        if not _NAME.fullmatch(stage.name):
            what = f"expected {toml_lines.fields_of(Stage)['name'].description}, got {stage.name!r:.60}"
        elif stage.name in known:
            what = f"{stage.name} is given twice"
        elif len(set(stage.unknowns)) < len(stage.unknowns):
            place, what = ("stages", index, "unknowns"), "a key is given twice"
        if what:
            raise toml_lines.error_at(file, content, place, what)
        known.add(stage.name)
    return replace(stages, problem=file.parent / stages.problem)


def text(stages: Stages, note: str) -> str:
    """Return the content of the file, after a comment."""
    head: dict[str, Any] = {"problem": str(stages.problem), "method": stages.method, "settings": stages.settings}
    head |= {"steps": stages.steps, "seconds": stages.seconds, "seed": stages.seed}
    parts = [f"# {note}\n", tomli_w.dumps({key: value for key, value in head.items() if value not in (None, {})})]
    if stages.run is not None:
        options = {key: value for key, value in asdict(stages.run).items() if value is not None}
        parts.append(tomli_w.dumps({"run": options}))
    for stage in stages.stages:
        table = {"name": stage.name, "unknowns": list(stage.unknowns), "share": stage.share}
        table |= {"coarser": stage.coarser} if stage.coarser > 1 else {}
        table |= {key: value for key in ("method", "settings") if (value := getattr(stage, key))}
        parts.append(toml_lines.array_table("stages", table))
    return "\n".join(parts)


def write(stages: Stages, folder: Path) -> None:
    """Write the file of a run in stages, with the absolute path of the problem. Raises `OSError` if it cannot be written."""
    absolute = replace(stages, problem=stages.problem.resolve())
    note = "Stages of a run: `unrender resume` continues with the unfinished ones"
    files.write(folder / FILE, toml_lines.encode(text(absolute, note), str(folder / FILE)))


def split(stages: Stages) -> list[tuple[int | None, float | None]]:
    """Return (steps, seconds) of each stage by the shares, None without that budget. All have a step, even if the total is exceeded."""
    total = sum(stage.share for stage in stages.stages)
    ends, budgets = 0.0, []
    assigned = 0
    for stage in stages.stages:
        ends += stage.share
        steps = None
        if stages.steps is not None:
            steps = max(1, round(stages.steps * ends / total) - assigned)
            assigned += steps
        budgets.append((steps, None if stages.seconds is None else stages.seconds * stage.share / total))
    return budgets


def folder_of(stages: Stages, index: int, out: Path) -> Path:
    """Return the run folder of a stage in the folder `out`: 1-NAME, 2-NAME, ..."""
    return out / f"{index + 1}-{stages.stages[index].name}"


def run_folders(directory: Path) -> list[Path]:
    """Return the run folders of a folder of stages, also of those not started; else the folder itself. Raises `InputError`."""
    if not (directory / FILE).is_file():
        return [directory]
    stages = read(directory / FILE)
    if not is_of_run(directory / FILE):
        return [directory]
    return [folder_of(stages, index, directory) for index in range(len(stages.stages))]


def last_result(directory: Path) -> Path:
    """Return the run folder of the last started stage; any other folder is returned as it is. Raises `InputError`."""
    if (directory / schema.RECORD).is_file():
        return directory
    return next((run for run in reversed(run_folders(directory)) if (run / schema.RECORD).is_file()), directory)


def stage_of(run: Path) -> tuple[Stages, int] | None:
    """Return the stages of a run folder and its index among them; None without stages. Raises `InputError`."""
    out, name = run.resolve().parent, run.resolve().name
    if not is_of_run(out / FILE):
        return None
    stages = read(out / FILE)
    names = [folder_of(stages, index, out).name for index in range(len(stages.stages))]
    return (stages, names.index(name)) if name in names else None
