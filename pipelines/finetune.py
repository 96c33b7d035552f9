"""`fieldfuse finetune`: fit the field of a run further."""

from __future__ import annotations

from fieldfuse.pipelines.options import (
    Budget,
    Config,
    Decoder,
    Device,
    Engine,
    Json,
    OptionalOut,
    Pairs,
    Quiet,
    Seed,
    Target,
    Threads,
    gather,
)


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
    """Fit the field of a run for another --budget seconds, then render, export and score it.

    The folder then holds these settings; the `run` command that made it would fit its own field again.
    With other settings of the field itself (its decoder, say) it is fitted anew on the same pictures and poses; the field of a run with
    --no-finetune is the start of the fit.
    """
    from fieldfuse.pipelines.work import work

    flags = {"budget": budget, "device": device, "threads": threads, "seed": seed, "engine": engine, "decoder": decoder, "finetune": True}
    work(target, out, gather(None, config, pairs, **flags), ("field", "render", "export"), quiet=quiet, as_json=json, go_on=True)
