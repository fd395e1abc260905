"""Who trains in a sweep right now, and what its journal says: for tests that kill."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

PROGRAM = [sys.executable, "-c", "from ethbrake_marl.cli.app import main; main()"]


def journal(folder: Path) -> list[dict[str, Any]]:
    """The lines of a sweep's journal that are whole."""
    path = folder / "journal.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}\n")]


def holders(folder: Path) -> dict[int, str]:
    """Processes that train in a run of this folder -> the run."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            targets = [os.readlink(process / "fd" / number) for number in os.listdir(process / "fd")]
        except OSError:  # ended in the meantime
            continue
        runs = [Path(each).parent.name for each in targets if each.startswith(f"{folder}/runs/")]
        found |= {int(process.name): run for run in runs}
    return found


def parent(process: int) -> int:
    """Who began a process; 0 for one that has ended in the meantime."""
    try:
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0
