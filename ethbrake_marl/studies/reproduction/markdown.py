"""docs/reproduction.md: the results of a reproduction as Markdown, with its figures and its data beside it."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

from ethbrake_marl.errors import InvalidInput, plain_text
from ethbrake_marl.evaluation.per_world import check_target, write_output
from ethbrake_marl.studies.reproduction.folder import Json, ReproductionFolder, checked_stem, read_figure
from ethbrake_marl.studies.reproduction.page import command_of, few_worlds, lead_of, made_in

FIGURES, PREFIX = "figures", "reproduction-"  # of the figures beside the page
_WIDTH = 99  # characters of a line
_LONG_TABLE = 12  # rows
_PLACES = "--output runs/reproduction --docs docs/reproduction.md"


def check_docs(file: Path) -> None:
    """Raise ``InvalidInput`` for a page whose name does not end in ``.md``, or that cannot be written."""
    if file.suffix != ".md":
        raise InvalidInput(f"{file}: must end in .md")
    check_target(file, force=True)


def write_docs(file: Path, folder: ReproductionFolder, results: Sequence[Json]) -> None:
    """Write the page, the results as ``.json`` beside it, and the figures into ``figures/``; all are replaced.

    Raises as ``check_docs``.
    """
    check_docs(file)
    figures = file.parent / FIGURES
    figures.mkdir(exist_ok=True)
    for result in results:
        for each in result["figures"]:
            data = read_figure(folder, result["name"], each["stem"], ".svg")
            write_output(figures / f"{PREFIX}{each['stem']}.svg", data, force=True)
    content = json.dumps(list(results), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_output(file.with_suffix(".json"), content.encode(), force=True)
    write_output(file, docs_page(results).encode(), force=True)


def docs_page(results: Sequence[Json]) -> str:
    """The page of these results."""
    few = few_worlds(results)
    blocks = [
        "# The paper, made again",
        "What comes out where the paper's experiments are made again, and where it cannot?",
        _wrapped(lead_of(results)),
        _wrapped(f"Made by `{command_of(results)} {_PLACES}` ({_cell(made_in(results))})."),
        _wrapped(
            "The page, its figures and `reproduction.json`, which holds the same as data, are written by that command"
            " and not by hand; `ethbrake reproduce` makes them again without training. [The paper, line by line]"
            "(paper.md) has the account of every equation."
        ),
        *([_wrapped(few)] if few else []),
        "## Overview",
        _table(
            ("Item", "Verdict", "Because"),
            [(f"[{_cell(each['title'])}](#{_cell(each['name'])})", each["verdict"]["outcome"],
              _cell(each["verdict"]["because"])) for each in results],
        ),
        *(block for each in results for block in _item(each)),
    ]  # fmt: skip
    return "\n\n".join(blocks) + "\n"


def _item(result: Json) -> list[str]:
    """The section of one item."""
    labels = ", ".join(_cell(label) for label in result["labels"])
    what = f"**{_cell(result['title'])}**. {_cell(result['what'])}"
    blocks = [f"## {_cell(result['name'])}", _wrapped(f"{what} ({labels})" if labels else what)]
    blocks.append(_wrapped(f"**{_cell(result['verdict']['outcome'])}**: {_cell(result['verdict']['because'])}"))
    blocks += [_wrapped(_cell(note)) for note in result["notes"]]
    for each in result["figures"]:
        file = f"{FIGURES}/{PREFIX}{checked_stem(each['stem'])}.svg"
        blocks.append(f"![{_cell(each['title'])}. {_cell(each['text'])}]({file})")
    for table in result["tables"]:
        blocks += [f"### {_cell(table['title'])}", _texts(table["head"], table["rows"])]
        blocks += [_wrapped(_cell(table["note"]))] if table["note"] else []
    rows = [(each["what"], each["outcome"], each["because"]) for each in result["comparisons"]]
    blocks += ["### Comparisons with the paper", _texts(("What", "Verdict", "Because"), rows)]
    rows = [(each["name"], each["value"], each["origin"]) for each in result["parameters"]]
    return [*blocks, "### Parameters", _texts(("Parameter", "Value", "Origin"), rows)]


def _texts(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts, folded where it is long."""
    table = _table([_cell(cell) for cell in head], [[_cell(cell) for cell in row] for row in rows])
    if len(rows) <= _LONG_TABLE:
        return table
    return f"<details>\n<summary>{len(rows)} rows</summary>\n\n{table}\n\n</details>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose cells are Markdown already."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def _wrapped(text: str) -> str:
    """A paragraph in lines of the pages' width; no line of it begins a list or a heading."""
    lines = textwrap.wrap(text, _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(re.sub(r"^(?=[-+#>] )", r"\\", line) for line in lines)


def _cell(text: str) -> str:
    """Text that is no markup: what would be is escaped."""
    plain = plain_text(text, keep="\u00a0").replace("<", "&lt;")
    return re.sub(r"([\\|*_`])", r"\\\1", plain).replace("](", "]\\(")
