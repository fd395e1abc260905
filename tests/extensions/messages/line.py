"""A line of three vehicles whose messages can be followed by hand, and what its vehicles see."""

from typing import Any

import numpy as np

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.worlds.scenario import Scenario

LINE = Scenario(
    name="by-hand", gaps_m=[8, 6], speeds_mps=[20, 18, 22], braking_capacity_mps2=[6, 7, 5], driving_capacity_mps2=3,
    latency_s=[0, 0.5, 1.0], mass_t=[4.5, 5.5, 5.9], restitution=0.1, roles={"vehicle_2": "learner"},
)  # fmt: skip


def played(v2x: Any, observation: Any = None, n: int = 1, scenario: Scenario = LINE) -> tuple[Game, State]:
    _, game = open_game(scenario.replace(v2x=v2x), observation=observation)
    return game, game.reset(game.draw(n, 7, 0))


def seen_by(game: Game, state: State, body: int) -> dict[str, float]:
    return dict(zip(game.views[body].names, game.observe(state, np.array([body]))[0][0].tolist(), strict=True))


def stepped(game: Game, state: State, action: float) -> State:
    return game.step(state, np.full((state.n, len(game.settings.learners)), action))[0]
