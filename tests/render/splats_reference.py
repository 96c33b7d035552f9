"""Gaussian splatting as Kerbl et al. (2023) have it, every Gaussian at every pixel, in float64: what the kernels are held against."""

from __future__ import annotations

import torch

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.nerfusion.encoding import spherical_harmonics

Tensor = torch.Tensor


def draw(values: Tensor, intrinsics: Intrinsics, world_from_camera: Array) -> tuple[Tensor, Tensor]:
    """(N, 11 + 3 K) parameters → (H, W, 3) colours on black and (H, W) light left; autograd gives the gradients."""
    mean, scale, rotation, peak, harmonics = values.split([3, 3, 4, 1, values.shape[1] - 11], 1)
    pose = torch.from_numpy(invert(world_from_camera)).to(values)
    x, y, z = (mean @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    w, i, j, k = torch.nn.functional.normalize(rotation, dim=1).unbind(1)
    turn = torch.stack(
        [
            *(1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)),
            *(2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)),
            *(2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)),
        ],
        1,
    ).view(-1, 3, 3)
    own = turn * scale.exp()[:, None]
    covariance = own @ own.transpose(1, 2)
    c = intrinsics
    side_x, side_y = 0.15 * c.width / c.fx, 0.15 * c.height / c.fy
    u = (x / z).clamp(-c.cx / c.fx - side_x, (c.width - c.cx) / c.fx + side_x)
    v = (y / z).clamp(-c.cy / c.fy - side_y, (c.height - c.cy) / c.fy + side_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([c.fx / z, zero, -c.fx * u / z, zero, c.fy / z, -c.fy * v / z], 1).view(-1, 2, 3) @ pose[:3, :3]
    flat = jacobian @ covariance @ jacobian.transpose(1, 2) + 0.3 * torch.eye(2).to(values)
    inverse = torch.linalg.inv(flat)
    directions = torch.nn.functional.normalize(mean.detach() - torch.from_numpy(world_from_camera[:3, 3]).to(values), dim=1)
    count = harmonics.shape[1] // 3
    basis = spherical_harmonics(directions)[:, :count]
    colours = (0.5 + torch.einsum("nk,nkc->nc", basis, harmonics.view(-1, count, 3))).clamp_min(0)
    rows, columns = torch.meshgrid(torch.arange(c.height) + 0.5, torch.arange(c.width) + 0.5, indexing="ij")
    light, image = torch.ones(c.height, c.width).to(values), torch.zeros(c.height, c.width, 3).to(values)
    for n in torch.argsort(z):
        if z[n] <= 0:
            continue
        dx, dy = columns - (c.fx * x[n] / z[n] + c.cx), rows - (c.fy * y[n] / z[n] + c.cy)
        (a, b), (_, d) = inverse[n]
        alpha = (torch.sigmoid(peak[n, 0]) * torch.exp(-0.5 * (a * dx * dx + d * dy * dy) - b * dx * dy)).clamp_max(0.99)
        alpha = torch.where((alpha >= 1 / 255) & (light >= 1e-4), alpha, torch.zeros_like(alpha))
        image = image + (light * alpha)[..., None] * colours[n]
        light = light * (1 - alpha)
    return image, light
