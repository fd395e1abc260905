"""Plans that a shield may try: at the alert, and as ways to continue after a proposed action.

A plan [n, T, L] has the L learners' actions at every decision. The bound does not depend on this file: the shield
computes the harm of each plan before it follows the plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.agents.e_v2x_bm import coupled
from ethbrake_marl.agents.team import Agent, propose
from ethbrake_marl.episode.commands import actions_of
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.hold import choose, descend
from ethbrake_marl.episode.state import END, STEPS, State
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.forces import capacity
from ethbrake_marl.motion.layout import BRAKING, Floats

BRAKE_SHARES = np.linspace(0.0, 1.0, 21)  # shares of its brakes that each of several learners tries at the alert
FALLBACK_ROUNDS = 2  # rounds in which the learners take turns to try them
CHANGES = np.array([0.05, -0.05, 0.1, -0.1, 0.2, -0.2, 0.4, -0.4])  # added to the plan's next actions, then held
AGENTS = "agents"  # memory of a state: the memories of the shield's agents, vehicle -> memory
SINGLE_ACTIONS = np.linspace(0.0, -1.0, 4)  # actions of one of several learners, tried while the others follow the plan


def first_plans(game: Game, alert: State, state: State, count: HarmCount) -> list[Floats]:
    """Plans of constant actions from which a shield chooses at the alert, [n, T, L] each.

    With one learner: E-V2X-BM. With several: E-V2X-BM of each learner while the others brake fully; the best share of
    each learner's brakes, chosen one learner after the other; full braking of all; and E-V2X-BM of all, as the team
    ``e_v2x_bm`` drives.
    """
    learners, until_s = game.settings.learners, state.clock[:, END]
    full = alert._replace(wanted=state.wanted.copy())
    full.wanted[:, learners] = -alert.braking_capacity_mps2[:, learners - 1]
    choices = [coupled(full, body, count, until_s) for body in learners.tolist()]
    best = actions_of(alert, learners, -np.stack([choice.deceleration_mps2 for choice in choices], axis=1))
    actions = [best]
    if len(learners) > 1:
        commands, _ = descend(state, learners.tolist(), BRAKE_SHARES, FALLBACK_ROUNDS, until_s, count)
        alone = [np.where(column, best, -1.0) for column in np.eye(len(learners), dtype=np.bool_)]
        actions = [*alone, actions_of(alert, learners, commands[:, learners]), np.full(best.shape, -1.0), best]
    return [constant_plans(game, action) for action in actions]


def constant_plans(game: Game, actions: Floats) -> Floats:
    """Plans [n, T, L] that repeat the actions [n, L] up to the horizon."""
    decisions = int(np.ceil(game.settings.horizon_s / game.settings.time_step_s)) + 1
    return np.repeat(actions[:, np.newaxis], decisions, axis=1)


def best_constant(game: Game, states: State, plans: Floats, count: HarmCount, below: Floats) -> tuple[Floats, Floats]:
    """Constant actions with the least harm, [n, 1, L], and an estimate of this harm, [n] m2/s2.

    A candidate is the next actions of ``plans`` [n, T, L] with one of ``CHANGES`` added to all of them. With several
    learners there are more candidates: one learner holds one of ``SINGLE_ACTIONS``, the others hold the plan's next
    actions. ``states`` may contain several possible states of each world, in consecutive rows; then the largest harm
    over these states counts. Where no candidate has an estimate under ``below`` [n] (m2/s2), the estimate is ``below``.
    """
    learners, (n, _, L) = game.settings.learners, plans.shape
    single_actions = SINGLE_ACTIONS if L > 1 else SINGLE_ACTIONS[:0]
    actions = np.empty((n, len(CHANGES) + L * len(single_actions), L))
    commands = np.empty((states.n, *actions.shape[1:]))
    write_candidates(states.car, states.clock, learners, plans, CHANGES, single_actions, actions, commands)
    best, least = choose(states, states.wanted, learners, commands, states.clock[:, END], count, below)
    return actions[np.arange(n), best, np.newaxis], least


@large
def write_candidates(car, clock, learners, plans, changes, single_actions, actions, commands):
    """Write the candidates of ``best_constant`` to ``actions`` [n, C, L], and their commands (m/s2) to ``commands``.

    ``commands`` [n M, C, L], ``car`` and ``clock`` have a row for each of the M possible states of a world.
    """
    M = len(car) // len(plans)
    for row in range(len(car)):
        k = row // M
        now = min(int(clock[k * M, STEPS]), plans.shape[1] - 1)
        for j in range(actions.shape[1]):
            for c in range(len(learners)):
                action, single = plans[k, now, c], j - len(changes) - c * len(single_actions)
                if j < len(changes):
                    action = min(max(action + changes[j], -1.0), 0.0)
                elif 0 <= single < len(single_actions):
                    action = single_actions[single]
                actions[k, j, c] = action
                commands[row, j, c] = action * capacity(car[row], BRAKING, learners[c])


def ask_agents(
    drivers: Mapping[int, Agent], state: State, memories: Mapping[int, Any]
) -> tuple[Floats, dict[int, Any]]:
    """Actions of a shield's agents, [n, L], and their new ``memories``.

    Only these agents hear each other's plans. Nobody else does, because a shield may apply other actions.
    """
    return propose(drivers, state._replace(memories={**state.memories, **memories}), memories)


def rollout(
    game: Game, drivers: Mapping[int, Agent], state: State, plans: Floats, count: HarmCount, most: Any = np.inf
) -> Floats:
    """Copy of ``plans`` [n, T, L] with the actions that agents choose from ``state`` on.

    Agents drive until the episode ends or its harm is above ``most`` [n] (m2/s2). ``drivers``: vehicle -> agent;
    ``state`` contains the agents' memories (``AGENTS``).
    """
    plans, rows, drivers = plans.copy(), np.arange(state.n), game.agents(drivers)
    while (~state.ended & (state.harm(count) <= most)).any():
        actions, memories = ask_agents(drivers, state, state.memories[AGENTS])
        now = np.minimum(state.steps, plans.shape[1] - 1)
        plans[rows, now] = actions
        state, _ = game.follow(state._replace(memories={**state.memories, AGENTS: memories}), actions)
    return plans
