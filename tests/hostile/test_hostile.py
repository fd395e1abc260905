"""A sample of the attack, in every run of the suite: a few cases of every kind, in a process of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_hostile_files__a_sample_of_the_attack_breaks_no_rule() -> None:
    command = [sys.executable, "-m", "tests.hostile", "--sample", "5", "--seed", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    told = re.search(r"^(\d+) cases, 0 broke a rule", done.stdout, re.MULTILINE)
    assert told is not None and int(told[1]) == 5 * len(re.findall(r"^\w+ +in all ", done.stdout, re.MULTILINE)) >= 45
