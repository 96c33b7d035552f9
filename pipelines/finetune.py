"""`fieldfuse finetune`: fit the field of a run further."""

from __future__ import annotations

from fieldfuse.pipelines.options import Options, Place, takes
from fieldfuse.pipelines.work import work


@takes("budget device threads seed engine decoder config pairs quiet json")
def finetune(place: Place, options: Options) -> None:
    """Fit the field of a run for another --budget seconds, then render, export and score it.

    The folder then holds these settings; the `run` command that made it would fit its own field again.
    With other settings of the field itself (its decoder, say) it is fitted anew on the same pictures and poses; the field of a run with
    --no-finetune is the start of the fit.
    """
    settings = options.settings()
    settings["flags"]["finetune"] = True
    work(place, options, ("field", "render", "export"), settings, go_on=True)
