"""What `unrender doctor` says, and its exit status."""

from __future__ import annotations

import io
import math
from pathlib import Path

import pytest

from unrender.app.cli import doctor
from unrender.backend import cache, variant
from unrender.core.errors import VariantError
from unrender.display.terminal import Console


@pytest.fixture(autouse=True)
def without_gpu(monkeypatch: pytest.MonkeyPatch):
    """So that the session's variant stays."""
    monkeypatch.setattr(variant, "gpu_problem", lambda: "none [of these]")


def run() -> tuple[int, str]:
    console = Console(file=io.StringIO(), width=200)
    status = doctor.doctor(console)
    return status, console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]


def test_the_trial_gradient_is_right():
    error = doctor.gradient_error()
    assert error < doctor.TOLERANCE


def test_a_machine_that_works_gets_zero():
    status, said = run()
    assert status == 0
    for word in ("python", "mitsuba", "LLVM", "CPU", "llvm_ad_rgb", "none [of these]", "right: relative error"):
        assert word in said


@pytest.mark.parametrize("error", [0.5, math.nan])
def test_a_wrong_gradient_gets_three(error: float, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "gradient_error", lambda: error)
    status, said = run()
    assert status == 3
    assert "wrong" in said


def test_a_machine_that_cannot_run_gets_three_and_the_command(monkeypatch: pytest.MonkeyPatch):
    def refuse() -> str:
        raise VariantError("no LLVM; install: apt-get install -y libllvm19")

    monkeypatch.setattr(variant, "use", refuse)
    status, said = run()
    assert status == 3
    assert "install: apt-get install -y libllvm19" in said


def test_missing_extras_are_named(monkeypatch: pytest.MonkeyPatch):
    required = ["numpy", "no-such-thing>=2; extra == 'dev'", "pytest; extra == 'dev'"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: required)
    assert doctor._missing() == ["(optional, tests of this package) install: pip install 'unrender[dev]'"]


def test_only_packages_that_can_be_installed_are_named(monkeypatch: pytest.MonkeyPatch):
    required = [
        "no-such-flip; python_version < '3' and extra == 'flip'",
        "no-such-flip; platform_system != 'none' and extra == 'flip'",
        "no-such-thing[fast]; extra == 'other'",
        "not a requirement",
    ]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: required)
    assert doctor._missing() == [
        "(optional, the measure FLIP) install: pip install 'unrender[flip]'",
        "(optional, other) install: pip install 'unrender[other]'",
    ]


def test_the_cache_folder_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(tmp_path))
    place = cache.folder(cache.REFERENCES)
    assert place is not None
    (place / "one.npz").write_bytes(bytes(2_000_000))
    _, said = run()
    assert f"{tmp_path} (references 2 MB, kernels 0 MB)" in said
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, "")
    assert "switched off" in dict(doctor._cache())["cache"]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(tmp_path / "file"))
    assert "cannot be written" in dict(doctor._cache())["cache"]
