"""The robust shield: its bound holds in the nominal world and in every corner of its box of possible worlds.

It is the step shield with one change: the price of a plan is its largest harm over all *members* of a world, the
nominal world and the corners (``uncertainty``). The members are simulated in parallel with the episode, with the
applied actions, by the episode's own step; so the proof of the step shield holds in each of them. It does not hold
between the corners (docs/shield.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.team import Agent
from ethbrake_marl.episode.counts import HONEST, AnyCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.layer import MODEL
from ethbrake_marl.episode.state import END, State, map_arrays, take
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.motion.layout import GAP, IMPACTS, SPEED, Bools, Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.fallbacks import AGENTS, constant_plans
from ethbrake_marl.shields.shield import NamedShield
from ethbrake_marl.shields.step import StepShield, StepShieldMemory

CONSTANT_ACTIONS = np.linspace(0.0, -1.0, 101)  # constant actions that are tried at the alert for the worst member
RANGE_ROUNDING = 1e-9  # by which a gap (m) or speed (m/s) may lie outside the range of the members


class Members(NamedTuple):
    states: State  # arrays [n, M, ...], the nominal state first
    trusted: Bools  # [n] whether everything that was observed was possible


class RobustShield(StepShield):
    """Shield whose bound holds in the nominal world and in every corner of the intervals, but not between the corners.

    The info ``trusted`` is false once a gap or speed was observed, before any impact, that the intervals rule out.
    ``uncertainty``: such as ``gaps_m=0.5,mass_t=10%``. Other arguments: ``StepShield``.
    """

    knows = MODEL

    def __init__(
        self,
        drivers: Mapping[int, Agent] | None = None,
        *,
        uncertainty: str | None = None,
        harm_count: AnyCount = HONEST,
        allowance: float = 0.0,
    ) -> None:
        super().__init__(drivers, harm_count=harm_count, allowance=allowance)
        self.uncertainty = parse_uncertainty(uncertainty)

    def begin(self, game: Game, alert: State, state: State) -> StepShieldMemory:
        """Raises ``InvalidInput`` if the intervals do not fit the worlds."""
        states = reset_without_shield(game, self.uncertainty.members(alert))
        if (states.time_s >= game.settings.horizon_s).any():
            raise InvalidInput(
                f"uncertainty: {self.uncertainty}: the first decision may be as late as {states.time_s.max():g} s; must"
                f" be before the horizon, {game.settings.horizon_s:g} s"
            )
        memory = self.first_memory(game, alert, state, states, self.agents_at(game, alert))
        return memory._replace(members=Members(split_members(states, state.n), np.ones(state.n, np.bool_)))

    def possible_states(self, state: State, memory: StepShieldMemory) -> State:
        """The possible states of each world: its nominal state, then the corners; [n M, ...] in all."""
        states = join_members(memory.members.states)
        rows = np.arange(state.n).repeat(states.n // state.n)
        return states._replace(memories={**states.memories, AGENTS: take(state.memories[AGENTS], rows)})

    def price(self, game: Game, states: State, plans: Floats, most: Any = np.inf, caps: Floats | None = None) -> Floats:
        """Harm of each plan in the worst of the M possible states of its world, [n] m2/s2. ``caps`` is unused."""
        M = states.n // len(plans)
        limits = np.broadcast_to(most, len(plans)).repeat(M)
        return np.asarray(super().price(game, states, plans.repeat(M, axis=0), limits).reshape(-1, M).max(axis=1))

    def plans(self, game: Game, alert: State, state: State, states: State) -> list[Floats]:
        learners, n, plans = game.settings.learners, state.n, super().plans(game, alert, state, states)
        if states.n == n:
            return plans
        actions = np.repeat(CONSTANT_ACTIONS[:, np.newaxis], len(learners), axis=1)
        commands = actions * states.braking_capacity_mps2[:, np.newaxis, learners - 1]
        harm = hold(states, states.wanted, learners.tolist(), commands, states.clock[:, END], self.harm_count)[0]
        best = harm.reshape(n, states.n // n, -1).max(axis=1).argmin(axis=1)
        return [*plans, constant_plans(game, actions[best])]

    def decide(
        self, game: Game, state: State, proposed: Floats | None, *, donate: bool
    ) -> tuple[Floats, StepShieldMemory]:
        """As for ``StepShield``. Also advances the possible states, and compares the state with their range."""
        before: Members = state.memories["shield"].members
        trusted, states = before.trusted & may_be_in(state, before.states), join_members(before.states)
        applied, memory = super().decide(game, state, proposed, donate=donate)
        after, _ = game.follow(states, applied.repeat(states.n // state.n, axis=0))
        return applied, memory._replace(members=Members(split_members(after, state.n), trusted))

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        return {**super().infos(game, state), "trusted": state.memories["shield"].members.trusted}


def reset_without_shield(game: Game, alerts: State) -> State:
    return game._replace(shield=None, rewarding=game.rewarding._replace(shaping=None)).reset(alerts)


def split_members(states: State, n: int) -> State:
    """[n M, ...] -> [n, M, ...]."""
    return map_arrays(lambda array: array.reshape(n, len(array) // n, *array.shape[1:]), states)  # type: ignore[no-any-return]


def join_members(states: State) -> State:
    """[n, M, ...] -> [n M, ...]."""
    return map_arrays(lambda array: array.reshape(array.shape[0] * array.shape[1], *array.shape[2:]), states)  # type: ignore[no-any-return]


def may_be_in(state: State, members: State) -> Bools:
    """Whether all gaps and speeds of ``state`` lie within the range of its ``members`` [n, M, ...], or after an impact,
    [n].

    Before the first impact, gaps and speeds are monotone in each quantity, so every world within the intervals lies in
    this range.
    """
    struck = state.line[:, IMPACTS].any(axis=1) | members.line[:, :, IMPACTS].any(axis=(1, 2))
    inside = np.ones(state.n, np.bool_)
    for row, columns in ((SPEED, slice(1, None)), (GAP, slice(1, -1))):
        now, ends = state.line[:, row, columns], members.line[:, :, row, columns]
        low, high = ends.min(axis=1) - RANGE_ROUNDING, ends.max(axis=1) + RANGE_ROUNDING
        inside &= ((low <= now) & (now <= high)).all(axis=1)
    return inside | struck


ROBUST = Part(
    NamedShield(RobustShield, "uncertainty"),
    form="robust:INTERVALS",
    about="as +step for uncertain quantities, in the corners of their intervals, such as +robust:gaps_m=0.5:mass_t=10%",
    knows=MODEL,
)
