"""How many threads numeric libraries use. Nothing here may import them before the count is set."""

from __future__ import annotations

import os
from typing import Any

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
SHORT_SPIN = "1000"  # turns, microseconds


def bound_threads(options: dict[str, Any]) -> None:
    """Give numeric libraries the thread count of the command line, and have all threads allocate from one heap.

    Call it before anything imports NumPy: its BLAS reads the count when it is loaded, and no more.
    """
    # Threads that spin while they wait take the cores from whatever else runs: on a busy machine with two cores a fit made 83 steps
    # in 15 s with spinning threads and 306 with sleeping ones. So they sleep, but not at once (GNU's library counts the turns): to wake
    # one for each of the networks' many short operations would cost a quarter of their time (docs/measured/performance.md).
    if os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE").upper() == "PASSIVE":
        os.environ.setdefault("GOMP_SPINCOUNT", SHORT_SPIN)
    pairs = [pair.removeprefix("threads=") for pair in options.get("pairs") or [] if pair.startswith("threads=")]
    wanted = options.get("flags", {}).get("threads") or next(iter(pairs), None)
    if wanted is not None and str(wanted).isdigit() and int(wanted) > 0:
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(wanted)))
    from fieldfuse import memory

    memory.one_heap()
