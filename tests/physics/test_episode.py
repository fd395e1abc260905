"""One step of an episode: engine, search and shield are made of the same compiled rules, and agree to the bit."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from ethbrake_marl import engine as engine_step, search as search_kernel
from ethbrake_marl.agents.registry import drive, fixed_commands, script_agents
from ethbrake_marl.physics import kernel, kernel as episode
from ethbrake_marl.physics.kernel import Decisions
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.search import Profiles, profile_problem
from ethbrake_marl.shield import step_shield, step_shield as members

RULES = ("step_end_s", "onset_s", "command_in_force", "stands")
PAPER = load_scenario("paper-random")


class Phases:
    """Drives profiles of equal phases on the grid of decisions."""

    state_free = False
    name = "phases"

    def __init__(self, commands: np.ndarray, length: int) -> None:
        self.commands, self.length = commands, length

    def act(self, worlds, vehicle):
        started = worlds.vehicles.latency_s[:, vehicle]
        phase = np.maximum(Decisions(started, 0.1).latest(worlds.time_s), 0) // self.length
        return self.commands[np.arange(worlds.n), np.minimum(phase, self.commands.shape[1] - 1)]


def test_rules__are_the_same_objects_in_engine_search_and_shield():
    used = engine_step.step_worlds.py_func.__globals__
    assert all(used[name] is getattr(episode, name) for name in RULES)
    assert used["advance_table"] is kernel.advance_table
    assert used["advance_table"] is episode.step_episode.py_func.__globals__["advance_table"]
    assert members.step_again is episode.step_again
    assert episode.follow.py_func.__globals__["step_again"] is episode.step_again
    assert search_kernel.follow is episode.follow


def test_rules__stand_nowhere_else():
    # who plays an episode by calling the kernel of segments itself would have a step of its own
    for module in (search_kernel, step_shield, members):
        assert "advance_table" not in inspect.getsource(module)
    source = inspect.getsource(engine_step.step_worlds.py_func)
    assert all(f"{name}(" in source for name in (*RULES, "advance_table"))
    assert "- time" not in source.replace("until - time", "")


@pytest.mark.parametrize("name", ["paper-random", "paper-random-obstacle", "stress-wide"])
@pytest.mark.parametrize("length", [1, 7])
def test_profiles__step_by_step_realise_what_the_engine_does_to_the_bit(name, length):
    scenario = load_scenario(name)
    sample = scenario.sample(40, 11)
    worlds, vehicle = sample.worlds, scenario.learners[0]
    rng = np.random.default_rng(length)
    shares = rng.uniform(-1.0, 0.3, (worlds.n, 100 // length))
    commands = shares * worlds.vehicles.braking_capacity_mps2[:, [vehicle]]
    commands = np.clip(commands, None, worlds.vehicles.driving_capacity_mps2[:, [vehicle]])
    others = fixed_commands(script_agents(scenario), worlds, "test", vehicle=vehicle)
    problem = profile_problem(worlds, [vehicle], horizon_s=scenario.horizon_s, others_mps2=others)
    ends = np.minimum((np.arange(commands.shape[1]) + 1) * length, problem.last_step[:, np.newaxis])
    ends[:, -1] = problem.last_step
    first, total = problem.follow(Profiles(ends, commands[:, :, np.newaxis]))
    ledger = drive(worlds, Phases(commands, length), scenario, vehicle).ledger
    assert np.array_equal(first, ledger.world_harm("first"))
    assert np.array_equal(total, ledger.world_harm("total"))


def test_first_decision__is_the_least_latency_of_who_decides_or_now():
    worlds = PAPER.sample(3, 1).worlds
    assert worlds.first_decision_s([1, 2]).tolist() == [0.5] * 3
    assert worlds.first_decision_s([2]).tolist() == [0.8] * 3
    assert worlds.first_decision_s([]).tolist() == [0.0] * 3


@pytest.mark.parametrize(("horizon", "number"), [(8.0, 75), (8.05, 76), (0.55, 1), (0.6, 1)])
def test_number_of_decisions__the_last_one_ends_at_the_horizon(horizon, number):
    assert Decisions(np.array([0.5]), 0.1).before(horizon).tolist() == [number]


def test_decision_at__is_on_the_grid_in_spite_of_rounding():
    steps = np.arange(2000)
    assert np.array_equal(Decisions(np.full(2000, 0.5), 0.1).latest(0.5 + steps * 0.1), steps)
    assert Decisions(np.array([0.5]), 0.1).latest(np.array([0.4999])).tolist() == [-1]
