"""The files of examples/, which docs/extending shows: written into a package outside the tree, announced by entry points, and run."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import unrender

ROOT = Path(__file__).resolve().parents[2]
TEXT = "\n".join(page.read_text() for page in sorted((ROOT / "docs" / "extending").glob("*.md")))
SHOWN = re.findall(r"^```\{literalinclude\} \.\./\.\./examples/(\w+)\.py$", TEXT, re.MULTILINE)
FILES = {path.stem: path.read_text() for path in sorted((ROOT / "examples").glob("*.py"))}
PLAN = re.findall(r"^```toml\n(\[estimator\].*?)^```$", TEXT, re.DOTALL | re.MULTILINE)[0]
"""The plan file that the pages show."""
REGISTERED = {
    "loss": "Charbonnier",
    "schedule": "InverseTime",
    "preconditioner": "Grey",
    "pixel sampler": "Alternating",
    "image estimator": "Clamped",
    "estimator": "AveragedGradient",
    "optimizer": "SignDescent",
    "step transform": "ScaleByLargest",
    "method": "momentum",
    "gallery problem": "painted-wall",
}
UNREGISTERED = {"tinted", "exposure"}
"""A BSDF is known to Mitsuba, a renderer is handed to a problem."""

DRIVER = '''
import json, sys
import numpy as np
import unrender as ur
from unrender.core import registry, tables
from unrender.io.toml_lines import tomllib
from unrender.methods import method

sys.path.insert(0, sys.argv[1])
from analytic import problem

found = {}
found["kinds"] = {kind: sorted(c.__module__ for c in registry.components(kind).values()) for kind in registry.KINDS}

def make(name, **fields):
    return tables.component({"type": name, **fields})

def error(asked, estimator, optimizer, steps=100):
    history = ur.optimize(asked, estimator, optimizer, steps).history
    errors = [max(record["parameter_error"].values()) for record in history if "parameter_error" in record]
    return [errors[0], errors[-1]]

sgd, adam = ur.optimizers.SGD(0.1), ur.optimizers.Adam(0.02)
loss = make("Charbonnier", epsilon=0.1)
image, reference = np.random.default_rng(0).uniform(0, 2, (2, 50))
central = (loss.value(image + 1e-6, reference) - loss.value(image - 1e-6, reference)) / 2e-6
found["derivative"] = float(np.abs(loss.derivative(image, reference) - central).max())
found["loss"] = error(problem(loss), ur.PathGradient(spp=4), adam)
found["schedule"] = [method("plain").start({"schedule": "inversetime(50)"})[1].schedule(50), make("InverseTime", half=4)(4)]
grey = make("Grey", strength=0.5)
found["grey"] = grey.apply(np.array([[1.0, 3.0]])).tolist()
asked = problem()
asked = ur.Problem(
    asked.renderer, [ur.Parameter("colour", 0.5, preconditioner=grey), ur.Parameter("map", 0.5)], asked.original_views, truth=asked.truth
)
found["preconditioner"] = error(asked, ur.PathGradient(spp=4), sgd)
sampler = make("Alternating", inner={"type": "Uniform", "count": 8}, every=3)
found["pixel sampler"] = error(problem(views=2), ur.PathGradient(pixels=sampler, spp=2), adam)
found["image estimator"] = error(problem(), ur.PathGradient(make("Clamped", inner="RecursiveControlVariate"), spp=2), adam)
averaged = make("AveragedGradient", inner={"type": "PathGradient", "spp": 2}, decay=0.5)
found["estimator"] = error(problem(), averaged, adam)
found["optimizer"] = error(problem(), ur.PathGradient(spp=2), make("SignDescent", learning_rate=0.05, schedule="inversetime(10)"))
parts = [{"type": "GradientMean", "decay": 0.5}, {"type": "ScaleByLargest"}]
chain = make("Chain", transforms=parts, learning_rate=0.05)
found["step transform"] = error(problem(), ur.PathGradient(spp=2), chain)
whole = ur.optimize(problem(), ur.PathGradient(spp=2), chain, 9).parameters
ur.optimize(problem(), ur.PathGradient(spp=2), chain, 4, run_directory=sys.argv[3])
again = ur.resume(sys.argv[3], problem(), steps=9).parameters
found["resumed"] = all(np.array_equal(whole[key], again[key]) for key in whole)
parts = tomllib.loads(sys.argv[4])
found["plan file"] = error(problem(), tables.component(parts["estimator"]), tables.component(parts["optimizer"]))
found["method"] = error(problem(), *method("momentum").start({"learning_rate": "0.05"}))
for each in (loss, grey, sampler, averaged, chain):
    assert tables.component(json.loads(json.dumps(tables.table(each)))) == each

from additions.exposure import ExposureRenderer, problem as exposure
found["renderer"] = error(exposure(), ur.PathGradient(spp=4), adam)

ur.use(sys.argv[2])
tiny = {"resolution": 6, "reference_spp": 64}
wall = ur.gallery.problem("painted-wall", **tiny)
found["gallery problem"] = error(wall, ur.PathGradient(spp=2), adam, 40)
from additions.painted_wall import PaintedWall
from additions.tinted import register_tinted
register_tinted()
specification = PaintedWall(**tiny)
def tinted():
    return specification.scene() | {
        "wall": {"type": "rectangle", "bsdf": {"type": "tinted", "tint": {"type": "rgb", "value": [0.6, 0.4, 0.3]}}}
    }
asked = ur.Problem(tinted, [ur.Parameter("wall.bsdf.tint", 0.5, bounds=(0, 1))], wall.original_views, max_depth=2,
                   truth={"wall.bsdf.tint": [0.6, 0.4, 0.3]})
found["BSDF"] = error(asked, ur.PathGradient(ur.images.RecursiveControlVariate(), spp=2), adam, 40)
scene = ur.app.export((asked, {"wall.bsdf.tint": [0.1, 0.2, 0.3]}), sys.argv[3] + "-scene").scene
import mitsuba as mi
found["exported BSDF"] = [value[0] for value in mi.traverse(mi.load_file(str(scene)))["wall.bsdf.tint"]]
print(json.dumps(found))
'''  # fmt: skip


def package(folder: Path, files: dict[str, str]) -> None:
    """A package `additions` that is installed in `folder` as pip would: each file a module with an entry point."""
    (folder / "additions").mkdir(parents=True)
    (folder / "additions" / "__init__.py").write_text("")
    for name, text in files.items():
        (folder / "additions" / f"{name}.py").write_text(text)
    info = folder / "additions-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: additions\nVersion: 1.0\n")
    points = "\n".join(f"{name} = additions.{name}" for name in files)
    (info / "entry_points.txt").write_text(f"[unrender.components]\n{points}\n")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory, mitsuba_variant: str) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("contributing")
    package(folder, FILES)
    source = Path(unrender.__file__).parents[1]
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", DRIVER, str(Path(__file__).parent), mitsuba_variant, str(folder / "run"), PLAN],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(source), str(folder), *sys.path])},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert not process.stderr
    return json.loads(process.stdout)


def test_every_file_is_followed(found: dict[str, Any]) -> None:
    assert len(FILES) == len(REGISTERED) + len(UNREGISTERED)
    assert set(FILES) >= UNREGISTERED
    assert sorted(SHOWN) == sorted(FILES)
    assert "```python" not in TEXT  # code that no test runs


@pytest.mark.parametrize("kind", REGISTERED)
def test_each_is_found_by_its_kind(found: dict[str, Any], kind: str) -> None:
    outside = [module for module in found["kinds"][kind] if module.startswith("additions.")]
    assert len(outside) == 1
    assert f"class {REGISTERED[kind]}" in FILES[outside[0].partition(".")[2]] or kind in ("method", "gallery problem")


@pytest.mark.parametrize(
    "name",
    [
        *("loss", "preconditioner", "pixel sampler", "image estimator", "estimator", "optimizer", "step transform"),
        *("method", "plan file", "gallery problem", "renderer", "BSDF"),
    ],
)
def test_each_recovers_a_known_truth(found: dict[str, Any], name: str) -> None:
    before, after = found[name]
    assert after < 0.4 * before


def test_a_run_with_a_foreign_transform_resumes_to_the_bit(found: dict[str, Any]) -> None:
    assert found["resumed"]


def test_each_computes_what_it_says(found: dict[str, Any]) -> None:
    assert found["derivative"] < 1e-6
    assert found["schedule"] == [0.5, 0.5]
    assert found["grey"] == [[1.5, 2.5]]
    assert found["exported BSDF"] == pytest.approx([0.1, 0.2, 0.3])  # Mitsuba had no XML tag for plugins from Python
