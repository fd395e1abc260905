"""Shields that decide in the estimated world: they use only the information that their vehicle received.

The module ``estimated`` explains the *estimated world*. Mode ``step`` certifies every action in the median world, the
estimated world in which every unknown quantity has its median, and promises nothing about the true world. Mode
``robust`` also certifies every action in the corners: the estimated worlds in which every unknown quantity has its
smallest or largest value. If the true world is one of the corners, the harm in the true world up to the horizon is at
most the bound at the first decision. This bound holds for two reasons: a later message only removes corners that
contradict the message, and a new plan replaces the present plan only if the new plan is better in the remaining
corners. If the true world lies between the corners, the harm can exceed the bound.

Arguments that several methods share: ``worlds`` are the true worlds, ``estimated`` the estimated worlds at the same
time, ``rows`` [m] the indices of episodes in the batch, and ``way_m`` is the distance that the shielded vehicle has
travelled since the alert, m, one number for each world.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.extensions.certified.estimated import Ranges
from ethbrake_marl.extensions.certified.estimating_agents import Odometer
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import MOST_CORNERS, Uncertainty
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.agents.received import Received
from ethbrake_marl.first_edition.engine.memory import renew_memory, take_memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.certify import Decision, plan_harm
from ethbrake_marl.first_edition.shields.comparison import seen_columns, worlds_at
from ethbrake_marl.first_edition.shields.rollouts import Proposer
from ethbrake_marl.first_edition.shields.running import put
from ethbrake_marl.first_edition.shields.step import StepShield

PER_WORLD = ("predicted_harm", "interventions", "_heard", "_asked_s", "_wanted", "_impact_s")  # attributes [n, ...]

SURPRISE = 1e-6  # largest difference (m, m/s) between a measurement and its prediction that counts as equal


def _hold_better(shield: StepShield, rows: Ints, before: StepShield) -> None:
    """After a restart of ``shield`` in the episodes ``rows``, restore the harm so far, and replace each new plan by the
    rest of the old plan if the predicted harm of this rest is at most the predicted harm of the new plan.

    ``before`` is a copy of the shield from before the restart; the function changes ``shield`` in place.
    """
    (running, backup), (old, held) = shield.memory[:2], before.memory[:2]
    assert running is not None and old is not None
    at, plan, width = running.rows_of(rows), backup.plan[rows].copy(), held.plan.shape[1]
    N, states = running.problem.mass.shape[1], running.states.copy()
    states[at, 3 * N - 2 : 5 * N - 4] = old.states[at, 3 * N - 2 : 5 * N - 4]  # harm
    running = running._replace(states=states)
    column = np.arange(width) + old.steps[rows, np.newaxis]
    rest = np.take_along_axis(held.plan[rows], np.minimum(column, width - 1), axis=1)
    rest = np.where(column < width, rest, -1.0)  # full braking after the plan
    part = running.take(rows)
    harm, still = plan_harm(part, plan), plan_harm(part, rest)
    plan[still <= harm] = rest[still <= harm]
    backup = backup._replace(plan=put(backup.plan, rows, plan), harm=put(backup.harm, rows, np.minimum(still, harm)))
    shield.memory = shield.memory._replace(running=running, backup=backup)


class EstimatedShield:
    """``StepShield`` that certifies the proposed actions of one vehicle in its estimated world.

    The shield starts at the first decision. The shield restarts when its vehicle learns of a further vehicle, learns
    that another vehicle reacts, or sees a vehicle move otherwise than predicted. After a restart, the shield keeps the
    rest of the previous plan if the predicted harm of this rest is at most the predicted harm of the new plan.
    ``predicted_harm`` [n] is the bound on harm at the first decision. It is infinite if the vehicle had an impact
    before the first decision, because the harm of that impact is unknown.

    Args:
        scenario: the scenario of the worlds; a mixture of scenarios raises ``InvalidInput``.
        vehicle: index of the shielded vehicle.
        harm_count: ``first`` or ``total``.
        robust: worlds in which actions are certified. False: only the median world. True: the median world and all
            corners of the ranges of the unknown quantities; more than ``MOST_CORNERS`` corners raise ``InvalidInput``.
        others: scripts of the other vehicles by vehicle index; None: the scripts of the scenario.

    """

    def __init__(
        self,
        scenario: Scenario,
        vehicle: int,
        *,
        harm_count: HarmCount = "first",
        robust: bool = False,
        others: Mapping[int, Script] | None = None,
    ) -> None:
        self.scenario, self.vehicle, self.robust = scenario, vehicle, robust
        self.predicted_harm: Floats = np.zeros(0)
        self.interventions: Ints = np.zeros(0, np.int64)  # [n] number of interventions so far in the running episodes
        self.decision: Decision | None = None  # last decision
        self._harm_count: HarmCount = harm_count
        self._others = script_agents(scenario, except_for=vehicle) if others is None else others
        self._odometer: tuple[Floats, ...] = ()  # an ``Odometer``
        self._heard: Floats = np.zeros((0, 0))  # [n, 2 N] information at the last start; NaN: not started
        self._asked_s: Floats = np.zeros(0)  # [n] time of the last decision
        self._wanted: Floats = np.zeros(0)  # [n] last certified actions
        self._totals: Floats = np.zeros((0, 0, 0))  # [n, M, pairs] predicted total harm at the last decision (m2/s2)
        self._impact_s: Floats = np.zeros((0, 0))  # [n, N] time of the last predicted impact of each vehicle
        self._ranges = Ranges.of(scenario, vehicle, self._others)
        numbers = len(self._ranges.uncertain)
        if robust and 2**numbers > MOST_CORNERS:
            raise InvalidInput(
                f"robust:estimated: scenario {scenario.name!r} has {numbers} unknown quantities of other vehicles;"
                f" their smallest and largest values make {2**numbers} combinations (corners), but at most"
                f" {MOST_CORNERS} are allowed; give fewer quantities a range"
            )
        self.shield = self._make()

    def _make(self) -> RobustShield:
        return RobustShield(self.scenario, self.vehicle, harm_count=self._harm_count, others=self._others)

    @property
    def members(self) -> int:
        """Number of possible worlds in which the shield certifies an action, for each true world: the median world and
        all corners.
        """
        return 1 + len(self._corners())

    def __copy__(self) -> EstimatedShield:
        """Return an independent copy: its decisions do not change the original shield."""
        apart = object.__new__(EstimatedShield)
        apart.__dict__.update(self.__dict__)
        apart.shield = copy.copy(self.shield)
        for name in PER_WORLD:
            setattr(apart, name, getattr(self, name).copy())
        return apart

    def take(self, rows: Ints) -> EstimatedShield:
        """Return an independent copy of the shield for only the episodes with the indices ``rows``."""
        apart = copy.copy(self)
        if self.shield.memory.running is not None:
            apart.shield = self.shield.take(rows)
        apart._odometer = take_memory(self._odometer, rows)
        for name in (*PER_WORLD, *(("_totals",) if len(self._totals) else ())):
            setattr(apart, name, getattr(self, name)[rows])
        return apart

    def begin(self, worlds: Worlds, rows: Ints) -> None:
        """Start new episodes at the indices ``rows`` of the batch; ``worlds`` [m] are their worlds at the alert.

        Certification starts later, at the first decision, with the information received by then.
        """
        if len(rows) >= len(self._wanted):
            self.shield, self._wanted, self._totals = self._make(), np.zeros(0), np.zeros((0, 0, 0))
        n, N, fresh = len(rows), worlds.N, self._wanted.size == 0
        memories = {
            "_odometer": Odometer.begun(worlds, self.vehicle), "predicted_harm": np.full(n, np.nan),
            "_heard": np.full((n, 2 * N), np.nan), "_impact_s": np.full((n, N), -1.0), "_asked_s": np.full(n, np.nan),
            "_wanted": np.zeros(n), "interventions": np.zeros(n, np.int64),
        }  # fmt: skip
        for name, part in memories.items():
            setattr(self, name, part if fresh else renew_memory(getattr(self, name), rows, part))

    def decide(
        self, worlds: Worlds, proposed: Floats, proposer: Proposer | None = None, *, only: Bools | None = None
    ) -> Floats:
        """Return the certified actions, [n], from -1 (full braking) to 1; the action is 0 until the vehicle's latency
        has elapsed.

        If ``decide`` is called again at the same time of an episode, it returns the same action for this episode.
        Raises ``InvalidInput`` for an episode that was not started with ``begin``.

        Args:
            worlds: the true worlds; only the information that the vehicle received is read.
            proposed: [n] actions that the policy proposes.
            proposer: the policy and its memory. If no other plan certifies a proposed action, the shield also tries the
                policy's rollout (simulated episode) in the estimated worlds. None: the shield does not try it.
            only: [n] True for worlds in which the vehicle decides now; None: all worlds.

        """
        shield, vehicle = self.shield, self.vehicle
        if worlds.n > len(self._heard):
            raise InvalidInput(
                f"shield: estimated: decide was called for {count_of(worlds.n, 'world')}, but begin for"
                f" {len(self._heard)}; call begin for each world first"
            )
        self._odometer = odometer = Odometer(*self._odometer).look(worlds, vehicle)
        past = worlds.vehicles.latency_s[:, vehicle] <= worlds.time_s
        due = past & (worlds.time_s != self._asked_s) & (worlds.time_s < self.scenario.horizon_s)
        due &= True if only is None else only
        if due.any():
            estimated = self._ranges.estimate(worlds, odometer.way_m)
            self._begin_anew(worlds, estimated, odometer.way_m, due)
            proposer = None if proposer is None else proposer._replace(worlds=estimated)
            self.decision = decision = shield.decide(proposed, only=due, proposer=proposer)
            self._wanted[due] = decision.applied[due]
            self.interventions = self.interventions + (decision.intervened & due)
            self._asked_s[due] = worlds.time_s[due]
        return self._wanted.copy()

    def _begin_anew(self, worlds: Worlds, estimated: Worlds, way_m: Floats, due: Bools) -> None:
        """Start the inner shield (``self.shield``) in worlds in which it has not started; restart it in worlds in which
        new information requires a restart.

        ``due`` [n] is True for worlds that have a decision now.
        """
        shield, vehicle = self.shield, self.vehicle
        known = Received.by(worlds, vehicle)
        heard = np.concatenate([known.heard, known.reacts], axis=1)
        fresh, started = np.isnan(self._heard[:, 0]), shield.memory.running is not None
        if started:
            self._note_impacts(worlds)
        keeps = self._keeps(known, worlds.time_s)
        surprised = self._is_surprised(estimated, known.known & ~keeps) if started else fresh
        anew = fresh | surprised | (heard != self._heard).any(axis=1)
        rows = np.flatnonzero(due & anew)
        rows = rows if started else np.arange(worlds.n)
        if not rows.size:
            return
        before = copy.copy(shield) if started else None
        keeps = keeps & ~fresh[:, np.newaxis]
        self._begin_shield(worlds.take(rows), estimated.take(rows), way_m[rows], rows, keeps[rows], before)
        if before is not None and (held_before := rows[~fresh[rows]]).size:
            _hold_better(shield, held_before, before)
        rows = rows[due[rows]]  # the other worlds start at their own first decision
        first, self._heard[rows] = rows[fresh[rows]], heard[rows]
        felt = worlds.pair_hit[first, max(vehicle - 1, 0) : vehicle + 1].any(axis=1)
        felt |= worlds.obstacle_hit[first] & (vehicle == 0)
        self.predicted_harm[first] = np.where(felt, np.inf, shield.memory.backup.harm[first])

    def _begin_shield(
        self, worlds: Worlds, estimated: Worlds, way_m: Floats, rows: Ints, keeps: Bools, before: StepShield | None
    ) -> None:
        """Start the inner shield (``self.shield``) in the episodes ``rows``, whose worlds are ``worlds`` and
        ``estimated``, [m].

        The inner shield certifies actions in the median world and, in mode ``robust``, in the corners of the ranges of
        unknown quantities. ``keeps`` [m, N] is True for vehicles whose predicted state replaces their received state.
        ``before`` is the inner shield as it was before the restart; None if it starts for the first time.
        """
        parts = []
        for m, share in enumerate([None, *self._corners()]):
            foretold = None
            if before is not None:
                running = before.memory.running
                assert running is not None
                expected = worlds_at(estimated, running.states[rows * running.members + m])
                known = keeps.any(axis=1, keepdims=True)
                foretold = (replace(expected, pair_hit=expected.pair_hit & known), keeps)
            parts.append(self._ranges.estimate(worlds, way_m, share, foretold))
        self.shield.begin(parts[0], rows, possible=Uncertainty.interleaved(parts))

    def _keeps(self, received: Received, time_s: Floats) -> Bools:
        """Return a mask [n, N]: True for each vehicle whose predicted state replaces its received state.

        The mask is True for a vehicle that is unknown, and for a vehicle whose last message is older than the vehicle's
        last predicted impact or contact. ``time_s`` [n] is the present time.
        """
        running = self.shield.memory.running
        if running is None:
            return np.zeros(received.known.shape, np.bool_)
        n, N = received.known.shape
        whole = running.problem.mass.shape[1]  # number of vehicles in the columns, counting an obstacle ahead
        gaps = running.states.reshape(n, running.members, -1)[:, :, whole : 2 * whole - 1]
        touching: Bools = np.any(gaps == 0.0, axis=1)
        pressed = np.zeros((n, whole), np.bool_)
        pressed[:, :-1], pressed[:, 1:] = touching, pressed[:, 1:] | touching
        since = (received.at_s < self._impact_s) | (pressed[:, whole - N :] & (received.at_s < time_s[:, np.newaxis]))
        keeps: Bools = ~received.known | ((self._heard[:, :N] == 2.0) & since)
        keeps[:, self.vehicle] = False
        return keeps

    def _note_impacts(self, worlds: Worlds) -> None:
        """Store the present time as the time of the last impact of each vehicle that had an impact since the last
        decision in at least one possible world.
        """
        running = self.shield.memory.running
        assert running is not None
        pairs = running.problem.mass.shape[1] - 1
        totals = running.states[:, 4 * pairs + 1 : 5 * pairs + 1].reshape(worlds.n, running.members, pairs)
        if self._totals.shape == totals.shape:
            met: Bools = np.any(totals > self._totals, axis=1)
            for p in range(pairs):
                for j in {p - pairs + worlds.N - 1, p - pairs + worlds.N} & set(range(worlds.N)):
                    self._impact_s[met[:, p], j] = worlds.time_s[met[:, p]]
        self._totals = totals.copy()

    def _is_surprised(self, estimated: Worlds, heard: Bools) -> Bools:
        """Return a mask [n]: True for each world in which the estimated state of at least one vehicle is outside the
        range of the states that the shield predicted for this vehicle.

        ``heard`` [n, N] is True for each vehicle whose received state is compared with its predicted states.
        """
        running = self.shield.memory.running
        assert running is not None
        seen, wrong = seen_columns(Packed.of(estimated)), np.zeros(estimated.n, np.bool_)
        first = (seen.shape[1] + 4) // 5 - estimated.N  # 1 if an obstacle ahead is vehicle 0 of the columns, else 0
        foretold = running.states[:, : seen.shape[1]].reshape(estimated.n, running.members, -1)
        outside: Bools = (seen < foretold.min(axis=1) - SURPRISE) | (seen > foretold.max(axis=1) + SURPRISE)
        for i in range(estimated.N):
            wrong |= heard[:, i] & outside[:, first + i]
        for p in range(estimated.N - 1):
            wrong |= heard[:, p] & heard[:, p + 1] & outside[:, 2 * first + estimated.N + p]
        return wrong

    def _corners(self) -> list[dict[tuple[str, int], float]]:
        uncertain = self._ranges.uncertain
        shares = product((0.0, 1.0), repeat=len(uncertain)) if self.robust else []
        return [dict(zip(uncertain, each, strict=True)) for each in shares]
