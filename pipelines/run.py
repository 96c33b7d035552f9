"""`fieldfuse run SOURCE --out DIR`: the main job, from a capture to a field, a surface, exports and a report."""

from __future__ import annotations

from fieldfuse.errors import InputError
from fieldfuse.pipelines.options import RUN, Options, Out, Place, Source, takes
from fieldfuse.pipelines.work import work

MOST_SECONDS = 1e7  # a third of a year


@takes(f"{RUN} cells address")
def run(source: Source, out: Out, options: Options) -> None:
    """Turn a capture into a radiance field (and a TSDF surface, if it has depth), exports and a report.

    Run the same command again after an interruption: what is finished is reused.
    """
    check(options)
    work(Place(source, out), options, ("tsdf", "field", "render", "export"), options.settings(), total_budget=options.total_budget)


def check(options: Options) -> None:
    """See that the options go together.

    Raises:
        InputError: some do not.
    """
    total = options.total_budget
    for name in ("preset", "budget", "image_size"):
        if total is not None and getattr(options, name) is not None:
            raise InputError(f"--total-budget chooses what --{name.replace('_', '-')} would set; give one of them")
    if total is not None and not total < MOST_SECONDS:  # not a number neither
        raise InputError(f"--total-budget is {total:g}; it must be a number of seconds, at most 10 million")
