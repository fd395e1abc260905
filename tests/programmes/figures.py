"""Blocks, tables and pictures of the pages that commands make in minutes: make them again and compare.

Blocks must have equal lines, and pictures equal pixels. Each number of a table must be among the numbers that its
commands print, to the decimals shown. tests/docs/printed.py says what `make test` compares, and what nothing compares
because it needs a training, a long search or one machine's speed.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
from PIL import Image

from tests.docs.printed import (
    BLOCKS,
    NIGHTLY,
    PICTURES,
    ROOT,
    TABLES,
    How,
    Shown,
    agrees,
    commands_of,
    how,
    missing_figures,
    pictures,
    printed_blocks,
    results,
    tables_of_figures,
)
from tests.programmes import Cases, Given, Told

PROGRESS = re.compile(r": [\d,]+ of [\d,]+$|^compiling ")


def run(command: str, folder: Path) -> str:
    """Return the output of a command: stderr, then stdout. Raises ``RuntimeError`` if the command fails."""
    words = shlex.split(command)
    words[1:] = [str(ROOT / word) if word.startswith("docs/studies/") else word for word in words[1:]]
    called = [sys.executable, *(["-m", "ethbrake_marl"] if words[0] == "ethbrake" else []), *words[1:]]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    done = subprocess.run(called, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"exit status {done.returncode}: {done.stderr[-300:]}")
    return done.stderr + done.stdout


@cache
def told_by(command: str) -> str:
    """Return the output of a command, cached, because several tables may use it."""
    with tempfile.TemporaryDirectory() as folder:
        return run(command, Path(folder))


def differing_block(block: Shown, place: How, folder: Path) -> list[str]:
    """Return the lines of a block that differ from the page. Progress (``500 of 2,000``) is not compared."""
    found = []
    for command, shown in commands_of(block.text):
        wanted, told = (
            [line for line in lines if not PROGRESS.search(line)]
            for lines in (shown, run(command, folder).splitlines())
        )
        if not agrees(wanted, told):
            found += [f"{command} prints", *(f"    {line}" for line in told if line.rstrip() not in wanted)]
    return found


def differing_picture(picture: Shown, place: How, folder: Path) -> list[str]:
    """Return in words whether a picture has other pixels; empty if not."""
    for command in place.by:
        run(command, folder)
    if picture.begin.endswith(".svg"):
        same = (ROOT / "docs" / "figures" / picture.begin).read_bytes() == (folder / picture.begin).read_bytes()
        return [] if same else ["other bytes"]
    old, new = (
        np.asarray(Image.open(path / picture.begin).convert("RGBA"), int)
        for path in (ROOT / "docs" / "figures", folder)
    )
    if old.shape != new.shape:
        return [f"{new.shape[1]} x {new.shape[0]} pixels, not {old.shape[1]} x {old.shape[0]}"]
    share = float((np.abs(old - new).max(axis=2) > 8).mean())  # fainter differences are the drawing library's
    return [f"{share:.2%} of the pixels"] if share > 1e-4 else []


def nightly() -> Iterator[tuple[str, Shown, How]]:
    """Yield (kind, item, how it is made) for everything that is compared here; items of several pages only once."""
    kinds = (("block", printed_blocks, BLOCKS), ("table", tables_of_figures, TABLES), ("picture", pictures, PICTURES))
    found = [(kind, each, how(table, each.begin)) for kind, shown, table in kinds for each in shown()]
    found += [("table", each, ("", place)) for each, place in results()]
    done = set()
    for kind, each, place in found:
        if place is not None and place[1].where == NIGHTLY and (kind, each.text) not in done:
            done.add((kind, each.text))
            yield kind, each, place[1]


COMPARE: dict[str, Callable[[Shown, How, Path], list[str]]] = {
    "block": differing_block,
    "table": lambda table, place, folder: missing_figures(table.text, "\n".join(map(told_by, place.by))),
    "picture": differing_picture,
}


def compare(kind: str, shown: Shown, place: How) -> Told:
    """Make one item again, and compare it."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = COMPARE[kind](shown, place, Path(folder))
        except RuntimeError as error:
            found = [str(error)]
    return Told(not found, "\n        ".join(f"{each:.200}" for each in found) or "the same")


def cases(given: Given) -> Cases:
    for kind, shown, place in nightly():
        yield f"{shown.page}: {shown.begin:.70}", partial(compare, kind, shown, place)
