"""The plane sweep on the CPU, compiled: what `plane_sweep.py` and `matching.py` do with whole tensors, pixel by pixel.

In tensors a sweep writes what another view shows of every pixel at every plane, 21 numbers each, and reads it back; here they are compared
where they are looked up. Volumes lie in memory pixel by pixel, planes next to each other, since all that follows goes along planes.
Results equal those of the tensors to rounding (tests compare them), whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from fieldfuse.stereo.cost_volume import DOWN, STRAIGHT, UP, summed_paths
from fieldfuse.threads import share, slices

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"reassoc", "contract", "nsz", "arcp"}}
F = np.float32
COLOURS, PATCH = 3, 18  # of a descriptor
WIDE, WHOLE = 24, 28  # as kept here: patches and zeros up to whole vectors, then colours
FEW = 4096  # below which threads do not pay
PIECES = 8  # a thread


def fits(*values: Tensor) -> bool:
    """Whether the kernels can take these."""
    return all(value.device.type == "cpu" and value.dtype == torch.float32 for value in values)


def array(values: Tensor) -> Any:
    """What a kernel takes; no copy where it lies in memory as it should."""
    return values.detach().contiguous().numpy()


def spread(work: Callable[[slice], Any], count: int) -> None:
    """Do `work` on `count` things, on as many threads as torch has."""
    threads = torch.get_num_threads() if count >= FEW else 1
    share(work, slices(count, PIECES * threads if threads > 1 else 1), threads)


@njit(**OPTIONS)
def _compare(
    own: Any, other: Any, rays: Any, turn: Any, shift: Any, lens: Any, inverses: Any, gain: Any, cost: Any, least: Any, seen: Any
) -> None:
    """Add to `cost`, lower `least` and count in `seen` (P, D) how the other view differs where it sees a pixel at a plane."""
    height, width = other.shape[0], other.shape[1]
    fx, fy, cx, cy, across, down = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    for p in range(len(own)):
        rx, ry, rz = rays[p, 0], rays[p, 1], rays[p, 2]
        ax = rx * turn[0, 0] + ry * turn[1, 0] + rz * turn[2, 0]
        ay = rx * turn[0, 1] + ry * turn[1, 1] + rz * turn[2, 1]
        az = rx * turn[0, 2] + ry * turn[1, 2] + rz * turn[2, 2]
        mine = own[p]
        for d in range(len(inverses)):
            z = az + inverses[d] * shift[2]
            if not z > F(1e-4):
                continue
            u = ((ax + inverses[d] * shift[0]) / z * fx + cx) / across
            v = ((ay + inverses[d] * shift[1]) / z * fy + cy) / down
            if not (u >= F(0) and u <= F(1) and v >= F(0) and v <= F(1)):
                continue
            x = min(max(u * F(width) - F(0.5), F(0)), F(width - 1))
            y = min(max(v * F(height) - F(0.5), F(0)), F(height - 1))
            left, upper = int(x), int(y)
            right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
            sx, sy = x - F(left), y - F(upper)
            w00, w01, w10, w11 = (F(1) - sx) * (F(1) - sy), sx * (F(1) - sy), (F(1) - sx) * sy, sx * sy
            a, b, c, e = other[upper, left], other[upper, right], other[lower, left], other[lower, right]
            patch = F(0)
            for k in range(WIDE):
                apart = w00 * a[k] + w01 * b[k] + w10 * c[k] + w11 * e[k] - mine[k]
                patch += apart * apart
            colour = F(0)
            for k in range(WIDE, WIDE + COLOURS):
                colour += abs(w00 * a[k] + w01 * b[k] + w10 * c[k] + w11 * e[k] - mine[k])
            value = F(0.5) * (min(colour * (gain / F(COLOURS)), F(1)) + min(patch * F(0.5 / PATCH), F(1)))
            cost[p, d] += value
            least[p, d] = min(least[p, d], value)
            seen[p, d] += 1


@njit(**OPTIONS)
def _combine(cost: Any, least: Any, seen: Any, unknown: Any) -> None:
    """`matching.together`, into `cost`."""
    for p in range(len(cost)):
        for d in range(cost.shape[1]):
            cost[p, d] = F(0.5) * (cost[p, d] / F(seen[p, d]) + least[p, d]) if seen[p, d] else unknown


def widened(descriptors: Tensor) -> Tensor:
    """(N, 21) descriptors as they are kept here, (N, 28)."""
    out = descriptors.new_zeros((len(descriptors), WHOLE))
    out[:, :PATCH], out[:, WIDE : WIDE + COLOURS] = descriptors[:, COLOURS:], descriptors[:, :COLOURS]
    return out


class Comparison:
    """Compares the pixels of one view with what other views show at planes.

    Args:
        own: (P, 21) descriptors.
        rays: (P, 3) of unit depth, camera axes.
        inverses: (D,).
        gain: of a mean difference in colour (`matching.COLOUR_GAIN`).
    """

    def __init__(self, own: Tensor, rays: Tensor, inverses: Tensor, gain: float) -> None:
        self.own, self.rays, self.inverses, self.gain = array(widened(own)), array(rays), array(inverses), F(gain)
        shape = (len(own), len(inverses))
        self.cost, self.least, self.seen = np.zeros(shape, np.float32), np.ones(shape, np.float32), np.zeros(shape, np.uint16)

    def add(self, descriptors: Tensor, turn: Tensor, shift: Tensor, lens: Tensor) -> None:
        """One more view.

        Args:
            described: (21, h, w).
            turn, shift: (3, 3), (3,): camera axes → the other's, row vectors, the shift for points at unit depth.
            lens: (6,) fx, fy, cx, cy, width, height of its pictures.
        """
        other = array(widened(descriptors.flatten(1).T).view(*descriptors.shape[1:], WHOLE))
        given = [other, *(array(values) for values in (turn, shift, lens))]

        def part(p: slice) -> None:
            view, *rest = given
            _compare(self.own[p], view, self.rays[p], *rest, self.inverses, self.gain, self.cost[p], self.least[p], self.seen[p])

        spread(part, len(self.own))

    def result(self, unknown: float) -> Tensor:
        """(P, D) costs, `unknown` where no view sees the place."""
        _combine(self.cost, self.least, self.seen, F(unknown))
        return torch.from_numpy(self.cost)


def semi_global(cost: Tensor, small: float, large: float) -> Tensor:
    """`matching.semi_global` of float32 costs (D, h, w) of at least three planes on the CPU, by the kernel of matching; pixel-major."""
    volume = array(cost.permute(1, 2, 0))
    even = np.zeros(volume.shape[:2], np.float32)  # depth may step anywhere
    one, other = share(lambda way: summed_paths(volume, even, small, large, STRAIGHT, (way,)), (DOWN, UP), torch.get_num_threads())
    one += other
    one /= F(4)
    return torch.from_numpy(one).permute(2, 0, 1)


@njit(**OPTIONS)
def _carve(likely: Any, empty: Any, lost: Any, out: Any) -> None:
    """`sweep.carved` of pixels (P, D) into `out`."""
    planes = likely.shape[1]
    for p in range(len(likely)):
        own, left = likely[p], out[p]
        total, places = F(0), 0
        for d in range(planes):
            free = empty[p, d] == 0
            left[d] = own[d] if free else F(0)
            total += left[d]
            places += free
        if places == 0:
            left[0] = F(1)
        elif total > lost:
            for d in range(planes):
                left[d] /= total
        else:
            for d in range(planes):
                left[d] = F(0) if empty[p, d] else F(1) / F(places)


def carved(likely: Tensor, empty: Tensor, lost: float) -> Tensor:
    """`sweep.carved` of float32 likelihoods (D, h, w) on the CPU; `lost` is what is left of a pixel where nothing is known any more."""
    planes, height, width = likely.shape
    given = array(likely.permute(1, 2, 0).reshape(-1, planes)), array(empty.permute(1, 2, 0).reshape(-1, planes).view(torch.uint8))
    out = np.empty((height * width, planes), np.float32)
    spread(lambda p: _carve(given[0][p], given[1][p], F(lost), out[p]), height * width)
    return torch.from_numpy(out).view(height, width, planes).permute(2, 0, 1)


@njit(**OPTIONS)
def _fill(likely: Any, step: Any, width: int, table: Any) -> None:
    """Likelihoods (P, D) → `table` (P, D, 3)."""
    planes = likely.shape[1]
    behind = np.zeros(planes + 1, np.float32)  # likelihood of this plane and all nearer ones
    for p in range(len(likely)):
        own, out = likely[p], table[p]
        for d in range(planes - 1, -1, -1):
            behind[d] = behind[d + 1] + own[d]
        sure = F(0)
        for d in range(planes - width + 1):
            sure = max(sure, behind[d] - behind[d + width])
        after, last = F(0), F(0)
        for d in range(planes):
            nearer = F(0.5) * (behind[d] + behind[d + 1])  # the surface lies anywhere about its plane
            after += F(0.5) * (last + nearer) * step if d > 0 else F(0)
            out[d, 0], out[d, 1], out[d, 2] = nearer, after, sure
            last = nearer


def table(likely: Tensor, step: float, peak: int) -> Tensor:
    """`sweep._table` of float32 likelihoods (D, h, w) on the CPU: (3, D, h, w), in memory (h, w, D, 3)."""
    planes, height, width = likely.shape
    given = array(likely.permute(1, 2, 0).reshape(-1, planes))
    out = np.empty((height * width, planes, 3), np.float32)
    spread(lambda p: _fill(given[p], F(step), min(2 * peak + 1, planes), out[p]), height * width)
    return torch.from_numpy(out).view(height, width, planes, 3).permute(3, 2, 0, 1)


@njit(**OPTIONS)
def between(table: Any, x: Any, y: Any, d: Any, channel: int) -> Any:
    """Trilinear value of (h, w, D, C) at pixels and planes with whole numbers at their centres; beyond the border the border's."""
    height, width, planes = table.shape[0], table.shape[1], table.shape[2]
    x, y, d = min(max(x, F(0)), F(width - 1)), min(max(y, F(0)), F(height - 1)), min(max(d, F(0)), F(planes - 1))
    # Whole numbers are bounded once more: what is no number must not be read at.
    left, upper, first = min(max(int(x), 0), width - 1), min(max(int(y), 0), height - 1), min(max(int(d), 0), planes - 1)
    right, lower, second = min(left + 1, width - 1), min(upper + 1, height - 1), min(first + 1, planes - 1)
    sx, sy, sd = x - F(left), y - F(upper), d - F(first)
    value = F(0)
    for corner in range(4):
        row, column = upper if corner < 2 else lower, left if corner % 2 == 0 else right
        weight = (F(1) - sy if corner < 2 else sy) * (F(1) - sx if corner % 2 == 0 else sx)
        value += weight * ((F(1) - sd) * table[row, column, first, channel] + sd * table[row, column, second, channel])
    return value


@njit(**OPTIONS)
def _look(points: Any, truncation: Any, table: Any, pose: Any, lens: Any, lowest: Any, step: Any, out: Any) -> None:
    """`DepthDistribution.look`: expected SDF, visibility, confidence into `out` (N, 3)."""
    height, width = F(table.shape[0]), F(table.shape[1])
    for n in range(len(points)):
        px, py, pz = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
        depth = max(px * pose[0, 2] + py * pose[1, 2] + pz * pose[2, 2], F(1e-6))
        inverse = F(1) / depth
        x = ((px * pose[0, 0] + py * pose[1, 0] + pz * pose[2, 0]) * inverse * lens[0] + lens[2]) / lens[4] * width - F(0.5)
        y = ((px * pose[0, 1] + py * pose[1, 1] + pz * pose[2, 1]) * inverse * lens[1] + lens[3]) / lens[5] * height - F(0.5)
        half = inverse * min(truncation[n] / depth, F(0.9))
        near, far = (inverse + half - lowest) / step, (inverse - half - lowest) / step
        nearer = between(table, x, y, near, 0)
        first = between(table, x, y, near, 1) - max(-near, F(0)) * step
        last = between(table, x, y, far, 1) - max(-far, F(0)) * step
        out[n, 0] = min(max(F(1) - (first - last) / half, F(-1)), F(1))
        out[n, 1] = min(max(F(1) - nearer, F(0)), F(1))
        out[n, 2] = min(max(between(table, x, y, near, 2), F(0)), F(1))


def look(points: Tensor, truncation: Tensor, table: Tensor, pose: Tensor, lens: Tensor, lowest: float, step: float) -> Tensor:
    """(N, 3) of what voxels read from the table (3, D, h, w) of a sweep.

    Args:
        pose: (4, 4) of the camera.
        lens: (6,) fx, fy, cx, cy, width, height of its pictures.
    """
    given = [array(values) for values in (points, truncation.expand(len(points)), table.permute(2, 3, 1, 0), pose, lens)]
    out = np.empty((len(points), 3), np.float32)
    spread(lambda n: _look(given[0][n], given[1][n], *given[2:], F(lowest), F(step), out[n]), len(points))
    return torch.from_numpy(out)
