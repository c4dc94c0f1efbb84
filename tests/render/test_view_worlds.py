"""Views of different worlds: values of single views, scenes of single views, from Python and from files, against separate renders."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.app.distributed.transfer import packed, unpacked
from unrender.app.stages import stages_file
from unrender.app.stages.stage_problem import StagedProblem
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.estimators.base import as_numpy
from unrender.images.recursive_control_variate import RecursiveControlVariate
from unrender.runs.reopen import problem_of
from unrender.scene import serialization
from unrender.scene.batches import PixelBatch, PixelSample
from unrender.scene.fingerprint import differences, fingerprint

pytestmark = pytest.mark.mitsuba

WALL, LAMP, PAINT = "wall.bsdf.reflectance.data", "right.intensity.value", 4
DARK = [0.0, 0.0, 0.0]


def scene(
    left: float = 1.0, right: float = 3.0, paint: float = 0.5, width: int = 8, shift: float = 0.0
) -> dict[str, Any]:
    """A wall with a texture under two lamps."""
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": width, "height": 8, "rfilter": {"type": "box"}}
    texture = mi.Bitmap(np.full((PAINT, PAINT, 3), paint, np.float32))
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 50, "to_world": look, "film": film},
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([shift, 0, 0]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "raw": True}},
        },
        "left": {"type": "point", "position": [-1, 0, 2], "intensity": left},
        "right": {"type": "point", "position": [1, 0, 2], "intensity": right},
    }


def picture(spp: int = 256, **of: Any) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene(**of)), spp=spp, seed=mi.UInt32(7)))


def problem(views: list[ur.View], keys: tuple[str, ...] = (WALL,), **options: Any) -> ur.Problem:
    return ur.Problem(scene, [ur.Parameter(key) for key in keys], views, **options)


def lit_apart() -> ur.Problem:
    """Three views of one sensor: both lamps, the left alone, the right alone."""
    seen = [
        ur.View(picture(paint=0.3)),
        ur.View(picture(paint=0.3, right=0.0), known={LAMP: DARK}),
        ur.View(picture(paint=0.3, left=0.0), known={"left.intensity.value": DARK}),
    ]
    return problem(seen, (WALL, LAMP))


def agree(found: np.ndarray, expected: np.ndarray, errors: float = 5.0) -> bool:
    """Whether pictures agree within their noise, which two lamps of which one is drawn have: the means over all pixels within 5 σ."""
    noise = (found - expected).std() / np.sqrt(found[..., 0].size)
    return bool(abs((found - expected).mean()) < errors * noise + 1e-5)


def test_each_view_shows_its_own_world() -> None:
    made = lit_apart()
    values = {WALL: np.full((PAINT, PAINT, 3), 0.3, np.float32), LAMP: np.full(3, 3.0, np.float32)}
    for index, view in enumerate(made.views):
        assert agree(ur.render(made, values, view=index, spp=256), np.asarray(view.reference))
    # The planted fault: another view's world.
    assert not agree(ur.render(made, values, view=1, spp=256), np.asarray(made.views[2].reference))


@pytest.mark.parametrize("image", quick(["plain", "rcv"], "rcv"))
def test_the_gradient_is_the_sum_of_separate_problems(image: str) -> None:
    """Whole views, with the same random numbers: equal to rounding. A lamp that is off in a view has no gradient there."""
    estimator = ur.PathGradient(RecursiveControlVariate(), spp=8) if image == "rcv" else ur.PathGradient(spp=8)
    references = [picture(paint=0.3), picture(paint=0.3, right=0.0)]
    together = problem([ur.View(references[0]), ur.View(references[1], known={LAMP: DARK})], (WALL, LAMP))
    point = together.initial()
    state, total = estimator.init(together, point), []
    for step in range(3):
        estimate, state = estimator.estimate(together, point, state, Key(1, step))
        total.append(as_numpy(estimate).gradient)
    apart = problem([ur.View(references[0]), ur.View(references[0])], (WALL, LAMP))
    assert np.abs(total[-1][WALL]).max() > 0
    other = estimator.estimate(apart, point, estimator.init(apart, point), Key(1, 0))[0]
    assert not np.allclose(as_numpy(other).gradient[WALL], total[0][WALL], rtol=1e-2)
    brighter = problem([ur.View(references[0]), ur.View(2.0 * references[1], known={LAMP: DARK})], (WALL, LAMP))
    changed = as_numpy(estimator.estimate(brighter, point, estimator.init(brighter, point), Key(1, 0))[0]).gradient
    np.testing.assert_array_equal(changed[LAMP], total[0][LAMP])
    assert not np.allclose(changed[WALL], total[0][WALL], rtol=1e-2)


@pytest.mark.slow
def test_adaptive_mini_batches_mix_the_worlds() -> None:
    made = lit_apart()
    result = ur.optimize(made, "adaptive", steps=40)
    assert result.skipped == 0
    assert np.abs(result.parameters[WALL] - 0.3).mean() < np.abs(result.initial[WALL] - 0.3).mean()


def test_the_gradient_is_the_slope_of_the_loss() -> None:
    """A brighter wall and a brighter lamp, by differences of many-sample pictures."""
    made = lit_apart()
    paint, lamp = np.full((PAINT, PAINT, 3), 0.5, np.float32), np.full(3, 3.0, np.float32)
    point = {WALL: made.renderer.array(paint), LAMP: made.renderer.array(lamp)}
    estimator, found = ur.PathGradient(spp=128), []
    for seed in range(12):
        estimate = estimator.estimate(made, point, estimator.init(made, point), Key(seed))[0]
        found.append([float(np.sum(x)) for x in as_numpy(estimate).gradient.values()])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(len(found))

    def loss(of_paint: float, of_lamp: float) -> float:
        worlds = [{"right": of_lamp}, {"right": 0.0}, {"right": of_lamp, "left": 0.0}]
        pictures = [picture(spp=4096, paint=of_paint, **world) for world in worlds]
        references = [np.asarray(view.reference) for view in made.views]
        return sum(float(np.mean((one - other) ** 2)) for one, other in zip(pictures, references, strict=True))

    slopes = [(loss(0.51, 3.0) - loss(0.49, 3.0)) / 0.02, (loss(0.5, 3.05) - loss(0.5, 2.95)) / 0.1]
    for slope, value, sigma in zip(slopes, mean, error, strict=True):
        assert abs(value - slope) < 5 * sigma + 0.01 * abs(slope)
        assert abs(1.5 * value - slope) > 5 * sigma + 0.01 * abs(slope)


def test_pixels_drawn_from_all_views_are_those_of_the_views() -> None:
    made = lit_apart()
    point = made.initial()
    session = made.renderer.prepare(list(point), None)
    rng = np.random.default_rng(0)
    views, pixels = rng.integers(0, 3, 50), rng.integers(0, 64, 50)
    like = made.renderer.array(np.zeros(1))
    sample = PixelSample(
        arrays.like_integers(views, like), arrays.like_integers(pixels, like), made.renderer.array(np.ones((50, 1)))
    )
    request = PixelBatch(made, sample).request(256, 3, 2)
    rendering = session.image(point, request)
    images = arrays.numpy(rendering.images).mean(axis=0)
    whole = [ur.render(made, view=view, spp=1024).reshape(-1, 3) for view in range(3)]
    expected = np.stack([whole[view][pixel] for view, pixel in zip(views, pixels, strict=True)])
    for view in range(3):
        assert images[views == view].mean() == pytest.approx(expected[views == view].mean(), rel=0.1)
    # The adjoint of a weight on view 1 alone does not see the lamp that is off there.
    weights = np.zeros((2, 50, 3), np.float32)
    weights[:, views == 1] = 1.0
    gradient = session.adjoint(point, rendering.paths, made.renderer.array(weights))
    assert (arrays.numpy(gradient[LAMP]) == 0).all()
    assert (arrays.numpy(gradient[WALL]) != 0).any()
    weights = np.zeros((2, 50, 3), np.float32)
    weights[:, views == 2] = 1.0
    gradient = session.adjoint(point, rendering.paths, made.renderer.array(weights))
    assert arrays.numpy(gradient[LAMP])[0] == pytest.approx(images[views == 2, 0].sum() / 3.0, rel=1e-3)


@pytest.mark.slow
def test_a_view_may_have_a_scene_and_a_film_of_its_own() -> None:
    """One paint in two rooms, of which one is dark on the right, and has a wider film."""
    other = scene(right=0.0, width=12)
    references = [picture(paint=0.3), picture(paint=0.3, right=0.0, width=12)]
    views = [ur.View(references[0]), ur.View(references[1], scene=other)]
    made = problem(views)
    assert made.sizes == [(8, 8), (8, 12)]
    values = {WALL: np.full((PAINT, PAINT, 3), 0.3, np.float32)}
    assert agree(ur.render(made, values, view=1, spp=256), references[1])
    result = ur.optimize(made, "auto", steps=60, progress=False)
    assert np.abs(result.parameters[WALL][1:-1, 1:-1] - 0.3).mean() < 0.05
    texts = {WALL: "0.5 * grey"}  # the other room was refused, since it has no parameter "grey"
    derived = ur.Problem(scene, [ur.Parameter("grey", initial=0.6)], views, expressions=texts)
    assert agree(ur.render(derived, view=1, spp=256), references[1])


@pytest.mark.slow
def test_a_known_pose_moves_an_object_in_one_view() -> None:
    moved = picture(paint=0.3, shift=0.7)
    made = problem([ur.View(picture(paint=0.3)), ur.View(moved, known={"wall.translation": [0.7, 0.0, 0.0]})])
    values = {WALL: np.full((PAINT, PAINT, 3), 0.3, np.float32)}
    still, turned = (ur.render(made, values, view=view, spp=256) for view in range(2))
    assert np.abs(turned - moved).mean() < 0.15 * moved.mean()
    assert np.abs(still - moved).mean() > 0.3 * moved.mean()
    result = ur.optimize(made, "auto", steps=60, progress=False)
    assert np.abs(result.parameters[WALL] - 0.3).mean() < 0.05


@pytest.mark.slow
def test_lamps_of_three_pictures_are_told_apart() -> None:
    """Wall and lamp trade off in one picture; lamps that are lit one by one, of which one is known, tell them apart."""
    result = ur.optimize(lit_apart(), "auto", steps=150, progress=False)
    assert result.parameters[LAMP] == pytest.approx(np.full(3, 3.0), rel=0.1)
    assert result.status == "finished"


def seen(made: ur.Problem, values: dict[str, np.ndarray], spp: int = 1024) -> list[np.ndarray]:
    return [ur.render(made, values, view=view, spp=spp) for view in range(len(made.views))]


@pytest.mark.slow
def test_a_jar_in_four_worlds_is_recovered() -> None:
    """Lamps off, the jar turned, and outdoors: pictures at the truth, the gradient by differences of pictures, and the descent."""
    made = ur.gallery.problem("one-jar", resolution=24, texture_resolution=8)
    references = [np.asarray(view.reference) for view in made.views]
    true = seen(made, made.truth)
    for n in range(4):  # own and other view's world, the planted fault
        own, other = (np.abs(true[n] - references[m]).mean() / true[n].mean() for m in (n, n - 1))
        assert own < 0.04
        assert other > 0.1
    start = made.initial_values()
    estimator, point, found = ur.PathGradient(spp=64), made.initial(), []
    for seed in range(8):
        estimate = estimator.estimate(made, point, estimator.init(made, point), Key(seed))[0]
        found.append([float(np.sum(x)) for x in as_numpy(estimate).gradient.values()])
    for number, (key, step) in enumerate(zip(start, (0.02, 0.5), strict=True)):
        ends = [seen(made, {**start, key: start[key] + sign * step}) for sign in (1, -1)]
        losses = [sum(float(np.mean(np.square(a - b))) for a, b in zip(end, references, strict=True)) for end in ends]
        slope, mean = (losses[0] - losses[1]) / (2 * step), np.mean(found, axis=0)[number]
        error = 5 * np.std(found, axis=0, ddof=1)[number] / np.sqrt(len(found)) + 0.01 * abs(slope)
        assert abs(mean - slope) < error
        assert abs(0.75 * mean - slope) > error
    result = ur.optimize(made, steps=80, progress=False)
    for key, error in made.parameter_error(result.parameters).items():
        assert error < 0.3 * made.parameter_error(start)[key]


# ---------------------------------------------------------------------- files

XML = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="8"/><rfilter type="box"/></film></sensor>
<shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
<emitter type="point" id="lamp"><point name="position" x="0" y="0" z="2"/><rgb name="intensity" value="{light}"/></emitter></scene>"""
HEAD = 'scene = "scene.xml"\n[[parameters]]\nkey = "wall.bsdf.reflectance.value"\n[[views]]\nreference = "one.npy"\n'


def files(folder: Path, more: str) -> Path:
    (folder / "scene.xml").write_text(XML.format(width=8, light=2.0))
    (folder / "other.xml").write_text(XML.format(width=6, light=5.0))
    np.save(folder / "one.npy", np.full((8, 8, 3), 0.1, np.float32))
    np.save(folder / "two.npy", np.full((8, 6, 3), 0.1, np.float32))
    (folder / "problem.toml").write_text(HEAD + more)
    return folder / "problem.toml"


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_a_file_has_worlds_and_its_run_resumes(tmp_path: Path) -> None:
    worlds = '[[views]]\nreference = "one.npy"\nwith = { "lamp.intensity.value" = [0.5, 0.5, 0.5] }\n'
    worlds += '[[views]]\nreference = "two.npy"\nscene = "other.xml"\n'
    made = ur.Problem.from_file(files(tmp_path, worlds))
    means = [ur.render(made, view=view, spp=16).mean() for view in range(3)]
    # Views take random numbers of their own; over seeds their ratio scatters by .17 %.
    assert means[1] == pytest.approx(means[0] / 4, rel=0.01)
    assert means[2] > 2 * means[0]
    ur.optimize(made, "auto", steps=6, run_directory=tmp_path / "run", progress=False)
    straight = ur.optimize(made, "auto", steps=12, run_directory=tmp_path / "straight", progress=False)
    (tmp_path / "changed").mkdir()
    changed = ur.Problem.from_file(files(tmp_path / "changed", worlds.replace("0.5,", "0.6,")))
    known, key = fingerprint(made), "view 1: known lamp.intensity.value"
    assert known[key] != fingerprint(changed)[key]
    assert known["view 2: scene"].endswith("other.xml")
    resumed = ur.resume(tmp_path / "run", steps=12)
    key = "wall.bsdf.reflectance.value"
    assert resumed.parameters[key] == pytest.approx(straight.parameters[key], rel=1e-5)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("with = { nothing = 1.0 }", r"problem.toml:6: views\[0\].with: the scene has no parameter nothing"),
        (
            'with = { "wall.bsdf.reflectance.value" = 0.5 }',
            r"wall.bsdf.reflectance.value is known in all views, so none",
        ),
        ("with = 3", r"problem.toml:6: views\[0\].with: expected a table of values by key in quotes"),
        ("with = { lamp.intensity.value = 0 }", r'"lamp.intensity.value" = 0 }, got lamp = \{\'intensity\''),
        ('with = { "lamp.intensity.value" = true }', r"got lamp.intensity.value = true$"),
        (
            'with = { "wall.rotation" = [0, 1] }',
            r"wall.rotation: expected a number or 3 numbers, got an array of shape",
        ),
        ('with = { "lamp.intensity.value" = -1 }', r"views\[0\].with: lamp.intensity.value: expected at least 0"),
        ('with = { "lamp.intensity.value" = [1, 2] }', r"views\[0\].with: lamp.intensity.value: "),
        ('scene = "missing.xml"', r"views\[0\].scene: "),
        ('scene = "other.xml"', r"views\[0\].reference: \w+.npy: 8x8 pixels"),
        ('scene = "other.xml"\nsensor = 3', r"views\[0\].sensor: expected 0, the only sensor, got 3"),
        ("when = 3", r"views\[0\].when: no such field; there are reference, sensor, weight, mask, with, scene"),
    ],
)
def test_a_world_that_cannot_be_is_refused_in_one_line(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        ur.Problem.from_file(files(tmp_path, more + "\n"))
    assert "\n" not in str(caught.value)


def test_a_part_of_the_views_may_know_an_unknown() -> None:
    """Views of one worker, and the first view of a stage's scene: another view determines the lamp."""
    cloudpickle = pytest.importorskip("ray").cloudpickle
    made = problem([ur.View(picture()), ur.View(picture(right=0.0), known={LAMP: DARK})], (WALL, LAMP), max_depth=3)
    ray = SimpleNamespace(cloudpickle=cloudpickle)
    for view in (0, 1):
        assert len(unpacked(packed(made, [view], ray), ray).views) == 1
    with pytest.raises(InputError, match=f"{LAMP} is known in all views"):
        made.replaced(views=made.original_views[1:])


def test_a_tie_may_have_a_member_that_all_views_know() -> None:
    """It was refused, though the other member determines the value."""
    left = "left.intensity.value"
    view = ur.View(picture(left=2.0, right=0.0), known={LAMP: DARK})
    tie = ur.Parameter("lamps", keys=[left, LAMP], initial=1.5)
    made = ur.Problem(scene, [tie], [view])
    alone = ur.Problem(scene, [ur.Parameter(left, initial=1.5)], [view])
    estimator = ur.PathGradient(spp=8)
    (one,), (other,) = (ur.estimate(p, estimator).gradient.values() for p in (made, alone))
    assert np.abs(other).min() > 0
    np.testing.assert_allclose(one, other, rtol=1e-5)
    with pytest.raises(InputError, match="lamps is known in all views"):
        made.replaced(views=[ur.View(picture(), known={LAMP: DARK, left: DARK})])
    with pytest.raises(InputError, match="no parameter lamps; give the parameters of the scene that this unknown sets"):
        made.replaced(views=[ur.View(picture(), known={"lamps": DARK})])


def test_a_stage_has_a_scene_though_the_first_view_knows_what_is_fixed(tmp_path: Path) -> None:
    lamp, more = "lamp.intensity.value", 'with = { "lamp.intensity.value" = [0.5, 0.5, 0.5] }\n'
    file = files(tmp_path, f'{more}[[views]]\nreference = "one.npy"\n[[parameters]]\nkey = "{lamp}"\n')
    stage = stages_file.Stage("colour", ("wall.bsdf.reflectance.value",))
    first = stages_file.Stage("light", (lamp,))
    whole = StagedProblem.read(stages_file.Stages(file, (first, stage), steps=1))
    made = whole.of_stage(stage, {lamp: np.full(3, 3.0, np.float32)}, tmp_path / "made")
    assert made.renderer.values([lamp])[lamp].numpy() == pytest.approx(3.0)


def test_a_stage_has_the_initial_values_of_what_it_does_not_move(tmp_path: Path) -> None:
    """It had the values of the scenes instead, 2 and 5."""
    lamp = "lamp.intensity.value"
    more = f'[[views]]\nreference = "two.npy"\nscene = "other.xml"\n[[parameters]]\nkey = "{lamp}"\ninitial = 3.0\n'
    file = files(tmp_path, more)
    colour = stages_file.Stage("colour", ("wall.bsdf.reflectance.value",))
    staged = StagedProblem.read(stages_file.Stages(file, (colour, stages_file.Stage("light", (lamp,))), steps=1))
    whole = ur.Problem.from_file(file)
    for intensity, earlier in ((3.0, {}), (4.0, {lamp: np.full(3, 4.0, np.float32)})):
        made = staged.of_stage(colour, earlier, tmp_path / f"made{intensity:.0f}")
        values = {**whole.initial_values(), lamp: np.full(3, intensity, np.float32)}
        for view in (0, 1):
            expected = ur.render(whole, values, view=view, spp=16).mean()
            assert ur.render(made, view=view, spp=16).mean() == pytest.approx(expected, rel=1e-4)


def test_unknowns_of_expressions_in_stages_are_refused(tmp_path: Path) -> None:
    more = '[[parameters]]\nkey = "strength"\ninitial = 3.0\n[expressions]\n"lamp.intensity.value" = "strength * [1, 1, 1]"\n'
    stages = stages_file.Stages(files(tmp_path, more), (stages_file.Stage("light", ("strength",)),), steps=1)
    with pytest.raises(InputError, match="strength is an unknown of expressions, which stages do not support"):
        StagedProblem.read(stages)


def test_reopened_scenes_of_views_keep_the_depth_of_their_integrators(tmp_path: Path) -> None:
    """They took that of the problem's scene in stages, reopened run folders, workers and `replaced`. A depth of 1 shows no lit wall."""
    cloudpickle = pytest.importorskip("ray").cloudpickle
    lamp = "lamp.intensity.value"
    more = f'[[views]]\nreference = "two.npy"\nscene = "other.xml"\n[[parameters]]\nkey = "{lamp}"\n'
    file, other = files(tmp_path, more), tmp_path / "other.xml"
    other.write_text(other.read_text().replace('name="max_depth" value="2"', 'name="max_depth" value="1"'))
    made = ur.Problem.from_file(file)
    (tmp_path / "run").mkdir()
    serialization.save(made, tmp_path / "run")
    stages = stages_file.Stages(file, (stages_file.Stage("light", (lamp,)),), steps=1)
    staged = StagedProblem.read(stages).of_stage(stages.stages[0], {}, tmp_path / "made")
    reopened = ur.Problem.from_file(tmp_path / "run" / serialization.FILE)
    ray = SimpleNamespace(cloudpickle=cloudpickle)
    sent = unpacked(packed(made, [0, 1], ray), ray)
    for each in (made, made.replaced(name="again"), reopened, staged, sent):
        assert ur.render(each, view=0, spp=4).mean() > 0.01
        assert not ur.render(each, view=1, spp=4).any()


def test_a_known_value_without_a_key_is_refused() -> None:
    with pytest.raises(InputError, match=r"view 1: known: expected values by key of the scene, got \{3: 0\.5\}"):
        problem([ur.View(picture()), ur.View(picture(), known={3: 0.5})])  # pyright: ignore[reportArgumentType]


def test_a_scene_without_the_unknowns_is_refused() -> None:
    other = scene()
    other["floor"] = other.pop("wall")
    with pytest.raises(InputError, match="view 0: scene: it has none of the unknowns, such as wall"):
        problem([ur.View(picture(), scene=other)])


def test_a_view_of_a_sensor_that_the_scene_lacks_is_refused_beside_other_worlds() -> None:
    """It showed the other view's world, which is a sensor behind the scene's."""
    views = [ur.View(picture(), sensor=1), ur.View(picture(right=0.0), known={LAMP: DARK})]
    for make in (problem, lit_apart().replaced):
        with pytest.raises(InputError, match="view 0: sensor: expected 0, the only sensor, got 1"):
            make(views=views)


def test_changed_files_of_views_are_differences_and_another_working_directory_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only their names counted: a run resumed with other lamps, and not from another directory."""
    lamp, more = "lamp.intensity.value", '[[views]]\nreference = "two.npy"\nscene = "other.xml"\n'
    file = files(tmp_path, f'with = {{ "{lamp}" = "lamp.npy" }}\n{more}')
    np.save(tmp_path / "lamp.npy", np.full(3, 0.5, np.float32))
    monkeypatch.chdir(tmp_path)
    first = fingerprint(ur.Problem.from_file(file.name))
    monkeypatch.chdir("/")
    assert differences(first, fingerprint(ur.Problem.from_file(file))) == []
    np.save(tmp_path / "lamp.npy", np.full(3, 0.6, np.float32))
    (tmp_path / "other.xml").write_text(XML.format(width=6, light=6.0))
    changes = [f"view 0: known {lamp} has changed", "file other.xml has changed"]
    assert differences(first, fingerprint(ur.Problem.from_file(file))) == changes


@pytest.mark.usefixtures("short_ends")
def test_a_scene_of_a_view_made_in_python_is_no_part_of_a_file(tmp_path: Path) -> None:
    """The file was written without it, and the view reopened with the problem's scene."""
    file = files(tmp_path, "")
    key, one = "wall.bsdf.reflectance.value", np.load(tmp_path / "one.npy")
    other = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    made = []
    for light in (1.0, 2.0):
        views = [ur.View(one), ur.View(one, scene=scene(left=light) | {"wall": scene()["wall"] | {"bsdf": other}})]
        made.append(ur.Problem(tmp_path / "scene.xml", [ur.Parameter(key)], views))
    assert differences(*map(fingerprint, made)) == ["view 1: scene has changed"]
    ur.optimize(made[0], "plain", steps=2, run_directory=tmp_path / "run", progress=False)
    with pytest.raises(InputError, match="the problem was made in Python; pass it"):
        problem_of(tmp_path / "run")
    assert "scene" in ur.Problem.from_file(file).origin


def test_a_reopened_folder_knows_the_same_values(tmp_path: Path) -> None:
    """Its file with the values was compared with the values themselves, and runs did not resume."""
    files(tmp_path, "")
    one, lamp = np.load(tmp_path / "one.npy"), "lamp.intensity.value"
    views = [ur.View(one), ur.View(one, known={lamp: 0.5}), ur.View(one, known={lamp: np.array([1.0, 2.0, 3.0])})]
    made = ur.Problem(tmp_path / "scene.xml", [ur.Parameter("wall.bsdf.reflectance.value")], views)
    (tmp_path / "run").mkdir()
    serialization.save(made, tmp_path / "run")
    again = ur.Problem.from_file(tmp_path / "run" / serialization.FILE)
    assert differences(fingerprint(made), fingerprint(again)) == []
