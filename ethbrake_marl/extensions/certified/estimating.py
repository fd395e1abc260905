"""Shields and E-V2X-BM that use only what their vehicle has received: they decide in estimated lines (``estimated``).

**Claim of the shield with corners**, ``robust:estimated``. Let B be its bound at the first decision. If the true world
is one of the estimated lines that are possible then, the harm of the episode is at most B, to the last bit, whatever is
proposed and whatever messages are lost.

**Proof.** Each estimated line is simulated by the episode's own step with the actions that are applied, so the one that
is the true world is the true episode, and it never becomes impossible. The proof of the step shield holds in each line
that remains; with fewer lines the price of the plan does not rise, and another plan is held only if it costs less. ∎

Without corners, in the median line alone, nothing is promised. Between the corners the harm may be above the bound. The
info ``trusted`` is false once every estimated line is contradicted.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import ESTIMATED, Agent
from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.pairwise import pairwise
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import advanced
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.estimated import SURPRISE, Lines, without_channel
from ethbrake_marl.extensions.certified.robust import Members, MembersShield, apart, joined, opened
from ethbrake_marl.motion.layout import GAP, LATENCY, SPEED, Bools, Floats, Ints
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.algorithm_1 import EpisodeShield, Memory as EpisodeMemory
from ethbrake_marl.shields.named import NamedShield
from ethbrake_marl.shields.step import Memory, part
from ethbrake_marl.worlds.scenario import Scenario


class EstimatedShield(MembersShield):
    """Shield of one learner that certifies actions in its estimated lines (``estimated.Lines``).

    Args:
        drivers: body -> agent, as for ``StepShield``.
        scenario: the scenario of the worlds.
        harm_count: which count of harm is bounded (``episode.counts``).
        corners: certify also in the corners of the ranges, not only in the median line.

    """

    knows = ESTIMATED

    def __init__(
        self,
        drivers: Mapping[int, Agent] | None = None,
        *,
        scenario: Scenario,
        harm_count: str = "first",
        corners: bool = False,
    ) -> None:
        super().__init__(drivers, harm_count=harm_count)
        self.lines = lines_of_learner(scenario, corners)

    def begin(self, game: Game, alert: State, state: State) -> Memory:
        lines, possible, _ = self.lines.heard(state, opened(game, self.lines.at_alert(alert, state)))
        median = lines.take(np.arange(0, lines.n, self.lines.alert.n))
        memory = self.first_memory(game, median, median, lines, self.agents_at(game, alert))
        return memory._replace(members=Members(apart(lines, state.n), possible))

    def decide(self, game: Game, state: State, proposed: Floats | None, *, donate: bool) -> tuple[Floats, Memory]:
        memory: Memory = state.memories["shield"]
        lines, possible, changed = self.lines.heard(state, joined(memory.members.states))
        trusted = memory.members.trusted & (possible | state.ended)
        rows = (changed & ~state.ended).nonzero()[0]
        if len(rows):
            memory = self.planned_again(game, memory, lines, rows)
        memory = memory._replace(members=Members(apart(lines, state.n), trusted))
        state = state._replace(memories={**state.memories, "shield": memory})
        return super().decide(game, state, proposed, donate=donate)

    def rolled_out(self, game: Game, state: State, plans: Floats, most: Any = np.inf) -> Floats:
        return super().rolled_out(*without_channel(game, state), plans, most)

    def planned_again(self, game: Game, memory: Memory, lines: State, rows: Ints) -> Memory:
        """In the worlds ``rows``, replace the plan in ``memory`` by the cheapest of itself and newly made plans.

        ``lines``: the estimated lines, M rows for each world.
        """
        here = part(lines, rows, self.lines.alert.n)
        median = here.take(np.arange(0, here.n, self.lines.alert.n))
        plan, price = memory.plan.copy(), memory.price.copy()
        plans = [plan[rows], *self.plans(game, median, median, here)]
        prices = np.stack([self.price(game, here, each) for each in plans])
        plan[rows], price[rows] = np.stack(plans)[prices.argmin(axis=0), np.arange(len(rows))], prices.min(axis=0)
        return memory._replace(plan=plan, price=price)


class EstimatedEpisodeShield(EpisodeShield):
    """Algorithm 1 (*hybrid*) in the median line: the first decision chooses the policy or E-V2X-BM for the episode.

    ``drivers``: body -> agent, as for ``StepShield``. ``harm_count``: the harm that is compared. ``bound``: how H* is
    computed, ``coupled`` or ``pairwise``, as for ``EpisodeShield``.
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
        self.lines = lines_of_learner(scenario, corners=False)

    def begin(self, game: Game, alert: State, state: State) -> EpisodeMemory:
        median, _, _ = self.lines.heard(state, opened(game, self.lines.at_alert(alert, state)))
        game, median = without_channel(game, median)
        return super().begin(game, median, median)


class Estimate(NamedTuple):
    median: State  # line at the last decision
    command: Floats  # [n] m/s2; NaN: none yet


class EstimatedEV2XBM:
    """E-V2X-BM in the median line; it chooses a new deceleration when received values differ from this line's.

    ``is_pairwise``: use the paper's closed form, not a simulation of the line. ``count`` is the harm that is minimised.
    """

    knows = ESTIMATED

    def __init__(self, scenario: Scenario, is_pairwise: bool = False, count: str = "first") -> None:
        self.scenario, self.is_pairwise, self.count = scenario, is_pairwise, count
        self.name = f"e_v2x_bm{':pairwise' if is_pairwise else ''}:estimated"
        self.lines: dict[int, Lines] = {}  # body -> its median line

    def begin(self, alert: State, body: int) -> Estimate:
        check_exact(alert, self.name)
        if body not in self.lines:
            self.lines[body] = Lines.of(self.scenario, body, corners=False)
        median = self.lines[body].at_alert(alert, alert)._replace(memories={})
        return Estimate(median, np.full(alert.n, np.nan))

    def act(self, state: State, memory: Estimate, body: int) -> tuple[Floats, Estimate]:
        wanted = memory.median.wanted.copy()
        wanted[:, body] = state.wanted[:, body]
        foretold = advanced(memory.median._replace(wanted=wanted), state.time_s)
        median, command = self.lines[body].overwritten(state, foretold), memory.command.copy()
        rows = (differ(foretold, median) | np.isnan(command)).nonzero()[0]
        if len(rows):
            here = median.take(rows)
            choice = pairwise(here, body) if self.is_pairwise else None
            choice = choice or coupled(here, body, self.count, self.scenario.horizon_s)
            command[rows] = -choice.deceleration_mps2
        return command, Estimate(median, command)


def differ(one: State, other: State) -> Bools:
    """Return in which worlds two lines differ in speeds, gaps or parameters of vehicles, [n].

    Latencies that are over are ignored.
    """
    parts = []
    for line in (one, other):
        car = line.car[:, :, 1:].copy()
        car[:, LATENCY] = np.maximum(car[:, LATENCY], line.time_s[:, np.newaxis])
        parts.append((line.line[:, SPEED, 1:], line.line[:, GAP, :-1], car.reshape(line.n, -1)))
    near = [np.isclose(mine, theirs, 0.0, SURPRISE).all(axis=1) for mine, theirs in zip(*parts, strict=True)]
    return np.asarray(~np.all(near, axis=0))


def lines_of_learner(scenario: Scenario, corners: bool) -> Lines:
    if len(scenario.learners) != 1:
        raise InvalidInput(
            f"shield: scenario {scenario.name!r} has {len(scenario.learners)} learners; an estimated shield needs"
            " exactly one: make the environment with learners=['vehicle_2'], or use mode step"
        )
    return Lines.of(scenario, scenario.learners[0], corners=corners)


def make_e_v2x_bm(argument: str | None, settings: Any) -> EstimatedEV2XBM:
    if argument not in (None, "pairwise"):
        raise InvalidInput(f"agent {settings.spec!r}: must be e_v2x_bm:estimated or e_v2x_bm:pairwise:estimated")
    return EstimatedEV2XBM(settings.needed_scenario(), argument == "pairwise", settings.harm_count)


def _entry(make: Any, form: str, about: str) -> Part:
    return Part(make, form=form, about=about, knows=ESTIMATED)


STEP = _entry(NamedShield(EstimatedShield), "step:estimated", "certified in the median line that its vehicle estimates")
CORNERS = _entry(
    NamedShield(partial(EstimatedShield, corners=True)),
    "robust:estimated",
    "also in the corners of the ranges of what was not received",
)
EPISODE = _entry(
    NamedShield(EstimatedEpisodeShield, "bound"),
    "episode[:pairwise]:estimated",
    "the paper's hybrid in the line that its vehicle estimates",
)
E_V2X_BM = _entry(
    make_e_v2x_bm, "e_v2x_bm[:pairwise]:estimated", "computed from received information and the scenario's ranges"
)
