"""`unrender watch` as a user has it: a run in one process, its page in another, a browser in a third."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import unrender as package
from browser import chromium
from unrender.app.watch import server

PATIENCE = 120.0
SOURCE = Path(package.__file__).parents[1]


@contextmanager
def command(folder: Path, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """`unrender ARGUMENTS` in another process, ended with the block."""
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "unrender.app.cli.main", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(SOURCE)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def until(what: str, true: Callable[[], Any]) -> Any:
    """What `true` returns as soon as that is true."""
    last = time.monotonic() + PATIENCE
    while time.monotonic() < last:
        if found := true():
            return found
        time.sleep(0.1)
    raise AssertionError(f"in {PATIENCE:g} s not: {what}")


def address(watching: subprocess.Popen[str]) -> str:
    assert watching.stdout is not None
    said = []
    for line in watching.stdout:
        said.append(line)
        if line.startswith("watching at "):
            return line.split()[-1]
    raise AssertionError("".join(said))


def status(url: str) -> int:
    try:
        return urllib.request.urlopen(url).status
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.slow
def test_a_browser_sees_a_run_move_pauses_resumes_and_stops_it(problem: Path, mitsuba_variant: str):
    """Also: nothing is loaded from elsewhere, and no script but the page's own runs."""
    folder = problem.parent
    long = ["run", "problem.toml", "--seconds", 600, "--out", "result", "--variant", mitsuba_variant, "--final-spp", 4]
    with chromium() as page, command(folder, *long) as run:
        until("the run begins", (folder / "result" / "live" / "views.npz").exists)
        with command(folder, "watch", "result", "--no-browser") as watching:
            url = address(watching)
            requests: list[str] = []
            page.on("request", lambda request: requests.append(request.url))
            page.on("dialog", lambda dialog: dialog.accept())
            page.goto(url)

            def step() -> int:
                return int(page.locator("td.step").inner_text().split("/")[0] or 0)

            def state() -> str:
                return page.locator("tr[data-run]").get_attribute("data-state")

            assert state() == "running"
            first = step()
            until("the page moves", lambda: step() > first)
            source = page.locator("img.right").get_attribute("src")
            until("the picture changes", lambda: page.locator("img.right").get_attribute("src") != source)
            until(
                "every picture is there", lambda: page.evaluate("[...document.images].every(i => i.naturalWidth > 0)")
            )
            assert page.locator(".charts.seconds svg").count() >= 2

            page.get_by_role("button", name="Pause result").click()
            until("it is paused", lambda: state() == "paused")
            at = step()
            record = (folder / "result" / "live" / "status.json").read_text()
            page.wait_for_timeout(3000)
            assert step() == at
            assert (folder / "result" / "live" / "status.json").read_text() == record
            page.get_by_role("button", name="Resume result").click()
            until("it goes on", lambda: state() == "running" and step() > at)

            # What the reader has chosen and focused outlives the updates.
            page.get_by_label("Picture on the right").first.select_option("Error of the current")
            page.locator(".slider input").first.fill("20")
            page.get_by_role("button", name="Pause result").focus()
            at = step()
            until("it goes on", lambda: step() > at + 1)
            assert page.locator(".slider .tag.r").first.inner_text() == "Error of the current"
            assert page.locator(".slider").first.evaluate("s => s.style.getPropertyValue('--at')") == "20%"
            assert page.evaluate("document.activeElement.dataset.command") == "pause"
            page.keyboard.press("Enter")
            until("it is paused by the keyboard", lambda: state() == "paused")

            page.get_by_role("button", name="Stop result").click()
            assert run.wait(timeout=PATIENCE) == 130
            until("the page says so", lambda: state() == "finished")
            assert "interrupted" in page.locator(".state").inner_text()
            assert not page.get_by_role("button", name="Stop result").is_visible()
            assert page.complaints == []
            assert {request.split("/")[2] for request in requests} == {url.split("/")[2]}

            wrong = url.rstrip("/")[:-1] + ("a" if url.rstrip("/")[-1] != "a" else "b") + "/"
            assert [status(at) for at in (url, wrong, url.rsplit("/", 2)[0] + "/")] == [200, 403, 403]
    assert not (folder / "result" / "live").exists()
    assert not (folder / "result" / "control.json").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["problem.toml"], "problem.toml: a file, expected a run folder"),
        ([".", "../" + "{name}"], "listed twice"),
        ([".", "--port", "70000"], "--port': Input should be less than or equal to 65535"),
        ([".", "--port", "1"], "--port 1: "),
        ([], "Missing argument"),
    ],
)
def test_watch_refuses_in_one_line(unrender, problem: Path, arguments: list[str], message: str):
    if arguments[-1:] == ["1"] and os.geteuid() == 0:
        arguments, message = [".", "--port", "-1"], "greater than or equal to 0"  # root may listen anywhere
    answer = unrender("watch", *(word.format(name=problem.parent.name) for word in arguments))
    assert answer.refuses(message)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, int]]:
    """What a browser was handed: the argument, what the file behind it says, its mode. The server serves nothing, and lets one in."""
    found: list[tuple[str, str, int]] = []

    def browse(argument: str) -> bool:
        path = Path(urllib.request.url2pathname(argument.removeprefix("file://")))
        found.append((argument, path.read_text(), stat.S_IMODE(path.stat().st_mode)))
        return True

    def serve(directories: list[Path], address: Any, on: Any, on_admission: Any = None) -> None:
        served.append((directories, address))
        if on_admission is not None:
            path = Path(urllib.request.url2pathname(found[-1][0].removeprefix("file://")))
            assert path.exists()
            on_admission()
            assert not path.parent.exists()

    served: list[Any] = []
    monkeypatch.setattr(webbrowser, "open", browse)
    monkeypatch.setattr(server, "serve", serve)
    monkeypatch.setattr(os, "nice", lambda by: by)
    return found


def test_the_browser_s_arguments_do_not_hold_the_secret(unrender, problem: Path, opened: list[Any]):
    """Every user of the machine can read them."""
    answer = unrender("watch", ".")
    assert answer.status == 0
    url = next(line.split()[-1] for line in answer.out.splitlines() if line.startswith("watching at "))
    (argument, text, mode), token = opened[0], url.rstrip("/").rpartition("/")[2]
    assert argument.startswith("file:///")
    assert token not in argument
    assert f'content="0; url={url}"' in text
    assert mode == 0o600
    assert unrender("watch", ".", "--no-browser").status == 0
    assert len(opened) == 1


def test_a_run_that_has_not_begun_is_waited_for(unrender, problem: Path, opened: list[Any]):
    """As in `unrender run ... --out out/room & unrender watch out/room`."""
    (problem.parent / "roam").mkdir()
    answer = unrender("watch", "out/room", "room", "--no-browser")
    assert answer.status == 0
    assert answer.out.splitlines()[:2] == [
        "out/room: no such folder yet: waiting for a run to begin there",
        "room: no such folder yet: waiting for a run to begin there; did you mean roam?",
    ]
    assert not (problem.parent / "out").exists()
