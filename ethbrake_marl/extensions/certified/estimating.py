"""Shield that uses only what its vehicle has received: it decides in the vehicle's median line (``estimated``).

It guarantees nothing: the true line may do more harm than the bound in the median line. The info ``trusted`` is false
once something was received or measured that the median line had not predicted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.team import Agent
from ethbrake_marl.episode.counts import HONEST, AnyCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import ESTIMATED
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.estimated import MedianLine, without_channel
from ethbrake_marl.extensions.certified.robust import reset_without_shield
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.shield import NamedShield
from ethbrake_marl.shields.step import StepShield, StepShieldMemory
from ethbrake_marl.worlds.scenario import Scenario


class MedianMemory(NamedTuple):
    median: State  # line at the last decision
    trusted: Bools  # [n] whether it has foretold everything that was received


class EstimatedShield(StepShield):
    """The step shield of one learner, in the line that its vehicle estimates (``estimated.MedianLine``). No guarantee.

    Its bound is the harm of the plan in the median line, and may rise when that line is corrected.
    """

    knows = ESTIMATED

    def __init__(
        self, drivers: Mapping[int, Agent] | None = None, *, scenario: Scenario, harm_count: AnyCount = HONEST
    ) -> None:
        super().__init__(drivers, harm_count=harm_count)
        self.line = line_of_learner(scenario)

    def begin(self, game: Game, alert: State, state: State) -> StepShieldMemory:
        median, trusted = self.line.corrected(state, reset_without_shield(game, self.line.at_alert(alert, state)))
        memory = self.first_memory(game, median, median, median, self.agents_at(game, alert))
        return memory._replace(members=MedianMemory(median, trusted))

    def decide(
        self, game: Game, state: State, proposed: Floats | None, *, donate: bool
    ) -> tuple[Floats, StepShieldMemory]:
        memory: StepShieldMemory = state.memories["shield"]
        median, foretold = self.line.corrected(state, memory.members.median)
        foretold |= state.ended
        rows = (~foretold).nonzero()[0]
        if len(rows):
            memory = self.plan_again(game, memory, median.take(rows), rows)
        memory = memory._replace(members=MedianMemory(median, memory.members.trusted & foretold))
        state = state._replace(memories={**state.memories, "shield": memory})
        applied, memory = super().decide(game, state, proposed, donate=donate)
        after, _ = game.follow(median, applied)
        return applied, memory._replace(members=memory.members._replace(median=after))

    def possible_states(self, state: State, memory: StepShieldMemory) -> State:
        """The median lines."""
        median: State = memory.members.median
        agent_memories = {body: state.memories[body] for body in self.drivers if body in state.memories}
        return median._replace(memories={**median.memories, **agent_memories})

    def rolled_out(self, game: Game, state: State, plans: Floats, most: Any = np.inf) -> Floats:
        return super().rolled_out(*without_channel(game, state), plans, most)

    def plan_again(self, game: Game, memory: StepShieldMemory, median: State, rows: Ints) -> StepShieldMemory:
        """Memory in which the worlds ``rows``, with corrected ``median`` lines, have the cheapest of their plan and new
        plans.
        """
        plan, price = memory.plan.copy(), memory.price.copy()
        plan[rows], price[rows] = self.cheapest(game, median, [plan[rows], *self.plans(game, median, median, median)])
        return memory._replace(plan=plan, price=price)

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        return {**super().infos(game, state), "trusted": state.memories["shield"].members.trusted}


def line_of_learner(scenario: Scenario) -> MedianLine:
    if len(scenario.learners) != 1:
        raise InvalidInput(
            f"shield: scenario {scenario.name!r} has {len(scenario.learners)} learners; an estimated shield needs"
            " exactly one: make the environment with learners=['vehicle_2'], or use mode step"
        )
    return MedianLine.of(scenario, scenario.learners[0])


ESTIMATED_STEP = Part(
    NamedShield(EstimatedShield),
    form="step:estimated",
    about="certified in the median line that its vehicle estimates",
    knows=ESTIMATED,
)
