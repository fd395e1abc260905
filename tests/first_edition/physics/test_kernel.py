"""The kernel: the closed forms of its events by hand, and one step of an episode for engine, search and shield."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive, script_agents
from ethbrake_marl.first_edition.agents.protocol import fixed_commands
from ethbrake_marl.first_edition.engine.profiles import Profiles, profile_problem
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.motion import contact, drift, force_range, settle, solo_motion, speed_event
from tests.first_edition.rest.fixture_asked import Acts

NEVER = (math.inf, 0.0)
CHANGES = math.nan  # an acceleration that is not constant all along

# Function, and what it makes of which numbers.
BY_HAND: dict[Callable[..., Any], list[tuple[tuple[float, ...], Any]]] = {
    contact: [  # gap, closing, pressing: the first root, and its closing speed
        ((6.0, 8.0, 0.0), (0.75, 8.0)),
        ((8.0, 3.0, 1.0), (2.0, 5.0)),  # D = 9 + 16
        ((4.0, 0.0, 2.0), (2.0, 4.0)),
        ((4.0, -2.0, 4.0), (2.0, 6.0)),  # opens at first: D = 4 + 32
        ((4.0, 4.0, -2.0), (2.0, 0.0)),  # D = 0: a touch
        ((4.0, 4.0, math.nextafter(-2.0, -9.0)), NEVER),
        ((4.0, 0.0, 0.0), NEVER),
        ((4.0, -1.0, 0.0), NEVER),
        ((4.0, 0.0, -1.0), NEVER),
    ],
    drift: [((9.0, 2.0, 4.0, 1.5), 9.0 - 3.0 - 4.5)],  # the quadratic of the gap
    speed_event: [  # speed, acceleration, command, limit: standstill, or the limit of a driver
        ((4.0, -2.0, -2.0, 9.0), (2.0, 0.0)),
        ((-4.0, 2.0, -2.0, 9.0), (2.0, 0.0)),
        ((4.0, 2.0, 2.0, 10.0), (3.0, 10.0)),
        ((12.0, -2.0, 2.0, 10.0), (1.0, 10.0)),  # faster than its limit, held back: it drives again from 10 m/s on
        ((4.0, -2.0, 2.0, 10.0), (2.0, 0.0)),  # drives, but is dragged
        ((4.0, -2.0, 2.0, 1e-300), (2.0, 0.0)),  # both at one instant: it stands
        ((4.0, 2.0, 0.0, 6.0), NEVER),  # pushed without driving: no limit
        ((10.0, 2.0, 2.0, 10.0), NEVER),
        ((0.0, -2.0, -2.0, 9.0), NEVER),
        ((0.0, 2.0, 0.0, 9.0), NEVER),
        ((4.0, 0.0, 2.0, 9.0), NEVER),
    ],
    force_range: [  # speed, command, limit: a range at standstill and at the limit only
        ((4.0, -3.0, 9.0), (-3.0, -3.0)),
        ((-4.0, -3.0, 9.0), (3.0, 3.0)),
        ((0.0, -3.0, 9.0), (-3.0, 3.0)),
        ((4.0, 3.0, 9.0), (3.0, 3.0)),
        ((9.0, 3.0, 9.0), (0.0, 3.0)),
        ((9.5, 3.0, 9.0), (0.0, 0.0)),
        ((-4.0, 3.0, 9.0), (3.0, 3.0)),
        ((4.0, 0.0, 9.0), (0.0, 0.0)),
        ((9.0, 0.0, 9.0), (0.0, 0.0)),
    ],
    settle: [  # low, high: the value nearest to rest
        ((2.0, 3.0), 2.0),
        ((-3.0, -2.0), -2.0),
        ((-1.0, 2.0), 0.0),
        ((0.0, 3.0), 0.0),
        ((-3.0, 0.0), 0.0),
    ],
    solo_motion: [  # speed, command, onset, limit, duration: speed, way, and whether the acceleration was constant
        ((8.0, -2.0, 0.0, 10.0, 1.0), (6.0, 7.0, -2.0)),
        ((8.0, -2.0, -0.5, 10.0, 1.0), (6.0, 7.0, -2.0)),
        ((8.0, -2.0, 0.5, 10.0, 1.5), (6.0, 11.0, CHANGES)),  # coasts 4 m
        ((8.0, -2.0, 1.0, 10.0, 1.0), (8.0, 8.0, 0.0)),  # takes effect at the very end
        ((8.0, -2.0, 2.0, 10.0, 1.0), (8.0, 8.0, 0.0)),
        ((8.0, 0.0, 0.5, 10.0, 1.0), (8.0, 8.0, 0.0)),
        ((8.0, 0.0, 0.0, 10.0, 1.0), (8.0, 8.0, 0.0)),
        ((4.0, -4.0, 0.0, 10.0, 2.0), (0.0, 2.0, CHANGES)),
        ((4.0, -4.0, 0.0, 10.0, 1.0), (0.0, 2.0, CHANGES)),  # an event at the end belongs to the segment
        ((1.0, -4.0, 0.0, 10.0, 1.0), (0.0, 0.125, CHANGES)),
        ((0.0, -4.0, 0.0, 10.0, 1.0), (0.0, 0.0, 0.0)),  # the brakes hold
        ((8.0, 2.0, 0.0, 10.0, 0.5), (9.0, 4.25, 2.0)),
        ((8.0, 2.0, 0.0, 10.0, 1.0), (10.0, 9.0, CHANGES)),
        ((8.0, 2.0, 0.0, 10.0, 3.0), (10.0, 29.0, CHANGES)),
        ((10.0, 2.0, 0.0, 10.0, 1.0), (10.0, 10.0, 0.0)),
        ((12.0, 2.0, 0.0, 10.0, 1.0), (12.0, 12.0, 0.0)),
    ],
}


@pytest.mark.parametrize(
    ("function", "given", "expected"),
    [pytest.param(of, *case, id=f"{of.__name__}{case[0]}") for of, cases in BY_HAND.items() for case in cases],
)
def test_closed_form__by_hand(function: Callable[..., Any], given: tuple[float, ...], expected: Any) -> None:
    np.testing.assert_array_equal(function(*given), expected)


# ---------------------------------------------------------------- one step of an episode


@pytest.mark.parametrize("name", ["paper-random", "paper-random-obstacle", "stress-wide"])
@pytest.mark.parametrize("length", [1, 7])
def test_profiles__step_by_step_realise_what_the_engine_does_to_the_bit(name, length):
    scenario = eb.load_scenario(name)
    worlds, vehicle = scenario.sample(40, 11).worlds, scenario.learners[0]
    shares = np.random.default_rng(length).uniform(-1.0, 0.3, (worlds.n, 100 // length))
    commands = shares * worlds.vehicles.braking_capacity_mps2[:, [vehicle]]
    commands = np.clip(commands, None, worlds.vehicles.driving_capacity_mps2[:, [vehicle]])
    others = fixed_commands(script_agents(scenario), worlds, "test", vehicle=vehicle)
    problem = profile_problem(worlds, [vehicle], horizon_s=scenario.horizon_s, others_mps2=others)
    ends = np.minimum((np.arange(commands.shape[1]) + 1) * length, problem.last_step[:, np.newaxis])
    ends[:, -1] = problem.last_step
    found = problem.follow(Profiles(ends, commands[:, :, np.newaxis]))

    @Acts
    def phases(worlds: eb.Worlds, vehicle: int) -> np.ndarray:
        """Each command for ``length`` decisions."""
        decision = Decisions(worlds.vehicles.latency_s[:, vehicle], 0.1).latest(worlds.time_s)
        return commands[np.arange(worlds.n), np.minimum(np.maximum(decision, 0) // length, commands.shape[1] - 1)]

    ledger = drive(worlds, phases, scenario, vehicle).ledger
    np.testing.assert_array_equal(found, [ledger.world_harm("first"), ledger.world_harm("total")])


def test_decisions__are_on_the_grid_in_spite_of_rounding_and_the_last_one_ends_at_the_horizon() -> None:
    numbers = [Decisions(np.array([0.5]), 0.1).before(horizon).tolist() for horizon in (8.0, 8.05, 0.55, 0.6)]
    assert Decisions(0.2, 0.3).before(1.1) == 3.0  # 0.9 / 0.3 is a little more than 3
    assert numbers == [[75.0], [76.0], [1.0], [1.0]]
    steps = np.arange(2000)
    assert np.array_equal(Decisions(np.full(2000, 0.5), 0.1).latest(0.5 + steps * 0.1), steps)
    assert Decisions(np.array([0.5]), 0.1).latest(np.array([0.4999])).tolist() == [-1]
