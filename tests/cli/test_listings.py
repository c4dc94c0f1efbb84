"""What the command tells of itself."""

from __future__ import annotations

import numpy as np
import pytest

from unrender import gallery
from unrender.methods import methods

COMMANDS = ("run", "compare", "report", "gallery", "methods", "doctor")


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_help_names_every_command(unrender, arguments):
    answer = unrender(*arguments)
    assert answer.status == 0
    assert all(command in answer.out for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(unrender, command):
    answer = unrender(command, "--help")
    assert answer.status == 0
    assert "Usage: unrender " + command in answer.out


def test_version(unrender):
    answer = unrender("--version")
    assert answer.status == 0
    assert answer.out.strip()


def test_methods_lists_every_option_of_every_method(unrender):
    answer = unrender("methods")
    assert answer.status == 0
    for method in methods().values():
        alone = unrender("methods", method.name)
        assert alone.out in answer.out
        assert method.summary in alone.out
        for name, field in method.options.model_fields.items():
            assert name in alone.out
            assert field.description
            assert field.description in alone.out


def test_gallery_lists_every_problem(unrender):
    answer = unrender("gallery")
    assert answer.status == 0
    assert [line.split()[0] for line in answer.out.splitlines()] == gallery.names()


def test_gallery_tells_the_options_of_one(unrender):
    name = gallery.names()[0]
    answer = unrender("gallery", name)
    assert answer.status == 0
    assert gallery.summary(name) in answer.out
    assert all(option.name in answer.out for option in gallery.options(name))


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_a_plan_is_printed_and_its_file_makes_the_same_run(unrender, tmp_path):
    tiny = ("-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=8")
    common = ("--steps", "4", "--variant", "llvm_ad_rgb", "--final-spp", "1", "--threads", "1")
    printed = unrender("methods", "--plan", "indirect-room", *tiny)
    assert printed.status == 0, printed.error
    assert "# recursive control variates" in printed.out
    plan = tmp_path / "plan.toml"
    plan.write_text(printed.out)
    for name, method in (("named", "auto"), ("planned", str(plan))):
        answer = unrender("run", "indirect-room", *tiny, *common, "--method", method, "--out", str(tmp_path / name))
        assert answer.status == 0, answer.error
    first, second = (np.load(tmp_path / name / "parameters.npz") for name in ("named", "planned"))
    assert all(np.array_equal(first[key], second[key]) for key in first.files)

    answer = unrender("run", "indirect-room", *tiny, *common, "--method", str(plan), "--set", "spp=2")
    assert answer.status == 2
    assert "which contains all settings" in answer.error
    answer = unrender("run", "indirect-room", *tiny, *common, "--method", str(tmp_path / "none.toml"))
    assert answer.status == 2
    assert "none.toml" in answer.error
    assert len(answer.error.strip().splitlines()) == 1
