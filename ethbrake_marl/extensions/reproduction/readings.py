"""The paper's strategies in our physics, under two readings of the time from which Vehicle 2 may act."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.evaluation.door import SEED
from ethbrake_marl.evaluation.evaluate import Result, evaluate
from ethbrake_marl.evaluation.identity import about_scenario
from ethbrake_marl.evaluation.measures import Measure
from ethbrake_marl.evaluation.named_measures import measures_called
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.names import open_game, teams_of
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

RANDOM, DISTANCE = "paper-random", "paper-distance"

NON_ETHICAL, SAC, PPO = "Non-ethical (full braking)", "SAC", "PPO"
REALISED, COUPLED, PREDICTED = "E-V2X-BM, realised", "E-V2X-BM, coupled", "E-V2X-BM, predicted"
PROVEN = "least harm, proven"

FOUR = {  # the paper's four strategies, with two versions of E-V2X-BM
    NON_ETHICAL: "full_brake",
    REALISED: "e_v2x_bm:pairwise",
    COUPLED: "e_v2x_bm",
    SAC: "sac",
    PPO: "ppo",
}
BASELINES = (REALISED, COUPLED, PREDICTED)

ABOUT_BASELINE = (
    "E-V2X-BM, predicted: what the closed form expects, pair by pair. Realised: what that deceleration does once speeds"
    " are exchanged. Coupled: the constant deceleration of least harm in the same physics."
)


class Reading(NamedTuple):
    """A reading of the paper's text: the time from which Vehicle 2 acts."""

    name: str
    acts_s: float | None = None  # since the alert (s); None: the latency of the scenario

    def scenario(self, name: str, **changes: Any) -> Scenario:
        """Return a shipped scenario under this reading, with ``changes`` of other keys."""
        scenario = load_scenario(name).replace(**changes)
        first, _, *others = scenario.model_dump()["latency_s"]
        return scenario if self.acts_s is None else scenario.replace(latency_s=[first, self.acts_s, *others])


READINGS = STATED, EARLY = Reading("as stated"), Reading("Vehicle 2 acts at 0.2 s", 0.2)


def expected(game: Game, alert: State, last: State) -> Floats | None:
    """Harm that Algorithm 1 expects at the alert: the smaller one of H* and the harm of the policy."""
    memory: Any = last.memories.get("shield")
    return None if memory is None else np.minimum(memory.policy_harm, memory.bound_harm)


def drive(
    scenario: Scenario, agents: Mapping[str, Any], episodes: int, seed: int = SEED, measures: Iterable[str] = ()
) -> Result:
    """Let agents drive the first worlds of a list. Where a policy drives that was trained elsewhere, the page says so.

    ``agents`` are specs by name in tables.
    """
    loaded, game = open_game(scenario)
    chosen = Measure("expected_harm", expected), *measures_called(measures)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Unfamiliar)
        worlds, teams = loaded.draw(episodes, seed), teams_of(agents, loaded)
        return evaluate(worlds, teams, game, chosen, about=about_scenario(loaded, seed))


def least_harm(scenario: Scenario, episodes: int) -> Floats:
    """Return a lower bound that is proven for every strategy, in the first worlds of the list, [n] m2/s2."""
    worlds = scenario.sample(episodes, SEED)
    return lower_bound(worlds, horizon_s=scenario.horizon_s, time_step_s=scenario.time_step_s).harm


@cache
def driven(name: str, reading: Reading, agents: tuple[tuple[str, str], ...], episodes: int) -> tuple[Result, Floats]:
    """Return what agents do in a shipped scenario, and the least possible harm. Items share what is the same.

    ``agents`` are pairs of a name in tables and a spec.
    """
    scenario = reading.scenario(name)
    return drive(scenario, dict(agents), episodes), least_harm(scenario, episodes)


def harms(result: Result, least: Floats) -> dict[str, Floats]:
    """Return the first-impact harm of each strategy, what E-V2X-BM predicts, and the least possible, [n] m2/s2."""
    each = {name: columns["first_impact_harm"] for name, columns in result.columns.items()}
    if REALISED in result.columns:
        each[PREDICTED] = result[REALISED]["predicted_harm"]
    return each | {PROVEN: least}
