"""The recurrent network of train/recurrent.py, which looks at the age of messages."""

import sys
from pathlib import Path

import pytest

import ethbrake_marl as eb
from tests.docs.site import load


def test_recurrent__leaves_a_network_that_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script, folder = load("../../train/recurrent"), tmp_path / "gru"
    monkeypatch.setattr(sys, "argv", ["recurrent.py", "--output", str(folder), "--updates", "2", "--worlds", "8"])
    script.main()
    result = eb.evaluate("cooperation-3-congested", f"{script.__file__}:make_agent:{folder}", episodes=5)
    assert result.n == 5
