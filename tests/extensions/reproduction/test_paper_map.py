"""The paper's fixed-step map: impacts by hand, a slow reference, figures of version 0.5, and what it refuses."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.reproduction.paper_map import sample
from ethbrake_marl.motion.layout import COUNT, GAP, HIT, SPEED
from tests.refused import refused

SCENARIO = eb.load_scenario("paper-random-map")


def at_a_sample(gaps, speeds) -> eb.State:
    """One world of the map, in which nobody commands anything, at a sample with these gaps and speeds."""
    state = SCENARIO.sample(1, 7)
    line, wanted, clock = state.line.copy(), np.zeros(state.wanted.shape), state.clock.copy()
    line[0, GAP, 1:3], line[0, SPEED, 1:] = gaps, speeds
    clock[0, 0] = clock[0, 1] = 2.0
    return state._replace(line=line, wanted=wanted, clock=clock)


def test_impact__by_hand() -> None:
    """Masses 4.5 and 5.5 t, e = 0.1, closing at 10 m/s: changes of 0.55 * 1.1 * 10 and 0.45 * 1.1 * 10 m/s."""
    after = sample(at_a_sample([-0.5, 50.0], [10.0, 20.0, 15.0]), 0.1)
    assert after.speeds_mps[0].tolist() == pytest.approx([16.05, 15.05, 15.0])
    assert after.harm("first")[0] == after.harm("total")[0] == 100.0
    assert after.gaps_m[0].tolist() == pytest.approx([-0.5 + 0.1 * (16.05 - 15.05), 50.0 + 0.1 * (15.05 - 15.0)])
    again = sample(at_a_sample([-0.5, 50.0], [10.0, 9.0, 9.0]), 0.1)  # overlapping, but separating
    assert not again.line[0, COUNT].any() and again.harm("total")[0] == 0.0


def test_impact__second_of_a_pair_is_total_harm_only_and_vehicles_stop_at_0() -> None:
    state = at_a_sample([0.0, 50.0], [10.0, 12.0, 0.4])
    state.line[0, HIT, 1], state.wanted[0, 3] = 1.0, -6.0
    after = sample(state, 0.1)
    assert (after.harm("first")[0], after.harm("total")[0], after.speeds_mps[0, 2]) == (0.0, 4.0, 0.0)


def test_impacts__of_one_sample_go_from_the_rear_to_the_front() -> None:
    """Vehicle 2 first gets 5.9 * 1.1 * 5 / 11.4 = 2.846 m/s from Vehicle 3, and then strikes Vehicle 1 with more."""
    after = sample(at_a_sample([0.0, 0.0], [10.0, 12.0, 17.0]), 0.1)
    pushed = 2.0 + 5.9 * 1.1 * 5.0 / 11.4
    assert after.pair_harm("total")[0].tolist() == pytest.approx([pushed * pushed, 25.0])


@pytest.mark.parametrize(
    ("step_s", "agent", "harm"),
    [(0.1, "full_brake", 23.479299909088144), (0.2, "full_brake", 29.585014941952608),
     (0.25, "full_brake", 36.812182133604814), (0.5, "full_brake", 35.79459513033634),
     (0.1, "constant:5", 27.97726529370422)],
)  # fmt: skip
def test_map__has_the_figures_of_version_0_5(step_s: float, agent: str, harm: float) -> None:
    result = eb.evaluate(SCENARIO.replace(time_step_s=step_s), agent, episodes=2_000)
    assert result[agent]["first_impact_harm"].mean() == harm


def test_worlds__are_those_of_the_exact_scenario() -> None:
    exact, mapped = (eb.load_scenario(name).sample(50, 7) for name in ("paper-random", "paper-random-map"))
    for one, other in zip(exact[:5], mapped[:5], strict=True):
        assert np.array_equal(one, other)


def by_hand(start: eb.State, actions: np.ndarray) -> tuple[list[float], list[float], float]:
    """Drive one world from its first decision, with places in place of gaps: gaps, speeds, total harm at the end."""
    h, mass, capacity = 0.1, start.mass_t[0].tolist(), start.braking_capacity_mps2[0].tolist()
    places, speeds, harm = [0.0, *(-np.cumsum(start.gaps_m[0])).tolist()], start.speeds_mps[0].tolist(), 0.0
    for n, action in enumerate(actions):
        if 0.5 + n * h > 8.0 - 1e-9 or not any(speeds):
            break
        for front, rear in ((1, 2), (0, 1)):
            closing = speeds[rear] - speeds[front]
            if places[front] <= places[rear] and closing > 0.0:
                harm += closing * closing
                speeds[front] += mass[rear] * 1.1 * closing / (mass[front] + mass[rear])
                speeds[rear] -= mass[front] * 1.1 * closing / (mass[front] + mass[rear])
        for i, command in enumerate((-1.0, action, -1.0 if 0.5 + n * h > 0.8 - 1e-9 else 0.0)):
            before, change = speeds[i], h * command * capacity[i]
            speeds[i] = max(before + change, 0.0)
            if before < 0.0:  # brakes act against the motion
                speeds[i] = min(before - change, 0.0) if change < 0.0 else before + change
            places[i] += h * (before + speeds[i]) / 2.0
    return [places[0] - places[1], places[1] - places[2]], speeds, harm


def test_map__is_that_of_a_slow_reference() -> None:
    _, game = eb.open_game(SCENARIO)
    state = start = game.reset(SCENARIO.sample(60, 7))
    actions = np.random.default_rng(7).uniform(-1.0, 1.0, (75, 60, 1))
    for each in actions:
        state, _ = game.step(state, each)
    assert state.ended.all() and state.collided.mean() > 0.5 and (state.gaps_m < 0.0).any()
    for k in range(60):
        gaps, speeds, harm = by_hand(start.take([k]), actions[:, k, 0])
        assert state.gaps_m[k] == pytest.approx(gaps, abs=1e-9)
        assert state.speeds_mps[k] == pytest.approx(speeds, abs=1e-9)
        assert state.harm("total")[k] == pytest.approx(harm, abs=1e-9)


def test_collision__counts_each_sample_of_an_overlap() -> None:
    """Minus k_i w_i^2 of the pairs that overlap when the step begins, closing or not."""
    reward = {"harm": 0.0, "collision": 1.0, "k_energy": [1.0, 3.0]}
    _, game = eb.open_game(SCENARIO, reward=reward)
    state, counted = game.reset(SCENARIO.sample(40, 7)), 0
    while not state.ended.all():
        before = state
        state, step = game.step(state, np.full((40, 1), -0.2))
        squares = np.where(before.gaps_m <= 0.0, np.diff(before.speeds_mps, axis=1) ** 2, 0.0)
        expected = np.where(before.ended, 0.0, -squares @ np.array([1.0, 3.0]))
        assert step.reward[:, 1] == pytest.approx(expected, abs=1e-12)
        counted += int((expected < 0.0).sum())
    assert counted > 80  # more samples than pairs


def test_step__does_not_change_the_state_and_nothing_happens_after_the_end() -> None:
    _, game = eb.open_game(SCENARIO)
    state = game.reset(SCENARIO.sample(20, 7))
    line = state.line.copy()
    game.step(state, np.full((20, 1), -1.0))
    assert np.array_equal(state.line, line)
    while not state.ended.all():
        state, _ = game.step(state, np.full((20, 1), -1.0))
    after, step = game.step(state, np.full((20, 1), 1.0))
    assert np.array_equal(after.line, state.line) and np.array_equal(after.clock, state.clock)
    assert not step.reward.any()


def test_results__have_no_honest_cost() -> None:
    columns = eb.evaluate(SCENARIO, "full_brake", episodes=5)["full_brake"]
    assert "total_harm" in columns and not any(name.startswith("honest_cost") for name in columns)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"obstacle_gap_m": 60.0}, "obstacle_gap_m: is not known to physics: paper-map"),
        ({"brake_rate_mps3": 30.0}, "brake_rate_mps3: is not known to physics: paper-map"),
        ({"physics": "paper-mop"}, "physics = paper-mop: did you mean paper-map?; known: paper-map"),
    ],
)
def test_scenario__that_the_map_cannot_play_is_refused(changes: dict[str, Any], told: str) -> None:
    with refused(told):
        SCENARIO.replace(**changes)


def record() -> None:
    _, game = eb.open_game(SCENARIO)
    team = eb.Team.of({"vehicle_2": eb.make_agent("full_brake")}, "full_brake")
    eb.record_episode(SCENARIO.sample(1, 7), team, game)


def refusals() -> dict[str, Callable[[], Any]]:
    late = {"latency_s": [0, 1.5, 1.6], "early_impacts": "keep"}

    def drive(agent: str, measures: str = "") -> Callable[[], Any]:
        return lambda: eb.evaluate(SCENARIO, agent, episodes=5, measures=measures or ())

    return {
        "a plan of constant commands (e_v2x_bm other than": drive("e_v2x_bm"),
        "shields other than episode:pairwise": drive("full_brake+step"),
        "pushed_m needs exact impacts": drive("full_brake", "pushed_m"),
        "pushed_mps needs exact impacts": drive("full_brake", "pushed_mps"),
        "the term push needs exact impacts": drive("full_brake", "push"),
        "the term drove needs exact impacts": drive("full_brake", "drove"),
        "a record of the motion between decisions needs exact impacts": record,
        "harm_count honest needs exact impacts": lambda: eb.open_game(SCENARIO, reward="honest"),
        "the term still_moving needs exact impacts": lambda: eb.open_game(
            SCENARIO, reward={"harm": 1.0, "still_moving": 1.0}
        ),
        "row 0 has an impact before the first decision": lambda: eb.evaluate(
            SCENARIO.replace(**late), "full_brake", episodes=5
        ),
        "k_energy has 1 entries; must be a number, or have one for each of the 2 pairs": lambda: eb.open_game(
            SCENARIO, reward={"harm": 0.0, "collision": 1.0, "k_energy": [1.0]}
        ),
    }


@pytest.mark.parametrize("message", refusals())
def test_what_needs_exact_impacts__is_refused(message: str) -> None:
    with refused(message):
        refusals()[message]()
