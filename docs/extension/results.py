"""What was measured: the tables of docs/results/TOPIC.json, which the site shows on the page of that topic."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

RESULTS = Path(__file__).resolve().parents[1] / "results"
NUMERAL = re.compile(r"[-+−–]?\d[^`]*|–|-|")


class Table(BaseModel):
    """A table as it was printed, and what made it; a date or machine that nobody wrote down is empty."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    id: str = Field(pattern="^[a-z0-9-]+$")  # its anchor; no two tables of the site have the same
    title: str
    columns: list[str]
    rows: list[list[str]]
    commands: list[str]
    machine: str
    date: str = Field(pattern=r"^(\d{4}-\d\d-\d\d)?$")
    compared: Literal["in the suite", "make figures", "a training", "a long search", "a speed"]
    note: str

    @model_validator(mode="after")
    def _is_whole(self) -> Table:
        if wrong := [row for row in self.rows if len(row) != len(self.columns)]:
            raise ValueError(f"{self.id}: {len(wrong[0])} cells of {len(self.columns)}: {wrong[0]}")
        return self

    @property
    def markdown(self) -> str:
        """The table alone; columns of numbers stand to the right."""
        return table_of(self.columns, self.rows)

    @property
    def section(self) -> str:
        """The table below its heading, with what is to be known about it."""
        measured = ", ".join(filter(None, [self.date, self.machine])) or "not written down"
        commands = "\n".join(f"$ {command}" for command in self.commands)
        shown = [f"```console\n{commands}\n```"] if commands else []
        facts = f"Measured: {measured}. Compared: {self.compared}."
        return "\n\n".join([f"({self.id})=\n## {self.title}", self.markdown, self.note, facts, *shown])


def table_of(columns: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown; columns of numbers stand to the right."""
    kinds = ["---:" if all(map(NUMERAL.fullmatch, cells)) else "---" for cells in zip(*rows, strict=True)]
    lines = [[cell.replace("|", r"\|") for cell in line] for line in (columns, kinds, *rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


TABLES = TypeAdapter(list[Table])


def read_tables(topic: str) -> list[Table]:
    """The tables of a topic. Raises ``ValueError`` for any key too few or too many, and for what is no text."""
    return TABLES.validate_json((RESULTS / f"{topic}.json").read_bytes())


def text_of(tables: list[Table]) -> str:
    """The file of these tables, each row on a line of its own."""
    written = []
    for table in tables:
        texts = {key: json.dumps(value, ensure_ascii=False) for key, value in table.model_dump().items()}
        rows = ",\n   ".join(json.dumps(row, ensure_ascii=False) for row in table.rows)
        texts["rows"] = f"[\n   {rows}\n  ]"
        written.append(",\n  ".join(f'"{key}": {text}' for key, text in texts.items()))
    body = "\n },\n {\n  ".join(written)
    return f"[\n {{\n  {body}\n }}\n]\n"


def add_tables(page: str, topic: str) -> str:
    """The page of a topic, and then its tables."""
    return "\n\n".join([page.rstrip(), *(table.section for table in read_tables(topic))]) + "\n"


def add_reproduction(page: str) -> str:
    """The page about the paper's items, and then the verdict on each and all that docs/reproduction.json has of it."""
    parts = [page]
    for item in plain(json.loads((RESULTS.parent / "reproduction.json").read_bytes())):
        verdict = "**{outcome}**: {because}".format(**item["verdict"])
        parts += [f"({item['name']})=\n## {item['title']}", item["what"], verdict, *item["notes"]]
        for drawn in item["figures"]:
            parts.append(f"![{drawn['title']}. {drawn['text']}](../figures/reproduction-{drawn['stem']}.svg)")
        for table in item["tables"]:
            parts += [f"### {table['title']}", table_of(table["head"], table["rows"]), table["note"]]
        for title, key in (("Comparisons with the paper", "comparisons"), ("Parameters", "parameters")):
            parts += [f"### {title}", table_of([*item[key][0]], [[*each.values()] for each in item[key]])]
    return "\n\n".join(parts)


def plain(value: Any) -> Any:
    """What was read from JSON, its texts so that nothing in them is markup."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list):
        return [plain(each) for each in value]
    return re.sub(r"([\\*_`<\[])", r"\\\1", value) if isinstance(value, str) else value
