"""`fieldfuse run SOURCE --out DIR`: the main job, from a capture to a field, a surface, exports and a report."""

from __future__ import annotations

from pipelines.options import (
    Budget,
    Config,
    Decoder,
    Device,
    Engine,
    Holdout,
    ImageSize,
    Json,
    Out,
    Pairs,
    PosesFrom,
    Preset,
    Quiet,
    Seed,
    Source,
    Threads,
    gather,
)


def run(
    source: Source,
    out: Out,
    preset: Preset = None,
    budget: Budget = None,
    image_size: ImageSize = None,
    holdout: Holdout = None,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    engine: Engine = None,
    decoder: Decoder = None,
    poses: PosesFrom = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Turn a capture into a radiance field (and a TSDF surface, if it has depth), exports and a report.

    Run the same command again after an interruption: what is finished is reused.
    """
    from pipelines.work import work

    flags = {"budget": budget, "image_size": image_size, "holdout": holdout, "device": device, "threads": threads, "seed": seed}
    flags |= {"engine": engine, "decoder": decoder, "poses.source": poses}
    work(source, out, gather(preset, config, pairs, **flags), ("tsdf", "field", "render", "export"), quiet=quiet, as_json=json)
