"""Compiles what numba caches on disk, before workers start that would each compile the same: `python -m tests.kernels`."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from fieldfuse.stereo import fast_mvs
from fieldfuse.training import numba_warm


def fits() -> None:
    for decoder in ("deferred", "per_sample"):
        numba_warm.run(decoder, 16, 16)


def main() -> None:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for done in [pool.submit(fits), pool.submit(fast_mvs.warm_up)]:
            done.result()


if __name__ == "__main__":
    main()
