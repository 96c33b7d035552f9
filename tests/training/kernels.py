"""Small guided fits in a process of their own, and the compiled kernels that the warm-up before their clock had missed.

`python -m tests.training.kernels deferred` prints, as JSON, the kernels that were compiled, or loaded from their cache, while a clock ran,
and those that were compiled for several signatures.
"""

from __future__ import annotations

import gc
import json
import sys
from collections import Counter
from dataclasses import replace
from itertools import count

import numpy as np
import torch
from numba.core.dispatcher import Dispatcher

from fieldfuse.capture.types import Views
from fieldfuse.stereo import transients
from fieldfuse.training import depth_start, fit
from fieldfuse.training.fit import Begin
from fieldfuse.training.guided import fit_guided
from fieldfuse.volume.grid import GridHost
from tests.stereo.made import with_passer
from tests.training.test_guided import SCENE, wanted

Kernels = set[tuple[str, str]]


def ready() -> Kernels:
    """Names of the toolkit's kernels, and the signatures that they are ready for."""
    every = (one for one in gc.get_objects() if Dispatcher in type(one).__mro__)  # `isinstance` takes a second for a million of them
    found = [one for one in every if one.py_func.__module__.startswith("fieldfuse.")]
    return {(f"{one.py_func.__module__}.{one.py_func.__name__}", str(signature)) for one in found for signature in one.signatures}


def captures() -> dict[str, Views]:
    """Of what is known of a scene that somebody passes through: nothing, nothing and masks, alpha, depth."""
    made, depths, _ = with_passer()
    made = replace(made, test=np.arange(len(made)) == 3)
    left = [np.arange(image.shape[1]) > 8 + np.zeros(image.shape[:2]) for image in made.images]
    cut_out = replace(made, alpha=[255 * one.astype(np.uint8) for one in left], background=(1.0, 1.0, 1.0))
    return {"pictures": made, "masked": replace(made, valid=left), "alpha": cut_out, "depth": replace(made, depths=list(depths))}


def missed(views: Views, decoder: str, host: GridHost | None) -> Kernels:
    """The kernels that a fit of these views had to make ready after its clock began to run."""
    looks, before = count(), [Kernels()]

    def ticks() -> float:
        look = next(looks)
        if look == 0:
            before[0] = ready()
        return 0.02 * look

    result = fit_guided(views, SCENE, wanted("budget=1", f"field.decoder={decoder}"), begin=Begin(host), ticks=ticks)
    assert result.steps > 20 and result.field.resolution > 16  # it went from one level to the next
    assert views.background is not None or (result.left_out is not None and len(result.left_out.masks) > 0)
    return ready() - before[0]


def main(decoder: str) -> None:
    torch.set_num_threads(1)
    transients.FEWEST = depth_start.FEW_VIEWS = 6  # six pictures are enough here …
    fit.TIMELINE_PIXELS = 256  # … and few pixels
    told = {name: sorted(missed(views, decoder, GridHost() if name == "depth" else None)) for name, views in captures().items()}
    several = [name for name, number in Counter(name for name, _ in ready()).items() if number > 1]
    sys.stdout.write(json.dumps({"missed": told, "several": several}) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
