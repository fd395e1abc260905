"""What evaluations, their results, episodes, statistics, datasets and figures refuse."""

import json
from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.first_edition.evaluation.comparison import compare_results
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.per_world import read_harms, read_result
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.seeds import interquartile_mean, mean_over_seeds
from ethbrake_marl.first_edition.evaluation.statistics import exact_sum, mean, paired_difference, rate
from ethbrake_marl.first_edition.evaluation.summary import summarise
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
WORLDS = PAPER.sample(3, 0).worlds
BRAKE = {"full_brake": eb.make_agent("full_brake")}


class Confused:
    """An agent that predicts harm of another shape."""

    name, knows = "confused", "own sensors"

    def __init__(self, shape):
        self.shape = shape

    def begin(self, alert, vehicle, scripts):
        return {"predicted_harm": np.zeros(self.shape)}

    def act(self, worlds, memory, vehicle):
        return np.zeros(3), memory


EVALUATIONS: dict[str, Callable[[], object]] = {
    "evaluate: agents is empty; pass at": lambda: eb.evaluate(WORLDS, {}, scenario=PAPER),
    "vehicle = 3: must be the name of a": lambda: eb.evaluate(WORLDS, BRAKE, scenario=PAPER, vehicle=3),
    "scenario 'paper-random' has the": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=PAPER.with_learners([1, 2]), vehicle=1
    ),
    "evaluate: worlds is empty; pass at": lambda: eb.evaluate(WORLDS.take(np.arange(0)), BRAKE, scenario=PAPER),
    "must be a Worlds or Sample object, for": lambda: eb.evaluate(5, BRAKE, scenario=PAPER),
    "agent 5: must be name or name:argument": lambda: eb.evaluate(agents=[5], scenario=PAPER, episodes=2),
    "worlds or episodes, not both": lambda: eb.evaluate(WORLDS, BRAKE, scenario=PAPER, episodes=2),
    "agent 'confused': predicted_harm in its": lambda: eb.evaluate(WORLDS, {"x": Confused((3, 2))}, scenario=PAPER),
    "agent 'confused' of vehicle_2: memory:": lambda: eb.evaluate(WORLDS, {"x": Confused((2,))}, scenario=PAPER),
    "agent 'ppo' was not evaluated;": lambda: eb.evaluate(WORLDS, BRAKE, scenario=PAPER).outcome("ppo"),
    "x.csv: is not a file that --per-world": lambda: read_harms(Path("x.csv"), b"a,b\n1,2\n"),
}


@pytest.mark.parametrize("message", EVALUATIONS)
def test_evaluation__is_refused(message: str) -> None:
    with refused(message):
        EVALUATIONS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown vehicle 'vehicle_9'; did you": lambda: eb.evaluate(WORLDS, BRAKE, scenario=PAPER, vehicle="vehicle_9")
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


def test_groups__are_those_of_a_mixture_or_of_vehicle_types() -> None:
    with refused("by = 'scenario': these worlds have no groups; worlds of a mixture can be grouped by 'scenario',"):
        eb.summarise_by(eb.evaluate(WORLDS, BRAKE, scenario=PAPER), "scenario")
    mixed = eb.load_scenario("realistic-mixed")
    with refused("unknown group 'vehicle_9_type'; did you mean 'vehicle_3_type'?", UnknownName):
        eb.summarise_by(eb.evaluate(mixed.sample(3, 7), BRAKE, scenario=mixed), "vehicle_9_type")


# ---------------------------------------------------------------- results that are compared


def result(content: Any) -> Any:
    """What a results file with this content holds."""
    Path("x.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return read_result(Path("x.json"))


def row(**changes: Any) -> dict[str, Any]:
    """One row of an evaluation of full braking in five worlds, with changes."""
    found = evaluate(PAPER.sample(5, 7), make_lineup(["full_brake"], PAPER), scenario=PAPER, seed=7)
    return {**summarise(found)[0].to_json(), **changes}


RESULTS: dict[str, Callable[[], object]] = {
    "x.json: must contain complete JSON:": lambda: result("["),
    "x.json: is not a results file, because": lambda: result("{}"),
    "x.json: is not a results file; give a": lambda: result("3"),
    "x.json: worlds_sha256 is missing or not": lambda: result('[{"kind": "evaluate", "agent": "x", "episodes": 3}]'),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", RESULTS)
def test_results_file__is_refused(message: str) -> None:
    with refused(message):
        RESULTS[message]()


@pytest.mark.parametrize(
    "changes",
    [{"total_harm": "x"}, {"total_harm_interval": [1]}, {"total_harm": -5.0, "total_harm_interval": [-6, 1]}],
    ids=lambda changes: str(changes)[:40],
)
def test_results_file__has_means_inside_their_intervals(changes: dict[str, Any], empty_folder: Path) -> None:
    with refused(": must be a mean harm, and an interval [low, high] that contains the mean"):
        result([row(**changes)])


@pytest.mark.parametrize(("key", "message"), [("scenario_sha256", "cannot be compared: their scenarios")])
def test_results__of_something_else_are_not_compared(key: str, message: str, empty_folder: Path) -> None:
    with refused(f"x.json and x.json {message}"):
        compare_results(result([row()]), result([row(**{key: "0" * 64})]))


# ---------------------------------------------------------------- episodes, statistics, figures


@pytest.mark.parametrize("sample_s", [0.0, nan, inf])
def test_record__is_of_one_world_at_a_positive_time(sample_s: float) -> None:
    with refused("record_episode: world has 3 worlds; pass exactly 1, for instance worlds.take([0])"):
        eb.record_episode(WORLDS, BRAKE["full_brake"], scenario=PAPER)
    with refused(f"record_episode: sample_s = {sample_s}: must be a finite number of seconds above 0"):
        eb.record_episode(WORLDS.take([0]), BRAKE["full_brake"], scenario=PAPER, sample_s=sample_s)


STATISTICS: dict[str, Callable[[], object]] = {
    "exact sum: values has shape (1,); must": lambda: exact_sum(np.array([nan])),
    "rate: successes = -1, count = 10: must": lambda: rate(-1, 10),
    "statistics: values has shape (0,); must": lambda: mean(np.array([])),
    "statistics: there are 3 values, but 2": lambda: paired_difference(np.zeros(3), np.zeros(2)),
    "interquartile_mean: tasks is empty;": lambda: interquartile_mean([]),
    "mean_over_seeds: the arrays have the": lambda: mean_over_seeds([[1.0, 2.0]], [[1.0, 2.0, 3.0]]),
    "mean_over_seeds: some values are NaN or": lambda: mean_over_seeds([[inf, 1.0, 2.0]], [[1.0, 2.0, 3.0]]),
}


@pytest.mark.parametrize("message", STATISTICS)
def test_statistics__are_of_finite_numbers_that_fit(message: str) -> None:
    with refused(message):
        STATISTICS[message]()


# ---------------------------------------------------------------- datasets
