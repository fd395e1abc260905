"""Best known commands where a script reacts: candidates are played in the game."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.search.in_game import Commands, changed, commands_of, search_in_game


class Copies:
    """Brakes as hard as the vehicle ahead at the last decision: nobody closes on it except by a late command."""

    name, knows = "copies", "messages"

    def begin(self, alert: State, body: int) -> np.ndarray:
        return np.zeros(alert.n)

    def act(self, state: State, memory: np.ndarray, body: int) -> tuple[np.ndarray, np.ndarray]:
        force = state.forces_mps2[:, body - 2].clip(-state.braking_capacity_mps2[:, body - 1], 0.0)
        return force, force


@pytest.fixture
def line() -> eb.Scenario:
    eb.register_agent("copies", lambda argument, settings: Copies(), knows="messages")
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "copies"}
    return eb.load_scenario("paper-random").replace(roles=roles, early_impacts="keep")


def test_candidate__by_hand() -> None:
    # 8 steps: from step floor(0.5^2 x 8) = 2, for ceil(8^0.5) = 3 steps; the command is -6 + 0.25 x 8, or, at the end,
    # at most 2 % of 8 away: 0 + (2 x 0.25 - 1) x 0.02^(0.2 / 0.7) x 8.
    low, span, best = np.full((1, 1), -6.0), np.full((1, 1), 8.0), np.zeros((1, 8))
    numbers = np.full((10, 3, 1), [[0.5], [0.5], [0.25]])
    assert changed(best, low, span, numbers, 0).tolist() == [[0, 0, -4, -4, -4, 0, 0, 0]]
    late = changed(best, low, span, numbers, 5)[0]
    assert late[2:5] == pytest.approx([-0.5 * 0.02 ** (0.2 / 0.7) * 8] * 3) and not late[[0, 1, 5, 6, 7]].any()


def test_best_harm__is_what_happens_and_no_worse_than_the_agents_it_begins_with(line: eb.Scenario) -> None:
    result = eb.evaluate(line, "full_brake,coast,plan,best_harm:15", episodes=6)
    best = result["best_harm:15"]
    assert (best["predicted_harm"] == best["honest_cost"]).all()
    for agent in ("full_brake", "coast", "plan"):
        assert (best["honest_cost"] <= result[agent]["honest_cost"]).all()
    assert best["honest_cost"].sum() < result["plan"]["honest_cost"].sum()


def test_search__does_not_depend_on_other_worlds_and_repeats_commands_of_agents(line: eb.Scenario) -> None:
    scenario, game = eb.open_game(line)
    worlds, team = scenario.sample(4, seed=2), eb.Team("idm", {2: eb.make_agent("idm", scenario=scenario)})
    commands, harm = search_in_game(game, worlds, candidates=12, teams=[team])
    some_commands, some_harm = search_in_game(game, worlds.take([3, 1]), candidates=12, teams=[team])
    assert some_harm.tolist() == harm[[3, 1]].tolist() and (some_commands == commands[[3, 1]]).all()
    repeated = eb.Team("repeated", {2: Commands(commands_of(game, worlds, team, commands.shape[1]))})
    harms = [eb.play_to_end(game, worlds, each).harm("honest").tolist() for each in (team, repeated)]
    assert harms[0] == harms[1] and (harm <= harms[0]).all()
