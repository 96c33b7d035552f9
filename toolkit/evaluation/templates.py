"""The page templates that lie beside this file, with the filters that show numbers as people read them."""

from __future__ import annotations

from importlib import resources

from jinja2 import Environment, FunctionLoader, StrictUndefined, Template

from fieldfuse.evaluation import words

FILTERS = (words.decimal, words.significant, words.whole, words.size, words.memory, words.duration, words.share, words.held)


def template(name: str) -> Template:
    """A template by file name; all text that it is given is escaped, a name that it is not given is an error."""
    environment = Environment(
        loader=FunctionLoader(_source), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    for show in FILTERS:
        environment.filters[show.__name__] = show
    return environment.get_template(name)


def _source(name: str) -> str:
    return resources.files("fieldfuse.evaluation").joinpath(name).read_text(encoding="utf-8")
