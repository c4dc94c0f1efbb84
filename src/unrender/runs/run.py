"""A run: components, budget, parameters, history, its state from step to step, and the noise of its gradient."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.core import arrays, memory, trees
from unrender.core.signals import GRACEFUL
from unrender.core.trees import Tree
from unrender.estimators.base import Estimate, Estimator, pixel_weights
from unrender.methods.plan import Plan
from unrender.optimizers.base import Choosing, Measuring, Optimizer
from unrender.runs.number_means import NumberTrace
from unrender.runs.result import INTERRUPTED, TERMINATED, Result
from unrender.scene.problem import Problem

if TYPE_CHECKING:
    from unrender.runs.callbacks import Callback


@dataclass
class Run:
    """A run, with everything that belongs to it. Callbacks get it.

    Attributes:
        plan: Plan of the run, with the problem as passed.
        problem: Problem with the plan's settings and the current meshes.
        steps, seconds: the budget; None for no limit.
        folder: the run folder; None without one.
        step: number of completed steps.
        clock: seconds of optimisation so far.
        parameters: current parameters (arrays of the renderer), possibly at a coarse resolution.
        state: further state from step to step.
        description: fields of `Result` that are known before the first step, see `metadata.describe_run`.
        initial: {key: array}, initial parameters at the scene's resolution.
        history: one record per step.
        warmup_seconds: seconds of tracing and compiling.
        skipped: number of steps that were not applied.
        ahead: number of steps by which resolutions are ahead of the schedule of `CoarseToFine`, see `refinement.hurry`.
        few_steps: the one of them that says that the budget allows few steps; "" for none.
        stopped: reason to end after the current step; "" for none.
        deadline: time of `time.perf_counter` at which everything should be finished, with final images; None without such a budget.
        last_step: time of `time.perf_counter` at which the steps should end, so that everything fits into the budget; None if the budget
            covers the steps only.
        resumed: steps after which the run was resumed; None for a new run.
        before: seconds of the budget before the first step.
        grace: seconds after the deadline at which the end of the run may still be busy.
        trial: seconds and samples of the last step of the warm-up.
        replanned: whether the plan has been replaced by one with shorter steps, see `budget.shorter_steps`.
        tracing: seconds by which the first step of the warm-up took longer than the last one with as many paths; all of it for one step.
        compiled: whether kernels were compiled in the warm-up.
        tested: whether the budget has time for tests at the end, whose kernels the warm-up has then compiled.
    """

    plan: Plan
    problem: Problem
    estimator: Estimator
    optimizer: Optimizer
    seed: int
    steps: int | None
    seconds: float | None
    parameters: Tree
    state: RunState
    callbacks: Sequence[Callback] = ()
    description: dict[str, Any] = field(default_factory=dict)
    initial: dict[str, np.ndarray] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)
    warmup_seconds: float = 0.0
    folder: Path | None = None
    step: int = 0
    clock: float = 0.0
    estimate: Estimate | None = None
    skipped: int = 0
    ahead: int = 0
    warnings: list[str] = field(default_factory=list)
    few_steps: str = ""
    stopped: str = ""
    resumed: Sequence[int] | None = None
    last_step: float | None = None
    deadline: float | None = None
    before: float = 0.0
    grace: float = math.inf
    trial: tuple[float, int] = (0.0, 0)
    replanned: bool = False
    tracing: float = 0.0
    compiled: bool = False
    tested: bool = True

    def begin_budget(self, began: float | None) -> None:
        """Set the deadline of a budget in seconds that counts from `began`; None for one that covers the steps alone."""
        self.deadline = None if began is None or self.seconds is None else began + self.seconds

    def time_left(self) -> float:
        """Return the seconds until the deadline, which may be below 0; infinity without one."""
        return math.inf if self.deadline is None else self.deadline - time.perf_counter()

    def stop(self, reason: str = "callback") -> None:
        """End the run after the current step."""
        self.stopped = self.stopped or reason

    def full(self) -> dict[str, np.ndarray]:
        """Return the parameters as NumPy arrays at the scene's resolution."""
        return self.problem.full(self.parameters)

    @contextmanager
    def shown(self) -> Iterator[Run]:
        """Yield the run as callbacks see it: parameters that only the plan made coarse have the scene's resolution."""
        present, own = self.parameters, self.plan.problem.coarse_to_fine
        shapes, size = self.problem.shapes(), arrays.shape
        coarse = [k for k in self.problem.coarse_to_fine if k not in own and size(present[k]) != shapes[k]]
        if not coarse:
            yield self
            return
        full = self.full()
        seen = self.parameters = {**present, **{key: self.problem.renderer.array(full[key]) for key in coarse}}
        try:
            yield self
        finally:
            if self.parameters is seen:
                self.parameters = present

    def allowed_seconds(self) -> float:
        """Return the total seconds of steps in the budget, on the run's clock; infinity without a limit."""
        if self.seconds is None:
            return math.inf
        left = math.inf if self.last_step is None else self.last_step - time.perf_counter()
        return min(self.seconds, self.clock + left)

    def progress(self) -> float:
        """Return the used fraction of the budget, in [0, 1]."""
        shares = [self.step / self.steps if self.steps else 0.0, self.clock / self.seconds if self.seconds else 0.0]
        if self.seconds and self.last_step is not None:
            shares.append(1.0 - (self.last_step - time.perf_counter()) / self.seconds)
        return min(max(shares), 1.0)

    def result(self, info: bool = False) -> Result:
        """Return the current result; with `info`, including the information of the last estimate."""
        state, optimizer = self.state.optimizer, self.optimizer
        return Result(
            parameters=self.full(),
            initial=self.initial,
            history=self.history,
            seconds=self.clock,
            warmup_seconds=self.warmup_seconds,
            stopped=self.stopped,
            skipped=self.skipped,
            warnings=[*self.warnings, *(line for callback in self.callbacks for line in callback.warnings(self))],
            info=to_numpy(self.estimate.info) if info and self.estimate else {},
            resumed=self.resumed or (),
            adapted=list(optimizer.choices(state)) if isinstance(optimizer, Choosing) else [],
            standard_error=self._standard_errors(),
            pixel_weights=pixel_weights(self.estimator, self.state.estimator),
            **self.description,
        )

    def _standard_errors(self) -> dict[str, np.ndarray]:
        """Return the standard error of the parameters that have one, in their units; none with a prior, which has its own width."""
        if not isinstance(self.optimizer, Measuring):
            return {}
        coordinates = self.problem.coordinates
        errors = self.optimizer.standard_errors(self.state.optimizer, coordinates.of(self.parameters))
        errors = {key: x for key, x in errors.items() if self.problem.unknowns[key].prior is None}
        slopes = coordinates.slopes({key: self.parameters[key] for key in errors})
        by_x = {key: np.abs(arrays.numpy(slopes[key])) * x if key in slopes else x for key, x in errors.items()}
        return {key: x.astype(np.float32) for key, x in by_x.items()}

    def snapshot(self) -> dict[str, Any]:
        """Return everything that determines the next steps, for checkpoints (`state.pack`)."""
        state, candidate = self.state, self.state.candidate
        parts = {"candidate": candidate and vars(candidate), "ahead": self.ahead, "few_steps": self.few_steps}
        parts |= {"other_start": state.other_start, "numbers": state.numbers.snapshot()}
        parts |= {"pictures": state.pictures, "hidden": dict(state.hidden)}
        return {
            "parameters": self.parameters,
            "step": self.step,
            "clock": self.clock,
            "skipped": self.skipped,
            "warnings": list(self.warnings),
            "estimator": self.problem.executor.collect(state.estimator),
            "optimizer": state.optimizer,
            "noise": dict(vars(state.noise)),
            "zero_gradient": dict(state.zero_gradient),
            "samples": state.samples,
            "skipped_in_a_row": state.skipped_in_a_row,
            "next_error": state.next_error,
        } | {name: part for name, part in parts.items() if part}

    def restore(self, saved: dict[str, Any]) -> None:
        """Restore a snapshot, which has been checked to be one of this run's."""
        self.parameters, self.step, self.clock = saved["parameters"], saved["step"], saved["clock"]
        self.skipped, self.warnings, self.ahead = saved["skipped"], list(saved["warnings"]), saved.get("ahead", 0)
        self.few_steps = str(saved.get("few_steps") or "")
        state = self.state
        state.estimator, state.optimizer = saved["estimator"], saved["optimizer"]
        state.noise = GradientNoise(**saved["noise"])
        state.zero_gradient, state.samples = saved["zero_gradient"], saved["samples"]
        state.skipped_in_a_row, state.next_error = saved["skipped_in_a_row"], saved["next_error"]
        state.candidate = Candidate(**saved["candidate"]) if "candidate" in saved else None
        state.numbers = NumberTrace.restored(saved.get("numbers"))
        state.other_start, state.pictures = str(saved.get("other_start") or ""), saved.get("pictures", {})
        state.hidden = dict(saved.get("hidden", {}))


@dataclass(frozen=True)
class Candidate:
    """Parameters of an earlier step that may be better than the last ones.

    Attributes:
        step: number of completed steps.
        parameters: {key: array} at the scene's resolution.
    """

    step: int
    loss: float
    parameters: dict[str, np.ndarray]


@dataclass
class RunState:
    """State of a run from step to step, in addition to `Run`'s parameters.

    Attributes:
        noise: statistics of the gradient so far.
        zero_gradient: {key: whether its gradient has always been exactly zero}.
        samples: number of paths so far.
        skipped_in_a_row: number of steps since the last applied one.
        next_error: time on the run's clock at which the parameters' error is measured again.
        candidate: best of the tested earlier parameters; None before the first.
        numbers: values of the numbers at each step.
        other_start: outcome of the comparison with other starts, see `runs.refinement`; "" before it.
        pictures: new images of earlier steps, see `earlier_image.stored`; {} before the first.
        hidden: {mesh: number of steps since a picture showed it}, of the meshes that one has shown.
    """

    estimator: Any
    optimizer: Any
    noise: GradientNoise
    zero_gradient: dict[str, bool]
    samples: int = 0
    skipped_in_a_row: int = 0
    next_error: float = 0.0
    candidate: Candidate | None = None
    numbers: NumberTrace = field(default_factory=NumberTrace)
    other_start: str = ""
    pictures: dict[str, Any] = field(default_factory=dict)
    hidden: dict[str, int] = field(default_factory=dict)


SNAPSHOT_COUNTS = ("step", "clock", "skipped", "samples", "skipped_in_a_row", "next_error")
"""Fields of a snapshot that are finite numbers of at least 0."""


@contextmanager
def interruptible(run: Run) -> Iterator[None]:
    """Let the first Ctrl-C or SIGTERM end the run after the current step; a second one has its previous effect.

    Only in the main thread. SIGTERM is not changed if it has a handler, unless the handler has the attribute `GRACEFUL`, or if the run
    has no folder that stores its result.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reasons = {signal.SIGINT: INTERRUPTED}
    terminated = signal.getsignal(signal.SIGTERM)
    if (terminated is signal.SIG_DFL and run.folder is not None) or hasattr(terminated, GRACEFUL):
        reasons[signal.SIGTERM] = TERMINATED
    before = {number: signal.getsignal(number) for number in reasons}

    def restore_handlers() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def stop(number: int, frame: Any) -> None:
        run.stop(reasons[signal.Signals(number)])
        restore_handlers()

    for number in reasons:
        signal.signal(number, stop)
    try:
        yield
    finally:
        restore_handlers()


def raise_termination(run: Run) -> None:
    """End the process by SIGTERM if it stopped the run, which has been saved, and the signal has no handler."""
    if run.stopped == TERMINATED and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.raise_signal(signal.SIGTERM)


def to_numpy(info: Any) -> Any:
    """Convert the Dr.Jit arrays of `Estimate.info` to NumPy."""
    if isinstance(info, Mapping):
        return {key: to_numpy(value) for key, value in info.items()}
    return arrays.numpy(info) if arrays.is_drjit(info) else info


_DECAY = 0.9
_EVERY = 7  # stride at which elements of large arrays are sampled, to save the memory of a mean gradient


@dataclass
class GradientNoise:
    """Estimate of the fraction of noise in the gradient's second moment E‖g‖², from exponential means over about ten steps.

    With decay a, the squared norm of the mean is ‖ḡ‖² + ρ N for total variance N and ρ = (1 - a) / (1 + a). N follows from it and from
    the second moment ‖ḡ‖² + N. A true change of the gradient within ten steps counts as noise, so this is a diagnostic, not an estimate.
    For arrays of a million elements or more, every seventh is sampled.

    Attributes:
        mean: exponentially weighted mean of the gradients, or of their samples; None before the first; with a variance, of `whole` only.
        second_moment, weight: the same of ‖g‖², and the sum of the weights.
    """

    mean: Tree | None = None
    second_moment: float = 0.0
    weight: float = 0.0

    def update(self, gradient: Tree, variance: Tree | None = None, whole: Tree | None = None) -> float | None:
        """Add a gradient, and return the fraction in [0, 1]; None for fewer than ten gradients without variance, and for a zero gradient.

        With the estimator's variance, the result is its fraction of ‖g‖². Gradients of an estimator that reuses earlier samples resemble
        each other, and would otherwise appear free of noise. `whole` are gradients that have a full mean, for `free_of_bounds`.
        """
        whole = whole or {}
        sampled = self._follow(gradient | whole if variance is None else whole, whole)
        if variance is not None:
            sums = sum(map(arrays.total, variance.values())), sum(map(memory.square, gradient.values()))
            arrays.evaluate(sums)
            noise, square = (arrays.number(x) for x in sums)
            return min(noise / square, 1.0) if square > 0 else None
        shares = [
            math.prod(arrays.shape(g)) / math.prod(arrays.shape(x))
            for g, x in zip(gradient.values(), sampled.values(), strict=True)
        ]
        squares = [
            [memory.square(x) * share for x, share in zip(tree.values(), shares, strict=True)]
            for tree in (sampled, self.mean or {})
        ]
        arrays.evaluate(squares)
        square, square_of_mean = (sum(arrays.number(x) for x in s) for s in squares)
        self.second_moment = self.second_moment * _DECAY + square * (1 - _DECAY)
        self.weight = self.weight * _DECAY + (1 - _DECAY)
        if self.weight < 1 - _DECAY**10 or self.second_moment <= 0:
            return None
        mean_square = self.second_moment / self.weight
        rho = (1 - _DECAY) / (1 + _DECAY)
        noise = (mean_square - square_of_mean / self.weight**2) / (1 - rho)
        return min(max(noise / mean_square, 0.0), 1.0)

    def _follow(self, gradient: Tree, whole: Collection[str]) -> Tree:
        """Add a gradient to the mean, and return it, or its samples."""
        some = {key for key, g in gradient.items() if memory.is_large(g) and key not in whole}
        sampled = {key: memory.every(g, _EVERY) if key in some else g for key, g in gradient.items()}
        if not sampled:
            return sampled
        if self.mean is None or trees.shapes(self.mean) != trees.shapes(sampled):
            self.mean, self.second_moment, self.weight = trees.zeros_like(sampled), 0.0, 0.0
        self.mean = trees.map(lambda m, g: m * _DECAY + g * (1 - _DECAY), self.mean, sampled)
        arrays.evaluate(self.mean, sampled)
        return sampled
