"""`fieldfuse evaluate`: scores of a run's field and surface on the held-out pictures, and the report."""

from __future__ import annotations

from fieldfuse.pipelines.options import Options, Place, takes
from fieldfuse.pipelines.work import work


@takes("threads config pairs quiet json")
def evaluate(place: Place, options: Options) -> None:
    """Render the held-out views, score them, and write the report."""
    work(place, options, ("render",), options.settings())
