"""What ``ethbrake run`` says of several learners, against evaluations of our own of what it left."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.extensions.cooperation import run_section
from ethbrake_marl.progress import Progress
from ethbrake_marl.training.experiment import ExperimentResult, run_experiment
from ethbrake_marl.training.team import load_team
from tests.fixtures.commands import draw_nothing
from tests.learning.tiny import TINY_PPO

SCENARIO = eb.load_scenario("cooperation-3-pair")
RECIPE = TINY_PPO.replace(total_steps=512, scheme="shared")
COUNTS = ("first", "total")
LEARNERS = ("vehicle_2", "vehicle_3")
FURTHER = ("alone/vehicle_2", "alone/vehicle_3", "without-messages")
WORLDS, SEARCHED = 12, 6
BRAKING = eb.make_agent("full_brake")


def run(folder: Path, scenario: eb.Scenario, **given: Any) -> ExperimentResult:
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        patch.setattr(run_section, "SEARCHED", SEARCHED)
        patch.setattr(run_section, "BUDGET", 200)
        return run_experiment(scenario, folder, **{"recipe": RECIPE, "episodes": WORLDS, **given})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of two learners."""
    path = tmp_path_factory.mktemp("team") / "run"
    run(path, SCENARIO)
    return path


def told(folder: Path, table: str) -> dict[str, Any]:
    """The rows of a table, by their first cell."""
    return {next(iter(row.values())): row for row in json.loads((folder / "cooperation.json").read_text())[table]}


def alone(folder: Path, name: str) -> Team:
    """The vehicle that was trained alone; the other learner brakes fully."""
    vehicle = SCENARIO.vehicle_names.index(name)
    own = load_team(folder / "alone" / name, SCENARIO, vehicles=[vehicle])
    assert [*own.drivers] == [vehicle]
    return Team({vehicle: BRAKING for vehicle in SCENARIO.learners} | dict(own.drivers), name)


def harm(scenario: eb.Scenario, agent: Any, count: str) -> np.ndarray:
    """Harm of each vehicle in each of the run's worlds, [12, 3]."""
    found = eb.evaluate(scenario.sample(WORLDS, 7), {"it": agent}, scenario=scenario, seed=7)
    return found.outcome("it").vehicle_harm(count)


@pytest.mark.parametrize("count", COUNTS)
def test_who_bears_what__is_what_the_trained_vehicles_do(folder: Path, count: str) -> None:
    rows, team = told(folder, f"borne_{count}"), load_team(folder, SCENARIO)
    drivers = {"full_brake": BRAKING, "trained team": team}
    for name, vehicle in zip(LEARNERS, SCENARIO.learners, strict=True):
        drivers[f"{name} alone"] = alone(folder, name)
        drivers[f"all but {name}"] = Team({**team.drivers, vehicle: BRAKING}, name)
    assert rows.keys() == drivers.keys() | {"e_v2x_bm", "shielded team"}
    for name, driver in drivers.items():
        each = harm(SCENARIO, driver, count).mean(axis=0)
        cells = [rows[name][key] for key in (*SCENARIO.vehicle_names, "line")]
        assert cells == pytest.approx([*each, each.sum()])


@pytest.mark.parametrize("count", COUNTS)
def test_added__is_the_harm_without_the_learner_minus_the_teams(folder: Path, count: str) -> None:
    rows, borne = told(folder, "added"), told(folder, f"borne_{count}")
    for name in LEARNERS:
        more = borne[f"all but {name}"]["line"] - borne["trained team"]["line"]
        assert rows[name][f"{count}_added"] == pytest.approx(more)


@pytest.mark.parametrize("count", COUNTS)
def test_compared__with_the_best_alone_the_team_without_messages_and_the_optimum(folder: Path, count: str) -> None:
    rows, borne = told(folder, f"compared_{count}"), told(folder, f"borne_{count}")
    best = min(LEARNERS, key=lambda name: told(folder, "borne_first")[f"{name} alone"]["line"])  # what was trained for
    silent = SCENARIO.replace(v2x="sensors-only")
    without = harm(silent, load_team(folder / "without-messages", silent), count).sum(axis=1).mean()
    expected = {
        f"best single learner ({best} alone)": (borne[f"{best} alone"]["line"], WORLDS),
        "team without messages": (without, WORLDS),
        "full_brake without messages": (harm(silent, BRAKING, count).sum(axis=1).mean(), WORLDS),
    }
    for name, (its, worlds) in expected.items():
        row = rows.pop(name)
        assert (row["its"], row["team"], row["worlds"]) == pytest.approx((its, borne["trained team"]["line"], worlds))
        assert row["difference"] == pytest.approx(row["team"] - row["its"])
    assert [*rows] == ["joint optimum"]
    drivers = [BRAKING, load_team(folder, SCENARIO), *(alone(folder, name) for name in LEARNERS)]
    known = np.min([harm(SCENARIO, driver, count).sum(axis=1)[:SEARCHED] for driver in drivers], axis=0)
    assert rows["joint optimum"]["worlds"] == SEARCHED and rows["joint optimum"]["its"] <= known.mean()


def test_page__has_the_tables_below_the_results(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert page.index(">Results</h2>") < page.index(">Several learners</h2>") < page.index(">Episodes</h2>")
    assert all(title in page for title in ("Who bears what", "What each learner adds", "The trained team compared"))


MIXTURE = """
name: mine
mixture:
  - {scenario: cooperation-3-pair, weight: 1}
  - {scenario: cooperation-3-congested, weight: 1}
"""
SENSORS = json.dumps(SCENARIO.replace(v2x="sensors-only", name="mine").declared())


@pytest.mark.parametrize(("text", "why"), [(MIXTURE, "a mixture"), (SENSORS, "a scenario without messages")])
def test_messages__that_cannot_be_taken_away_are_said(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    run(tmp_path / "run", eb.load_scenario(tmp_path / "mine.yaml"), recipe=RECIPE.replace(total_steps=128))
    told = json.loads((tmp_path / "run" / "cooperation.json").read_text())["note"]
    assert f"What messages add was not measured: this is {why}." in told


def test_interrupted__training_is_followed_by_no_other(tmp_path: Path) -> None:
    def press(progress: Progress) -> None:
        if progress.done == 256:
            os.kill(os.getpid(), signal.SIGINT)

    assert run(tmp_path / "run", SCENARIO, on_progress=press).trained.status == "interrupted"
    assert not {"alone", "without-messages"} & {path.name for path in (tmp_path / "run").iterdir()}
    assert {*json.loads((tmp_path / "run" / "cooperation.json").read_text())} == {
        "borne_first",
        "borne_total",
        "added",
        "note",
    }


def test_interrupted__further_training_ends_the_comparison_and_not_the_report(tmp_path: Path) -> None:
    pressed: list[Progress] = []

    def press(progress: Progress) -> None:
        if progress.name.startswith("alone/vehicle_3") and progress.done and not pressed:
            pressed.append(progress)
            os.kill(os.getpid(), signal.SIGINT)

    assert run(tmp_path / "run", SCENARIO, on_progress=press).interrupted == "the training run in alone/vehicle_3"
    status = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (status["status"], status["reason"]) == ("finished", "interrupted: the training run in alone/vehicle_3")
    told = json.loads((tmp_path / "run" / "cooperation.json").read_text())["note"]
    assert told == "The training run in alone/vehicle_3 was interrupted: nothing more was compared."
    assert told in (tmp_path / "run" / "report.html").read_text()


def test_interrupted__search_stops_at_once_and_keeps_the_team(tmp_path: Path) -> None:
    def press(progress: Progress) -> None:
        if progress.name == "joint optimum":
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "run", SCENARIO, on_progress=press)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    assert load_team(tmp_path / "run", SCENARIO).drivers.keys() == {1, 2}


def test_turns__are_those_of_the_team_alone(tmp_path: Path) -> None:
    run(tmp_path / "run", SCENARIO, recipe=RECIPE.replace(scheme="independent", turns=1))
    schemes = [json.loads((tmp_path / "run" / name / "team.json").read_text())["scheme"] for name in FURTHER]
    assert schemes == ["single", "single", "independent"]


def test_objective__is_told_where_it_is_not_the_harm_of_all(tmp_path: Path) -> None:
    run(tmp_path / "run", SCENARIO.replace(objective="own"), recipe=RECIPE.replace(total_steps=128))
    assert "first-impact harm (own)" in (tmp_path / "run" / "report.html").read_text()


def test_one_learner__has_no_such_section(finished_run: Path) -> None:
    assert not (finished_run / "cooperation.json").exists()
    assert "Several learners" not in (finished_run / "report.html").read_text()
