"""Measures of how badly an agent does in a world: the scores in a search for its worst worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, unknown_name
from ethbrake_marl.extensions.studies.falsification import Falsified, Watcher, far_apart, search
from ethbrake_marl.extensions.studies.named_worlds import NamedWorld
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.varying import states_of
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.ranges import ranges
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario

MeasureName = Literal["harm", "regret", "difference", "bound"]

MEASURES: tuple[MeasureName, ...] = get_args(MeasureName)

HINDSIGHT = "best_harm"  # default reference agent of the measure regret


@dataclass(frozen=True, slots=True)
class Measured:
    """Score and harm of an agent in n worlds, and the harm or bound with which its harm is compared (all in m2/s2)."""

    score: Floats  # [n] value of the measure, the larger the worse for the agent; minus infinity if the physics failed
    harm: Floats  # [n] harm of the agent; NaN if the physics failed
    # [n] harm of the agent to compare with, or bound of the agent's shield; None for the measure ``harm``.
    reference: Floats | None


@dataclass(frozen=True, slots=True)
class Measure:
    """Measure of how badly an agent does in a world.

    The measure ``harm`` is the agent's harm. The measure ``regret`` is the agent's harm minus the harm of a reference
    agent, by default ``best_harm``. The measure ``difference`` is the absolute difference between the harms of the
    agent and the reference agent. The measure ``bound`` is the agent's harm minus the bound of its shield at the alert;
    a value above 0 means that the bound is broken.
    """

    name: MeasureName  # name of the measure
    agents: Mapping[str, Driver]  # agents by name: the agent, then the reference agent if there is one
    scenario: Scenario  # scenario whose learners the agents drive
    harm_count: HarmCount  # harm count: the first impact of each pair (``first``) or all impacts (``total``)

    def __call__(self, sample: Sample) -> Measured:
        """Return for each world the agent's score, its harm, and the harm or bound to compare with.

        Raises ``InvalidInput`` for the measure ``bound`` if the agent has no shield.
        """
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
                f"agent {next(iter(self.agents))!r} has no shield, but --measure bound compares the harm with the"
                " bound of a shield; give an agent with a shield, for instance ppo+step"
            )
        reference[rows] = beside
        more = harm[rows] - beside
        score[rows] = np.abs(more) if self.name == "difference" else more
        return Measured(score, harm, reference)

    def falsify(
        self, budget: int, seed: int, *, most: int = 20, adaptive: bool = True, on_round: Watcher | None = None
    ) -> Falsified:
        """Search all worlds that the scenario can draw for those in which the agent does worst.

        For every measure but ``bound``, only worlds with a score above 0 are returned, so the result may be empty.
        Raises the exceptions of ``scenario.ranges``. Raises ``InvalidInput`` if no tried world has a finite score.

        Args:
            budget: number of worlds to try.
            seed: seed of the search.
            most: largest number of worlds in the result; any two of them differ clearly.
            adaptive: True: search around the worst worlds so far; False: all worlds are uniform random worlds.
            on_round: called with the number of worlds tried so far and ``budget``.

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
                f"scenario {self.scenario.name!r}: all {budget:,} tried worlds are invalid: in each of them an impact"
                " happens before any agent may act, or the simulation fails; write 'early_impacts: keep' into the"
                " scenario, or give a larger --budget"
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

        ``agent`` and ``against`` are specs such as ``ppo+step``. ``against`` is the reference agent of ``regret``
        (None: ``best_harm``) and ``difference``; for the other measures it must be None. Raises ``InvalidInput`` if
        ``name`` is unknown, or if ``against`` is missing or not allowed for the measure.
        """
        chosen = next((each for each in MEASURES if each == name), None)
        if chosen is None:
            raise unknown_name("measure", name, MEASURES)
        if name in ("harm", "bound") and against is not None:
            raise InvalidInput(
                f"--against {against}: --measure {name} uses no second agent; leave --against out, or use"
                " --measure regret or difference"
            )
        if name == "difference" and against is None:
            raise InvalidInput("--measure difference compares two agents; give the second agent with --against AGENT")
        specs = [agent] if name in ("harm", "bound") else [agent, against or HINDSIGHT]
        lineup = make_lineup(specs, scenario, harm_count=harm_count)
        if len(lineup) != len(specs):
            raise InvalidInput(
                f"agent {' or '.join(specs)}: this name means several agents; give the name of one agent"
            )
        return cls(chosen, lineup, scenario, harm_count)
