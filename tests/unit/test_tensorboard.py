"""The callback for TensorBoard: what its files hold."""

from __future__ import annotations

import sys

import pytest

import unrender as ur
from unrender.runs.callbacks import TensorBoard

PACKAGE = "needs tensorboardX: pip install 'unrender[tensorboard]'"


@pytest.mark.mitsuba
def test_events_hold_the_history_and_the_pictures(tmp_path):
    pytest.importorskip("tensorboardX", reason=PACKAGE)
    proto = pytest.importorskip("tensorboardX.proto.event_pb2")
    problem = ur.gallery.problem("exponential")
    estimator = ur.PathGradient(spp=4)
    adam = ur.optimizers.Adam(learning_rate=0.02)
    result = ur.optimize(problem, estimator, adam, steps=5, callbacks=[TensorBoard(tmp_path / "board")])
    (path,) = (tmp_path / "board").iterdir()
    found: dict[str, list[tuple[int, float]]] = {}
    pictures = set()
    data = path.read_bytes()
    while data:  # records: length, its checksum, the event, its checksum
        length = int.from_bytes(data[:8], "little")
        event = proto.Event()
        event.ParseFromString(data[12 : 12 + length])
        data = data[16 + length :]
        for value in event.summary.value:
            if value.HasField("simple_value"):
                found.setdefault(value.tag, []).append((event.step, value.simple_value))
            else:
                pictures.add(value.tag)
    assert found["loss"] == [(r["step"], pytest.approx(r["loss"], rel=1e-6)) for r in result.history]
    assert found["samples"][-1] == (4, result.history[-1]["samples"])
    assert "parameter_error/rate" in found
    assert pictures == {"view/0"}


def test_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ur.InputError, match=r"pip install 'unrender\[tensorboard\]'"):
        TensorBoard(tmp_path)


def test_a_place_that_cannot_be_written_to(tmp_path):
    pytest.importorskip("tensorboardX", reason=PACKAGE)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ur.InputError, match="cannot be written"):
        TensorBoard(tmp_path / "file")
    with pytest.raises(ur.InputError, match="picture_seconds"):
        TensorBoard(tmp_path / "board", picture_seconds=0)
