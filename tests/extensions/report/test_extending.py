"""Parts of the user's own in reports, and the page that shows how to add them."""

import re
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as second
import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.app import app, run_command


def test_measure__stands_in_the_page_of_an_evaluation(empty_folder: Path) -> None:
    def rear(episodes: Any) -> Any:
        """Largest change of speed of the rear vehicle."""
        return episodes.largest_speed_change_mps[:, 2]

    eb.register_measure("change_of_rear", rear, unit="m/s")
    words = [
        "evaluate",
        "--agents",
        "full_brake,coast",
        "--seed",
        "7",
        "--episodes",
        "40",
        "--output",
        "out",
        "--report",
    ]
    assert run_command(words) == 0
    found = eb.evaluate(agents="full_brake", scenario="paper-random", episodes=40).outcome("full_brake")
    page = Path("out/report.html").read_text()
    assert "change_of_rear (m/s)" in page and f"{found.metrics['change_of_rear'].mean():.2f}" in page


DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = (DOCS / "extend.md").read_text("utf-8")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page__its_code_runs_from_the_top_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(app, "registered_commands", [*app.registered_commands])
    code = "\n".join(re.findall("```python\n(.*?)```", PAGE, re.DOTALL))
    names: dict[str, Any] = {"__name__": "my_file"}
    exec(compile(code, "extend.md", "exec"), names)
    assert names["status"] == 0
    assert "6.31\n" in capsys.readouterr().out
    assert run_command(["scenario", "parts"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in ("comfort", "time_gap", "rural", "front-first", "patient", "absorbed"))
    policy = second.load_policy(tmp_path / "runs" / "again")
    assert policy.manifest.algorithm == "patient" and "comfort" in policy.manifest.reward["terms"]
    assert policy.manifest.observation.features[-1] == "rear_1.mass_ratio"
    assert (tmp_path / "runs" / "again" / "harm.png").stat().st_size > 1000
