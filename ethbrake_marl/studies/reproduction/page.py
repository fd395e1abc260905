"""The page of a reproduction: one HTML file that holds its figures and loads nothing from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined

from ethbrake_marl.errors import plain_text
from ethbrake_marl.studies.reproduction.folder import Json, ReproductionFolder, read_figure
from ethbrake_marl.studies.reproduction.verdicts import TOLERANCE

_TEMPLATE = "page.html.j2"
TITLE = "The paper, made again"
LEAD = (
    "Every figure and table of How to Brake? Ethical Emergency Braking with Deep Reinforcement Learning, with the"
    " paper's numbers and statements. Every verdict is computed: a number agrees where it is within the chance between"
    f" two lists of worlds or {100.0 * TOLERANCE:g} % of what is printed, and cannot agree where a bound that holds for"
    " every strategy excludes it. Statements are those of the paper's text; its figures hold no printed numbers."
)


def render_page(folder: ReproductionFolder, results: Sequence[Json]) -> str:
    """The page as HTML; whatever the results say is shown as text."""
    environment = Environment(
        loader=PackageLoader("ethbrake_marl.studies.reproduction", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_as_text,
    )
    sources = {
        each["stem"]: _source(folder, result["name"], each["stem"]) for result in results for each in result["figures"]
    }
    return environment.get_template(_TEMPLATE).render(title=TITLE, lead=LEAD, results=results, sources=sources)


def _as_text(value: object) -> object:
    """What the template shows: nothing in a text turns the line around or moves a cursor."""
    return plain_text(value, keep="\u00a0") if isinstance(value, str) else value


def _source(folder: ReproductionFolder, name: str, stem: str) -> str:
    """A figure as a data URI: a picture, whose own scripts and links a browser does not follow."""
    encoded = base64.b64encode(read_figure(folder, name, stem, ".svg")).decode("ascii")
    return f"data:image/svg+xml;base64,{encoded}"
