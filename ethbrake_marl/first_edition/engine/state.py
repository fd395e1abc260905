"""``State``: the running episodes of an engine at one moment, one row per world."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.compiled_step import ENDED, STEP
from ethbrake_marl.first_edition.engine.memory import Memory, map_memory, take_memory
from ethbrake_marl.first_edition.game.harm import Ledger
from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints


class State(NamedTuple):
    """The running episodes of an engine at one moment, with one row for each of n worlds."""

    motion: Floats  # [n, S] time, speeds, gaps and harm so far, in the columns of ``physics.columns``
    params: Floats  # [n, K] parameters of the vehicles, and the periodic messages that have reached them
    clock: Floats  # [n, CLOCK_WIDTH] time of the first decision, steps taken, last step, whether the episode has ended
    wanted: Floats  # [n, N] acceleration that each vehicle commanded in the last step (m/s2)
    potential: Floats  # [n, N] potentials of a shaped reward; 0 without shaping
    memories: dict[int, Memory]  # vehicle index -> memory of its script, if it has one; never changed in place
    guarded: Any = None  # memory of the engine's guard; None without one
    impacts: EpisodeImpacts | None = None  # impacts so far, if the reward measures them; never changed in place

    @property
    def packed(self) -> Packed:
        """The worlds in two arrays (layout: ``physics.columns``); not a copy."""
        return Packed(self.motion, self.params)

    @property
    def ended(self) -> Bools:
        """Whether each episode has ended, [n]."""
        return np.asarray(self.clock[:, ENDED] == 1.0, np.bool_)

    @property
    def steps(self) -> Ints:
        """Number of steps that each episode has taken, [n]."""
        return self.clock[:, STEP].astype(np.int64)

    @property
    def time_s(self) -> Floats:
        """Time of each world since the alert, [n] s."""
        return self.motion[:, self.packed.column.time]

    @property
    def ledger(self) -> Ledger:
        """Harm and number of impacts of each pair since the episodes began (a copy)."""
        packed, column = self.packed, self.packed.column
        params = packed.params
        weight = params[:, column.harm_weight : column.own_latency]
        of_worlds = params[:, column.mass : column.limit], params[:, column.restitution], weight
        return Ledger(*packed.ledger(), *(each.copy() for each in of_worlds))

    def copy(self) -> State:
        """Return a copy with arrays of its own; the scripts' memories, which never change in place, are shared."""
        motion, params, clock, wanted, potential = (array.copy() for array in self[:5])
        return State(motion, params, clock, wanted, potential, self.memories, self.guarded, self.impacts)

    def take(self, rows: Ints) -> State:
        """Return the state of only the worlds with the indices ``rows``; an index may occur several times."""
        guarded = None if self.guarded is None else self.guarded.take(rows)
        motion, params, clock, wanted, potential, memories = take_memory(self[:6], rows)
        impacts = None if self.impacts is None else self.impacts.take(rows)
        return State(motion, params, clock, wanted, potential, memories, guarded, impacts)

    @staticmethod
    def join(states: list[State]) -> State:
        """Return one state that contains the worlds of all ``states``, in the order of ``states``.

        All ``states`` must come from the same engine. Raises ``InvalidInput`` if this engine has a guard, because
        memories of guards cannot be joined.
        """
        if states[0].guarded is not None:
            raise InvalidInput("states of an engine with a shield cannot be joined; use an engine without a shield")
        joined = State(*map_memory(lambda *parts: np.concatenate(parts), *(state[:6] for state in states)))
        impacts = [state.impacts for state in states if state.impacts is not None]
        return joined._replace(impacts=EpisodeImpacts.join(impacts) if impacts else None)
