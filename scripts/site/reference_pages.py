"""Pages of the reference that are directives for docstrings, with an example each: `make docs` writes them. Tests run the examples."""

from dataclasses import dataclass
from pathlib import Path

__all__ = ["PAGES", "Page", "write_pages"]


@dataclass(frozen=True)
class Page:
    """One page.

    Attributes:
        title: its heading.
        text: one sentence before the example.
        example: Python code, after `import unrender as ur`.
        members: names that the page documents: of modules, or of classes, functions and exceptions with their kind before a space.
        without: names of a module that another page has.
    """

    title: str
    text: str
    example: str
    members: tuple[str, ...]
    without: str = ""

    def markdown(self) -> str:
        """Return the page's text."""
        directives = "\n\n".join(self._directive(member) for member in self.members)
        return (
            f"# {self.title}\n\n{self.text}\n\n```python\nimport unrender as ur\n\n{self.example.strip()}\n```\n\n"
            f"```{{eval-rst}}\n.. currentmodule:: unrender\n\n{directives}\n```\n"
        )

    def _directive(self, member: str) -> str:
        kind, _, name = member.rpartition(" ")
        lines = [f".. auto{kind or 'module'}:: {name}"]
        if kind in ("", "class"):
            lines.append("   :members:")
        if name == "Problem":
            lines.append("   :inherited-members:")
        if name == "Renderer":
            lines.append("   :special-members: __call__")
        if not kind and self.without:
            lines.append(f"   :exclude-members: {self.without}")
        return "\n".join(lines)


EXPONENTIAL = 'problem = ur.gallery.problem("exponential")  # one number, no renderer'
PAGES = {
    "problems": Page(
        "Problems",
        "What is to be recovered, from which images.",
        """
ur.use()
problem = ur.gallery.problem("poster", resolution=16)
print(list(problem.unknowns), problem.views[0].reference.shape)
pictures = ur.render(problem, spp=4)  # of the start
""",
        (
            "function use",
            *("class Problem", "class Parameter", "class View", "class unrender.scene.CoarseToFine"),
            "class unrender.scene.prior.Prior",
            *("class unrender.scene.meshes.MeshRegularizer", "class unrender.scene.meshes.Remeshing"),
            *("function render", "function render_pair", "class unrender.io.Grid"),
            *("function unrender.io.read_grid", "function unrender.io.write_grid"),
        ),
    ),
    "estimators": Page(
        "Gradient estimators",
        "From a problem to an estimate of its loss gradient. Each says what it provides, and whether it is biased. "
        "[Protocols](protocols.md) has what they return.",
        f"""
{EXPONENTIAL}
estimate = ur.estimate(problem, ur.PathGradient(spp=16))
print(estimate.loss, estimate.gradient)
""",
        (
            *("class PathGradient", "class MetaEstimator", "class SmoothedDerivatives", "class GaussNewton"),
            *("class unrender.estimators.HybridGradient", "class unrender.estimators.PathThenNewton"),
            *("class unrender.estimators.LossValues", "class unrender.estimators.StockGradient"),
        ),
    ),
    "images": Page(
        "`ur.images`",
        "Image estimators: the image that the loss sees.",
        "estimator = ur.PathGradient(image=ur.images.RecursiveControlVariate(), spp=4)",
        ("unrender.images",),
    ),
    "pixels": Page(
        "`ur.pixels`",
        "Pixel samplers: the pixels that a step renders.",
        "estimator = ur.PathGradient(pixels=ur.pixels.Adaptive(4096), spp=2)",
        ("unrender.pixels",),
    ),
    "losses": Page(
        "`ur.losses`",
        "The distance of an image from its reference. The protocol is [`Loss`](protocols.md).",
        f"""
{EXPONENTIAL}
problem = problem.replaced(loss=ur.losses.Huber(delta=0.1))
""",
        ("unrender.losses",),
        "Loss",
    ),
    "optimizers": Page(
        "`ur.optimizers`",
        "From an estimate to a step. Optimizers are chains of transforms. The protocols are [`Optimizer` and "
        "`StepTransform`](protocols.md).",
        """
from unrender.optimizers.transforms import GradientMean, ScaleByRms

adam = ur.optimizers.Chain((GradientMean(0.9), ScaleByRms(0.999)), learning_rate=0.01)
""",
        ("unrender.optimizers", "unrender.optimizers.transforms"),
        "Optimizer",
    ),
    "protocols": Page(
        "Protocols of components",
        "A component is an object with the methods of a protocol. [Add a component](../extending/index.md) has a complete "
        "file of each kind, the tutorial [your own estimator](../tutorials/own-estimator.md) runs one. Kinds for `register` "
        "are loss, schedule, parameterisation, preconditioner, pixel sampler, image estimator, estimator, optimizer, step "
        "transform, method and gallery problem.",
        "print(ur.PathGradient().provides)  # an optimizer that requires more is refused",
        ("function register", "unrender.protocols"),
    ),
    "schedules": Page(
        "`ur.schedules`",
        "Factors of a learning rate or of a smoothing width. The protocol is [`Schedule`](protocols.md).",
        """
schedule = ur.schedules.Warmup(20, then=ur.schedules.Cosine(280))
print(schedule(0), schedule(20), schedule(300))
adam = ur.optimizers.Adam(0.02, schedule=schedule)
""",
        ("unrender.schedules",),
        "Schedule",
    ),
    "parameterisations": Page(
        "`ur.parameterisations`",
        "The variable that an optimizer moves in place of a parameter. The protocols are "
        "[`Parameterisation` and `Transform`](protocols.md).",
        'lamp = ur.Parameter("lamp.emitter.radiance.value", 20.0, parameterisation=ur.parameterisations.Log())',
        ("unrender.parameterisations",),
        "Parameterisation",
    ),
    "preconditioners": Page(
        "`ur.preconditioners`",
        "Changes of variables that smooth a gradient. The protocol is [`Preconditioner`](protocols.md).",
        'wall = ur.Parameter("wall.bsdf.reflectance.data", preconditioner=ur.preconditioners.LargeSteps(10.0))',
        ("unrender.preconditioners",),
        "Preconditioner",
    ),
    "runs": Page(
        "Runs",
        "From an estimator and an optimizer to a result. [Protocols](protocols.md) has the base class of callbacks.",
        f"""
{EXPONENTIAL}
result = ur.optimize(problem, ur.PathGradient(spp=16), ur.optimizers.Adam(0.05), steps=40)
print(result.status, result.parameters, result.verification["best"])
""",
        (
            *("function optimize", "function estimate", "function unrender.runs.sensitivity"),
            *("function unrender.runs.uncertainty", "function resume"),
            *("function unrender.app.distribute", "function unrender.app.sweep"),
            *("class unrender.app.sweeps.record.SweepRecord", "class Result"),
            *("class unrender.runs.Live", "class unrender.core.random.Key"),
            *("function unrender.app.export", "function unrender.app.import_capture"),
            *("class unrender.app.ImportOptions", "class unrender.app.capture.importing.Imported"),
            *("function unrender.app.judge", "class unrender.app.evaluation.judge.Judgement"),
            "function unrender.app.turntable",
        ),
    ),
    "renderer": Page(
        "`ur.Renderer`",
        "Images and gradients for a [loop of your own](../guide/own-loop.md).",
        """
ur.use()
import mitsuba as mi
import numpy as np

scene = mi.cornell_box()
scene["sensor"]["film"].update(width=8, height=8)
renderer = ur.Renderer(scene, ["red.reflectance.value"], spp=4)
image = renderer.render([0.5, 0.4, 0.3])
gradient = renderer.backward(2 * (image - 0.3) / image.size)  # of mean((image - 0.3)²)
print(gradient["red.reflectance.value"])
""",
        ("class Renderer",),
    ),
    "errors": Page(
        "Errors",
        "What a caller may catch.",
        """
try:
    ur.optimizers.Adam(learning_rate=-1)
except ur.InputError as error:
    print(error)
""",
        ("exception UnrenderError", "exception InputError", "exception VariantError"),
    ),
    "smoothed": Page(
        "`ur.smoothed`",
        "Smoothed derivatives of [any function](../guide/any-function.md) that can be evaluated.",
        """
value, error = ur.smoothed.gradient(lambda x: abs(x).sum(axis=1), theta=[0.5, -0.2], sigma=0.1, samples=512)
print(value, "±", error)
""",
        ("unrender.estimators.smoothing",),
    ),
    "grey_box": Page(
        "`ur.grey_box`",
        "The same behind a PyTorch network.",
        """
import torch

place = torch.tensor([0.5, -0.2], requires_grad=True)
ur.grey_box.loss(lambda x: abs(x).sum(axis=1), place, sigma=0.1, samples=64, seed=0).backward()
print(place.grad)
""",
        ("unrender.estimators.smoothing.grey_box",),
    ),
    "statistics": Page(
        "`ur.statistics`",
        "The formulas of the papers, on NumPy and Dr.Jit arrays alike.",
        """
from unrender.statistics import welford

state = welford.init(0.0)
for x in (1.0, 2.0, 3.0):
    state = welford.update(state, x, x, 0.9)
print(welford.covariance(state))
""",
        tuple(f"unrender.statistics{part}" for part in ("", ".welford", ".meta", ".gaussian", ".recursion")),
    ),
    "metrics": Page(
        "`ur.losses.metrics`",
        "Differences of pictures in numbers.",
        """
import numpy as np

reference = np.random.default_rng(0).uniform(0, 1, (16, 16, 3))
picture = 0.9 * reference
print(ur.losses.metrics.rmse(picture, reference), ur.losses.metrics.ssim(picture, reference))
""",
        ("unrender.losses.metrics", "unrender.scene.surfaces"),
    ),
    "report": Page(
        "`unrender.app.report`",
        "Pages made from run folders.",
        f"""
from unrender.app import report

{EXPONENTIAL}
for name in ("a", "b"):
    ur.optimize(problem, ur.PathGradient(), ur.optimizers.Adam(), steps=20, run_directory=f"out/{{name}}")
report.page("out/a")
report.compare(["out/a", "out/b"], "out/compare.html")
""",
        ("unrender.app.report",),
    ),
    "gallery": Page(
        "`ur.gallery`",
        "Problems made by code, with known truth. The [gallery](../gallery/index.md) has a picture of each.",
        """
print(ur.gallery.names())
print(ur.gallery.summary("poster"), [option.name for option in ur.gallery.options("poster")])
""",
        ("unrender.gallery",),
    ),
}
"""Pages by file name."""


def write_pages(folder: Path) -> None:
    """Write all pages to the folder of the reference."""
    for name, page in PAGES.items():
        (folder / f"{name}.md").write_text(page.markdown())
