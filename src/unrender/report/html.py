"""One self-contained page from a template: style and script within, nothing fetched, everything untrusted escaped."""

from __future__ import annotations

import base64
import hashlib
import json
import shlex
from collections.abc import Mapping
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from unrender.report import words
from unrender.report.folder import RunRecord


def render(template: str, **context: Any) -> bytes:
    """The page as UTF-8. Its content security policy lets no script run but the one of `slider.js`."""
    environment = _environment()
    source, _, _ = PackageLoader("unrender.report", "templates").get_source(environment, "slider.js")
    digest = base64.b64encode(hashlib.sha256(source.encode()).digest()).decode("ascii")
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    page = environment.get_template(template)
    return page.render(policy=policy, script=Markup(source), **context).encode()


def flattened(fields: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested fields as {"outer.inner": text}, what is empty left out."""
    found: dict[str, str] = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            found.update(flattened(value, f"{prefix}{name}."))
        elif isinstance(value, list) and all(isinstance(part, str) for part in value):
            found[f"{prefix}{name}"] = ", ".join(value)
        elif value not in (None, ""):
            found[f"{prefix}{name}"] = value if isinstance(value, str) else json.dumps(value)
    return {name: text for name, text in found.items() if text}


def command(record: RunRecord) -> str:
    """The command line of a run as one would type it."""
    return record.command if isinstance(record.command, str) else shlex.join(record.command)


def facts(record: RunRecord) -> dict[str, str]:
    """What a run was made with, {name: value}: problem, settings, seed, hardware, versions."""
    hardware = record.hardware if isinstance(record.hardware, dict) else {"hardware": record.hardware}
    return flattened(
        {
            "problem": {"name": record.name, **record.problem},
            "method": record.method,
            "settings": record.settings,
            "seed": record.seed,
            "variant": record.variant,
            "hardware": hardware,
            "versions": record.versions,
        }
    )


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("unrender.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=words.number, duration=words.duration, count=words.count)
    return environment
