"""The variant that is chosen, and that a machine which cannot run it is told so instead of being taken down."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tiers import slow
from unrender.backend import llvm, variant
from unrender.core.errors import VariantError

TOO_OLD = [
    pytest.param(path, major, marks=pytest.mark.skipif(not Path(path).exists(), reason=f"{path} is not here"))
    for path, major in (
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.so.1", 14),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
    )
]


class FakeMitsuba:
    """Remembers what was set. `works` are the variants that can be."""

    def __init__(self, name: str | None = None, works: tuple[str, ...] = variant.VARIANTS):
        self.name, self.works, self.times = name, works, 0

    def variant(self) -> str | None:
        return self.name

    def set_variant(self, name: str) -> None:
        if name not in self.works:
            raise ImportError(f"no\n{name}")
        self.name, self.times = name, self.times + 1


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeMitsuba:
    """A Mitsuba that sets nothing, on a machine whose GPU and LLVM work."""
    mitsuba = FakeMitsuba()
    monkeypatch.setattr(variant, "_mitsuba", lambda: mitsuba)
    monkeypatch.setitem(sys.modules, "mitsuba", mitsuba)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(variant, "gpu_problem", lambda: None)
    monkeypatch.setattr(variant, "llvm_version", lambda: (19, 1, 7))
    return mitsuba


def python(code: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh process. A variable that is None is removed."""
    values = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={name: value for name, value in values.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


USE = """
from unrender.core.errors import VariantError
try:
    from unrender.backend import variant
    print(variant.{call})
except VariantError as error:
    print(error)
    raise SystemExit(3)
"""


def test_auto_takes_the_gpu_where_it_works(fake: FakeMitsuba, monkeypatch: pytest.MonkeyPatch):
    assert variant.use() == "cuda_ad_rgb"
    monkeypatch.setattr(variant, "gpu_problem", lambda: "no driver")
    assert variant.use() == "llvm_ad_rgb"
    assert fake.name == "llvm_ad_rgb"


def test_again_changes_nothing_and_another_one_is_set(fake: FakeMitsuba):
    assert [variant.use("llvm_ad_rgb"), variant.use("llvm_ad_rgb")] == ["llvm_ad_rgb"] * 2
    assert fake.times == 1
    assert variant.use("cuda_ad_rgb") == variant.current() == "cuda_ad_rgb"


def test_a_gpu_that_does_not_work_is_refused_with_the_reason(fake: FakeMitsuba, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(variant, "gpu_problem", lambda: "the driver is broken")
    with pytest.raises(VariantError, match="the driver is broken"):
        variant.use("cuda_ad_rgb")
    assert fake.name is None


def test_spectral_variants_are_checked_as_those_of_rgb(fake: FakeMitsuba, monkeypatch: pytest.MonkeyPatch):
    assert variant.use("cuda_ad_spectral") == variant.current() == variant.ensure() == "cuda_ad_spectral"
    assert variant.use() == "cuda_ad_rgb"
    assert variant.use("llvm_ad_spectral") == variant.ensure() == "llvm_ad_spectral"
    monkeypatch.setattr(variant, "gpu_problem", lambda: "the driver is broken")
    with pytest.raises(VariantError, match=r"cuda_ad_spectral cannot run here.*'llvm_ad_spectral' runs on the CPU"):
        variant.use("cuda_ad_spectral")
    monkeypatch.setattr(variant, "_check_llvm", lambda: (_ for _ in ()).throw(VariantError("old LLVM")))
    with pytest.raises(VariantError, match="old LLVM"):
        variant.ensure()


def test_the_variant_of_a_device_has_the_colours_of_another_variant():
    of = variant.with_colours_of
    assert of(variant.CUDA, "llvm_ad_spectral") == "cuda_ad_spectral"
    assert of(variant.LLVM, "cuda_ad_spectral") == "llvm_ad_spectral"
    assert of("cuda_ad_spectral", variant.LLVM) == variant.CUDA
    assert [of(name, None) for name in variant.VARIANTS] == list(variant.VARIANTS)
    assert variant.same_colours(variant.CUDA, variant.LLVM)
    assert not variant.same_colours(variant.LLVM, "llvm_ad_spectral")


@pytest.mark.parametrize("name", ["llvm", "scalar_rgb", "llvm_ad_spectral_polarized", "cuda_ad_rgb ", ""])
def test_an_unknown_variant_is_refused(name: str):
    expected = "expected 'auto', 'cuda_ad_rgb', 'llvm_ad_rgb', 'cuda_ad_spectral' or 'llvm_ad_spectral'"
    with pytest.raises(VariantError, match=expected):
        variant.use(name)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("llvm_ad_spectral_polarized", "no polarised rendering"),
        ("cuda_ad_mono_polarized", "no polarised rendering and no monochromatic rendering"),
        ("llvm_ad_mono", "no monochromatic rendering"),
        ("scalar_rgb", "no variants of 'scalar'"),
    ],
)
def test_a_variant_of_mitsuba_is_refused_with_what_is_missing(fake: FakeMitsuba, name: str, what: str):
    line = f"'{name}' is not supported, since unrender has {what}"
    with pytest.raises(VariantError, match=f"{line}: expected"):
        variant.use(name)
    fake.name = name
    with pytest.raises(VariantError, match=f"Mitsuba's variant: {line}; call"):
        variant.ensure()


def test_a_variant_that_mitsuba_refuses_is_one_line(fake: FakeMitsuba):
    fake.works = ()
    with pytest.raises(VariantError, match=r"^Mitsuba cannot use llvm_ad_rgb: no llvm_ad_rgb$"):
        variant.use("llvm_ad_rgb")


@pytest.mark.parametrize("version", [None, (14, 0, 6), (15, 0, 6), (16, 0, 6)])
def test_no_kernel_with_an_old_llvm(
    version: tuple[int, ...] | None, fake: FakeMitsuba, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(variant, "llvm_version", lambda: version)
    monkeypatch.delenv(llvm.ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "choose", lambda: None)
    monkeypatch.setattr(variant.install_hints, "command", lambda needs: f"get {needs[0]}")
    for call in (lambda: variant.use("llvm_ad_rgb"), lambda: variant.ensure()):
        fake.name = "llvm_ad_rgb"  # as if the user had set it
        with pytest.raises(VariantError, match=f"needs LLVM {llvm.OLDEST} or newer; install: get llvm$"):
            call()


def test_ensure_keeps_what_the_user_set(fake: FakeMitsuba, monkeypatch: pytest.MonkeyPatch):
    fake.name = "llvm_ad_rgb"
    assert variant.ensure() == "llvm_ad_rgb"
    monkeypatch.setattr(variant, "gpu_problem", lambda: pytest.fail("a GPU already in use needs no trial"))
    fake.name = "cuda_ad_rgb"
    assert variant.ensure() == "cuda_ad_rgb"
    assert fake.times == 0


def test_ensure_chooses_where_nothing_is_set(fake: FakeMitsuba):
    assert variant.ensure() == "cuda_ad_rgb"


def test_ensure_refuses_a_variant_without_derivatives(fake: FakeMitsuba):
    fake.name = "scalar_rgb"
    with pytest.raises(VariantError, match=r"'scalar_rgb'.*call unrender\.use") as told:
        variant.ensure()
    assert "cuda" not in str(told.value)  # which this machine may not have


def test_the_trial_passes_where_kernels_run(mitsuba_variant: str):
    assert variant.gpu_trial(variant=mitsuba_variant) is None


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import os; os.abort()", "exit status -6"),
        ("import sys; sys.exit('OptiX is\\nmissing')", "missing"),
    ],
)
def test_the_trial_survives_a_broken_driver(code: str, said: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(variant, "_TRIAL", "")
    problem = variant.gpu_trial(code)
    assert problem is not None
    assert said in problem


def test_a_hidden_gpu_is_not_tried(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setattr(variant, "gpu_trial", lambda: pytest.fail("tried"))
    assert "CUDA_VISIBLE_DEVICES" in str(variant.gpu_problem.__wrapped__())


def test_importing_chooses_a_safe_llvm():
    if llvm.choose() is None:
        pytest.skip("no LLVM here")
    answer = python(
        USE.format(call="use('llvm_ad_rgb')") + "\nassert variant.llvm_version()[0] >= 17", DRJIT_LIBLLVM_PATH=None
    )
    assert (answer.returncode, answer.stdout, answer.stderr) == (0, "llvm_ad_rgb\n", "")


@pytest.mark.parametrize(("path", "major"), TOO_OLD)
@pytest.mark.parametrize("call", [slow("use('llvm_ad_rgb')"), "ensure()"])
def test_an_old_llvm_is_one_line_and_no_abort(path: str, major: int, call: str):
    answer = python(USE.format(call=call), DRJIT_LIBLLVM_PATH=path, CUDA_VISIBLE_DEVICES="")
    assert answer.returncode == 3, answer.stderr
    assert f"{path} is LLVM {major}, unrender needs LLVM {llvm.OLDEST} or newer; " in answer.stdout
    assert answer.stdout.count("\n") == 1
    assert answer.stderr == ""


@pytest.mark.parametrize(("path", "major"), TOO_OLD)
def test_an_old_llvm_loaded_before_us_is_one_line_and_no_abort(path: str, major: int):
    code = "import mitsuba, os; os.environ.pop('DRJIT_LIBLLVM_PATH')" + USE.format(call="ensure()")
    answer = python(code, DRJIT_LIBLLVM_PATH=path, CUDA_VISIBLE_DEVICES="")
    assert answer.returncode == 3, answer.stderr
    assert f"needs LLVM {llvm.OLDEST} or newer; " in answer.stdout
    assert answer.stdout.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("libLLVM-19.so", None, "{variable} is no such file, "),
        slow("libLLVM.so", "not a library", "{variable} is not LLVM, "),
        ("libLLVM-19.so", "not a library", "Dr.Jit cannot load {variable}, "),
    ],
)
def test_a_path_that_is_no_llvm_is_one_line(name: str, content: str | None, said: str, tmp_path: Path):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    answer = python(USE.format(call="use('llvm_ad_rgb')"), DRJIT_LIBLLVM_PATH=str(path))
    assert answer.returncode == 3, answer.stderr
    assert answer.stdout.startswith(said.format(variable=f"DRJIT_LIBLLVM_PATH={path}"))
    assert answer.stdout.count("\n") == 1
