"""A share of a problem's views on its worker: references, memory of image estimators, and gradients."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from unrender.app.distributed.assignment import total
from unrender.app.distributed.messages import Batch, Call, References, Reply
from unrender.core import arrays, trees
from unrender.core.trees import Tree
from unrender.estimators.sample_groups import TREES, GradientRequest, leave_one_out_groups
from unrender.images.base import PairRequest
from unrender.images.recursive_control_variate import RecursiveControlVariateState
from unrender.pixels.base import MiniBatch
from unrender.pixels.pixel_statistics import PilotRequest
from unrender.runs.folder.state import Packed, pack, unpack
from unrender.scene.batches import Frame, FullView, PixelBatch, PixelSample
from unrender.scene.problem import Problem


class ViewShare:
    """Some views of a problem on a worker, which stores numbered arrays and memories until the driver drops them.

    Equal calls with equal arrays and memories give equal replies, independent of the worker. The views' indices in the full problem
    determine their random numbers.
    """

    def __init__(self, problem: Problem, views: tuple[int, ...]):
        self.problem, self.views = problem, views
        self._arrays: dict[int, Any] = {}
        self._memories: dict[int, tuple[Any, ...]] = {}
        self._snapshot: tuple[int, Any] | None = None

    def run(self, call: Call) -> Reply:
        """Return the gradient of the share's views, and store the memory after it."""
        started = time.perf_counter()
        self._receive(call)
        if call.pilot is not None:
            return Reply({}, {}, {}, {}, 0, {}, {}, time.perf_counter() - started, paths=self._pilot(call))
        request = self._request(call)
        if call.replay:
            self._remember(call, self._replayed(call, request))
            return Reply({}, {}, {}, {}, 0, {}, {}, time.perf_counter() - started)
        frames: list[tuple[int, Frame]] = self._full_views()
        if call.batch is not None:
            sample = self._sample(call.batch)
            frames = [(-1, PixelBatch(self.problem, sample))]
            request = replace(request, batch=MiniBatch(sample, tangents=self._tree(call.tangents)))
        parts = [request.estimate_frame(self.problem, frame, call.key.fold(max(index, 0))) for index, frame in frames]
        states = tuple(part.image_state for part in parts)
        parts_by_name = {name: [getattr(part, name) for part in parts] for name in TREES}
        arrays.evaluate(states, parts_by_name, [part.loss for part in parts])
        if call.batch is None:
            self._remember(call, states)
        sums = {name: total(map(trees.numpy, parts)) for name, parts in parts_by_name.items()}
        shown = [(index, part) for (index, _), part in zip(frames, parts, strict=True) if call.pictures and index >= 0]
        info: dict[str, dict[int, np.ndarray]] = {}
        for index, part in shown:
            for name, value in part.info.items():
                info.setdefault(name, {})[index] = arrays.numpy(value)
        return Reply(
            sums["gradient"],
            sums["previous"],
            sums["fresh"],
            {index: arrays.number(part.loss) for (index, _), part in zip(frames, parts, strict=True)},
            sum(part.samples for part in parts),
            {index: arrays.numpy(part.image) for index, part in shown},
            info,
            time.perf_counter() - started,
            draws=parts[0].draws if call.batch is not None else None,
            paired=sums["paired"],
            noise=sums["noise"],
        )

    def store(self, number: int, packed: Packed) -> None:
        """Store the memory of another worker."""
        self._memories[number] = unpack(packed)

    def fetch(self, number: int) -> Packed:
        """Return a memory, packed for storage elsewhere."""
        return pack(self._memories[number])

    # ------------------------------------------------------------------ parts of a call

    def _receive(self, call: Call) -> None:
        for number, value in call.arrays.items():
            self._arrays[number] = self.problem.renderer.array(value)
        for number in call.drop_arrays:
            self._arrays.pop(number, None)
        for number in call.drop_memories:
            self._memories.pop(number, None)

    def _tree(self, references: References) -> Tree:
        return {key: self._arrays[number] for key, number in references.items()}

    def _request(self, call: Call) -> GradientRequest:
        parameters = self._tree(call.parameters)
        state = call.image.init(self.problem, parameters)
        if call.state is not None and call.state.memory is not None and call.state.parameters is not None:
            views = self._memories[call.state.memory]
            state = RecursiveControlVariateState(self._tree(call.state.parameters), views, None, call.state.step)
            if call.state.snapshot and call.batch is not None:
                if self._snapshot is None or self._snapshot[0] != call.state.memory:
                    self._snapshot = call.state.memory, call.image.prepare(self.problem, state).snapshot
                state = replace(state, snapshot=self._snapshot[1])
        elif call.state is not None:
            state = RecursiveControlVariateState(step=call.state.step)
        pair, of = None, call.pair
        if of is not None:
            pair = PairRequest(self._tree(of.previous), of.space, of.step, difference_spp=of.difference_spp)
        return GradientRequest(
            parameters,
            call.image,
            state,
            call.spp,
            call.key,
            call.adjoint_spp,
            pair,
            tolerance=call.tolerance,
            fresh=call.fresh,
            noise=call.noise,
        )

    def _full_views(self) -> list[tuple[int, Frame]]:
        return [(index, FullView(self.problem, local)) for local, index in enumerate(self.views)]

    def _sample(self, batch: Batch) -> PixelSample:
        like = self.problem.renderer.array(batch.weights[:, None])

        def integers(values: np.ndarray) -> Any:
            return arrays.like_integers(values, like)

        return PixelSample(integers(batch.views), integers(batch.pixels), like, integers(batch.positions))

    def _pilot(self, call: Call) -> tuple[np.ndarray, ...]:
        assert call.batch is not None
        references = tuple(map(self.problem.renderer.array, call.pilot or ()))
        sample, tangents = self._sample(call.batch), self._tree(call.tangents)
        request = PilotRequest(self._tree(call.parameters), sample, call.key, references, tangents)
        return tuple(request.carry_out(self.problem))

    def _replayed(self, call: Call, request: GradientRequest) -> tuple[Any, ...]:
        """Return the memory after a step of full views, without its gradient."""
        groups = leave_one_out_groups(call.spp, call.adjoint_spp)
        memory = tuple(
            call.image.estimate(
                self.problem,
                request.parameters,
                request.state,
                frame,
                call.spp,
                groups,
                call.key.fold(index).fold(0),
                request.pair_request,
            )[1]
            for index, frame in self._full_views()
        )
        arrays.evaluate(memory)
        return memory

    def _remember(self, call: Call, states: tuple[Any, ...]) -> None:
        if call.result is not None:
            self._memories[call.result] = states


class Hosts(Protocol):
    """Processes that hold shares, and can lose them."""

    @property
    def count(self) -> int:
        """The number of shares."""
        ...

    def room(self) -> list[tuple[str, int]]:
        """Return the machine of each share, and its available bytes; 0 for unknown."""
        ...

    def run(self, calls: Mapping[int, Call]) -> dict[int, Reply]:
        """Run the calls of all shares concurrently and return their replies. Replies of shares that were lost meanwhile are missing;
        these shares exist again without memory. Raise `InputError` if they cannot be restored."""
        ...

    def emptied(self) -> set[int]:
        """Return the shares that were lost since the last call of this method, including those that replied before. They have no memory."""
        ...

    def store(self, share: int, number: int, packed: Packed) -> bool:
        """Store a memory on a share, see `ViewShare.store`; return False if the share was lost."""
        ...

    def fetch(self, number: int) -> dict[int, Packed]:
        """Return a memory of all shares, see `ViewShare.fetch`, without lost shares."""
        ...

    def movable(self) -> list[int]:
        """Return the shares that should move to another worker."""
        ...

    def move(self, share: int) -> None:
        """Move a share to another worker, where it has no memory yet."""
        ...
