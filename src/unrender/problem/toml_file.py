"""Problems as TOML files.

    name = "wall"
    scene = "room.xml"
    max_depth = 6
    loss = "L1"                                # or { type = "Huber", delta = 0.1 }, { type = "Perceptual", weights = "vgg16.safetensors" }

    [[parameters]]
    key = "wall.bsdf.reflectance.data"
    initial = 0.5                              # a number, a colour [r, g, b], a picture, a grid (.vol), an array (.npy, .npz)
    bounds = [0.0, 1.0]                        # inf and -inf are open
    learning_rate = 0.01
    preconditioner = { type = "LargeSteps", strength = 10.0 }
    coarse_to_fine = [200, 400]                # steps before which the resolution doubles, see CoarseToFine
    parameterisation = "logit"                 # what the optimizer moves: identity, log, logit, softplus
    truth = "wall.exr"                         # where it is known, to measure the error

    [[views]]
    reference = "photo.exr"
    sensor = 0
    weight = 1.0
    mask = "mask.png"

Paths are relative to the file. Only `scene`, `key` and `reference` are required.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pydantic
from pydantic import BaseModel, ConfigDict, Field, StrictFloat, StrictInt, StrictStr

from unrender.core import tables
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.io import bounded_files, toml_lines
from unrender.io.toml_lines import tomllib
from unrender.problem import coarse_to_fine
from unrender.problem.errors import FieldError, Place, dotted
from unrender.problem.parameter import Parameter
from unrender.problem.problem import Problem
from unrender.problem.view import View

__all__ = ["read"]

_Number = StrictFloat | StrictInt


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Parameter(_Model):
    key: StrictStr = Field(description='the name of a scene parameter, such as "wall.bsdf.reflectance.value"')
    initial: _Number | StrictStr | list[Any] | None = Field(
        None, description="a number, a colour [r, g, b], or the path of a picture, .vol, .npy or .npz file"
    )
    bounds: tuple[_Number, _Number] | None = Field(None, description="two numbers [low, high] (inf is open)")
    learning_rate: _Number | None = Field(None, description="a number above 0")
    preconditioner: StrictStr | dict[str, Any] | None = Field(
        None, description='a table such as { type = "LargeSteps", strength = 10.0 }'
    )
    coarse_to_fine: list[StrictInt] | dict[str, Any] | None = Field(
        None,
        description='a list of steps such as [200, 400], or a table such as { steps = [200, 400], states = "reset" }',
    )
    parameterisation: StrictStr | dict[str, Any] | None = Field(
        None,
        description='"identity", "log", "logit", "softplus" or, with a scale, "softplus(0.1)"',
    )
    truth: _Number | StrictStr | list[Any] | None = Field(
        None, description="a number, a colour [r, g, b], or the path of a picture, .vol, .npy or .npz file"
    )


class _View(_Model):
    reference: StrictStr = Field(description="the path of a picture (.exr, .hdr, .png, .jpg, .npy)")
    sensor: StrictInt = Field(0, description="the index of a sensor of the scene, from 0")
    weight: _Number = Field(1.0, description="a number above 0")
    mask: StrictStr | None = Field(None, description="the path of a picture with values from 0 to 1")


class _Problem(_Model):
    scene: StrictStr = Field(description="the path of a Mitsuba .xml file")
    parameters: list[_Parameter] = Field(description="at least one [[parameters]] table", min_length=1)
    views: list[_View] = Field(description="at least one [[views]] table", min_length=1)
    name: StrictStr | None = Field(None, description="a string of at most 200 characters", max_length=200)
    max_depth: StrictInt = Field(6, description="a whole number of at least 1")
    loss: StrictStr | dict[str, Any] = Field(
        "L2", description='a name such as "L1", or a table such as { type = "Huber", delta = 0.1 }'
    )


def read(path: str | Path) -> Problem:
    """The problem that a TOML file describes.

    Raises:
        InputError: "problem.toml:12: parameters[0].bounds: ...": the file, the line, the field, what was expected.
    """
    file = Path(path)
    text = bounded_files.read_text(file, toml_lines.LARGEST).replace("\r\n", "\n")
    try:
        model = _Problem.model_validate(_parse(file, text))
        problem = _build(model, file)
        problem.origin["file"] = str(file.resolve())
        return problem
    except pydantic.ValidationError as error:
        # An unknown field first: where its name is misspelt, the right one is missing too.
        details = sorted(error.errors(), key=lambda detail: detail["type"] != "extra_forbidden")
        raise InputError(_message(file, text, *_explain(details[0]))) from error
    except FieldError as error:
        place = error.place
        if place[0] == "truth":  # in a file it stands with the parameter
            keys = [parameter.key for parameter in model.parameters]
            place = ("parameters", keys.index(str(place[1])), "truth")
        raise InputError(_message(file, text, place, error.what)) from error


def _message(file: Path, text: str, place: Place, what: str) -> str:
    return f"{file}:{toml_lines.find(text, place)}: {dotted(place)}: {what}"


def _parse(file: Path, text: str) -> dict[str, Any]:
    toml_lines.check(text, str(file))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        head, _, tail = message.rpartition(" (at ")
        line, _, column = tail.rstrip(")").removeprefix("line ").partition(", ")
        where = f"{file}:{line}: not valid TOML: {head} ({column})"
        if not line.isdigit():
            where = f"{file}:{text.rstrip().count(chr(10)) + 1}: not valid TOML: {message}"
        raise InputError(where) from error
    except RecursionError as error:
        raise InputError(f"{file}: not valid TOML: nested too deeply") from error
    except ValueError as error:
        raise InputError(f"{file}: not valid TOML: {str(error)[:200]}") from error


def _build(model: _Problem, file: Path) -> Problem:
    folder = file.parent
    try:
        loss = tables.component(model.loss, "loss", folder=folder)
    except InputError as error:
        raise FieldError(("loss",), str(error)) from error
    return Problem(
        folder / model.scene,
        [_parameter(index, parameter, folder) for index, parameter in enumerate(model.parameters)],
        [
            View(folder / view.reference, view.sensor, view.weight, None if view.mask is None else folder / view.mask)
            for view in model.views
        ],
        loss,
        model.max_depth,
        truth={p.key: _value(p.truth, folder) for p in model.parameters if p.truth is not None},
        name=model.name or file.stem,
    )


def _parameter(index: int, model: _Parameter, folder: Path) -> Parameter:
    preconditioner = None
    if model.preconditioner is not None:
        try:
            preconditioner = tables.component(model.preconditioner, "preconditioner", folder=folder)
        except InputError as error:
            raise FieldError(("parameters", index, "preconditioner"), str(error)) from error
    way = None
    if model.coarse_to_fine is not None:
        try:
            way = coarse_to_fine.of(model.coarse_to_fine)
        except InputError as error:
            raise FieldError(("parameters", index, "coarse_to_fine"), str(error)) from error
    start = _value(model.initial, folder)
    return Parameter(model.key, start, model.bounds, model.learning_rate, preconditioner, way, model.parameterisation)


def _value(value: Any, folder: Path) -> Any:
    return folder / value if isinstance(value, str) else value


def _explain(detail: Any) -> tuple[Place, str]:
    """The place and the message of one of pydantic's errors."""
    place, model = _field(detail["loc"])
    fields = model.model_fields
    name = place[-1] if place else ""
    if detail["type"] == "extra_forbidden":
        names = ", ".join(fields)
        return place, f"no such field{did_you_mean(str(name), fields) or f'; there are {names}'}"
    expected = fields[str(name)].description if name in fields else "a table"
    if detail["type"] == "missing" and len(detail["loc"]) == len(place):
        return place, f"missing, expected {expected}"
    got = repr(detail["input"])
    return place, f"expected {expected}, got {got if len(got) <= 80 else got[:77] + '...'}"


def _field(location: tuple[int | str, ...]) -> tuple[Place, type[_Model]]:
    """The place of the field that an error is about, without pydantic's own additions about unions and tuples, and the
    model that the field belongs to."""
    inner = {"parameters": _Parameter, "views": _View}
    if len(location) >= 2 and location[0] in inner and isinstance(location[1], int):
        return location[:3], inner[str(location[0])]
    return location[:1], _Problem
