"""What the README, the pages of the site and the docstrings show is true: every code block is executed or checked (`documents`)."""

from __future__ import annotations

import ast
import importlib
import itertools
import pkgutil
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import documents
import pytest
from documents import ROOT, Runner, blocks, previous_pages

import unrender as ur
from tiers import quick

DOCS = ROOT / "docs"
SITE = ROOT / "scripts" / "site"
sys.path.insert(0, str(SITE))
import reference_pages  # noqa: E402

# docs/extending has tests of its own, which install its files; the commands of results.md take hours.
PAGES = [
    ROOT / "README.md",
    *sorted(
        page
        for page in DOCS.rglob("*.md")
        if page.name not in ("results.md", "contributing.md")
        and not {"benchmarks", "extending", "gallery", "tutorials"} & set(page.relative_to(DOCS).parts)
    ),
    *sorted((ROOT / "examples" / "tutorials").glob("*.md")),
]
SLOW = {
    "README.md",
    "quickstart.md",
    *("material.md", "light.md", "medium.md", "pose.md", "mesh.md", "camera.md", "any-function.md", "photographs.md"),
    *("own-loop.md", "own-estimator.md", "losses.md", "speed.md", "stages.md", "sweeps.md", "runs.md", "watching.md"),
    *("exporting.md", "surfaces.md", "volumes.md", "poses.md", "lamps.md", "parameterisations.md", "light-pose.md"),
    *("texture.md", "command-line.md"),
}

# What the example of a docstring takes as given.
GIVEN = {
    "unrender.core.phases": "",
    "unrender": "",
    "unrender.app.exporting.scene_folder.export": """
        import unrender as ur
        problem = ur.gallery.problem("indirect-room", resolution=16, texture_resolution=8)
        result = ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(), 2, run_directory="out/indirect-room-auto")
    """,
    "unrender.gallery.problem": "from unrender.gallery import problem",
    "unrender.own_loop.renderer.Renderer": """
        import unrender as ur
        ur.use("llvm_ad_rgb")
        import mitsuba as mi
        import numpy as np
        scene = mi.cornell_box()
        scene["sensor"]["film"].update(width=8, height=8)
        parameters, steps, derivative = {"red.reflectance.value": [0.5, 0.4, 0.3]}, 2, np.ones((8, 8, 3))
        renderer = ur.Renderer(scene, ["red.reflectance.value"])
    """,
    "unrender.rendering.mitsuba.emissive": "volume = None",
    "unrender.estimators.smoothing.function": """
        import unrender as ur
        def f(x): return (x**2).sum(axis=1)
        theta = [0.5, -0.2]
    """,
    "unrender.estimators.smoothing.grey_box": """
        import torch
        import unrender as ur
        pictures = torch.ones(3, 4)
        network = torch.nn.Linear(4, 2)
        def f(points, items): return (points**2).sum(axis=1)
    """,
}
GROUPS = ("app", "estimators", "io", "runs", "scene")
"""Packages whose public names the reference lists one by one."""
SLOW_EXAMPLES = {
    "unrender.app.exporting.scene_folder.export",
    "unrender.own_loop.renderer.Renderer",
    "unrender.estimators.smoothing.grey_box",
}
ILLUSTRATIONS = {
    "unrender.optimizers.recipes.Chain": "the names are not imported; the page of optimizers runs such one",
    "unrender.optimizers.partitioned.Partitioned": "the names are not imported; tests/unit/test_mesh_descent.py makes such ones",
    "unrender.core.registry": "a class is shown without its methods",
    "unrender.app.distributed.distribute.distribute": "it starts worker processes, as tests/render/test_dealt_runs.py does",
    "unrender.app.cli.sweep.sweep": "it starts worker processes; tests/cli/test_sweep_command.py has a sweep from Python",
}


@pytest.fixture
def small_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """An empty folder, and few steps and samples whatever a block asks for."""
    import matplotlib

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "400")
    matplotlib.use("Agg")
    optimize, resume, problem = ur.optimize, ur.resume, ur.gallery.problem

    def few(steps: int | None, seconds: float | None, most: int) -> dict[str, Any]:
        return {"steps": None if steps is None else min(steps, most), "seconds": None if seconds is None else 0.2}

    def optimize_briefly(*given: Any, steps: Any = None, seconds: Any = None, **options: Any) -> ur.Result:
        positional = list(given)
        if len(positional) > 3:
            steps = positional.pop()
        return optimize(*positional, **few(steps, seconds, 2), **options)

    def resume_briefly(*given: Any, steps: Any = None, seconds: Any = None, **options: Any) -> ur.Result:
        return resume(*given, **few(steps, seconds, 4), **options)

    def problem_of_noisy_references(name: str, **options: Any) -> ur.Problem:
        if "reference_spp" in {option.name for option in ur.gallery.options(name)}:
            options["reference_spp"] = 4
        return problem(name, **options)

    monkeypatch.setattr(ur, "optimize", optimize_briefly)
    monkeypatch.setattr(ur, "resume", resume_briefly)
    monkeypatch.setattr(ur.gallery, "problem", problem_of_noisy_references)
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def _parameters() -> list[Any]:
    return [
        pytest.param(page, id=str(page.relative_to(ROOT)), marks=[pytest.mark.slow] if page.name in SLOW else [])
        for page in PAGES
        if blocks(page)
    ]


@pytest.mark.parametrize("page", _parameters())
@pytest.mark.usefixtures("small_runs")
def test_every_block_of_a_page_is_true(
    page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = [block.text for block in blocks(page)]
    if any("import torch" in text for text in texts):
        pytest.importorskip("torch")
    if any("ur.register" in text for text in texts):  # what a page registers is gone after it
        registry = importlib.import_module("unrender.core.registry")
        monkeypatch.setattr(registry, "_components", dict(registry._components))
        monkeypatch.setattr(registry, "_state_modules", set(registry._state_modules))
    for each in itertools.chain(previous_pages(page), [page]):  # one after the other: what comes between is done, too
        runner = Runner(each.stem, capsys.readouterr)
        # What a page makes goes with it: scenes whose parameters have gradients would be seen by the kernels of other tests.
        monkeypatch.setitem(sys.modules, runner.module.__name__, runner.module)
        for block in blocks(each):
            runner.run(block)


@pytest.mark.parametrize(
    "name", quick(reference_pages.PAGES, *(reference_pages.PAGES.keys() - {"problems", "renderer", "grey_box"}))
)
@pytest.mark.usefixtures("small_runs")
def test_the_examples_of_the_reference_run(name: str) -> None:
    page = reference_pages.PAGES[name]
    if "torch" in page.example:
        pytest.importorskip("torch")
    exec(f"import unrender as ur\n{page.example}", {})


def test_few_blocks_are_skipped_and_each_says_why():
    skipped = [block for page in PAGES for block in blocks(page) if block.marker.startswith("skip")]
    for block in skipped:
        assert re.fullmatch(r"skip, .{10,}", block.marker), block.place
    assert len(skipped) <= 10


def test_pages_are_short():
    """All text below docs has at most 150 KiB, and no page of the guide more than 150 lines. Built pages have other folders or names."""
    built = {"benchmarks", "gallery", "tutorials", "reference"}
    pages = [page for page in DOCS.rglob("*.md") if not built & set(page.relative_to(DOCS).parts)]
    assert sum(len(page.read_bytes()) for page in pages if page.name != "equations.md") < 150 << 10
    assert [
        page.name for page in (DOCS / "guide").glob("*.md") if page.read_text(encoding="utf-8").count("\n") > 150
    ] == []


def _source(module: str) -> Path:
    base = ROOT / "src" / Path(*module.split("."))
    return base / "__init__.py" if base.is_dir() else base.with_suffix(".py")


def _module(name: str) -> str:
    """The module that a qualified name is in, or is."""
    return name if _source(name).is_file() else name.rpartition(".")[0]


def _of_source(module: str) -> Iterator[tuple[str, str]]:
    """(qualified name, docstring) of a module and its classes and functions, private ones among them."""
    for node in ast.walk(ast.parse(_source(module).read_text(encoding="utf-8"))):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and (text := ast.get_docstring(node)):
            yield (module if isinstance(node, ast.Module) else f"{module}.{node.name}"), text


def _examples(module: str) -> list[tuple[str, str]]:
    """(qualified name, code) of every indented block that is Python, of the docstrings of a module, its classes and functions."""
    found = []
    for name, text in _of_source(module):
        for paragraphs in re.findall(r"(?:(?<=\n\n)|\A)((?: {4}.*\n?|\n(?= {4}))+)", text):
            code = "\n".join(line[4:] for line in paragraphs.splitlines())
            try:
                body = compile(code, name, "exec", ast.PyCF_ONLY_AST).body  # pyright: ignore[reportAttributeAccessIssue]
            except SyntaxError:
                continue  # a formula, a table
            if body:
                found.append((name, code))
    return found


def test_every_example_of_a_docstring_is_known():
    """To this file: what it takes as given, or why it is not run."""
    modules = ["unrender", *(module.name for module in pkgutil.walk_packages(ur.__path__, "unrender."))]
    assert {name for module in modules for name, _ in _examples(module)} == GIVEN.keys() | ILLUSTRATIONS.keys()


@pytest.mark.parametrize("name", quick(GIVEN, *(GIVEN.keys() - SLOW_EXAMPLES)))
@pytest.mark.usefixtures("small_runs")
def test_the_examples_of_docstrings_run(name: str) -> None:
    given = "\n".join(line.removeprefix("        ") for line in GIVEN[name].splitlines())
    if "torch" in given:
        pytest.importorskip("torch")
    codes = [code for known, code in _examples(_module(name)) if known == name]
    assert codes
    for code in codes:
        namespace: dict[str, Any] = {}
        exec(given, namespace)
        exec(code, namespace)


def test_the_fields_of_the_documented_problem_file_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = importlib.import_module("unrender.scene.toml_file").__doc__ or ""
    shown = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    ") or not line)
    documents.check_toml(shown, "unrender.scene.toml_file")


PUBLIC_MODULES = {
    "images": "unrender.images", "pixels": "unrender.pixels", "losses": "unrender.losses", "optimizers": "unrender.optimizers",
    "schedules": "unrender.schedules", "preconditioners": "unrender.preconditioners",
    "parameterisations": "unrender.parameterisations", "smoothed": "unrender.estimators.smoothing",
    "statistics": "unrender.statistics", "metrics": "unrender.losses.metrics", "report": "unrender.app.report",
    "gallery": "unrender.gallery", "protocols": "unrender.protocols",
}  # fmt: skip


def test_the_reference_has_every_public_name():
    """By a directive of its own, or by one for its module, which documents what `__all__` lists."""
    text = "\n".join(page.markdown() for page in reference_pages.PAGES.values())
    single = set(re.findall(r"auto(?:class|function|exception):: (\w+)$", text, re.MULTILINE))
    whole = set(re.findall(r"automodule:: ([\w.]+)$", text, re.MULTILINE))
    for name in {*ur.__all__, *ur._MODULES} - {"io", "grey_box"}:
        protocol = name in getattr(ur.protocols, "__all__")  # noqa: B009
        assert name in single or protocol or name in GROUPS or PUBLIC_MODULES.get(name) in whole, name
    for group in GROUPS:
        for name in getattr(ur, group).__all__:
            assert name in single or re.search(
                rf"auto(?:class|function):: unrender\.{group}\.{name}$", text, re.MULTILINE
            ), name


@pytest.fixture
def site_pages(mitsuba_variant: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module that builds pages of the site."""
    monkeypatch.syspath_prepend(str(SITE))
    return importlib.import_module("site_pages")


def without_a_meaning(page: str) -> list[str]:
    """The arguments of tables whose last cell is empty."""
    return re.findall(r"^\| `(\w+)` \| .*?\|\s+\|$", page, re.MULTILINE)


def test_every_argument_has_a_default_and_a_meaning(site_pages: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    page = site_pages.arguments_page()
    assert len(re.findall(r"^\| `\w+` \|", page, re.MULTILINE)) > 200
    assert without_a_meaning(page) == []
    monkeypatch.setattr(ur.losses.Huber, "__doc__", "Without its arguments.")
    assert without_a_meaning(site_pages.arguments_page()) == ["delta"]


def test_names_that_have_moved_warn_and_are_the_same() -> None:
    for name, home in ur._MOVED.items():
        with pytest.warns(DeprecationWarning, match=rf"unrender\.{name} is now unrender\.{home}"):
            found = getattr(ur, name)
        module, _, own = home.rpartition(".")
        place = importlib.import_module(f"unrender.{module}")
        assert found is (getattr(place, own) if hasattr(place, own) else importlib.import_module(f"unrender.{home}")), (
            name
        )
    with pytest.raises(AttributeError):
        _ = ur.nothing


DESIGN = (
    "use Problem Parameter View losses Renderer register images pixels PathGradient MetaEstimator SmoothedDerivatives optimizers "
    "preconditioners optimize estimate Estimate Result render_pair statistics smoothed gallery InputError VariantError UnrenderError"
)
"""Names on which scripts rely, and which stay."""


def test_a_first_script_needs_few_names_and_those_of_the_design_stay() -> None:
    assert len(ur.__all__) <= 28
    assert set(DESIGN.split()) <= set(ur.__all__)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in {*ur.__all__, *ur._MODULES} - {"grey_box"}:  # needs PyTorch
            assert getattr(ur, name) is not None
            assert name in dir(ur)
    assert not set(ur._MOVED) & {*ur.__all__, *ur._MODULES}


def test_names_in_the_pages_exist():
    """`unrender.a.b` and `ur.a.b` in backticks."""
    for page in PAGES:
        for name in re.findall(r"(?<!group )`(?:unrender|ur)\.([\w.]+)(?:\(.*?\))?`", page.read_text(encoding="utf-8")):
            assert _resolve(name.rstrip(".")), f"{page.relative_to(ROOT)}: unrender.{name}"


def _resolve(name: str) -> bool:
    if name.startswith("grey_box"):  # needs PyTorch
        return (
            f"def {name.rpartition('.')[2]}" in (ROOT / "src/unrender/estimators/smoothing/grey_box.py").read_text()
            or "." not in name
        )
    found: Any = ur
    parts = name.split(".")
    for index, part in enumerate(parts):
        if not hasattr(found, part):
            try:
                found = importlib.import_module(".".join(["unrender", *parts[: index + 1]]))
                continue
            except ImportError:
                return False
        found = getattr(found, part)
    return True


def test_files_and_folders_that_the_design_notes_name_exist():
    text = (DOCS / "design-notes.md").read_text(encoding="utf-8")
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", text):
        assert (ROOT / "src" / "unrender" / name).exists() or (ROOT / name).exists(), name


def test_links_of_the_readme_lead_to_files():
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / "README.md").read_text(encoding="utf-8")):
        assert (ROOT / target).exists(), target


def test_the_stub_has_every_public_name():
    """What a type checker sees, the names under TYPE_CHECKING, is what `__all__` lists and the module gives."""
    tree = ast.parse((ROOT / "src/unrender/__init__.py").read_text(encoding="utf-8"))
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname or alias.name
        for node in ast.walk(checked)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    plain = {"use", "InputError", "UnrenderError", "VariantError"}
    assert seen | plain == {*ur.__all__, *ur._MODULES}
    assert all(hasattr(ur, name) for name in ur.__all__)
    assert (ROOT / "src/unrender/py.typed").is_file()
