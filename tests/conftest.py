"""What every test starts from: a Mitsuba variant that works, and the folder of assets where there is one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from unrender.backend import variant
from unrender.core.errors import VariantError

variant.prepare()  # before any test module imports Dr.Jit


@pytest.fixture(scope="session", autouse=True)
def mitsuba_variant() -> str:
    """The variant of this test session: the CPU's, so that numbers are the same everywhere, or `UNRENDER_VARIANT`."""
    import drjit as dr

    try:
        name = variant.use(os.environ.get("UNRENDER_VARIANT", variant.LLVM))
    except VariantError as error:
        pytest.exit(str(error), returncode=3)  # once, not once per test
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        # Each worker would start a thread per core, and they would wait for each other.
        dr.set_thread_count(max(1, dr.thread_count() // workers))
    return name


@pytest.fixture(scope="session")
def assets() -> Path:
    """Assets made by others (meshes, environment maps, Mitsuba's tutorial scenes): the folder `UNRENDER_ASSETS`, else
    `shared/assets` beside the repository."""
    given = os.environ.get("UNRENDER_ASSETS")
    folder = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "assets"
    if not folder.is_dir():
        pytest.skip(f"no assets: {folder} is not a folder; set UNRENDER_ASSETS to one")
    return folder
