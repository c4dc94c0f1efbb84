"""Connections to a live page: its owner's, idle ones, and ones that ask without the token again and again.

    python clients.py ADDRESS IDLE BUSY SECONDS [OWNERS]

Idle connections say nothing and come back when they are cut off. Busy ones ask for a page without the token, wait for the answer, and ask
again. The owner, who is there unless OWNERS is 0, asks once a second, on a new connection each time, for the whole page. Prints, as JSON,
the owner's seconds per answer, how many idle and busy ones are connected in the mean, and how often a busy one was answered.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from urllib.parse import urlsplit

counts = {"idle": 0, "busy": 0, "answered": 0}


async def ask(host: str, port: int, path: str) -> tuple[int, float]:
    """The status of the answer, and the seconds until all of it is there."""
    began = time.perf_counter()
    reader, writer = await asyncio.open_connection(host, port)
    try:
        writer.write(f"GET {path} HTTP/1.1\r\nhost: {host}:{port}\r\nconnection: close\r\n\r\n".encode())
        answer = await reader.read(-1)
        return int(answer.split(b" ", 2)[1]), time.perf_counter() - began
    finally:
        writer.close()


async def idle(host: str, port: int) -> None:
    """Be connected, and say nothing."""
    while True:
        try:
            reader, writer = await asyncio.open_connection(host, port)
        except OSError:
            await asyncio.sleep(0.1)
            continue
        counts["idle"] += 1
        try:
            await reader.read(1)
        except OSError:
            pass
        finally:
            counts["idle"] -= 1
            writer.close()


async def busy(host: str, port: int) -> None:
    """Ask without the token, as fast as answers come."""
    while True:
        counts["busy"] += 1
        try:
            await ask(host, port, "/wrong/")
            counts["answered"] += 1
        except (OSError, IndexError, ValueError):
            await asyncio.sleep(0.01)
        finally:
            counts["busy"] -= 1


async def main(address: str, idle_count: int, busy_count: int, seconds: float, owners: int) -> None:
    """All of them at once."""
    where = urlsplit(address)
    host, port = where.hostname or "", where.port or 0
    tasks = [asyncio.create_task(idle(host, port)) for _ in range(idle_count)]
    tasks += [asyncio.create_task(busy(host, port)) for _ in range(busy_count)]
    waits, connected = [], []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        await asyncio.sleep(1.0)
        connected.append((counts["idle"], counts["busy"]))
        if not owners:
            continue
        try:
            status, took = await asyncio.wait_for(ask(host, port, where.path), 30)
        except (OSError, IndexError, ValueError, TimeoutError):
            status, took = 0, 30.0
        waits.append(took if status == 200 else 30.0)
    for task in tasks:
        task.cancel()
    means = {name: sum(of) / len(of) for name, of in zip(("idle", "busy"), zip(*connected, strict=True), strict=True)}
    print(json.dumps({"waits": waits, "answered": counts["answered"] / seconds, **means}))


if __name__ == "__main__":
    owners = int(sys.argv[5]) if len(sys.argv) > 5 else 1
    asyncio.run(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]), owners))
