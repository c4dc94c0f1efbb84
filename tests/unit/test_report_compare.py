"""Comparing runs: numbers with a closed form, and what is refused or said."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_folders import KEY, Page, write_run

from unrender.app import report
from unrender.app.report import curves, groups, panels, tables
from unrender.app.sweeps.record import stated_error
from unrender.core.errors import InputError
from unrender.losses import metrics
from unrender.runs.folder.reader import ViewPictures, read


def compared(tmp_path: Path, runs: list[Path]) -> dict[str, Any]:
    report.compare(runs, tmp_path / "out")
    return json.loads((tmp_path / "out" / "compare.json").read_text())


def test_equal_time_numbers_have_their_closed_form(tmp_path):
    """Errors 0.5 exp(-t / 4) and 0.5 exp(-t / 2), times a factor per seed: medians, ratio and time are known."""
    runs = []
    times = {"plain": np.arange(1, 9) * 1.0, "rcv": np.arange(1, 17) * 0.5}
    for method, rate in (("plain", 0.25), ("rcv", 0.5)):
        for seed, factor in enumerate((0.7, 1.0, 1.2)):
            errors = factor * 0.5 * np.exp(-rate * times[method])
            runs.append(write_run(tmp_path / f"{method}{seed}", method, seed, times[method], errors))
    found = compared(tmp_path, runs)
    assert found["first"] == "plain"
    assert found["seconds"] == 8.0
    assert [metric["name"] for metric in found["metrics"]] == [KEY, "loss"]
    by_error = found["metrics"][0]
    for i, t in enumerate((2.0, 4.0, 8.0)):
        for method, rate in (("plain", 0.25), ("rcv", 0.5)):
            moment = by_error["methods"][method]["moments"][i]
            assert moment["seconds"] == t
            assert moment["error"]["median"] == pytest.approx(0.5 * np.exp(-rate * t), rel=1e-5)
            assert moment["error"]["low"] == pytest.approx(0.35 * np.exp(-rate * t), rel=1e-5)
            assert moment["error"]["high"] == pytest.approx(0.6 * np.exp(-rate * t), rel=1e-5)
            assert moment["ratio"] == pytest.approx(1.0 if method == "plain" else np.exp(-0.25 * t), rel=1e-5)
    assert by_error["best_of_first"] == pytest.approx(0.5 * np.exp(-2.0), rel=1e-6)
    reached = by_error["methods"]["rcv"]["reached"]
    assert reached["seconds"] == 4.0  # exp(-4 / 2) = exp(-8 / 4)
    assert reached["speedup"] == 2.0
    assert (reached["fastest"], reached["slowest"], reached["count"]) == (3.5, 4.5, 3)
    assert by_error["methods"]["plain"]["reached"]["count"] == 2  # the third seed never came to the median
    page = Page(tmp_path / "out" / "compare.html")
    assert page.dangers() == []
    assert "2× as fast" in page.words
    assert "plain seed 1 (8 s), rcv seed 1 (8 s)" in page.words  # the median runs are the ones pictured


def test_a_first_method_that_never_improves_gives_no_speedup(tmp_path):
    runs = [
        write_run(tmp_path / "plain", "plain", errors=(0.6, 0.7, 0.8, 0.9)),
        write_run(tmp_path / "rcv", "rcv"),
    ]
    found = compared(tmp_path, runs)["metrics"][0]
    assert found["first_improves"] is False
    assert found["methods"]["rcv"]["reached"]["speedup"] is None
    assert "never got below where it began" in Page(tmp_path / "out" / "compare.html").words


def test_a_level_never_reached_is_null(tmp_path):
    runs = [write_run(tmp_path / "rcv", "rcv"), write_run(tmp_path / "plain", "plain", errors=(0.5, 0.45, 0.45, 0.4))]
    reached = compared(tmp_path, runs)["metrics"][0]["methods"]["plain"]["reached"]
    assert reached["seconds"] is None
    assert reached["count"] == 0
    assert "not reached" in Page(tmp_path / "out" / "compare.html").words


def test_several_parameters_come_with_their_mean_relative_error(tmp_path):
    truth = {"a": np.zeros(4), "b": np.zeros(4)}
    initial = {"a": np.full(4, 2.0), "b": np.full(4, 0.5)}
    runs = [write_run(tmp_path / m, m, errors=(0.5, 0.5, 0.5, 0.25), truth=truth, initial=initial) for m in ("x", "y")]
    metrics = compared(tmp_path, runs)["metrics"]
    assert [metric["name"] for metric in metrics] == ["relative parameter error", "loss", "a", "b"]
    last = metrics[0]["methods"]["x"]["moments"][-1]["error"]["median"]
    assert last == pytest.approx((0.25 / 2.0 + 0.25 / 0.5) / 2)


def test_without_truth_the_loss_is_compared(tmp_path):
    alone = {"initial": {KEY: np.zeros((4, 4, 3))}, "parameters": {KEY: np.ones((4, 4, 3))}, "truth": {}, "views": {}}
    found = compared(tmp_path, [write_run(tmp_path / m, m, **alone) for m in ("x", "y")])
    assert [metric["name"] for metric in found["metrics"]] == ["loss"]
    assert found["methods"][0]["image_error"]["median"] is None


def test_runs_are_grouped_by_method_and_settings_but_not_by_seed_or_budget(tmp_path):
    def run(name: str, method: str, seed: int, settings: dict[str, Any]) -> Path:
        return write_run(tmp_path / name, method, seed, settings=settings)

    runs = [
        run("a", "plain", 0, {"spp": 4, "steps": 10, "estimator": "PathGradient(image=Plain(), spp=4)"}),
        run("b", "plain", 1, {"spp": 4, "steps": 20, "estimator": "PathGradient(image=Plain(), spp=4)"}),
        run("c", "plain", 0, {"spp": 8, "steps": 10, "estimator": "PathGradient(image=Plain(), spp=8)"}),
        run("d", "rcv", 0, {"spp": 2, "steps": 10}),
    ]
    found = groups.group([read(path) for path in runs])
    assert [(group.label, len(group.runs)) for group in found] == [
        ("plain (spp 4)", 2),
        ("plain (spp 8)", 1),
        ("rcv", 1),
    ]


def test_a_run_and_its_continuation_are_compared_with_each_other(tmp_path: Path):
    """They were one row, "plain, 2 runs", as if they were of two seeds."""
    runs = [write_run(tmp_path / name, "plain", 0, settings={"steps": steps}) for name, steps in (("a", 10), ("b", 30))]
    runs.append(write_run(tmp_path / "c", "rcv", 0))
    found = groups.group([read(path) for path in runs])
    assert [(group.label, len(group.runs)) for group in found] == [("plain, a", 1), ("plain, b", 1), ("rcv", 1)]


@pytest.mark.parametrize(("rate", "untuned"), [(0.01, True), (0.02, False)])
def test_a_reference_with_its_default_rate_is_named_untuned(tmp_path: Path, rate: float, untuned: bool):
    stock = write_run(tmp_path / "a", "stock", settings={"options": {"learning_rate": rate}})
    notices = compared(tmp_path, [stock, write_run(tmp_path / "b", "plain")])["notices"]
    assert any("default learning rate, not tuned" in line for line in notices) == untuned
    assert compared(tmp_path, [stock])["notices"] == []


def test_what_weakens_a_comparison_is_said(tmp_path):
    runs = [
        write_run(tmp_path / "a", "plain", 0),
        write_run(tmp_path / "b", "plain", 0),
        write_run(
            tmp_path / "c",
            "rcv",
            0,
            hardware={"processor": "another"},
            stopped="interrupted",
            warnings=["mind the gap"],
        ),
    ]
    notices = " ".join(compared(tmp_path, runs)["notices"])
    for part in ("different hardware", "interrupted", "mind the gap"):
        assert part in notices
    assert compared(tmp_path, [write_run(tmp_path / m, m) for m in ("x", "y")])["notices"] == []


@pytest.mark.parametrize(
    ("method", "told"),
    [("plain", ["max_depth was 6, is 4", "parameter x: initial has changed"]), ("rcv", ["max_depth"])],
)
def test_differences_of_two_problems_are_named(tmp_path: Path, method: str, told: list[str]):
    """A method may change the start of an unknown, so that only counts for one method."""
    parts = [
        {"max_depth": depth, "parameter x: initial": f"sha256:{depth}", "estimator": depth} for depth in ("6", "4")
    ]
    of = [{"parameters": [KEY], "views": 1, "loss": "L2()", "max_depth": 6, "fingerprint": part} for part in parts]
    runs = [write_run(tmp_path / "a", "plain", problem=of[0]), write_run(tmp_path / "b", method, 1, problem=of[1])]
    (line,) = (line for line in compared(tmp_path, runs)["notices"] if "another problem" in line)
    assert line.startswith("b is of another problem than a: max_depth was 6, is 4")
    assert all(part in line for part in told)
    assert line.count(";") == len(told) - 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"truth": {"other.data": np.zeros((4, 5, 3))}}, "only one of them recovers"),
        ({"views": {f"view0/{k}": np.ones((3, 4, 3)) for k in ("reference", "result")}}, "view 0 is 4 × 3, not 8 × 6"),
        ({"views": {}}, "view 0 is missing"),
        ({"times": (), "errors": (0.1,)[:0], "parameters": {KEY: np.ones((4, 5, 3))}}, "no step was taken"),
    ],
)
def test_runs_of_another_problem_are_refused(tmp_path, change, message):
    runs = [write_run(tmp_path / "a"), write_run(tmp_path / "b", **change)]
    with pytest.raises(InputError, match=message) as raised:
        report.compare(runs, tmp_path / "out")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_compare_refuses_nothing_twice_and_a_file_in_its_place(tmp_path):
    run = write_run(tmp_path / "a")
    with pytest.raises(InputError, match="at least one"):
        report.compare([], tmp_path / "out")
    with pytest.raises(InputError, match="given twice"):
        report.compare([run, run], tmp_path / "out")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="cannot be written"):
        report.compare([run], tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_equal_samples_have_their_closed_form(tmp_path):
    """Errors fall as exp(-n / 400) by samples, at 100 and 200 of them a step: the places of a step's end are known."""
    times = np.arange(1, 9) * 1.0
    runs = []
    for method, samples in (("plain", 100), ("rcv", 200)):
        errors = 0.5 * np.exp(-samples * np.arange(1, 9) / 400)
        runs.append(write_run(tmp_path / method, method, 0, times, errors, samples_per_step=samples))
    found = compared(tmp_path, runs)
    assert found["samples"] == 800
    for method in ("plain", "rcv"):
        moments = found["metrics"][0]["methods"][method]["at_samples"]
        assert [moment["samples"] for moment in moments] == [200, 400, 800]
        assert [moment["seconds"] for moment in moments] == [None] * 3
        for moment in moments:
            assert moment["error"]["median"] == pytest.approx(0.5 * np.exp(-moment["samples"] / 400), rel=1e-5)
            assert moment["ratio"] == pytest.approx(1.0)
    words = Page(tmp_path / "out" / "compare.html").words
    assert "after 800 paths" in words
    assert "At equal samples" in words


def test_methods_that_start_elsewhere_are_relative_to_one_start(tmp_path):
    """As `auto` does where the brightness tells of a better start: its own start would make the same end look five times worse."""
    truth = {"a": np.zeros((2, 1)), "b": np.zeros((2, 1))}
    far, near = ({"a": truth["a"] + 0.5, "b": truth["b"] + b} for b in (0.5, 0.05))
    runs = [
        write_run(tmp_path / "x", "x", truth=truth, initial=far),
        write_run(tmp_path / "y", "y", truth=truth, initial=near),
    ]
    found = compared(tmp_path, runs)["metrics"][0]
    assert found["name"] == "relative parameter error"
    for method in ("x", "y"):
        assert found["methods"][method]["moments"][-1]["error"]["median"] == pytest.approx(0.2)
    chart = tables.charts_of_runs({"x": read(runs[0]), "y": read(runs[1])}, {"x": 0, "y": 1}, "seconds")[0]
    assert chart.description == "x: from 1 to 0.2; y: from 0.55 to 0.2"
    start = dict.fromkeys(truth, 0.5)
    assert [stated_error(read(run), start)[0] for run in runs] == [pytest.approx(0.2)] * 2


def test_environment_maps_are_compared_without_their_repeated_columns(tmp_path):
    """They would count twice in the mean error."""
    truth = {"sky.data": np.full((4, 6, 3), 0.5)}
    found = truth["sky.data"] + 0.1
    found[:, [0, -1]] = 9.0
    of = {"parameters": ["sky.data"], "views": 1, "measures": {"sky.data": {"role": "value", "repeated": 1}}}
    runs = [write_run(tmp_path / m, m, truth=truth, parameters={"sky.data": found}, problem=of) for m in ("x", "y")]
    report.compare(runs, tmp_path / "out")
    page = Page(tmp_path / "out" / "compare.html")
    assert "4 × 4 × 3; in sRGB" in page.words
    assert page.words.count("mean 0.1 ") == 2
    assert page.picture("sky.data : error of x").shape == (4, 4, 3)


def test_pictures_are_measured(tmp_path):
    """The medians over seeds of measures that are known by themselves."""
    reference = np.linspace(0.05, 0.6, 12 * 16 * 3).reshape(12, 16, 3).astype(np.float32)
    runs, wanted = [], {"plain": (1.1, 1.2, 1.3), "rcv": (1.02, 1.03, 1.04)}
    for method, factors in wanted.items():
        for seed, factor in enumerate(factors):
            views = {"view0/reference": reference, "view0/result": reference * np.float32(factor)}
            runs.append(write_run(tmp_path / f"{method}{seed}", method, seed, views=views))
    found = {of["label"]: of["images"] for of in compared(tmp_path, runs)["methods"]}
    for method, factors in wanted.items():
        for name, of in {"RMSE": metrics.rmse, "relative MSE": metrics.relative_mse, "PSNR": metrics.psnr}.items():
            values = [of(reference * np.float32(factor), reference) for factor in factors]
            assert found[method][name]["median"] == pytest.approx(values[1], rel=1e-5)
            assert found[method][name]["low"] == pytest.approx(min(values), rel=1e-5)
    page = Page(tmp_path / "out" / "compare.html").words
    assert "PSNR ↑" in page
    assert "SSIM ↑" in page
    assert ("FLIP ↓" in page) == metrics.has_flip()


def test_pixels_that_a_mask_leaves_out_decide_nothing(tmp_path):
    """One method is exact where the mask counts, and far off beside it; the other is a little off everywhere."""
    reference = np.linspace(0.05, 0.6, 12 * 16 * 3).reshape(12, 16, 3)
    mask = np.tile(np.where(np.arange(16) < 8, 0.0, 1.0), (12, 1))
    mask[:, 8] = 0.5
    runs = []
    for method, picture in (("x", reference + 5.0 * (mask == 0)[..., None]), ("y", reference + 0.05)):
        views = {
            "view0/reference": reference,
            "view0/result": picture,
            "view0/initial": 0 * picture,
            "view0/mask": mask,
        }
        runs.append(write_run(tmp_path / method, method, views=views))
    exact, off = compared(tmp_path, runs)["methods"]
    assert exact["image_error"]["median"] == exact["images"]["RMSE"]["median"] == 0.0
    assert exact["images"]["relative MSE"]["median"] == 0.0
    assert exact["images"]["SSIM"]["median"] == pytest.approx(1.0)
    assert off["image_error"]["median"] == pytest.approx(0.05, rel=1e-4)
    assert off["images"]["RMSE"]["median"] == pytest.approx(0.05, rel=1e-4)
    assert off["images"]["SSIM"]["median"] < 1.0
    if metrics.has_flip():
        assert exact["images"]["FLIP"]["median"] == 0.0 < off["images"]["FLIP"]["median"]
    weights = mask[..., None] / (3 * mask.sum())
    before = float(np.sqrt(np.sum(weights * reference**2)))
    (row,) = tables.view_rows(read(runs[0]))
    assert (row.before, row.after) == (pytest.approx(before, rel=1e-5), 0.0)
    pictures = [ViewPictures(np.where(mask[..., None] > 0, reference, x), reference, mask=mask) for x in (0.0, 50.0)]
    assert len({panels.view_of_run(0, of).note for of in pictures}) == 1, "the exposure"
    np.savez(
        runs[0] / "pictures.npz", **{"view0/reference": reference, "view0/result": reference, "view0/mask": 0 * mask}
    )
    with pytest.raises(InputError, match="view0/mask: expected numbers from 0 to 1, not all 0"):
        read(runs[0])


def test_metrics_of_some_views_only_are_said(tmp_path, monkeypatch):
    views = {
        f"view{view}/{kind}": np.full((8, 8, 3), 0.5 + view) for view in range(3) for kind in ("reference", "result")
    }
    runs = [write_run(tmp_path / m, m, views=views) for m in ("x", "y")]
    said = "Metrics of the last pictures are means over the first 2 of 3 views."
    assert said not in compared(tmp_path, runs)["notices"]
    monkeypatch.setattr(curves, "MOST_PIXELS", 128)
    assert said in compared(tmp_path, runs)["notices"]


def test_equal_pictures_are_infinitely_good_and_still_a_page(tmp_path):
    one = np.full((8, 8, 3), 0.5)
    views = {f"view0/{kind}": one for kind in ("reference", "result")}
    found = compared(tmp_path, [write_run(tmp_path / m, m, views=views) for m in ("x", "y")])
    assert found["methods"][0]["images"]["PSNR"]["median"] is None  # infinity has no JSON
    assert "∞" in Page(tmp_path / "out" / "compare.html").words


def test_without_its_package_flip_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(metrics, "has_flip", lambda: False)
    found = compared(tmp_path, [write_run(tmp_path / m, m) for m in ("x", "y")])
    assert "FLIP" not in found["methods"][0]["images"]


@pytest.mark.parametrize("kind", ["reference", "truth"])
def test_another_reference_or_truth_is_another_problem_and_rounding_is_not(tmp_path, kind):
    def run(name: str, factor: float) -> Path:
        value = np.linspace(0.1, 0.6, 4 * 5 * 3).reshape(4, 5, 3)
        views = {"view0/reference": value, "view0/result": value}
        if kind == "truth":
            return write_run(tmp_path / name, name, truth={KEY: value * factor})
        return write_run(tmp_path / name, name, views=views | {"view0/reference": value * factor})

    first, rounded, other = run("first", 1.0), run("rounded", 1 + 1e-6), run("other", 1.1)
    notices = compared(tmp_path, [first, rounded])["notices"]
    assert [line for line in notices if "differs" in line] == [line for line in notices if kind == "reference"]
    with pytest.raises(
        InputError, match=r"other: another problem than .*first: .*another (reference|true value)"
    ) as raised:
        report.compare([first, other], tmp_path / "refused")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "refused").exists()
