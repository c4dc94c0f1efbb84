"""What lies in a run folder: the names of its files, and the models of those that are JSON.

A run writes what these models say, and `reader` checks what it reads against them. Fields that a model does not have are ignored.

| file | holds |
|---|---|
| `run.json` | `RunRecord` |
| `method.toml` | `method_file.Method` |
| `problem.toml`, `problem/` | see `problem.serialization` |
| `history.jsonl` | one JSON object per step, see `HISTORY_COLUMNS` |
| `parameters.npz`, `initial.npz`, `truth.npz` | {key: array}: the latest, the first, the true values where they are known |
| `last.npz` | {key: array} after the last step, where `parameters.npz` holds better ones of an earlier step |
| `pictures.npz` | {"view0/reference": (H, W, 3), ...}, see `PICTURE_NAME` |
| `sensitivity.npz` | {key: array}: see `Result.sensitivity` |
| `meshes.npz`, `meshes/` | see `meshes.arrays_of`; PLY and OBJ files of the meshes that were recovered |
| `checkpoints/00000050/` | `state.safetensors` and `manifest.json`, see `Manifest` |
| `live/` | what a run looks like now, see `live.Live`; `status.json` is a `LiveStatus` |
| `control.json` | {"command": one of `COMMANDS`} |
| `lock` | the process that holds the folder, see `lock` |
"""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, StrictInt, StrictStr, ValidationError

from unrender.core.checks import encode_text
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.core.text import printable, reason_of
from unrender.io import bounded_files
from unrender.rendering import parameter_errors
from unrender.rendering.parameter_errors import ErrorMeasure

# ---------------------------------------------------------------------- names of files

RECORD, METHOD, HISTORY, LOCK, CONTROL = "run.json", "method.toml", "history.jsonl", "lock", "control.json"
PARAMETERS, INITIAL, TRUTH, PICTURES = "parameters.npz", "initial.npz", "truth.npz", "pictures.npz"
SENSITIVITY, MESHES, LAST = "sensitivity.npz", "meshes.npz", "last.npz"
REPORT = "report.html"
CHECKPOINTS, STATE, MANIFEST = "checkpoints", "state.safetensors", "manifest.json"
LIVE, LIVE_STATUS, LIVE_START, LIVE_VIEWS = "live", "status.json", "start.npz", "views.npz"

COMMANDS = ("run", "pause", "stop")
"""What control.json may say."""

PICTURE_NAME = re.compile(r"view([0-9]{1,6})/(reference|initial|result|control_weight|pixel_probability)")
"""Of the arrays in pictures.npz, live/start.npz and live/views.npz."""

HISTORY_AXES = ("seconds", "samples")
"""Columns of the history that every record has, finite and never falling: seconds of optimization and paths traced so far."""
HISTORY_COLUMNS = (*HISTORY_AXES, "loss", "gradient_noise")
"""Columns that are numbers; the last two are null where a step was not finite or nothing is known yet. A record also has "step", from 0,
and may have "parameter_error", {key: see `Problem.parameter_error`}, and "resolution", {key: texels along each axis}."""

_Count = Annotated[StrictInt, Field(ge=0, lt=2**63)]
_Seconds = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
_Status = Literal["running", "finished", "interrupted", "failed", "worse than start", "memory disagrees"]

WORSE, MEMORY_DISAGREES = "worse than start", "memory disagrees"
DOUBTFUL = frozenset({WORSE, MEMORY_DISAGREES})
"""Statuses of runs that used up their budget, and that fresh pictures contradict."""
ENDED = DOUBTFUL | {"finished"}
"""Statuses of runs that used up their budget."""
NOT_VERIFIED = "not verified"
"""What is said of runs without `RunRecord.verification`."""


# ---------------------------------------------------------------------- run.json


class ProblemRecord(BaseModel):
    """What run.json says of the problem: keys of parameters, number of views, loss, and so on, for people.

    Attributes:
        fingerprint: see `problem.fingerprint`; None where it was not taken.
        origin: where the problem came from, see `Problem.origin`.
        measures: {key: how its error is measured}, see `ErrorMeasure.record`; without the plain ones.
    """

    model_config = ConfigDict(extra="allow")

    fingerprint: dict[StrictStr, StrictStr] | None = None
    origin: dict[StrictStr, Any] = {}
    measures: dict[StrictStr, Any] = {}

    def measure(self, key: str) -> ErrorMeasure:
        """Return how the error of a parameter is measured."""
        return parameter_errors.from_record(self.measures.get(key))

    @property
    def description(self) -> dict[str, Any]:
        """The fields that are for people."""
        return dict(self.model_extra or {})


class RunRecord(BaseModel):
    """run.json: what was run and how far it came; live/run.json is a part of it.

    Attributes:
        status: what the run does or how it ended.
        name: of the problem.
        method, settings: how it was run.
        choices, adapted: see `Result`.
        seed: of all random numbers.
        command: what was typed; "" for a run of the library.
        versions, hardware, variant: on what it ran.
        stopped: see `Result.stopped`; "" while the run goes on.
        steps, seconds, warmup_seconds, skipped, warnings: see `Result`.
        problem: what was to be recovered.
        resumed: the steps at which it was resumed.
        image_errors, undetermined, phases: see `Result`.
        standard_error: of each number, {key: one value per element}; see `Result`.
        verification: see `Result`; empty for runs that were not verified.
        error: the exception by which the run failed; "" for none.
    """

    model_config = ConfigDict(extra="ignore")

    status: _Status = "finished"
    name: StrictStr
    method: StrictStr
    settings: dict[StrictStr, Any] = {}
    choices: list[StrictStr] = []
    adapted: list[StrictStr] = []
    seed: Annotated[StrictInt, Field(ge=-(2**63), lt=2**63)] = 0
    command: StrictStr = ""
    versions: dict[StrictStr, Any] = {}
    hardware: dict[StrictStr, Any] = {}
    variant: StrictStr = ""
    stopped: StrictStr = ""
    steps: _Count = 0
    seconds: _Seconds = 0.0
    warmup_seconds: _Seconds = 0.0
    skipped: _Count = 0
    warnings: list[StrictStr] = []
    problem: ProblemRecord = ProblemRecord()
    resumed: list[_Count] = []
    image_errors: dict[StrictStr, tuple[_Seconds, _Seconds]] = {}
    undetermined: list[StrictStr] = []
    standard_error: dict[StrictStr, list[_Seconds]] = {}
    verification: dict[StrictStr, Any] = {}
    phases: dict[StrictStr, _Seconds] = {}
    error: StrictStr = ""

    @property
    def verified(self) -> str:
        """The status that fresh pictures give the run; "not verified" where none were rendered, as in folders of earlier versions."""
        found = self.verification.get("status")
        return found if found in ENDED else NOT_VERIFIED


# ---------------------------------------------------------------------- live/status.json


class LiveStatus(BaseModel):
    """live/status.json: where a run is now.

    Attributes:
        status: "running", "paused" or "ended".
        stopped: see `Result.stopped`; "" while the run goes on.
        step, steps: how many are done, and of how many; None without such a budget.
        seconds, budget_seconds: of optimization so far, and at most.
        loss, samples: of the last record of the history.
        skipped, warnings: see `Result`.
        control: the command that holds.
        process, host: who runs.
        update_seconds: what the last update of live/ took.
        initial_error: {key: root mean square error} before the first step.
        shapes: {key: shape} of the parameters, whose arrays in live/ may be smaller.
    """

    model_config = ConfigDict(extra="ignore")

    status: StrictStr
    stopped: StrictStr = ""
    step: _Count = 0
    steps: _Count | None = None
    seconds: _Seconds = 0.0
    budget_seconds: _Seconds | None = None
    loss: float | None = None
    samples: _Count = 0
    skipped: _Count = 0
    warnings: list[StrictStr] = []
    control: StrictStr = "run"
    process: Annotated[StrictInt, Field(gt=0, lt=2**31)] | None = None
    host: StrictStr = ""
    update_seconds: float = 0.0
    initial_error: dict[StrictStr, float] = {}
    shapes: dict[StrictStr, list[_Count]] = {}


# ---------------------------------------------------------------------- checkpoints/*/manifest.json


class Manifest(BaseModel):
    """manifest.json of a checkpoint.

    Attributes:
        format: of the checkpoint.
        step: how many steps were done.
        seed: the run's.
        size, sha256: of state.safetensors.
        versions: of what decides the numbers.
        problem: the problem's fingerprint.
        state: how the tensors are put together, see `state.py`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1]
    step: _Count
    seed: StrictInt
    size: _Count
    sha256: Annotated[StrictStr, Field(pattern=r"^[0-9a-f]{64}$")]
    versions: dict[StrictStr, StrictStr]
    problem: dict[StrictStr, StrictStr]
    state: Any


Model = TypeVar("Model", bound=BaseModel)


def validate(model: type[Model], given: Any, where: str) -> Model:
    """`given` as the model. Raises `InputError`: one line that begins with `where` and names the first field that does not suit."""
    try:
        return model.model_validate(given)
    except RecursionError as error:
        raise InputError(f"{where}: nested too deeply") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = printable(".".join(str(part) for part in first["loc"]))
        if first["type"] == "missing":
            hint = did_you_mean(name, map(printable, given)) if isinstance(given, dict) else ""
            raise InputError(f"{where}: {name} is missing{hint}") from error
        if first["type"] == "extra_forbidden":
            raise InputError(f"{where}: unknown field {name}") from error
        message = first["msg"].removeprefix("Input should be ")
        field = f"{name}: " if first["loc"] else ""
        raise InputError(f"{where}: {field}expected {message}, got {printable(repr(first['input']))}") from error


def encode(model: type[BaseModel], given: Any, where: str) -> bytes:
    """Return the bytes of a JSON file that the reader takes as the model.

    Raises:
        InputError: the reader would refuse them; one line that begins with `where` and names the field.
    """
    try:
        data = encode_text(json.dumps(given, indent=2, ensure_ascii=False) + "\n", where)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{where}: cannot be written as JSON: {reason_of(error, 200)}") from error
    if len(data) > bounded_files.LARGEST_JSON:
        raise InputError(f"{where}: larger than {bounded_files.LARGEST_JSON >> 20} MiB, which no reader takes")
    validate(model, bounded_files.parse_object(data.decode(), where), where)
    return data


def serialize(record: BaseModel) -> dict[str, Any]:
    """The fields that were given to a model made by `model_construct`, in the model's order, as they were given."""
    return record.model_dump(exclude_unset=True, warnings=False)
