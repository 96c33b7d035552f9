"""First hits of rays on a scene's solids, exact: compiled on CPUs, by Triton on CUDA."""

from __future__ import annotations

import torch

from fieldfuse.backends import dispatch
from fieldfuse.backends.numba import cast as compiled
from fieldfuse.simulate.solids import Solids
from fieldfuse.threads import share, slices

Tensor = torch.Tensor

FAR = float(compiled.FAR)
FEW = 4096  # rays below which threads do not pay


def cast(solids: Solids, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """First hits of rays.

    Args:
        origins: (N, 3), or (1, 3) for rays from one place.
        directions: (N, 3) unit vectors.

    Returns:
        distance (N,), `FAR` where nothing is hit, and the number of the solid (N,) int64, −1 where nothing is hit. A solid that
        the ray starts in is not seen (rooms are seen from inside).
    """
    if dispatch.can_use_triton(origins, directions):
        from fieldfuse.backends.triton import cast as cast_gpu

        return cast_gpu.cast(solids, origins, directions, FAR, float(compiled.NEAREST))
    starts, rays = (values.contiguous().cpu().numpy() for values in (origins, directions))
    distance, number = torch.empty(len(rays)), torch.empty(len(rays), dtype=torch.int64)
    shapes = [values.cpu().numpy() for values in (solids.centre, solids.half, solids.rotation, solids.radius, solids.ends)]

    def part(some: slice) -> None:
        own = starts if len(starts) == 1 else starts[some]
        compiled.cast(own, rays[some], *shapes, distance[some].numpy(), number[some].numpy())

    threads = torch.get_num_threads() if len(rays) > FEW else 1
    share(part, slices(len(rays), 4 * threads if threads > 1 else 1), threads)
    return distance.to(directions.device), number.to(directions.device)
