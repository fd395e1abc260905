"""Step mode of the shield: a guaranteed harm that holds at every step, whoever proposes the actions.

**Claim.** Let ``B`` be the bound at the first decision: the harm of the backup plan, executed in the engine. If every
step applies the action that ``certify`` returns, then the harm at the end of the episode is at most ``B``, whatever is
proposed, and the bound never rises during the episode. An episode ends at rest or at the scenario's horizon. The claim
does not cover anything that happens after the horizon.

**Induction.** Between two decisions the shield holds a *plan*, an action for every decision up to the horizon, and its
harm ``c``: the harm of the whole episode if that plan is executed from the present state, including the harm so far and
the pairs that were already hit. One function computes it, ``members.follow_plan``. It advances decision by decision
with the operations of the engine's step in the same order, and adds harm in the same order. So:

1. *Start.* ``c = B``.
2. *The proposal is applied* only with a plan from the next state whose harm, computed by ``follow_plan`` from exactly
   that state, is at most the budget. The shield then holds that plan, and ``c`` is its harm. If the proposal is the
   plan's own action, the shield keeps the rest of the plan with the same ``c``, since the same operations act on the
   same numbers.
3. *The plan's action is applied* otherwise. ``follow_plan`` passed through the resulting state when it computed ``c``,
   so the harm of the plan's rest is ``c`` to the last bit. A plan that harms less may replace it.
4. *End.* When the episode ends, nothing is left to execute, and ``c`` is the harm of the episode.

The *budget* is the largest harm that a certificate may have: ``c``, or any value between ``c`` and ``B``. Hence
``c <= B`` always. ∎ The proof needs no tolerance: as long as the engine behaves as predicted, the harm of the episode
and the last bound are the same double.

**Several vehicles.** With several shielded vehicles, an action above is a row of actions, one for each vehicle, and so
is each entry of the plan; the proof is the same. All proposals together are tried first. If they have no certificate,
the vehicles are tried one by one, front to rear: the vehicle's proposal replaces its action in the joint plan, and is
accepted if a plan behind it has a harm within the budget; otherwise the vehicle keeps its planned action. Each attempt
starts from a certified plan, and ends with one.

**Several members.** A world may stand for several possible worlds, its *members*. Then every harm above is the largest
over the members, and all members are advanced by the same actions: the harm of *every* member is at most ``B``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self, cast, get_args

import numpy as np

from ethbrake_marl.agents.driving import script_agents
from ethbrake_marl.agents.protocol import Agent, fixed_commands
from ethbrake_marl.engine.profiles import ProfileProblem, profile_problem
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, renumbered, unknown_name
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.messages import refuse_untold
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shields.certify import CONSTANTS, Backup, Decision, certify, from_now, plan_harm
from ethbrake_marl.shields.checks import check_amount, check_scenario
from ethbrake_marl.shields.comparison import SLACK, ends_under
from ethbrake_marl.shields.first_plan import best_constants, joint_constants
from ethbrake_marl.shields.log import Intervention, interventions
from ethbrake_marl.shields.reasons import ShieldReason
from ethbrake_marl.shields.rollouts import Proposer, certify_by_policy, rolled_out
from ethbrake_marl.shields.running import Running, begin_running
from ethbrake_marl.shields.step_memory import StepMemory

Cap = Literal["baseline"]  # plan under which a vehicle's harm is its cap, the largest harm that it may bear


class StepShield:
    """Guarantee the harm of a batch of episodes: call ``begin`` when episodes start and ``decide`` in every step.

    Both methods replace the whole state in one assignment and change no array in place. So an error or an interrupt
    leaves bound, plan and trust as they were, and a ``copy.copy`` is independent.

    The bound starts as the harm of the coupled optimum (E-V2X-BM's constant deceleration), executed decision by
    decision, or as the harm of ``policy``, simulated from the alert, where that is lower. It never rises. It covers the
    time up to the scenario's horizon. ``memory.settles`` [n] is true where nothing moves any more at the horizon under
    the first plan.

    At each decision the observed worlds are compared with the prediction, bit by bit. Where they differ (a vehicle
    brakes beyond its capacity, a number is NaN, a message is missing), ``memory.distrusted`` [n] is set and the
    guarantee is lost. For the rest of the episode the *fallback* drives: the rest of the plan or the best constant
    action, whichever harms less, chosen again after every surprise. If a world continues (``only``) after its episode
    should have ended, it brakes fully.

    If each world has several ``possible`` worlds, all of this holds for the worst of them, and the observed world must
    lie within the range of their predictions.

    Args:
        scenario: the scenario of all worlds.
        vehicle: index of the shielded vehicle (0 = front), or indices of several, front to rear.
        harm_count: impacts whose harm is guaranteed: ``first`` (each pair's first) or ``total`` (all).
        allowance: loosens the bound by that much (m2/s2), until the episode ends.
        others: index of each other vehicle -> its script, whose command must be fixed at the alert; None: the
            scenario's scripts.
        cap: ``baseline``: no vehicle bears more harm than under the constant actions of least harm; None: only the sum
            over the vehicles is bounded.
        logging: keep every intervention in ``log``.

    Raises ``InvalidInput`` for an unknown count or vehicle, a negative allowance, or others whose commands are not
    fixed.

    """

    possible_are = "possible worlds"  # what error messages call the possible worlds; a subclass may set another name

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int | Sequence[int],
        *,
        harm_count: HarmCount = "first",
        allowance: float = 0.0,
        others: Mapping[int, Script] | None = None,
        cap: Cap | None = None,
        logging: bool = False,
    ) -> None:
        check_harm_count(harm_count)
        check_scenario(scenario, "shield")
        check_amount("allowance", allowance, "shield", " m2/s2")
        several = isinstance(vehicle, Sequence) and not isinstance(vehicle, str)
        each: tuple[Any, ...] = tuple(cast(Sequence[Any], vehicle)) if several else (vehicle,)
        known = range(scenario.vehicles)
        if not each or any(not isinstance(i, int | np.integer) or isinstance(i, bool) or i not in known for i in each):
            raise InvalidInput(f"shield: vehicle = {vehicle!r}: must be an index from 0 to {scenario.vehicles - 1}")
        if list(each) != sorted(set(each)):
            raise InvalidInput(f"shield: vehicle = {vehicle!r}: several are named front to rear, each once")
        if cap not in (None, *get_args(Cap)):
            raise unknown_name("shield cap", cap, get_args(Cap))
        self.vehicles = tuple(map(int, each))
        self.vehicle = self.vehicles if several else self.vehicles[0]
        self.scenario, self.harm_count, self.allowance, self.cap = scenario, harm_count, allowance, cap
        self.logging = logging
        self._entries: list[Intervention] = []  # shared with copies; the first ``memory.logged`` belong to this shield
        self.memory = StepMemory()
        scripts = script_agents(scenario, except_for=self.vehicles) if others is None else others
        self._others = {i: script for i, script in scripts.items() if i not in self.vehicles}
        self._width = int(Decisions(np.zeros(1), scenario.time_step_s).before(scenario.horizon_s)[0]) + 1

    @property
    def bound(self) -> Floats:
        """Harm of each running episode that the shield guarantees not to exceed, [n] m2/s2."""
        return self._bound_of(self.memory)

    def _bound_of(self, memory: StepMemory) -> Floats:
        running, harm = memory.running, memory.backup.harm
        if running is None or self.allowance == 0.0:
            return harm
        return np.maximum(harm, np.where(running.finished, 0.0, memory.first_bound + self.allowance))

    @property
    def predicted_harm(self) -> Floats:
        """Harm that the shield guaranteed at the alert, allowance included, [n] m2/s2."""
        return self.memory.first_bound + self.allowance

    @property
    def chosen_policy(self) -> Bools:
        """Whether no proposed action of the episode has been replaced so far, [n]."""
        return np.asarray(self.interventions == 0, np.bool_)

    @property
    def log(self) -> list[Intervention] | None:
        """All interventions (replaced actions) since the last ``clear_log``; None without ``logging``."""
        return self._entries[: self.memory.logged] if self.logging else None

    def clear_log(self) -> None:
        """Delete all log entries. The log grows until this is called."""
        self._entries, self.memory = [], self.memory._replace(logged=0)

    @property
    def interventions(self) -> Ints:
        """Number of actions replaced so far in each running episode, summed over the vehicles, [n]."""
        return np.asarray(self.memory.replaced.reshape(len(self.memory.replaced), -1).sum(axis=1), np.int64)

    def shares(self) -> Floats:
        """Return the harm that each vehicle bears if the current plan is executed, [n, N] m2/s2."""
        running, backup = self.memory.running, self.memory.backup
        if running is None:
            raise InvalidInput("shield: shares, but no episode has begun; call begin first")
        return ends_under(running.nominal(), backup.plan)[1][:, -self.scenario.vehicles :]

    def take(self, rows: Ints) -> Self:
        """Return an independent shield for the episodes in the rows with the indices ``rows``."""
        part = copy.copy(self)
        part.memory = self.memory.take(rows)
        return part

    def begin(
        self,
        worlds: Worlds,
        rows: Ints,
        policy: Agent | Mapping[int, Agent] | None = None,
        *,
        possible: Worlds | None = None,
    ) -> None:
        """Start new episodes in some rows of the batch.

        To start a larger batch, pass all of its rows, 0 to k - 1, at once. Raises ``InvalidInput`` for other rows that
        do not exist, and where messages lack a piece that certificates need.

        Args:
            worlds: the worlds of these rows at the alert, as the shield assumes them.
            rows: indices of the rows in which the episodes start.
            policy: the policy that proposes, which is simulated from the alert; for several vehicles, vehicle index ->
                policy; None: only the constant actions of least harm give the bound.
            possible: the possible worlds of each world, [len(rows) * M], the world itself first; None:
                ``members_of(worlds)``.

        """
        running_rows = len(self.memory.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin in row {rows.max()} of a batch of {running_rows}: a larger batch begins with all of its"
                " rows at once"
            )
        refuse_untold(worlds, self.vehicles, "shield")
        possible = self.members_of(worlds) if possible is None else possible
        self.memory = self.memory.put(rows, self._begun(worlds, rows, policy, possible))

    def members_of(self, worlds: Worlds) -> Worlds:
        """Return the possible worlds of worlds at the alert, M for each of n worlds: n * M worlds.

        Here each world is its only possible world; a subclass may return more.
        """
        return worlds

    def _begun(
        self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None, possible: Worlds
    ) -> StepMemory:
        """Return the memory of new episodes, with the first plan and its bound in each world.

        Args:
            worlds: n worlds at the alert.
            rows: [n] rows of the batch in which the episodes start.
            policy: the policy that proposes; for several vehicles, vehicle index -> policy; None: none.
            possible: the possible worlds, M for each world, [n * M].

        """
        members, vehicles = possible.n // worlds.n, self.vehicles
        problem = self._problem(possible, members)
        running = begin_running(problem, members)
        plan = best_constants(worlds, running, self.vehicle, self._width, self.scenario, self.harm_count)
        harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)
        borne = ends_under(running, plan)[1]
        if self.cap is not None:
            running = running._replace(caps=borne)
        if policy is not None:
            policies = policy if isinstance(policy, Mapping) else dict.fromkeys(vehicles[:1], policy)
            if set(policies) != set(vehicles):
                raise InvalidInput(f"shield: policies for vehicles {sorted(policies)}, shielded are {list(vehicles)}")
            drivers = {i: policies[i] for i in vehicles}
            actions = rolled_out(worlds, drivers, self.scenario, self.vehicle, self._width)
            alone = plan_harm(running, actions)
            better = alone <= harm
            if self.cap is not None:
                better &= (ends_under(running, actions)[1] <= borne).all(axis=1)
            plan[better] = actions[better]
            harm = np.where(better, alone, harm)
        settles = ends_under(running, plan)[0]
        harm, enclosure = self._bound_at_alert(possible, problem, rows, plan, harm)
        constants = joint_constants(len(vehicles)) if len(vehicles) > 1 else np.array(CONSTANTS)
        return StepMemory(
            running, Backup(plan, harm, constants), first_bound=harm, alone_harm=alone, settles=settles,
            replaced=np.zeros((worlds.n, *plan.shape[2:]), np.int64), distrusted=np.zeros(worlds.n, np.bool_),
            baseline_shares=borne[::members, borne.shape[1] - worlds.N :], episode=np.zeros(worlds.n, np.int64),
            enclosure=enclosure,
        )  # fmt: skip

    def _problem(self, possible: Worlds, members: int) -> ProfileProblem:
        """Return the possible worlds and the commands of the unshielded vehicles, as a problem of ``engine.profiles``.

        Raises ``InvalidInput`` if these commands are not fixed at the alert. If each world has several possible worlds
        (``members``), each of them must also leave the shielded vehicles at least one decision before the horizon.
        """
        vehicles, horizon_s = self.vehicles, self.scenario.horizon_s
        if members > 1 and self.cap is not None:
            raise InvalidInput(f"shield: cap {self.cap!r} and {members} possible worlds: give one of the two")
        latest = possible.vehicles.latency_s[:, list(vehicles)].min(axis=1).max()
        if members > 1 and not latest < horizon_s:
            raise InvalidInput(
                f"{self.possible_are}: the first decision of vehicle_{vehicles[0] + 1} may be as late as {latest:g} s;"
                f" must be before the horizon, {horizon_s:g} s"
            )
        try:
            others = fixed_commands(self._others, possible, "shield", vehicle=None)
        except InvalidInput as error:
            raise error if members == 1 else InvalidInput(f"{self.possible_are}: {error}") from None
        with renumbered(np.repeat(np.arange(possible.n // members), members)):
            return profile_problem(
                possible, vehicles, harm_count=self.harm_count, horizon_s=horizon_s,
                time_step_s=self.scenario.time_step_s, others_mps2=others, written_out=self.scenario.has_obstacle,
            )  # fmt: skip

    def _bound_at_alert(
        self, possible: Worlds, problem: ProfileProblem, rows: Ints, plan: Floats, harm: Floats
    ) -> tuple[Floats, Any]:
        """Return the bound of the first plans, [n] m2/s2, and the shield's further memory (``StepMemory.enclosure``).

        Here the bound is ``harm``, and the further memory is None. A subclass may compute another bound, and use the
        memory.

        Args:
            possible: the possible worlds at the alert, M for each world.
            problem: the same worlds as a problem of ``engine.profiles``.
            rows: rows of the batch in which the episodes start.
            plan: [n, L] or [n, L, K] first plans.
            harm: [n] their harm in the worst possible world, m2/s2.

        """
        return harm, None

    def decide(
        self,
        proposed: Floats,
        *,
        seen: Floats | None = None,
        only: Bools | None = None,
        proposer: Proposer | None = None,
    ) -> Decision:
        """Decide on the proposed actions in every running episode.

        Args:
            proposed: [n], or [n, K] for several vehicles: proposed actions; clipped to [-1, 1]. Where it is NaN,
                nothing is proposed, and the plan's action is applied.
            seen: [n, columns] the observed worlds, as the first columns of ``Running.states``; None: they are not
                compared with the prediction.
            only: [n] worlds in which to decide; the others stay unchanged. None: all whose episode has not ended.
            proposer: the policies. Where nothing else certifies a proposal, they are simulated from this decision on,
                and their actions are tried as a plan. None: this is not tried.

        Returns the decision, with the actions to apply. Afterwards ``memory`` holds the predicted next state.

        """
        memory = self.memory
        if memory.running is None:
            raise InvalidInput("shield: decide, but no episode has begun; call begin first")
        if np.shape(proposed) != (shape := (*memory.distrusted.shape, *memory.backup.plan.shape[2:])):
            raise InvalidInput(f"shield: proposed {np.shape(proposed)}; {shape} is needed")
        asked = ~memory.running.finished if only is None else only
        if seen is not None:
            memory = self._compared(memory, seen, asked)
        decision, self.memory = self._decided(memory, proposed, asked, proposer)
        return decision

    def _decided(
        self, memory: StepMemory, proposed: Floats, asked: Bools, proposer: Proposer | None
    ) -> tuple[Decision, StepMemory]:
        """Return the decision on ``proposed`` [n] or [n, K] in the worlds ``asked`` [n], and the memory after it.

        ``memory`` is the memory before. ``proposer`` holds the policies to simulate, or None.
        """
        before, held, budget = memory.running, memory.backup, self._bound_of(memory)
        assert before is not None
        goes_on, asked = asked & before.finished, asked & ~before.finished
        each = np.repeat(asked, before.members)
        now = before._replace(ended=before.ended | ~each)
        actions = np.array(proposed, np.float64)
        actions[memory.distrusted] = np.nan
        decision = certify(now, actions, held, budget)
        if proposer is not None:
            decision = certify_by_policy(decision, now, actions, budget, held.plan, proposer)
        decision = self._also_certified(now, memory, budget, decision, asked & ~memory.distrusted)
        decision.reason[asked & memory.distrusted] = ShieldReason.ASSUMPTION_BROKEN
        decision.applied[goes_on] = -1.0  # full braking where the episode should have ended
        after = memory._replace(
            replaced=memory.replaced + (decision.intervened.T & asked).T,
            running=decision.after._replace(ended=np.where(each, decision.after.ended, before.ended)),
            backup=decision.backup,
        )
        decision = decision._replace(bound=self._bound_of(after))
        if self.logging:
            if len(self._entries) > memory.logged:  # entries of a step that was rolled back, or of a copy
                self._entries = self._entries[: memory.logged]
            self._entries.extend(interventions(now, memory.episode, self.vehicles, proposed, decision, held))
            after = after._replace(logged=len(self._entries))
        return decision, after

    def _also_certified(
        self, now: Running, memory: StepMemory, budget: Floats, decision: Decision, asked: Bools
    ) -> Decision:
        """Return the decision to apply, given a decision that keeps the budget in every possible world.

        Here it is returned unchanged; a subclass may replace more actions.

        Args:
            now: the episodes before the decision.
            memory: memory before the decision, with the plan held so far.
            budget: [n] largest accepted harm, m2/s2.
            decision: the decision.
            asked: [n] worlds in which to decide.

        """
        return decision

    def as_seen(self, seen: Floats) -> Floats:
        """Return ``seen`` [n, columns], the observed worlds, in a form that can be compared with the prediction.

        If the prediction has a column for the gap to an obstacle ahead, worlds without obstacle (an infinite gap) get
        the predicted gap there. Otherwise ``seen`` is returned unchanged.
        """
        running = self.memory.running
        assert running is not None
        N = running.problem.mass.shape[1]
        if self.scenario.vehicles == N:
            return seen
        seen = seen.copy()
        seen[:, N] = np.where(np.isposinf(seen[:, N]), running.states[:: running.members, N], seen[:, N])
        return seen

    def expects(self, seen: Floats) -> Bools:
        """Return whether each observed world in ``seen`` [n, columns] agrees with the prediction, [n].

        With one possible world, both must be equal to the bit. With several, each column must lie within the range of
        their predictions, or, after an impact in one of them, be a finite number.
        """
        running = self.memory.running
        assert running is not None
        seen = self.as_seen(seen)
        columns = seen.shape[1]
        if running.members == 1:
            return np.asarray((seen == running.states[:, :columns]).all(axis=1), np.bool_)
        predicted = running.states.reshape(running.n, running.members, -1)
        low, high = predicted[:, :, :columns].min(axis=1) - SLACK, predicted[:, :, :columns].max(axis=1) + SLACK
        within = np.asarray(((seen >= low) & (seen <= high)).all(axis=1), np.bool_)
        return np.asarray(within | (self._leaves_range(running) & np.isfinite(seen).all(axis=1)), np.bool_)

    def _leaves_range(self, running: Running) -> Bools:
        """Return whether an impact has happened in one of a world's possible worlds, [n].

        From then on the world itself may lie outside their range. ``running`` are the predicted episodes.
        """
        N = running.problem.mass.shape[1]
        predicted = running.states.reshape(running.n, running.members, -1)
        return np.asarray((predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2)), np.bool_)

    def _compared(self, memory: StepMemory, seen: Floats, asked: Bools) -> StepMemory:
        """Return the shield's memory after it has compared the observed worlds with the prediction in ``memory``.

        ``seen`` [n, columns] holds the observed worlds, as the first columns of ``Running.states``. Only the worlds
        ``asked`` [n] are compared. Worlds that contradict the prediction are distrusted, and get a new plan from the
        observed state.
        """
        running, backup, seen = memory.running, memory.backup, self.as_seen(seen)
        assert running is not None
        columns, surprising = seen.shape[1], asked & ~self.expects(seen)
        if not surprising.any():
            return memory
        known = np.isfinite(seen).all(axis=1) & ~running.finished  # other worlds keep their prediction, or brake fully
        rows = np.flatnonzero(surprising & known)
        states, ended, at = running.states.copy(), running.ended.copy(), running.rows_of(rows)
        states[at, :columns] = np.repeat(seen[rows], running.members, axis=0)
        ended[at] = np.repeat(running.steps[rows], running.members) >= running.problem.last_step[at]
        running = running._replace(states=states, ended=ended)
        plan, harm = backup.plan.copy(), backup.harm.copy()
        harm[rows] = np.inf
        for constant in (None, *backup.constants):
            trial = backup.plan if constant is None else from_now(backup.plan, constant, running.steps)
            with renumbered(rows):
                found = plan_harm(running.take(rows), trial[rows])
            better = rows[found < harm[rows]]
            harm[rows] = np.minimum(found, harm[rows])
            plan[better] = trial[better]
        distrusted, backup = memory.distrusted | surprising, backup._replace(plan=plan, harm=harm)
        return memory._replace(running=running, backup=backup, distrusted=distrusted)
