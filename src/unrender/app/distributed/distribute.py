"""`unrender.app.distribute`: distributes a problem's views to workers."""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace

from unrender.app.distributed.assignment import assign
from unrender.app.distributed.cluster import Workers, connect
from unrender.app.distributed.executor import DistributedExecutor
from unrender.app.distributed.ray_hosts import RayHosts
from unrender.app.distributed.transfer import packed
from unrender.backend.limits import cores
from unrender.backend.variant import check_threads, current, same_colours, unsupported, with_colours_of
from unrender.core.errors import InputError
from unrender.scene.problem import Problem

_log = logging.getLogger("unrender")
_LEAST_STORE = 256 << 20
_GRADIENTS, _DOUBLE, _SLACK = 3, 8, 1.5
"""Maximum number of gradients in a reply, bytes of a number, and ratio of a store's size to its contents."""


@contextlib.contextmanager
def distribute(
    problem: Problem,
    workers: int | str | Workers = "auto",
    variant: str = "auto",
    threads: int | None = None,
    tell: Callable[[str], None] = _log.warning,
    insecure: bool = False,
) -> Iterator[Problem]:
    """Yield the problem with its views distributed to workers. Within the context, `optimize` and `resume` compute its gradients there.

        with unrender.app.distribute(problem, workers=4) as distributed:
            result = unrender.optimize(distributed, "rcv", steps=300)

    Each worker is a Ray process with a GPU or some of the processor's threads. It holds its views: their references, and the memory of
    image estimators. In each step it receives the parameters that changed, and returns gradient and loss, which are summed in a fixed
    order in double precision. Random numbers do not depend on the number of workers. Results therefore equal those of one process up to
    rounding, and to the bit for equal numbers of workers (with one thread each; with more, threads add to a gradient in the order they
    finish). Optimizer, checkpoints and history stay in this process. A run folder can be resumed with any number of workers or none.

    A worker that dies or stops responding loses no step: others take over its views and repeat its steps since its memory was last
    collected, and the run continues to the same result.

    Args:
        problem: problem with at least one view; there is at most one worker per view.
        workers: number of workers; "auto", one for each GPU or core; "HOST:PORT" of a Ray cluster, or "NUMBER@HOST:PORT".
        variant: Mitsuba variant of the workers; "auto" for one with the colours of this process's variant.
        threads: processor threads per worker; None for its share.
        tell: function that receives a line for each lost or lagging worker.
        insecure: whether to join a cluster that other users can enter.

    Raises:
        InputError: Ray is not installed, there is no cluster at the address, or other users can enter it; the problem cannot be sent,
            has too few views, or does not fit a worker's memory; workers are lost repeatedly, or have an unsuitable variant.
    """
    _check_colours(variant)
    parsed = workers if isinstance(workers, Workers) else Workers.parse(str(workers), "workers")
    parsed = replace(parsed, insecure=parsed.insecure or insecure)
    views = len(problem.views)
    if parsed.count is not None and parsed.count > 1 and views == 1:
        raise InputError(
            f"workers: {problem.name} has one view, which cannot be distributed to {parsed.count} workers; use one process"
        )
    if parsed.count is not None and parsed.count > views:
        tell(f"workers: using {views} workers for {views} views instead of {parsed.count}")
        parsed = replace(parsed, count=views)
    with connect(parsed, variant, store_bytes=_store_bytes(problem, parsed), most=views) as cluster:
        if threads is not None and cluster.address is None:
            check_threads(threads)
        resolutions = problem.renderer.resolutions()
        pixels = [math.prod(resolutions[view.sensor]) for view in problem.views]
        shares = assign(pixels, cluster.share.count)
        hosts = RayHosts(cluster, shares, tuple(packed(problem, share, cluster.ray) for share in shares), threads, tell)
        try:
            yield problem.with_parts(executor=DistributedExecutor(problem, shares, hosts, cluster.variant))
        finally:
            hosts.close()


def _check_colours(variant: str) -> None:
    """Raise `InputError` for a variant that is not supported, or whose gradients would be those of other pictures than this process's."""
    if refusal := unsupported(variant):
        raise InputError(f"workers: {refusal}")
    own = current()
    if variant != "auto" and own is not None and not same_colours(variant, own):
        raise InputError(
            f"workers: {variant} renders other colours than {own} of this process; use {with_colours_of(variant, own)}"
        )


def _store_bytes(problem: Problem, workers: Workers) -> int:
    """Return the object store size of a local cluster: room for the replies of all workers, at most half of the free shared memory."""
    numbers = sum(math.prod(shape) for shape in problem.shapes().values())
    count = workers.count or min(len(problem.views), cores())
    try:
        free = shutil.disk_usage("/dev/shm").free // 2
    except OSError:
        return _LEAST_STORE
    return max(_LEAST_STORE, min(int(_SLACK * _GRADIENTS * _DOUBLE * numbers * (count + 1)), free))
