"""The digest of the physics changes with what the physics does, and only then."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.motion import digest
from ethbrake_marl.motion.layout import DROVE, FIRST, GAP, IMPACTS, PASSED, PUSHED, SPEED, THROWN, TOTAL

FEW = "from ethbrake_marl.motion import digest; digest.WORLDS = 30; print(digest.physics_digest())"  # without numba


def digest_of(folder: Path, file: str = "", old: str = "", new: str = "") -> str:
    """Digest of few worlds in a copy of the package in ``folder``, with another text in one file of ``motion``."""
    package = Path(digest.__file__).parents[1]
    copy = shutil.copytree(package, folder / package.name, ignore=shutil.ignore_patterns("_*s", "extensions"))
    if file:
        text = (copy / "motion" / file).read_text("utf-8")
        assert old in text
        (copy / "motion" / file).write_text(text.replace(old, new), "utf-8")
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", FEW]
    done = subprocess.run(command, cwd=folder, env=environment, text=True, capture_output=True, check=True)
    return done.stdout


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> str:
    return digest_of(tmp_path_factory.mktemp("unchanged"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "old", "new", "changes"),
    [
        ("impact.py", "PLASTIC_MPS = 0.05", "PLASTIC_MPS = 0.5", True),
        ("impact.py", "bounce * (pooled - line[SPEED, i])", "bounce * (pooled - line[SPEED, i]) * (1.0 + 1e-15)", True),
        ("push.py", "push *= duration", "push *= 2.0 * duration", True),
        ("contact.py", "def contact(", "def contact(", False),
        ("impact.py", "pooled", "together", False),  # another name
    ],
)
def test_digest__is_that_of_outcomes(
    file: str, old: str, new: str, changes: bool, tmp_path: Path, unchanged: str
) -> None:
    assert (digest_of(tmp_path, file, old, new) != unchanged) == changes


def test_worlds_of_the_digest__are_all_kinds() -> None:
    lines = [np.concatenate([line[:, :, :2] for line in digest.play_random_worlds(n)]) for n in range(2, 7)]
    every = np.concatenate(lines)
    assert np.isfinite(every[:, :, 1:]).all()
    for row in (IMPACTS, FIRST, TOTAL, PUSHED, PASSED, DROVE, THROWN):
        assert (every[:, row] != 0.0).any(axis=0).all()
    assert (every[:, SPEED] < 0.0).any() and (every[:, GAP, 1] == 0.0).any() and (every[:, GAP, 0] == 0.0).any()
