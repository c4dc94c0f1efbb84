"""run.json, as far as a run that goes on reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
from pydantic import BaseModel, ConfigDict, Field, StrictInt, StrictStr

from unrender.io import files
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

FILE = "run.json"
_LONGEST = 1 << 26
_Time = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Described(BaseModel):
    """What run.json says of the problem."""

    model_config = ConfigDict(extra="allow")

    fingerprint: dict[StrictStr, StrictStr] | None = None
    origin: dict[StrictStr, Any] = {}


class Record(BaseModel):
    """run.json. Fields beyond these are ignored."""

    model_config = ConfigDict(extra="ignore")

    status: Literal["running", "finished", "interrupted", "failed"] = "finished"
    name: StrictStr
    method: StrictStr
    settings: dict[StrictStr, Any] = {}
    command: StrictStr = ""
    variant: StrictStr = ""
    steps: Annotated[StrictInt, Field(ge=0)] = 0
    seconds: _Time = 0.0
    warmup_seconds: _Time = 0.0
    problem: Described = Described()
    resumed: list[Annotated[StrictInt, Field(ge=0)]] = []


def read(folder: Path) -> Record:
    """The record of a run folder. Raises `InputError` where there is none, that names the field."""
    path = folder / FILE
    if not folder.is_dir():
        pair_request = [p.name for p in folder.parent.iterdir() if p.is_dir()] if folder.parent.is_dir() else []
        what = "a file, expected a run folder" if folder.exists() else "no such run folder"
        raise InputError(f"{folder}: {what}{did_you_mean(folder.name, pair_request)}")
    if not path.is_file():
        raise InputError(f"{folder}: not a run folder: {FILE} is missing")
    found = files.parse_json(files.read_bytes(path, _LONGEST), str(path))
    try:
        return Record.model_validate(found)
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"]) or FILE
        raise InputError(f"{path}: {field[:80]}: {first['msg'].lower()}, got {repr(first['input'])[:60]}") from error
    except RecursionError as error:
        raise InputError(f"{path}: nested too deeply") from error
