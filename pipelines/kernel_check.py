"""Whether the kernels of this machine compute what they should: a ray through even haze, by every engine that runs here."""

from __future__ import annotations

import math

import torch

SIDE = 16  # voxels along the lattice
TOLERANCE = 2e-4  # of opacity and colour: what a kernel that is right may round on any device


def engine_errors() -> dict[str, float]:
    """Render even haze with torch, and with Numba or Triton, whichever runs here.

    Returns:
        The largest error of each engine: of opacity against 1 − exp(−σ·length) (NeRFusion eq. 6) in float64, and of colour against torch's.
    """
    from fieldfuse.backends.dispatch import choose_engine
    from fieldfuse.nerfusion.decoder import make_decoder
    from fieldfuse.render.field import Field, density
    from fieldfuse.render.image import make_renderer
    from fieldfuse.volume.edit import with_corner_blocks
    from fieldfuse.volume.space import Space
    from fieldfuse.volume.topology import BLOCK, Topology

    torch.manual_seed(0)
    line = torch.arange(SIDE // BLOCK)
    topology = Topology(torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3))
    topology, occupied = with_corner_blocks(topology, torch.ones(topology.zero_row, dtype=torch.bool))
    rows = topology.zero_row + 1
    decoder = make_decoder("deferred", 16, 96)  # as settings have it: what is compiled here need not be compiled by the first run
    raw = -math.log(2 * float(density(torch.zeros(1)).double()))  # an optical thickness of 1 through the lattice, whose side is 2
    values = torch.full((rows,), raw), torch.rand(1, 16).repeat(rows, 1)
    field = Field(Space((0.0, 0.0, 0.0), 1.0, 0.0), SIDE, topology, occupied, *values, decoder, torch.zeros(3))
    origins = torch.tensor([[-3.0, 0.1, -0.2], [0.3, 3.0, 0.4]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    exact = -math.expm1(-1.0)
    seen = {"torch": make_renderer(field, "torch")(origins, directions)}
    for device in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        engine = choose_engine("auto", "deferred", torch.device(device))
        seen[f"{engine} ({device})"] = make_renderer(field.to(device))(origins, directions)
    return {
        engine: max(float((ray.opacity.cpu() - exact).abs().max()), float((ray.colour.cpu() - seen["torch"].colour).abs().max()))
        for engine, ray in seen.items()
    }


def report() -> str:
    """The engines with their errors in one line.

    Raises:
        ArithmeticError: an engine is wrong by more than `TOLERANCE`.
    """
    errors = engine_errors()
    line = ", ".join(f"{engine} {error:.0e}" for engine, error in errors.items())
    if not all(error <= TOLERANCE for error in errors.values()):
        raise ArithmeticError(f"an engine renders wrongly: {line}")
    return f"largest errors: {line}"
