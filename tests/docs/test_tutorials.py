"""The notebooks below docs/tutorials/, each from its first cell to its last, in a folder and a process of its own.

`make docs` runs them too, and shows what they print.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.site import DOCS

CELL = re.compile(r"^```\{code-cell\} python\n(?::tags: .*\n)?(.*?)^```$", re.DOTALL | re.MULTILINE)
TRAIN = ("ablation", "cooperative-learner", "read-a-report", "train-and-shield")
NOTEBOOKS = sorted(
    path.stem for path in (DOCS / "tutorials").glob("*.md") if "\nfile_format: mystnb\n" in path.read_text("utf-8")
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in TRAIN else pytest.mark.slow) for name in NOTEBOOKS]
)
def test_notebook__runs_from_its_first_cell_to_its_last(name: str, tmp_path: Path) -> None:
    cells = CELL.findall((DOCS / "tutorials" / f"{name}.md").read_text("utf-8"))
    assert cells
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(cells)],
        env={**os.environ, "PYTHONPATH": str(DOCS.parent), "OMP_NUM_THREADS": "1"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_notebooks__that_train_are_there() -> None:
    assert set(TRAIN) < set(NOTEBOOKS)
    assert len(NOTEBOOKS) == 8
