"""Lines and agents for the tests of evaluations."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.layer import SENSORS
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.evaluate import Result, evaluate_teams
from ethbrake_marl.evaluation.measure_registry import measures_called
from ethbrake_marl.evaluation.provenance import about_scenario
from ethbrake_marl.worlds.scenario import Scenario

# Two vehicles at 20 m/s, 1 m apart, brake with 6 m/s2, the rear one from 0.5 s. By hand: at 0.5 s the gap is 0.25 m and
# the closing speed 3 m/s, which stays; so the impact is at 0.5 + 0.25/3 s with w = 3: harm 9, shared 4.95 and 4.05.
# With e = 0.1 the speeds after it are 18.315 and 18.015 m/s; the front one stops 3.0525 s later.
PAIR: dict[str, Any] = {
    "name": "pair", "vehicles": 2, "gaps_m": 1.0, "speeds_mps": 20.0, "braking_capacity_mps2": 6.0,
    "driving_capacity_mps2": 6.0, "mass_t": [4.5, 5.5], "latency_s": [0.0, 0.5], "restitution": 0.1,
    "roles": {"vehicle_2": "learner"},
}  # fmt: skip

FULL_BRAKE, COAST, GENTLE = Held("full_brake"), Held("coast"), Held("constant:4.0")


class Foreteller:
    """Brakes fully, and predicts the first gap as its harm."""

    name, knows = "foreteller", SENSORS

    def begin(self, alert: State, body: int) -> Any:
        return alert.gaps_m[:, 0].copy()

    def measures(self, last: State, memory: Any, body: int) -> Any:
        return {"predicted_harm": memory}

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        return -state.braking_capacity_mps2[:, body - 1], memory


class Drives(NamedTuple):
    """Drives forward with one command."""

    command_mps2: float
    name: str = "drives"
    knows: str = SENSORS

    def begin(self, alert: State, body: int) -> None:
        return None

    def act(self, state: State, memory: None, body: int) -> tuple[Any, None]:
        return np.full(state.n, self.command_mps2), None


class Careless:
    """Says neither what it knows nor what it did."""

    name = "careless"

    def begin(self, alert: State, body: int) -> None:
        return None

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        return np.zeros(state.n), memory


def teams(*agents: Any, body: int = 2) -> dict[str, Team]:
    return {agent.name: Team(agent.name, {body: agent}) for agent in agents}


def evaluated(
    scenario: Any, n: int = 40, agents: Any = (FULL_BRAKE, GENTLE), measures: Any = (), **more: Any
) -> Result:
    loaded, game = open_game(Scenario(**scenario) if isinstance(scenario, dict) else scenario)
    (body,) = game.settings.learners.tolist()
    drawn = loaded.draw(n, 7)
    return evaluate_teams(
        drawn, teams(*agents, body=body), game, measures_called(measures), about=about_scenario(loaded, 7), **more
    )


def recorded(recordings: int, rows_of_each: int = 20) -> Scenario:
    """Scenario of rows of several recordings, each with gaps and speeds of its own."""
    rng, rows = np.random.default_rng(2), []
    for k in range(recordings):
        gap_m, speed_mps = rng.uniform(4, 12), rng.uniform(14, 22)
        rows += [[gap_m + rng.uniform(0, 1), speed_mps, f"drive_{k}.csv: 1-2-3"] for _ in range(rows_of_each)]
    table = {"columns": ["gap_1_m", "speed_2_mps", "recording"], "rows": rows}
    paper = open_game("paper-random")[0]
    return Scenario(**{**paper.declared(), "name": "recorded", "table": table})
