"""Make the gallery's pictures of results: start, result after some steps of `auto`, and reference of each problem's first view.

    python scripts/site/gallery_results.py [NAME ...]

Writes a JPEG of a few kB per problem to docs/images/gallery. They are committed, because all runs together take some ten minutes.
"""

import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import unrender as ur
from unrender.display.pictures import shown_image

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "images" / "gallery"
PIXELS, STEPS = 48, 100
LEAST_SAMPLES = 1024
"""Fewest samples per pixel of the pictures; problems with noisier light have more samples in their references."""
ENLARGED, GAP, QUALITY = 2, 4, 80


def strip(name: str) -> bytes | None:
    """Return the JPEG of a problem; None for a problem without pictures."""
    defaults = {option.name: option.default for option in ur.gallery.options(name)}
    if "resolution" not in defaults:
        return None
    samples = max(LEAST_SAMPLES, defaults.get("reference_spp", 0))
    options = {"resolution": PIXELS} | ({"reference_spp": samples} if "reference_spp" in defaults else {})
    problem = ur.gallery.problem(name, **options)
    result = ur.optimize(problem, steps=STEPS, seed=0, progress=False)
    reference = np.asarray(problem.views[0].reference)
    pictures = [first_view(ur.render(problem, values, spp=samples)) for values in (result.initial, result.parameters)]
    shown = [enlarged(shown_image(picture, like=reference)) for picture in (*pictures, reference)]
    gap = np.full((shown[0].shape[0], GAP, 3), 255, np.uint8)
    joined = np.concatenate([shown[0], gap, shown[1], gap, shown[2]], axis=1)
    file = io.BytesIO()
    Image.fromarray(joined).save(file, "JPEG", quality=QUALITY, optimize=True)
    return file.getvalue()


def first_view(pictures: Any) -> np.ndarray:
    """Return the picture of the first view, (H, W, 3)."""
    return np.asarray(pictures[0] if isinstance(pictures, (list, tuple)) else pictures)


def enlarged(colours: np.ndarray) -> np.ndarray:
    """Return a display image in [0, 1] as bytes, with each pixel repeated."""
    return (colours * 255 + 0.5).astype(np.uint8).repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def main(names: list[str]) -> None:
    """Make the pictures of these problems, of all if there are none."""
    ur.use()
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names or ur.gallery.names():
        try:
            content = strip(name)
        except ur.UnrenderError as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        if content is not None:
            (FOLDER / f"{name}.jpg").write_bytes(content)
        print(name, "no pictures" if content is None else f"{len(content)} bytes", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
