"""Random scripts: each world's own generator, and refusal of a script that answers differently when asked twice."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import AgentFailed, InvalidInput
from ethbrake_marl.evaluation.evaluate import evaluate_teams
from ethbrake_marl.worlds.open_game import game_of
from ethbrake_marl.worlds.user_worlds import worlds_from_state

PAPER = eb.load_scenario("paper-random").replace(early_impacts="keep")
FIXED = PAPER.replace(gaps_m=8, line_speed_mps=20, speed_deviations_mps=0, braking_capacity_mps2=6, latency_s=0.5)


class Drawing:
    """Brakes fully after a time that ``draw(alert, body)`` returns."""

    name, knows = "drawing", "own sensors"

    def __init__(self, draw: Callable[[State, int], Any]) -> None:
        self.draw = draw

    def begin(self, alert: State, body: int) -> Any:
        return self.draw(alert, body)

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        after = memory if isinstance(memory, np.ndarray) else np.zeros(state.n)
        return np.where(state.time_s >= after, -state.braking_capacity_mps2[:, body - 1], 0.0), memory


class Braking(Drawing):
    name = "braking"


def from_generators(alert: State, body: int) -> Any:
    return np.array([generator.lognormal(0.0, 0.4) for generator in alert.generators(body)])


def harm(scenario: eb.Scenario, draw: Callable[[State, int], Any], n: int = 40, agents: int = 2) -> list[Any]:
    """Honest cost of full braking under each of several names, in worlds where Vehicle 3 is a drawing script."""
    _, game = game_of(scenario, {3: Drawing(draw)})
    team = eb.Team.of({"vehicle_2": eb.make_agent("full_brake")}, "x")
    teams = {f"agent {k}": team for k in range(agents)}
    result = evaluate_teams(scenario.draw(n, 7), teams, game)
    return [result[name]["honest_cost"] for name in teams]


@pytest.mark.parametrize("scenario", [PAPER, FIXED, PAPER.replace(v2x="nominal")])
def test_generators__give_every_agent_the_same_emergencies(scenario: eb.Scenario) -> None:
    first, second = harm(scenario, from_generators)
    assert first.tobytes() == second.tobytes() and len(np.unique(first)) > 10
    assert harm(scenario, from_generators, n=10, agents=1)[0].tobytes() == first[:10].tobytes()


def test_generators__depend_on_seed_world_and_vehicle_alone() -> None:
    def numbers(worlds: State, body: int = 3) -> list[float]:
        return [generator.random() for generator in worlds.generators(body)]

    worlds = FIXED.sample(30, 7)
    expected = numbers(worlds)
    assert len({*expected, *numbers(worlds, 2), *numbers(FIXED.sample(30, 8))}) == 90
    assert numbers(worlds) == expected  # anew at each call
    assert numbers(worlds.take([20, 3])) == [expected[20], expected[3]]
    assert numbers(FIXED.sample(1, 7, first=12)) == [expected[12]]
    _, game = game_of(FIXED, {})
    assert numbers(game.reset(worlds)) == expected
    own = eb.worlds_from_table(FIXED, {"gap_1_m": [8.0, 8.0, 8.0]})
    assert len({*numbers(own)}) == 3 and numbers(worlds_from_state(FIXED, {})) == numbers(own)[:1]


RNG = np.random.default_rng(1)
DIFFERENT: dict[str, Callable[[State, int], Any]] = {
    "own generator": lambda alert, body: RNG.lognormal(size=alert.n),
    "generator without a seed": lambda alert, body: np.random.default_rng().random(alert.n),
    "whole numbers": lambda alert, body: RNG.integers(0, 1000, alert.n),
    "second of a tuple": lambda alert, body: (np.zeros(alert.n), RNG.random((alert.n, 2))),
    "in a mapping": lambda alert, body: {"time": RNG.random(alert.n), "none": None},
}
ALIKE: dict[str, Callable[[State, int], Any]] = {
    "nothing": lambda alert, body: None,
    "no number": lambda alert, body: np.full(alert.n, np.nan),
    "of the state": lambda alert, body: alert.speeds_mps[:, body - 1] / 20.0,
    "generators to keep": lambda alert, body: (np.array(alert.generators(body), object),),
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_script_that_draws_for_itself__is_refused_in_one_line(what: str) -> None:
    right = (
        r"'drawing', vehicle_3: begin answers differently for the same worlds; must draw random numbers from"
        r" alert\.generators\(body\) in begin, and keep them in its memory$"
    )
    with pytest.raises(AgentFailed, match=right) as caught:
        harm(PAPER, DIFFERENT[what])
    assert "\n" not in str(caught.value)
    with pytest.raises(AgentFailed, match="vehicle_2: begin answers differently"):
        eb.evaluate(PAPER, {"mine": Braking(DIFFERENT[what])}, episodes=5)
    _, game = game_of(PAPER, {3: Drawing(DIFFERENT[what])})
    with pytest.raises(AgentFailed, match="begin answers differently"):
        game.reset(PAPER.sample(1, 7))


class InAct(Drawing):
    """Draws in ``act`` what ``draw`` returns."""

    def begin(self, alert: State, body: int) -> Any:
        return None

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        return self.draw(state, body), memory


class InObject(InAct):
    """Draws in ``begin`` and remembers it in the object; without a seed."""

    def begin(self, alert: State, body: int) -> Any:
        self.after = RNG.lognormal(size=alert.n)

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        return np.where(state.time_s > self.after[: state.n], -2.0, 0.0), memory


def rarely(n: int) -> Any:
    return np.where(np.arange(n) == n - 1, RNG.random(n), 0.5)


RANDOM: dict[str, tuple[str, Any]] = {
    "in act": ("act", InAct(lambda state, body: -RNG.random(state.n))),
    "a list": ("act", InAct(lambda state, body: [*-RNG.random(state.n)])),
    "in act, late": ("act", InAct(lambda state, body: np.where(state.time_s < 2.0, 0.0, -RNG.random(state.n)))),
    "in the object": ("act", InObject(lambda state, body: None)),
    "in the last world": ("begin", Drawing(lambda alert, body: rarely(alert.n))),
    "in act, in the last world": ("act", InAct(lambda state, body: -rarely(state.n))),
}


@pytest.mark.parametrize("what", RANDOM)
@pytest.mark.parametrize("scenario", [PAPER, PAPER.replace(v2x="nominal")])
def test_script_that_draws_out_of_sight__is_refused(scenario: eb.Scenario, what: str) -> None:
    method, script = RANDOM[what]
    team = eb.Team.of({"vehicle_2": eb.make_agent("full_brake")}, "x")
    with pytest.raises(AgentFailed, match=f"'drawing', vehicle_3: {method} answers differently for the same worlds"):
        evaluate_teams(scenario.draw(40, 7), {"x": team}, game_of(scenario, {3: script})[1])


def test_agent__may_act_at_random() -> None:
    mine = InAct(lambda state, body: -RNG.random(state.n))
    assert eb.evaluate(PAPER, {"mine": mine}, episodes=5)["mine"]["honest_cost"].shape == (5,)


@pytest.mark.parametrize("what", ALIKE)
def test_script_that_answers_alike__is_not(what: str) -> None:
    first, second = harm(PAPER, ALIKE[what], n=5)
    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize("body", [0, 4, -1, 1.5, True, None])
def test_generators__of_a_vehicle_that_the_line_lacks_are_refused(body: Any) -> None:
    with pytest.raises(InvalidInput, match=r"body = .*: must be a whole number in 1\.\.3"):
        eb.load_scenario("paper-random").sample(1, 7).generators(body)
