"""The machine that numbers were measured on."""

from __future__ import annotations

import os
import platform
import time
from importlib import metadata
from typing import Any

import torch

LIBRARIES = ("numpy", "numba", "torch", "open3d", "open3d-cpu")


def machine(threads: int | None, device: str = "cpu") -> dict[str, Any]:
    """What numbers depend on: kind of machine, versions, threads (None: as many as cores), and how busy it is; a load above the cores
    means that times are upper bounds."""
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "machine": platform.machine(),
        "system": platform.system(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": threads or os.cpu_count(),
        "device": device,
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "versions": versions,
        "measured": time.strftime("%Y-%m-%d %H:%M"),
    }
