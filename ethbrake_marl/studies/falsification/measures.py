"""Measures of an agent's weakness, world by world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.team import Driver
from ethbrake_marl.defaults import HINDSIGHT, MeasureName
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Sample, Scenario


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured in some worlds, [n] each, m2/s2; minus infinity and NaN where the physics failed."""

    score: Floats
    harm: Floats
    reference: Floats | None  # harm of the agent that it is compared with, or the bound that a shield told


@dataclass(frozen=True, slots=True)
class Measure:
    """How bad a world is for an agent.

    ``harm``: its harm. ``regret``: what it does more than the reference, by default the best profile that a search
    finds with hindsight. ``difference``: by how much it and the reference differ, either way. ``bound``: its harm less
    the bound that its shield told at the alert; above zero the bound is broken.
    """

    name: MeasureName
    agents: Mapping[str, Driver]  # the agent, and the reference if there is one
    scenario: Scenario
    harm_count: HarmCount

    def __call__(self, sample: Sample) -> Measured:
        """Measure in these worlds; where the physics fails with one of the agents the score is minus infinity."""
        n = sample.worlds.n
        score, harm, reference = np.full(n, -np.inf), np.full(n, np.nan), np.full(n, np.nan)
        try:
            found = evaluate(sample, self.agents, scenario=self.scenario, aftermath=False)
        except PhysicsError:
            return Measured(score, harm, reference)
        rows = np.searchsorted(sample.index, found.index)
        agent, *other = (found.outcome(name) for name in self.agents)
        harm[rows] = agent.ledger.world_harm(self.harm_count)
        beside = self._reference(agent, other)
        if beside is None:
            score[rows] = harm[rows]
            return Measured(score, harm, None)
        reference[rows] = beside
        more = harm[rows] - beside
        score[rows] = np.abs(more) if self.name == "difference" else more
        return Measured(score, harm, reference)

    def _reference(self, agent: Outcome, other: list[Outcome]) -> Floats | None:
        if self.name == "harm":
            return None
        if self.name != "bound":
            return other[0].ledger.world_harm(self.harm_count)
        if agent.predicted_harm is None:
            raise InvalidInput(
                f"agent {next(iter(self.agents))!r}: tells no bound; --measure bound is for an agent behind a shield,"
                " for instance ppo@shipped+step"
            )
        return agent.predicted_harm


def make_measure(
    name: MeasureName, agent: str, against: str | None, scenario: Scenario, harm_count: HarmCount
) -> Measure:
    """The measure of that name; raises ``InvalidInput`` for a reference that is missing or that nobody asks."""
    if name in ("harm", "bound") and against is not None:
        raise InvalidInput(f"--against {against}: --measure {name} compares with nobody; use regret or difference")
    if name == "difference" and against is None:
        raise InvalidInput("--measure difference: compares two agents; say which is the other one, --against AGENT")
    specs = [agent] if name in ("harm", "bound") else [agent, against or HINDSIGHT]
    lineup = make_lineup(specs, scenario, harm_count=harm_count)
    if len(lineup) != len(specs):
        raise InvalidInput(f"agent {' or '.join(specs)}: stands for several agents; one is needed here")
    return Measure(name, lineup, scenario, harm_count)
