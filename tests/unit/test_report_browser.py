"""What the report's own script does, in Chromium."""

from __future__ import annotations

import numpy as np
import pytest
from report_folders import write_run

from browser import chromium
from unrender.app import report
from unrender.app.report import tone_mapping

PIXEL = """async (image) => {
  await image.decode();
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [1, 1];
  const context = canvas.getContext('2d');
  context.drawImage(image, 0, 0);
  return [...context.getImageData(0, 0, 1, 1).data].slice(0, 3);
}"""


def test_the_report_lets_one_choose_pictures_views_and_exposure(tmp_path):
    flat = np.full((8, 8, 3), 0.2, np.float32)
    views = {f"view{i}/{kind}": flat * (1 + i) for i in range(2) for kind in ("reference", "initial", "result")}
    path = report.page(write_run(tmp_path / "run", views=views))
    with chromium() as page:
        page.goto(path.as_uri())
        first, second = page.locator("[data-view='0']"), page.locator("[data-view='1']")
        assert (first.is_visible(), second.is_visible()) == (True, False)
        page.locator("select.view").select_option("1")
        assert (first.is_visible(), second.is_visible()) == (False, True)

        right = second.get_by_label("Picture on the right")
        options = right.locator("option").all_inner_texts()
        assert options == ["Result", "Reference", "Start", "Error at the start", "Error of the result"]
        right.select_option("Error of the result")
        slider = second.locator(".slider")
        error = second.locator("figure > img[data-label='Error of the result']")
        assert slider.locator("img.right").get_attribute("src") == error.get_attribute("src")
        assert "Error of the result on the right" in slider.locator("input").get_attribute("aria-label")
        slider.locator("input").focus()
        page.keyboard.press("ArrowRight")
        assert slider.evaluate("s => s.style.getPropertyValue('--at')") == "51%"
        box = slider.bounding_box()
        page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 5)
        assert slider.evaluate("s => parseFloat(s.style.getPropertyValue('--at'))") == pytest.approx(25, abs=1)

        page.locator(".exposure input").fill("-1")
        assert page.locator(".exposure output").inner_text() == "-1 EV"
        left = slider.locator("img.left")
        # As it is in the file.
        assert left.evaluate(PIXEL) == [round(255 * float(tone_mapping.srgb(np.array(0.7))))] * 3
        box = left.bounding_box()
        request = page.screenshot(clip={"x": box["x"] + 5, "y": box["y"] + box["height"] / 2, "width": 1, "height": 1})
        # And half as bright on the screen.
        assert np.abs(_pixel(request) - 255 * tone_mapping.srgb(np.array(0.35))).max() <= 2
        assert slider.locator("img.right").evaluate("i => i.style.filter") == ""  # colours of numbers stay
        page.locator("label[for=over-samples]").click()
        assert page.locator(".charts.samples").is_visible()
        assert not page.locator(".charts.seconds").is_visible()
        assert page.complaints == []


@pytest.mark.slow
def test_the_report_fits_a_phone(tmp_path):
    path = report.page(write_run(tmp_path / "run", command="unrender " + "very-long-" * 40))
    with chromium(viewport={"width": 360, "height": 740}) as page:
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        assert page.complaints == []


def _pixel(png: bytes) -> np.ndarray:
    import io

    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)[0, 0]
