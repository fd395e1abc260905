"""The counts R1 and R2 against a simulator of the tests that shares nothing with the package, and by hand."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.agents.team import play
from ethbrake_marl.extensions.reproduction.counting import play_and_count
from ethbrake_marl.extensions.reproduction.readings import OURS, R1, R2, READINGS, STATED
from ethbrake_marl.extensions.reproduction.strategies import E_V2X_BM, NON_E, PREDICTED, SHIPPED_SPECS, strategies
from tests.reference.paper_line import Worlds, harm_of_both, harm_of_first, step_error

WORLDS = 200
VEHICLE_2 = 2


def commands_of(spec: str) -> np.ndarray:
    """Commands of Vehicle 2 at each decision, [n, k]."""
    scenario, game = open_game("paper-random")
    team = teams_of(spec, scenario, harm_count="first")[spec]
    _, *states = (state for _, state in play(game, scenario.sample(WORLDS, 7), team))
    return np.stack([state.wanted[:, VEHICLE_2] for state in states], axis=1)


def paper_worlds() -> Worlds:
    """The worlds as the paper states them: capacities and delays are written here, not read."""
    alert = eb.load_scenario("paper-random").sample(WORLDS, 7)
    return Worlds(alert.gaps_m, alert.speeds_mps, np.array([6.0, 7.0, 6.0]), np.array([0.0, 0.5, 0.8]))


def test_hybrid__is_never_above_the_bound_by_a_simulator_of_its_own() -> None:
    worlds = paper_worlds()
    decelerations = np.linspace(0.0, 7.0, 71)
    each = worlds._replace(
        gaps=np.tile(worlds.gaps, (71, 1)), speeds=np.tile(worlds.speeds, (71, 1))
    )  # all worlds with the first deceleration, then all with the second one, ...
    scanned = harm_of_both(each, -np.repeat(decelerations, WORLDS)[:, np.newaxis]).reshape(71, WORLDS)
    bound, best = scanned.min(axis=0), decelerations[scanned.argmin(axis=0)]
    braking = harm_of_first(worlds, -best[:, np.newaxis])
    assert (braking <= bound + step_error(bound)).all() and bound.mean() > 5.0
    exact = pairwise(eb.load_scenario("paper-random").sample(WORLDS, 7), VEHICLE_2).harm
    assert (exact <= bound + step_error(bound)).all() and exact.mean() == pytest.approx(
        bound.mean(), rel=0.05
    )  # a scan of decelerations
    for spec in SHIPPED_SPECS.values():
        alone = harm_of_first(worlds, commands_of(spec))
        hybrid = np.where(alone <= bound, alone, braking)
        assert (hybrid <= bound + step_error(bound)).all() and (alone > bound + step_error(bound)).any()


def test_counts__are_those_of_the_simulator() -> None:
    worlds, counted = paper_worlds(), strategies(STATED, WORLDS, SHIPPED_SPECS)
    specs = {NON_E: "full_brake", E_V2X_BM: "e_v2x_bm:pairwise", **SHIPPED_SPECS}
    for name, spec in specs.items():
        commands = commands_of(spec)
        first, both = counted[R1][name]["first"], counted[R2][name]["first"]
        assert (np.abs(first - harm_of_first(worlds, commands)) <= step_error(first) + 0.01).mean() > 0.99
        assert (np.abs(both - harm_of_both(worlds, commands)) <= 2.0 * step_error(both) + 0.01).mean() > 0.99
        assert np.array_equal(counted[R1][name]["collided"], first > 0.0)
        assert (first <= both + 1e-9).all() and ((first < both - 1e-9).any() or name in SHIPPED_SPECS)


def test_bound__holds_in_both_counts_and_not_in_ours() -> None:
    counted = strategies(STATED, 1_000, SHIPPED_SPECS)
    assert [*counted] == [*READINGS]
    above = {}
    for reading, outcomes in counted.items():
        bound = outcomes[E_V2X_BM][PREDICTED]
        above[reading] = sum((outcomes[f"Hybrid {name}"]["first"] > bound + 1e-9).sum() for name in SHIPPED_SPECS)
        better = [outcomes[f"Hybrid {name}"]["first"] <= outcomes[name]["first"] + 1e-9 for name in SHIPPED_SPECS]
        assert np.all(better) if reading == R2 else reading == R1 or not np.all(better)
    assert above[OURS] > 100 and above[R1] == above[R2] == 0
    assert counted[R2][E_V2X_BM]["first"] == pytest.approx(counted[R2][E_V2X_BM][PREDICTED], abs=1e-9)
    assert (counted[R1][E_V2X_BM]["first"] <= counted[R1][E_V2X_BM][PREDICTED] + 1e-9).all()


def test_count__by_hand() -> None:
    """All drive at 20 m/s. Vehicle 1 brakes with 6 m/s2, Vehicle 2 with 7 m/s2 from 0.5 s on, Vehicle 3 with 6 m/s2
    from 0.8 s on, and meets Vehicle 2 before Vehicle 2 meets Vehicle 1.
    """
    scenario, game = open_game("paper-random")
    states = {"gap_1_m": [5.0], "gap_2_m": [4.0], "speed_1_mps": [20.0], "speed_2_mps": [20.0], "speed_3_mps": [20.0]}
    alert, team = eb.worlds_from_table(scenario, states), teams_of("full_brake", scenario)["full_brake"]
    counted = play_and_count(game, alert, team)
    # Vehicles 2 and 3: they close at 2.1 m/s and have used up 0.315 m at 0.8 s; then 1 m/s2 presses
    rear = 2.1**2 + 2.0 * (4.0 - 0.315)
    # Vehicles 1 and 2: while both brake, the gap is t^2 / 2 - 3.5 t + 5.875, which is 0 at a closing speed of sqrt(0.5)
    front = 3.5**2 - 2.0 * 5.875
    assert counted.line_first == pytest.approx([rear]) and counted.pairs_alone == pytest.approx([rear + front])
