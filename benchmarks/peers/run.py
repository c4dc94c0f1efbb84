"""`auto` beside the pipelines of others: Weier et al. 2025 and svbrdf_uncertainty, each in its own environment, at equal processor time.

Neither is part of this repository. Of each, clone the repository, make an environment with what it asks for, and name both:
`--weier FOLDER --weier-python PYTHON`, `--svbrdf FOLDER --svbrdf-python PYTHON`; either pair may be left out. A small driver of ours
(drivers/) runs theirs as it is and keeps the textures on the way; what they leave is written below out/.

All start from 0.5 everywhere with the same pictures. `auto` has no option given. A peer has the settings that its authors published, and
once more, where another is better, the rate that is best on a seed of its own. Errors are of the texels that the views see, and of pictures
by cameras that nobody was given, rendered by us with the textures that each side found. Time is the processor's, of all threads, without
compilation and the first step.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.peers import scenes
from benchmarks.races import TUNING_SEED, first_at, search
from benchmarks.runner.records import Record, scratch
from benchmarks.suite.run import errors_of
from benchmarks.timed_runs import timed_run, views_error

_POINTS = 20
_PICTURE_SPP = 256
MERGE = ("problems",)
QUICK = {"problem": ("plane",), "seconds": 4.0, "seeds": 1, "resolution": 16, "reference_spp": 64}
NOTHING_GIVEN = (
    "no peer is given: clone github.com/google/practical-inverse-rendering-of-textured-and-translucent-appearance or "
    "github.com/rubenwiersma/svbrdf_uncertainty, make an environment for it as its README says, and name both, "
    "as in --weier FOLDER --weier-python ENVIRONMENT/bin/python; benchmarks/peers/notes.md has the details"
)
PYRAMID = {
    "approach": "MIPMAP_PYRAMID",
    "base_learning_rate": 0.1,
    "samples_per_pixel_primal": 16,
    "samples_per_pixel_gradient": 1,
    "shares": {"base_color": 1.0, "roughness": 0.1, "metallic": 0.1},
}
"""Weier et al.'s: their `painting/mipmap_pyramid.gin`, for metallic their default."""
FILTER = {
    **PYRAMID,
    "approach": "NAIVE",
    "use_gradient_filtering": True,
    "filtering_sigma_d": 0.1,
    "a_trous_filtering_steps": 5,
    "log_domain_filtering": True,
    "beta_1": 0.2,
}
"""The filter of Chang et al. 2024 as Weier et al. wrote it, at what Chang et al. published: σ_d 0.1, five levels, β₁ 0.2."""
LOOP = {"learning_rate": 0.01, "grad_spp": 32, "smoothness_weight": 1e-3}
"""svbrdf_uncertainty's: the defaults of `optimize_material`."""

Points = list[tuple[float, dict[str, np.ndarray]]]


class Judge:
    """Errors of textures, relative to the start.

    Args:
        case: whose truth and held-out pictures are known.
    """

    def __init__(self, case: scenes.Case):
        self.case, self._errors = case, errors_of(case.problem)
        with np.load(case.folder / "others.npz") as found:
            views = [ur.View(found[f"arr_{n}"].astype(np.float32), n) for n in range(len(found.files))]
        unknown = [ur.Parameter(key, initial=0.5) for key in case.keys]
        self._others = ur.Problem(case.folder / "others.xml", unknown, views, max_depth=scenes.DEPTH)
        self._begin = views_error(self._others, self._others.initial_values(), _PICTURE_SPP)

    def each(self, values: dict[str, np.ndarray]) -> dict[str, float]:
        """The error of each texture where seen, by its channel."""
        return {key.split(".")[-2]: error for key, error in self._errors(values).items()}

    def textures(self, values: dict[str, np.ndarray]) -> float:
        """The mean over textures."""
        return float(np.mean(list(self.each(values).values())))

    def run(self, found: Points, steps: int) -> dict[str, Any]:
        """The record of a run."""
        last = {key: found[-1][1][key].reshape(truth.shape) for key, truth in self.case.problem.truth.items()}
        curve = [[seconds, self.textures(values)] for seconds, values in found]
        pictures = views_error(self._others, last, _PICTURE_SPP) / self._begin
        errors = {"textures": self.textures(last), "each": self.each(last), "pictures": pictures}
        return {"curve": curve, **errors, "steps": steps}


def ours(judge: Judge, seconds: float, seed: int) -> dict[str, Any]:
    """`auto`, no option given; errors are no part of the time."""
    kept = timed_run(judge.case.problem, seconds, seed, points=_POINTS)
    return judge.run(kept.found, kept.steps)


@dataclass(frozen=True)
class Entrant:
    """A pipeline of others, in a process of its own, with the settings that its authors published.

    Attributes:
        name: in the record.
        driver: the file under drivers/.
        python: of its environment.
        path: what its modules are imported from.
        scene: the file it reads.
        settings: as published.
        rate: the name of the learning rate among them.
        tuned: whether the rate is tuned, too.
    """

    name: str
    driver: str
    python: Path
    path: Path
    scene: str
    settings: dict[str, Any]
    rate: str
    tuned: bool = True

    def run(
        self, judge: Judge, seconds: float, seed: int, rate: float | None = None, check: bool = False
    ) -> dict[str, Any]:
        """One run, at the published rate where none is given; `check` has its rendering of the true scene compared with the references."""
        settings = self.settings if rate is None else {**self.settings, self.rate: rate}
        folder, driver = judge.case.folder.resolve(), Path(__file__).parent / f"drivers/{self.driver}.py"
        asked = {
            "scene": str(folder / self.scene), "references": str(folder / "references.npz"), "folder": str(folder),
            "out": str(folder / "found.npz"), "keys": judge.case.keys, "material": scenes.MATERIAL, "depth": scenes.DEPTH,
            "seconds": seconds, "points": _POINTS, "seed": seed, "settings": settings, "check": check,
        }  # fmt: skip
        (folder / "task.json").write_text(json.dumps(asked))
        command = [str(self.python.absolute()), str(driver), str(folder / "task.json")]
        environment = {**os.environ, "PYTHONPATH": str(self.path.resolve()), "MPLBACKEND": "Agg"}
        environment["HOME"] = str(scratch(f"peers/kernels-{self.driver}"))  # older Dr.Jit keeps its kernels there
        done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            (folder / "failed.txt").write_text(done.stdout + done.stderr)
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            sys.exit(f"{driver.name} failed in {self.python}: {last} (more in {folder / 'failed.txt'})")
        with np.load(folder / "found.npz") as kept:
            textures = {key: kept[f"texture/{key}"] for key in judge.case.keys}
            points = [(float(s), {key: textures[key][n] for key in textures}) for n, s in enumerate(kept["seconds"])]
            found = judge.run(points, int(kept["steps"][-1])) | ({"check": float(kept["check"])} if check else {})
        line = f"rate {settings[self.rate]:g} seed {seed}: {found['textures']:.4f} in {found['steps']} steps"
        print(f"  {judge.case.problem.name} {self.name} {line}", flush=True)
        return found

    def best_rate(self, judge: Judge, seconds: float) -> tuple[float, list[dict[str, float]]]:
        """The rate of least texture error on a seed of its own, from the published one and thrice that on; and all that were tried."""
        published = self.settings[self.rate]
        return search((published, 3 * published), lambda rate: self.run(judge, seconds, TUNING_SEED, rate)["textures"])


def entrants(
    weier: Path | None, weier_python: Path | None, svbrdf: Path | None, svbrdf_python: Path | None, texture: int
) -> list[Entrant]:
    """Of the peers that are given."""
    found = []
    if svbrdf is not None and svbrdf_python is not None:
        own, loop = ("svbrdf", svbrdf_python, svbrdf, "scene.xml"), {**LOOP, "texture_res": texture}
        found.append(Entrant("svbrdf_uncertainty", *own, loop, "learning_rate"))
    if weier is not None and weier_python is not None:
        own = "weier", weier_python, weier / "python", "mipmaps.xml"
        found.append(Entrant("Weier et al.", *own, PYRAMID, "base_learning_rate"))
        found.append(Entrant("filter, by Weier et al.", *own, FILTER, "base_learning_rate", tuned=False))
    if not found:
        sys.exit(NOTHING_GIVEN)
    return found


def run(
    weier: Path | None = None,
    weier_python: Path | None = None,
    svbrdf: Path | None = None,
    svbrdf_python: Path | None = None,
    assets: Path | None = None,
    problem: tuple[str, ...] = tuple(scenes.SCENES),
    seconds: float = 30.0,
    seeds: int = 2,
    resolution: int = 64,
    texture: int = 64,
    reference_spp: int = 4096,
    weier_rate: float | None = None,
    svbrdf_rate: float | None = None,
) -> Iterator[dict[str, Any]]:
    """Every problem.

    Args:
        weier: checkout of Weier et al.'s repository
        weier_python: interpreter of its environment, with Mitsuba 3.6.4
        svbrdf: checkout of svbrdf_uncertainty
        svbrdf_python: interpreter of its environment, with Mitsuba 3.5.0
        assets: folder with spot/ and textures/, for the problem spot
        seconds: budget of a run, of the processor
        reference_spp: of the pictures that are given, and held out
        weier_rate: their tuned rate, where it is known; none to look for it
        svbrdf_rate: likewise
    """
    peers = entrants(weier, weier_python, svbrdf, svbrdf_python, texture)
    known = {"Weier et al.": weier_rate, "svbrdf_uncertainty": svbrdf_rate}
    found: dict[str, Any] = {"problems": {}}
    for name in problem:
        folder = scratch(f"peers/{name}-{resolution}-{texture}-{reference_spp}")
        judge = Judge(scenes.case(name, folder, assets, svbrdf, resolution, texture, reference_spp))
        ours(judge, seconds / 4, TUNING_SEED)  # its kernels
        sides: dict[str, Any] = {"auto": {"runs": [ours(judge, seconds, seed) for seed in range(seeds)]}}
        print(f"  {name} auto: {[round(one['textures'], 4) for one in sides['auto']['runs']]}", flush=True)
        found["problems"][name] = sides
        for peer in peers:
            runs = [peer.run(judge, seconds, seed, check=seed == 0) for seed in range(seeds)]
            sides[peer.name] = {"settings": peer.settings, "runs": runs}
            yield found
            if not peer.tuned:
                continue
            rate = known[peer.name]
            if rate is None:
                rate, sides[peer.name]["tried"] = peer.best_rate(judge, seconds)
            if rate != peer.settings[peer.rate]:
                runs = [peer.run(judge, seconds, seed, rate) for seed in range(seeds)]
                sides[f"{peer.name}, tuned"] = {"settings": {**peer.settings, peer.rate: rate}, "runs": runs}
                yield found


_RATES = ("base_learning_rate", "learning_rate")


def _reached(runs: Sequence[Record], error: float) -> str:
    """The median over runs of the seconds after which the error is first at most so much."""
    found = float(np.median([first_at(list(zip(*run["curve"], strict=True)), error) for run in runs]))
    return f"{found:.1f} s" if np.isfinite(found) else "never"


def table(record: Record) -> str:
    """Errors at the end, and steps; how far each peer's rendering of the true scene is from the references."""
    text = "{seconds:g} s of the processor, pictures of {resolution}², textures of {texture}², errors relative to the start, median and "
    text += "range: of the textures where seen, and of held-out pictures."
    parts = [text.format(**record["settings"])]
    for name, sides in record["problems"].items():
        ours = sides["auto"]["runs"]
        several = len(ours[0]["each"]) > 1
        head = "side | rate | steps | textures | held-out pictures | `auto` as good after"
        rows = [_row(side, entry, ours, several) for side, entry in sides.items()]
        runs = ((side, run) for side, entry in sides.items() for run in entry["runs"])
        checks = ", ".join(f"{side} {run['check']:.3f}" for side, run in runs if "check" in run)
        parts += [
            f"**{name}**, {len(ours)} seed{'s' if len(ours) > 1 else ''}",
            markdown.table(f"{head} | each texture" if several else head, rows),
            f"The true scene as a peer renders it, from the references, relative: {checks}.",
        ]
    return markdown.blocks(*parts)


def _row(side: str, entry: Record, ours: Sequence[Record], several: bool) -> list[str]:
    runs = entry["runs"]
    rate = next((f"{entry['settings'][key]:.2g}" for key in _RATES if key in entry.get("settings", {})), "")
    steps = f"{np.median([run['steps'] for run in runs]):g}"
    errors = [markdown.spread([run[kind] for run in runs]) for kind in ("textures", "pictures")]
    reached = "" if side == "auto" else _reached(ours, float(np.median([run["textures"] for run in runs])))
    each = [f"{channel} {np.median([run['each'][channel] for run in runs]):.3f}" for channel in runs[0]["each"]]
    return [side, rate, steps, *errors, reached, *(["; ".join(each)] if several else [])]


def plot(record: Record) -> figures.Figure:
    panels = {
        name: {side: figures.from_start(run["curve"][1:] for run in entry["runs"]) for side, entry in sides.items()}
        for name, sides in record["problems"].items()
    }
    return figures.curves(panels, "processor seconds", "error where seen / at the start", log="")
