"""The slices: tests, costs, the suite, and each paper's figures, at sizes for a GPU.

Minutes are estimates, since no slice has run on a GPU yet: where a benchmark has budgets, runs times budget and half a minute of
compilation for each scene, else a guess. The texts of the papers at hand give few film sizes; where one has none, films are of 256² to
1024².
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass

__all__ = ["SLICES", "Command", "Slice"]


@dataclass(frozen=True)
class Command:
    """One process; what has ended is not run again.

    Attributes:
        words: "doctor", "tests" with pytest's arguments, or a benchmark with its options.
        minutes: expected on a GPU; an estimate.
        toy: in place of the words after the first at toy sizes; benchmarks get `--quick` besides.
    """

    words: str
    minutes: float
    toy: str = ""

    @property
    def name(self) -> str:
        """What runs: "doctor", "tests" or a benchmark."""
        return shlex.split(self.words)[0]

    def arguments(self, toy: bool) -> list[str]:
        """The words after the name, at full or at toy sizes."""
        if not toy:
            return shlex.split(self.words)[1:]
        quick = [] if self.name in ("doctor", "tests") else ["--quick"]
        return [*quick, *shlex.split(self.toy)]


@dataclass(frozen=True)
class Slice:
    """A part of the plan.

    Attributes:
        name: on the command line.
        what: it shows; with the paper's figure where it is one's.
        commands: run in this order.
    """

    name: str
    what: str
    commands: tuple[Command, ...]

    @property
    def minutes(self) -> float:
        """Expected in all."""
        return sum(command.minutes for command in self.commands)


def _one(name: str, what: str, *commands: tuple[float, str] | tuple[float, str, str]) -> Slice:
    return Slice(name, what, tuple(Command(words, minutes, *toy) for minutes, words, *toy in commands))


def _tests(folder: str, minutes: float, toy: str) -> Slice:
    words = f"tests -m 'mitsuba and not slow' tests/{folder}"
    return _one(f"tests-{folder}", f"the quick tests of tests/{folder} that render", (minutes, words, toy))


_SUITE = "--gallery-resolution 512 --seconds 10 --seeds 2 --spp 4 16 --rates 0.02 0.05"
_SUITE_PROBLEMS = (
    ("indirect-room", "glossy-room", "sunlit-vase"),
    ("lamp", "spiral", "ajar"),
    ("chalice", "mirror-trio", "sun-glossy"),
    ("plain-and-textured", "two-planets", "caustic"),
    ("poster", "three-bodies", "wall"),
    ("tea", "smoke"),
)
_RACES = ("indirect-room", "glossy-room", "sunlit-vase", "lamp")
_TASKS = {"QUAD": 2, "BOX2": 5, "BOX10": 8, "MUG": 5, "SHADOW": 6, "BUNNY": 8, "TEXTURE": 9}
_META = ("'adam 4 spp' 'adam 16 spp' 'rcv 2 spp' meta", "'adam 32 spp' 'coupled 3 spp' 'coupled 3 spp, rcv'")
_AJAR = ("'adam 1 spp' 'adam 16 spp' 'adam 64 spp' meta", "'adam 4 spp' 'rcv 2 spp' 'coupled 3 spp, rcv'")
_NERF = ("'Adam, 2 spp' 'Adam, 4 spp'", "'Adam, 8 spp' meta", "'coupled, 3 spp' 'coupled on rcv, 3 spp'")
_SHAPES = ("SUZANNE", "BANANA")
_NETWORKS = ("CNN", "CNN5")
_LARGE = (
    ("three-textures", "Fig. 1", 5000, 1024),
    ("globe-and-mirror", "Fig. 9, EARTH", 2000, 4096),
    ("sun-glossy, 32 views", "Fig. 9, BOWL", 2000, 2048),
)
_ADAPTIVE = ("sun-glossy relative L2", "plain-and-textured", "two-planets")

SLICES: tuple[Slice, ...] = (
    _one("doctor", "what the machine has", (0.5, "doctor")),
    _tests("unit", 3, "-m 'mitsuba and not slow' tests/unit/test_losses.py"),
    _tests("contract", 9, "-m 'mitsuba and not slow' tests/contract/test_tolerance.py"),
    _tests("render", 9, "-m 'mitsuba and not slow' tests/render/test_grids.py"),
    _tests("statistical", 9, "-m 'mitsuba and not slow' tests/statistical/test_grey_box_chain_rule.py"),
    _one("denoisers", "OptiX against Open Image Denoise", (3, "denoisers --size 64 256 1024 --reference-spp 4096")),
    _one(
        "speed",
        "costs of pair, adjoint and step by film size, and outside of kernels",
        (3, "speed.sizes --size 256 512 1024 2048"),
        (3, "speed --resolution 512"),
    ),
    _one("first-step", "seconds to the first step, kernels compiled anew", (8, "first_step")),
    *(
        _one(
            f"suite-{number}",
            f"`auto` against the tuned loop: {', '.join(problems)}",
            *(
                (3.0, f"suite --problem {name} {_SUITE}", f"--problem {name} --gallery-resolution 16")
                for name in problems
            ),
        )
        for number, problems in enumerate(_SUITE_PROBLEMS, 1)
    ),
    _one(
        "rcv-variance",
        "RCV Figs 3, 6 and 7",
        (2, "rcv.fig3_weights --resolution 256"),
        (4, "rcv.fig6_7_loss_bias --resolution 256 --spp 16"),
    ),
    _one(
        "rcv-order",
        "RCV Fig. 4, at its 256 steps of 16 spp",
        (5, "rcv.fig4_order --resolution 256 --spp 16 --steps 256"),
    ),
    _one(
        "rcv-moving",
        "RCV Sec. 7 and Fig. 10",
        (3, "rcv.heuristic_weights --resolution 128 --spp 16"),
        (7, "rcv.fig10_perceptual --resolution 128 --spp 16 --steps 100 --seeds 1"),
    ),
    _one("rcv-spaces", "RCV Fig. 8", (6, "rcv.fig8_spaces --resolution 256")),
    *(
        _one(
            f"rcv-race-{name}-{loss}",
            f"RCV Fig. 9: {name}, {loss}",
            (
                7,
                f"rcv.fig9_reconstruction --problem {name} --loss {loss} --resolution 512 --seconds 8 --seeds 3",
                f"--problem {name} --loss {loss}",
            ),
        )
        for name in _RACES
        for loss in ("L1", "L2")
    ),
    *(
        _one(
            f"meta-spiral-{number}",
            "Meta Fig. 1, over 2000 steps",
            (
                8,
                f"meta.equal_time --problem spiral --resolution 256 --steps 2000 --seeds 3 --only {names}",
                f"--problem spiral --only {names}",
            ),
        )
        for number, names in enumerate(_META, 1)
    ),
    *(
        _one(
            f"meta-ajar-{number}",
            "Meta Fig. 6",
            (
                7,
                f"meta.equal_time --problem ajar --resolution 512 --seconds 12 --seeds 3 --only {names}",
                f"--problem ajar --only {names}",
            ),
        )
        for number, names in enumerate(_AJAR, 1)
    ),
    _one(
        "meta-chalice",
        "Meta Fig. 9, with its map of 2048²",
        (
            8,
            "meta.equal_time --problem chalice --resolution 512 --texture-resolution 2048 --seconds 12 --seeds 2 "
            "--only 'adam 4 spp' 'adam 16 spp' meta 'coupled 3 spp, rcv'",
            "--texture-resolution 8 --only 'adam 4 spp' 'adam 16 spp' meta 'coupled 3 spp, rcv'",
        ),
    ),
    _one(
        "meta-estimates",
        "Meta Figs 2 to 5 and Sec. 7",
        (2, "meta.fig3_4_estimates --resolution 128 --steps 100"),
        (3, "meta.fig5_ablations --seconds 5 --resolution 256"),
        (4, "meta.differences --resolution 128 --cost-resolution 256 1024 --runs 16"),
    ),
    *(
        _one(
            f"ho-table2-{task}",
            f"HO Table 2: {task}",
            (minutes, f"higher_order.table2 --task {task} --runs 10 --resolution 128", f"--task {task}"),
        )
        for task, minutes in _TASKS.items()
    ),
    _one(
        "ho-mesh",
        "HO Fig. 5, with its 2562 vertices",
        (6, "higher_order.fig5_mesh --subdivisions 4 --resolution 128 --seconds 60"),
    ),
    *(
        _one(
            f"ho-shapes-{task}",
            f"HO Fig. 5: {task}, at its number of vertices",
            (
                8,
                f"higher_order.fig5_shapes --task {task} --resolution 128 --seconds 60 --views 4",
                "--task BANANA",
            ),
        )
        for task in _SHAPES
    ),
    *(
        _one(
            f"ho-network-{task}",
            f"HO Table 2: {task}, over minutes",
            (9, f"higher_order.networks --task {task} --runs 1 --seconds 120 --images 64 --size 64", f"--task {task}"),
        )
        for task in _NETWORKS
    ),
    _one(
        "ho-noise",
        "HO supplement: rendering noise",
        (6, "higher_order.rendering_noise --resolution 128 --renders 1000"),
    ),
    _one(
        "ho-speed",
        "HO: cost and variance by batch and detail",
        (3, "higher_order.speed --resolution 256 --detail 1 3 5"),
        (4, "higher_order.variance"),
    ),
    _one(
        "adaptive-variance",
        "Adaptive Figs 3 and 7",
        (3, "adaptive.fig3_variance --resolution 256 --count 4096"),
        (4, "adaptive.fig7_failure --resolution 128"),
    ),
    *(
        _one(
            f"adaptive-race-{number}",
            f"Adaptive Figs 5 and 6: {name}",
            (
                8,
                f"adaptive.equal_time --problem '{name}' --resolution 1024 --count 65536 --seeds 3",
                f"--problem '{name}'",
            ),
        )
        for number, name in enumerate(_ADAPTIVE, 1)
    ),
    *(
        _one(
            f"adaptive-large-{number}",
            f"Adaptive {figure}: {name}, steps with falling rates",
            (
                9,
                f"adaptive.equal_time --problem '{name}' --steps {steps} --resolution {resolution} --count 65536 --seeds 1 "
                "--only uniform adaptive --part race",
                f"--problem '{name}' --steps 4",
            ),
        )
        for number, (name, figure, steps, resolution) in enumerate(_LARGE, 1)
    ),
    _one(
        "adaptive-volume",
        "Adaptive Fig. 9, LEGO: 8³ to its 256³",
        (9, "adaptive.coarse_volume --resolution 512 --grid 256 --every 150 --after 300 --count 65536 --seeds 1"),
    ),
    _one(
        "adaptive-kernels",
        "Adaptive Eq. 12 between colours, and Fig. 6",
        (3, "adaptive.cross_channels --paths 16777216"),
        (5, "adaptive.fig6_differential --resolution 256 --count 8192"),
    ),
    *(
        _one(
            f"volumes-nerf-{number}",
            "Meta Fig. 7, at its 256³",
            (
                8,
                "volumes.fig7_nerf --grid 256 --resolution 256 --schedule falling --seconds 48 --seeds 1 "
                f"--only {names}",
                f"--only {names}",
            ),
        )
        for number, names in enumerate(_NERF, 1)
    ),
    _one(
        "volumes-smoke",
        "RCV Fig. 11",
        (8, "volumes.fig11_smoke --budget time --resolution 128 --grid 64", "--budget time --seconds 0.3"),
    ),
    _one(
        "volumes-weights",
        "RCV Figs 2, 5 and 6",
        (3, "volumes.fig2_weights --resolution 128"),
        (3, "volumes.fig5_drift --resolution 64"),
        (3, "volumes.fig6_landscape --resolution 64"),
    ),
    _one(
        "volumes-cost",
        "cost of volumes, dense and sparse",
        (3, "volumes.cost --resolution 256 --grid 128"),
    ),
    _one(
        "memory",
        "device memory of grids to 256³",
        *((2.0, f"volumes.memory --method {name}", f"--method {name}") for name in ("plain", "rcv", "meta", "coupled")),
    ),
    _one(
        "shapes",
        "meshes at equal time",
        (9, "shapes.equal_time --problems sphere-to-bunny --resolution 256 --seconds 6 --seeds 2", "--strengths 5"),
    ),
)
