"""Measures of how badly an agent does in each world, to search for its worst worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.errors import InvalidInput, PhysicsError, unknown_name
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.varying import states_of
from ethbrake_marl.extensions.studies.falsification import Falsified, Watcher, far_apart, search
from ethbrake_marl.extensions.studies.named_worlds import NamedWorld
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.scenario.ranges import ranges
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

MeasureName = Literal["harm", "regret", "difference", "bound"]

MEASURES: tuple[MeasureName, ...] = get_args(MeasureName)

HINDSIGHT = "best_harm"  # default reference of regret


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of an agent in n worlds (m2/s2)."""

    score: Floats  # [n] value of the measure, the larger the worse for the agent; -inf where the physics failed
    harm: Floats  # [n] harm of the agent; NaN where the physics failed
    # [n] harm of the agent to compare with, or bound of the agent's shield; None for the measure ``harm``.
    reference: Floats | None


@dataclass(frozen=True, slots=True)
class Measure:
    """Measure of how badly an agent does in a world; calling it with a sample measures every world.

    ``harm``: its harm. ``regret``: its harm minus the harm of the reference, by default the best profile that a search
    finds with hindsight. ``difference``: the absolute difference between its harm and that of the reference. ``bound``:
    its harm minus the bound of its shield at the alert; above zero the bound is broken.
    """

    name: MeasureName  # one of the four measures above
    agents: Mapping[str, Driver]  # by name: the agent, then the reference agent if there is one
    scenario: Scenario  # scenario whose learners they drive
    harm_count: HarmCount  # impacts that harm counts: each pair's first one (``first``) or all (``total``)

    def __call__(self, sample: Sample) -> Measured:
        """Return the measurements in the worlds of ``sample``; if the physics fails in a world, its score is -inf."""
        n = sample.worlds.n
        score, harm, reference = np.full(n, -np.inf), np.full(n, np.nan), np.full(n, np.nan)
        try:
            evaluation = evaluate(sample, self.agents, scenario=self.scenario, aftermath=False)
        except PhysicsError:
            return Measured(score, harm, reference)
        rows = np.searchsorted(sample.index, evaluation.index)
        agent, *other = (evaluation.outcome(name) for name in self.agents)
        harm[rows] = agent.ledger.world_harm(self.harm_count)
        if self.name == "harm":
            score[rows] = harm[rows]
            return Measured(score, harm, None)
        beside = other[0].ledger.world_harm(self.harm_count) if other else agent.predicted_harm
        if beside is None:
            raise InvalidInput(
                f"agent {next(iter(self.agents))!r}: tells no bound; --measure bound is for an agent behind a shield,"
                " for instance ppo+step"
            )
        reference[rows] = beside
        more = harm[rows] - beside
        score[rows] = np.abs(more) if self.name == "difference" else more
        return Measured(score, harm, reference)

    def falsify(
        self, budget: int, seed: int, *, most: int = 20, adaptive: bool = True, on_round: Watcher | None = None
    ) -> Falsified:
        """Search the worlds of the scenario for those in which the agent is worst.

        Worlds without harm, regret or difference are not kept, so the result may be empty.

        Args:
            budget: number of worlds to try.
            seed: seed of the search.
            most: largest number of worst worlds to keep; they differ clearly from one another.
            adaptive: whether to look around the worst worlds so far; False: worlds are drawn uniformly.
            on_round: called with the number of worlds tried so far and ``budget``.

        Raises ``InvalidInput`` if the scenario draws nothing, or if none of the tried worlds belongs to it, and the
        exceptions of ``scenario.ranges``.

        """
        drawn = ranges(self.scenario)

        def score(points: Floats) -> Floats:
            sample, accepted = drawn.sample(points)
            scores, rows = np.full(len(points), -np.inf), np.flatnonzero(accepted)
            if len(rows):
                scores[rows] = self(sample.take(rows)).score
            return scores

        tried = search(score, len(drawn.names), budget, seed, adaptive=adaptive, on_round=on_round)
        worst = far_apart(tried, most)
        if self.name != "bound":
            worst = worst[tried.scores[worst] > 0.0]
        if not np.isfinite(tried.scores).any():
            raise InvalidInput(
                f"scenario {self.scenario.name!r}: none of {budget:,} worlds tried counts: all have an impact before"
                " anybody may act, or the physics fails; give early_impacts: keep, or a larger --budget"
            )
        above = np.flatnonzero(tried.scores > 0.0)
        sample, shown_worlds = drawn.sample(tried.points[worst])[0], []
        if len(worst):
            evaluation = self(sample)
            shown_worlds = [
                NamedWorld(
                    name=f"{self.name}-{k + 1}",
                    score=float(evaluation.score[k]),
                    harm=float(evaluation.harm[k]),
                    reference=None if evaluation.reference is None else float(evaluation.reference[k]),
                    state={name: each for name, each in state.items() if each is not None},
                )
                for k, state in enumerate(states_of(sample.worlds, self.scenario))
            ]
        return Falsified(sample, shown_worlds, tried.scores, int(above[0]) + 1 if len(above) else None)

    @classmethod
    def of(cls, name: str, agent: str, against: str | None, scenario: Scenario, harm_count: HarmCount) -> Measure:
        """Return the measure called ``name`` for an agent.

        Args:
            name: ``harm``, ``regret``, ``difference`` or ``bound``.
            agent: spec of the agent.
            against: spec of the agent to compare with; None: for ``regret`` the best profile that a search finds.
            scenario: scenario whose learners they drive.
            harm_count: impacts that harm counts.

        Raises ``InvalidInput`` if an agent to compare with is missing or not allowed.

        """
        chosen = next((each for each in MEASURES if each == name), None)
        if chosen is None:
            raise unknown_name("measure", name, MEASURES)
        if name in ("harm", "bound") and against is not None:
            raise InvalidInput(f"--against {against}: --measure {name} compares with nobody; use regret or difference")
        if name == "difference" and against is None:
            raise InvalidInput("--measure difference: compares two agents; say which is the other one, --against AGENT")
        specs = [agent] if name in ("harm", "bound") else [agent, against or HINDSIGHT]
        lineup = make_lineup(specs, scenario, harm_count=harm_count)
        if len(lineup) != len(specs):
            raise InvalidInput(f"agent {' or '.join(specs)}: stands for several agents; one is needed here")
        return cls(chosen, lineup, scenario, harm_count)
