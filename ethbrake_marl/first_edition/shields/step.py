"""Mode ``step`` of the shield: keep the harm of the episode within a bound, whatever actions are proposed.

**Claim.** Let ``B`` be the bound at the first decision, which is the harm of the plan made at the alert. If every step
applies the action that ``certify`` returns, then the harm at the end of the episode is at most ``B``, whatever actions
are proposed. The bound never rises during the episode. An episode ends at rest or at the scenario's horizon. The claim
does not cover anything that happens after the horizon.

**Induction.** Between two decisions the shield has a *plan*. Let ``c`` be the harm of the plan: the harm of the whole
episode if the plan is executed from the present state. ``c`` includes the harm so far. In the first-impact count, ``c``
leaves out further impacts of pairs that already had an impact. The function ``members.follow_plan`` computes ``c``: it
simulates the plan decision by decision, with the same floating-point operations as the engine's step, in the same
order, and adds up the harm in the same order as the engine. Hence:

1. *Start.* At the first decision ``c = B``.

2. *A proposal is applied* only if the harm of some plan from the next state on is at most the budget. ``follow_plan``
   computes the harm of this new plan from exactly the next state. The new plan becomes the shield's plan, and its harm
   becomes ``c``. If the proposal equals the planned action, the plan and ``c`` stay the same, because a new simulation
   would repeat the same operations.

3. *Otherwise the planned action is applied.* When ``follow_plan`` computed ``c``, the simulation passed through the
   state after the planned action. So from this state on, the rest of the plan again has the harm ``c``, to the last
   bit. The shield may also replace the rest of the plan by a plan with less harm.

4. *End.* When the episode ends, no action is left to execute, and ``c`` is the harm of the episode.

The *budget* is the largest harm that a new plan may have: ``c``, or any value from ``c`` to ``B``. Hence ``c <= B`` at
every decision. ∎

The proof needs no tolerance: as long as the engine behaves as predicted, the harm of the episode and the last bound are
the same floating-point number.

**Several vehicles.** With several shielded vehicles, each action in the proof is an array with one action per shielded
vehicle. The shield first tries all proposals together. If no plan after all proposals stays within the budget, the
shield tries the proposals one by one, front to rear: one vehicle's proposal replaces that vehicle's action in the plan.
A single proposal is accepted if some plan after this proposal stays within the budget; if not, the vehicle's planned
action remains. Before and after each proposal is tried, the shield has a plan whose harm is at most the budget.

**Several members.** With several possible worlds (*members*) of a world, each harm in the proof is the largest harm
over the members, and the same actions are executed in all members. So in *every* member the harm of the episode is at
most ``B``.

Arguments that several methods share:

- ``worlds``: n worlds at the alert; ``possible``: the M possible worlds of each world, [n * M], with the world itself
  first.
- ``rows``: indices of the batch rows in which new episodes start, [n].
- ``memory``: the shield's memory before the decision; ``asked``: True for each world in which the shield
  must choose an action, [n].
- ``seen``: the observed state of each world, [n, columns], in the order of the columns of ``Running.states``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self, cast, get_args

import numpy as np

from ethbrake_marl.errors import InvalidInput, renumbered, unknown_name
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.agents.protocol import Agent, fixed_commands
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, profile_problem
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.messages import refuse_untold
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.certify import CONSTANTS, Backup, Decision, certify, from_now, plan_harm
from ethbrake_marl.first_edition.shields.checks import check_amount, check_scenario
from ethbrake_marl.first_edition.shields.comparison import SLACK, ends_under
from ethbrake_marl.first_edition.shields.first_plan import best_constants, joint_constants
from ethbrake_marl.first_edition.shields.log import Intervention, interventions
from ethbrake_marl.first_edition.shields.reasons import ShieldReason
from ethbrake_marl.first_edition.shields.rollouts import Proposer, certify_by_policy, rolled_out
from ethbrake_marl.first_edition.shields.running import Running, begin_running
from ethbrake_marl.first_edition.shields.step_memory import StepMemory

Cap = Literal["baseline"]  # plan that sets the caps: a vehicle may bear at most the harm that it bears under this plan


class StepShield:
    """Bound the harm of a batch of episodes: call ``begin`` when episodes start and ``decide`` before every step.

    ``begin`` and ``decide`` replace ``memory`` as a whole and change no array in place. If ``begin`` or ``decide``
    raises an error, the shield keeps its old memory. A copy of the shield by ``copy.copy`` is independent of the
    original.

    At the alert the bound is the harm of E-V2X-BM's constant deceleration, executed decision by decision. In worlds
    where ``policy``, simulated from the alert, does less harm than E-V2X-BM, the bound is the policy's harm.

    At each decision the observed worlds are compared with the shield's prediction, bit by bit. If a world differs from
    its prediction (a vehicle brakes beyond its capacity, a number is NaN, a message is missing), this world is marked
    in ``memory.distrusted`` [n], and its bound no longer holds. In a distrusted world the shield ignores proposals for
    the rest of the episode, and applies the rest of the plan or the best constant action, whichever does less harm. The
    shield chooses again whenever a distrusted world differs from the new prediction. If the engine continues an episode
    after the end that the shield predicted, the shielded vehicles brake fully.

    With several ``possible`` worlds for each world, each harm is the largest harm over the possible worlds, and each
    observed number must lie within the range of its predictions.

    Args:
        scenario: the scenario of all worlds.
        vehicle: index of the shielded vehicle (0 = front), or indices of several, front to rear.
        harm_count: which harm is bounded: ``first`` (first impact of each pair) or ``total`` (every impact).
        allowance: amount by which the bound is loosened until the episode ends, m2/s2.
        others: scripts of the unshielded vehicles (vehicle index -> script); each script must fix its commands at the
            alert. None: the scenario's scripts.
        cap: ``baseline``: no vehicle bears more harm than under the constant actions that do the least harm; None: only
            the harm summed over all vehicles is bounded.
        logging: whether ``log`` lists the interventions (replaced actions).

    Raises ``InvalidInput`` for an unknown harm count, an unknown vehicle, a negative allowance, or a script in
    ``others`` whose commands are not fixed at the alert.

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
            raise InvalidInput(f"shield: vehicle = {vehicle!r}: must be different indices in increasing order")
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
        """Bound of each running episode, [n] m2/s2."""
        return self._bound_of(self.memory)

    def _bound_of(self, memory: StepMemory) -> Floats:
        running, harm = memory.running, memory.backup.harm
        if running is None or self.allowance == 0.0:
            return harm
        return np.maximum(harm, np.where(running.finished, 0.0, memory.first_bound + self.allowance))

    @property
    def predicted_harm(self) -> Floats:
        """Bound of each episode at the alert, including the allowance, [n] m2/s2."""
        return self.memory.first_bound + self.allowance

    @property
    def chosen_policy(self) -> Bools:
        """For each world: True if no action has been replaced so far in the running episode, [n]."""
        return np.asarray(self.interventions == 0, np.bool_)

    @property
    def log(self) -> list[Intervention] | None:
        """Interventions (replaced actions) since the last call of ``clear_log``; None if ``logging`` is False."""
        return self._entries[: self.memory.logged] if self.logging else None

    def clear_log(self) -> None:
        """Delete all log entries. If ``clear_log`` is never called, the log grows without limit."""
        self._entries, self.memory = [], self.memory._replace(logged=0)

    @property
    def interventions(self) -> Ints:
        """Number of actions replaced so far in each running episode, summed over the vehicles, [n]."""
        return np.asarray(self.memory.replaced.reshape(len(self.memory.replaced), -1).sum(axis=1), np.int64)

    def shares(self) -> Floats:
        """Return the harm that each vehicle bears in the whole episode under the present plan, [n, N] m2/s2."""
        running, backup = self.memory.running, self.memory.backup
        if running is None:
            raise InvalidInput("shield: shares() was called before any episode began; call begin first")
        return ends_under(running.nominal(), backup.plan)[1][:, -self.scenario.vehicles :]

    def take(self, rows: Ints) -> Self:
        """Return an independent copy of the shield that contains only the episodes in the rows ``rows``."""
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

        To enlarge the batch to k rows, start episodes in all rows from 0 to k - 1 in one call.

        Args:
            worlds: the worlds of the new episodes, as the shield assumes them (the true worlds may differ).
            rows: indices of the batch rows in which the new episodes start.
            policy: policy that is simulated from the alert, or vehicle index -> policy for several vehicles; in worlds
                where it does less harm than the best constant actions, its harm is the bound. None: the bound is the
                harm of the best constant actions.
            possible: the possible worlds of each world; None: the result of ``members_of(worlds)``.

        Raises ``InvalidInput`` for rows that do not exist in the batch, and if the messages in ``worlds`` lack a
        quantity that the shield needs.

        """
        running_rows = len(self.memory.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin was called for row {rows.max()}, but the shield has only {running_rows} rows (worlds);"
                " to add rows, call begin for all rows, old and new, at once"
            )
        refuse_untold(worlds, self.vehicles, "shield")
        possible = self.members_of(worlds) if possible is None else possible
        self.memory = self.memory.put(rows, self._begun(worlds, rows, policy, possible))

    def members_of(self, worlds: Worlds) -> Worlds:
        """Return the M possible worlds of each of n worlds at the alert, as one batch of n * M worlds.

        In this class the only possible world is the world itself. A subclass may return several.
        """
        return worlds

    def _begun(
        self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None, possible: Worlds
    ) -> StepMemory:
        """Return the shield's memory of new episodes, with the plan and the bound of each world at the alert."""
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
                raise InvalidInput(
                    f"shield: policy has a policy for the vehicle indices {sorted(policies)}; must have one for each"
                    f" shielded vehicle, {list(vehicles)}, and for no other"
                )
            drivers = {i: policies[i] for i in vehicles}
            actions = rolled_out(worlds, drivers, self.scenario, self.vehicle, self._width)
            alone = plan_harm(running, actions)
            better = alone <= harm
            if self.cap is not None:
                better &= (ends_under(running, actions)[1] <= borne).all(axis=1)
            plan[better] = actions[better]
            harm = np.where(better, alone, harm)
        settles = ends_under(running, plan)[0]
        constants = joint_constants(len(vehicles)) if len(vehicles) > 1 else np.array(CONSTANTS)
        return StepMemory(
            running, Backup(plan, harm, constants), first_bound=harm, alone_harm=alone, settles=settles,
            replaced=np.zeros((worlds.n, *plan.shape[2:]), np.int64), distrusted=np.zeros(worlds.n, np.bool_),
            baseline_shares=borne[::members, borne.shape[1] - worlds.N :], episode=np.zeros(worlds.n, np.int64),
        )  # fmt: skip

    def _problem(self, possible: Worlds, members: int) -> ProfileProblem:
        """Return the possible worlds and the unshielded vehicles' commands, as input for ``engine.profiles``.

        ``members`` is the number M of possible worlds of each world. Raises ``InvalidInput`` if a script's commands are
        not fixed at the alert. With several possible worlds, also raises ``InvalidInput`` if the shield has a cap, or
        if in one possible world the first decision is not before the horizon.
        """
        vehicles, horizon_s = self.vehicles, self.scenario.horizon_s
        if members > 1 and self.cap is not None:
            raise InvalidInput(
                f"shield: cap = {self.cap!r}: must be None for a shield that considers several possible worlds (here"
                f" {members}) for each world"
            )
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
            proposed: proposed actions, [n], or [n, K] for several vehicles; clipped to [-1, 1]. Where the proposal is
                NaN, the planned action is applied.
            seen: the observed worlds, which are compared with the prediction; None: nothing is compared.
            only: True for each world in which to decide, [n]; all other worlds stay unchanged. None: the shield decides
                in every world whose episode has not ended.
            proposer: the policies that propose actions. If no other plan certifies a proposal, the shield simulates the
                policies after this proposal, and tries their actions as a plan. None: no policy is simulated.

        Returns the decision with the actions to apply. After the call, ``memory`` contains the state that is predicted
        for the next decision.

        """
        memory = self.memory
        if memory.running is None:
            raise InvalidInput("shield: decide() was called before any episode began; call begin first")
        if np.shape(proposed) != (shape := (*memory.distrusted.shape, *memory.backup.plan.shape[2:])):
            raise InvalidInput(f"shield: proposed has the shape {np.shape(proposed)}; must have the shape {shape}")
        asked = ~memory.running.finished if only is None else only
        if seen is not None:
            memory = self._compared(memory, seen, asked)
        decision, self.memory = self._decided(memory, proposed, asked, proposer)
        return decision

    def _decided(
        self, memory: StepMemory, proposed: Floats, asked: Bools, proposer: Proposer | None
    ) -> tuple[Decision, StepMemory]:
        """Return the decision on ``proposed`` [n] or [n, K], and the memory after the decision."""
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

    def as_seen(self, seen: Floats) -> Floats:
        """Return the observed worlds ``seen`` in a form that can be compared with the prediction.

        Predictions may have a column for the gap to an obstacle ahead. In worlds without an obstacle, the observed gap
        to the obstacle is infinite; the result contains the predicted number instead.
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
        """Return whether each observed world in ``seen`` agrees with the prediction, [n].

        With a single possible world, each observed number must equal the predicted number to the bit. With several
        possible worlds, each observed number must lie within the range of its predictions in the possible worlds. Once
        an impact has happened in one of the possible worlds, every finite observed number is accepted.
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
        """For each world: return whether an impact has happened in at least one of its possible worlds, [n].

        After an impact in a possible world, the true world may lie outside the range of the possible worlds.
        """
        N = running.problem.mass.shape[1]
        predicted = running.states.reshape(running.n, running.members, -1)
        return np.asarray((predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2)), np.bool_)

    def _compared(self, memory: StepMemory, seen: Floats, asked: Bools) -> StepMemory:
        """Compare the observed worlds with the prediction in ``memory``; return the new memory.

        A world that differs from the prediction becomes distrusted, and gets a new plan from the observed state on.
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
