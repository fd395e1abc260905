"""The running episodes of a batch: their rows, and what can be read from them."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.engine.step import ENDED, STEP
from ethbrake_marl.engine.stream import Roster
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import Ledger
from ethbrake_marl.observations import Observations, observe_packed
from ethbrake_marl.observations.observe import Plan
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.rows import (
    Packed,
    ledger_columns,
    obstacle_ledger_columns,
    own_latency_and_news,
    params_at,
    unpack,
    with_news_columns,
    with_obstacle_columns,
)
from ethbrake_marl.scenario import Scenario

RUNNING = ("_state", "_params", "_clock", "_wanted", "_potential")  # arrays of an engine that every step changes


class Running:
    """``n`` running episodes of one scenario, to be read; ``Engine`` moves them."""

    scenario: Scenario  # of every episode
    n: int  # worlds that are advanced together
    roster: Roster  # who runs in which row, and which worlds failed
    _state: Floats  # of the running episodes, as rows of ``physics.rows``
    _params: Floats
    _clock: Floats  # [n, CLOCK_WIDTH]
    _wanted: Floats  # [n, N] m/s2
    _potential: Floats  # [n, N]
    _obstacle: bool  # the rows have columns of an obstacle
    _by_link: bool  # ... of news by link
    _plan: Plan  # of what a vehicle observes

    @property
    def packed(self) -> Packed:
        """The running worlds themselves, as rows of ``physics.rows``: for kernels to read, not to be changed."""
        return Packed(self._state, self._params)

    @property
    def wanted_mps2(self) -> Floats:
        """What each vehicle wanted in the last step, [n, N]: for kernels to read, not to be changed."""
        return self._wanted

    @property
    def worlds(self) -> Worlds:
        """The worlds as they are now, in their own memory."""
        return unpack(self.packed)

    @property
    def ledger(self) -> Ledger:
        """Harm of the running episodes so far, in its own memory."""
        vehicles = self.scenario.vehicles
        first, total, count = ledger_columns(self._state, vehicles)
        mass = self._params[:, params_at(3, vehicles) : params_at(4, vehicles)].copy()
        return Ledger(first, total, count, *obstacle_ledger_columns(self._state, vehicles), mass)

    @property
    def known_from_s(self) -> Floats:
        """From when on vehicle i acts on news of vehicle j, [n, N, N]: ``known_from_s`` of the worlds' vehicles."""
        return own_latency_and_news(self._params, self.scenario.vehicles)[1]

    @property
    def ended(self) -> Bools:
        """Episodes that have ended, [n]."""
        ended: Bools = self._clock[:, ENDED] == 1.0
        return ended

    @property
    def steps(self) -> Ints:
        """Steps that the running episodes have taken, [n]."""
        return self._clock[:, STEP].astype(np.int64)

    def observe(self, vehicle: int) -> Observations:
        """Current observation of one vehicle, [n, F]."""
        if not 0 <= vehicle < self.scenario.vehicles:
            raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{self.scenario.vehicles - 1}")
        return self.observe_all(np.array([vehicle]))[:, 0]

    def observe_all(self, vehicles: Ints, rows: Ints | None = None) -> Observations:
        """Current observations of several vehicles, [n, len(vehicles), F]; only of the worlds ``rows`` if given."""
        state, params = self._state, self._params
        if rows is not None:
            state, params = state.take(rows, axis=0), params.take(rows, axis=0)
        if not self._plan.extras:
            return observe_packed(state, params, vehicles, self._plan)
        steps = self._clock[:, STEP] if rows is None else self._clock[rows, STEP]
        return observe_packed(state, params, vehicles, self._plan, steps)

    def _kept(self, packed: Packed) -> Packed:
        """Rows as wide as they are kept: with columns of an obstacle, and of news by link, if the first had such."""
        (state, params), N = packed, self.scenario.vehicles
        return Packed(
            with_obstacle_columns(state, N) if self._obstacle else state,
            with_news_columns(params, N) if self._by_link else params,
        )
