"""What every shield reports after a decision, and the reward term that counts replaced actions."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from ethbrake_marl.agents.drive import Agent, check_agent
from ethbrake_marl.episode.counts import check_count
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.script_calls import guard_scripts
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Floats


class ShieldReason(IntEnum):
    """Why the step shield accepted or replaced an action.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldReason(3).name
    'NO_CERTIFICATE'

    """

    NO_DECISION = -1  # before the first step, and always for a vehicle that follows a script
    SAME_AS_PLAN = 0  # accepted: it is the plan's action
    PLAN_REMAINS = 1  # accepted: the bound holds if the rest of the plan follows
    CONSTANT = 2  # accepted: the bound holds if constant actions follow
    NO_CERTIFICATE = 3  # replaced: the bound holds for no plan that was tried
    NOT_A_NUMBER = 4  # replaced: nothing was proposed
    ENDED = 5  # the episode is over (6 is not used)
    POLICY_ROLLOUT = 7  # accepted: the bound holds if the shield's own agents drive on

    @property
    def text(self) -> str:
        """The reason in words, such as "no certificate"."""
        return self.name.lower().replace("_", " ")


def checked_drivers(drivers: Mapping[int, Agent] | None) -> dict[int, Agent]:
    for body, agent in (drivers or {}).items():
        check_agent(agent, f"shield: policy of vehicle_{body} = {agent!r:.60}")
    return guard_scripts(dict(sorted((drivers or {}).items())))


def check_learners(game: Game, drivers: Mapping[int, Agent]) -> None:
    if list(drivers) != game.rules.learners.tolist():
        theirs, right = (", ".join(f"vehicle_{i}" for i in each) for each in (drivers, game.rules.learners))
        raise InvalidInput(f"shield: has agents for {theirs}; must have one for each learner, {right or 'none'}")


def check_harm_count(count: str) -> None:
    check_count("shield: harm_count", count)


def spread(game: Game, state: State, columns: Any, other: Any = 0) -> Any:
    """Return values of all vehicles, [n, N]: those of learners from ``columns`` [n, L], and ``other`` for scripts."""
    wide = np.full((state.n, state.vehicles), other, columns.dtype)
    wide[:, game.rules.learners - 1] = columns
    return wide


def intervention(before: State, step: Step, after: State) -> Floats:
    """Minus 1 for each vehicle whose proposed action a shield has replaced, otherwise 0."""
    memory = after.memories.get("shield")
    if memory is None:
        raise InvalidInput(
            "this game has no shield, so the term would always be 0; give the environment a shield, eb.shield(env), or"
            " leave the term out of the reward (training by a recipe has no shield)"
        )
    return np.where(memory.intervened, -1.0, 0.0)
