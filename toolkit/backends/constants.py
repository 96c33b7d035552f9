"""Numbers that the reference in torch and the kernels share."""

from __future__ import annotations

# Layout of a field: blocks of BLOCK³ voxels.
BLOCK = 8  # voxels a side
VOXELS = BLOCK**3
LOOKUP = (BLOCK + 1) ** 3  # corners of a block's voxels
BRICK = BLOCK // 2  # voxels a side of what a ray skips at once

# Rays and samples.
MAX_STRETCH = 1e4  # a coarse step is never longer than this many times its length at the region of interest
OPAQUE = 128.0  # optical thickness whose transmittance is 0 in float32
UNITS = 32.0  # σ is counted per 1/32 of normalised space, so raw densities mean the same at every resolution
THRESHOLD = 1e-3  # samples of smaller weight have no colour and get no gradient
SOLID = 0.5  # a ray of which less than this is left ends somewhere: its strongest sample is a surface
STOP = 1e-4  # a ray ends where less than this part of the light is left
RAW_MAX = 12.0  # exp(12) is opaque over a thousandth of a voxel; the clamp keeps forward values and gradients finite

# Decoders.
FREQUENCIES = 5  # of the positional encoding of features, in the paper's decoder
DIRECTION = 16  # spherical harmonics of degree 3 and less, which decoders take
# Constants of the real spherical harmonics, orthonormal on the sphere: 1; y, z, x; xy, yz, xz; 3z² - 1; x² - y²; and of degree 3
# y(3x² - y²), x(x² - 3y²); xyz; y(5z² - 1), x(5z² - 1); z(5z² - 3); z(x² - y²)
SH = (
    *(0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396),
    *(0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277),
)

# Training: which pixels a step looks at (`training.pixels`), and the depth term (`training.losses`).
TILE = 8  # pixels a side of what remembers an error
SHARE = 0.8  # S, of the density that goes by errors
MOST = 4.0  # M, most that an error counts, in means
TOP = 1 - SHARE + SHARE * MOST  # of a density
KEEP = 0.75  # of a tile's error stays when a ray comes to it
RENEW = 64  # steps from one look at all errors to the next
REACH = 0.05  # r: share of the distance, beyond the noise, within which a sample counts as near the surface

# Latents of the networks' volumes.
INSIDE = 3  # the latent that starts as how far behind the surface the voxel lies
CHANGE = 0.5  # most that networks may add to the distance behind the surface, before tanh: free space of which the sweep is sure stays so
