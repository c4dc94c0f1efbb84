"""One thread: OpenEXR in Mitsuba waits for ever for a second one, which it is lent to read and write files."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.io import images

SCRIPT = """
import sys
import numpy as np
import mitsuba as mi
import unrender as ur
from unrender.backend import variant
from unrender.io import images

folder = sys.argv[1]
variant.use_threads(1)
sky = np.random.default_rng(1).uniform(0.1, 1.0, (256, 512, 3))
images.write(sky, folder + "/sky.exr")
assert np.allclose(images.read(folder + "/sky.exr").values, sky, atol=1e-2)
scene = {
    "type": "scene",
    "sky": {"type": "envmap", "filename": folder + "/sky.exr"},
    "ball": {"type": "sphere", "id": "ball", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
}
problem = ur.Problem(scene, [ur.Parameter("ball.bsdf.reflectance.value")], [ur.View(np.full((4, 4, 3), 0.2))])
ur.optimize(problem, ur.PathGradient(), ur.optimizers.Adam(), steps=2)
import drjit as dr
assert dr.thread_count() == 1
"""


@pytest.mark.usefixtures("one_thread")
def test_a_picture_borrows_a_thread_and_returns_it(tmp_path: Path) -> None:
    import drjit as dr

    sky = np.random.default_rng(1).uniform(0.1, 1.0, (256, 512, 3))
    images.write(sky, tmp_path / "sky.exr")
    assert np.allclose(images.read(tmp_path / "sky.exr").values, sky, atol=1e-2)
    assert dr.thread_count() == 1


@pytest.mark.slow
def test_exr_files_are_read_and_written(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import unrender as ur; ur.use('llvm_ad_rgb')\n" + SCRIPT, str(tmp_path)],
        timeout=300,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.usefixtures("one_thread")
def test_a_picture_waits_for_another_thread_that_renders(tmp_path: Path) -> None:
    """To change the number of threads beside a render waited for ever: seen within 30 s, where two threads read 84 files."""
    file = tmp_path / "sky.exr"
    images.write(np.ones((4, 4, 3)), file)
    rendering, rendered, order = threading.Event(), threading.Event(), []

    def render(long: bool) -> None:
        with exclusive("render", long):
            rendering.set()
            rendered.wait(60)
            order.append("rendered")

    for long in (False, True):
        rendering.clear()
        rendered.clear()
        thread = threading.Thread(target=render, args=(long,))
        thread.start()
        rendering.wait(60)
        if long:
            with pytest.raises(InputError, match=r"with one thread of Dr\.Jit: render is running in another thread"):
                images.read(file)
            rendered.set()
        else:
            threading.Timer(0.2, rendered.set).start()
            images.read(file)
            order.append("read")
        thread.join()
    assert order == ["rendered", "read", "rendered"]


def test_exr_files_are_refused_in_a_fork(tmp_path: Path) -> None:
    """Workers of `multiprocessing` that start by `fork` waited for ever for threads that only their parent has. Other files need none."""
    script = """
import os, signal, sys
import numpy as np
import unrender as ur
from unrender.io import images
ur.use('llvm_ad_rgb')
exr, png = sys.argv[1:]
images.write(np.ones((4, 4, 3)), exr)
if not (child := os.fork()):
    signal.alarm(20)
    status = int((images.read(png).values != 1).any())
    try:
        images.read(exr)
    except ur.UnrenderError as error:
        os._exit(status + 2 * ("get_context('spawn')" not in str(error)))
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    Image.new("RGB", (4, 4), "white").save(tmp_path / "one.png")
    command = [sys.executable, "-c", script, *(str(tmp_path / name) for name in ("one.exr", "one.png"))]
    done = subprocess.run(command, timeout=100, capture_output=True, text=True)
    assert done.returncode == 0, done
