"""Work on CUDA of known shapes, recorded once as a graph of launches and repeated: one launch for the processor instead of hundreds."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from fieldfuse.backends.dispatch import OTHERS_GO_ON

MOST = 4  # recordings that are cached
RECORDED = 2**23  # numbers in images up to which encoding them is recorded on CUDA: recordings hold the memory that they need
Work = Callable[..., tuple[Tensor, ...]]
Recording = tuple[torch.cuda.CUDAGraph, list[Tensor], tuple[Tensor, ...]]  # with where it reads and what it writes


class Recorded:
    """Functions of tensors, called through it: launched as ever the first time for a set of shapes, recorded the second, then repeated.
    What cannot be recorded, for want of memory say, is launched as ever.

    What they read beside their tensors (parameters) must stay where it is; its numbers may change. A copy of it starts without recordings.
    """

    def __init__(self) -> None:
        self._made: dict[Hashable, Recording | None] = {}
        self._refused: set[Hashable] = set()
        self._pool: Any = None

    def __deepcopy__(self, _memo: Any) -> Recorded:
        return Recorded()

    def __reduce__(self) -> tuple[type[Recorded], tuple[()]]:
        return Recorded, ()

    def __call__(self, work: Work, what: Hashable, *given: Tensor) -> tuple[Tensor, ...]:
        """Copies of what `work` gives for the tensors; `what` names the work together with their shapes."""
        key = what, *[(value.shape, value.dtype) for value in given]
        if key in self._refused:
            return work(*given)
        if key not in self._made:  # libraries choose and load what they need before anything is recorded
            while len(self._made) >= MOST:
                self._made.pop(next(iter(self._made)))
            self._made[key] = None
            return work(*given)
        made = self._made[key]
        if made is None:
            try:
                made = self._made[key] = self._record(work, given)
            except RuntimeError:
                self._refused.add(key)
                return work(*given)
        graph, inputs, results = made
        for place, value in zip(inputs, given, strict=True):
            place.copy_(value)
        graph.replay()
        return tuple(result.clone() for result in results)

    def _record(self, work: Work, given: tuple[Tensor, ...]) -> Recording:
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()  # one after the other they can share memory
        inputs = [value.clone() for value in given]
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode=OTHERS_GO_ON):
            results = work(*inputs)
        return graph, inputs, results


def worth_recording(images: Tensor) -> bool:
    """Whether encoding such images is recorded: hundreds of launches, of which the processor makes one that way."""
    free = not torch.is_grad_enabled() and not torch.is_autocast_enabled(images.device.type)
    return free and images.is_cuda and images.numel() <= RECORDED


def addresses(modules: Iterable[nn.Module | None]) -> tuple[int, ...]:
    """Where the modules' parameters lie, which recordings read there; all of a module are moved together."""
    return tuple(next(module.parameters()).data_ptr() for module in modules if module is not None)
