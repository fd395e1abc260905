"""What evaluations, their results, episodes, statistics, datasets and figures refuse."""

import json
from collections.abc import Callable
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.evaluation.comparison import compare_results
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.evaluation.per_world import read_harms, read_result
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.seeds import interquartile_mean, mean_over_seeds, share_over_seeds
from ethbrake_marl.evaluation.statistics import exact_sum, mean, paired_difference, rate
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.physics.advance import advance
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")
WORLDS = PAPER.sample(3, 0).worlds
BRAKE = {"full_brake": eb.make_agent("full_brake")}
FOUR = PAPER.replace(
    vehicles=4,
    gaps_m=7.0,
    speeds_mps=20.0,
    braking_capacity_mps2=6.0,
    driving_capacity_mps2=6.0,
    mass_t=5.0,
    latency_s=0.5,
    roles={"vehicle_2": "learner"},
)
HEAD = "agent,world,first_impact_harm,total_harm\n"


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
    "evaluate: agents is empty; pass at least one agent, for instance": lambda: eb.evaluate(WORLDS, {}, scenario=PAPER),
    "evaluate: chunk = 0: must be a whole number, at least 1": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=PAPER, chunk=0
    ),
    "evaluate: chunk = 2.5: must be a whole number, at least 1": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=PAPER, chunk=2.5
    ),
    "vehicle = 3: must be the name of a vehicle, or an index from 0 to 2": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=PAPER, vehicle=3
    ),
    "scenario 'paper-random' has 0 learners (none); name the vehicle that the agents drive, for instance": lambda: (
        eb.evaluate(WORLDS, BRAKE, scenario=PAPER.replace(roles={}, early_impacts="keep"))
    ),
    "scenario 'paper-random' has the learners vehicle_2, vehicle_3, but vehicle = vehicle_2 is the only": lambda: (
        eb.evaluate(WORLDS, BRAKE, scenario=PAPER.with_learners([1, 2]), vehicle=1)
    ),
    "reset: got 3 worlds of 3 vehicles; 3 worlds of 4 vehicles must be passed": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=FOUR
    ),
    "evaluate: worlds is empty; pass at least one world": lambda: eb.evaluate(
        WORLDS.take(np.arange(0)), BRAKE, scenario=PAPER
    ),
    "reset: world 0 is at 0.1 s; episodes start at the alert, t = 0, without any impact": lambda: eb.evaluate(
        advance(WORLDS, -WORLDS.vehicles.braking_capacity_mps2, until_s=0.1)[0], BRAKE, scenario=PAPER
    ),
    "must be a Worlds or Sample object, for instance scenario.sample(100, seed=7)": lambda: eb.evaluate(
        5, BRAKE, scenario=PAPER
    ),
    "must be specs such as 'full_brake,ppo', or a mapping": lambda: eb.evaluate(WORLDS, 5, scenario=PAPER),
    "agent 5: must be name or name:argument": lambda: eb.evaluate(agents=[5], scenario=PAPER, episodes=2),
    "worlds or episodes, not both": lambda: eb.evaluate(WORLDS, BRAKE, scenario=PAPER, episodes=2),
    "number of worlds = 0: must be a whole number, at least 1": lambda: eb.evaluate(
        agents="coast", scenario=PAPER, episodes=0
    ),
    "evaluate: agent 'a': 'str' is not an agent, because it has no name and no act; to make an agent": lambda: (
        eb.evaluate(WORLDS, {"a": "full_brake"}, scenario=PAPER)
    ),
    "agent 'confused': predicted_harm in its memory has type float64 and shape (3, 2); must be one": lambda: (
        eb.evaluate(WORLDS, {"x": Confused((3, 2))}, scenario=PAPER)
    ),
    "agent 'confused' of vehicle_2: memory: contains ndarray of shape (2,); must contain only arrays": lambda: (
        eb.evaluate(WORLDS, {"x": Confused((2,))}, scenario=PAPER)
    ),
    "agent 'ppo' was not evaluated; evaluated agents: full_brake": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=PAPER
    ).outcome("ppo"),
    "x.csv: is not a file that --per-world wrote: 'agent'": lambda: read_harms(Path("x.csv"), b"a,b\n1,2\n"),
    "x.csv: is not a file that --per-world wrote: invalid literal for int() with base 10: 'x'": lambda: read_harms(
        Path("x.csv"), f"{HEAD}a,x,1,1\n".encode()
    ),
    "x.csv: is not a file that --per-world wrote: harms of world 1 = ['nan',": lambda: read_harms(
        Path("x.csv"), f"{HEAD}a,1,nan,1\n".encode()
    ),
    "x.csv: is not a file that --per-world wrote: harms of world 1 = ['1',": lambda: read_harms(
        Path("x.csv"), f"{HEAD}a,1,1,1e300\n".encode()
    ),
}


@pytest.mark.parametrize("message", EVALUATIONS)
def test_evaluation__is_refused(message: str) -> None:
    with refused(message):
        EVALUATIONS[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown vehicle 'vehicle_9'; did you mean 'vehicle_3'?": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario=PAPER, vehicle="vehicle_9"
    ),
    "unknown scenario 'paper-randm'; did you mean 'paper-random'?": lambda: eb.evaluate(
        WORLDS, BRAKE, scenario="paper-randm"
    ),
    "unknown agent 'full_brak'; did you mean 'full_brake'?": lambda: eb.evaluate(WORLDS, ["full_brak"], scenario=PAPER),
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


def test_agent__says_what_it_knows() -> None:
    knowing = Confused((3,))
    knowing.knows = "all"
    with refused("agent 'confused': knows = 'all': must be one or several of 'own sensors', 'messages'"):
        eb.evaluate(WORLDS, {"x": knowing}, scenario=PAPER)


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
    "x.json: must contain complete JSON: Expecting value: line 1 column 2 (char 1)": lambda: result("["),
    "x.json: is not a results file, because the key kind is missing; give a file with the output": lambda: result("{}"),
    "x.json: is not a results file; give a file with the output of ethbrake evaluate": lambda: result("3"),
    "x.json: unknown kind of results 'evalute'; did you mean 'evaluate'?": lambda: result('[{"kind": "evalute"}]'),
    "x.json: results of the kind best-harm cannot be compared; give results of the kind evaluate or shield": lambda: (
        result('{"kind": "best-harm"}')
    ),
    "x.json: the key agents must be a list of one or more objects; evaluate again": lambda: result(
        '{"kind": "evaluate", "seed": 7}'
    ),
    "x.json: worlds_sha256 is missing or not of type str; run ethbrake evaluate again": lambda: result(
        '[{"kind": "evaluate", "agent": "x", "episodes": 3}]'
    ),
    "x.json: full_brake: first_impact_harm = 27.178703352274425, first_impact_harm_interval = [0.0,": lambda: result(
        [row(episodes=1)]
    ),
    "x.json: full_brake: episodes = 0: must be from 1 to 1,000,000,000,000": lambda: result([row(episodes=0)]),
    "x.json: full_brake: episodes = True: must be from 1 to 1,000,000,000,000": lambda: result([row(episodes=True)]),
    "x.json: lists the agent full_brake twice; evaluate each agent once": lambda: result([row(), row()]),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", RESULTS)
def test_results_file__is_refused(message: str) -> None:
    with refused(message):
        RESULTS[message]()


@pytest.mark.parametrize(
    "changes",
    [
        {"total_harm": "x"},
        {"total_harm": True},
        {"total_harm": 1e300},
        {"total_harm": 10**400},
        {"total_harm_interval": [1]},
        {"total_harm_interval": [1e6, 2e6]},
        {"total_harm_interval": [9, 1]},
        {"total_harm": -5.0, "total_harm_interval": [-6, 1]},
    ],
    ids=lambda changes: str(changes)[:40],
)
def test_results_file__has_means_inside_their_intervals(changes: dict[str, Any], empty_folder: Path) -> None:
    with refused(": must be a mean harm, and an interval [low, high] that contains the mean"):
        result([row(**changes)])


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("scenario_sha256", "cannot be compared: their scenarios differ"),
        ("worlds_sha256", "cannot be compared: their worlds differ"),
    ],
)
def test_results__of_something_else_are_not_compared(key: str, message: str, empty_folder: Path) -> None:
    with refused(f"x.json and x.json {message}"):
        compare_results(result([row()]), result([row(**{key: "0" * 64})]))


def test_results__whose_mean_is_not_that_of_their_worlds_are_not_compared(empty_folder: Path) -> None:
    assert (
        run_command(["evaluate", "--agents", "full_brake", "--episodes", "5", "--output", "a", "--per-world", "csv"])
        == 0
    )
    (told,) = json.loads(Path("a/results.json").read_text())
    changed = {**told, "first_impact_harm": 3.0, "first_impact_harm_interval": [2.0, 4.0]}
    Path("a/x.json").write_text(json.dumps([changed]))
    with refused(
        "a/x.json: full_brake: first_impact_harm = 3, but its mean over the file with one row per world is 27.1787; one"
    ):
        compare_results(read_result(Path("a/results.json")), read_result(Path("a/x.json")))


# ---------------------------------------------------------------- episodes, statistics, figures


@pytest.mark.parametrize("sample_s", [0.0, nan, inf])
def test_record__is_of_one_world_at_a_positive_time(sample_s: float) -> None:
    with refused("record_episode: world has 3 worlds; pass exactly 1, for instance worlds.take([0])"):
        eb.record_episode(WORLDS, BRAKE["full_brake"], scenario=PAPER)
    with refused(f"record_episode: sample_s = {sample_s}: must be a finite number of seconds above 0"):
        eb.record_episode(WORLDS.take([0]), BRAKE["full_brake"], scenario=PAPER, sample_s=sample_s)


STATISTICS: dict[str, Callable[[], object]] = {
    "exact sum: values has shape (1,); must have finite numbers of shape [n]": lambda: exact_sum(np.array([nan])),
    "exact sum: values has shape (1, 1); must have finite numbers of shape [n]": lambda: exact_sum(np.array([[1.0]])),
    "rate: successes = -1, count = 10: must be 0 <= successes <= count, and count at least 1": lambda: rate(-1, 10),
    "rate: successes = 11, count = 10: must be 0 <= successes <= count, and count at least 1": lambda: rate(11, 10),
    "rate: successes = 0, count = 0: must be 0 <= successes <= count, and count at least 1": lambda: rate(0, 0),
    "statistics: values has shape (0,); must have one finite number per world: shape [n] with n >= 1": lambda: mean(
        np.array([])
    ),
    "statistics: values has shape (2,); must have one finite number per world: shape [n] with n >= 1": lambda: mean(
        np.array([1.0, nan])
    ),
    "statistics: there are 3 values, but 2 values of the baseline; the two numbers must be": lambda: paired_difference(
        np.zeros(3), np.zeros(2)
    ),
    "interquartile_mean: tasks is empty; pass the results of at least one task": lambda: interquartile_mean([]),
    "interquartile_mean: task 0: values has shape (0,); must have one finite number per seed: shape [n] with": lambda: (
        interquartile_mean([[]])
    ),
    "interquartile_mean: task 0: values has shape (2,); must have one finite number per seed: shape [n]": lambda: (
        interquartile_mean([[1.0, nan]])
    ),
    "mean_over_seeds: the arrays have the shapes (1, 2) and (1, 3): must be [seeds, worlds] with the same": lambda: (
        mean_over_seeds([[1.0, 2.0]], [[1.0, 2.0, 3.0]])
    ),
    "mean_over_seeds: some values are NaN or infinite: all values must be finite": lambda: mean_over_seeds(
        [[inf, 1.0, 2.0]], [[1.0, 2.0, 3.0]]
    ),
    "mean_over_seeds: the arrays have the shapes (1, 1, 3) and (1, 3): must be [seeds, worlds] with the same": lambda: (
        mean_over_seeds([[[1.0, 2.0, 3.0]]], [[1.0, 2.0, 3.0]])
    ),
    "share_over_seeds: the arrays have the shapes (2, 200) and (1, 200) and (1, 5): must be [seeds, worlds]": lambda: (
        share_over_seeds(np.ones((2, 200)), np.ones(200), np.zeros(5))
    ),
}


@pytest.mark.parametrize("message", STATISTICS)
def test_statistics__are_of_finite_numbers_that_fit(message: str) -> None:
    with refused(message):
        STATISTICS[message]()


# ---------------------------------------------------------------- datasets
