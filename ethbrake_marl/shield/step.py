"""Step mode of the shield: a guaranteed harm that holds at every step, whoever proposes the actions.

**Claim.** Let ``B`` be the bound at the first decision: the harm of the backup plan, executed in the engine. If every
step applies what ``certify`` says, the harm realised at the end of the episode is at most ``B``, whatever is proposed,
and the bound never rises on the way. The end is rest or the scenario's horizon. Of what still moves then, and of what
happens afterwards, nothing is claimed.

**Induction.** Between two decisions the shield holds a *plan*, an action for every decision up to the horizon, and its
harm ``c``: the harm of the whole episode if that plan is executed from the present state, with the harm so far, and
with the pairs that were hit before. Both come from one function, ``members.follow_plan``. It advances decision by
decision with the operations of the engine's step in their order, and adds harm in its order. So:

1. *Start.* ``c = B``.
2. *The proposal is applied* only with a plan from the next state whose harm, computed by ``follow_plan`` from that very
   state, is at most the budget. That plan is held from now on, and ``c`` is its harm. If the proposal is the plan's own
   action, the rest of the plan is that plan, with the same ``c``: the same operations on the same numbers.
3. *The plan's action is applied* otherwise. The rest of the plan is executed from a state that ``follow_plan`` passed
   through when it found ``c``: the harm remains ``c`` to the last bit. A plan that harms less may replace it.
4. *End.* When the episode ends nothing is left to execute, and ``c`` is the harm realised.

The budget is ``c``, or anything between ``c`` and ``B``, so ``c <= B`` always. ∎ No tolerance enters: where the engine
does what it is said to do, realised harm and the last bound are the same double.

**Several vehicles.** Where several are shielded, an action above is a row of actions, one for each vehicle, and so is
each entry of the plan; the proof is the same. All proposals together are tried first. If they have no certificate, the
vehicles are taken from front to rear: each proposal replaces that vehicle's action in the joint plan, and is accepted
with a plan behind it whose harm is at most the budget; otherwise that vehicle's planned action stays. Each attempt
begins with a certified plan, and ends with one.

**Several members.** A world may stand for several possible ones, its members. Then every harm above is the largest over
them, and all are advanced by the same actions: the realised harm of *every* member is at most ``B``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self, cast, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.driving import script_agents
from ethbrake_marl.agents.protocol import Agent, fixed_commands
from ethbrake_marl.engine.profiles import ProfileProblem, profile_problem
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, renumbered, unknown_name
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.certify import CONSTANTS, Backup, Decision, certify, from_now, plan_harm
from ethbrake_marl.shield.checks import check_amount, check_scenario
from ethbrake_marl.shield.comparison import SLACK, ends_under
from ethbrake_marl.shield.first_plan import best_constants, joint_constants
from ethbrake_marl.shield.log import Intervention, interventions
from ethbrake_marl.shield.reasons import ShieldReason
from ethbrake_marl.shield.rollouts import Proposer, certify_by_policy, rolled_out
from ethbrake_marl.shield.running import Running, begin_running, put

Cap = Literal["baseline"]  # whose plan a vehicle's harm is the most that it may bear


class StepShield:
    """Guarantee the harm of a batch: ``begin`` when episodes start, ``decide`` in every step.

    Both replace everything it holds in one assignment, and change nothing in place. So what fails, or is interrupted,
    leaves bound, plan and trust as they were, and a ``copy.copy`` goes on apart.

    The bound starts as the harm of the coupled optimum, realised decision by decision, or of a ``policy`` rolled out
    from the alert where that harms less; and it only falls. It bounds the harm up to the scenario's horizon, and says
    nothing of what still moves then, or of what happens afterwards. ``settles`` [n] says where the plan at the alert
    leaves nothing moving.

    What happens is compared with what was predicted, bit by bit. Where it differs (a vehicle brakes beyond its
    capacity, a number is none, a message never came) ``distrusted`` [n] is set, and nothing is guaranteed any more. For
    the rest of the episode the fallback ``best constant`` drives: the better one of the plan's rest and the constants,
    chosen again after every surprise. A world that is asked ``only`` after its episode was to be over brakes fully.

    With several ``possible`` worlds for each one, all of this holds for the worst of them, and what is seen must lie
    within the range of their predictions.

    Args:
        scenario: of all worlds.
        vehicle: index of the shielded vehicle, or of several, front to rear.
        harm_count: the harm that is guaranteed.
        allowance: what the budget grants above the bound, m2/s2; the bound is then that budget until the episode ends.
        others: scripts of the other vehicles, whose commands must be fixed at the alert; None: the scenario's.
        cap: ``baseline``: no vehicle bears more than under the plan of least harm.
        logging: keep every intervention in ``log``.

    Raises ``InvalidInput`` for an unknown count or vehicle, a negative allowance, or others whose commands are not
    fixed.

    """

    possible_are = "possible worlds"  # what messages say of a world's members

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
        self._entries: list[Intervention] = []  # shared with copies; the first ``_logged`` of them are of this one
        self._logged = 0
        self.running: Running | None = None
        self.backup = Backup(np.zeros((0, 0)), np.zeros(0))
        self.first_bound: Floats = np.zeros(0)  # [n] harm of the backup at the first decision
        self.alone_harm: Floats = np.zeros(0)  # [n] of the policy rolled out; infinity without one
        self.settles: Bools = np.zeros(0, np.bool_)  # [n] under the plan of the first decision all rest at the horizon
        self.replaced: Ints = np.zeros(0, np.int64)  # [n] or [n, K] actions so far in the running episodes
        self.episode: Ints = np.zeros(0, np.int64)  # [n] number of each row's running episode
        self.distrusted: Bools = np.zeros(0, np.bool_)
        self.baseline_shares: Floats = np.zeros((0, 0))  # [n, N] what each vehicle bears under the best constants
        scripts = script_agents(scenario, except_for=self.vehicles) if others is None else others
        self._others = {i: script for i, script in scripts.items() if i not in self.vehicles}
        self._width = int(Decisions(np.zeros(1), scenario.time_step_s).before(scenario.horizon_s)[0]) + 1

    @property
    def bound(self) -> Floats:
        """Harm of each running episode is at most this, [n] m2/s2: what certificates may reach."""
        if self.running is None or self.allowance == 0.0:
            return self.backup.harm
        granted = np.where(self.running.finished, 0.0, self.first_bound + self.allowance)
        return np.maximum(self.backup.harm, granted)

    @property
    def predicted_harm(self) -> Floats:
        """What was told at the alert, [n] m2/s2."""
        return self.first_bound + self.allowance

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        return np.asarray(self.interventions == 0, np.bool_)

    @property
    def log(self) -> list[Intervention] | None:
        """Every decision so far in which something else than the proposal was applied; None without ``logging``."""
        return self._entries[: self._logged] if self.logging else None

    def clear_log(self) -> None:
        """Forget what was logged so far: it grows until then."""
        self._entries, self._logged = [], 0

    @property
    def interventions(self) -> Ints:
        """Actions that were replaced so far in each running episode, of all vehicles together, [n]."""
        return np.asarray(self.replaced.reshape(len(self.replaced), -1).sum(axis=1), np.int64)

    def shares(self) -> Floats:
        """What each vehicle bears of the harm if the plan that is held now is executed, [n, N] m2/s2."""
        if self.running is None:
            raise InvalidInput("shield: shares, but no episode has begun; call begin first")
        return ends_under(self.running.nominal(), self.backup.plan)[1][:, -self.scenario.vehicles :]

    def take(self, rows: Ints) -> Self:
        """The shield of some rows, which goes on apart."""
        part, held = copy.copy(self), self.backup
        part.running = None if self.running is None else self.running.take(rows)
        part.backup = held._replace(plan=held.plan[rows], harm=held.harm[rows])
        for name in ("first_bound", "alone_harm", "settles", "replaced", "distrusted", "baseline_shares", "episode"):
            setattr(part, name, getattr(self, name)[rows])
        return part

    def begin(
        self,
        worlds: Worlds,
        rows: Ints,
        policy: Agent | Mapping[int, Agent] | None = None,
        *,
        possible: Worlds | None = None,
    ) -> None:
        """Start new episodes in these rows.

        Rows 0 to k - 1 together may also begin a larger batch. Raises ``InvalidInput`` for rows that are not there.

        Args:
            worlds: of these rows alone, at the alert, as the shield takes them to be.
            rows: where they start.
            policy: proposes, and is rolled out from the alert; of several vehicles, one for each by its index.
            possible: the members of each world [n * M], the world itself first; None: ``members_of(worlds)``.

        """
        running_rows = len(self.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin in row {rows.max()} of a batch of {running_rows}: a larger batch begins with all of its"
                " rows at once"
            )
        new = copy.copy(self)
        new._begin(worlds, rows, policy, self.members_of(worlds) if possible is None else possible)
        self.__dict__.update(new.__dict__)

    def members_of(self, worlds: Worlds) -> Worlds:
        """The members of worlds at the alert, [n * M]: here each world alone."""
        return worlds

    def _begin(self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None, possible: Worlds) -> None:
        """Find the plan to start with in each of these worlds, and keep it in their rows."""
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
        harm = self._bound_at_alert(possible, problem, rows, plan, harm)
        new: dict[str, NDArray[Any]] = {
            "first_bound": harm, "alone_harm": alone, "settles": settles,
            "replaced": np.zeros((worlds.n, *plan.shape[2:]), np.int64), "distrusted": np.zeros(worlds.n, np.bool_),
            "baseline_shares": borne[::members, borne.shape[1] - worlds.N :],
        }  # fmt: skip
        constants = joint_constants(len(vehicles)) if len(vehicles) > 1 else np.array(CONSTANTS)
        self._keep(rows, running, Backup(plan, harm, constants), new)

    def _problem(self, possible: Worlds, members: int) -> ProfileProblem:
        """All possible worlds with the commands of the vehicles that are not shielded; refused if these are not known.

        Where there are several members, each must also leave the shielded vehicles a decision before the horizon.
        """
        vehicles, horizon_s = self.vehicles, self.scenario.horizon_s
        if members > 1 and self.cap is not None:
            raise InvalidInput(f"shield: cap {self.cap!r} and {members} possible worlds: give one of the two")
        latest = possible.vehicles.latency_s[:, list(vehicles)].min(axis=1).max()
        if members > 1 and not latest < horizon_s:
            raise InvalidInput(
                f"{self.possible_are}: vehicle_{vehicles[0] + 1} may decide first at {latest:g} s; must be before the"
                f" horizon, {horizon_s:g} s"
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
    ) -> Floats:
        """The bound [n] of the first plans, whose harm is ``harm`` in the worst member: here that harm."""
        return harm

    def _keep(self, rows: Ints, running: Running, backup: Backup, new: dict[str, NDArray[Any]]) -> None:
        """Put what has begun into its rows, or begin a larger batch with it."""
        old, order = self.running, np.argsort(rows)
        if old is None or running.n >= old.n:
            self.running = running.take(order)
            self.backup = backup._replace(plan=backup.plan[order], harm=backup.harm[order])
            new = {name: values[order] for name, values in new.items()}
            new["episode"] = np.full(running.n, self.episode.max(initial=-1) + 1)
        else:
            at = old.rows_of(rows)
            self.running = Running(
                old.problem.put(at, running.problem), put(old.states, at, running.states),
                put(old.steps, rows, running.steps), put(old.ended, at, running.ended),
                put(old.caps, at, running.caps) if old.caps.size else old.caps,
            )  # fmt: skip
            plan, harm = put(self.backup.plan, rows, backup.plan), put(self.backup.harm, rows, backup.harm)
            self.backup = backup._replace(plan=plan, harm=harm)
            new["episode"] = self.episode[rows] + 1
            new = {name: put(getattr(self, name), rows, values) for name, values in new.items()}
        self.__dict__.update(new)

    def decide(
        self,
        proposed: Floats,
        *,
        seen: Floats | None = None,
        only: Bools | None = None,
        proposer: Proposer | None = None,
    ) -> Decision:
        """Decide in every running episode, or ``only`` in some; the others stay as they are.

        ``seen`` [n, columns]: the worlds as they are now, in the first columns of ``Running.states``. Where nothing
        else certifies a proposal, the ``proposer`` (if given) is rolled out from the state after it.
        """
        if self.running is None:
            raise InvalidInput("shield: decide, but no episode has begun; call begin first")
        if np.shape(proposed) != (shape := (*self.distrusted.shape, *self.backup.plan.shape[2:])):
            raise InvalidInput(f"shield: proposed {np.shape(proposed)}; {shape} is needed")
        after = copy.copy(self)
        decision = after._decided(proposed, seen, ~self.running.finished if only is None else only, proposer)
        self.__dict__.update(after.__dict__)  # in one piece: not even an interrupt comes between
        return decision

    def _decided(self, proposed: Floats, seen: Floats | None, asked: Bools, proposer: Proposer | None) -> Decision:
        """Decide, and become the shield as it will be once that was carried out."""
        assert self.running is not None
        if seen is not None:
            self._compare(seen, asked)
        before = self.running
        goes_on, asked = asked & before.finished, asked & ~before.finished
        each = np.repeat(asked, before.members)
        now = before._replace(ended=before.ended | ~each)
        given = np.array(proposed, np.float64)
        given[self.distrusted] = np.nan
        held, budget = self.backup, self.bound
        decision = certify(now, given, held, budget)
        if proposer is not None:
            decision = certify_by_policy(decision, now, given, budget, held.plan, proposer)
        decision = self._also_certified(now, held, budget, decision, asked & ~self.distrusted)
        decision.reason[asked & self.distrusted] = ShieldReason.ASSUMPTION_BROKEN
        decision.applied[goes_on] = -1.0  # its episode was to be over: it holds the brakes
        self.replaced = self.replaced + (decision.intervened.T & asked).T
        self.running = decision.after._replace(ended=np.where(each, decision.after.ended, before.ended))
        self.backup = decision.backup
        decision = decision._replace(bound=self.bound)
        if self.logging:
            if len(self._entries) > self._logged:  # of a step that was not made, or of a copy
                self._entries = self._entries[: self._logged]
            self._entries.extend(interventions(now, self.episode, self.vehicles, proposed, decision, held))
            self._logged = len(self._entries)
        return decision

    def _also_certified(self, now: Running, held: Backup, budget: Floats, decision: Decision, asked: Bools) -> Decision:
        """What is left of a decision that all members allow: here all of it. ``held``: the backup before it."""
        return decision

    def as_seen(self, seen: Floats) -> Floats:
        """What is seen, with a post ahead where it was predicted: nothing stands there."""
        assert self.running is not None
        N = self.running.problem.mass.shape[1]
        if self.scenario.vehicles == N:
            return seen
        seen = seen.copy()
        seen[:, N] = np.where(np.isposinf(seen[:, N]), self.running.states[:: self.running.members, N], seen[:, N])
        return seen

    def expects(self, seen: Floats) -> Bools:
        """Where what is seen now [n, columns] does not contradict what was predicted, [n].

        One member: where the two are equal to the bit. Several: where each column lies within the range of their
        predictions, or, in a world that may leave that range, is a finite number.
        """
        running = self.running
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
        """Worlds [n] that may leave the range of their members: one of them has had an impact."""
        N = running.problem.mass.shape[1]
        predicted = running.states.reshape(running.n, running.members, -1)
        return np.asarray((predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2)), np.bool_)

    def _compare(self, seen: Floats, asked: Bools) -> None:
        """Find the worlds that did not do what was predicted, and choose anew there from what is seen."""
        assert self.running is not None
        running, seen = self.running, self.as_seen(seen)
        columns, surprising = seen.shape[1], asked & ~self.expects(seen)
        if not surprising.any():
            return
        self.distrusted = self.distrusted | surprising
        known = np.isfinite(seen).all(axis=1) & ~running.finished  # others: what was predicted goes on, or the brakes
        rows = np.flatnonzero(surprising & known)
        states, ended, at = running.states.copy(), running.ended.copy(), running.rows_of(rows)
        states[at, :columns] = np.repeat(seen[rows], running.members, axis=0)
        ended[at] = np.repeat(running.steps[rows], running.members) >= running.problem.last_step[at]
        self.running = running._replace(states=states, ended=ended)
        plan, harm, held = self.backup.plan.copy(), self.backup.harm.copy(), self.backup.plan
        harm[rows] = np.inf
        for constant in (None, *self.backup.constants):
            trial = held if constant is None else from_now(held, constant, running.steps)
            with renumbered(rows):
                found = plan_harm(self.running.take(rows), trial[rows])
            better = rows[found < harm[rows]]
            harm[rows] = np.minimum(found, harm[rows])
            plan[better] = trial[better]
        self.backup = self.backup._replace(plan=plan, harm=harm)
