"""The plan that a shield starts with at the alert: constants of least harm, or what the policies do, if that is
better.

For one shielded vehicle the constant is the coupled optimum. For several it is the best of these: all brake fully,
one of them takes its coupled optimum while the others brake fully, and what a descent finds from the best of those,
one vehicle after the other.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.driving import script_agents
from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.protocol import Agent, fixed_commands
from ethbrake_marl.engine.profiles import profile_problem
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, renumbered, unknown_name
from ethbrake_marl.extensions.certified.enclosure import CORNERS, INTERIOR, Boxes, checked_robust
from ethbrake_marl.extensions.certified.uncertainty import Uncertainty
from ethbrake_marl.game.actions import command_to_action
from ethbrake_marl.game.harm import HarmCount, check_harm_count
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.checks import check_amount, check_scenario
from ethbrake_marl.shield.comparison import SLACK, ends_under
from ethbrake_marl.shield.log import Intervention, interventions
from ethbrake_marl.shield.members import (
    CONSTANTS,
    NO_CERTIFICATE,
    Backup,
    Decision,
    Running,
    ShieldReason,
    begin_running,
    bettered_plan,
    certify,
    descend_constants,
    from_now,
    plan_harm,
    put,
)
from ethbrake_marl.shield.rollouts import Proposer, certify_rollouts, rolled_out

LOOKED_AT = np.linspace(0.0, -1.0, 101)  # constant actions, for the bound at the alert where there are several members

GRID = np.linspace(0.0, -1.0, 21)  # ... of the descent of several vehicles

ROUNDS = 2  # of that descent

LADDER = np.linspace(0.0, -1.0, 5)  # actions of the first and of the last vehicle in the constants of several

Cap = Literal["baseline"]  # whose plan a vehicle's harm is the most that it may bear


def joint_constants(vehicles: int) -> Floats:
    """Constant actions [C, K] of several vehicles, front to rear: all alike, or evenly from one action to another."""
    alike = np.repeat(np.array(CONSTANTS)[:, np.newaxis], vehicles, axis=1)
    share = np.linspace(0.0, 1.0, vehicles)
    ladders = [first + share * (last - first) for first in LADDER for last in LADDER if first != last]
    return np.concatenate([alike, ladders])


def held(action: Floats, width: int) -> Floats:
    """The plans [n, width, K] that hold these actions [n, K]."""
    return np.repeat(action[:, np.newaxis], width, axis=1)


class StepShield:
    """Guarantees the harm of a batch: ``begin`` when episodes start, ``decide`` in every step.

    Both change it in one piece, and nothing that it holds is changed in place: what fails, or is interrupted, leaves
    bound, plan and trust as they were, and a ``copy.copy`` goes on apart.

    The bound starts as the harm of the coupled optimum, realised decision by decision, or as that of a ``policy``
    rolled out from the alert where that is lower, and only ever falls; ``allowance`` (m2/s2) is what the budget grants
    above it (0: none), and the bound is then that budget until the episode ends. It bounds the harm up to the
    scenario's horizon and says nothing of what still moves then, or of what happens afterwards (``settles`` [n]: where
    the plan held at the alert leaves nothing moving). The other vehicles follow ``others``
    (default: the scenario's scripts), whose commands must be fixed at the alert. What happens is compared with what was
    predicted, bit by bit: where it differs (a vehicle that brakes beyond its capacity, a number that is none, a message
    that never came) ``distrusted`` [n] is set, nothing is guaranteed any more, and for the rest of the episode the
    fallback ``best constant`` drives: the better one of the plan's rest and the constants, chosen again after every
    surprise. In a world that is asked ``only`` after its episode was to be over, full braking is applied. With an
    ``uncertainty`` (robust mode) all of this holds for the worst member of each world, and what is seen must lie within
    the range of their predictions. Raises ``InvalidInput`` for an unknown count or vehicle, a negative allowance,
    others whose commands are not fixed, or what ``robust`` interior cannot certify.
    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int | Sequence[int],
        *,
        harm_count: HarmCount = "first",
        allowance: float = 0.0,
        others: Mapping[int, Script] | None = None,
        uncertainty: Uncertainty | None = None,
        cap: Cap | None = None,
        robust: str = CORNERS,
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
        self.vehicles = tuple(map(int, each))
        self.vehicle = self.vehicles if several else self.vehicles[0]
        if uncertainty is not None and (len(self.vehicles) > 1 or cap is not None):
            what = "several vehicles" if cap is None else "a cap"
            raise InvalidInput(f"shield: uncertainty: {what} with it: not covered; mode robust shields one vehicle")
        if cap not in (None, *get_args(Cap)):
            raise unknown_name("shield cap", cap, get_args(Cap))
        self.scenario, self.harm_count, self.allowance = scenario, harm_count, allowance
        self.uncertainty, self.cap = uncertainty, cap
        self.robust = checked_robust(robust, "shield")
        self.boxes: Boxes | None = None  # where every world of them is certified
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
        Boxes.check_possible(self.robust, scenario, harm_count, self._others)
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

    def take(self, rows: Ints) -> StepShield:
        """The shield of some rows, which goes on apart."""
        part, held = copy.copy(self), self.backup
        part.running = None if self.running is None else self.running.take(rows)
        part.boxes = None if self.boxes is None else self.boxes.take(rows)
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
        """New episodes start in these rows; ``worlds`` holds those rows only, at the alert, as they are believed.

        The ``policy`` that proposes (of several vehicles: one for each, by index) is rolled out from there. Certified
        are the members of the ``uncertainty``, or the ``possible`` worlds [n * M], each world's own one first.
        Rows 0 to k - 1 together may also begin a larger batch. Raises ``InvalidInput`` for rows that are not there.
        """
        running_rows = len(self.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin in row {rows.max()} of a batch of {running_rows}: a larger batch begins with all of its"
                " rows at once"
            )
        new = copy.copy(self)
        new._begin(worlds, rows, policy, possible)
        self.__dict__.update(new.__dict__)

    def _begin(
        self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None, possible: Worlds | None
    ) -> None:
        """Find the plan to start with in each of these worlds, and keep it in their rows."""
        if possible is None:
            possible = worlds if self.uncertainty is None else self.uncertainty.members(worlds)
        members, vehicles, horizon_s = possible.n // worlds.n, self.vehicles, self.scenario.horizon_s
        if members > 1 and self.cap is not None:
            raise InvalidInput(f"shield: cap {self.cap!r} and {members} possible worlds: give one of the two")
        latest = possible.vehicles.latency_s[:, list(vehicles)].min(axis=1).max()
        if members > 1 and not latest < horizon_s:
            raise InvalidInput(
                f"uncertainty: {self.uncertainty}: vehicle_{vehicles[0] + 1} may decide first at {latest:g} s; must be"
                f" before the horizon, {horizon_s:g} s"
            )
        try:
            others = fixed_commands(self._others, possible, "shield", vehicle=None)
        except InvalidInput as error:
            raise error if members == 1 else InvalidInput(f"uncertainty: {self.uncertainty}: {error}") from None
        with renumbered(np.repeat(np.arange(worlds.n), members)):
            problem = profile_problem(
                possible, vehicles, harm_count=self.harm_count, horizon_s=horizon_s,
                time_step_s=self.scenario.time_step_s, others_mps2=others, written_out=self.scenario.has_obstacle,
            )  # fmt: skip
        running = begin_running(problem, members)
        plan = self._best_constants(worlds, running)
        if members > 1:
            plan = bettered_plan(running, plan, LOOKED_AT)[0]
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
        if members > 1 and self.robust == INTERIOR:
            boxes = Boxes.of(possible, problem, worlds.n, self.scenario, self._others)
            harm = boxes.at_alert(plan, harm)
            self.boxes = boxes.placed(self.boxes, rows)
        constants = joint_constants(len(vehicles)) if len(vehicles) > 1 else np.array(CONSTANTS)
        new: dict[str, NDArray[Any]] = {
            "first_bound": harm, "alone_harm": alone, "settles": settles,
            "replaced": np.zeros((worlds.n, *plan.shape[2:]), np.int64), "distrusted": np.zeros(worlds.n, np.bool_),
            "baseline_shares": borne[::members, borne.shape[1] - worlds.N :],
        }  # fmt: skip
        old, order = self.running, np.argsort(rows)
        if old is None or worlds.n >= old.n:
            self.running, self.backup = running.take(order), Backup(plan[order], harm[order], constants)
            new = {name: values[order] for name, values in new.items()}
            new["episode"] = np.full(worlds.n, self.episode.max(initial=-1) + 1)
        else:
            at = old.rows_of(rows)
            self.running = Running(
                old.problem.put(at, problem), put(old.states, at, running.states), put(old.steps, rows, running.steps),
                put(old.ended, at, running.ended), put(old.caps, at, running.caps) if old.caps.size else old.caps,
            )  # fmt: skip
            self.backup = Backup(put(self.backup.plan, rows, plan), put(self.backup.harm, rows, harm), constants)
            new["episode"] = self.episode[rows] + 1
            new = {name: put(getattr(self, name), rows, values) for name, values in new.items()}
        self.__dict__.update(new)

    def _best_constants(self, worlds: Worlds, running: Running) -> Floats:
        """The plans [n, L] or [n, L, K] of the best constant actions found."""
        vehicles, members = list(self.vehicles), running.members
        others = np.array(running.problem.command[::members, running.problem.command.shape[1] - worlds.N :])
        others[:, vehicles] = -worlds.vehicles.braking_capacity_mps2[:, vehicles]

        def alone(vehicle: int) -> Floats:
            best = optimise_coupled(
                worlds, vehicle, harm_count=self.harm_count, horizon_s=self.scenario.horizon_s, others_mps2=others
            ).deceleration_mps2
            return command_to_action(-best, worlds.vehicles, vehicle)

        if isinstance(self.vehicle, int):
            return np.repeat(alone(self.vehicle)[:, np.newaxis], self._width, axis=1)
        if members > 1:  # a team of one vehicle: no other team is shielded against uncertainty
            return held(alone(vehicles[0])[:, np.newaxis], self._width)
        best = np.full((worlds.n, len(vehicles)), -1.0)
        least = plan_harm(running, held(best, self._width))
        for c in range(len(vehicles) + 1):
            if c < len(vehicles):
                action = np.full_like(best, -1.0)
                action[:, c] = alone(vehicles[c])
            else:
                action = best.copy()
                descend_constants(running.uncapped, GRID, ROUNDS, action)
            harm = plan_harm(running, held(action, self._width))
            best, least = np.where((harm < least)[:, np.newaxis], action, best), np.minimum(harm, least)
        return held(best, self._width)

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
        rejected = (decision.reason == NO_CERTIFICATE).reshape(len(asked), -1).any(axis=1)
        if proposer is not None and (rows := np.flatnonzero(rejected)).size:
            found = certify_rollouts(now, given, rows, budget, held.plan, proposer)
            margin, plan = decision.margin.copy(), found.backup.plan
            margin[rows] = np.maximum(margin[rows], found.margin)
            assert (plan == from_now(decision.backup.plan[rows], plan, found.after.steps - 1)).all()  # one past
            kept = np.flatnonzero((found.reason != NO_CERTIFICATE).reshape(len(rows), -1).all(axis=1))
            decision = decision._replace(margin=margin).put(rows[kept], found._replace(margin=margin[rows]), kept)
        decision = certify_inside(self.boxes, now, held, budget, decision, asked & ~self.distrusted)
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

        One member: where it is what was predicted, to the bit. Several: where it lies within the range of their
        predictions, by column; once one of them has had an impact, worlds between the corners may leave that range, and
        any finite numbers will do. So they will where the own latency of a box is uncertain (a decision falls at
        another time in each of its worlds then), and where friction is.
        """
        running, boxes = self.running, self.boxes
        assert running is not None
        seen = self.as_seen(seen)
        columns, N = seen.shape[1], running.problem.mass.shape[1]
        if running.members == 1:
            return np.asarray((seen == running.states[:, :columns]).all(axis=1), np.bool_)
        predicted = running.states.reshape(running.n, running.members, -1)
        low, high = predicted[:, :, :columns].min(axis=1) - SLACK, predicted[:, :, :columns].max(axis=1) + SLACK
        within = np.asarray(((seen >= low) & (seen <= high)).all(axis=1), np.bool_)
        anywhere = (predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2))
        if boxes is not None:
            own = 2 * boxes.limit.shape[1] + boxes.vehicle
            anywhere |= boxes.high[:, own] > boxes.low[:, own]
        if self.uncertainty is not None and self.uncertainty.moves_together:
            anywhere[:] = True
        return np.asarray(within | (anywhere & np.isfinite(seen).all(axis=1)), np.bool_)

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


def certify_inside(
    boxes: Boxes | None, running: Running, held: Backup, budget: Floats, decision: Decision, asked: Bools
) -> Decision:
    """A decision that the corners allow, refused where its plan is not certified for every world of the box, if any.

    ``held`` is the backup before it. A plan without a certificate never replaces the held one. Episodes end at the
    horizon: that all corners rest does not mean that every world does.
    """
    if boxes is None:
        return decision
    plan, other = decision.backup.plan.copy(), (decision.backup.plan != held.plan).any(axis=1)
    bound = np.where(asked & ~other, held.harm, decision.bound)  # of the corners alone, where the plan is the same
    changed = np.flatnonzero(asked & other)
    found = boxes.bound(changed, plan[changed], budget[changed], only_enough=True)
    least = np.where(decision.intervened, held.harm, budget)[changed]
    good = found <= least
    bound[changed[good]] = found[good]
    known = np.isfinite(found)
    decision.margin[changed[known]] = (budget[changed] - found)[known]
    bad = changed[~good]
    plan[bad], bound[bad] = held.plan[bad], held.harm[bad]
    decision = decision._replace(bound=bound, backup=decision.backup._replace(plan=plan, harm=bound))
    refused = bad[~decision.intervened[bad]]
    if refused.size:  # the held plan's action instead
        part, plan = running.take(refused), held.plan[refused]
        action, harm = plan[np.arange(len(plan)), part.steps], held.harm[refused]
        with renumbered(refused):
            instead = certify(part, action, Backup(plan, harm, held.constants), harm)
        every, reason = np.ones(len(refused), np.bool_), np.full(len(refused), NO_CERTIFICATE)
        instead = instead._replace(intervened=every, reason=reason, margin=decision.margin[refused])
        decision = decision.put(refused, instead, np.arange(len(refused)))
    after = decision.after
    over = np.repeat(after.steps, after.members) >= after.problem.last_step
    each = np.repeat(asked, after.members)
    return decision._replace(after=after._replace(ended=np.where(each, over, after.ended)))
