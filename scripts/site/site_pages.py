"""Pages that the site builds from the code and the records, and that are not committed: gallery, arguments, ranges, coverage."""

import dataclasses
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import reference_pages

from benchmarks.runner import records
from benchmarks.runner.catalogue import benchmarks
from scripts.coverage import coverage_page, ranges_page
from scripts.coverage.cli import RECORD
from unrender import gallery
from unrender.app import distributed, exporting
from unrender.app.capture import capture, formats, unknowns
from unrender.app.capture.formats import lights
from unrender.app.stages import stages_file
from unrender.core import registry
from unrender.display.pictures import png, shown_image
from unrender.io import parameter_values, toml_lines
from unrender.methods import method
from unrender.rendering.mitsuba import turned_lights
from unrender.runs.folder import schema
from unrender.scene import toml_file, view_checks

PIXELS, SAMPLES = 96, 64
"""Side and samples per pixel of the gallery's pictures."""
ENLARGED = 2
"""Pixels on the page for each pixel of a picture, along each axis."""
SECTION = re.compile(r"^(Args|Attributes):\n((?:    .*\n|\n)*)", re.MULTILINE)
ENTRY = re.compile(r"^    (\w[\w, ]*): ((?:.*\n)(?:^     .*\n)*)", re.MULTILINE)
CODE_COLUMNS = 60


def write_pages(docs: Path) -> None:
    """Write all pages below the folder of the site's sources."""
    coverage_page.PAGE.write_text(coverage_page.page(json.loads(RECORD.read_text())))
    ranges_page.PAGE.write_text(ranges_page.page())
    (docs / "reference" / "arguments.md").write_text(arguments_page())
    (docs / "reference" / "commands.md").write_text(commands_page())
    (docs / "reference" / "files.md").write_text(files_page())
    reference_pages.write_pages(docs / "reference")
    (docs / "equations.md").write_text((docs.parent / "src" / "unrender" / "EQUATIONS.md").read_text())
    for notebook in sorted((docs.parent / "examples" / "tutorials").glob("*.md")):
        (docs / "tutorials" / notebook.name).write_text(notebook.read_text().replace("(../../docs/", "(../"))
    folder = docs / "gallery"
    folder.mkdir(exist_ok=True)
    (folder / "index.md").write_text(gallery_page(folder))


def link_benchmarks(app: Any, docname: str, source: list[str]) -> None:
    """Make `[name]` of a benchmark a link to its page, in the pages that are committed."""
    if not docname.startswith("benchmarks/"):
        named = benchmarks().keys() & set(re.findall(r"\[([\w.]+)\]", source[0]))
        source[0] += "\n" + "".join(f"\n[{name}]: /benchmarks/{name}.md" for name in sorted(named))


def offer_notebook(app: Any, docname: str, source: list[str]) -> None:
    """Put a link to the executed `.ipynb` below the heading of a tutorial."""
    if "{code-cell}" in source[0]:
        link = f"{{nb-download}}`This page as a notebook <{docname.rpartition('/')[2]}.ipynb>`"
        source[0] = re.sub(r"^# .*$", rf"\g<0>\n\n{link}", source[0], count=1, flags=re.MULTILINE)


def gallery_page(folder: Path) -> str:
    """Return a page with a picture of every problem, and what comes out. The pictures go to `folder`."""
    record = records.read(benchmarks()["suite"].folder) or {"problems": {}}
    parts = [
        "# Gallery",
        "Problems made by code, whose truth is known. Three pictures show the first view: start, result of 100 steps of "
        "`auto` at 48 pixels a side, and reference. A single picture is the reference. Poses that start far off need "
        "`smoothed` with a larger `sigma` ([pose](../guide/pose.md)): there the picture shows where `auto` ends.",
        "Errors are relative to the start, after 4 s on two CPU cores: of the tutorial loop with the best of eight "
        "settings, and of `auto` (`python -m benchmarks suite`).",
    ]
    for name in gallery.names():
        parts += [f"## {name}", gallery.summary(name)]
        if (folder.parent / "images" / "gallery" / f"{name}.jpg").is_file():
            parts.append(f"![Start, result and reference of {name}](../images/gallery/{name}.jpg)")
        elif picture := _reference(name, folder):
            parts.append(f"![First reference of {name}]({picture})")
        entry = record["problems"].get(name)
        if entry:
            parts.append(f"Error of the loop {entry['loop'][-1]:.3g}, of `auto` {entry['auto'][-1]:.3g}.")
        parts.append(f"```sh\nunrender run {name} --seconds 20\n```")
    return "\n\n".join(parts) + "\n"


def _reference(name: str, folder: Path) -> str:
    """Render a problem's first reference to a file. Return its name, "" for a problem without pictures."""
    known = {option.name for option in gallery.options(name)}
    if "resolution" not in known:
        return ""
    small = {"resolution": PIXELS} | ({"reference_spp": SAMPLES} if "reference_spp" in known else {})
    file = folder / f"{name}.png"
    if not file.is_file():
        reference = gallery.problem(name, **small).views[0].reference
        file.write_bytes(png(shown_image(np.asarray(reference)).repeat(ENLARGED, 0).repeat(ENLARGED, 1)))
    return file.name


def arguments_page() -> str:
    """Return a page with a table of arguments for each component and method."""
    parts = [
        "# Arguments",
        "The arguments of all components and methods, with their defaults. `unrender methods NAME` prints the options "
        "of a method on the terminal.",
    ]
    for kind in registry.KINDS:
        if kind in ("method", "gallery problem"):
            continue
        parts.append(f"## {kind[0].upper()}{kind[1:]}{'es' if kind.endswith('s') else 's'}")
        for name, component in registry.components(kind).items():
            rows = list(_rows(component))
            parts.append(f"**`{name}`**: {_cell(_summary(component))}")
            if rows:
                parts.append("| argument | default | meaning |\n|---|---|---|\n" + "\n".join(rows))
    parts.append("## Methods")
    for name in registry.components("method"):
        made = method(name)
        parts += [f"### {name}", _cell(made.summary[0].upper() + made.summary[1:]) + "."]
        parts += inspect.cleandoc(made.options.__doc__ or "").split("\n\n")[1:]
        rows = []
        for key, field in made.options.model_fields.items():
            default = _code(field.get_default(call_default_factory=True))
            rows.append(f"| `{key}` | {default} | {_cell(field.description or '')} ({_cell(made.expected(key))}) |")
        if rows:
            parts.append("| option | default | meaning |\n|---|---|---|\n" + "\n".join(rows))
    return "\n\n".join(parts) + "\n"


FILES = {
    "References": view_checks,
    "Run folders": schema,
    "Values from files": parameter_values,
    "Photographs": formats,
    "Axes of cameras": capture,
    "Photographs under known lights": lights,
    "Turned lights": turned_lights,
    "Unknowns of photographs": unknowns,
    "Exports": exporting,
    "Distributed runs": distributed,
}
"""Modules whose docstrings are sections of the page of files, by heading."""


def files_page() -> str:
    """Return a page with the fields of problem files and files of stages, and the conventions of all other files."""
    parts = ["# Files and conventions", "Fields without a default are required."]
    for heading, tables in (("Problem files", toml_file.TABLES), ("Files of stages", stages_file.TABLES)):
        parts.append(f"## {heading}")
        for name, model in tables.items():
            rows = []
            for own, field in toml_lines.fields_of(model).items():
                default = "required" if field.is_required() else _code(field.get_default(call_default_factory=True))
                rows.append(f"| `{field.alias or own}` | {default} | {_cell(field.description or '')} |")
            title = f"`[[{name}]]`" if name else "The file"
            parts.append(f"| {title} | default | value |\n|---|---|---|\n" + "\n".join(rows))
    for heading, module in FILES.items():
        parts += [f"## {heading}", inspect.cleandoc(module.__doc__ or "")]
    return "\n\n".join(parts) + "\n"


def commands_page() -> str:
    """Return a page with each command of `unrender`: its usage, what it does, and a table of its options."""
    from typer.main import get_command

    from unrender.app.cli.app import app

    parts = [
        "# Commands",
        "What `unrender COMMAND -h` prints. [The command line](../guide/command-line.md) has exit statuses, memory and variables.",
    ]
    commands: Any = get_command(app)
    rows = [
        f"| [`unrender {name}`](#unrender-{name}) | {_summary_line(command.help)} |"
        for name, command in commands.commands.items()
    ]
    parts.append("| command | purpose |\n|---|---|\n" + "\n".join(rows))
    for name, command in commands.commands.items():
        arguments = " ".join(
            each.metavar or each.name.upper() for each in command.params if each.param_type_name == "argument"
        )
        parts += [f"## unrender {name}", f"`unrender {name} {arguments}`".replace(" `", "`"), _paragraph(command.help)]
        rows = []
        for each in command.params:
            if each.param_type_name == "option" and not getattr(each, "hidden", False):
                rows.append(f"| {', '.join(f'`{flag}`' for flag in each.opts)} | {_cell(each.help or '')} |")
        parts.append("| option | meaning |\n|---|---|\n" + "\n".join(rows))
    return "\n\n".join(parts) + "\n"


def _summary_line(text: str) -> str:
    return _cell(_paragraph(text).partition("\n\n")[0])


def _paragraph(text: str) -> str:
    return "\n\n".join(" ".join(each.split()) for each in inspect.cleandoc(text or "").split("\n\n"))


def _rows(component: Any) -> Iterator[str]:
    """A row for each field that may be set."""
    if not dataclasses.is_dataclass(component):
        return
    meanings = _meanings(component)
    for field in dataclasses.fields(component):
        if not field.init or field.name.startswith("_"):
            continue
        default = "required"
        if field.default is not dataclasses.MISSING:
            default = _code(field.default)
        elif field.default_factory is not dataclasses.MISSING:
            default = _code(field.default_factory())
        yield f"| `{field.name}` | {default} | {_cell(meanings.get(field.name, ''))} |"


def _meanings(component: Any) -> dict[str, str]:
    """{argument: its description} of a class's docstring, and of those it inherits from."""
    found: dict[str, str] = {}
    for base in reversed(inspect.getmro(component)):
        text = inspect.cleandoc(base.__doc__ or "") + "\n"
        for section in SECTION.finditer(text):
            for names, meaning in ENTRY.findall(section[2]):
                found |= {name.strip(): " ".join(meaning.split()) for name in names.split(",")}
    return found


def _summary(component: Any) -> str:
    return " ".join(inspect.cleandoc(component.__doc__ or "").partition("\n\n")[0].split())


def _code(value: Any) -> str:
    text = repr(value)
    return f"`{_cell(text)}`" if len(text) <= CODE_COLUMNS else f"a {type(value).__name__}"


def _cell(text: str) -> str:
    """Text that neither ends a cell nor begins markup."""
    return (
        re.sub(r"([|<*\[\]]|(?<!\w)_)", r"\\\1", " ".join(text.split()))
        if "`" not in text
        else text.replace("|", r"\|")
    )
