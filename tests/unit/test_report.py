"""The page of a run, made from run folders that are written here."""

from __future__ import annotations

import base64
import hashlib
import io
import re
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image
from report_folders import KEY, Page, write_run

from unrender.app import report
from unrender.app.report import curves, panels, tone_mapping
from unrender.display import formatting
from unrender.losses import metrics
from unrender.runs.folder.reader import read


def test_page_is_one_file_that_fetches_nothing_and_runs_only_its_own_script(tmp_path):
    path = report.page(write_run(tmp_path / "run"))
    page = Page(path)
    assert path == tmp_path / "run" / "report.html"
    assert page.dangers() == []
    assert not re.search(r"https?:|@import|url\((?!#)", page.source)
    digest = base64.b64encode(hashlib.sha256("".join(page.scripts).encode()).digest()).decode()
    (policy,) = [meta["content"] for meta in page.all("meta") if "http-equiv" in meta]
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy
    assert not list(path.parent.glob("*.part"))


HOSTILE = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>{{ 1234 * 4321 }}</style></title>"


def test_text_from_the_run_is_inert(tmp_path):
    truth = {HOSTILE: np.full((4, 5, 3), 0.25), HOSTILE + "2": np.array([0.1, 0.2, 0.3])}
    hostile = {
        "name": HOSTILE,
        "command": HOSTILE,
        "warnings": [HOSTILE],
        "settings": {HOSTILE: HOSTILE},
        "stopped": HOSTILE,
        "variant": HOSTILE,
        "versions": {HOSTILE: HOSTILE},
    }
    runs = [write_run(tmp_path / m, m + HOSTILE, truth=truth, **hostile) for m in ("a", "b")]
    for path in (report.page(runs[0]), report.compare(runs, tmp_path / "out")):
        page = Page(path)
        assert page.dangers() == []
        assert page.words.count(HOSTILE) >= 4  # shown as it is, neither executed nor evaluated
        assert "5332114" not in page.words


def test_the_inertness_test_sees_what_it_should(tmp_path):
    """Planted faults: each of these would be found."""
    for planted in (
        "<script>1</script>",
        "<p onclick=x>",
        "<img src='https://a.b'>",
        "<img src=x>",
        "<iframe>",
        "<a href=x>",
    ):
        path = tmp_path / "planted.html"
        path.write_text(f"<script></script>{planted}")
        assert Page(path).dangers(), planted


def test_pictures_are_accessible(tmp_path):
    page = Page(report.page(write_run(tmp_path / "run")))
    assert all(image["alt"] for image in page.all("img"))
    assert all(svg["aria-label"] and svg["role"] == "img" for svg in page.all("svg"))
    sliders = [a for a in page.all("input") if a["type"] == "range" and "aria-label" in a]
    assert len(sliders) == 2  # the view and the map
    assert all("on the left" in slider["aria-label"] for slider in sliders)
    # Until its script runs.
    assert all("hidden" in label for label in page.all("label") if label.get("class") == "exposure")
    radios = {a["id"] for a in page.all("input") if a["type"] == "radio"}
    assert radios == {label["for"] for label in page.all("label") if "for" in label}


def test_page_opens_only_when_asked(tmp_path, monkeypatch):
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    run = write_run(tmp_path / "run")
    report.page(run)
    assert opened == []
    path = report.page(run, open_after=True)
    assert opened == [path.as_uri()]


# Pictures


def test_srgb_has_the_standards_values():
    assert np.allclose(
        tone_mapping.srgb(np.array([-1.0, 0.0, 0.0031308, 0.5, 1.0, 9.0, np.nan])),
        [0, 0, 0.04045, 0.735357, 1, 1, 0],
        atol=1e-5,
    )


def test_exposure_takes_the_references_percentile_to_its_place_and_ignores_a_lamp():
    flat = np.full((10, 10, 3), 0.02)
    assert metrics.exposure(flat) == pytest.approx(0.7 / 0.02)
    with_lamp = flat.copy()
    with_lamp[0, :4] = 50.0
    assert metrics.exposure(with_lamp) == pytest.approx(0.7 / 0.02)
    assert metrics.exposure(np.zeros((2, 2, 3))) == 1.0


def test_all_pictures_of_a_view_have_the_references_exposure(tmp_path):
    rng = np.random.default_rng(3)
    reference = rng.uniform(0.01, 0.1, (6, 8, 3)).astype(np.float32)
    views = {"view0/reference": reference, "view0/initial": 2 * reference, "view0/result": 0.7 * reference}
    page = Page(report.page(write_run(tmp_path / "run", views=views)))
    factor = metrics.exposure(reference)
    for alt, linear in {"the reference": 1.0, "the result": 0.7, "before the first step": 2.0}.items():
        expected = tone_mapping.srgb(linear * reference * factor) * 255
        assert np.abs(page.picture(f"View 0: {alt}") - expected).max() <= 0.51
    assert formatting.number(factor) in page.words


def test_control_weight_is_the_mean_over_channels_from_0_to_1(tmp_path):
    reference = np.full((2, 2, 3), 0.5)
    weight = np.zeros((2, 2, 3))
    weight[0, 1], weight[1, 0] = 1.0, [1.0, 0.5, 0.0]
    views = {"view0/reference": reference, "view0/result": reference, "view0/control_weight": weight}
    page = Page(report.page(write_run(tmp_path / "run", views=views)))
    shown = page.picture("View 0: control weight per pixel")
    low, middle, high = [68, 1, 84], [33, 145, 140], [253, 231, 37]  # viridis
    assert np.abs(shown.astype(int) - np.array([[low, high], [middle, low]])).max() <= 2


@pytest.mark.parametrize("name", [tone_mapping.ERROR_COLORMAP, tone_mapping.VALUE_COLORMAP])
def test_colour_maps_are_those_of_matplotlib_without_its_import(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    expected = matplotlib.colormaps[name](np.arange(256))[:, :3]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    values = 2.0 * np.arange(256) / 255.0 + 1.0
    assert np.abs(tone_mapping.apply_colormap(values, 1.0, 3.0, name) - expected).max() < 1.2 / 255.0


def test_error_pictures_of_start_and_result_share_one_scale(tmp_path):
    reference = np.full((4, 4, 3), 0.5)
    result = reference.copy()
    result[0, 0] += 0.1
    views = {"view0/reference": reference, "view0/initial": reference + 0.4, "view0/result": result}
    page = Page(report.page(write_run(tmp_path / "run", views=views)))
    start, end = (page.picture(f"View 0: error {of}") for of in ("before the first step", "of the result"))
    expected = tone_mapping.apply_colormap(np.array([[1.0, 0.5, 0.0]]), 0.0, 1.0, tone_mapping.ERROR_COLORMAP)[0] * 255
    assert np.abs(start - expected[0]).max() <= 1  # 0.4 is the end of the scale
    assert np.abs(end[0, 0] - expected[1]).max() <= 2  # a quarter of it is half-way: square root
    assert np.abs(end[1:] - expected[2]).max() <= 1


def test_large_pictures_are_box_filtered():
    large = np.zeros((2, 3000, 3))
    large[:, ::3] = 0.3
    shown = tone_mapping.INLINE.colour(large, 1.0, "")
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(shown.source.split(",")[1]))))
    assert pixels.shape == (1, 1000, 3)
    assert np.abs(pixels - 255 * tone_mapping.srgb(np.array(0.1))).max() <= 0.51


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((8, 8, 3), True),
        ((8, 8, 1), True),
        ((8, 9), True),
        ((5, 6, 7, 1), True),
        ((4, 4), False),  # a transform
        ((3,), False),
        ((1,), False),
        ((), False),
        ((300,), False),
        ((1, 1, 3), False),
        ((8, 8, 2), False),
    ],
)
def test_what_is_shown_as_a_picture(shape, expected):
    assert panels.is_map(np.zeros(shape)) is expected


def test_maps_scalars_and_volumes(tmp_path):
    volume = np.arange(4 * 5 * 6, dtype=float).reshape(4, 5, 6, 1)
    truth = {
        "grid.data": volume,
        "bsdf.alpha": np.array([0.125]),
        "light.radiance": np.array([0.75, 0.5, 0.25]),
        "environment.data": np.full((4, 8, 3), 7.0),
        "rough.data": np.linspace(0.1, 0.9, 64).reshape(8, 8, 1),
    }
    page = Page(report.page(write_run(tmp_path / "run", truth=truth)))
    assert "0.125" in page.words
    assert "0.75, 0.5, 0.25" in page.words
    for axis, plane in {"z": volume[2], "y": volume[:, 2], "x": volume[:, :, 3]}.items():
        expected = tone_mapping.apply_colormap(plane[..., 0], 0.0, volume.max(), tone_mapping.VALUE_COLORMAP) * 255
        assert np.abs(page.picture(f"grid.data middle slice along {axis}: the truth") - expected).max() <= 0.51
    environment = page.picture("environment.data : the truth")
    assert np.abs(environment - 255 * tone_mapping.srgb(np.array(0.7))).max() <= 0.51  # exposed, for it passes 1


def test_the_table_tells_errors_from_the_truth(tmp_path):
    truth = {"a": np.array([0.0, 0.0]), "b": np.array([1.0])}
    run = write_run(
        tmp_path / "run",
        truth=truth,
        initial={"a": np.array([3.0, 4.0]), "b": np.array([1.5])},
        parameters={"a": np.array([0.3, 0.4]), "b": np.array([1.25])},
    )
    words_of_page = Page(report.page(run)).words
    assert formatting.number(np.sqrt(12.5)) in words_of_page
    assert formatting.number(np.sqrt(0.125)) in words_of_page
    assert "0.25" in words_of_page


def test_the_parameter_error_is_that_of_the_returned_values(tmp_path):
    """The page had the error of the last step's values: 0.032 where the values beside it were off by 0.0009."""
    truth, initial, last = ({"a": np.array([value])} for value in (0.5, 1.5, 0.625))
    run = write_run(tmp_path / "run", errors=(0.9, 0.7, 0.5, 0.3), truth=truth, initial=initial, parameters=last)
    assert "Parameter error 0.125 RMSE, from 1" in Page(report.page(run)).words


def test_numbers_have_their_standard_errors(tmp_path):
    parameters = {"a": np.array([-0.3, 0.4]), "b": np.array([1.25])}
    run = write_run(tmp_path / "run", truth=parameters, parameters=parameters, standard_error={"a": [0.012, 0.034]})
    text = Page(report.page(run)).words
    assert "−0.300 ± 0.012, 0.400 ± 0.034" in text
    assert "1.25 ±" not in text
    assert "one standard error, from the noise" in text


def test_facts_are_labelled_text_and_few_values_are_at_the_top(tmp_path):
    run = write_run(
        tmp_path / "run",
        truth={"a": np.array([-0.2, 0.5])},
        parameters={"a": np.array([-0.3, 0.4])},
        choices=["path gradients of a"],
        settings={"spp": 4, "estimator": "PathGradient(image=Plain())"},
        verification={"status": "finished", "start": [0.0218, 0.00158], "end": [0.0018, 0.0019], "best": "end"},
    )
    text = Page(report.page(run)).words
    assert text.index("Recovered values a −0.3, 0.4") < text.index("How it was made")
    assert "verified.loss at the start 0.0218 ± 0.0016 verified.loss at the end 0.0018 ± 0.0019" in text
    assert "[0.0218" not in text
    assert "PathGradient(" not in text


def test_a_texture_refined_on_the_way_is_shown_without_an_error(tmp_path):
    truth = {KEY: np.full((8, 8, 3), 0.5)}
    run = write_run(tmp_path / "run", truth=truth, initial={KEY: np.zeros((2, 2, 3))})
    page = Page(report.page(run))
    alts = {image["alt"] for image in page.all("img")}
    assert f"{KEY} : error" in alts
    assert f"{KEY} : error at the start" not in alts
    series = curves.parameter_error(read(run), KEY)
    assert series is not None
    assert series.values[0] == 0.4  # the first recorded one


def test_without_truth_pictures_or_steps_there_is_still_a_page(tmp_path):
    bare = write_run(
        tmp_path / "bare",
        truth={},
        initial={KEY: np.zeros((4, 4, 3)), "x": np.zeros(())},
        parameters={KEY: np.ones((4, 4, 3)), "x": np.ones(())},
        views={},
        times=(),
        errors=(),
    )
    page = Page(report.page(bare))
    assert f"{KEY} : start" in {image["alt"] for image in page.all("img")}
    assert page.all("svg") == []
    assert "nan" not in page.words


def test_records_without_a_number_leave_a_gap(tmp_path):
    page = Page(report.page(write_run(tmp_path / "run", loss=(1.0, None, float("inf"), 0.5), skipped=2)))
    assert "2 skipped" in page.words
    (loss,) = {svg["aria-label"] for svg in page.all("svg") if svg["aria-label"].startswith("Loss over Seconds")}
    assert "from 1 to 0.5" in loss


def test_many_views_are_counted_not_all_pictured(tmp_path):
    one = np.full((2, 2, 3), 0.5)
    views = {f"view{i}/{kind}": one for i in range(11) for kind in ("reference", "result")}
    page = Page(report.page(write_run(tmp_path / "run", views=views)))
    assert "3 of them not pictured" in page.words
    assert [f"View {i}" in page.words for i in (0, 7, 8)] == [True, True, False]


def test_a_map_has_its_standard_error_and_what_the_references_decided(tmp_path):
    folder = write_run(tmp_path / "run")
    shape = read(folder).parameters[KEY].shape
    share = np.zeros(shape, np.float32)
    share[:2] = 0.9
    errors: dict[str, Any] = {KEY: np.full(shape, 0.02, np.float32), "other": np.zeros(3)}
    shares: dict[str, Any] = {KEY: share}
    np.savez(folder / "standard_error.npz", **errors)
    np.savez(folder / "data_share.npz", **shares)
    run = read(folder)
    assert set(run.standard_error) == set(run.data_share) == {KEY}
    captions = {item.caption: item for stack in panels.map_of_run(run, KEY).stacks for item in stack}
    assert captions["Standard error"].note == "mean 0.02"
    assert captions["Decided by the references"].note.startswith(f"{2 / shape[0]:.0%} decided by the references")


def test_a_map_without_standard_errors_has_the_reason(tmp_path):
    said = "no map of standard errors: pictures may not change in proportion to it"
    run = read(write_run(tmp_path / "run", without_errors=[f"{KEY}: {said}", f"{KEY}.other: no map: another reason"]))
    note = panels.map_of_run(run, KEY).note
    assert said in note
    assert "another reason" not in note
