"""The live page among connections that are not its owner's: idle, slow, many, without the token; and how its browser is let in."""

from __future__ import annotations

import http.client
import json
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
import uvicorn
from report_folders import write_run

from browser import chromium
from unrender.app.watch import Address, connections, server
from unrender.app.watch.connections import Redirect
from unrender.app.watch.monitor import RunMonitor

PATIENCE = 20.0


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small ones, so that tests reach them."""
    monkeypatch.setattr(connections.Connection, "seconds_to_ask", 0.6)
    monkeypatch.setattr(connections.Connection, "strangers", 12)


@contextmanager
def served(folder: Path, refusal_seconds: float = 0.0) -> Iterator[Address]:
    """A page, served as `unrender watch` does."""
    with server.listen(0) as opened:
        address = Address(opened.getsockname()[1])
        running = uvicorn.Server(server._config(server.application([folder], address, refusal_seconds)))
        thread = threading.Thread(target=running.run, kwargs={"sockets": [opened]})
        thread.start()
        try:
            yield address
        finally:
            running.should_exit = True
            thread.join()


def connected(address: Address, first: bytes = b"") -> socket.socket:
    found = socket.create_connection((server.HOST, address.port), timeout=PATIENCE)
    found.sendall(first)
    return found


def lasts(connection: socket.socket, said: bytes = b"") -> float:
    """Seconds until the server ends a connection, on which one byte after the other is sent meanwhile."""
    began = time.monotonic()
    connection.settimeout(0.05)
    while time.monotonic() < began + PATIENCE:
        try:
            if said:
                connection.send(said)
            if connection.recv(1 << 16) == b"":
                break
        except TimeoutError:
            continue
        except OSError:
            break
    return time.monotonic() - began


def asking(address: Address) -> closing[http.client.HTTPConnection]:
    return closing(http.client.HTTPConnection(server.HOST, address.port, timeout=PATIENCE))


def status(address: Address, path: str = "", method: str = "GET") -> int:
    """Of the owner's request, on a connection of its own."""
    with asking(address) as connection:
        connection.request(method, f"/{address.token}/{path}")
        with connection.getresponse() as answer:
            answer.read()
            return answer.status


def test_idle_connections_do_not_keep_the_owner_out(tmp_path: Path) -> None:
    """As many as the system lets a test open without asking for more files."""
    with served(write_run(tmp_path / "run")) as address, ExitStack() as stack:
        assert status(address) == 200  # templates are compiled
        for _ in range(200):
            stack.enter_context(connected(address))
        began = time.monotonic()
        assert status(address) == 200
        assert time.monotonic() - began < 1


@pytest.mark.slow
def test_idle_and_busy_strangers_do_not_keep_the_owner_out(tmp_path: Path) -> None:
    """A small form of the benchmark `watch.connections`, by its clients."""
    clients = Path(__file__).parents[1] / "clients.py"
    with served(write_run(tmp_path / "run"), refusal_seconds=0.5) as address:
        assert status(address) == 200
        words = [sys.executable, str(clients), address.url, "300", "30", "5"]
        found = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    assert sorted(found["waits"])[len(found["waits"]) // 2] < 1  # 30 where it was refused
    assert found["idle"] > 290
    assert found["answered"] > 1


@pytest.mark.usefixtures("limits")
def test_who_does_not_ask_or_asks_too_slowly_is_cut_off(tmp_path: Path) -> None:
    """Nothing, half a request, one byte after the other, a body that does not come, another request that does not end."""
    with served(write_run(tmp_path / "run")) as address, ExitStack() as stack:
        page = f"/{address.token}/".encode()
        host = f"host: 127.0.0.1:{address.port}\r\n".encode()
        head = b"GET " + page + b" HTTP/1.1\r\n" + host
        body = b"POST " + page + b"control/0 HTTP/1.1\r\n" + host
        body += b"content-type: application/json\r\ncontent-length: 1000\r\n\r\n{"
        said = ((b"", b""), (b"GET /", b""), (head, b"x"), (body, b" "), (head + b"\r\n" + head, b"x"))
        pool = stack.enter_context(ThreadPoolExecutor(len(said)))
        opened = [stack.enter_context(connected(address, first)) for first, _ in said]
        for took, (first, _) in zip(pool.map(lasts, opened, [more for _, more in said]), said, strict=True):
            assert 0.3 < took < 5, first
        assert status(address) == 200


@pytest.mark.usefixtures("limits")
def test_the_oldest_stranger_makes_room_and_the_owner_stays(tmp_path: Path) -> None:
    with served(write_run(tmp_path / "run")) as address, ExitStack() as stack:
        owner = stack.enter_context(asking(address))
        owner.request("GET", f"/{address.token}/style.css")
        assert owner.getresponse().read()
        sock = owner.sock
        strangers = [stack.enter_context(connected(address)) for _ in range(12 + 5)]
        ended = [lasts(stranger) for stranger in strangers[:5]]
        assert max(ended) < 0.5  # before their time was up
        owner.request("GET", f"/{address.token}/update")
        assert owner.getresponse().status == 200
        assert owner.sock is sock  # on the connection that it had


def test_refusals_wait_and_end_their_connection(tmp_path: Path) -> None:
    with served(write_run(tmp_path / "run"), refusal_seconds=0.5) as address:
        began = time.monotonic()
        with asking(address) as connection:
            connection.request("GET", "/wrong/")
            with connection.getresponse() as answer:
                answer.read()
        assert answer.status == 403
        assert time.monotonic() - began >= 0.5
        assert answer.getheader("connection") == "close"
        began = time.monotonic()
        assert status(address) == 200
        assert time.monotonic() - began < 0.5


@pytest.mark.parametrize("run", ["9" * 5000, "1", "-1", "0x0", "%D9%A3", "1.5", "%20", "00000000000"])
def test_a_run_that_is_not_there_is_not_found(tmp_path: Path, run: str) -> None:
    with served(write_run(tmp_path / "run")) as address:
        assert status(address, f"control/{run}", "POST") == 404


def test_a_folder_that_is_not_made_yet_is_waited_for(tmp_path: Path) -> None:
    monitor = RunMonitor(tmp_path / "later" / "run")
    assert monitor.snapshot().state == "waiting"
    (tmp_path / "later").mkdir()
    assert monitor.snapshot().state == "waiting"
    write_run(tmp_path / "later" / "run")
    found = monitor.snapshot()
    assert found.state == "finished"
    assert found.run is not None
    (tmp_path / "later" / "run").rename(tmp_path / "later" / "gone")
    assert monitor.snapshot().state == "vanished"


def test_the_first_request_with_the_token_is_told_once(tmp_path: Path) -> None:
    told: list[int] = []
    folder = write_run(tmp_path / "run")
    with server.listen(0) as opened:
        address = Address(opened.getsockname()[1])
        page = server.application([folder], address, on_admission=lambda: told.append(1))
        running = uvicorn.Server(server._config(page))
        thread = threading.Thread(target=running.run, kwargs={"sockets": [opened]})
        thread.start()
        try:
            with asking(address) as connection:
                connection.request("GET", "/wrong/")
                with connection.getresponse() as answer:
                    answer.read()
            assert answer.status == 403
            assert told == []
            assert [status(address), status(address, "update")] == [200, 200]
            assert told == [1]
        finally:
            running.should_exit = True
            thread.join()


def test_a_redirect_is_the_owner_s_alone_and_goes_away() -> None:
    url = 'http://127.0.0.1:8000/a"b&c/'
    with Redirect(url) as redirect:
        text = redirect.path.read_text()
        assert "a&quot;b&amp;c" in text
        assert url not in text
        assert stat.S_IMODE(redirect.path.stat().st_mode) == 0o600
        assert stat.S_IMODE(redirect.path.parent.stat().st_mode) == 0o700
        redirect.remove()
        assert not redirect.path.parent.exists()
    with Redirect(url) as redirect:
        pass
    assert not redirect.path.parent.exists()


@pytest.mark.slow
def test_a_browser_follows_the_redirect(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    with served(folder) as address, Redirect(address.url) as redirect, chromium() as page:
        page.goto(redirect.path.as_uri())
        page.wait_for_url(address.url)
        page.get_by_text("finished").first.wait_for()
