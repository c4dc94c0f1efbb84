"""The command that installs what is missing."""

from __future__ import annotations

import pytest

from unrender.backend import install_hints


@pytest.mark.parametrize(
    ("by", "expected"),
    [
        ("apt-get", "sudo apt-get update && sudo apt-get install -y libllvm20 libatomic1"),
        ("dnf", "sudo dnf install llvm-libs libatomic"),
        ("pacman", "sudo pacman -S llvm-libs gcc-libs"),
        ("brew", "brew install llvm@19"),
        ("conda", "conda install -c conda-forge libllvm19 libgcc"),
        ("", "conda install -c conda-forge libllvm19 libgcc"),
    ],
)
def test_each_manager_by_its_own_names(by: str, expected: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(install_hints, "is_root", lambda: False)
    monkeypatch.setattr(install_hints, "manager", lambda: by)
    monkeypatch.setattr(
        install_hints, "_known_to_apt", lambda names: next((n for n in names if n == "libllvm20"), None)
    )
    assert install_hints.command(["llvm", "libatomic.so.1"]) == expected


def test_root_needs_no_sudo(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(install_hints, "is_root", lambda: True)
    assert install_hints.command(["llvm"], by="dnf") == "dnf install llvm-libs"


def test_a_release_without_a_good_llvm_is_sent_to_llvm_itself(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(install_hints, "is_root", lambda: True)
    monkeypatch.setattr(install_hints, "_known_to_apt", lambda names: "coreutils" if "coreutils" in names else None)
    assert install_hints.apt_packages(["llvm"]) is None
    assert install_hints.apt_packages(["libatomic.so.1"]) == ["libatomic1"]
    command = install_hints.command(["llvm", "libatomic.so.1"], by="apt-get")
    assert "https://apt.llvm.org/llvm.sh" in command
    assert command.endswith("apt-get install -y libatomic1")


def test_empty_package_lists_are_read_first(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(install_hints, "is_root", lambda: True)
    monkeypatch.setattr(install_hints, "_known_to_apt", lambda names: None)
    assert install_hints.command(["llvm"], by="apt-get") == "apt-get update && apt-get install -y libllvm19"


def test_inside_conda_conda_is_named():
    assert install_hints.manager({"CONDA_PREFIX": "/opt/conda"}) == "conda"
    assert install_hints.manager({}) != "conda"
