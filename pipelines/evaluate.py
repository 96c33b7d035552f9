"""`fieldfuse evaluate`: scores of a run's field and surface on the held-out pictures, and the report."""

from __future__ import annotations

from fieldfuse.pipelines.options import Config, Json, OptionalOut, Pairs, Quiet, Target, Threads, gather


def evaluate(
    target: Target,
    out: OptionalOut = None,
    threads: Threads = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Render the held-out views, score them, and write the report."""
    from fieldfuse.pipelines.reconstruct import BEFORE
    from fieldfuse.pipelines.work import work

    work(target, out, gather(None, config, pairs, threads=threads), ("render",), quiet=quiet, as_json=json, trusted=(*BEFORE, "field"))
