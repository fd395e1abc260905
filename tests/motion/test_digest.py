"""The digest of the physics changes with its code, and not with its words."""

import shutil
from pathlib import Path

import pytest

from ethbrake_marl.motion import digest


@pytest.mark.parametrize(
    ("old", "new", "changes"),
    [
        ("PLASTIC_MPS = 0.05", "PLASTIC_MPS = 0.06", True),
        ("bounce * (pooled - line[SPEED, i])", "bounce * (pooled + line[SPEED, i])", True),
        ("    end = head", "end = head", True),  # in another block
        ("# a contact at", "# any contact at", False),
        ("Return the isotonic", "Write the isotonic", False),
        ("speeds of the touching bodies", "speed of the touching bodies", False),
    ],
)
def test_digest__is_that_of_the_code(old: str, new: str, changes: bool, tmp_path: Path, monkeypatch) -> None:
    folder = shutil.copytree(Path(digest.__file__).parent, tmp_path / "motion")
    monkeypatch.setattr(digest, "__file__", str(folder / "digest.py"))
    before, file = digest.physics_digest.__wrapped__(), folder / "impact.py"
    file.write_text(file.read_text("utf-8").replace(old, new), "utf-8")
    assert (digest.physics_digest.__wrapped__() != before) == changes
