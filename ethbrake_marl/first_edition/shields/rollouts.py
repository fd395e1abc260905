"""Rollouts of the policies that propose actions: simulations in which these policies drive, used as plans.

A rollout starts at the alert or at a later decision, and its plan is certified like any other plan (``plan_harm``). If
a policy later deviates from its rollout, the shield may replace actions of the policy; the bound still holds.

Arguments that several functions share:

- ``running``: the n episodes at this decision; ``rows`` [m]: the worlds in which a rollout is tried.
- ``proposed``: proposed actions, [n] or [n, K].
- ``budget``: largest harm that the shield accepts in each world, [n] m2/s2.
- ``held``: the shield's plans before this decision, [n, L] or [n, L, K]; entries before the present decision are the
  actions applied so far.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import renumbered
from ethbrake_marl.first_edition.agents.driving import episode_engine, write_down
from ethbrake_marl.first_edition.agents.protocol import Agent, AgentAround, Team
from ethbrake_marl.first_edition.engine.memory import Memory, ask_script, begin_script, take_memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.actions import action_to_command, command_to_action
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.messages import Messages
from ethbrake_marl.first_edition.physics.motion import has_acted
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.certify import Backup, Decision, certify, from_now, plan_harm
from ethbrake_marl.first_edition.shields.comparison import ends_under, worlds_at
from ethbrake_marl.first_edition.shields.reasons import NO_CERTIFICATE, NOT_A_NUMBER, ShieldReason
from ethbrake_marl.first_edition.shields.running import Running


class Proposer(NamedTuple):
    """The policies that propose actions, with the memories and the worlds from which a rollout starts."""

    policies: Mapping[int, Agent]  # index of each shielded vehicle -> its policy, front to rear
    memories: Mapping[int, Memory]  # index of each shielded vehicle -> memory of its policy after this decision
    worlds: Worlds  # the n worlds at this decision


def rolled_out(
    worlds: Worlds, policies: Mapping[int, Agent], scenario: Scenario, vehicle: int | tuple[int, ...], width: int
) -> Floats:
    """Return the actions of ``policies``, which drive without a shield from the alert to the end of the episodes.

    ``policies`` maps the index of each shielded vehicle to the vehicle's policy. The actions have the shape [n, width]
    if ``vehicle`` is an index, and [n, width, K] if it is a tuple of K indices. After the end of an episode the actions
    are full braking.
    """
    team = Team({i: _Rounded(policy) for i, policy in policies.items()}, next(iter(policies.values())).name)
    engine = episode_engine(worlds, team, scenario)
    columns = write_down(engine, width, lambda: np.stack([engine.memories[i]["action"] for i in team.drivers], axis=1))
    actions = np.where(np.isnan(columns), -1.0, columns)
    return actions[:, :, 0] if isinstance(vehicle, int) else actions


def certify_by_policy(
    decision: Decision, running: Running, proposed: Floats, budget: Floats, held: Floats, proposer: Proposer
) -> Decision:
    """Return ``decision``, changed so that each rejected proposal that a rollout of the policy certifies is accepted.

    ``decision`` is the decision that ``certify`` made without rollouts.
    """
    rejected = (decision.reason == NO_CERTIFICATE).reshape(running.n, -1).any(axis=1)
    rows = np.flatnonzero(rejected)
    if not rows.size:
        return decision
    again = certify_rollouts(running, proposed, rows, budget, held, proposer)
    margin, plan = decision.margin.copy(), again.backup.plan
    margin[rows] = np.maximum(margin[rows], again.margin)
    assert (plan == from_now(decision.backup.plan[rows], plan, again.after.steps - 1)).all()  # same past
    certified = np.flatnonzero((again.reason != NO_CERTIFICATE).reshape(len(rows), -1).all(axis=1))
    return decision._replace(margin=margin).put(rows[certified], again._replace(margin=margin[rows]), certified)


def certify_rollouts(
    running: Running, proposed: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Decision:
    """Decide again in the worlds ``rows``, whose proposals were rejected; this time the plans are policy rollouts.

    In each world one plan is tried: the proposal, clipped to [-1, 1], followed by the policy's actions in a simulation
    from the next state on. If this plan stays within the budget and the caps, the plan becomes the backup, and the
    proposal is accepted. Otherwise the proposal stays rejected, with the reason ``NO_CERTIFICATE``. If a vehicle's
    proposal is NaN, the vehicle's planned action is used. The result is a decision for the m worlds in ``rows`` only.
    """
    part, least, silent = running.take(rows), budget[rows], np.isnan(proposed[rows])
    planned = held[rows, np.minimum(running.steps[rows], held.shape[1] - 1)]
    first = np.where(silent, planned, np.clip(proposed[rows], -1.0, 1.0))
    plan = _later_plan(running.nominal(), first, rows, budget, held, proposer)
    with renumbered(rows):
        harm = plan_harm(part, plan)
        improved = harm <= least
        if part.caps.size:
            within = (ends_under(part, plan)[1] <= part.caps).all(axis=1)
            improved &= within.reshape(part.n, -1).all(axis=1)
        decision = certify(part, first, Backup(plan, harm, no_constants(plan)), np.maximum(least, harm))
    each = improved.reshape(-1, *[1] * (first.ndim - 1))
    reason = np.where(silent, NOT_A_NUMBER, ShieldReason.POLICY_ROLLOUT)
    margin = np.broadcast_to((least - harm).reshape(each.shape), first.shape)
    return decision._replace(intervened=silent | ~each, margin=margin, reason=np.where(each, reason, NO_CERTIFICATE))


def _later_plan(
    running: Running, first: Floats, rows: Ints, budget: Floats, held: Floats, proposer: Proposer
) -> Floats:
    """Return plans for m worlds: the actions so far, then ``first``, then the policies' actions in a rollout.

    A rollout stops as soon as its harm exceeds the budget. ``first`` [m] or [m, K] are the actions at the present
    decision. ``running`` has one possible world for each world.
    """
    policies, memories, worlds = proposer
    memories, seen = take_memory(memories, rows), worlds.take(rows)
    episodes, most, action = running.take(rows), budget[rows], first
    plan, nothing = from_now(held[rows], -1.0, episodes.steps), np.zeros(len(rows))
    while True:
        going = np.flatnonzero(~episodes.ended)
        plan[going, episodes.steps[going]] = action[going]
        with renumbered(rows):
            episodes = certify(episodes, action, Backup(plan, nothing, no_constants(plan)), nothing).after
        N = episodes.problem.mass.shape[1]
        harm = 4 * N - 3 if episodes.problem.clock[0, CLOCK.HARM_IS_TOTAL] == 1.0 else 3 * N - 2
        so_far = episodes.states[:, harm : harm + N - 1].sum(axis=1)
        episodes = episodes._replace(ended=episodes.ended | (so_far > most))
        if episodes.ended.all():
            return plan
        # the worlds that the policies observe at the next decision, with the last actions in force
        commands = episodes.problem.command[:, -seen.N :].copy()  # without an obstacle ahead
        for c, vehicle in enumerate(policies):
            column = action if action.ndim == 1 else action[:, c]
            commands[:, vehicle] = action_to_command(column, seen.vehicles, vehicle)
        time, vehicles, force = episodes.time_s, seen.vehicles, episodes.states[:, -seen.N :]
        commands = vehicles.piece_commands(commands, time)
        acts = np.where(has_acted(vehicles.latency_s, time[:, np.newaxis]), commands, 0.0)
        at_once = np.isinf(np.where(acts < force, vehicles.brake_rate_mps3, vehicles.release_rate_mps3))
        in_force = np.where(at_once, acts, force)
        seen = replace(
            worlds_at(seen, episodes.states),
            time_s=time,
            command_mps2=in_force,
            messages=Messages.of(seen).with_intents(commands),
        )
        with renumbered(rows):
            proposed, memories = proposed_actions(policies, memories, seen)
        action = proposed.reshape(first.shape)
        action = np.where(np.isnan(action), -1.0, action)  # the shield does not apply NaN either


def no_constants(plan: Floats) -> Floats:
    """Return an array that contains no constant action, for ``Backup``: [0], or [0, K] if ``plan`` has the axis K."""
    return np.zeros((0, *plan.shape[2:]))


def proposed_actions(
    policies: Mapping[int, Agent], memories: Mapping[int, Memory], worlds: Worlds
) -> tuple[Floats, dict[int, Memory]]:
    """Return the actions that the policies propose, [n, K] in [-1, 1], and the new memory of each vehicle's policy.

    ``policies`` and ``memories`` map the index of each of K vehicles to its policy and to the policy's memory.
    """
    asked = {i: proposed_action(policy, worlds, memories[i], i) for i, policy in policies.items()}
    after = {i: memory for i, (_, memory) in asked.items()}
    return np.stack([action for action, _ in asked.values()], axis=1), after


def proposed_action(policy: Agent, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
    """Return the actions [n] in [-1, 1] that ``policy`` proposes for ``vehicle``, and the policy's new memory.

    In worlds where the policy commands NaN, the result is NaN.
    """
    command, memory = ask_script(policy, worlds, memory, vehicle)
    return np.where(np.isnan(command), np.nan, command_to_action(command, worlds.vehicles, vehicle)), memory


class _Rounded(AgentAround):
    """Policy whose commands are converted to actions and back, so that they are rounded as in a plan.

    ``memory["action"]`` contains the last actions that the policy chose.
    """

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        return {"policy": begin_script(self.policy, alert, vehicle, scripts), "action": np.zeros(alert.n)}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        action, policy = proposed_action(self.policy, worlds, memory["policy"], vehicle)
        action = np.where(np.isnan(action), -1.0, action)
        return action_to_command(action, worlds.vehicles, vehicle), {"policy": policy, "action": action}
