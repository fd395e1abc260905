"""What a report adds to the folder of a run."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.report.experiment import telling_world
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from tests.cli.test_train import ctrl_c_when, status_of
from tests.fixtures.commands import rows_of, told_json

AGENTS = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "trained policy", "hybrid"]


def test_run__leaves_results_figures_report_and_policy(finished_run: Path) -> None:
    names = {path.name for path in finished_run.iterdir()}
    assert names >= {
        "config.json", "run.json", "progress.csv", "policy", "results.csv", "results.json", "per_world.csv",
        "report.html", "learning_curve.png", "harm_against_gap.png", "trajectories.png",
    }  # fmt: skip
    page = (finished_run / "report.html").read_text()
    assert page.count("<figure>") == page.count("data:image/svg") == 6  # three of them are in the pictures, too
    assert page.count('"pieces":') == 50 * len(AGENTS)
    assert status_of(finished_run, "status", "stage", "steps", "reason") == ("finished", "report", 256, None)


def test_run__the_other_two_tests_stand_beside_the_main_one(finished_run: Path) -> None:
    rows = json.loads((finished_run / "other_tests.json").read_text())
    tests = ["paper-random-brake-only", "paper-random-obstacle"]
    expected = [(test, agent) for test in tests for agent in ("full_brake", "e_v2x_bm", "trained policy", "hybrid")]
    assert [(row["parameters"]["scenario"], row["agent"]) for row in rows] == expected
    flat = rows_of(finished_run / "other_tests.csv")
    assert [(line["scenario"], line["agent"]) for line in flat] == expected
    for test, row in zip(tests, rows[::4], strict=True):
        scenario = eb.load_scenario(test)
        result = eb.evaluate(scenario.sample(60, 7), make_lineup(["full_brake"], scenario), scenario=scenario, seed=7)
        assert row["total_harm"] == eb.summarise(result)[0].total_harm.value


@pytest.mark.slow
def test_run__json_prints_the_rows_alone_and_force_replaces(ethbrake, tiny_recipe, finished_run, tmp_path) -> None:
    folder = tmp_path / "again"
    shutil.copytree(finished_run, folder)
    (folder / "per_world.csv").write_text("stale")
    answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "60", "--output", folder, "--force", "--json")
    assert told_json(answer) == json.loads((finished_run / "results.json").read_text())
    assert (folder / "per_world.csv").read_bytes() == (finished_run / "per_world.csv").read_bytes()
    assert "training" in answer.err and str(folder / "report.html") in answer.err
    assert all(picture.read_bytes().startswith(b"\x89PNG") for picture in folder.glob("*.png"))


@pytest.mark.slow
def test_run__interrupted_evaluates_the_policy_so_far_and_goes_on_as_a_training(
    ethbrake, tiny_recipe, tmp_path, monkeypatch
) -> None:
    folder = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        ctrl_c_when(patch, lambda shown: shown["done"] == 128)
        answer = ethbrake("run", "--recipe", tiny_recipe, "--episodes", "40", "--output", folder, "--json")
    assert (answer.status, [row["agent"] for row in json.loads(answer.out)]) == (130, AGENTS)
    assert "interrupted after 128 steps; now evaluating the policy so far" in answer.err
    last = answer.err.splitlines()[-1]
    assert last.startswith("interrupted after 128 training steps") and str(folder) in last
    assert status_of(folder, "status", "steps", "stage") == ("interrupted", 128, "report")
    assert "interrupted" in (folder / "report.html").read_text()
    assert ethbrake("train", "--resume", folder).status == 0
    assert status_of(folder, "status", "steps") == ("finished", 256)
    assert not [*folder.glob("*.html"), *folder.glob("*.png"), *folder.glob("results.*")]  # of the policy before


@pytest.mark.parametrize(
    ("before", "after", "row"),
    [
        ([9.0, 0.0, 5.0, 7.0], [1.0, 0.0, 4.0, 2.0], 3),  # savings 8, -, 1, 5
        ([4.0, 3.0], [0.0, 0.0], 1),  # of two, the smaller saving
        ([0.0, 0.0], [0.0, 5.0], 0),  # full braking harms nobody
    ],
)
def test_telling_world__is_the_median_saving_among_harmful_worlds(before, after, row):
    harms = {"full_brake": before, "trained policy": after}
    by_count = {name: {"first": np.ones(4), "total": np.array(harm)} for name, harm in harms.items()}
    outcome = {name: SimpleNamespace(world_harm=found.__getitem__) for name, found in by_count.items()}
    evaluation = SimpleNamespace(outcome=outcome.__getitem__, outcomes=harms)
    assert telling_world(evaluation, "total") == row
