"""Tables of initial states as spreadsheets, disks and strangers leave them."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

from ethbrake_marl.scenario import load_scenario
from tests.hostile.case import NASTY, Case, damaged, write
from tests.hostile.yaml_parts import NOT_FINITE, NOT_NUMBERS

HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"
ROW = "7,7,20,18,20"
TABLE = f"{HEADER}\n{ROW}\n{ROW}\n{ROW}\n"


def _with_field(rng: random.Random, text: str, line: int | None = None) -> str:
    """The table with another field in one place."""
    rows = [row.split(",") for row in TABLE.splitlines()]
    at = rng.randrange(1, 4) if line is None else line
    rows[at][rng.randrange(5)] = text
    return "\n".join(",".join(row) for row in rows) + "\n"


Make = Callable[[random.Random], str | bytes]

CERTAIN: dict[str, Make] = {
    "not finite": lambda r: _with_field(r, r.choice(NOT_FINITE)),
    "not a number": lambda r: _with_field(r, r.choice([each for each in NOT_NUMBERS if "," not in each])),
    "out of range": lambda r: _with_field(r, r.choice(("-1", "1e300", "-1e-9", "201", "1e999", "99999999"))),
    "empty field": lambda r: _with_field(r, r.choice(("", " ", '""', "\t", "\xa0"))),
    "nasty field": lambda r: _with_field(r, r.choice(NASTY).replace("\r\n", " ")),
    "formula": lambda r: _with_field(
        r, r.choice(("=1+1", "=cmd|'/c calc'!A1", "@SUM(1)", "+7-", "-7+1", "=HYPERLINK(1)"))
    ),
    "long field": lambda r: _with_field(r, r.choice("9xé") * r.choice((3000, 200_000, 2_000_000)) + "z"),
    "nasty column": lambda r: _with_field(r, r.choice(NASTY).replace("\r\n", " "), line=0),
    "unknown column": lambda r: _with_field(
        r, r.choice(("gap_3_m", "speed_0_mps", "x" * 5000, "GAP_1_M", "gap_1_km", "", "__class__")), line=0
    ),
    "column twice": lambda r: TABLE.replace("gap_2_m", "gap_1_m"),
    "many columns": lambda r: ",".join(["gap_1_m"] * r.choice((20, 5000, 100_000))) + "\n1\n",
    "columns short or over": lambda r: _with_field(r, r.choice(("7,7", "7,7,7,7", "7\n7"))),
    "other separator": lambda r: TABLE.replace(",", r.choice((";", "\t", "|", " ", "\x1f"))),
    "no rows": lambda r: r.choice(
        ("", HEADER, HEADER + "\n", "\n\n\n", "\n" * 100_000, HEADER + "\n\n\n", ",,,,\n", "\ufeff")
    ),
    "quotes": lambda r: _with_field(r, r.choice(('"7', '7"7', '"7"7"', '"' * 999, '"7\n7\n7'))),
    "encoding": lambda r: TABLE.encode(r.choice(("utf-16", "utf-16-le", "utf-32", "utf-16-be"))),
    "not text": lambda r: TABLE.encode() + r.choice((b"\xff\xfe", b"\xc3(", b"\xed\xa0\x80", b"\x80")),
    "NUL": lambda r: _with_field(r, r.choice(("\0", "7\0", "\0\0\0"))),
    "too large": lambda r: b"7" * ((64 << 20) + r.choice((1, 1 << 20))),
    "something else": lambda r: r.choice(
        (b"PK\x03\x04" * 9, b"\x7fELF", b"<html>", b"{}", b"%PDF-1.7", b"SQLite format 3\0", b"\x1f\x8b\x08")
    ),
}


def tables_of_states(rng: random.Random) -> Iterator[Case]:
    """CSV files: 10 of each category, 60 damaged ones."""
    for category, make in CERTAIN.items():
        for _ in range(2 if category == "too large" else 10):
            yield _case(category, rng.random(), make, True)
    for _ in range(60):
        yield _case("damaged", rng.random(), lambda r: damaged(r, TABLE.encode()), False)


def _case(category: str, seed: float, make: Make, certain: bool) -> Case:
    return Case(
        "CSV",
        category,
        ("evaluate", "--agents", "coast", "--initial-states", "worlds.csv"),
        lambda folder: write(folder / "worlds.csv", make(random.Random(seed))),
        certain=certain,
        reader=lambda: load_scenario("paper-random").read_worlds("worlds.csv"),
    )
