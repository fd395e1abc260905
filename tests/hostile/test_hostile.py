"""A sample of the attack, in every run of the suite: a few cases of every kind, in a process of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.hostile.gates import gate_rows, kind_rows

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_hostile_files__a_sample_of_the_attack_breaks_no_rule() -> None:
    command = [sys.executable, "-m", "tests.hostile", "--sample", "5", "--seed", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    told = re.search(r"^(\d+) cases, 0 broke a rule", done.stdout, re.MULTILINE)
    assert told is not None and int(told[1]) == 5 * len(re.findall(r"^\w+ +in all ", done.stdout, re.MULTILINE)) >= 45


@pytest.mark.parametrize("rows", [kind_rows, gate_rows])
def test_page__says_how_much_the_attack_holds(rows: Callable[[], Iterable[str]]) -> None:
    page = (ROOT / "docs" / "security.md").read_text("utf-8")
    assert "\n".join(rows()) + "\n" in page


def test_gates__are_reached() -> None:
    reached = re.findall(r"at least (\d+) \| ([\d,]+) \|", "\n".join(gate_rows()))
    assert [int(least) for least, _ in reached] == [400, 40, 80, 100]
    assert all(int(there.replace(",", "")) >= int(least) for least, there in reached)
