"""Data-parallel training under `torchrun`: every process takes its own samples, gradients are averaged, weights stay equal."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.distributed as dist

from fieldfuse.errors import InputError


@dataclass(frozen=True)
class Crew:
    """The processes of one training run."""

    rank: int = 0
    size: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def leads(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    @property
    def exchange_device(self) -> torch.device:
        """Where numbers lie that the processes exchange: nccl takes those of a device, gloo the processor's."""
        return self.device if dist.get_backend() == "nccl" else torch.device("cpu")

    def average_gradients(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Mean over the processes, as one flat message. A parameter without a gradient counts as zero; all processes must call this."""
        if self.size == 1:
            return
        parameters = [p for p in parameters if p.requires_grad]
        flat = torch.cat([(p.grad if p.grad is not None else torch.zeros_like(p)).reshape(-1).float() for p in parameters])
        shared = flat.to(self.exchange_device)
        dist.all_reduce(shared)
        flat = shared.to(flat.device).div_(self.size)
        for p, part in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
            p.grad = part.view_as(p).to(p.dtype)

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process."""
        if self.size == 1:
            return flag
        value = torch.tensor([float(flag)], device=self.exchange_device)
        dist.all_reduce(value, dist.ReduceOp.MAX)
        return bool(value.item())

    def mean(self, values: dict[str, float]) -> dict[str, float]:
        """Mean of each number over the processes that have it."""
        if self.size == 1:
            return values
        gathered: list[Any] = [None] * self.size
        dist.all_gather_object(gathered, values)
        present = {key: [one[key] for one in gathered if key in one] for key in dict.fromkeys(key for one in gathered for key in one)}
        return {key: sum(found) / len(found) for key, found in present.items()}

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def join_crew(device: str = "auto") -> Iterator[Crew]:
    """The crew that `torchrun` started (by its environment variables), or a crew of one.

    nccl between CUDA devices; gloo between CPUs, and where a machine's processes share its devices, which nccl refuses.

    Raises:
        InputError: a device that is not there, or a device that is not known.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"the device is {device!r}; it must be auto, cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("there is no CUDA device that torch can use; train with device: cpu")
    cuda = torch.cuda.is_available() and device != "cpu"
    size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    place = torch.device("cuda", local % torch.cuda.device_count()) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(place)
    if size == 1:
        yield Crew(0, 1, place)
        return
    shared = int(os.environ.get("LOCAL_WORLD_SIZE", size)) > torch.cuda.device_count()
    dist.init_process_group("nccl" if cuda and not shared else "gloo")
    try:
        yield Crew(rank, size, place)
    finally:
        dist.destroy_process_group()
