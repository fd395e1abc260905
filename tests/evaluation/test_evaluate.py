"""Evaluations: measures by hand, golden rows, the same bits in any number of processes, refusals."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.e_v2x_bm import EV2XBM
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import BUILT_IN_COUNTS
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.terms import TERMS, register_term
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, PhysicsError, UnknownName
from ethbrake_marl.evaluation import evaluate as evaluating
from ethbrake_marl.evaluation.evaluate import evaluate_teams
from ethbrake_marl.evaluation.measure_registry import MEASURES, measures_called, register_measure
from ethbrake_marl.evaluation.measures import Measure, Statistic
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.evaluation.summary import summarise
from ethbrake_marl.motion.layout import GAP
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.algorithm_1 import EpisodeShield
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.evaluation.lines import COAST, FULL_BRAKE, GENTLE, PAIR, Careless, Drives, Foreteller, evaluated, teams
from tests.refused import refused

# ---- measures


def test_measures__of_one_impact_by_hand() -> None:
    result = evaluated(PAIR, 2, [FULL_BRAKE], ["pushed_m", "own", "maximin"])
    # 10.6458 m to the impact, 27.9533 m after it; alone 33.3333 m
    expected = {
        "collided": 1.0, "impacts": 1.0, "first_impact_harm": 9.0, "total_harm": 9.0, "total_harm_1": 4.95,
        "total_harm_2": 4.05, "hardest_impact_mps": 3.0, "pushed_m_1": 5.26575,
        "pushed_m_1_far": 1.0, "own_first_1": 4.95, "own_total_2": 4.05, "maximin_total": 4.95,
        "end_s": 3.7,
    }  # fmt: skip
    row = {name: float(result["full_brake"][name][1]) for name in expected}
    assert row == pytest.approx(expected, rel=1e-5)
    assert result["full_brake"]["ended"].tolist() == ["at_rest", "at_rest"]


def test_objectives__are_measured_in_every_count_and_once_unless_vehicles_differ() -> None:
    asked = "weighted:1, 3,vehicle_2,own,pushed_mps"
    result = evaluated(PAIR, 1, [FULL_BRAKE, COAST], asked)
    row = {name: column[0] for name, column in result["full_brake"].items()}
    expected = {
        "vehicle_2_first": 4.05, "vehicle_2_honest": 4.05, "weighted:1, 3_total": (4.95 + 3.0 * 4.05) / 2.0,
        "own_total_1": 4.95,
    }  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    assert "vehicle_2_first_1" not in row and "pushed_mps" in row
    coasts = result["coast"]
    assert coasts["vehicle_2_honest"] == coasts["honest_cost_2"] > coasts["vehicle_2_total"]


def test_worst5__is_the_mean_of_the_worst_worlds_in_every_count() -> None:
    result = eb.evaluate("paper-random", "full_brake", episodes=100, measures="worst5", harm_count="honest")
    (row,) = eb.summarise(result)
    for count, column in ((each.name, each.column) for each in BUILT_IN_COUNTS):
        last_five = np.sort(result["full_brake"][column])[-5:]
        assert row[f"worst5_{count}"].value == pytest.approx(last_five.mean()) and row[f"worst5_{count}"].interval


# PAIR with e = 0 and equal masses: coasting, Vehicle 2 is at Vehicle 1 after sqrt(2 / 6) s and 10.547 m, and 3.464 m/s
# faster. Both have 18.268 m/s then and slow down at 3 m/s2, for 6.089 s and 55.620 m, with a push of 6 m/s2.
PLASTIC = {**PAIR, "restitution": 0.0, "mass_t": 1.0}


def test_pushes__of_a_pair_by_hand() -> None:
    asked = ["pushed_mps", "pushed_m", "drove_towards", "still_moving", "push", "drove"]
    row = {name: column[0] for name, column in evaluated(PLASTIC, 1, [COAST], asked)["coast"].items()}
    expected = {
        "pushed_mps": 36.536, "pushed_mps_1": 36.536, "pushed_mps_obstacle": 0.0, "push": -36.536,
        "pushed_m_1": 10.547 + 55.620 - 33.333, "drove_towards": 0.0, "drove_2": 0.0,
    }  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=2e-3)
    assert (row["pushed_m_1_far"], row["drove_towards_hard"], row["still_moving"]) == (True, False, False)
    assert "pushed_m_2" not in row and "pushed_mps_2" not in row


@pytest.mark.parametrize(("command", "hard"), [(2.0, True), (1.0, False)])
def test_driving__before_the_first_impact_by_hand(command: float, hard: bool) -> None:
    # closing from 0.5 s, where the gap is 0.25 m and 3 m/s are missing: (6 + u) / 2 t^2 + 3 t = 0.25
    time = (math.sqrt(9.0 + 0.5 * (6.0 + command)) - 3.0) / (6.0 + command)
    asked = ["drove_towards", "drove", "still_moving"]
    row = {name: column[0] for name, column in evaluated(PAIR, 1, [Drives(command)], asked)["drives"].items()}
    assert row["drove_towards"] == row["drove_towards_2"] == pytest.approx(time / (0.5 + time), rel=1e-9)
    assert row["drove_2"] == pytest.approx(-7.5 * command) and row["drove_towards_1"] == 0.0
    assert (row["drove_towards_hard"], row["still_moving"]) == (hard, True)
    far = evaluated({**PAIR, "gaps_m": 900.0}, 1, [Drives(command)], asked)["drives"]
    assert far["drove_towards"][0] == pytest.approx(7.5 / 8.0) and far["drove_2"][0] == pytest.approx(-7.5 * command)


def test_conduct__is_measured_in_every_line() -> None:
    for name in ("cooperation-4-all", "paper-random-obstacle", "cooperation-2-five"):
        scenario, game = open_game(name)
        alert, learners = scenario.sample(20, 7), game.settings.learners.tolist()
        team = Team("coast", {body: COAST for body in learners})
        asked = measures_called("pushed_mps,pushed_m,drove_towards,still_moving,drove")
        columns = evaluate_teams(alert, {"coast": team}, game, asked)["coast"]
        each = [f"pushed_mps_{i}" for i in range(1, alert.vehicles)] + ["pushed_mps_obstacle"]
        assert np.sum([columns[key] for key in each], axis=0) == pytest.approx(columns["pushed_mps"])
        assert all((columns[key] >= 0.0).all() for key in each) and (
            name != "paper-random-obstacle" or columns["pushed_mps"].any()
        )
        assert not columns["drove_towards"].any() and columns["still_moving"].tolist() == [
            each == "horizon" for each in columns["ended"]
        ]
        ways = {key for key in columns if re.fullmatch("pushed_m_[0-9]", key)}
        assert ways == {f"pushed_m_{i + 1}" for i in range(alert.vehicles) if i + 1 not in learners}


def test_pushed_m__of_any_vehicle_is_where_it_ends_minus_where_it_would() -> None:
    scenario, game = open_game("paper-random")
    alert = scenario.sample(30, 7)
    result = evaluated("paper-random", 30, [COAST], ["pushed_m"])["coast"]
    last = [state for _, state in evaluating.play(game, alert, teams(COAST)["coast"])][-1]
    # the last vehicle coasts for its latency and brakes with 6 m/s2; it ends behind Vehicle 1 by both gaps
    own = alert.speeds_mps[:, 2] * alert.latency_s[:, 2] + alert.speeds_mps[:, 2] ** 2 / 12.0
    first = result["pushed_m_1"] + alert.speeds_mps[:, 0] ** 2 / 12.0
    way = first - (last.gaps_m - alert.gaps_m).sum(axis=1)
    assert result["pushed_m_3"] == pytest.approx(way - own, abs=1e-9) and "pushed_m_2" not in result


def test_sums_of_terms__are_what_is_rewarded() -> None:
    result = evaluated("paper-random", 5, measures=["collision", "jerk"])["constant:4.0"]
    harm = result["total_harm"]
    assert result["collision"] == pytest.approx(-harm, rel=1e-12) and harm.any()
    # at 0.5 s Vehicle 2 reaches -4 m/s2 within a step of 0.1 s, Vehicle 3 -6 m/s2 at 0.8 s; Vehicle 1 has braked before
    assert result["jerk_2"].tolist() == pytest.approx([-1600.0] * 5) and not result["jerk_1"].any()


def test_measure_of_ones_own__is_a_column_with_its_statistic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MEASURES, "loaded", dict(MEASURES.loaded))

    def near(game: Any, alert: State, last: State) -> Any:
        """Whether the last gap is below 1 m."""
        return last.gaps_m < 1.0 if game.settings.learners[0] == 1 else last.gaps_m[:, -1] < 1.0

    register_measure("near", near, unit="", statistics=[Statistic("near_rate", "rate", "Near")])
    register_measure("near", near, unit="", statistics=[Statistic("near_rate", "rate", "Near")])  # twice the same
    result = evaluated("paper-random", 20, measures=["near"])
    table = summarise(result)
    assert table[0]["near_rate"] == rate(result["full_brake"]["near"]) and "Near" in str(table)
    assert table.meanings()["Near"] == "Whether the last gap is below 1 m."
    with refused("measure 'near' is registered already", AlreadyExists):
        register_measure("near", near, unit="m")


def doc(function: Any) -> Any:
    function.__doc__ = "A measure."
    return function


REFUSED_MEASURES: dict[str, tuple[str, Any]] = {
    "must be 1 to 64 characters": ("x_1", doc(lambda g, a, last: last.time_s)),
    "with a docstring that describes the measure": ("x", lambda g, a, last: last.time_s),
    "this name is already in use": ("total_harm", doc(lambda g, a, last: last.time_s)),
    "its function fails: ZeroDivisionError": ("x", doc(lambda g, a, last: 1 / 0)),
    "float64 of shape (2, 3); must return": ("x", doc(lambda g, a, last: np.zeros((2, 3)))),
    "its value is nan in row 1; must be finite": ("x", doc(lambda g, a, last: np.array([1.0, np.nan]))),
}


@pytest.mark.parametrize("message", REFUSED_MEASURES)
def test_measure__that_cannot_be_used(message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MEASURES, "loaded", dict(MEASURES.loaded))
    name, function = REFUSED_MEASURES[message]
    with refused(message, (InvalidInput, AlreadyExists)):  # type: ignore[arg-type]
        register_measure(name, function)
        evaluated(PAIR, 2, measures=[name])


FILE = """
from ethbrake_marl import Part


def gap(game, alert, last):
    '''Last gap ahead of Vehicle 2, m.'''
    return last.gaps_m[:, 0]


class Pushes:
    def __init__(self, game, alert):
        self.steps = 0 * alert.steps

    def see(self, before, step, after):
        if step is not None:
            self.steps += (after.gaps_m[:, 0] == 0.0) & ~before.ended

    def result(self, last):
        return self.steps


def pushes(game, alert):
    '''Steps that end in contact.'''
    return Pushes(game, alert)


class Mild:
    name, knows = "mild", "own sensors"

    def begin(self, alert, body):
        return None

    def act(self, state, memory, body):
        return -2.0 + 0.0 * state.time_s, memory


steps = Part(watch=pushes, unit="steps")
coloured = Part(gap, colour="red")
number = 3
"""


def test_agents_and_measures_of_a_python_file__run_in_every_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MEASURES, "loaded", dict(MEASURES.loaded))
    monkeypatch.setattr(evaluating, "CHUNK", 5)
    file = tmp_path / "mine.py"
    file.write_text(FILE)
    names, agents = f"{file}:gap,{file}:steps", {"mild": f"{file}:Mild", "constant": "constant:2"}
    one, two = (eb.evaluate("paper-random", agents, episodes=10, measures=names, jobs=jobs) for jobs in (1, 2))
    for name in ("gap", "steps"):
        assert one["mild"][name].tolist() == two["mild"][name].tolist() == two["constant"][name].tolist()
    assert {each.name: each.unit for each in one.measures[-2:]} == {"gap": "1", "steps": "steps"}
    assert "mine.py" in one.about["versions"]
    with refused("does not define 'gap_m'"):
        measures_called(f"{file}:gap_m")
    with refused("measure 'number': give one function"):
        measures_called([f"{file}:number"])
    with refused("measure 'coloured': got an unexpected keyword argument 'colour'"):
        measures_called([f"{file}:coloured"])


def test_measures_of_two_files_with_one_name__stand_side_by_side_and_one_after_the_other(empty_folder: Path) -> None:
    near = "near = Part(near, statistics=[Statistic('near_rate', 'rate', 'Near')])\n"
    for file, value in (("mine.py", 1.0), ("b/mine.py", 2.0)):
        Path(file).parent.mkdir(exist_ok=True)
        text = f"def worst(game, alert, last):\n    'A number.'\n    return 0.0 * last.time_s + {value}\n"
        text += f"def near(game, alert, last):\n    'Whether.'\n    return last.time_s < {10 * value - 10}\n"
        imports = "from ethbrake_marl import Part\nfrom ethbrake_marl.evaluation.measures import Statistic\n"
        Path(file).write_text(imports + text + near)
    for file, value in (("mine.py", 1.0), ("b/mine.py", 2.0)):
        assert eb.evaluate("paper-random", "coast", episodes=2, measures=f"{file}:worst")["coast"]["worst"][0] == value
    names = "mine.py:worst,b/mine.py:worst,mine.py:near,b/mine.py:near,./mine.py:worst"
    result = eb.evaluate("paper-random", "coast", episodes=2, measures=names)
    assert [each.name for each in result.measures[-4:]] == names.split(",")[:4]
    (row,) = table = summarise(result)
    keys = ("mine.py:worst", "b/mine.py:worst", "mine.py:near_rate", "b/mine.py:near_rate")
    assert [row.estimates[key].value for key in keys] == [1.0, 2.0, 0.0, 1.0]  # type: ignore[union-attr]
    assert table.sheet().names[6:8] == ["mine.py:near_rate", "b/mine.py:near_rate"]
    assert {"Near (mine.py)", "Near (b/mine.py)"} < table.meanings().keys()
    assert [cells[0] for cells in table.measures().rows] == ["mine.py:worst (1)", "b/mine.py:worst (1)"]  # type: ignore[union-attr]


def test_measures__with_one_statistic_are_refused() -> None:
    two = [Measure(name, lambda game, alert, last: last.collided, "", "", (Statistic("hit"),)) for name in ("a", "b")]
    scenario, game = open_game(PAIR)
    with refused("measures 'a' and 'b': both have the statistic 'hit'; give one of them another key"):
        evaluate_teams(scenario.draw(2, 7), teams(FULL_BRAKE), game, two)


class Reporting:
    """Brakes fully, and reports one measure as given."""

    name, knows = "reporting", "own sensors"

    def __init__(self, report: Any) -> None:
        self.report = report

    def begin(self, alert: State, body: int) -> Any:
        return np.full(alert.n, float(body))

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        return -state.braking_capacity_mps2[:, body - 1], memory

    def measures(self, last: State, memory: Any, body: int) -> Any:
        return self.report(last, memory)


def test_an_agent__reports_measures_of_its_own() -> None:
    reporting = Reporting(lambda last, memory: {"mine": 2.0 * memory, "speeds": last.speeds_mps})
    result = eb.evaluate(PAIR, {"reporting": reporting, "full": "full_brake"}, episodes=4)
    assert result["reporting"]["mine"].tolist() == [4.0] * 4
    assert result["reporting"]["speeds_2"].tolist() == [0.0] * 4
    assert not {"mine", "speeds_2"} & result["full"].keys()
    reported, braking = summarise(result)
    assert reported["mine"].value == 4.0 and braking["mine"] is None
    assert reported["mine"].interval is None  # nothing is random
    assert result.measure_of("mine").meaning == result.measure_of("speeds_2").meaning == evaluating.REPORTED


def test_agents__that_report_the_same_measure_have_its_mean_but_no_common_prediction() -> None:
    reporting = Reporting(lambda last, memory: {"mine": memory, "predicted_harm": memory})
    both = {"vehicle_2": reporting, "vehicle_3": reporting}
    columns = eb.evaluate("cooperation-3-pair", {"both": both}, episodes=2)["both"]
    assert columns["mine"].tolist() == [2.5, 2.5] and "predicted_harm" not in columns
    team = eb.shield(eb.Team.of(both, "both"))
    shielded = eb.evaluate("cooperation-3-pair", {"both": team}, episodes=2)["both"]
    assert shielded["mine"].tolist() == [2.5, 2.5] and shielded["replaced_none"].dtype == bool


def test_a_shield_and_a_layer__report_measures_of_their_own() -> None:
    class Quiet(StepShield):
        def measures(self, game: Any, last: State) -> Any:
            return {"certified": last.memories["shield"].settles}

    class Fog(eb.Layer):
        def measures(self, last: State) -> Any:
            return {"fog": np.full(last.n, 0.5)}

    scenario, game = open_game("paper-random")
    quiet, bare = Team("quiet", {2: FULL_BRAKE}, Quiet({2: FULL_BRAKE})), Team("bare", {2: FULL_BRAKE})
    result = evaluate_teams(scenario.draw(3, 7), {"quiet": quiet, "bare": bare}, game.with_layers([Fog()]))
    assert result["quiet"]["certified"].all() and "replaced_none" not in result["quiet"]
    assert result["bare"]["fog"].tolist() == result["quiet"]["fog"].tolist() == [0.5] * 3


@pytest.mark.parametrize(
    ("report", "message"),
    [
        (
            lambda last, memory: {"total_harm": memory},
            "team 'reporting': reports the measure 'total_harm', which is in",
        ),
        (lambda last, memory: {"mine": memory[:1]}, "measure 'mine': its function returned float64 of shape (1,)"),
        (lambda last, memory: 1 / 0, "vehicle_2: measures fails: ZeroDivisionError"),
    ],
    ids=["in use", "shape", "error"],
)
def test_a_bad_report__is_refused(report: Any, message: str) -> None:
    with pytest.raises(EthBrakeError, match=re.escape(message)):
        eb.evaluate(PAIR, {"reporting": Reporting(report)}, episodes=2)


@pytest.mark.parametrize(
    ("scenario", "pushed"),
    [
        ("paper-random-obstacle", {"pushed_m_1", "pushed_m_1_far", "pushed_m_3"}),
        ({**PAIR, "roles": {"vehicle_1": "learner", "vehicle_2": "learner"}, "obstacle_gap_m": 60.0}, set()),
    ],
)
def test_measures__that_are_not_asked_for_or_not_defined_have_no_column(scenario: Any, pushed: set[str]) -> None:
    asked = ["still_moving", "pushed_m"]
    result = eb.evaluate(scenario, "full_brake", episodes=2, measures=asked)
    names = {each.name for each in result.measures if each.name not in result["full_brake"]}
    assert names == {"outside", "predicted_harm", "replaced", "pushed_m"}  # pushed_m has columns of vehicles alone
    assert {column for column in result["full_brake"] if column.startswith("pushed_m")} == pushed
    usual = eb.evaluate(scenario, "full_brake", episodes=2)["full_brake"]
    assert not any(column.startswith(tuple(asked)) for column in usual)


def test_terms_of_ones_own__are_summed_and_names_are_used_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for registry in (TERMS, MEASURES):
        monkeypatch.setattr(registry, "loaded", dict(registry.loaded))
    register_term("moving", doc(lambda before, step, after: (after.speeds_mps > 0.0) * step.time_step_s), unit="s")
    assert 3.0 < evaluated(PAIR, 2, [FULL_BRAKE], ["moving"])["full_brake"]["moving_1"][0] <= 3.8
    register_term("decisions", doc(lambda before, step, after: np.ones(after.n)))
    counted = evaluated("paper-random", 9, [FULL_BRAKE], ["decisions"])["full_brake"]
    assert counted["decisions"].tolist() == np.round((counted["end_s"] - 0.5) / 0.1).tolist()
    assert np.ptp(counted["end_s"]) > 0.0
    with refused("already in use", AlreadyExists):
        register_measure("moving", doc(lambda game, alert, last: last.time_s))
    register_measure("still", doc(lambda game, alert, last: last.time_s))
    register_term("still", doc(lambda before, step, after: step.time_step_s * ~after.collided))
    with refused("measure 'still': a measure and a term of the reward have this name", AlreadyExists):
        measures_called("still")
    assert [each.name for each in measures_called("pushed_m,pushed_mps,pushed_m,total_harm")] == [
        "pushed_m", "pushed_mps", "total_harm",
    ]  # fmt: skip
    with refused("unknown measure 'pushed_n'; did you mean 'pushed_m'?", UnknownName):
        measures_called(["pushed_n"])
    with refused("social needs an angle from 0 to 90"):
        evaluated(PAIR, 2, measures=["social:99"])


# ---- evaluations


def test_result__is_the_same_in_chunks_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    measures, done = ["pushed_m", "risk"], list[int]()
    whole = evaluated("paper-random", 50, measures=measures)
    monkeypatch.setattr(evaluating, "CHUNK", 17)
    parts = evaluated("paper-random", 50, measures=measures, on_done=done.append)
    assert done == [17, 34, 50] and parts.about == whole.about
    for agent, columns in whole.columns.items():
        for name, column in columns.items():
            assert parts[agent][name].dtype == column.dtype and (parts[agent][name] == column).all(), name


def test_identity__changes_with_worlds_and_scenario_alone() -> None:
    scenario, game = open_game("paper-random")
    about = evaluated("paper-random", 5, [FULL_BRAKE]).about
    assert evaluated("paper-random", 5, [GENTLE]).about == about
    assert {"python", "ethbrake-marl", "numba", "numpy"} <= about["versions"].keys() and len(
        about["physics_digest"]
    ) == 16
    drawn = scenario.draw(5, 7)
    given = drawn.worlds._replace(clock=0 * drawn.worlds.clock)  # without their numbers
    assert evaluate_teams(given, teams(GENTLE), game).about["worlds_sha256"] == about["worlds_sha256"]
    for other in (evaluated("paper-random", 6), evaluated(scenario.replace(restitution=0.2).declared(), 5)):
        assert other.about["worlds_sha256"] != about["worlds_sha256"]
    for key, value, same in (("horizon_s", 5.0, False), ("title", "Mine", True)):
        other = evaluated(scenario.replace(**{key: value}).declared(), 5)
        assert (other.about["scenario_sha256"] == about["scenario_sha256"]) == same


def test_table_and_parts__of_a_result() -> None:
    result = evaluated("paper-random", 30, [Foreteller(), FULL_BRAKE])
    table = result.arrays()
    assert {len(column) for column in table.values()} == {60}
    assert table["world"].tolist() == [*range(30)] * 2 and np.isnan(table["predicted_harm"][30:]).all()
    assert table["total_harm"][30:].tolist() == result["full_brake"]["total_harm"].tolist()
    some = result.take(result.worlds["gap_1_m"] > 7.5)
    assert some.n == int((result.worlds["gap_1_m"] > 7.5).sum()) and (some.worlds["gap_1_m"] > 7.5).all()
    assert some["full_brake"]["total_harm"].tolist() == table["total_harm"][30:][table["gap_1_m"][30:] > 7.5].tolist()
    frame = pytest.importorskip("pandas") and result.to_pandas()
    assert frame.groupby("agent").total_harm.mean()["full_brake"] == pytest.approx(table["total_harm"][30:].mean())


def test_door__takes_worlds_or_a_scenario() -> None:
    worlds = load_scenario("paper-random").sample(3, 7)
    given = eb.evaluate(worlds, "coast,full_brake", scenario="paper-random")
    drawn = eb.evaluate("paper-random", "coast,full_brake", episodes=3)
    assert (given.about["seed"], drawn.about["seed"]) == (None, 7) and "coast" in given and "ppo" not in given
    assert [*given] == ["coast", "full_brake"] == [*drawn]
    assert given["coast"]["total_harm"].tolist() == drawn["coast"]["total_harm"].tolist()


COAST_TWICE = partial(eb.evaluate, agents="coast", episodes=2)
DOOR: dict[str, Callable[[], Any]] = {
    "unknown agent in this result 'cost'; did you mean 'coast'": lambda: COAST_TWICE()["cost"],
    "there is no world among these rows": lambda: COAST_TWICE().take([]),
    "jobs = 0": lambda: COAST_TWICE(jobs=0),
    "scenario: is given twice": lambda: COAST_TWICE("paper-random", scenario="paper-random"),
    "worlds need their scenario": lambda: COAST_TWICE(load_scenario("paper-random").sample(3, 7)),
    **{f"the name {name!r}": partial(COAST_TWICE, agents={name: "coast"}) for name in ("a\nb",)},
}


@pytest.mark.parametrize("message", DOOR, ids=ascii)
def test_door__refuses(message: str) -> None:
    with refused(message, UnknownName if message.startswith("unknown") else InvalidInput):
        DOOR[message]()


def test_our_agents__are_sent_to_processes_and_report_what_they_predict(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario, game = open_game("paper-random")
    ppo = {2: LearnedAgent(load_shipped("ppo"), "ppo")}
    agents = {
        "e_v2x_bm": Team("e", {2: EV2XBM(game.settings)}), "ppo": Team("p", ppo),
        "ppo+step": Team("s", ppo, StepShield(ppo)), "ppo+episode": Team("a", ppo, EpisodeShield(ppo)),
    }  # fmt: skip
    monkeypatch.setattr(evaluating, "CHUNK", 40)
    one, two = (evaluate_teams(scenario.draw(80, 7), agents, game, jobs=jobs) for jobs in (1, 2))
    for name, columns in one.columns.items():
        assert all((two[name][key] == column).all() for key, column in columns.items())
    assert one["e_v2x_bm"]["predicted_harm"].tolist() == one["e_v2x_bm"]["honest_cost"].tolist()
    assert one["ppo+step"]["replaced_none"].tolist() == (one["ppo+step"]["replaced_actions"] == 0).tolist()
    least = np.minimum(one["ppo"]["honest_cost"], one["e_v2x_bm"]["honest_cost"])
    assert one["ppo+episode"]["honest_cost"].tolist() == least.tolist()
    assert summarise(one)[3]["policy_share"] == rate(one["ppo+episode"]["replaced_none"])
    assert one.knows["ppo+step"] == "messages + true model" and one.policies["ppo+step"] == one.policies["ppo"] != {}


def test_golden_rows() -> None:
    harm = mean(evaluated("paper-random", 10_000, [FULL_BRAKE])["full_brake"]["first_impact_harm"])
    assert harm.in_words() == "24.19 [23.85, 24.53]"
    for name, first, total in (("paper-random", "23.64", "24.86"), ("paper-random-obstacle", "33.31", "50.00")):
        row = summarise(evaluated(name, 2_000, [FULL_BRAKE]))[0]
        shown = [row[key].value for key in ("first_impact_harm", "total_harm", "collision_rate")]  # type: ignore[union-attr]
        assert [f"{shown[0]:.2f}", f"{shown[1]:.2f}", f"{shown[2]:.1%}"] == [first, total, "85.5%"]


def test_result__says_who_knows_what_and_what_was_evaluated() -> None:
    scenario, game = open_game("cooperation-2-blocked")
    agents = {**teams(FULL_BRAKE, Careless()), "both": Team("both", {2: FULL_BRAKE._replace(knows="true model")})}
    result = evaluate_teams(scenario.draw(12, 7), agents, game)
    assert result.knows == {"full_brake": "own sensors", "careless": "not stated", "both": "true model"}
    share = float(result.worlds["hidden"].mean())
    table = summarise(result)
    assert 0.0 < share < 1.0 and [row.sees_through for row in table] == [False, False, True]
    text = " ".join(str(table).split())
    assert f"† In {100 * share:.1f} % of these worlds the V2X channel hides something" in text
    assert "both: reads hidden values nevertheless" in text
    assert not evaluated("paper-random", 12).worlds["hidden"].any()


class Wild(Careless):
    name = "wild"

    def act(self, state: State, memory: Any, body: int) -> Any:
        return np.full(state.n, np.nan), memory


class Local(Careless):
    def __init__(self) -> None:
        self.lock = threading.Lock()


MINE = teams(FULL_BRAKE)
REFUSED: dict[str, Callable[[Any, Game], object]] = {
    "agents = {}: must be a mapping from names to teams": lambda drawn, game: evaluate_teams(drawn, {}, game),
    "must be a mapping from names to teams, for instance": lambda drawn, game: evaluate_teams(
        drawn, {"a": FULL_BRAKE}, game
    ),  # type: ignore[dict-item]
    "3 worlds of 3 vehicles; must be one or more worlds of 3 vehicles at": lambda drawn, game: evaluate_teams(
        game.reset(drawn.worlds), MINE, game
    ),
    "team 'x': drives vehicle_1; must drive exactly vehicle_2": lambda drawn, game: evaluate_teams(
        drawn, {"a": Team("x", {1: FULL_BRAKE})}, game
    ),
    "agent 'wild', world 0, vehicle_2 at 0.50 s: command nan m/s2": lambda drawn, game: evaluate_teams(
        drawn, teams(Wild()), game
    ),
    "this cannot be sent to another process (cannot": lambda drawn, game: evaluate_teams(
        drawn, teams(Local()), game, jobs=2
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_evaluation__that_is_refused(message: str) -> None:
    scenario, game = open_game("paper-random")
    with refused(message):
        REFUSED[message](scenario.draw(3, 7), game)


def test_failed_physics__raises_with_the_number_of_the_world() -> None:
    scenario, game = open_game("paper-random")
    worlds = scenario.sample(4, 7, first=100)
    line = worlds.line.copy()
    line[2, GAP, 1] = np.nan
    with refused("world 102: a check of the physics failed", PhysicsError):
        evaluate_teams(worlds._replace(line=line), teams(FULL_BRAKE), game)


class Touching(Careless):
    """Changes its memory in place."""

    name, knows = "touching", "own sensors"

    def begin(self, alert: State, body: int) -> Any:
        return np.zeros(alert.n)

    def act(self, state: State, memory: Any, body: int) -> Any:
        memory += 1.0
        return np.minimum(memory - 6.0, 0.0), memory


def test_what_others_bring__cannot_change_what_happens() -> None:
    """Measures, watches and agents see the arrays of a running episode, and cannot write to them."""
    scenario, game = open_game("paper-random")
    worlds = scenario.draw(3, 7)
    with refused("agent 'touching', vehicle_2: act fails: ValueError"):
        evaluate_teams(worlds, teams(Touching()), game)

    def heavier(game: Any, alert: State, last: State) -> Any:
        """Mass."""
        mass = alert.mass_t
        mass *= 2.0
        return mass

    class Slowing:
        def __init__(self, game: Any, alert: State) -> None:
            pass

        def see(self, before: State, step: Any, after: State) -> None:
            speeds = after.speeds_mps
            speeds *= 0.9

        def result(self, last: State) -> Any:
            return last.time_s

    for measure in (Measure("heavier", heavier), Measure("slowing", watch=Slowing)):
        with pytest.raises(InvalidInput, match=r"its function fails: ValueError: .*read-only"):
            evaluate_teams(worlds, teams(GENTLE), game, [measure])
    for name in ("world", "gap_1_m"):
        with refused(f"measure '{name}': is the name of a column of the worlds"):
            evaluate_teams(worlds, teams(GENTLE), game, [Measure(name, lambda game, alert, last: last.time_s)])


def test_evaluate__refuses_measures_that_are_no_names_and_a_list_beside_worlds() -> None:
    with refused("measures = 5: must be names of measures"):
        eb.evaluate("paper-random", "coast", episodes=1, measures=5)
    worlds = eb.load_scenario("paper-random").sample(2, 7)
    for given in ({"episodes": 1}, {"seed": 3}):
        with refused("leave them out if worlds are given"):
            eb.evaluate(worlds, "coast", scenario="paper-random", **given)
    with pytest.raises(UnknownName) as told:
        eb.evaluate("paper-random", "coast", episodes=1, measures="harmm")
    assert str(told.value).count(" pushed_m,") <= 1
