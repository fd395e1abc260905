"""docs/other-libraries.md, from the files of this folder and the rows of the last run."""

from __future__ import annotations

import json
from typing import Any

from tests.libraries.library import FOLDER, NAMES, ROOT, Library, load

MATRIX = FOLDER / "matrix.json"
PAGE = ROOT / "docs" / "other-libraries.md"
COLUMNS = ("library", "version", "way", "what was run", "harm", "full braking", "CPU s", "verdict")

HEAD = """\
# Other libraries

Each block below is what a user of that library writes, and nothing is left out but imports of the library's own that an
example of its documentation has anyway. Copy it, and it trains. The page is made from `tests/libraries/`, one file per library, by
`python -m tests.libraries --write`; a test compares the two. Whatever comes out drives in this project's tables:
`eb.policy_agent(model)`, or `ethbrake evaluate --agents full_brake,my_file.py:make_agent` ([agents](extending.md)).

`make test-libraries` makes an environment for each library in `.venvs/`, runs every block there, and prints this table. *Harm* is
first-impact harm of 500 worlds of `paper-random` (seed 7), beside full braking's. Where a way has time to learn within about a
minute it must beat full braking (*beats full braking*); the others run two iterations or so (*runs*).
"""


def make_page() -> str:
    """The whole page."""
    matrix = read_matrix()
    rows = [row for name in NAMES for row in matrix.get(name, [])]
    parts = [HEAD, _table([cells(row) for row in rows])]
    parts += [_section(load(name)) for name in NAMES]
    return "\n".join(parts)


def cells(row: dict[str, Any]) -> tuple[str, ...]:
    """A row of the matrix as text."""
    numbers = [f"{row[key]:.2f}" if key in row else "" for key in ("harm", "full_braking")]
    seconds = f"{row['seconds']:.0f}" if "seconds" in row else ""
    return (row["library"], row["version"], row["way"], row["ran"], *numbers, seconds, row["verdict"])


def _table(rows: list[tuple[str, ...]]) -> str:
    lines = [COLUMNS, tuple("---" for _ in COLUMNS), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _section(library: Library) -> str:
    lines = [f"## {library.title}\n", f"{library.about}\n", f"`pip install ethbrake-marl {library.install}`\n"]
    for way in library.ways:
        lines.append(f"{way.title[0].upper()}{way.title[1:]} ({way.ran}):\n")
        lines.append(f"```{'sh' if way.command else 'python'}\n{way.code}\n```\n")
    return "\n".join(lines)


def read_matrix() -> dict[str, list[dict[str, Any]]]:
    """The rows of the last run of each library, by name of its file."""
    found: dict[str, list[dict[str, Any]]] = json.loads(MATRIX.read_text("utf-8")) if MATRIX.is_file() else {}
    return found


def write_matrix(rows: dict[str, list[dict[str, Any]]]) -> None:
    """Keep them in the order of the page."""
    kept = {name: rows[name] for name in NAMES if name in rows}
    MATRIX.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")
