"""Step mode for a batch of running episodes: what ``certify`` decides, kept from step to step, watched and logged."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents.believed import SUFFIX, Foretold, Odometer, Ranges, Told, believed_worlds, ranges_of, told_to
from ethbrake_marl.agents.e_v2x_bm import optimise_coupled
from ethbrake_marl.agents.protocol import Agent, fixed_commands, place
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, count_of, renumbered, unknown_name
from ethbrake_marl.harm import check_harm_count
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, concatenate
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.kernel import ROW, number_of_decisions
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import PER_WORLD as OF_PROBLEM
from ethbrake_marl.search import ProfileProblem, profile_problem, state_columns, worlds_at
from ethbrake_marl.shield import enclosure
from ethbrake_marl.shield.certify import (
    CONSTANTS,
    Backup,
    Decision,
    Intervention,
    Proposer,
    Running,
    begin_running,
    bettered_plan,
    borne_under,
    certify,
    certify_rollouts,
    from_now,
    interventions,
    merged,
    no_caps,
    plan_harm,
    plan_rests,
    put,
    rolled_out,
)
from ethbrake_marl.shield.certify_kernel import ENDED, NO_CERTIFICATE, Members, gather, hold_constant, rows_of
from ethbrake_marl.shield.enclosure import CORNERS, INTERIOR, checked_robust
from ethbrake_marl.shield.uncertainty import (
    MOST_CORNERS,
    Uncertainty,
    check_amount,
    check_scenario,
    checked_vehicles,
    policies_of,
)

# The plan that a shield starts with at the alert: constants of least harm, or what the policies do, if that is better.
#
# For one shielded vehicle the constant is the coupled optimum. For several it is the best of these: all brake fully,
# one
# of them takes its coupled optimum while the others brake fully, and what a descent finds from the best of those, one
# vehicle after the other.

LOOKED_AT = np.linspace(0.0, -1.0, 101)  # constant actions, for the bound at the alert where there are several members
GRID = np.linspace(0.0, -1.0, 21)  # ... of the descent of several vehicles
ROUNDS = 2  # of that descent
LADDER = np.linspace(0.0, -1.0, 5)  # actions of the first and of the last vehicle in the constants of several

Cap = Literal["baseline"]
CAPS = ("baseline",)  # of whose plan a vehicle's harm is the most that it may bear


class Settings(NamedTuple):
    """What a shield is set to."""

    scenario: Scenario
    vehicle: int | tuple[int, ...]  # shielded: one, whose actions are [n], or several, [n, K]
    harm_count: HarmCount
    others: Mapping[int, Script]
    uncertainty: Uncertainty | None
    cap: Cap | None
    width: int  # decisions of a plan

    @property
    def vehicles(self) -> tuple[int, ...]:
        """Indices of the shielded vehicles."""
        return (self.vehicle,) if isinstance(self.vehicle, int) else self.vehicle


class Start(NamedTuple):
    """What a shield knows at the alert, of n worlds."""

    running: Running
    backup: Backup
    alone: Floats  # [n] harm of the policies, rolled out; infinity without (m2/s2)
    settles: Bools  # [n] under the plan all rest at the horizon
    baseline: Floats  # [n, N] what each vehicle bears under the best constant (m2/s2)


def start_of(settings: Settings, worlds: Worlds, policies: Mapping[int, Agent] | None) -> Start:
    """The plan to start with in each of these worlds, which are at the alert, as they are believed."""
    possible = worlds if settings.uncertainty is None else settings.uncertainty.members(worlds)
    members = possible.n // worlds.n
    _check_latest(settings, possible, members)
    running = begin_running(*_problem(settings, possible, members))
    constants = joint_constants(len(settings.vehicles)) if len(settings.vehicles) > 1 else np.array(CONSTANTS)
    plan = _baseline(settings, worlds, running)
    if members > 1:
        plan = bettered_plan(running, plan, LOOKED_AT)[0]
    harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)
    borne = borne_under(running, plan)
    if settings.cap is not None:
        running = running._replace(caps=borne)
    if policies is not None:
        actions = rolled_out(
            worlds, policies, settings.scenario, settings.vehicle, running.nominal().problem, settings.width
        )
        alone = plan_harm(running, actions)
        better = alone <= harm
        if settings.cap is not None:
            better &= (borne_under(running, actions) <= borne).all(axis=1)
        plan[better] = actions[better]
        harm = np.where(better, alone, harm)
    baseline = borne[::members, borne.shape[1] - worlds.N :]
    return Start(running, Backup(plan, harm, constants), alone, plan_rests(running, plan), baseline)


def joint_constants(vehicles: int) -> Floats:
    """Constant actions [C, K] of several vehicles, front to rear: all alike, or evenly from one action to another."""
    alike = np.repeat(np.array(CONSTANTS)[:, np.newaxis], vehicles, axis=1)
    share = np.linspace(0.0, 1.0, vehicles)
    ladders = [first + share * (last - first) for first in LADDER for last in LADDER if first != last]
    return np.concatenate([alike, ladders])


def _problem(settings: Settings, possible: Worlds, members: int) -> tuple[ProfileProblem, int]:
    others = fixed_commands(settings.others, possible, "shield", vehicle=None)
    with renumbered(np.repeat(np.arange(possible.n // members), members)):
        problem = profile_problem(
            possible, settings.vehicles, harm_count=settings.harm_count, horizon_s=settings.scenario.horizon_s,
            time_step_s=settings.scenario.time_step_s, others_mps2=others,
        )  # fmt: skip
    return problem, members


def _check_latest(settings: Settings, possible: Worlds, members: int) -> None:
    latest = possible.vehicles.latency_s[:, list(settings.vehicles)].min(axis=1).max()
    if members > 1 and not latest < settings.scenario.horizon_s:
        raise InvalidInput(
            f"uncertainty: {settings.uncertainty}: vehicle_{settings.vehicles[0] + 1} may decide first at {latest:g} s;"
            f" must be before the horizon, {settings.scenario.horizon_s:g} s"
        )


def _baseline(settings: Settings, worlds: Worlds, running: Running) -> Floats:
    """The plans [n, L] or [n, L, K] of the best constant actions found."""
    vehicles, members = settings.vehicles, running.members
    others = np.array(running.problem.command[::members, running.problem.command.shape[1] - worlds.N :])
    others[:, list(vehicles)] = -worlds.vehicles.braking_capacity_mps2[:, list(vehicles)]

    def alone(vehicle: int) -> Floats:
        best = optimise_coupled(
            worlds, vehicle, harm_count=settings.harm_count, horizon_s=settings.scenario.horizon_s, others_mps2=others
        ).deceleration_mps2
        return command_to_action(-best, worlds.vehicles, vehicle)

    if isinstance(settings.vehicle, int):
        return np.repeat(alone(settings.vehicle)[:, np.newaxis], settings.width, axis=1)
    if members > 1:  # a team of one vehicle: no other team is shielded against uncertainty
        return held(alone(vehicles[0])[:, np.newaxis], settings.width)
    braking = np.full((worlds.n, len(vehicles)), -1.0)
    best, least = braking, plan_harm(running, held(braking, settings.width))
    for c, vehicle in enumerate(vehicles):
        action = braking.copy()
        action[:, c] = alone(vehicle)
        best, least = _better(running, best, least, action, settings.width)
    action = best.copy()
    _descend(running, action)
    best, _ = _better(running, best, least, action, settings.width)
    return held(best, settings.width)


def held(action: Floats, width: int) -> Floats:
    """The plans [n, width, K] that hold these actions [n, K]."""
    return np.repeat(action[:, np.newaxis], width, axis=1)


def _better(running: Running, best: Floats, least: Floats, action: Floats, width: int) -> tuple[Floats, Floats]:
    """The actions of less harm, decision by decision; and that harm."""
    harm = plan_harm(running, held(action, width))
    return np.where((harm < least)[:, np.newaxis], action, best), np.minimum(harm, least)


def _descend(running: Running, action: Floats) -> None:
    """Improve constant actions [n, K] in place, one vehicle after the other; of worlds with one member each."""
    problem = running.problem
    assert len(running.states) == len(action)  # the kernel does not look
    descend_constants(
        running.states, running.steps, running.ended, problem.clock, problem.bounds, problem.command, problem.latency,
        problem.mass, problem.limit, no_caps(problem.n), problem.vehicles, GRID, ROUNDS, action,
    )  # fmt: skip


@compiled
def descend_constants(
    states: Floats, steps: Ints, ended: Bools, clock: Floats, bounds: Floats, command: Floats, latency: Floats,
    mass: Floats, limit: Floats, caps: Floats, vehicles: Ints, grid: Floats, rounds: int, action: Floats,
) -> None:  # fmt: skip
    """Replace each vehicle's constant action [n, K] in turn by the best of the grid, by harm in one segment."""
    table, critical = np.zeros((ROW.OF_EPISODE, mass.shape[1])), np.zeros(1, np.int64)
    lines = np.empty((states.shape[0], rows_of(caps), mass.shape[1]))
    gather(lines, 0, command, latency, mass, limit, caps)
    world = Members(table, clock, bounds, lines, vehicles, critical)
    for k in range(states.shape[0]):
        least = hold_constant(world, k, states[k], ended[k], steps[k], action, k)
        for turn in range(rounds * action.shape[1]):
            c = turn % action.shape[1]
            best = action[k, c]
            for g in range(grid.shape[0]):
                action[k, c] = grid[g]
                value = hold_constant(world, k, states[k], ended[k], steps[k], action, k)
                if value < least:
                    best, least = grid[g], value
            action[k, c] = best


BROKEN = ENDED + 1  # a reason that the kernel does not know


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
    surprise. With an ``uncertainty`` (robust mode) all of this holds for the worst member of each world, and what is
    seen must lie within the range of their predictions. Raises ``InvalidInput`` for an unknown count or vehicle, a
    negative allowance, others whose commands are not fixed, or what ``robust`` interior cannot certify.
    """

    fallback = "best constant"

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
        robust: str = enclosure.CORNERS,
        logging: bool = False,
    ) -> None:
        check_harm_count(harm_count)
        check_scenario(scenario, "shield")
        check_amount("allowance", allowance, "shield", " m2/s2")
        self.vehicle = checked_vehicles(vehicle, scenario)
        self.vehicles = (self.vehicle,) if isinstance(self.vehicle, int) else self.vehicle
        if uncertainty is not None and (len(self.vehicles) > 1 or cap is not None):
            what = "several vehicles" if cap is None else "a cap"
            raise InvalidInput(f"shield: uncertainty: {what} with it: not covered; mode robust shields one vehicle")
        if cap not in (None, *CAPS):
            raise unknown_name("shield cap", cap, CAPS)
        self.scenario, self.harm_count, self.allowance = scenario, harm_count, allowance
        self.uncertainty, self.cap = uncertainty, cap
        self.robust = enclosure.checked_robust(robust, "shield")
        self.boxes: enclosure.Boxes | None = None  # where every world of them is certified
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
        enclosure.check_possible(self.robust, scenario, harm_count, self._others)
        self._width = int(number_of_decisions(np.zeros(1), scenario.time_step_s, scenario.horizon_s)[0]) + 1

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
        untouched: Bools = self.interventions == 0
        return untouched

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
        every: Ints = self.replaced.reshape(len(self.replaced), -1).sum(axis=1)
        return every

    def shares(self) -> Floats:
        """What each vehicle bears of the harm if the plan that is held now is executed, [n, N] m2/s2."""
        if self.running is None:
            raise InvalidInput("shield: shares, but no episode has begun; call begin first")
        return borne_under(self.running.nominal(), self.backup.plan)[:, -self.scenario.vehicles :]

    def begin(self, worlds: Worlds, rows: Ints, policy: Agent | Mapping[int, Agent] | None = None) -> None:
        """New episodes start in these rows; ``worlds`` holds those rows only, at the alert, as they are believed.

        The ``policy`` that proposes (of several vehicles: one for each, by index) is rolled out from there.
        Rows 0 to k - 1 together may also begin a larger batch. Raises ``InvalidInput`` for rows that are not there.
        """
        running_rows = len(self.first_bound)
        if not (rows < running_rows).all() and sorted(rows.tolist()) != list(range(len(rows))):
            raise InvalidInput(
                f"shield: begin in row {rows.max()} of a batch of {running_rows}: a larger batch begins with all of its"
                " rows at once"
            )
        settings = Settings(
            self.scenario, self.vehicle, self.harm_count, self._others, self.uncertainty, self.cap, self._width
        )
        new = copy.copy(self)
        start = start_of(settings, worlds, policies_of(policy, self.vehicle))
        if start.running.members > 1 and self.robust == enclosure.INTERIOR:
            assert self.uncertainty is not None
            boxes = enclosure.boxes_of(self.uncertainty.members(worlds), start.running, self.scenario, self._others)
            harm = enclosure.bounds_at_alert(boxes, start.backup.plan, start.backup.harm)
            start = start._replace(backup=start.backup._replace(harm=harm))
            new.boxes = enclosure.placed(self.boxes, boxes, rows)
        new._place(rows, start)
        self.__dict__.update(new.__dict__)

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
        asked = asked & ~before.finished
        each = np.repeat(asked, before.members)
        now = before._replace(ended=before.ended | ~each)
        given = np.array(proposed, np.float64)
        given[self.distrusted] = np.nan
        held, budget = self.backup, self.bound
        decision = certify(now, given, held, budget)
        rejected = (decision.reason == NO_CERTIFICATE).reshape(len(asked), -1).any(axis=1)
        if proposer is not None and (rows := np.flatnonzero(rejected)).size:
            decision = merged(decision, rows, certify_rollouts(now, given, rows, budget, held.plan, proposer))
        decision = enclosure.certify_inside(self.boxes, now, held, budget, decision, asked & ~self.distrusted)
        decision.reason[asked & self.distrusted] = BROKEN
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

    def _compare(self, seen: Floats, asked: Bools) -> None:
        """Find the worlds that did not do what was predicted, and choose anew there from what is seen."""
        assert self.running is not None
        running, columns = self.running, seen.shape[1]
        surprising = asked & ~enclosure.expects(self.boxes, running, seen)
        if not surprising.any():
            return
        self.distrusted = self.distrusted | surprising
        rows = np.flatnonzero(surprising & np.isfinite(seen).all(axis=1))  # others: what was predicted goes on
        states, ended, at = running.states.copy(), running.ended.copy(), running.rows_of(rows)
        states[at, :columns] = np.repeat(seen[rows], running.members, axis=0)
        ended[at] = np.repeat(running.steps[rows], running.members) >= running.problem.last_step[at]
        self.running = running._replace(states=states, ended=ended)
        plan, harm, held = self.backup.plan.copy(), self.backup.harm.copy(), self.backup.plan
        harm[rows] = np.inf
        for constant in (None, *self.backup.constants):
            trial = held if constant is None else from_now(held, constant, running.steps)
            found = _harm_of(self.running, trial, rows)
            better = rows[found < harm[rows]]
            harm[rows] = np.minimum(found, harm[rows])
            plan[better] = trial[better]
        self.backup = self.backup._replace(plan=plan, harm=harm)

    def _place(self, rows: Ints, start: Start) -> None:
        """Keep new episodes in these rows."""
        count, old, running, backup = len(rows), self.running, start.running, start.backup
        new: dict[str, NDArray[Any]] = {
            "first_bound": backup.harm, "alone_harm": start.alone, "settles": start.settles,
            "replaced": np.zeros((count, *backup.plan.shape[2:]), np.int64), "distrusted": np.zeros(count, np.bool_),
            "baseline_shares": start.baseline,
        }  # fmt: skip
        if old is None or count >= old.n:
            order = np.argsort(rows)
            self.running = running.take(order)
            self.backup = backup._replace(plan=backup.plan[order], harm=backup.harm[order])
            self.episode = np.full(count, self.episode.max(initial=-1) + 1)
            for name, values in new.items():
                setattr(self, name, values[order])
            return
        at = old.rows_of(rows)
        arrays: dict[str, Any] = {
            name: put(getattr(old.problem, name), at, getattr(running.problem, name)) for name in OF_PROBLEM
        }
        self.running = Running(
            replace(old.problem, **arrays),
            put(old.states, at, running.states),
            put(old.steps, rows, running.steps),
            put(old.ended, at, running.ended),
            put(old.caps, at, running.caps) if old.caps.size else old.caps,
        )
        plan, harm = put(self.backup.plan, rows, backup.plan), put(self.backup.harm, rows, backup.harm)
        self.backup = self.backup._replace(plan=plan, harm=harm)
        for name, values in {**new, "episode": self.episode[rows] + 1}.items():
            setattr(self, name, put(getattr(self, name), rows, values))


def _harm_of(running: Running, plan: Floats, rows: Ints) -> Floats:
    """Harm of the plans in some of the worlds."""
    with renumbered(rows):
        return plan_harm(running.take(rows), plan[rows])


def by_vehicle(columns: NDArray[Any], vehicles: Sequence[int]) -> NDArray[Any]:
    """What is decided, [n] of one vehicle or [n, K], with the axis of vehicles: [n, K]."""
    return columns.reshape(len(columns), len(vehicles))


# Plans and members that a shield goes on with where it begins anew in the middle of an episode.


class Held(NamedTuple):
    """What a shield holds in some rows."""

    rest: Floats  # [m, L] its plans from the present decision on; full braking after them
    states: Floats  # [m, M, S] of its members now, their harm so far included


def held_in(shield: StepShield, rows: Ints) -> Held:
    """What it holds in some rows, from the present decision on."""
    running = shield.running
    assert running is not None
    plan, done = shield.backup.plan[rows], running.steps[rows]
    column, last = np.arange(plan.shape[1]) + done[:, np.newaxis], plan.shape[1] - 1
    rest = np.take_along_axis(plan, np.minimum(column, last), axis=1)
    states = running.states.reshape(running.n, running.members, -1)[rows]
    return Held(np.where(column <= last, rest, -1.0), states)


def hold_better(shield: StepShield, rows: Ints, old: Held, held_before: Bools) -> None:
    """Count the members' harm so far, and hold what is left of the old plans where it harms no more than the new."""
    running = shield.running
    assert running is not None
    if not held_before.any():
        return
    rows, states, at = rows[held_before], running.states.copy(), running.rows_of(rows[held_before])
    pairs = (states.shape[1] - 1) // 5
    states[at, -2 * pairs :] = old.states[held_before].reshape(len(at), -1)[:, -2 * pairs :]
    shield.running = running._replace(states=states)
    part, plan = shield.running.take(rows), shield.backup.plan[rows].copy()
    harm, before = plan_harm(part, plan), plan_harm(part, old.rest[held_before])
    kept = before <= harm
    plan[kept] = old.rest[held_before][kept]
    shield.backup = shield.backup._replace(
        plan=put(shield.backup.plan, rows, plan), harm=put(shield.backup.harm, rows, np.where(kept, before, harm))
    )


# Shields over a believed world: what is certified is certified on what was received, and nothing else is looked at.
#
# ``step``: every action is certified in the world that the vehicle believes in, with what is not known in the middle of
# its range. That promises nothing of the world as it is. ``robust``: in every corner of the ranges of what is not
# known.
# If the world is such a corner, its harm up to the horizon is at most the first bound: what is heard later leaves those
# corners standing that it agrees with, and the plan that was held is held on unless a better one for them is found.

PER_WORLD = ("predicted_harm", "interventions", "_heard", "_asked_s", "_wanted", "_impact_s")  # arrays [n, ...]
SURPRISE = 1e-6  # by more than this (m, m/s) what is measured is not what was foretold


class _Corners:
    """Worlds that are certified together, in the place of an ``Uncertainty``: the middle ones first."""

    def __init__(self, parts: list[Worlds]) -> None:
        order = np.arange(parts[0].n * len(parts)).reshape(len(parts), parts[0].n).T.ravel()
        self._members = concatenate(parts).take(order)

    def members(self, worlds: Worlds) -> Worlds:
        """The members [n * M], for each world its middle, then its corners."""
        return self._members


class BelievedShield:
    """A ``StepShield`` that certifies what one vehicle proposes on what was really received.

    It begins at the first decision, and anew whenever another vehicle is heard for the first time, is heard to react,
    or moves otherwise than was foretold; what is left of its plan is a candidate for the next one. After the first
    decision ``predicted_harm`` [n] is the first bound; infinite where the vehicle had an impact before, whose harm
    nobody told it. ``robust`` says in which worlds it certifies: None in the middle of what is not known, ``corners``
    also in all corners of its range, and ``interior`` in all worlds of the box around them, once, at the first
    decision. Raises ``InvalidInput`` for a mixture, a scenario with more than ``MOST_CORNERS`` corners, and what
    interior mode cannot certify. ``others`` are scripts of the other vehicles, by index; None: those of the scenario.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        harm_count: HarmCount = "first",
        robust: str | None = None,
        others: Mapping[int, Script] | None = None,
    ) -> None:
        self.scenario = scenario
        self.robust = None if robust is None else checked_robust(robust, SUFFIX)
        self.shield: StepShield | None = None
        self.predicted_harm: Floats = np.zeros(0)
        self.interventions: Ints = np.zeros(0, np.int64)  # [n] so far in the running episodes
        self.decision: Decision | None = None  # the last one
        self._harm_count: HarmCount = harm_count
        self._others = others  # None: the scenario's scripts
        self._odometer = Odometer()
        self._heard: Floats = np.zeros((0, 0))  # what the shield began on; NaN where it has not begun
        self._asked_s: Floats = np.zeros(0)  # [n] time of the last decision
        self._wanted: Floats = np.zeros(0)  # [n] actions
        self._totals: Floats = np.zeros((0, 0, 0))  # [n, M, pairs] foretold total harm at the last decision (m2/s2)
        self._impact_s: Floats = np.zeros((0, 0))  # [n, N] last time at which an impact of this vehicle was foretold
        self._ranges: tuple[int, Ranges] | None = None
        self._ranges_of(scenario.learners[0] if scenario.learners else 0)
        if len(scenario.learners) == 1:
            self._make(scenario.learners[0])  # refuses at once what interior mode cannot certify

    def _make(self, vehicle: int) -> StepShield:
        certain = self.robust or CORNERS
        return StepShield(self.scenario, vehicle, harm_count=self._harm_count, others=self._others, robust=certain)

    @property
    def members(self) -> int:
        """Worlds that are certified for each one: the middle, and all corners."""
        assert self._ranges is not None
        vehicle, ranges = self._ranges
        return 1 if self.robust is None else 1 + 2 ** len(ranges.uncertain(vehicle))

    def branch(self) -> BelievedShield:
        """A copy that goes on apart: what it decides leaves this one as it is."""
        apart = copy.copy(self)
        apart._odometer, apart.shield = copy.deepcopy(self._odometer), copy.copy(self.shield)
        for name in PER_WORLD:
            setattr(apart, name, getattr(self, name).copy())
        return apart

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Remember where these episodes start; nothing has been received yet."""
        self._ranges_of(vehicle)
        if len(rows) >= len(self._wanted) or self.shield is None or self.shield.vehicle != vehicle:
            self.shield = self._make(vehicle)
            self._odometer, self.interventions = Odometer(), np.zeros(0, np.int64)
            self.predicted_harm = self._asked_s = self._wanted = np.zeros(0)
            self._heard, self._impact_s, self._totals = np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0, 0))
        self._odometer.begin(worlds, vehicle, rows)
        none = np.full(len(rows), np.nan)
        self.predicted_harm = place(self.predicted_harm, rows, none)
        self._heard = place(self._heard, rows, np.full((len(rows), 2 * worlds.N), np.nan))
        self._impact_s = place(self._impact_s, rows, np.full((len(rows), worlds.N), -1.0))
        self._asked_s, self._wanted = place(self._asked_s, rows, none), place(self._wanted, rows, np.zeros(len(rows)))
        counted = np.pad(self.interventions, (0, len(self._heard) - len(self.interventions)))
        counted[rows] = 0
        self.interventions = counted

    def decide(
        self, worlds: Worlds, vehicle: int, proposed: Floats, policies: Mapping[int, Agent] | None = None
    ) -> Floats:
        """The certified actions [n], 0 before the vehicle's latency has elapsed; the same if asked again.

        Args:
            worlds: as they are; of them only what the vehicle received is read.
            vehicle: index from 0, the one that began.
            proposed: actions [n].
            policies: who is rolled out in the believed worlds where nothing else certifies a proposal, by vehicle.

        Raises ``InvalidInput`` if an episode never began.

        """
        n, shield = worlds.n, self.shield
        if shield is None or n > len(self._heard):
            raise InvalidInput(f"shield: {SUFFIX}: act on {count_of(n, 'world')}, but begin was not called for each")
        way = self._odometer.look(worlds, vehicle)
        past = worlds.vehicles.latency_s[:, vehicle] <= worlds.time_s
        due = past & (worlds.time_s != self._asked_s) & (worlds.time_s < self.scenario.horizon_s)
        if due.any():
            believed = self._believe(worlds, vehicle, way, None)
            self._begin_anew(worlds, believed, vehicle, way, due)
            assert shield.running is not None
            due &= ~shield.running.finished
            proposer = None if policies is None else Proposer(policies, believed)
            self.decision = decision = shield.decide(proposed, only=due, proposer=proposer)
            self._wanted[due] = decision.applied[due]
            self.interventions = self.interventions + (decision.intervened & due)
            self._asked_s[due] = worlds.time_s[due]
        return self._wanted.copy()

    def _begin_anew(self, worlds: Worlds, believed: Worlds, vehicle: int, way_m: Floats, due: Bools) -> None:
        """Let the shield begin where it has not, or where what was heard was not foretold."""
        shield, told = self.shield, told_to(worlds, vehicle)
        assert shield is not None
        heard = np.concatenate([told.known, told.reacts], axis=1).astype(np.float64)
        fresh, begun = np.isnan(self._heard[:, 0]), shield.running is not None
        keeps, anew = np.zeros_like(told.known), fresh
        if self.robust != INTERIOR:  # its plans are certified from the first decision on, whatever is heard later
            if begun:
                self._note_impacts(worlds)
            keeps = self._keeps(told, worlds.time_s, vehicle)
            surprised = self._is_surprised(believed, told.known & ~keeps) if begun else fresh
            anew = fresh | surprised | (heard != self._heard).any(axis=1)
        rows = np.flatnonzero(due & anew)
        rows = rows if begun else np.arange(worlds.n)
        if not rows.size:
            return
        old = held_in(shield, rows) if begun and self.robust != INTERIOR else None
        keeps = keeps & ~fresh[:, np.newaxis]
        self._begin_shield(worlds.take(rows), believed.take(rows), vehicle, way_m[rows], rows, keeps[rows], old)
        if old is not None:
            hold_better(shield, rows, old, ~fresh[rows])
        rows = rows[due[rows]]  # the others begin anew at their own first decision
        first, self._heard[rows] = rows[fresh[rows]], heard[rows]
        felt = worlds.pair_hit[first, max(vehicle - 1, 0) : vehicle + 1].any(axis=1)
        felt |= worlds.obstacle_hit[first] & (vehicle == 0)
        self.predicted_harm[first] = np.where(felt, np.inf, shield.backup.harm[first])

    def _begin_shield(
        self, worlds: Worlds, believed: Worlds, vehicle: int, way_m: Floats, rows: Ints, keeps: Bools, old: Held | None
    ) -> None:
        """Begin in ``rows``: in the middle of what is open, and for a robust shield in its corners."""
        shield, shares = self.shield, [None, *self._corners(vehicle)]
        assert shield is not None
        parts = []
        for m, share in enumerate(shares):
            foretold = None
            if old is not None:
                expected = worlds_at(believed, old.states[:, m])
                known = keeps.any(axis=1, keepdims=True)
                foretold = Foretold(replace(expected, pair_hit=expected.pair_hit & known), keeps)
            parts.append(self._believe(worlds, vehicle, way_m, share, foretold))
        if self.robust is not None:
            shield.uncertainty = cast(Uncertainty, _Corners(parts))
        shield.begin(parts[0], rows)

    def _keeps(self, told: Told, time_s: Floats, vehicle: int) -> Bools:
        """Whose foretold state tells more than what was told, [n, N]: nobody told anything, or not since an impact."""
        running = None if self.shield is None else self.shield.running
        if running is None:
            return np.zeros(told.known.shape, np.bool_)
        n, N = told.known.shape
        whole = (running.states.shape[1] + 4) // 5  # vehicles of the columns, an obstacle ahead included
        gaps = running.states.reshape(n, running.members, -1)[:, :, whole : 2 * whole - 1]
        touching: Bools = np.any(gaps == 0.0, axis=1)
        pressed = np.zeros((n, whole), np.bool_)
        pressed[:, :-1], pressed[:, 1:] = touching, pressed[:, 1:] | touching
        since = (told.at_s < self._impact_s) | (pressed[:, whole - N :] & (told.at_s < time_s[:, np.newaxis]))
        keeps: Bools = ~told.known | ((self._heard[:, :N] == 1.0) & since)
        keeps[:, vehicle] = False
        return keeps

    def _note_impacts(self, worlds: Worlds) -> None:
        """Write down which vehicles met in some member since the last decision."""
        assert self.shield is not None and self.shield.running is not None
        running = self.shield.running
        pairs = (running.states.shape[1] - 1) // 5
        totals = running.states[:, -pairs:].reshape(worlds.n, running.members, pairs)
        if self._totals.shape == totals.shape:
            met: Bools = np.any(totals > self._totals, axis=1)
            for p in range(pairs):
                for j in {p - pairs + worlds.N - 1, p - pairs + worlds.N} & set(range(worlds.N)):
                    self._impact_s[met[:, p], j] = worlds.time_s[met[:, p]]
        self._totals = totals.copy()

    def _is_surprised(self, believed: Worlds, heard: Bools) -> Bools:
        """Where somebody of whom was ``heard`` [n, N] is not within what the shield foretold, [n]."""
        assert self.shield is not None and self.shield.running is not None
        seen, wrong = state_columns(believed), np.zeros(believed.n, np.bool_)
        first = (seen.shape[1] + 2) // 3 - believed.N  # 1: an obstacle ahead is vehicle 0 of the columns
        foretold = self.shield.running.states.reshape(believed.n, self.shield.running.members, -1)
        outside: Bools = (seen < (foretold.min(axis=1) - SURPRISE)[:, : seen.shape[1]]) | (
            seen > (foretold.max(axis=1) + SURPRISE)[:, : seen.shape[1]]
        )
        for i in range(believed.N):
            wrong |= heard[:, i] & outside[:, first + i]
        for p in range(believed.N - 1):
            wrong |= heard[:, p] & heard[:, p + 1] & outside[:, 2 * first + believed.N + p]
        return wrong

    def _corners(self, vehicle: int) -> list[dict[tuple[str, int], float]]:
        if self.robust is None:
            return []
        uncertain = self._ranges_of(vehicle).uncertain(vehicle)
        return [dict(zip(uncertain, shares, strict=True)) for shares in product((0.0, 1.0), repeat=len(uncertain))]

    def _believe(
        self,
        worlds: Worlds,
        vehicle: int,
        way_m: Floats,
        share: dict[tuple[str, int], float] | None,
        foretold: Foretold | None = None,
    ) -> Worlds:
        others, ranges = self._others, self._ranges_of(vehicle)
        others = script_agents(self.scenario, except_for=vehicle) if others is None else others
        return believed_worlds(worlds, vehicle, ranges, others, way_m, share=share, foretold=foretold)

    def _ranges_of(self, vehicle: int) -> Ranges:
        if self._ranges is None or self._ranges[0] != vehicle:
            ranges = ranges_of(self.scenario, vehicle)
            numbers = len(ranges.uncertain(vehicle))
            if self.robust is not None and 2**numbers > MOST_CORNERS:
                raise InvalidInput(
                    f"robust:{SUFFIX}: scenario {self.scenario.name!r} leaves {numbers} numbers of the other vehicles"
                    f" open, which make {2**numbers} corners; at most {MOST_CORNERS} can be certified"
                )
            self._ranges = vehicle, ranges
        return self._ranges[1]
