"""Problems as TOML files.

    name = "wall"
    scene = "room.xml"
    max_depth = 6                              # default: that of the scene's integrator
    loss = "L1"                                # or { type = "Huber", delta = 0.1 }

    [expressions]
    "lamp.intensity.value" = "2 * strength"    # a parameter as a function of unknowns that the scene does not have

    [[parameters]]
    key = "wall.bsdf.reflectance.data"         # or keys = [...] for parameters that share one value; { "a" = 1, "b" = 0.5 } for factors
    initial = 0.5                              # a number, a colour [r, g, b], an image, a grid (.vol), a mesh, an array (.npy)
    bounds = [0.0, 1.0]                        # inf and -inf are unbounded
    learning_rate = 0.01
    preconditioner = { type = "LargeSteps", strength = 10.0 }
    coarse_to_fine = [200, 400]                # steps at which the resolution doubles, see CoarseToFine
    parameterisation = "log"                   # variable of the optimizer: identity or log
    prior = { total_variation = 0.1 }          # what is known of the values beforehand
    truth = "wall.exr"                         # true value, if known, to measure the error

    [[views]]
    reference = "photo.exr"
    sensor = 0
    weight = 1.0
    mask = "mask.png"
    with = { "lamp.intensity.value" = 0 }      # values of known parameters in this view alone
    scene = "room-2.xml"                       # another scene that this view is of
    aov = "depth"                              # what the reference has in place of colour

Paths are relative to the file. Only `scene`, `key` (or `keys`) and `reference` are required.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, StrictFloat, StrictInt, StrictStr

from unrender.core import checks, lazy
from unrender.io import bounded_files, confinement, toml_lines
from unrender.io.toml_lines import FieldError, Table
from unrender.rendering import AOVS

if TYPE_CHECKING:
    from unrender.core import tables
    from unrender.scene import coarse_to_fine, parameter, references
    from unrender.scene import problem as problems
else:  # fields are checked without Dr.Jit
    tables, coarse_to_fine, parameter = lazy.modules("core.tables", "scene.coarse_to_fine", "scene.parameter")
    references, problems = lazy.modules("scene.references", "scene.problem")

_Number = StrictFloat | StrictInt


class _Parameter(Table):
    key: StrictStr = Field(
        "", description='the name of a scene parameter, such as "wall.bsdf.reflectance.value"; with keys, any name'
    )
    keys: list[StrictStr] | dict[str, _Number] | None = Field(
        None, description='scene parameters that share one value, such as ["a.value", "b.value"], or factors by key'
    )
    initial: _Number | StrictStr | list[Any] | None = Field(
        None, description="a number, a colour [r, g, b], or the path of a picture, .vol, mesh, .npy or .npz file"
    )
    bounds: tuple[_Number, _Number] | None = Field(None, description="two numbers [low, high] (inf is unbounded)")
    learning_rate: _Number | None = Field(None, description="a number above 0")
    preconditioner: StrictStr | dict[str, Any] | None = Field(
        None, description='a table such as { type = "LargeSteps", strength = 10.0 }'
    )
    coarse_to_fine: list[StrictInt] | dict[str, Any] | None = Field(
        None,
        description='a list of steps such as [200, 400], or a table such as { steps = [200, 400], states = "reset" }',
    )
    parameterisation: StrictStr | dict[str, Any] | None = Field(None, description='"identity" or "log"')
    regularizer: dict[str, Any] | None = Field(
        None, description="for vertex positions, a table such as { bilaplacian = 0.001, edges = 0.001 }"
    )
    prior: dict[str, Any] | None = Field(
        None, description="a table such as { smoothness = 0.05 } or { near = [0.5, 0.5, 0.5], std = 0.1 }"
    )
    remeshing: list[StrictInt] | dict[str, Any] | None = Field(
        None,
        description='for vertex positions, a list of steps such as [100], or a table such as { steps = [100], method = "subdivide" }',
    )
    self_intersection: Literal["warn", "prevent", "ignore"] = Field(
        "warn", description='for vertex positions, "warn", "prevent" or "ignore"'
    )
    truth: _Number | StrictStr | list[Any] | None = Field(
        None, description="a number, a colour [r, g, b], or the path of a picture, .vol, mesh, .npy or .npz file"
    )


class _View(Table):
    reference: StrictStr = Field(description="the path of a picture (.exr, .hdr, .png, .jpg, .npy)")
    sensor: StrictInt = Field(0, description="the index of a sensor of the scene, from 0")
    weight: _Number = Field(1.0, description="a number above 0")
    mask: StrictStr | None = Field(None, description="the path of a picture with values from 0 to 1")
    known: dict[str, _Number | StrictStr | list[Any]] | None = Field(
        None, alias="with", description='a table of values by key in quotes, such as { "lamp.intensity.value" = 0 }'
    )
    scene: StrictStr | None = Field(None, description="the path of a Mitsuba .xml file")
    aov: StrictStr | None = Field(None, description=f"one of {', '.join(AOVS)}")


class _Problem(Table):
    scene: StrictStr = Field(description="the path of a Mitsuba .xml file")
    parameters: list[_Parameter] = Field(description="at least one [[parameters]] table", min_length=1)
    views: list[_View] = Field(description="at least one [[views]] table", min_length=1)
    name: StrictStr | None = Field(None, description="a string of at most 200 characters", max_length=200)
    max_depth: StrictInt | None = Field(None, description="a whole number of at least 1")
    expressions: dict[str, StrictStr] | None = Field(
        None, description='a table of texts by key of the scene, such as { "lamp.intensity.value" = "2 * strength" }'
    )
    loss: StrictStr | dict[str, Any] = Field(
        "L2", description='a name such as "L1", or a table such as { type = "Huber", delta = 0.1 }'
    )


TABLES: dict[str, type[Table]] = {"": _Problem, "parameters": _Parameter, "views": _View}
"""Models of a problem file's tables, by name; "" is the file itself."""


def read(path: str | Path, partial: bool = False) -> problems.Problem:
    """Return the problem of a TOML file. Raises `InputError`, "problem.toml:12: parameters[0].bounds: ...", with the expected value."""
    file = checks.path("problem", path, "a problem file")
    model, text = _read_model(file)
    try:
        with confinement.within(file.parent):
            problem = _build(model, file, partial)
        return problem.with_parts(origin={**problem.origin, "file": str(file.resolve())})
    except FieldError as error:
        place = error.place
        if place[0] == "truth":  # a file lists it with the parameter
            keys = [parameter.key or next(iter(parameter.keys or [""])) for parameter in model.parameters]
            place = ("parameters", keys.index(str(place[1])), "truth")
        raise toml_lines.error_at(file, text, place, error.what) from error


def check(path: str | Path) -> None:
    """Raise the `InputError` of `read` for fields that are not as expected, or a scene that is not there, without opening the scene."""
    file = Path(path)
    model, text = _read_model(file)
    scene = file.parent / model.scene
    if not scene.exists():
        raise toml_lines.error_at(file, text, ("scene",), f"{scene}: {bounded_files.no_file(scene)}")


def _read_model(file: Path) -> tuple[_Problem, str]:
    return toml_lines.read(file, _Problem, {"parameters": _Parameter, "views": _View})


def _build(model: _Problem, file: Path, partial: bool) -> problems.Problem:
    folder = file.parent
    with FieldError.at(("loss",)):
        loss = tables.component(model.loss, "loss", folder=folder)
    parameters = [_parameter(index, parameter, folder) for index, parameter in enumerate(model.parameters)]
    truths = zip(parameters, [parameter.truth for parameter in model.parameters], strict=True)
    return problems.Problem(
        folder / model.scene,
        parameters,
        [_view(view, folder) for view in model.views],
        loss,
        model.max_depth,
        truth={p.key: _value(truth, folder) for p, truth in truths if truth is not None},
        name=model.name or file.stem,
        expressions=model.expressions,
        partial=partial,
    )


def _view(model: _View, folder: Path) -> references.View:
    known = None if model.known is None else {key: _value(value, folder) for key, value in model.known.items()}
    mask, scene = (None if name is None else folder / name for name in (model.mask, model.scene))
    return references.View(folder / model.reference, model.sensor, model.weight, mask, known, scene, model.aov)


def _parameter(index: int, model: _Parameter, folder: Path) -> parameter.Parameter:
    if not model.key and not model.keys:
        raise FieldError(
            ("parameters", index, "key"), "missing, expected the name of a scene parameter, or several names as keys"
        )
    own = {name: value for name, value in model if name != "truth"}
    conversions = {
        "preconditioner": lambda value: tables.component(value, "preconditioner", folder=folder),
        "coarse_to_fine": coarse_to_fine.of,
    }
    for name, convert in conversions.items():
        if own[name] is not None:
            with FieldError.at(("parameters", index, name)):
                own[name] = convert(own[name])
    return parameter.Parameter(**own | {"initial": _value(model.initial, folder)})


def _value(value: Any, folder: Path) -> Any:
    return folder / value if isinstance(value, str) else value
