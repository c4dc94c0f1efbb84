"""What the Makefile needs before it can set anything up: Python's venv, and the system libraries of Dr.Jit.

    python3 -I scripts/prerequisites.py

Installs Debian's packages where it may (root, or sudo that asks no password), else prints the one command to run and
exits with 3. Runs on a bare Python: standard library only.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

BACKEND = Path(__file__).resolve().parents[1] / "src" / "unrender" / "backend"


def load(name: str) -> ModuleType:
    """A module of `unrender` by its file: the package itself cannot be imported yet."""
    spec = importlib.util.spec_from_file_location(f"unrender_{name}", BACKEND / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


llvm, install_hints = load("llvm"), load("install_hints")


def missing() -> list[str]:
    """What has to be installed, in the terms of `install_hints.NEEDS`."""
    needs = [] if importlib.util.find_spec("ensurepip") else ["venv"]
    needs += llvm.missing_companions()
    given = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    if not (llvm.is_usable(llvm.identify(Path(given)).major) if given else llvm.choose()):
        needs.append("llvm")
    return needs


def administrator() -> "list[str] | None":
    """What to put before a command that installs: nothing for root, sudo if it asks no password; None where neither."""
    if install_hints.is_root():
        return []
    sudo = shutil.which("sudo")
    if sudo and subprocess.run([sudo, "-n", "true"], capture_output=True, check=False).returncode == 0:
        return [sudo, "-n"]
    return None


def install(needs: "list[str]") -> None:
    """Install with apt-get, if it is here and allowed. What that achieved is for `missing` to say."""
    prefix = administrator()
    if prefix is None or not shutil.which("apt-get"):
        return
    quiet = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq"]
    print("reading the package lists: apt-get update", flush=True)
    subprocess.run([*quiet, "update"], check=False)
    names = install_hints.apt_packages(needs)
    if names is None:
        names = install_hints.apt_packages([need for need in needs if need != "llvm"])
    if names:
        print(f"installing {' '.join(names)}", flush=True)
        options = ["-y", "--no-install-recommends", "-o", "Dpkg::Use-Pty=0"]
        subprocess.run([*quiet, "install", *options, *names], stdout=subprocess.DEVNULL, check=False)


def main() -> int:
    """The exit status: 0 if everything is here now, else 3."""
    needs = missing()
    given = os.environ.get(llvm.ENVIRONMENT_VARIABLE)
    if given and "llvm" in needs:
        print(f"{llvm.ENVIRONMENT_VARIABLE}={given} is not LLVM {llvm.OLDEST} or newer: unset it", file=sys.stderr)
        return 3
    if needs:
        install(needs)
        needs = missing()
    if needs == ["llvm"] and Path("/proc/driver/nvidia/version").exists():
        print(f"no LLVM {llvm.OLDEST} or newer, so only the GPU will do; for the CPU: {install_hints.command(needs)}")
        return 0
    if needs:
        names = {"venv": "Python's venv", "llvm": f"LLVM {llvm.OLDEST} or newer"}
        what = ", ".join(names.get(need, need) for need in needs)
        print(f"missing: {what}; run: {install_hints.command(needs)}", file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
