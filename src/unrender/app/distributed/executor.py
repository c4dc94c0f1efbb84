"""Driver of a distributed problem: converts an estimator's request to calls of the shares, and sums their replies."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unrender.app.distributed import assignment
from unrender.app.distributed.assignment import joined, split, total
from unrender.app.distributed.messages import Call, ImageState, Pair, Reply, payload_bytes
from unrender.app.distributed.share import Hosts
from unrender.app.distributed.worker_state import Memories, Memory, Outbox, Recipe, Sent
from unrender.core import arrays
from unrender.core.errors import InputError
from unrender.core.trees import Tree
from unrender.estimators.meta import MetaEstimator
from unrender.estimators.path import PathGradient
from unrender.estimators.sample_groups import GradientRequest, GradientSample
from unrender.images.base import Plain
from unrender.images.denoising import Denoised
from unrender.images.recursive_control_variate import RecursiveControlVariate, RecursiveControlVariateState
from unrender.pixels.adaptive_counts import AdaptiveCounts
from unrender.pixels.pixel_statistics import PilotRequest
from unrender.pixels.uniform import All
from unrender.runs.folder.state import pack, unpack
from unrender.scene.problem import Problem

_MOST_LOSSES = 5  # maximum number of times that shares may be lost in one step
_PICTURES_EVERY = 25  # interval in steps of images for display


@dataclass
class Traffic:
    """Traffic between driver and workers in the last step.

    Attributes:
        sent, received: bytes of arrays, of all shares together.
        seconds: from the first call to the last reply, of a gradient and of a pilot before it.
        busy: computation time of the slowest share in seconds.
        lost: number of shares lost so far.
        repeated: number of steps repeated for lost shares so far.
    """

    sent: int = 0
    received: int = 0
    seconds: float = 0.0
    busy: float = 0.0
    lost: int = 0
    repeated: int = 0


class DistributedExecutor:
    """An `Executor` whose worker processes hold shares of the views; it sums their gradients in the order of the shares."""

    def __init__(self, problem: Problem, shares: tuple[tuple[int, ...], ...], hosts: Hosts, variant: str = ""):
        self.variant = variant
        self._problem, self._shares, self._hosts = problem, shares, hosts
        self._outbox, self._memories = Outbox(), Memories()
        self._arrays: list[set[int]] = [set() for _ in shares]
        self._present: list[set[int]] = [set() for _ in shares]
        self._recent: list[set[int]] = [set() for _ in shares]
        self._calls = 0
        self._in_step = False
        self._collection = 0
        self.traffic = Traffic()

    # ------------------------------------------------------------------ Executor

    def check(self, estimator: Any) -> None:
        name = type(estimator).__name__
        if not isinstance(estimator, (PathGradient, MetaEstimator)):
            raise InputError(
                f"{name} renders all views of a problem itself, so they cannot be distributed to workers; "
                "methods plain, rcv, meta, coupled, adaptive and most choices of auto can"
            )
        if getattr(estimator, "differential_bsdf", False):
            raise InputError(f"{name}: differential_bsdf is not supported by workers; leave it out")
        if getattr(estimator, "emitters", "scene") == "adaptive":
            raise InputError(f'{name}: emitters="adaptive" is not supported by workers; leave emitters="scene"')
        if isinstance(estimator.pixels, AdaptiveCounts):
            raise InputError(
                f"{name}: pixels=AdaptiveCounts(...) is not supported by workers; use unrender.pixels.All()"
            )
        image = estimator.image.inner if isinstance(estimator.image, Denoised) else estimator.image
        if not isinstance(image, (Plain, RecursiveControlVariate)):
            raise InputError(
                f"{name}: the memory of {type(image).__name__} cannot be distributed to workers; use another image estimator"
            )
        if isinstance(estimator, MetaEstimator) and not (isinstance(estimator.pixels, All) or isinstance(image, Plain)):
            raise InputError(
                f"{name}: a control variate of images and mini-batches of pixels at once cannot be distributed to workers; leave out one"
            )
        for key in (key for key, unknown in self._problem.unknowns.items() if unknown.remeshing is not None):
            raise InputError(f"{key}: remeshing is not supported in distributed runs; leave it out")
        assignment.check(self._problem, self._shares, self._hosts.room(), not isinstance(image, Plain))

    def estimate_gradient(self, problem: Problem, request: GradientRequest) -> GradientSample:
        del problem  # each share has its own
        self._reset_traffic()
        memory = self._memory(request.state)
        sample = None if request.batch is None else request.batch.sample
        call, sent = self._call(request, memory)
        updated: Any = (None,) * len(self._problem.views)
        if sample is None and isinstance(request.state, RecursiveControlVariateState):
            updated, call = self._memories.after(memory, call, sent)
        parts = [None] * len(self._shares) if sample is None else split(self._problem, sample, self._shares)
        calls = {index: replace(call, batch=part) for index, part in enumerate(parts) if sample is None or part}
        if isinstance(updated, Memory) and updated.recipe.call is not None:
            updated.recipe.call = replace(call, replay=True, pictures=False)
        replies = self._replies(calls, sent, memory)
        self._in_step = False
        if isinstance(updated, Memory) and updated.recipe.is_long(self._collection):
            self._collect(updated.recipe)
        gathered = self._sample(request, [replies[index] for index in sorted(replies)], updated)
        draws_of_parts = [(part, replies[index].draws) for index, part in enumerate(parts) if part is not None]
        return replace(gathered, draws=joined([(part, draws) for part, draws in draws_of_parts if draws is not None]))

    def trace_pilot(self, problem: Problem, request: PilotRequest) -> list[np.ndarray]:
        self._reset_traffic()
        known, tangents = self._outbox.numbered(request.parameters), self._outbox.once(request.tangents)
        sent = {one.number: one for tree in (known, tangents) for one in tree.values()}
        references = [arrays.numpy(reference) for reference in request.references]
        numbers = self._outbox.values(tangents)
        call = Call(self._outbox.values(known), Plain(), None, 1, request.key, tangents=numbers)
        parts = split(self._problem, request.sample, self._shares)
        used = {share: part.positions[part.weights > 0] for share, part in enumerate(parts) if part is not None}
        calls = {
            share: replace(call, batch=part, pilot=tuple(own[part.positions] for own in references))
            for share, part in enumerate(parts)
            if part is not None
        }
        replies = self._replies(calls, sent, None)
        paths = [np.empty((sum(map(len, used.values())), *x.shape[1:]), x.dtype) for x in replies[min(replies)].paths]
        for share, positions in used.items():
            for path, part in zip(paths, replies[share].paths, strict=True):
                path[positions] = part[: len(positions)]
        return paths

    def _reset_traffic(self) -> None:
        if not self._in_step:
            self.traffic = Traffic(lost=self.traffic.lost, repeated=self.traffic.repeated)
        self._in_step = True

    def prepare_images(self, problem: Problem, image: Any, state: Any) -> Any:
        if isinstance(state, RecursiveControlVariateState) and isinstance(state.views, Memory):
            return replace(state, snapshot=state.views)
        return state

    def collect(self, state: Any) -> Any:
        if isinstance(state, RecursiveControlVariateState) and isinstance(state.views, Memory):
            collected: Any = replace(state, views=self._views(state.views.recipe), snapshot=None)
            # The snapshot is that of all views.
            return collected if state.snapshot is None else RecursiveControlVariate().prepare(self._problem, collected)
        if dataclasses.is_dataclass(state) and not isinstance(state, type):
            parts = {each.name: getattr(state, each.name) for each in dataclasses.fields(state) if each.init}
            collected = {name: self.collect(part) for name, part in parts.items()}
            changed = {name: part for name, part in collected.items() if part is not parts[name]}
            return replace(state, **changed) if changed else state
        if isinstance(state, (tuple, list)) and type(state) in (tuple, list):
            collected = [self.collect(part) for part in state]
            same = all(a is b for a, b in zip(collected, state, strict=True))
            return state if same else type(state)(collected)
        return state

    # ------------------------------------------------------------------ requests to calls

    def _memory(self, state: Any) -> Memory | None:
        """Return the workers' memory of a state; transfer it to them if they do not have it."""
        if not isinstance(state, RecursiveControlVariateState) or not state.views:
            return None
        if isinstance(state.views, Memory):
            return state.views
        views = state.of_views()
        packed = (pack(tuple(views[view] for view in share)) for share in self._shares)
        return self._memories.stored(tuple(packed))

    def _call(self, request: GradientRequest, memory: Memory | None) -> tuple[Call, dict[int, Sent]]:
        """Return the call that all shares have in common, and its arrays."""
        sent: dict[int, Sent] = {}

        def named(values: Mapping[str, Sent]) -> dict[str, int]:
            sent.update({one.number: one for one in values.values()})
            return self._outbox.values(values)

        def numbered(tree: Tree) -> dict[str, int]:
            return named(self._outbox.numbered(tree))

        pair, state = request.pair_request, None
        if isinstance(request.state, RecursiveControlVariateState):
            past = request.state.parameters
            known = None if past is None else numbered(past)
            number = None if memory is None else memory.number
            state = ImageState(known, number, request.state.snapshot is not None, request.state.step)
        numbered_pair = (
            None if pair is None else Pair(numbered(pair.previous), pair.space, pair.step, pair.difference_spp)
        )
        self._calls += 1
        call = Call(
            numbered(request.parameters),
            request.image,
            state,
            request.spp,
            request.key,
            request.adjoint_spp,
            numbered_pair,
            tangents=named(self._outbox.once(request.tangents)),
            tolerance=request.tolerance,
            fresh=request.fresh,
            noise=request.noise,
            pictures=self._calls % _PICTURES_EVERY == 1,
        )
        return call, sent

    def _addressed(self, share: int, call: Call, sent: Mapping[int, Sent]) -> Call:
        """Return the call with the arrays that a share lacks, and with the numbers that it may drop."""
        present = self._arrays[share]
        missing = {number: one.value for number, one in sorted(sent.items()) if number not in present}
        old = present - set(sent) - self._recent[share]
        gone = {number for number in self._present[share] if not self._memories.is_alive(number)}
        if call.state is not None:
            gone.discard(-1 if call.state.memory is None else call.state.memory)
        self._arrays[share] = (present | set(missing)) - old
        self._recent[share] = set(sent)
        self._present[share] -= gone
        if call.result is not None:
            self._present[share].add(call.result)
        return replace(call, arrays=missing, drop_arrays=tuple(sorted(old)), drop_memories=tuple(sorted(gone)))

    # ------------------------------------------------------------------ calls and lost shares

    def _replies(self, calls: Mapping[int, Call], sent: Mapping[int, Sent], memory: Memory | None) -> dict[int, Reply]:
        """Return all replies. The memory of a lost share is restored by repeating its steps, and the share is called again."""
        received: dict[int, Reply] = {}
        started, busy = time.perf_counter(), 0.0
        for share in self._hosts.movable():
            if memory is not None:
                self._collect(memory.recipe)
            self._hosts.move(share)
            self._forget({share} | self._hosts.emptied())
        for _ in range(_MOST_LOSSES):
            open_ = {share: call for share, call in calls.items() if share not in received}
            ready = list(open_) if memory is None else self._ensured(open_, memory.recipe)
            addressed = {share: self._addressed(share, open_[share], sent) for share in ready}
            self.traffic.sent += sum(payload_bytes(call) for call in addressed.values())
            replies = self._hosts.run(addressed)
            self.traffic.received += sum(payload_bytes(reply) for reply in replies.values())
            busy = max([busy, *(reply.seconds for reply in replies.values())])
            received |= replies
            lost = (set(open_) - set(replies)) | self._hosts.emptied()
            self._forget(lost)
            self.traffic.lost += len(lost)
            if len(received) == len(calls):
                self.traffic.busy += busy
                self.traffic.seconds += time.perf_counter() - started
                return received
        views = ", ".join(str(view) for share in sorted(set(calls) - set(received)) for view in self._shares[share])
        raise InputError(f"workers: those of views {views} were lost {_MOST_LOSSES} times in one step")

    def _forget(self, shares: Iterable[int]) -> None:
        for share in shares:
            for present in (self._arrays, self._present, self._recent):
                present[share] = set()

    def _ensured(self, shares: Iterable[int], recipe: Recipe) -> list[int]:
        """Return those shares that have the memory of a recipe, restored if necessary, without shares that were lost meanwhile."""
        made = [share for share in shares if self._ensure(share, recipe)]
        return [share for share in made if recipe.number in self._present[share]]

    def _ensure(self, share: int, recipe: Recipe) -> bool:
        """Restore the memory of a recipe on a share; return False if the share was lost meanwhile."""
        if recipe.number in self._present[share]:
            return True
        chain = recipe.chain()
        first = next((n for n in reversed(range(len(chain))) if chain[n].number in self._present[share]), -1)
        for one in chain[first + 1 :]:
            if one.stored is not None:
                done = self._hosts.store(share, one.number, one.stored[share])
                self._present[share].add(one.number)
            else:
                call = one.call
                assert call is not None
                done = bool(self._hosts.run({share: self._addressed(share, call, one.sent)}))
                self.traffic.repeated += 1
            self._forget(self._hosts.emptied() | (set() if done else {share}))
            if one.number not in self._present[share]:
                return False
        return True

    # ------------------------------------------------------------------ collection of memories

    def _collect(self, recipe: Recipe) -> None:
        if recipe.stored is not None:
            return
        packed_parts: dict[int, Any] = {}
        shares = range(len(self._shares))
        for _ in range(_MOST_LOSSES):
            if len(self._ensured(shares, recipe)) == len(shares):
                fetched = self._hosts.fetch(recipe.number)
                self._forget(self._hosts.emptied() | (set(shares) - set(fetched)))
                packed_parts |= fetched
            if len(packed_parts) == len(shares):
                recipe.store(tuple(packed_parts[share] for share in shares))
                self._collection = sum(payload_bytes(packed.tensors) for packed in packed_parts.values())
                return
        raise InputError(f"workers: some were lost {_MOST_LOSSES} times while their memory was collected")

    def _views(self, recipe: Recipe) -> tuple[Any, ...]:
        self._collect(recipe)
        assert recipe.stored is not None
        by_view: dict[int, Any] = {}
        for share, packed in zip(self._shares, recipe.stored, strict=True):
            by_view |= zip(share, unpack(packed), strict=True)
        return tuple(by_view[view] for view in sorted(by_view))

    # ------------------------------------------------------------------ replies to a sum

    def _sample(self, request: GradientRequest, replies: Sequence[Reply], updated: Any) -> GradientSample:
        def summed(of: Callable[[Reply], Mapping[str, np.ndarray]]) -> Tree:
            return {key: self._problem.renderer.array(x) for key, x in total(map(of, replies)).items()}

        losses = sorted((view, reply.losses[view]) for reply in replies for view in reply.losses)
        batch = request.batch
        info: dict[str, dict[int, Any]] = {}
        if batch is not None and batch.probability:
            info["pixel_probability"] = batch.probability
        images: dict[int, Any] = {}
        for reply in replies:
            images |= reply.images
            for name, maps in reply.info.items():
                info.setdefault(name, {}).update(maps)
        state = request.state
        if batch is None or batch.sample is None:
            state = request.image.advance(request.parameters, request.state, updated)
        return GradientSample(
            gradient=summed(lambda reply: reply.gradient),
            paired=summed(lambda reply: reply.paired),
            previous=summed(lambda reply: reply.previous),
            fresh=summed(lambda reply: reply.fresh),
            noise=summed(lambda reply: reply.noise),
            losses=[loss for _, loss in losses],
            images=images,
            samples=(batch.samples if batch else 0) + sum(reply.samples for reply in replies),
            info=info,
            image=state,
        )
