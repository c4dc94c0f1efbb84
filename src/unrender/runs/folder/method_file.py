"""method.toml: the estimator, the optimizer and the options of a run, and the two components made again from their tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import pydantic
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, StrictStr

from unrender.core import tables
from unrender.core.errors import InputError
from unrender.estimators.base import Estimator
from unrender.io import bounded_files, toml_lines
from unrender.optimizers.base import Optimizer
from unrender.runs.run import Run

__all__ = ["Method", "Parts", "encode", "parts", "read", "serialize"]

_LONGEST = 1 << 20
_Positive = Annotated[StrictInt, Field(ge=1)]
_Seconds = Annotated[StrictFloat | StrictInt, Field(gt=0, allow_inf_nan=False)]


class Method(BaseModel):
    """method.toml.

    Attributes:
        name: of the method; "" for none.
        steps, seconds: the budget.
        seed: of the run.
        checkpoint_every, final_spp: see `optimize` and `RunAnnotations`.
        threads: that the run had.
        estimator, optimizer: tables, see `core.tables`; the reason, as text, where they cannot be stored.
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


@dataclass(frozen=True)
class Parts:
    """The two components that a run is made of."""

    estimator: Estimator
    optimizer: Optimizer


def serialize(run: Run, name: str, checkpoint_every: int | None, final_spp: int | None) -> dict[str, Any]:
    """The contents of method.toml for a run."""
    found = {
        "name": name,
        "steps": run.steps,
        "seconds": run.seconds,
        "seed": run.seed,
        "checkpoint_every": checkpoint_every,
        "final_spp": final_spp,
        "threads": dr.thread_count(),
        "estimator": _table(run.estimator),
        "optimizer": _table(run.optimizer),
    }
    return {key: value for key, value in found.items() if value is not None}


def read(path: Path) -> Method:
    """Read the file. Raises `InputError` that names the field."""
    return _parse(bounded_files.read_text(path, _LONGEST, path.parent), path)


def encode(method: Mapping[str, Any], path: Path) -> bytes:
    """Return the bytes of the file that `serialize` describes. Raises `InputError` where `read` would refuse them."""
    text = "# The run: its method, budget and seed\n" + tomli_w.dumps(dict(method))
    data = toml_lines.encode(text, str(path))
    _parse(text, path)
    return data


def _parse(text: str, path: Path) -> Method:
    found = toml_lines.parse(text, str(path))
    try:
        return Method.model_validate(found)
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"][:1]) or "the file"
        raise InputError(f"{path}: {field[:80]}: {first['msg'].lower()}, got {repr(first['input'])[:60]}") from error


def parts(method: Method, path: Path, estimator: Estimator | None, optimizer: Optimizer | None) -> Parts:
    """The components that method.toml describes, or those given in their place. Raises `InputError`."""

    def made(name: str, given: Any, words: Mapping[str, Any] | str) -> Any:
        if given is not None:
            return given
        if isinstance(words, str):
            raise InputError(f"{path}: {name}: {words}; hand it in: unrender.resume(..., {name}=...)")
        return tables.component(words, where=f"{path}: {name}")

    found = Parts(made("estimator", estimator, method.estimator), made("optimizer", optimizer, method.optimizer))
    for name, value, asked in (("estimator", found.estimator, "estimate"), ("optimizer", found.optimizer, "update")):
        if not callable(getattr(value, asked, None)):
            raise InputError(f"{path}: {name}: {type(value).__name__} is no {name}")
    return found


def _table(component: Any) -> dict[str, Any] | str:
    try:
        return tables.table(component)
    except tables.NotStorable as error:
        return f"it cannot be made again from a file ({error})"
