"""Bias of a loss's derivative from noisy images (RCV Fig. 7); Fig. 6 is `volumes.fig6_landscape`.

The derivative of the loss by each pixel at step 20 of a real descent on `indirect-room`, from a plain render and from a control
variate that took the same 20 steps: the mean over runs less the derivative at a converged image, its mean square freed of the runs'
noise, and the variance. "debiased" is the plain render's with its bias subtracted, which 256 more renders estimate (Eq. 14): an
ablation, at 257 times the samples. Derivatives are per pixel, times the number of pixels and channels, so that L1's are ±1.
"""

from __future__ import annotations

from typing import Any

import unrender as ur
from benchmarks import figures, markdown
from benchmarks.derivative_bias import METHODS, derivatives
from benchmarks.paths import converged, descent
from benchmarks.runner.records import Record
from benchmarks.suite.scenes import LOSSES

KEY = "back.bsdf.reflectance.data"
QUICK = {"resolution": 8, "runs": 3, "step": 3, "renders": 4, "reference_spp": 256}


def run(
    resolution: int = 40, runs: int = 24, spp: int = 4, step: int = 20, renders: int = 256, reference_spp: int = 8192
) -> dict[str, Any]:
    """Return the bias and the variance of both derivatives.

    Args:
        step: of the descent
        renders: that estimate the bias of Eq. 14
    """
    problem = ur.gallery.problem("indirect-room", resolution=resolution, texture_resolution=resolution, loss="L1")
    path = descent(problem, ur.PathGradient(spp=16), 0.02, step + 1)
    target = converged(problem, {KEY: problem.renderer.array(problem.truth[KEY])}, reference_spp).mean
    fig7, maps = derivatives(problem, path, LOSSES, target, spp, runs, renders, reference_spp)
    return {"fig7": fig7, "maps": maps}


def table(record: Record) -> str:
    losses = {name: {method: entry[method] for method in METHODS} for name, entry in record["fig7"]["losses"].items()}
    text = "{resolution}², {spp} spp, {runs} runs, step {step}; relative to the derivative's mean."
    return markdown.blocks(
        text.format(**record["settings"]),
        markdown.records(
            "loss | image | bias of the derivative | RMS over pixels | variance",
            "{loss} | {method} | {signed:+.1%} ± {signed_error:.1%} | {rms:.2f} | {variance:.2f}",
            markdown.named(losses, "loss", "", "method"),
        ),
        f"The image's variance is {record['fig7']['image_variance_ratio']:.1f} × lower with the control variate.",
    )


def plot(record: Record) -> figures.Figure:
    """Fig. 7: the derivative of each loss, and the bias of its estimates."""
    kinds = ("reference", "plain", "rcv", "plain/bias", "debiased/bias", "rcv/bias")
    rows = [
        {f"{loss}, {kind}": record["maps"][f"{loss}/{kind}"] for kind in kinds} for loss in record["fig7"]["losses"]
    ]
    return figures.pictures(rows, signed=True)
