"""Review a shield's interventions: simulate each episode again without the intervention, and compare the harm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, count_of, renumbered
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.protocol import Agent, AgentAround, Driver, Team
from ethbrake_marl.first_edition.engine.memory import Memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.actions import action_to_command
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.shields.rollouts import proposed_action
from ethbrake_marl.first_edition.shields.step import StepShield

SAME_HARM = 1e-9  # two harms that differ by at most this (m2/s2) count as equal

VERDICTS = ("needed", "harmless", "costly")


class Review(NamedTuple):
    """Effect of each of m interventions (replaced actions) of a shield."""

    world: Ints  # [m] row of the world in the batch
    vehicle: Ints  # [m] index of the vehicle whose action was replaced
    step: Ints  # [m] number of the decision
    harm: Floats  # [m] harm of the actual episode, with the intervention (m2/s2)
    unshielded_harm: Floats  # [m] harm if the policy or team drives unshielded from that decision on (m2/s2)
    verdict: NDArray[np.str_]  # [m] "needed", "costly" or "harmless": unshielded harm is higher, lower or the same
    trusted: Bools  # [m] whether the world behaved as the shield predicted

    def share(self, verdict: str) -> float:
        """Return the fraction of interventions with ``verdict`` (one of ``VERDICTS``); 0 without interventions."""
        return float((self.verdict == verdict).mean()) if self.verdict.size else 0.0


def review(shield: StepShield, policy: Driver, worlds: Worlds) -> Review:
    """Judge each intervention by the harm if ``policy`` drives unshielded from the decision of the intervention on.

    An intervention is *needed* if the episode without the intervention does more harm than the actual episode, *costly*
    if it does less harm, and *harmless* if both episodes do equal harm. The actual episode, with the interventions, is
    simulated again in ``worlds``, because the shield may have assumed other worlds.

    Args:
        shield: a shield made with ``logging=True``, after it has run the episodes in ``worlds``. Log entries of earlier
            episodes are ignored.
        policy: the agent, or the team of all shielded vehicles, that proposed the actions in the reviewed episodes.
        worlds: the worlds of the reviewed episodes at the alert.

    Raises ``InvalidInput`` if the shield has no log, or if ``worlds`` and the shield's batch differ in the number of
    worlds.

    """
    if shield.log is None or shield.memory.running is None:
        raise InvalidInput("review: the shield has no log; make the shield with logging=True, and run episodes")
    if worlds.n != shield.memory.running.n:
        raise InvalidInput(
            f"review: worlds has {count_of(worlds.n, 'world')}; pass the worlds of the shield's last episodes,"
            f" {count_of(shield.memory.running.n, 'world')}"
        )
    log = [
        entry for entry in shield.log if entry.world < worlds.n and entry.episode == shield.memory.episode[entry.world]
    ]
    world = np.array([entry.world for entry in log], np.int64)
    step = np.array([entry.step for entry in log], np.int64)
    harm, unshielded = np.zeros(0), np.zeros(0)
    if world.size:
        never = np.full(worlds.n, shield.memory.backup.plan.shape[1])
        harm = _released_harm(shield, policy, worlds, np.arange(worlds.n), never)[world]
        unshielded = _released_harm(shield, policy, worlds, world, step)
    verdict = np.where(unshielded > harm + SAME_HARM, "needed", "harmless")
    verdict = np.where(unshielded < harm - SAME_HARM, "costly", verdict)
    whose = np.array([entry.vehicle for entry in log], np.int64)
    return Review(world, whose, step, harm, unshielded, verdict, ~shield.memory.distrusted[world])


def _released_harm(shield: StepShield, policy: Driver, worlds: Worlds, world: Ints, step: Ints) -> Floats:
    """Return the harm of m episodes in which ``policy`` drives unshielded from decision ``step`` [m] on, [m] m2/s2.

    Before decision ``step`` the shielded vehicles repeat the actions that the shield applied. ``world`` [m] are the
    indices of the episodes' worlds in ``worlds``.
    """
    scenario, plan = shield.scenario, shield.memory.backup.plan[world]
    actions = plan.reshape(*plan.shape[:2], len(shield.vehicles))
    again = {
        i: _Released(agent, actions[:, :, c], step, shield.vehicles, scenario.time_step_s)
        for c, (i, agent) in enumerate(Team.of(policy, shield.vehicles).drivers.items())
    }
    with renumbered(world):
        return drive(worlds.take(world), Team(again, "released"), scenario).ledger.world_harm(shield.harm_count)


class _Released(AgentAround):
    """Agent that repeats recorded actions until a given decision, and follows a policy from that decision on.

    ``actions`` [m, L] are the recorded actions of m episodes, and ``release`` [m] is the first decision at which the
    policy drives. ``deciding`` are the indices of all shielded vehicles, which decide at the same times, every
    ``time_step_s`` seconds.
    """

    def __init__(
        self, policy: Agent, actions: Floats, release: Ints, deciding: tuple[int, ...], time_step_s: float
    ) -> None:
        super().__init__(policy, "released")
        self._actions, self._release, self._time_step_s = actions, release, time_step_s
        self._deciding = deciding

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        return {"policy": super().begin(alert, vehicle, scripts), "first_s": alert.first_decision_s(self._deciding)}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        own, policy = proposed_action(self.policy, worlds, memory["policy"], vehicle)
        step = Decisions(memory["first_s"], self._time_step_s).latest(worlds.time_s)
        held = self._actions[np.arange(len(step)), np.clip(step, 0, self._actions.shape[1] - 1)]
        action = np.where(step < self._release, held, own)
        return action_to_command(action, worlds.vehicles, vehicle), {**memory, "policy": policy}
