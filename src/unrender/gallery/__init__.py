"""Gallery: problems made by code, with known true values; looked up by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from unrender.core import registry
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.text import did_you_mean
from unrender.display import notebook
from unrender.gallery import fields
from unrender.gallery.fields import Option
from unrender.gallery.specification import ProblemSource, build_problem
from unrender.gallery.sunlit import photographs
from unrender.scene.problem import Problem

__all__ = ["Option", "names", "options", "photographs", "problem", "summary"]

_KIND = "gallery problem"


def names() -> list[str]:
    """Return the names of all registered problems, in the order of the gallery."""
    return list(registry.components(_KIND))


def summary(name: str) -> str:
    """Return one line: what is recovered, and from what. Raises `InputError` for an unknown name."""
    return (_specification(name).__doc__ or "").split("\n")[0]


def options(name: str) -> list[Option]:
    """Return the options of `problem(name, ...)`. Raises `InputError` for an unknown name."""
    return fields.of(_specification(name))


def check(name: str, options: Mapping[str, Any]) -> Any:
    """Return the specification with these options. Raises `InputError` as `problem` does."""
    return fields.fill(name, _specification(name), options)


@exclusive("gallery.problem")
def problem(name: str, **options: Any) -> Problem:
    """Return a problem made by code: scene, references, initial values and, if they exist, true values.

        problem("indirect-room", resolution=64, texture_resolution=64)

    Args:
        name: one of `names()`.
        options: see `options(name)`. All problems have loss, rendered ones resolution (pixels along a side), reference_spp and max_depth,
            and those with unknown textures texture_resolution. Defaults take seconds on two CPU cores; a GPU can use larger ones.

    References take up to a minute to render. They are stored in the cache folder (`backend.cache`) for the next call.

    Returns:
        The problem. Its references have noise, which a larger `reference_spp` reduces.

    Raises:
        InputError: the name or an option is unknown, or an option is out of range.
        VariantError: Mitsuba cannot run on this machine.
    """
    specification = check(name, options)
    with notebook.shown():
        if isinstance(specification, ProblemSource):
            made = specification.problem(name)
        else:
            made = build_problem(name, specification)
    return made.with_parts(origin={**made.origin, "gallery": name, "options": options})


def _specification(name: str) -> type:
    known = registry.components(_KIND)
    if not isinstance(name, str) or name not in known:
        hint = did_you_mean(str(name), known) or f"; it has {', '.join(known)}"
        raise InputError(f"gallery: no problem {name}{hint}")
    return known[name]
