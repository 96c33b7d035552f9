"""Fieldfuse: NeRFusion-style radiance fields on sparse voxel blocks, with a TSDF baseline beside them."""

__version__ = "0.1.0"
