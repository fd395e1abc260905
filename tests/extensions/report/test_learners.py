"""What the report of a run says of several learners, against evaluations of our own of what it left."""

from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.report.learners import learners_sheets
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.training.experiment import run_experiment
from ethbrake_marl.first_edition.training.team import load_team
from tests.first_edition.learning.tiny import TINY_PPO
from tests.fixtures.commands import draw_nothing

SCENARIO = eb.load_scenario("cooperation-3-pair")
BRAKING = eb.make_agent("full_brake")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two learners."""
    path = tmp_path_factory.mktemp("team") / "run"
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        run_experiment(SCENARIO, path, recipe=TINY_PPO.replace(total_steps=512, scheme="shared"), episodes=12)
    return path


def test_tables__are_what_the_trained_vehicles_do(folder: Path) -> None:
    team = load_team(folder, SCENARIO)
    agents: dict[str, Any] = {"full_brake": BRAKING, "trained team": team}
    for vehicle in SCENARIO.learners:
        name = f"all but {SCENARIO.vehicle_names[vehicle]}"
        agents[name] = Team({**team.drivers, vehicle: BRAKING}, name)
    result = eb.evaluate(SCENARIO.sample(12, 7), agents, scenario=SCENARIO, seed=7)
    *borne, added = learners_sheets(result)
    more: dict[str, list[float]] = {"vehicle_2": [], "vehicle_3": []}
    for count, sheet in zip(("first", "total"), borne, strict=True):
        lines = {}
        for name, *cells in sheet.rows:
            each = result.outcome(name).vehicle_harm(count).mean(axis=0)
            assert [cell.value for cell in cells] == pytest.approx([*each, each.sum()])
            lines[name] = each.sum()
        for name in more:
            more[name].append(lines[f"all but {name}"] - lines["trained team"])
    assert {name: [cell.value for cell in cells] for name, *cells in added.rows} == {
        name: pytest.approx(values) for name, values in more.items()
    }
