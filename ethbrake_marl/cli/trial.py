"""Try a scenario before use: what its worlds are like, what vehicles know of each other, and what can be learned."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import AGENTS, make_agent, open_game, team_of
from ethbrake_marl.agents.team import play_to_end
from ethbrake_marl.episode.counts import ALL_IMPACTS, HONEST, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.sampling import DrawnWorlds
from ethbrake_marl.worlds.scenario import Scenario

WORLDS, SEED = 200, 7
COMPARED = {"full braking": "full_brake", "best constant deceleration": "e_v2x_bm", "best known": "best_harm"}


class Trial(NamedTuple):
    """All learners brake fully, except in ``harm``."""

    drawn: DrawnWorlds
    early: int  # worlds with an impact before a learner can act
    moving: int  # worlds in which a vehicle still moves at the horizon
    late: int  # worlds in which Vehicle 1, whose braking is the alert, has a latency
    known: dict[str, dict[str, float]]  # learner -> other vehicle -> share of worlds in which it is known in time
    harm_count: HarmCount  # what agents minimise: the honest cost, or total harm if the impacts are not exact
    harm: dict[str, dict[str, float]]  # what drives the learners -> name of a count -> mean harm (m2/s2)
    refused: dict[str, str]  # agents that cannot drive here -> why

    @property
    def n(self) -> int:
        return self.drawn.worlds.n


def try_scenario(scenario: Scenario) -> Trial:
    """Raises the errors of scripts, which name vehicle, world and time."""
    count = HONEST if scenario.physics is None else ALL_IMPACTS
    loaded, game = open_game(scenario, reward={"harm_count": count})
    draw = loaded.draw(WORLDS, SEED)
    worlds, first = draw.worlds, game.reset(draw.worlds)
    harm, refused, last = {}, {}, first
    for what, spec in COMPARED.items():
        alone = spec == "best_harm"  # each of several learners would assume that the others brake fully
        if loaded.learners and spec in AGENTS and not (alone and len(loaded.learners) > 1):
            try:
                team = team_of(make_agent(spec, scenario=loaded, harm_count=count), loaded)
                end_state = play_to_end(game, worlds, team)
            except InvalidInput as error:
                if spec == "full_brake":  # a script's error
                    raise
                refused[spec] = str(error)
                continue
            last = end_state if spec == "full_brake" else last
            harm[what] = {each.name: float(end_state.harm(each).mean()) for each in end_state.counts}
    if not loaded.learners:
        last = _to_the_end(game, first)
    return Trial(
        draw,
        early=int(first.collided.sum()),
        moving=int((last.speeds_mps != 0.0).any(axis=1).sum()),
        late=int((worlds.latency_s[:, 0] > 0.0).sum()),
        known=_known_shares(loaded, first),
        harm_count=count,
        harm=harm,
        refused=refused,
    )


def _to_the_end(game: Game, state: State) -> State:
    nothing = np.zeros((state.n, 0))
    while not state.ended.all():
        state, _ = game.step(state, nothing)
    return state


def _known_shares(scenario: Scenario, state: State) -> dict[str, dict[str, float]]:
    """Learner -> other vehicle -> share of worlds in which the learner knows it when it can first act."""
    names: Any = scenario.vehicle_names
    acts_s = np.maximum(state.time_s[:, np.newaxis], state.latency_s)
    return {
        names[i - 1]: {
            names[j - 1]: float((state.know[:, i, j] <= acts_s[:, i - 1]).mean())
            for j in range(1, len(names) + 1)
            if j != i
        }
        for i in scenario.learners
    }
