"""`fieldfuse finetune`: fit the field of a run again with another budget or other settings of the fit."""

from __future__ import annotations

from pipelines.options import Budget, Config, Decoder, Device, Engine, Json, OptionalOut, Pairs, Quiet, Seed, Target, Threads, gather


def finetune(
    target: Target,
    out: OptionalOut = None,
    budget: Budget = None,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    engine: Engine = None,
    decoder: Decoder = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Fit the field anew on the pictures and poses that a run has made ready, then render, export and score it."""
    from pipelines.work import work

    flags = {"budget": budget, "device": device, "threads": threads, "seed": seed, "engine": engine, "decoder": decoder}
    work(target, out, gather(None, config, pairs, **flags), ("field", "render", "export"), quiet=quiet, as_json=json)
