"""Making a component, such as a loss, from its name and its options as text files give them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from unrender import losses, preconditioners
from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

LOSSES: dict[str, type] = {
    "L1": losses.L1,
    "L2": losses.L2,
    "RelativeL2": losses.RelativeL2,
    "Huber": losses.Huber,
    "Perceptual": losses.Perceptual,
}
PRECONDITIONERS: dict[str, type] = {"LargeSteps": preconditioners.LargeSteps}


def make(kinds: Mapping[str, type], description: Any) -> Any:
    """The component that `description` names: "L1", or {"type": "Huber", "delta": 0.1}.

    Args:
        kinds: the dataclasses to choose from, by name.
        description: a name, or a mapping with "type" and the options of that dataclass.

    Raises:
        InputError: an unknown name or option (with the nearest known one), a missing option, a value out of range.
    """
    known = " or ".join(f'"{name}"' for name in kinds)
    options = {"type": description} if isinstance(description, str) else description
    if not isinstance(options, Mapping) or not isinstance(options.get("type"), str):
        table = f'{{ type = "{next(iter(kinds))}" }}'
        raise InputError(f"expected {known}, or a table such as {table}, got {description!r}")
    name = options["type"]
    if name not in kinds:
        hint = did_you_mean(name, kinds) or did_you_mean(name.lower(), [kind.lower() for kind in kinds])
        same = [kind for kind in kinds if kind.lower() == name.lower()]
        hint = f"; did you mean {same[0]}?" if same else hint
        raise InputError(f'expected {known}, got "{name}"{hint}')
    kind = kinds[name]
    fields = {field.name: field for field in dataclasses.fields(kind)}
    given = {key: value for key, value in options.items() if key != "type"}
    for key in given:
        if key not in fields:
            has = f"it has {', '.join(fields)}" if fields else "it has none"
            raise InputError(f"{name} has no option {key}{did_you_mean(key, fields) or f'; {has}'}")
    for key, field in fields.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and key not in given:
            raise InputError(f"{name} needs {key}")
    try:
        return kind(**given)
    except TypeError as error:
        raise InputError(f"{name}: a value of the wrong type: {error}") from error
