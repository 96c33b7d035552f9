"""`fieldfuse poses`: camera poses alone."""

from __future__ import annotations

from fieldfuse.pipelines.options import Options, Place, takes
from fieldfuse.pipelines.work import work


@takes("poses depth_scale scale marker threads seed config pairs quiet json")
def poses(place: Place, options: Options) -> None:
    """Find (or read) the camera poses and write them as transforms.json and COLMAP text."""
    work(place, options, (), options.settings())
