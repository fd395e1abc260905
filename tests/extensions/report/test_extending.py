"""The page that shows how to add parts of your own."""

import re
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = (DOCS / "extend.md").read_text("utf-8")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page__its_code_runs_from_the_top_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = "\n".join(re.findall("```python\n(.*?)```", PAGE, re.DOTALL))
    names: dict[str, Any] = {"__name__": "my_file"}
    exec(compile(code, "extend.md", "exec"), names)
    capsys.readouterr()
    assert run_command(["scenario", "parts"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in ("comfort", "mass_ratio", "rural", "front-first", "patient", "absorbed"))
    policy = eb.load_policy(tmp_path / "runs" / "patient")
    assert policy.manifest.algorithm == "patient" and "comfort" in policy.manifest.reward["terms"]
    assert policy.manifest.observation.features[-1] == "rear_1.mass_ratio"
