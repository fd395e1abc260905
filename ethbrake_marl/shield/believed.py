"""Shields over a believed world: what is certified is certified on what was received, and nothing else is looked at.

``step``: every action is certified in the world that the vehicle believes in, with what is not known in the middle of
its range. That promises nothing of the world as it is. ``robust``: in every corner of the ranges of what is not known.
If the world is such a corner, its harm up to the horizon is at most the first bound: what is heard later leaves those
corners standing that it agrees with, and the plan that was held is held on unless a better one for them is found.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import cast

import numpy as np

from ethbrake_marl.agents.believed import SUFFIX, Foretold, Odometer, Ranges, Told, believed_worlds, ranges_of, told_to
from ethbrake_marl.agents.protocol import Agent, place
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.stream import Script
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, concatenate
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.search import state_columns, worlds_at
from ethbrake_marl.shield.certify import Decision, Proposer
from ethbrake_marl.shield.enclosure import CORNERS, INTERIOR, checked_robust
from ethbrake_marl.shield.step_shield import Held, StepShield, held_in, hold_better
from ethbrake_marl.shield.uncertainty import MOST_CORNERS, Uncertainty

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
