"""The attacks that once succeeded, and the test that repeats each. A test that is renamed or removed fails here."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
ATTACKS = {
    # Ray among strangers
    "Ray leaves its token in the home folder": "render/test_private_cluster.py::test_its_token_is_nowhere_but_in_the_environment",
    "Ray listens on all interfaces": "render/test_private_cluster.py::test_it_listens_on_the_loopback_alone",
    "a stranger replaces a function of the cluster": "render/test_private_cluster.py::test_a_stranger_neither_reads_nor_writes_nor_joins",
    "a stranger links Ray's logs to files of the user": "render/test_private_cluster.py::test_its_folder_is_closed",
    "Ray's folder remains after kill -9": "render/test_private_cluster.py::test_a_killed_driver_leaves_no_folder",
    "another user of the machine": "cli/test_shared_machine.py::test_another_user_runs_nothing_reads_no_secret_and_writes_nothing",
    "a cluster without a token is joined": "unit/test_trust.py::test_a_cluster_without_a_token_is_refused",
    "a cluster is joined whose token others read": "unit/test_trust.py::test_a_token_that_others_can_read_is_refused",
    "a cluster is joined whose folder others change": "unit/test_trust.py::test_ray_folder_that_others_can_change_is_refused",
    "a task holds code": "unit/test_cluster.py::test_tasks_are_data_and_functions_go_by_name",
    # Formats
    "PostScript named .png starts Ghostscript": "unit/test_picture_kinds.py::test_pillow_decodes_kinds_of_the_allow_list_alone",
    "OpenCV decodes any format": "unit/test_picture_kinds.py::test_opencv_decodes_kinds_of_the_allow_list_alone",
    "a small TIFF takes gigabytes": "unit/test_picture_kinds.py::test_a_bomb_is_refused_by_its_header",
    # Nothing is refused after the work
    "an --out folder that is not UTF-8": "cli/test_names.py::test_an_out_folder_that_is_not_utf_8_is_refused_before_the_work",
    "a working folder that is not UTF-8": "cli/test_names.py::test_a_working_folder_that_is_not_utf_8_is_refused_before_the_work",
    "a seed of 2**63": "cli/test_names.py::test_a_seed_that_no_record_holds_is_refused",
    # Containers
    "no HOME and a user without a name": "cli/test_restricted_environments.py::test_no_home_and_no_name",
    "a home folder that cannot be written": "cli/test_restricted_environments.py::test_a_home_that_cannot_be_written",
    "/dev/shm of 64 MB": "cli/test_bad_machines.py::test_workers_in_a_container_with_64_megabytes_of_shared_memory",
    "a container's share of the processor": "unit/test_limits.py::test_processor_share_of_version_2",
    "a container's memory": "unit/test_limits.py::test_limits_of_groups_above_hold_too",
    "more workers than the memory holds": "unit/test_cluster.py::test_workers_of_one_machine_fit_its_memory",
    "a million threads": "cli/test_restricted_environments.py::test_a_million_threads_are_one_line",
    # Own loops
    "two renderers in two threads": "contract/test_own_loop_scenes.py::test_two_threads_draw_what_each_draws_alone",
    "backward of another thread's image": "unit/test_own_loop.py::test_backward_of_another_threads_image_is_one_line",
    "a derivative that is NaN": "unit/test_own_loop.py::test_a_derivative_that_is_not_finite_is_one_line",
    "unknown keys": "unit/test_own_loop.py::test_values_that_would_be_ignored_are_one_line",
    "None for a value": "unit/test_own_loop.py::test_values_that_are_no_numbers_are_one_line",
    # Confinement
    "photographs and masks outside of the capture": "unit/test_confinement.py::test_files_outside_are_refused",
    "a folder of photographs that is a link": "unit/test_confinement.py::test_a_folder_of_photographs_that_is_a_link_is_refused",
    "meshes, textures and grids outside": "render/test_confined_scenes.py::test_assets_outside_are_refused",
    # Signals and memory
    "Ctrl-C while the command is loaded": "cli/test_signals_anywhere.py::test_while_the_command_is_loaded",
    "Ctrl-C during compiled code": "cli/test_signals_anywhere.py::test_compiled_code_that_goes_on_says_why_nothing_happens",
    "signals at any moment": "cli/test_signals_anywhere.py::test_at_uniformly_drawn_moments",
    "a signal while the supervised command starts": "cli/test_limited_memory.py::test_a_signal_between_the_processes_is_one_line",
    "too few addresses": "cli/test_limited_memory.py::test_too_few_addresses_are_one_line",
    "no memory in a library": "cli/test_limited_memory.py::test_the_libraries_run_out_of_memory",
    "a container that kills the command": "cli/test_limited_memory.py::test_a_container_ends_the_process",
    # Bad machines
    "a full disk, a full table of inodes": "cli/test_bad_machines.py::test_a_full_disk_is_one_line_and_the_run_goes_on_later",
    "damaged kernels in the cache": "cli/test_bad_machines.py::test_damaged_and_exchanged_kernels_change_nothing",
    "processes that share a cache": "cli/test_bad_machines.py::test_processes_that_fill_one_cache_together",
    "a cache that another user could fill": "unit/test_cache.py::test_a_folder_that_another_user_could_replace_keeps_nothing",
    "a clock that jumps": "cli/test_bad_machines.py::test_a_clock_that_jumps",
    "NFS without locks": "cli/test_bad_machines.py::test_a_file_system_without_locks",
    "entry points that raise": "cli/test_stranger.py::test_it_is_listed_and_a_broken_one_is_one_line",
}  # fmt: skip


@cache
def functions(file: str) -> set[str]:
    return {node.name for node in ast.parse((TESTS / file).read_text()).body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("attack", ATTACKS)
def test_each_attack_has_its_test(attack: str) -> None:
    file, _, name = ATTACKS[attack].partition("::")
    assert name in functions(file)
