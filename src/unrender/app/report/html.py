"""Rendering of self-contained pages from templates: style and script are inline, and all untrusted text is escaped."""

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
    """Render the page as UTF-8. Its content security policy allows only `viewer.js` and, after it, `more_script`."""
    script = source(_SCRIPT) + (source(more_script) if more_script else "")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    page = _environment().get_template(template)
    return page.render(policy=policy, script=Markup(script), **context).encode()


def source(name: str) -> str:
    """Return the text of a style sheet or script among the templates."""
    return loader().get_source(_environment(), name)[0]


def flatten(fields: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested fields as {"outer.inner": text}, without empty fields."""
    flat: dict[str, str] = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{name}."))
        elif isinstance(value, list) and all(isinstance(part, str) for part in value):
            flat[f"{prefix}{name}"] = ", ".join(value)
        elif value not in (None, ""):
            flat[f"{prefix}{name}"] = value if isinstance(value, str) else json.dumps(value)
    return {name: text for name, text in flat.items() if text}


_COMPONENTS = ("estimator", "optimizer")
_VERIFIED = {"start": "loss at the start", "end": "loss at the end", "best_loss": "loss of the selected parameters"}


def _verification(record: RunRecord) -> dict[str, Any]:
    """Return the verification by new pictures with labels. Pairs of a loss and its standard error become text."""
    named: dict[str, Any] = {"status": record.verified}
    for name, value in record.verification.items():
        label = _VERIFIED.get(name, "selected parameters" if name == "best" else name)
        match value:
            case [int() | float() as loss, int() | float() as error] if name in _VERIFIED:
                named[label] = formatting.with_standard_error(loss, error)
            case _:
                named[label] = value
    return named


def facts(record: RunRecord) -> dict[str, str]:
    """Return the facts about a run, {name: value}: problem, settings, seed, hardware, versions.

    The reasons of a method's choices replace the Python objects of its estimator and optimizer, which `run.json` stores.
    """
    hidden = _COMPONENTS if record.choices else ()
    return flatten(
        {
            "problem": {"name": record.name, **record.problem.description},
            "method": record.method,
            "choices": "; ".join(record.choices),
            "adapted": "; ".join(record.adapted),
            "settings": {name: value for name, value in record.settings.items() if name not in hidden},
            "seed": record.seed,
            "verified": _verification(record),
            "time": formatting.phases(record.phases),
            "variant": record.variant,
            "hardware": record.hardware,
            "versions": record.versions,
        }
    )


def environment(templates: BaseLoader) -> Environment:
    """Return a Jinja environment that escapes all values in its templates."""
    jinja = Environment(
        loader=templates,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_visible,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    jinja.filters.update(number=formatting.number, duration=formatting.duration, count=formatting.count)
    return jinja


def _visible(value: Any) -> Any:
    """Remove control characters from untrusted text, since a page is copied from and viewed in a terminal."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return visible(value, "\n\t")
    return value


@cache
def loader() -> PackageLoader:
    """Return the loader of the templates of the report."""
    return PackageLoader("unrender.app.report", "templates")


@cache
def _environment() -> Environment:
    return environment(loader())
