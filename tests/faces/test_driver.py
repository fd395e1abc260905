"""An agent that drives a vehicle of another simulator decides there as it does here."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.motion.layout import HIT
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")
CASES = [
    *[("paper-random", agent) for agent in ("ppo", "sac", "full_brake", "constant:3", "e_v2x_bm:pairwise", "e_v2x_bm")],
    *[(name, "e_v2x_bm") for name in ("paper-random-obstacle", "paper-random-buildup", "realistic-motorway")],
    *[(name, "e_v2x_bm") for name in ("cooperation-2-five", "realistic-mixed-buildup", "stress-wide")],
]


def drive_by_hand(scenario: Any, agent: Any, n: int = 60) -> float:
    """Largest difference between a driver's commands and those of the same agent in the same episodes, m/s2.

    Our own motion is the other simulator.
    """
    loaded, game = eb.open_game(scenario)
    worlds = loaded.sample(n, seed=7)
    body = int(game.settings.learners[0])
    driver = eb.Driver(agent, worlds, scenario=loaded, vehicle=f"vehicle_{body}")
    team = eb.Team.of({f"vehicle_{body}": eb.make_agent(agent, scenario=loaded)}, agent)
    states = [state for _, state in eb.play(game, worlds, team)]
    assert (driver.first_s == states[0].time_s).all() and driver.time_step_s == loaded.time_step_s
    worst, decisions = 0.0, 0
    for state, after in pairwise(states):
        has_obstacle = np.isfinite(state.obstacle_gap_m).all()
        command = driver.decide(
            state.time_s, state.gaps_m, state.speeds_mps, state.forces_mps2, state.pair_hit,
            commands_mps2=state.commands_mps2, obstacle_gap_m=state.obstacle_gap_m if has_obstacle else None,
            obstacle_hit=state.line[:, HIT, 0],
        )  # fmt: skip
        moving = ~state.ended
        assert (driver.state.commands_mps2 == state.commands_mps2)[moving].all()
        worst = max(worst, float(np.abs(command - after.commands_mps2[:, body - 1])[moving].max(initial=0.0)))
        decisions += int(moving.sum())
    assert decisions > 10 * n
    return worst


@pytest.mark.parametrize(("scenario", "agent"), CASES)
def test_driver__decides_as_the_agent_does_in_an_episode__bit_for_bit(scenario: str, agent: str) -> None:
    assert drive_by_hand(scenario, agent) == 0.0


class Remembers:
    """Coasts, and then brakes by a tenth of m/s2 more at each decision: a memory, and a count of the decisions."""

    name, knows = "remembers", "own sensors"

    def begin(self, alert: eb.State, body: int) -> Any:
        return np.zeros(alert.n)

    def act(self, state: eb.State, memory: Any, body: int) -> tuple[Any, Any]:
        assert (state.steps == memory).all()
        return -0.1 * memory, memory + 1.0


MEASURED = ([[6.0, -0.001]], [[17.0, 20.0, 21.0]], [[-6.5, 0.0, 0.0]], [[False, True]])


def driver_of(agent: Any = "full_brake", scenario: Any = PAPER, **settings: Any) -> eb.Driver:
    return eb.Driver(agent, scenario.sample(1, seed=7), scenario=scenario, **settings)


def test_driver__keeps_memory_and_last_command__and_shows_what_was_measured() -> None:
    driver = driver_of(Remembers())
    assert [float(driver.decide(0.5 + 0.1 * k, *MEASURED)[0]) for k in range(3)] == [0.0, -0.1, -0.2]
    state = driver.state
    assert state.gaps_m.tolist() == [[6.0, 0.0]] and state.pair_hit.tolist() == [[False, True]]
    assert state.speeds_mps.tolist() == [[17.0, 20.0, 21.0]] and state.forces_mps2.tolist() == [[-6.5, 0.0, 0.0]]
    assert state.time_s.tolist() == [0.7] and state.commands_mps2[0, 1] == -0.1
    driver.decide(0.8, *MEASURED)[:] = np.nan  # the caller's own
    assert driver.decide(0.9, *MEASURED).tolist() == [-0.4]


def test_driver__drives_one_of_several_learners() -> None:
    pair = eb.load_scenario("cooperation-3-pair")
    agents = {"vehicle_2": "coast", "vehicle_3": "full_brake"}
    driver = driver_of(agents, pair, vehicle="vehicle_3")
    assert driver.decide(driver.first_s, *MEASURED) == -driver.state.braking_capacity_mps2[:, 2]


def test_driver__refusals() -> None:
    driver = driver_of()
    gaps, speeds, accelerations, hit = MEASURED
    with refused("Driver.decide: gaps_m has shape (2,): must have shape (1, 2)"):
        driver.decide(0.5, gaps[0], speeds, accelerations, hit)
    driver.decide(0.7, *MEASURED)
    with refused("Driver.decide: time_s = 0.6: must be 0.7 or later"):
        driver.decide(0.6, *MEASURED)
    with refused("Driver: agent 'ppo+step' has a shield, whose bound"):
        driver_of("ppo+step")
    with refused("agent 'ladder': is the name of a group of agents"):
        driver_of("ladder")
    with refused("unknown learner 'vehicle_3'; did you mean 'vehicle_2'?"):
        driver_of(vehicle="vehicle_3")


INVALID = -1073741824.0  # of SUMO
VALUES: dict[str, Any] = dict(
    zip(("time_s", "gaps_m", "speeds_mps", "accelerations_mps2", "hit"), (0.5, *MEASURED), strict=True)
)
VALUES |= {"hit": [[False, False]], "commands_mps2": [[-6.0, 0.0, 0.0]], "obstacle_gap_m": [30.0], "obstacle_hit": [0]}


@pytest.mark.parametrize("name", VALUES)
@pytest.mark.parametrize("value", [INVALID, np.nan, np.inf, -np.inf, 1e6, -999.0])
def test_driver__refuses_marks_of_missing_values_and_leaves_its_state(name: str, value: float) -> None:
    driver, bad = driver_of(Remembers(), eb.load_scenario("paper-random-obstacle")), np.array(VALUES[name], float)
    bad[(..., -1) if bad.ndim else ()] = value
    where = str([0] * (bad.ndim - 1) + [bad.shape[-1] - 1]) if bad.ndim else ""
    with refused(f"Driver.decide: {name}{where} = {value:g}: must be finite and in ["):
        driver.decide(**VALUES | {name: bad})
    assert [driver.decide(**VALUES | {"time_s": time_s}).tolist() for time_s in (0.5, 0.6)] == [[0.0], [-0.1]]


@pytest.mark.parametrize("name", VALUES)
def test_driver__refuses_what_is_no_number(name: str) -> None:
    shape = np.shape(VALUES[name])
    masked = np.ma.masked_array(np.array(VALUES[name], float), np.ones(shape, bool))
    for value in (np.full(shape, "17"), np.full(shape, None), masked, [[1.0], [1.0, 2.0]]):
        with refused(f"Driver.decide: {name} = "):
            driver_of().decide(**VALUES | {name: value})


def test_driver__speeds_below_0_only_after_an_impact() -> None:
    back = VALUES | {"speeds_mps": [[17.0, -0.5, 21.0]]}
    with refused("Driver.decide: speeds_mps[0, 1] is below 0: must be at least 0 m/s in a world without an impact"):
        driver_of().decide(**back)
    for impact in ({"hit": [[False, True]]}, {"obstacle_hit": True}):
        driver = driver_of()
        driver.decide(**back | impact)
        assert driver.state.speeds_mps[0, 1] == -0.5


def test_driver__first_s_is_the_caller_s_own() -> None:
    driver = driver_of()
    driver.first_s += 9.0
    assert driver.decide(0.5, *MEASURED).tolist() == [-7.0]
