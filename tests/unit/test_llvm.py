"""Which LLVM is taken, out of which are there."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from unrender.backend import llvm

ELF = b"\x7fELF\x02\x01\x01" + bytes(9) + b"\x03\x00"
X86_64, I386 = b"\x3e\x00", b"\x03\x00"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of libraries on a 64-bit Linux machine."""
    python = tmp_path / "python"
    python.write_bytes(ELF + X86_64)
    monkeypatch.setattr(sys, "executable", str(python))
    libraries = tmp_path / "lib"
    libraries.mkdir()
    return libraries


def add(folder: Path, name: str, header: bytes = ELF + X86_64) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(header)
    return folder / name


@pytest.mark.parametrize(
    ("path", "major"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-18.so.18.1", 18),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/llvm-19/lib/libLLVM.so", 19),
        ("/usr/lib64/llvm17/lib/libLLVM.so", 17),
        ("/opt/homebrew/opt/llvm@19/lib/libLLVM.dylib", 19),
        ("/opt/homebrew/Cellar/llvm/22.1.0_1/lib/libLLVM.dylib", 22),
        ("/opt/conda/envs/3.10/lib/libLLVM.so", None),
        ("/usr/lib/libLLVM.so", None),
    ],
)
def test_the_name_tells_the_version(path: str, major: int | None):
    assert llvm.version_by_name(Path(path)) == major


def test_a_link_tells_what_it_links_to(tmp_path: Path):
    target = add(tmp_path, "libLLVM.so.19.1")
    link = tmp_path / "libLLVM.so"
    link.symlink_to(target)
    assert llvm.version_by_name(link) == 19


def test_candidates_are_shared_libraries_each_once(machine: Path):
    target = add(machine, "libLLVM.so.19.1")
    (machine / "libLLVM-19.so").symlink_to(target)
    (machine / "libLLVM-17.so").symlink_to(machine / "gone")
    for other in ("libLLVMSupport.so", "libLLVM-19.a", "libLLVMCore.a", "libclang-19.so"):
        add(machine, other)
    assert [path.resolve() for path in llvm.candidates([machine, machine, machine / "none"])] == [target]


def test_folders_put_the_conda_environment_first(tmp_path: Path):
    for folder in ("usr/lib/llvm-19/lib", "opt/homebrew/opt/llvm@19/lib", "usr/lib64"):
        (tmp_path / folder).mkdir(parents=True)
    found = llvm.folders({"CONDA_PREFIX": "/env"}, root=tmp_path)
    assert found[0] == Path("/env/lib")
    assert {tmp_path / "usr/lib/llvm-19/lib", tmp_path / "opt/homebrew/opt/llvm@19/lib", tmp_path / "usr/lib64"} < set(
        found
    )


@pytest.mark.parametrize(
    ("installed", "chosen"),
    [
        ([14, 15, 16], None),
        ([], None),
        ([14, 17], 17),
        ([19, 22, 15], 22),
        ([22, 30, 19], 22),  # one that was tried rather than the newest
        ([31, 30, 16], 30),
    ],
)
def test_the_newest_one_that_was_tried_is_chosen(machine: Path, installed: list[int], chosen: int | None):
    paths = [add(machine, f"libLLVM.so.{major}.1") for major in installed]
    library = llvm.choose(paths)
    assert (library.major if library else None) == chosen


def test_among_equals_the_first_folder_wins(machine: Path):
    first, second = add(machine / "conda", "libLLVM.so.19.1"), add(machine / "system", "libLLVM.so.19.1")
    library = llvm.choose(iter([first, second]))
    assert library == llvm.Library(first, 19)


def test_one_for_another_processor_is_passed_over(machine: Path):
    add(machine, "libLLVM.so.22.1", b"\x7fELF\x01\x01\x01" + bytes(9) + b"\x03\x00" + I386)
    add(machine, "libLLVM.so.21.1", b"INPUT(-lLLVM-21)")
    add(machine, "libLLVM.so.19.1")
    library = llvm.choose(llvm.candidates([machine]))
    assert library is not None
    assert library.major == 19


def test_only_nameless_ones_are_asked_and_only_in_need(machine: Path, monkeypatch: pytest.MonkeyPatch):
    asked: list[Path] = []

    def ask(path: Path) -> int:
        asked.append(path)
        return 20

    monkeypatch.setattr(llvm, "version_by_asking", ask)
    nameless, old, good = add(machine, "libLLVM.so"), add(machine, "libLLVM-14.so.1"), add(machine, "libLLVM.so.19.1")
    assert llvm.choose([nameless, old, good]) == llvm.Library(good, 19)
    assert asked == []
    assert llvm.choose([nameless, old]) == llvm.Library(nameless, 20)
    assert asked == [nameless]


def test_a_library_that_cannot_be_loaded_has_no_version(tmp_path: Path):
    broken = tmp_path / "libLLVM.so"
    broken.write_text("not a library")
    assert llvm.identify(broken) == llvm.Library(broken, None)
    assert llvm.identify(tmp_path / "libLLVM-19.so").major is None, "there is no such file"
    assert llvm.identify(Path("libLLVM-19.so")).major == 19, "a bare name is for the loader to find"


def test_a_real_library_tells_the_version_of_its_name():
    library = llvm.choose()
    if library is None or library.major is None:
        pytest.skip("no LLVM here")
    assert llvm.version_by_asking(library.path) == library.major
