"""docs/reference/coverage.md: a table for each kind of plugin, from the record."""

from __future__ import annotations

from typing import Any

from benchmarks import markdown
from benchmarks.runner.catalogue import ROOT
from scripts.coverage.plugins import IN_INSTANCES, PLUGINS

__all__ = ["PAGE", "page"]

PAGE = ROOT / "docs" / "reference" / "coverage.md"
_HEAD = """# Coverage of Mitsuba's plugins

Built from the record of `python -m scripts.coverage`: a scene of 16 x 16 pixels for each plugin of Mitsuba 3.9.1. The rows *in
instances* have the plugin's shape in a `shapegroup` with two instances; one parameter of each is measured, with a quarter of the samples.

| column | contents |
|---|---|
| image | mean of our picture over Mitsuba's, and the largest difference of 2 x 2 pixels in standard errors |
| gradient | path gradient over finite difference along a random direction, with its standard error |
| descends | squared error of the picture, and error of the parameter, after 40 steps of Adam over before |

*refused* is followed by the line that a user reads. *perturbed* means that there is no path gradient, so `--method smoothed` recovers the
parameter from perturbed renders. *weak* means that noise would hide a difference of 3 % of a picture, or of the whole gradient. *unseen*
means that a start far away in the parameter's range leaves the picture as it is, within noise. A descent begins a tenth of the range away,
or further where the pictures would hardly differ. It follows path gradients, or perturbed renders where there are none. Up to 24 numbers
that noise hides take Gauss-Newton steps instead. The squared error of its picture must halve. On path gradients, the parameter must come
closer to the truth, too, except vertices, normals, texture coordinates and tables of phase functions, of which many give nearly the same
picture. **no** marks a descent that did less within 40 steps: the noise of the renders hides its parameter."""


def page(record: dict[str, Any]) -> str:
    """Return the text of the page."""
    parts = [_HEAD]
    scenes = {**PLUGINS, **IN_INSTANCES}
    for kind in sorted({plugin.kind for plugin in scenes.values()}, key=str.lower):
        rows = [row for name, plugin in scenes.items() if plugin.kind == kind for row in _rows(name, record.get(name))]
        table = markdown.table("plugin | parameter | image | gradient | descends", rows)
        parts.append(f"## {kind[0].upper()}{kind[1:]}\n\n{table}")
    return "\n\n".join(parts) + "\n"


def _rows(name: str, found: dict[str, Any] | None) -> list[list[str]]:
    if found is None:
        return [[name, "–", "not measured", "not measured", "not measured"]]
    if "refused" in found or "failed" in found:
        why = f"refused: {found['refused']}" if "refused" in found else f"**failed**: {found['failed']}"
        return [[name, "–", _cell(why), "–", "–"]]
    image = _image(found["image"])
    if not found["parameters"]:
        return [[name, "none", image, "–", "–"]]
    return [
        [name, f"`{key}`", image, _gradient(entry["gradient"]), _descent(entry.get("descent"))]
        for key, entry in found["parameters"].items()
    ]


def _image(found: dict[str, Any]) -> str:
    ratio = "black" if found["ratio"] is None else f"{found['ratio']:.3f}"
    return f"{_verdict(found)}{ratio}, {found['z']:.1f} σ"


def _gradient(found: dict[str, Any]) -> str:
    if "refused" in found:
        return _cell(f"refused: {found['refused']}")
    if "perturbed" in found:
        return _cell(f"perturbed: {found['perturbed']}")
    if found["ratio"] is None:
        return f"{_verdict(found)}zero"
    return f"{_verdict(found)}{found['ratio']:.3f} ± {found['error']:.3f}"


def _descent(found: dict[str, Any] | None) -> str:
    if found is None:
        return "not measured"
    if "refused" in found:
        return _cell(f"refused: {found['refused']}")
    if found["ok"] is None:
        return "unseen"
    verdict = "" if found["ok"] else "**no**, "
    return f"{verdict}{found['after'] / found['before']:.2g}, {found['error']:.2g}"


def _verdict(found: dict[str, Any]) -> str:
    return {"ok": "", "zero": "", "weak": "weak, ", "wrong": "**wrong**, "}[found["verdict"]]


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
