"""Compiles what numba caches on disk, before workers start that would each compile the same: `python -m tests.kernels`."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context


def fits() -> None:
    from fieldfuse.config import load_settings
    from fieldfuse.progress import SILENT
    from fieldfuse.training.engine import warm_up

    for decoder in ("deferred", "per_sample"):
        warm_up(load_settings(pairs=["device=cpu", f"field.decoder={decoder}", "field.channels=16", "field.hidden=16"]), SILENT)


def matching() -> None:
    from fieldfuse.stereo import fast_mvs

    fast_mvs.warm_up()


def main() -> None:
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for done in [pool.submit(fits), pool.submit(matching)]:
            done.result()


if __name__ == "__main__":
    main()
