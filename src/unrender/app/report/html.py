"""One self-contained page from a template: style and script within, nothing fetched, everything untrusted escaped."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from jinja2 import BaseLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from unrender.core.text import visible
from unrender.display import formatting
from unrender.runs.folder.schema import RunRecord

_SCRIPT = "viewer.js"


def render(template: str, more_script: str = "", **context: Any) -> bytes:
    """The page as UTF-8. Its content security policy lets no script run but the one of `viewer.js`, and `more_script` after it."""
    script = source(_SCRIPT) + (source(more_script) if more_script else "")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    page = _environment().get_template(template)
    return page.render(policy=policy, script=Markup(script), **context).encode()


def source(name: str) -> str:
    """The text of a style sheet or script among the templates."""
    return loader().get_source(_environment(), name)[0]


def flatten(fields: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested fields as {"outer.inner": text}, what is empty left out."""
    found: dict[str, str] = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            found.update(flatten(value, f"{prefix}{name}."))
        elif isinstance(value, list) and all(isinstance(part, str) for part in value):
            found[f"{prefix}{name}"] = ", ".join(value)
        elif value not in (None, ""):
            found[f"{prefix}{name}"] = value if isinstance(value, str) else json.dumps(value)
    return {name: text for name, text in found.items() if text}


def facts(record: RunRecord) -> dict[str, str]:
    """What a run was made with, {name: value}: problem, settings, seed, hardware, versions."""
    return flatten(
        {
            "problem": {"name": record.name, **record.problem.description},
            "method": record.method,
            "choices": "; ".join(record.choices),
            "adapted": "; ".join(record.adapted),
            "settings": record.settings,
            "seed": record.seed,
            "verified": {"status": record.verified, **record.verification},
            "time": formatting.phases(record.phases),
            "variant": record.variant,
            "hardware": record.hardware,
            "versions": record.versions,
        }
    )


def environment(templates: BaseLoader) -> Environment:
    """An environment that escapes everything that is put into its templates."""
    found = Environment(
        loader=templates,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_visible,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters.update(number=formatting.number, duration=formatting.duration, count=formatting.count)
    return found


def _visible(value: Any) -> Any:
    """Text of others without control characters: a page is copied from, and viewed in a terminal."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return visible(value, "\n\t")
    return value


@cache
def loader() -> PackageLoader:
    """Of the report's templates."""
    return PackageLoader("unrender.app.report", "templates")


@cache
def _environment() -> Environment:
    return environment(loader())
