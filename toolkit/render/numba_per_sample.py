"""Pictures of a field with the paper's decoder through compiled kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from fieldfuse.backends.numba import common as K
from fieldfuse.backends.numba.decode_per_sample import Net, make_tape
from fieldfuse.backends.numba.march_per_sample import NEGLIGIBLE
from fieldfuse.backends.numba.matrix import LANES
from fieldfuse.backends.numba.render_per_sample import render_pass
from fieldfuse.nerfusion.decoder import FREQUENCIES, PerSample
from fieldfuse.nerfusion.encoding import DIRECTION
from fieldfuse.render.composite import STOP
from fieldfuse.render.field import Field
from fieldfuse.render.numba_renderer import PIECE, make_space, make_volume
from fieldfuse.threads import share

Tensor = torch.Tensor
Array = np.ndarray[Any, Any]
LAYERS = ("body.0", "body.2", "density", "colour.0", "colour.2")


def _padded(values: Array, rows: int, columns: int) -> Array:
    """`values` (r, c) in the corner of zeros (rows, columns), at the start of a cache line."""
    out = K.aligned((rows, columns), np.float32, zeroed=True)
    out[: values.shape[0], : values.shape[1]] = values
    return out


def whole(width: int) -> int:
    """`width` rounded up to whole LANES."""
    return -(-width // LANES) * LANES


def net_arrays(decoder: PerSample) -> Net:
    """Copies of the weights, padded."""
    state = {name: value.detach().cpu().numpy() for name, value in decoder.state_dict().items()}
    w1, w2, wd, w3, w4 = (state[f"{name}.weight"] for name in LAYERS)
    b1, b2, bd, b3, b4 = (state[f"{name}.bias"][None] for name in LAYERS)
    hidden, inputs = whole(decoder.hidden), whole(decoder.channels * (1 + 2 * FREQUENCIES))
    third = _padded(w3[:, : decoder.hidden].T, hidden + DIRECTION, hidden)
    third[hidden : hidden + DIRECTION, : decoder.hidden] = w3[:, decoder.hidden :].T
    net = Net(
        w1=_padded(w1.T, inputs, hidden),
        w1_back=K.aligned((hidden, inputs), np.float32),
        b1=_padded(b1, 1, hidden)[0],
        w2=_padded(w2.T, hidden, hidden),
        w2_back=K.aligned((hidden, hidden), np.float32),
        b2=_padded(b2, 1, hidden)[0],
        density=_padded(wd, 1, hidden)[0],
        density_bias=_padded(bd, 1, 1)[0],
        w3=third,
        w3_back=K.aligned((hidden, hidden), np.float32),
        b3=_padded(b3, 1, hidden)[0],
        w4=_padded(w4, 3, hidden),
        b4=_padded(b4, 1, 3)[0],
    )
    turn(net)
    return net


def turn(net: Net) -> None:
    """Renew what is kept transposed too."""
    net.w1_back[:], net.w2_back[:], net.w3_back[:] = net.w1.T, net.w2.T, net.w3[: len(net.b3)].T


def write_back(net: Net, decoder: PerSample) -> None:
    """The weights into the decoder."""
    h = decoder.hidden
    third = np.concatenate([net.w3[:h], net.w3[len(net.b3) : len(net.b3) + DIRECTION]])
    values = {
        "body.0.weight": net.w1[: decoder.channels * (1 + 2 * FREQUENCIES), :h].T,
        "body.0.bias": net.b1[:h],
        "body.2.weight": net.w2[:h, :h].T,
        "body.2.bias": net.b2[:h],
        "density.weight": net.density[None, :h],
        "density.bias": net.density_bias,
        "colour.0.weight": third[:, :h].T,
        "colour.0.bias": net.b3[:h],
        "colour.2.weight": net.w4[:, :h],
        "colour.2.bias": net.b4,
    }
    decoder.load_state_dict({name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in values.items()})


class PerSampleRenderer:
    """Renders rays of one field (CPU, the paper's decoder); makes the kernels' arrays once."""

    def __init__(self, field: Field, threads: int | None = None) -> None:
        assert isinstance(field.decoder, PerSample)
        self.space, self.volume, self.net = make_space(field), make_volume(field), net_arrays(field.decoder)
        self.background = field.background.numpy().astype(np.float32)
        self.threads = threads or torch.get_num_threads()

    def render(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(B, 3), (B, 3) → (B, 5): colour, distance, opacity. The same whatever the number of threads."""
        out = np.empty((len(origins), 5), np.float32)
        given = origins.float().contiguous().numpy(), directions.float().contiguous().numpy()

        def part(piece: slice) -> None:
            limits = (np.float32(STOP), np.float32(NEGLIGIBLE))
            arguments = (make_tape(self.net), self.background, given[0][piece], given[1][piece], *limits, out[piece])
            render_pass(self.space, self.volume, self.net, *arguments)

        size = max(min(PIECE, len(out) // self.threads), 1)
        pieces = [slice(start, start + size) for start in range(0, len(out), size)]
        share(part, pieces, self.threads)
        return torch.from_numpy(out)
