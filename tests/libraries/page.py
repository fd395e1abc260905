"""docs/other-libraries.md, from the files of this folder and the rows of the last run."""

from __future__ import annotations

import json
import textwrap
from typing import Any

from tests.libraries.library import FOLDER, NAMES, ROOT, Library, load

MATRIX = FOLDER / "matrix.json"
PAGE = ROOT / "docs" / "other-libraries.md"
COLUMNS = ("library", "version", "way", "what was run", "harm", "full braking", "own rollout", "CPU s", "verdict")

HEAD = """\
# Other libraries

How do you train with the library that you know? Each block below is at most ten lines: copy it, and
it trains. What comes out drives in this project's tables and under its shields:
`eb.policy_agent(model)` in Python, `--agents full_brake,my_file.py:make_agent` on the [command
line](cli.md).

Where a library leaves networks or settings to its user, those of the run stand before the block.
The loops that follow in CleanRL and TorchRL, and what turns each model into a policy, stand in its
file. The page is made from `tests/libraries/`, one file per library; a test compares the two.

`make test-libraries` makes an environment for each library below `.venvs/`, runs every block there,
and prints the table below. `ARGS="skrl --write"` runs one of them and writes the page anew.

- *Harm* is first-impact harm, mean of 500 worlds of `paper-random` (seed 7), beside full braking's.
- *Verdict*: a way that learns enough within about a minute has to beat full braking (*beats full
  braking*), the others run two iterations or so (*runs*).
- *Own rollout*: the policy drove 50 worlds in its library's own loop, too; the largest difference
  of any world's harm from ours, m2/s2.
- Seconds are processor time of one thread.
"""


TABLE_HEADS = ("who drives Vehicle 2", "collisions", "first-impact harm", "total harm", "Vehicle 1 shoved")
ONE_TABLE = """\
## Four libraries in one table

Do they learn equally well? These are the policies that the blocks of Stable-Baselines3 (native),
CleanRL, TorchRL and BenchMARL have left, trained for about a minute of processor time. Each is made
by a function of `tests/libraries/one_table.py`, and all drive in one environment on the same 500
worlds:

```sh
ethbrake evaluate --episodes 500 --agents \\
  full_brake,e_v2x_bm,one_table.py:cleanrl,...,ppo@shipped
```
"""


def make_page() -> str:
    """The whole page."""
    matrix = read_matrix()
    rows = [row for name in NAMES for row in matrix.get(name, [])]
    parts = [HEAD, _table(COLUMNS, [cells(row) for row in rows])]
    if "one_table" in matrix:
        parts += [ONE_TABLE, _table(TABLE_HEADS, [table_cells(row) for row in matrix["one_table"]])]
    parts += [_section(load(name)) for name in NAMES]
    return "\n".join(parts)


def cells(row: dict[str, Any]) -> tuple[str, ...]:
    """A row of the matrix as text."""
    numbers = [f"{row[key]:.2f}" if key in row else "" for key in ("harm", "full_braking")]
    numbers.append(f"{row['difference']:.0e}" if "difference" in row else "")
    seconds = f"{row['seconds']:.0f}" if "seconds" in row else ""
    return (row["library"], row["version"], row["way"], row["ran"], *numbers, seconds, row["verdict"])


def table_cells(row: dict[str, Any]) -> tuple[str, ...]:
    """A row of the table of all policies as text."""
    harm = (f"{row[name]:.2f}" for name in ("first_impact_harm", "total_harm"))
    return (
        row["agent"].rpartition(":")[2],
        f"{row['collision_rate']:.1%}",
        *harm,
        f"{row['vehicle_1_shoved_m']:.1f} m",
    )


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, tuple("---" for _ in heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _section(library: Library) -> str:
    about = textwrap.fill(library.about, 100, break_long_words=False, break_on_hyphens=False)
    lines = [f"## {library.title}\n", f"{about}\n", f"`pip install . {library.install}`\n"]
    for way in library.ways:
        lines.append(f"{way.title[0].upper()}{way.title[1:]} ({way.ran}):\n")
        if way.needed:
            lines.append(f"With these networks or settings:\n\n```python\n{way.needed.strip()}\n```\n")
        lines.append(f"```{'sh' if way.command else 'python'}\n{way.code}\n```\n")
    return "\n".join(lines)


def read_matrix() -> dict[str, list[dict[str, Any]]]:
    """The rows of the last run of each library, by name of its file."""
    found: dict[str, list[dict[str, Any]]] = json.loads(MATRIX.read_text("utf-8")) if MATRIX.is_file() else {}
    return found


def write_matrix(rows: dict[str, list[dict[str, Any]]]) -> None:
    """Keep them in the order of the page."""
    kept = {name: rows[name] for name in (*NAMES, "one_table") if name in rows}
    MATRIX.write_text(json.dumps(kept, indent=1) + "\n", "utf-8")
