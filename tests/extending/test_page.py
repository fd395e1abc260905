"""The page about extending: its code runs as it is printed, and its table names what there is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import app, run_command

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "extending.md").read_text("utf-8")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page__its_code_runs_from_the_top_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(app, "registered_commands", [*app.registered_commands])
    blocks = re.findall("```python\n(.*?)```", PAGE, re.DOTALL)
    code = "\n".join(blocks)
    names: dict[str, object] = {"__name__": "my_file"}
    exec(compile(code, "extending.md", "exec"), names)
    assert names["status"] == 0
    for command in ("train", "evaluate"):
        assert run_command([command, "--help"]) == 0
        told = capsys.readouterr().out
        assert all(name in told for name in ("comfort", "time_gap", "rural", "front-first", "patient", "absorbed"))
    policy = eb.load_policy(tmp_path / "runs" / "again")
    assert policy.manifest.algorithm == "patient" and "comfort" in policy.manifest.reward["terms"]
    assert policy.manifest.observation.features[-1] == "rear_1.mass_ratio"
    assert (tmp_path / "runs" / "again" / "harm.png").stat().st_size > 1000


def test_page__every_part_has_its_place_in_the_table() -> None:
    rows = re.findall(r"^\| \[(.*?)\]\(#(.*?)\)", PAGE, re.MULTILINE)
    headings = re.findall("^## (.*)$", PAGE, re.MULTILINE)
    assert [name.lower() for name, _ in rows] == [heading.lower() for heading in headings]
    assert [anchor for _, anchor in rows] == [heading.lower().replace(" ", "-") for heading in headings]
