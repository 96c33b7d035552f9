"""`fieldfuse poses`: camera poses alone."""

from __future__ import annotations

from fieldfuse.pipelines.options import Config, Json, OptionalOut, Pairs, PosesFrom, Quiet, Seed, Target, Threads, gather


def poses(
    target: Target,
    out: OptionalOut = None,
    source: PosesFrom = None,
    threads: Threads = None,
    seed: Seed = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Find (or read) the camera poses and write them as transforms.json and COLMAP text."""
    from fieldfuse.pipelines.work import work

    options = gather(None, config, pairs, threads=threads, seed=seed, **{"poses.source": source})
    work(target, out, options, (), quiet=quiet, as_json=json, trusted=("capture", "frames"))
