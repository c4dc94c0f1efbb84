"""method.toml: plan and options of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, StrictStr

from unrender.io import bounded_files, toml_lines
from unrender.runs.folder import schema
from unrender.runs.run import Run

_LONGEST = 1 << 20
_Positive = Annotated[StrictInt, Field(ge=1)]
_Seconds = Annotated[StrictFloat | Annotated[StrictInt, Field(lt=1 << 63)], Field(gt=0, allow_inf_nan=False)]


class Method(BaseModel):
    """Contents of method.toml.

    Attributes:
        name: name of the method; "" for none.
        checkpoint_every, final_spp: see `optimize` and `RunAnnotations`.
        estimator, optimizer, other_starts, settings: See `Plan.table`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: StrictStr = ""
    steps: _Positive | None = None
    seconds: _Seconds | None = None
    seed: StrictInt
    checkpoint_every: _Positive | None = None
    final_spp: _Positive | None = None
    threads: _Positive | None = None
    estimator: dict[StrictStr, Any] | StrictStr
    optimizer: dict[StrictStr, Any] | StrictStr
    other_starts: list[StrictStr] = Field(default_factory=list)
    settings: dict[StrictStr, dict[StrictStr, Any]] = Field(default_factory=dict)


def serialize(run: Run, name: str, checkpoint_every: int | None, final_spp: int | None) -> dict[str, Any]:
    """Return the contents of method.toml for a run."""
    contents = {
        "name": name,
        "steps": run.steps,
        "seconds": run.seconds,
        "seed": run.seed,
        "checkpoint_every": checkpoint_every,
        "final_spp": final_spp,
        "threads": dr.thread_count(),
        **run.plan.table(),
    }
    return {key: value for key, value in contents.items() if value is not None}


def read(path: Path) -> Method:
    """Read the file. Raises `InputError` that names the field."""
    return _parse(bounded_files.read_text(path, _LONGEST, path.parent), path)


def encode(method: Mapping[str, Any], path: Path) -> bytes:
    """Return the bytes of the file for the result of `serialize`. Raises `InputError` if `read` would reject them."""
    text = "# The run: its method, budget and seed\n" + tomli_w.dumps(dict(method))
    data = toml_lines.encode(text, str(path))
    _parse(text, path)
    return data


def _parse(text: str, path: Path) -> Method:
    return schema.validate(Method, toml_lines.parse(text, str(path)), str(path))
