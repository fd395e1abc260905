"""Shields and E-V2X-BM that use only what their vehicle has received: they decide in its median line (``estimated``).

They guarantee nothing: the true line may do more harm than the bound in the median line. The info ``trusted`` is false
once something was received or measured that the median line had not predicted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.agents.team import Agent
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import ESTIMATED
from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import hold_commands
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.estimated import SURPRISE, MedianLine, without_channel
from ethbrake_marl.extensions.certified.robust import reset_without_shield
from ethbrake_marl.motion.layout import GAP, LATENCY, SPEED, Bools, Floats, Ints
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.algorithm_1 import EpisodeShield, EpisodeShieldMemory as EpisodeMemory
from ethbrake_marl.shields.shield import NamedShield
from ethbrake_marl.shields.step import StepShield, StepShieldMemory
from ethbrake_marl.worlds.scenario import Scenario


class MedianMemory(NamedTuple):
    median: State  # line at the last decision
    trusted: Bools  # [n] whether it has foretold everything that was received


class EstimatedShield(StepShield):
    """The step shield of one learner, in the line that its vehicle estimates (``estimated.MedianLine``). No guarantee.

    Its bound is the harm of the plan in the median line, and may rise when that line is corrected.

    Args:
        drivers: body -> agent, as for ``StepShield``.
        scenario: the scenario of the worlds.
        harm_count: which count of harm is bounded (``episode.counts``).

    """

    knows = ESTIMATED

    def __init__(
        self, drivers: Mapping[int, Agent] | None = None, *, scenario: Scenario, harm_count: str = "first"
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
        """The lines that the vehicle assumes (``MedianLine``), in place of the true states. The memories of its agents
        are those in ``state``.
        """
        median: State = memory.members.median
        agent_memories = {body: state.memories[body] for body in self.drivers if body in state.memories}
        return median._replace(memories={**median.memories, **agent_memories})

    def rolled_out(self, game: Game, state: State, plans: Floats, most: Any = np.inf) -> Floats:
        return super().rolled_out(*without_channel(game, state), plans, most)

    def plan_again(self, game: Game, memory: StepShieldMemory, median: State, rows: Ints) -> StepShieldMemory:
        """Memory in which the worlds ``rows`` have the cheapest of their present plan and new plans.

        ``median``: the corrected median lines of these worlds.
        """
        plan, price = memory.plan.copy(), memory.price.copy()
        plan[rows], price[rows] = self.cheapest(game, median, [plan[rows], *self.plans(game, median, median, median)])
        return memory._replace(plan=plan, price=price)

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        return {**super().infos(game, state), "trusted": state.memories["shield"].members.trusted}


class EstimatedEpisodeShield(EpisodeShield):
    """The paper's Algorithm 1 (*hybrid*) in the median line: the first decision chooses the driver of the episode.

    It chooses the policy or E-V2X-BM. ``drivers``: body -> agent, as for ``StepShield``. ``harm_count``: the harm that
    is compared. ``bound``: how the harm H* of E-V2X-BM is computed, ``coupled`` or ``pairwise``, as for
    ``EpisodeShield``.
    """

    knows = ESTIMATED

    def __init__(
        self,
        drivers: Mapping[int, Agent] | None,
        *,
        scenario: Scenario,
        harm_count: str = "first",
        bound: str = "coupled",
    ) -> None:
        super().__init__(drivers, harm_count=harm_count, bound=bound)
        self.line = line_of_learner(scenario)

    def begin(self, game: Game, alert: State, state: State) -> EpisodeMemory:
        median, _ = self.line.corrected(state, reset_without_shield(game, self.line.at_alert(alert, state)))
        game, median = without_channel(game, median)
        return super().begin(game, median, median)


class ChoiceMemory(NamedTuple):
    median: State  # line at the last decision
    command: Floats  # [n] m/s2; NaN: none yet


class EstimatedEV2XBM:
    """E-V2X-BM, the best constant deceleration, computed in the line that the vehicle estimates (median line).

    It chooses a new deceleration when received values differ from the median line. ``is_pairwise``: use the paper's
    closed form instead of a simulation of the line. ``count``: the harm that is minimised.
    """

    knows = ESTIMATED

    def __init__(self, scenario: Scenario, is_pairwise: bool = False, count: str = "first") -> None:
        self.scenario, self.is_pairwise, self.count = scenario, is_pairwise, count
        self.name = f"e_v2x_bm{':pairwise' if is_pairwise else ''}:estimated"
        self.lines: dict[int, MedianLine] = {}  # of each body

    def begin(self, alert: State, body: int) -> ChoiceMemory:
        check_exact(alert, self.name)
        if body not in self.lines:
            self.lines[body] = MedianLine.of(self.scenario, body)
        median = self.lines[body].at_alert(alert, alert)._replace(memories={})
        return ChoiceMemory(median, np.full(alert.n, np.nan))

    def act(self, state: State, memory: ChoiceMemory, body: int) -> tuple[Floats, ChoiceMemory]:
        """Commands [n] m/s2, and the memory with the corrected median line.

        A deceleration is kept until the median line is corrected.
        """
        wanted = memory.median.wanted.copy()
        wanted[:, body] = state.wanted[:, body]
        foretold = hold_commands(memory.median._replace(wanted=wanted), state.time_s)
        median, command = self.lines[body].with_received(state, foretold), memory.command.copy()
        rows = (differ(foretold, median) | np.isnan(command)).nonzero()[0]
        if len(rows):
            here = median.take(rows)
            choice = pairwise(here, body) if self.is_pairwise else None
            choice = choice or coupled(here, body, self.count, self.scenario.horizon_s)
            command[rows] = -choice.deceleration_mps2
        return command, ChoiceMemory(median, command)


def differ(first_line: State, second_line: State) -> Bools:
    """Whether two lines differ in a speed, a gap or a parameter of a vehicle, [n].

    Latencies that are already over are ignored.
    """
    parts = []
    for line in (first_line, second_line):
        car = line.car[:, :, 1:].copy()
        car[:, LATENCY] = np.maximum(car[:, LATENCY], line.time_s[:, np.newaxis])
        parts.append((line.line[:, SPEED, 1:], line.line[:, GAP, :-1], car.reshape(line.n, -1)))
    near = [np.isclose(first, second, 0.0, SURPRISE).all(axis=1) for first, second in zip(*parts, strict=True)]
    return np.asarray(~np.all(near, axis=0))


def line_of_learner(scenario: Scenario) -> MedianLine:
    if len(scenario.learners) != 1:
        raise InvalidInput(
            f"shield: scenario {scenario.name!r} has {len(scenario.learners)} learners; an estimated shield needs"
            " exactly one: make the environment with learners=['vehicle_2'], or use mode step"
        )
    return MedianLine.of(scenario, scenario.learners[0])


def make_estimated_e_v2x_bm(argument: str | None, settings: Any) -> EstimatedEV2XBM:
    if argument not in (None, "pairwise"):
        raise InvalidInput(f"agent {settings.spec!r}: must be e_v2x_bm:estimated or e_v2x_bm:pairwise:estimated")
    return EstimatedEV2XBM(settings.needed_scenario(), argument == "pairwise", settings.harm_count)


def _entry(make: Any, form: str, about: str) -> Part:
    return Part(make, form=form, about=about, knows=ESTIMATED)


ESTIMATED_STEP = _entry(
    NamedShield(EstimatedShield), "step:estimated", "certified in the median line that its vehicle estimates"
)
ESTIMATED_EPISODE = _entry(
    NamedShield(EstimatedEpisodeShield, "bound"),
    "episode[:pairwise]:estimated",
    "the paper's hybrid in the line that its vehicle estimates",
)
ESTIMATED_E_V2X_BM = _entry(
    make_estimated_e_v2x_bm,
    "e_v2x_bm[:pairwise]:estimated",
    "computed from received information and the scenario's ranges",
)
