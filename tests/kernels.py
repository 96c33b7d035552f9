"""Compiles what numba caches on disk, before workers start that would each compile the same: `python -m tests.kernels`."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from fieldfuse.config import load_settings
from fieldfuse.progress import SILENT
from fieldfuse.stereo import fast_mvs
from fieldfuse.training.engine import warm_up


def fits() -> None:
    for decoder in ("deferred", "per_sample"):
        warm_up(load_settings(pairs=["device=cpu", f"field.decoder={decoder}"]), SILENT)


def main() -> None:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for done in [pool.submit(fits), pool.submit(fast_mvs.warm_up)]:
            done.result()


if __name__ == "__main__":
    main()
