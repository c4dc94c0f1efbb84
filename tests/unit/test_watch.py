"""The live page's server, asked without a browser; and what a browser makes of text that wants to be a script."""

from __future__ import annotations

import io
import json
import re
import shutil
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import uvicorn
from PIL import Image
from report_folders import KEY, write_run

from browser import chromium
from unrender.app.report import tone_mapping
from unrender.app.watch import Address, application
from unrender.app.watch.server import listen
from unrender.losses import metrics

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # newer ones of Starlette would rather have httpx's successor
    from starlette.testclient import TestClient

HOSTILE = (
    "<script>document.title='owned'</script>\"'><img src=x onerror=\"document.title='owned'\">{{ 1234 * 4321 }}</style>"
)


class Asked:
    """A page that is served, and what it answers."""

    def __init__(self, *folders: Path):
        self.address = Address(8000)
        self.client = TestClient(application(folders, self.address), base_url="http://127.0.0.1:8000")
        self.root = f"/{self.address.token}/"

    def get(self, path: str = "", **headers: str):
        return self.client.get(self.root + path, headers=headers)

    def order(self, command: object, run: int = 0, **headers: str):
        return self.client.post(f"{self.root}control/{run}", json={"command": command}, headers=headers)


def go_on(folder: Path, **status: object) -> Path:
    """Make a run folder one of a run that goes on."""
    live = folder / "live"
    live.mkdir()
    for name in ("run.json", "initial.npz", "truth.npz", "parameters.npz", "history.jsonl"):
        shutil.move(folder / name, live / name)
    with np.load(folder / "pictures.npz") as found:
        kinds = {name: found[name] for name in found.files}
    np.savez(live / "start.npz", **{n: a for n, a in kinds.items() if not n.endswith("result")})
    np.savez(live / "views.npz", **{n: a for n, a in kinds.items() if n.endswith("result")})
    (folder / "pictures.npz").unlink()
    (live / "status.json").write_text(json.dumps({"status": "running", "step": 7, "steps": 90} | status))
    return folder


def test_only_the_token_lets_in(tmp_path):
    asked = Asked(write_run(tmp_path / "run"))
    assert asked.get().status_code == 200
    token = asked.address.token
    wrong = [
        "/",
        f"/{token[:-1]}/",
        f"/{token}x/",
        "/favicon.ico",
        f"/x/{token}/",
        f"//{token[1:]}/",
        "/%00/",
        "/\xff/",
    ]
    for path in [*wrong, "/update", f"/{token.swapcase()}/update"]:
        answer = asked.client.get(path)
        assert answer.status_code == 403, path
        assert token not in answer.text
    assert asked.client.post("/control/0", json={"command": "stop"}).status_code == 403
    assert Address(1).token != Address(1).token
    assert len(token) >= 32


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example:8000", "127.0.0.1:8001", "", "127.0.0.2:8000"]
)
def test_another_host_s_name_is_refused(tmp_path, host):
    """A name of somebody's own that leads to 127.0.0.1 must not read the page."""
    asked = Asked(write_run(tmp_path / "run"))
    assert asked.get(host=host).status_code == 403


def test_another_page_may_not_command(tmp_path):
    asked = Asked(go_on(write_run(tmp_path / "run")))
    for origin in ("https://evil.example", "null", "http://127.0.0.1:9000"):
        assert asked.order("stop", origin=origin).status_code == 403
    assert not (tmp_path / "run" / "control.json").exists()
    assert asked.order("stop", origin="http://127.0.0.1:8000").status_code == 204


def test_every_answer_forbids_what_the_page_does_not_need(tmp_path):
    asked = Asked(write_run(tmp_path / "run"))
    for answer in (asked.get(), asked.get("viewer.js"), asked.get("nothing"), asked.client.get("/")):
        assert answer.headers["content-security-policy"].startswith("default-src 'none'; script-src 'self';")
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cache-control"] == "no-store"
        assert "server" not in answer.headers
    page = asked.get().text
    assert not re.search(r"<script(?! src=\"\w+\.js\"></script>)|\son\w+=|https?:", page)


@pytest.mark.parametrize(
    "path",
    ["../../etc/passwd", "%2e%2e/%2e%2e/etc/passwd", "picture/../../run.json", "picture/..%2frun.json", "run.json", "page.html",
     "picture/x", "control/0", "live/status.json", "base.html"],
)  # fmt: skip
def test_nothing_but_the_page_is_served(tmp_path, path):
    asked = Asked(write_run(tmp_path / "run"))
    assert asked.get(path).status_code in (403, 404, 405)


def test_the_page_shows_a_finished_run(tmp_path):
    run = write_run(tmp_path / "run")
    asked = Asked(run)
    page = asked.get().text
    for part in ("finished", KEY, "unrender run room --method plain", "3.9.1", "Parameter error (RMSE)"):
        assert part in page
    with np.load(run / "pictures.npz") as found:
        reference = found["view0/reference"]
    (address,) = {m[1] for m in re.finditer(r'src="(picture/\w+)"[^>]*alt="View 0: the reference"', page)}
    factor = metrics.exposure(reference)
    for stops in (0, 1.5, -2):
        answer = asked.get(f"{address}?stops={stops}")
        assert answer.headers["content-type"] == "image/png"
        shown = np.asarray(Image.open(io.BytesIO(answer.content)))
        expected = 255 * tone_mapping.srgb(reference * factor * 2.0**stops)
        assert np.abs(shown - expected).max() <= 0.51
    assert [asked.get(f"{address}?stops={bad}").status_code for bad in ("nan", "inf", "99", "x")] == [400] * 4


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"status": "failed", "stopped": "non-finite"}, "failed: gradients were not finite"),
        ({"status": "failed", "stopped": "", "error": "a defect"}, ">failed<"),
        ({"status": "interrupted", "stopped": "terminated"}, "terminated: this is the state at the termination"),
    ],
)
def test_the_page_tells_a_run_that_failed_from_one_that_finished(tmp_path, fields, words):
    run = write_run(tmp_path / "run")
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**record, **fields}))
    page = Asked(run).get().text
    assert words in page
    assert ">finished" not in page


def test_an_update_is_only_what_is_new(tmp_path):
    run = go_on(write_run(tmp_path / "run"))
    asked = Asked(run)
    first = asked.get("update?seen=")
    digest = first.headers["x-digest"]
    assert "running" in first.text
    assert asked.get(f"update?seen={digest}").status_code == 204
    (run / "live" / "status.json").write_text(json.dumps({"status": "paused", "step": 8}))
    second = asked.get(f"update?seen={digest}")
    assert second.status_code == 200
    assert "Resume" in second.text


def test_several_runs_lie_over_one_another(tmp_path):
    runs = [write_run(tmp_path / name, name) for name in ("plain", "rcv")]
    page = Asked(*runs).get().text
    chart = page[page.index("<h3>Loss") :]
    assert [f"</i>{name}</li>" in chart for name in ("plain", "rcv")] == [True, True]
    assert page.count('<tr data-run="') == 2
    same = [write_run(tmp_path / part / "run") for part in ("a", "b")]
    assert str(same[0]) in Asked(*same).get().text


def test_chosen_runs_and_views(tmp_path):
    one = np.full((4, 5, 3), 0.5)
    views = {f"view{i}/{kind}": one * i for i in (0, 2) for kind in ("reference", "result")}
    asked = Asked(write_run(tmp_path / "a"), write_run(tmp_path / "b", views=views, command="the other"))
    page = asked.get("update?run=1&view=2").text
    assert "View 2: the reference" in page
    assert "the other" in page
    assert "View 0: the reference" in asked.get("update?run=1&view=1").text  # there is no such view
    assert "View 0: the reference" in asked.get("update?run=9").text
    assert asked.get("update?run=x").status_code == 400


def test_a_folder_that_holds_nothing_yet_fills_and_vanishes(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    asked = Asked(folder)
    assert "waiting for the run to begin" in asked.get().text
    whole = go_on(write_run(tmp_path / "whole"))
    (folder / "live").mkdir()
    for name in ("status.json", "run.json", "initial.npz", "parameters.npz", "start.npz", "views.npz", "truth.npz"):
        shutil.copy(whole / "live" / name, folder / "live" / name)
        page = asked.get("update").text
        assert '<tr data-run="0"' in page, name
    assert "the reference" in page
    shutil.copy(whole / "live" / "history.jsonl", folder / "live")
    assert "<svg" in asked.get("update").text
    shutil.rmtree(folder)
    page = asked.get("update").text
    assert "the folder is gone" in page
    assert "the reference" in page  # what was last known
    assert asked.order("stop").status_code == 409
    assert not folder.exists()


def test_a_line_that_is_being_written_is_left_for_later(tmp_path):
    run = go_on(write_run(tmp_path / "run"))
    history = run / "live" / "history.jsonl"
    asked = Asked(run)
    with history.open("a") as file:
        file.write('{"seconds": 9.0, "samples": 900, "lo')
        file.flush()
        assert "not JSON" not in asked.get("update").text
        file.write('ss": 0.5}\n')
    page = asked.get("update").text
    assert "not JSON" not in page
    assert ">900</td>" in page


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("status.json", "{"),
        ("status.json", '{"status": 5}'),
        ("status.json", '{"status": "running", "process": -1}'),
        ("status.json", '{"status": "running", "steps": 1e400}'),
        ("run.json", '{"name": 1}'),
        ("views.npz", "PK nothing"),
        ("history.jsonl", '{"seconds": -1, "samples": 0}\n'),
    ],
)
def test_what_cannot_be_read_is_told_and_the_rest_is_shown(tmp_path, name, text):
    run = go_on(write_run(tmp_path / "run"))
    (run / "live" / name).write_text(text)
    answer = Asked(run).get()
    assert answer.status_code == 200
    assert name in re.sub(r"<[^>]+>", "", answer.text)


def test_links_that_lead_out_of_the_folder_are_not_followed(tmp_path):
    secret = write_run(tmp_path / "secret", command="a secret")
    run = write_run(tmp_path / "run")
    (run / "run.json").unlink()
    (run / "run.json").symlink_to(secret / "run.json")
    answer = Asked(run).get()
    assert "a secret" not in answer.text
    assert "leads out of the folder" in answer.text


def test_commands(tmp_path):
    asked = Asked(write_run(tmp_path / "done"), go_on(write_run(tmp_path / "run")))
    path = tmp_path / "run" / "control.json"
    for command in ("pause", "run", "stop"):
        assert asked.order(command, 1).status_code == 204
        assert json.loads(path.read_text()) == {"command": command}
    assert asked.order("stop", 0).status_code == 409
    assert asked.order("stop", 2).status_code == 404
    for bad in ("explode", None, 5, ["stop"], {"command": "stop"}):
        assert asked.order(bad, 1).status_code == 400
    post = asked.client.post
    assert (
        post(f"{asked.root}control/1", content=b"{" * 5000, headers={"content-type": "application/json"}).status_code
        == 413
    )
    assert (
        post(
            f"{asked.root}control/1", content=b'{"command":"stop"}', headers={"content-type": "text/plain"}
        ).status_code
        == 415
    )
    assert (
        post(f"{asked.root}control/1", content=b"\xff", headers={"content-type": "application/json"}).status_code == 400
    )
    assert json.loads(path.read_text()) == {"command": "stop"}


def test_a_command_replaces_a_link_and_does_not_follow_it(tmp_path):
    run = go_on(write_run(tmp_path / "run"))
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (run / "control.json").symlink_to(mine)
    assert Asked(run).order("pause").status_code == 204
    assert mine.read_text() == "mine"
    assert not (run / "control.json").is_symlink()


def hostile_run(path: Path, method: str) -> Path:
    truth = {HOSTILE: np.full((4, 5, 3), 0.25), HOSTILE + "2": np.array([0.1, 0.2, 0.3])}
    fields = dict.fromkeys(("name", "command", "stopped", "variant"), HOSTILE)
    told = {"settings": {HOSTILE: HOSTILE}, "versions": {HOSTILE: HOSTILE}, "warnings": [HOSTILE]}
    return write_run(path, method + HOSTILE, truth=truth, **fields, **told)


@pytest.mark.slow
def test_text_that_wants_to_be_a_script_is_shown_and_does_not_run(tmp_path):
    """In Chromium, in the page as it is loaded and in what it takes over later; a run's name and a parameter's among it."""
    runs = [hostile_run(tmp_path / ("a" + HOSTILE[:8]), "a"), go_on(hostile_run(tmp_path / "b", "b"))]
    with listen(0) as socket, chromium() as page:
        address = Address(socket.getsockname()[1])
        server = uvicorn.Server(
            uvicorn.Config(application(runs, address), log_level="error", lifespan="off", ws="none")
        )
        thread = threading.Thread(target=server.run, kwargs={"sockets": [socket]})
        thread.start()
        try:
            page.goto(address.url)
            page.locator("select[data-pick=run]").select_option("1")
            page.get_by_text("b" + HOSTILE).first.wait_for()
            (runs[1] / "live" / "status.json").write_text(
                json.dumps({"status": "paused", "step": 8, "warnings": [HOSTILE + "later"]})
            )
            page.get_by_text(HOSTILE + "later").wait_for()
            assert "owned" not in page.evaluate("document.title.replace(document.querySelector('h1').textContent, '')")
            assert page.evaluate(
                "[...document.querySelectorAll('script')].every(s => s.getAttribute('src')?.endsWith('.js'))"
            )
            assert page.evaluate(
                "[...document.querySelectorAll('*')].every(e => ![...e.attributes].some(a => a.name.startsWith('on')))"
            )
            assert page.evaluate("document.querySelectorAll('[src=x]').length") == 0
            assert page.get_by_text("5332114").count() == 0
            # Planted: the test would see a script that ran, and the page's policy stops one that was let in.
            page.evaluate("document.querySelector('h1').innerHTML = '<img src=x onerror=\"document.title = 1\">'")
            time.sleep(0.5)
            assert page.title() != "1"
            assert any("Content Security Policy" in line for line in page.complaints)
        finally:
            server.should_exit = True
            thread.join()
