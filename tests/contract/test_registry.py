"""The registry: what is in it, how kinds are told, and what it refuses."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import inspect
import json
import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender import losses, optimizers
from unrender.core import registry, tables
from unrender.core.errors import InputError
from unrender.gallery import fields
from unrender.methods import methods
from unrender.runs.folder.state import Packed, pack, unpack

TABLES = registry.table_components()


@pytest.fixture(autouse=True)
def undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers is forgotten after it."""
    for kind in registry.KINDS:
        registry.components(kind)
    monkeypatch.setattr(registry, "_components", dict(registry._components))
    monkeypatch.setattr(registry, "_state_modules", set(registry._state_modules))


def elsewhere(name: str, module: str, made_by: type) -> type:
    """The same class by another name, of a module that is not loaded."""
    made = dataclass(frozen=True)(type(name, (made_by,), {}))
    made.__module__, made.__qualname__ = module, name
    return made


@dataclass(frozen=True)
class Cubic:
    """A loss by its methods."""

    scale: float = 1.0
    linear = False
    pixelwise = True

    def value(self, image, reference):
        return self.scale * abs(image - reference) ** 3

    def derivative(self, image, reference):
        return 3 * self.scale * (image - reference) * abs(image - reference)


# ---------------------------------------------------------------------- what is in it


@pytest.mark.parametrize("kind", registry.KINDS)
def test_protocols_and_members_are_as_the_registry_says(kind: str) -> None:
    told = registry.KINDS[kind]
    module, _, name = told.protocol.rpartition(".")
    protocol = getattr(importlib.import_module(module), name)
    assert registry.kind_of_protocol(protocol) == kind
    if told.members:
        assert told.members[0] <= set(dir(protocol))


@pytest.mark.parametrize("kind", registry.KINDS)
def test_every_public_component_is_registered(kind: str) -> None:
    """Those that a package exports, of its own dataclasses: none was forgotten."""
    told = registry.KINDS[kind]
    found = registry.components(kind)
    assert found
    if told.in_tables and kind != "estimator":
        exported = vars(importlib.import_module(told.package))
        public = {name for name in exported["__all__"] if hasattr(exported[name], "__dataclass_fields__")}
        # A function has no table: whoever gives one gives it again when a run is resumed.
        assert public - {"FunctionLoss"} <= set(found)
    assert {"PathGradient", "MetaEstimator", "SmoothedDerivatives", "LossValues"} <= set(
        registry.components("estimator")
    )


@pytest.mark.parametrize("name", sorted(set(TABLES) - {"Perceptual"}))  # whose default fetches a network's weights
def test_every_component_comes_back_from_its_table(name: str) -> None:
    """Its default, or with 2 for each field that has none."""
    made_by = TABLES[name]
    required = [p for p in inspect.signature(made_by).parameters.values() if p.default is inspect.Parameter.empty]
    component = made_by(**{parameter.name: 2 for parameter in required})
    table = tables.table(component)
    assert table["type"] == name
    assert tables.component(json.loads(json.dumps(table))) == component


def test_lists_begin_where_they_should() -> None:
    assert list(registry.components("loss"))[:5] == ["L1", "L2", "RelativeL2", "Huber", "Perceptual"]
    assert list(methods())[:7] == ["auto", "plain", "rcv", "meta", "coupled", "adaptive", "smoothed"]
    assert ur.gallery.names()[0] == "indirect-room"


# ---------------------------------------------------------------------- registering


def test_a_loss_is_known_by_its_methods_and_named_everywhere() -> None:
    assert ur.register(Cubic) is Cubic
    assert registry.components("loss")["Cubic"] is Cubic
    assert list(registry.components("loss"))[-1] == "Cubic"
    assert ur.gallery.problem("exponential", loss={"type": "Cubic", "scale": 2.0}).loss == Cubic(2.0)
    assert ur.gallery.problem("exponential", loss=Cubic(3.0)).loss == Cubic(3.0)
    assert tables.component("Cubic", "loss") == Cubic()


def test_a_name_and_a_kind_may_be_given() -> None:
    ur.register(name="cube", kind="loss", position=0)(Cubic)
    assert next(iter(registry.components("loss"))) == "cube"
    assert tables.table(Cubic(2.0)) == {"type": "cube", "scale": 2.0}


def test_gallery_problems_are_named_in_lower_case() -> None:
    @ur.register
    @dataclass(frozen=True)
    class TwoNumbers:
        """Two numbers."""

        loss: losses.Loss = field(default=losses.L2(), metadata=fields.LOSS)

        def problem(self, name: str) -> ur.Problem:
            return ur.gallery.problem("quad", loss=self.loss)

    assert ur.gallery.names()[-1] == "two-numbers"
    assert ur.gallery.problem("two-numbers", loss="L1").loss == losses.L1()
    assert ur.gallery.summary("two-numbers") == "Two numbers."


def test_the_same_class_may_come_again() -> None:
    """As from a notebook's cell that is run twice."""
    ur.register(Cubic)
    again = elsewhere("Cubic", __name__, Cubic)
    ur.register(again)
    assert registry.components("loss")["Cubic"] is again


def test_two_of_one_name_are_refused_with_both_modules() -> None:
    with pytest.raises(InputError) as caught:
        ur.register(elsewhere("Adam", "elsewhere", Cubic))
    assert "two components are called Adam" in str(caught.value)
    assert "unrender.optimizers.recipes" in str(caught.value)
    assert "elsewhere" in str(caught.value)
    assert registry.components("optimizer")["Adam"] is optimizers.Adam


@pytest.mark.parametrize(
    ("component", "options", "message"),
    [
        (Cubic(), {}, "expected a class, got Cubic"),
        (type("Nothing", (), {}), {}, "it has the methods of none; say which with kind=, of loss, schedule, "),
        (type("Both", (), {"check": 1, "apply": 1, "value": 1, "derivative": 1}), {}, "it may be a loss or a preconditioner"),
        (type("Loose", (), {"value": 1, "derivative": 1}), {}, "a component is a frozen dataclass; put @register above @dataclass"),
        (Cubic, {"kind": "los"}, "no kind 'los'; did you mean loss?"),
        (Cubic, {"kind": "method"}, "a method inherits from unrender.methods.base.Options"),
    ],
)  # fmt: skip
def test_what_cannot_be_registered_is_one_line(component: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        ur.register(**options)(component) if options else ur.register(component)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_names_get_a_suggestion() -> None:
    with pytest.raises(InputError, match=r"unknown loss huber; did you mean Huber\?"):
        registry.find("loss", "huber")
    with pytest.raises(InputError, match=r"no kind 'optimiser'; did you mean optimizer\?"):
        registry.components("optimiser")


# ---------------------------------------------------------------------- tables


@pytest.mark.parametrize(
    ("given", "kind", "message"),
    [
        ({"type": "Adma"}, None, 'unknown type "Adma"; did you mean Adam?; install the package that registers it'),
        ({"type": "PathGradient", "image": {"type": "Adam"}}, None, 'image: expected "Denoised" or "Plain" or "RecursiveControlVariate"'),
        ({"type": "PathGradient", "image": 3}, None, "image: expected"),
        ({"type": "PathGradient", "image": "plain"}, None, "did you mean Plain?"),
        ({"type": "Adam", "schedule": "cosine(x)"}, None, "schedule: schedule: expected a number, got 'x'"),
        ({"type": "Adam", "schedule": {"type": "Huber"}}, None, 'schedule: expected "Constant" or'),
        ({"type": "Adam", "none": ["rate"]}, None, "none: expected a list of fields of Adam"),
        ({"type": "Adam", "none": [{}]}, None, "none: expected a list of fields of Adam"),
        ({"type": "Cosine"}, None, "Cosine needs steps"),
        ("Cosine", "loss", 'expected "L1" or "L2"'),
        ({"type": "Uniform", "count": 3, "counts": 3}, "pixel sampler", "Uniform has no option counts; did you mean count?"),
        ({"type": "Huber", "delta": []}, "loss", "Huber: delta must be"),
    ],
)  # fmt: skip
def test_wrong_tables_are_one_line(given: Any, kind: str | None, message: str) -> None:
    with pytest.raises(InputError) as caught:
        tables.component(given, kind, "method.toml: optimizer")
    assert str(caught.value).startswith("method.toml: optimizer: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_schedules_are_tables_or_short_text_wherever_one_is_expected() -> None:
    expected = optimizers.Adam(schedule=ur.schedules.Warmup(5, ur.schedules.Cosine(30)))
    for schedule in (
        "warmup(5) then cosine(30)",
        {"type": "Warmup", "steps": 5, "then": "cosine(30)"},
        {"type": "Warmup", "steps": 5, "then": {"type": "Cosine", "steps": 30}},
    ):
        assert tables.component({"type": "Adam", "schedule": schedule}) == expected


def test_nested_without_end_is_refused() -> None:
    given: Any = "cosine(3)"
    for _ in range(40):
        given = {"type": "Warmup", "steps": 1, "then": given}
    with pytest.raises(InputError, match="nested too deeply"):
        tables.component({"type": "Adam", "schedule": given})


# ---------------------------------------------------------------------- other packages


def announce(monkeypatch: pytest.MonkeyPatch, *points: Any) -> None:
    """Let entry points be found, as at the first look-up of a process."""
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points if group == registry.GROUP else ())
    monkeypatch.setattr(registry, "_loaded", registry._loaded - {registry.GROUP})


def point(name: str, load: Any) -> Any:
    return SimpleNamespace(name=name, value=f"{name}.module", load=load)


def test_entry_points_are_loaded_once_and_a_broken_one_is_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loads = []

    def good() -> None:
        loads.append(1)
        ur.register(Cubic)

    def bad() -> None:
        ur.register(elsewhere("Half", "broken", Cubic))
        raise RuntimeError("no such\nlibrary")

    def leaves() -> None:
        sys.exit(3)

    class Own(BaseException):
        pass

    def raises_its_own() -> None:
        raise Own("of a kind that nobody catches")

    def takes_a_name() -> None:
        ur.register(name="L2", kind="loss")(Cubic)

    points = {"bad": bad, "good": good, "leaves": leaves, "own": raises_its_own, "taken": takes_a_name}
    announce(monkeypatch, *(point(name, load) for name, load in points.items()))
    with caplog.at_level(logging.WARNING, "unrender"):
        assert "Cubic" in registry.components("loss")
        assert "Cubic" in registry.table_components()
    assert loads == [1]
    lines = [record.getMessage() for record in caplog.records]
    assert [line.split()[2] for line in lines] == ["bad", "leaves", "own", "taken"]
    assert "RuntimeError: no such library" in lines[0]
    assert "two components are called L2" in lines[3]
    assert not any("\n" in line for line in lines)
    assert "Half" not in registry.components("loss")
    assert registry.components("loss")["L2"] is losses.L2


# ---------------------------------------------------------------------- states


@dataclass(frozen=True)
class Remembered:
    """A state of this module."""

    numbers: Any


@dataclass(frozen=True)
class Checked:
    """It does more than hold what it is given."""

    number: int

    def __post_init__(self):
        raise AssertionError("constructed from a file")


@dataclass(frozen=True)
class CheckedToo(Checked):
    """It inherits that."""


def test_states_of_registered_modules_come_back_and_no_others() -> None:
    packed = pack(Remembered(np.arange(3)))
    with pytest.raises(
        InputError, match=r"Remembered' is not a state .* nor of a registered component; install the package"
    ):
        unpack(packed)
    np.testing.assert_array_equal(unpack(packed, [{"estimator": (Remembered(1),)}]).numbers, np.arange(3))
    ur.register(Cubic)
    np.testing.assert_array_equal(unpack(packed).numbers, np.arange(3))
    for kind in ("Checked", "CheckedToo"):
        hostile = {"class": f"{__name__}.{kind}", "fields": {"number": 1}}
        with pytest.raises(InputError, match="is not a state"):
            unpack(Packed(hostile, {}))


def test_states_may_live_in_another_module() -> None:
    packed = pack(Remembered(1))
    ur.register(kind="loss", states=__name__)(elsewhere("Distant", "elsewhere", Cubic))
    assert unpack(packed) == Remembered(1)


def test_no_module_is_imported_because_a_file_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "trap.py").write_text("raise AssertionError('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="is not a state"):
        unpack(Packed({"class": "trap.State", "fields": {}}, {}))
    with pytest.raises(InputError, match=r'unknown type "trap\.State"'):
        tables.component({"type": "trap.State"})
    assert "trap" not in sys.modules


class Stop(ur.protocols.Callback):
    """Interrupts after five steps."""

    def on_step(self, run, record):
        if run.step == 5:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Halved:
    """An optimizer that nobody registers: half of Adam's step, in a state of this module."""

    def __post_init__(self):
        object.__setattr__(self, "adam", optimizers.Adam(0.1))

    @property
    def requires(self):
        return self.adam.requires  # pyright: ignore[reportAttributeAccessIssue]

    def init(self, parameters, learning_rates=None):
        return Remembered(self.adam.init(parameters, learning_rates))  # pyright: ignore[reportAttributeAccessIssue]

    def update(self, estimate, state, parameters):
        steps, after = self.adam.update(estimate, state.numbers, parameters)  # pyright: ignore[reportAttributeAccessIssue]
        return {key: 0.5 * step for key, step in steps.items()}, Remembered(after)


def test_a_component_that_is_not_registered_is_resumed_where_it_is_handed_in(tmp_path: Path) -> None:
    whole = ur.optimize(ur.gallery.problem("exponential"), ur.PathGradient(spp=2), Halved(), 8)
    with pytest.raises(KeyboardInterrupt):
        ur.optimize(
            ur.gallery.problem("exponential"), ur.PathGradient(spp=2), Halved(), 8, callbacks=[Stop()],
            run_directory=tmp_path / "run", checkpoint_every=2,
        )  # fmt: skip
    with pytest.raises(InputError, match=r"Halved is not registered, see unrender\.register\).*pass it"):
        ur.resume(tmp_path / "run")
    again = ur.resume(tmp_path / "run", optimizer=Halved())
    assert again.resumed == [4]
    assert again.parameters == whole.parameters


FLAGS = [
    (of, each.name) for of in TABLES.values() for each in dataclasses.fields(of) if each.init and each.type == "bool"
]


@pytest.mark.parametrize(("of", "flag"), FLAGS, ids=lambda each: getattr(each, "__name__", each))
def test_a_flag_that_is_not_true_or_false_is_refused(of: Any, flag: str) -> None:
    """The text "false" would count as true."""
    required = {"count": 4, "sigma": 0.1}
    arguments = {each.name: required[each.name] for each in dataclasses.fields(of) if each.name in required}
    with pytest.raises(InputError, match=f"^{of.__name__}: {flag} must be true or false, got 'false'"):
        of(**arguments | {flag: "false"})
    assert of(**arguments | {flag: np.bool_(getattr(of(**arguments), flag))}) == of(**arguments)


@pytest.mark.parametrize("kind", registry.KINDS)
def test_names_are_read_from_the_source_in_their_order(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    own = {
        name: made_by
        for name, made_by in registry.components(kind).items()
        if made_by.__module__.startswith("unrender.")
    }
    monkeypatch.setattr(registry, "_components", {})
    monkeypatch.setattr(registry, "components", lambda kind: {"imported": object})
    assert registry.names(kind) == (list(own) if kind in ("method", "gallery problem") else ["imported"])
