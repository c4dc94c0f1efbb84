"""Run folders written field by field, and pages read as a browser would, for the tests of the report."""

from __future__ import annotations

import base64
import io
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

KEY = "wall.bsdf.reflectance.data"


def write_run(
    path: Path,
    method: str = "plain",
    seed: int = 0,
    times: Any = (1.0, 2.0, 3.0, 4.0),
    errors: Any = (0.4, 0.3, 0.2, 0.1),
    samples_per_step: int = 100,
    truth: dict[str, np.ndarray] | None = None,
    initial: dict[str, np.ndarray] | None = None,
    parameters: dict[str, np.ndarray] | None = None,
    views: dict[str, np.ndarray] | None = None,
    loss: Any = None,
    **fields: Any,
) -> Path:
    """A whole run folder: a 4 x 5 texture whose error is 0.5 at the start and then `errors` at `times`."""
    path.mkdir(parents=True)
    truth = {KEY: np.full((4, 5, 3), 0.25)} if truth is None else truth
    initial = {k: v + 0.5 for k, v in truth.items()} if initial is None else initial
    parameters = {k: v + errors[-1] for k, v in truth.items()} if parameters is None else parameters
    if views is None:
        reference = np.linspace(0.0, 0.6, 6 * 8 * 3).reshape(6, 8, 3)
        views = {"view0/reference": reference, "view0/initial": 0.2 * reference, "view0/result": reference + 0.01}
    for name, arrays in {"parameters": parameters, "initial": initial, "truth": truth, "pictures": views}.items():
        if arrays:
            np.savez(
                path / f"{name}.npz", allow_pickle=False, **{k: np.asarray(v, np.float32) for k, v in arrays.items()}
            )
    losses = np.square(errors) if loss is None else loss
    records = [
        {
            "step": i,
            "seconds": float(t),
            "loss": None if loss_i is None else float(loss_i),
            "samples": (i + 1) * samples_per_step,
            "gradient_noise": 0.5,
            "parameter_error": dict.fromkeys(truth, float(error)),
        }
        for i, (t, error, loss_i) in enumerate(zip(times, errors, losses, strict=True))
    ]
    (path / "history.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    record = {
        "name": "room",
        "method": method,
        "settings": {"spp": 4},
        "seed": seed,
        "command": f"unrender run room --method {method}",
        "versions": {"mitsuba": "3.9.1"},
        "hardware": {"processor": "a processor", "cores": 2},
        "variant": "llvm_ad_rgb",
        "stopped": "seconds",
        "steps": len(records),
        "seconds": float(times[-1]) if len(times) else 0.0,
        "skipped": 0,
        "warnings": [],
        "problem": {"parameters": list(parameters), "views": 1, "loss": "L1()"},
    }
    (path / "run.json").write_text(json.dumps(record | fields))
    return path


class Page(HTMLParser):
    """What a browser would make of a page, as far as the tests ask."""

    def __init__(self, path: Path):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []
        self.scripts: list[str] = []
        self._inside = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag in ("script", "style"):
            self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        if tag == self._inside:
            self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts.append(data)
        elif not self._inside:
            self.text.append(data)

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())

    def picture(self, alt: str) -> np.ndarray:
        """The pixels of the picture with this description, in [0, 255]."""
        (source,) = {image["src"] for image in self.all("img") if image["alt"] == alt}
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(source.removeprefix("data:image/png;base64,")))))

    def dangers(self) -> list[str]:
        """Whatever could run or fetch something, but for the page's own script."""
        found = [f"{tag} {n}" for tag, a in self.elements for n in a if n.startswith("on")]
        found += [
            f"{t} {n}" for t, a in self.elements for n in ("src", "href", "action") if a.get(n, "data:")[:5] != "data:"
        ]
        found += [tag for tag, _ in self.elements if tag in ("iframe", "object", "embed", "link", "base", "form", "a")]
        return found + ["script"] * (len(self.all("script")) - 1)
