"""Files of a run folder: their names, and the models of the JSON files.

A run writes what these models describe, and `reader` checks its input against them. Unknown fields are ignored.

| file | contents |
|---|---|
| `report.html` | the page: result and reference under a slider, errors, curves, settings; one file, no network |
| `run.json` | `RunRecord`: status, verification, settings, seed, versions, hardware, warnings, plan of `auto` (`choices`, `adapted`) |
| `method.toml` | `method_file.Method`: the method in full |
| `problem.toml`, `problem/` | the problem in full, see `scene.serialization` |
| `history.jsonl` | one JSON object per step, see `HISTORY_COLUMNS` |
| `parameters.npz`, `initial.npz`, `truth.npz` | {key: array}, float32: the best verified, the initial, and the known true values |
| `last.npz` | {key: array} after the last step, if `parameters.npz` contains better ones of an earlier step |
| `pictures.npz` | {"view0/reference": (H, W, 3), ...}, linear: `reference`, `initial`, `result`, `control_weight`; `mask`, (H, W) |
| `sensitivity.npz` | {key: array}: change of the images per unit of each element; where it is small, the value is noise or smoothing |
| `standard_error.npz`, `data_share.npz` | {key: array} of textures: how certain each element is, see `Result` |
| `meshes.npz`, `meshes/` | see `meshes.arrays_of`; PLY and OBJ files of the recovered meshes |
| `checkpoints/00000050/` | `state.safetensors` and `manifest.json`, see `Manifest`; the last three are kept |
| `live/` | current state of a run, see `live.Live`; `status.json` is a `LiveStatus` |
| `control.json` | {"command": one of `COMMANDS`} |
| `lock` | the process that holds the folder, see `lock` |

| number | meaning |
|---|---|
| `seconds` | time of the steps alone, without compilation (`warmup_seconds`), checkpoints and reports |
| `loss` | loss of the step's own noisy image; compare methods by image and parameter errors |
| `gradient_noise` | share of noise in the gradient's energy; near 1 a descent has converged, or needs more samples |
| `image_errors` | RMS difference of the converged picture from its reference, ± standard error, without the rendering's noise |
| `parameter_error` | RMS difference from the truth; degrees for normals and directions; distance between surfaces for meshes |
"""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, StrictInt, StrictStr, ValidationError

from unrender.core.checks import encode_text
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, printable, reason_of
from unrender.io import bounded_files
from unrender.rendering import parameter_errors
from unrender.rendering.parameter_errors import ErrorMeasure

# ---------------------------------------------------------------------- names of files

RECORD, METHOD, HISTORY, LOCK, CONTROL = "run.json", "method.toml", "history.jsonl", "lock", "control.json"
PARAMETERS, INITIAL, TRUTH, PICTURES = "parameters.npz", "initial.npz", "truth.npz", "pictures.npz"
SENSITIVITY, MESHES, LAST = "sensitivity.npz", "meshes.npz", "last.npz"
STANDARD_ERROR, DATA_SHARE = "standard_error.npz", "data_share.npz"
REPORT = "report.html"
CHECKPOINTS, STATE, MANIFEST = "checkpoints", "state.safetensors", "manifest.json"
LIVE, LIVE_STATUS, LIVE_START, LIVE_VIEWS = "live", "status.json", "start.npz", "views.npz"

COMMANDS = ("run", "pause", "stop")
"""Commands of control.json."""

PICTURE_NAME = re.compile(r"view([0-9]{1,6})/(reference|initial|result|control_weight|pixel_probability|mask)")
"""Names of the arrays in pictures.npz, live/start.npz and live/views.npz."""

HISTORY_AXES = ("seconds", "samples")
"""Columns that every record has, finite and never decreasing: seconds of optimisation and paths traced so far."""
HISTORY_COLUMNS = (*HISTORY_AXES, "loss", "gradient_noise")
"""Numeric columns.

The last two are null if a step was not finite or they are unknown. A record also has "step", from 0, and may have "parameter_error",
{key: see `Problem.parameter_error`}, "resolution", {key: texels along each axis}, and "faces", {key: number of triangles}.
"""

_Count = Annotated[StrictInt, Field(ge=0, lt=2**63)]
_Seconds = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
_Status = Literal[
    "running", "finished", "interrupted", "failed", "worse than start", "memory disagrees", "does not fit"
]

WORSE, MEMORY_DISAGREES, MISFIT = "worse than start", "memory disagrees", "does not fit"
DOUBTFUL = frozenset({WORSE, MEMORY_DISAGREES, MISFIT})
"""Statuses of runs that used up their budget, but that new images contradict."""
ENDED = DOUBTFUL | {"finished"}
"""Statuses of runs that used up their budget."""
NOT_VERIFIED = "not verified"
"""Status of runs without `RunRecord.verification`."""


# ---------------------------------------------------------------------- run.json


class ProblemRecord(BaseModel):
    """Description of the problem in run.json: keys of parameters, number of views, loss and others, for display.

    Attributes:
        fingerprint: see `scene.fingerprint`; None if not computed.
        origin: origin of the problem, see `Problem.origin`.
        measures: {key: error measure}, see `ErrorMeasure.record`; without the default ones.
    """

    model_config = ConfigDict(extra="allow")

    fingerprint: dict[StrictStr, StrictStr] | None = None
    origin: dict[StrictStr, Any] = {}
    measures: dict[StrictStr, Any] = {}

    def measure(self, key: str) -> ErrorMeasure:
        return parameter_errors.from_record(self.measures.get(key))

    @property
    def description(self) -> dict[str, Any]:
        """Fields for display."""
        return dict(self.model_extra or {})


class RunRecord(BaseModel):
    """run.json: the run and its progress; live/run.json contains a part of it.

    Attributes:
        status: activity of the run, or how it ended.
        choices, adapted: see `Result`.
        seed: seed of all random numbers.
        command: the command line; "" for a run of the library.
        stopped: see `Result.stopped`; "" while it runs.
        steps, seconds, warmup_seconds, skipped, warnings: see `Result`.
        image_errors, undetermined, without_errors, phases: see `Result`.
        standard_error: standard errors of each number, {key: one value per element}, None for infinite; see `Result`.
        verification: see `Result`; empty for runs that were not verified.
        misfit: "error", "share" (None if infinite) and "causes" of `Result.misfit`; empty without one.
        error: exception by which the run failed; "" for none.
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
    without_errors: list[StrictStr] = []
    standard_error: dict[StrictStr, list[_Seconds | None]] = {}
    verification: dict[StrictStr, Any] = {}
    misfit: dict[StrictStr, Any] = {}
    phases: dict[StrictStr, _Seconds] = {}
    error: StrictStr = ""

    @property
    def verified(self) -> str:
        """Status of the run according to new images; "not verified" if none were rendered, as in folders of earlier versions."""
        status = self.verification.get("status")
        return status if isinstance(status, str) and status in ENDED else NOT_VERIFIED


# ---------------------------------------------------------------------- live/status.json


class LiveStatus(BaseModel):
    """live/status.json: current state of a run.

    Attributes:
        status: "running", "paused" or "ended".
        stopped: see `Result.stopped`; "" while it runs.
        step, steps: number of completed steps, and their total; None without such a budget.
        seconds, budget_seconds: seconds of optimisation so far, and their limit.
        loss, samples: from the last record of the history.
        skipped, warnings: see `Result`.
        control: current command.
        process, host: process of the run.
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
    initial_error: dict[StrictStr, float] = {}
    shapes: dict[StrictStr, list[_Count]] = {}


# ---------------------------------------------------------------------- checkpoints/*/manifest.json


class Manifest(BaseModel):
    """manifest.json of a checkpoint.

    Attributes:
        step: number of completed steps.
        size, sha256: those of state.safetensors.
        versions: versions of the software on which the numbers depend.
        state: structure of the tensors, see `state.py`.
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


def validate(model: type[Model], content: Any, where: str) -> Model:
    """Validate a value against a model. Raises `InputError`: one line that begins with `where` and names the first invalid field."""
    try:
        return model.model_validate(content)
    except RecursionError as error:
        raise InputError(f"{where}: nested too deeply") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = printable(".".join(str(part) for part in first["loc"]))
        if first["type"] == "missing":
            hint = did_you_mean(name, map(printable, content)) if isinstance(content, dict) else ""
            raise InputError(f"{where}: {name} is missing{hint}") from error
        if first["type"] == "extra_forbidden":
            raise InputError(f"{where}: unknown field {name}") from error
        message = first["msg"].removeprefix("Input should be ")
        field = f"{name}: " if first["loc"] else ""
        raise InputError(f"{where}: {field}expected {message}, got {printable(repr(first['input']))}") from error


def encode(model: type[BaseModel], content: Any, where: str) -> bytes:
    """Return the bytes of a JSON file. Raises `InputError`, a line with `where` and the field, if the reader would reject them."""
    try:
        data = encode_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", where)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{where}: cannot be written as JSON: {reason_of(error, 200)}") from error
    if len(data) > bounded_files.LARGEST_JSON:
        raise InputError(f"{where}: larger than {bounded_files.LARGEST_JSON >> 20} MiB, which no reader takes")
    validate(model, bounded_files.parse_object(data.decode(), where), where)
    return data


def serialize(record: BaseModel) -> dict[str, Any]:
    """Return the fields that were passed to `model_construct`, in the model's order, unchanged."""
    return record.model_dump(exclude_unset=True, warnings=False)
