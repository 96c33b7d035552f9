"""What developers measure with: run from the repository, `python -m benchmarks.NAME …`. Nothing here is installed."""

import re
import sys

from fieldfuse.pipelines.options import bound_threads

ONE_THREAD = ("benchmarks.few_views", "benchmarks.ablations")  # they count the processor time of one thread

# While `python -m` looks for a benchmark, "-m" stands first in argv. NumPy's BLAS reads the number of threads when a benchmark imports it.
if sys.argv[0] == "-m":
    _given = re.search(r"\bthreads[= ](\d+)", " ".join(sys.argv))
    bound_threads({"flags": {"threads": _given[1] if _given else "1" if set(ONE_THREAD) & set(sys.orig_argv) else None}})
