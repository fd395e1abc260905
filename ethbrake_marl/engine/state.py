"""``State``: the running episodes of an engine at one moment, row by row."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.engine.compiled_step import ENDED, STEP
from ethbrake_marl.engine.memory import Memory, map_memory, take_memory
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.harm import Ledger
from ethbrake_marl.game.impacts import EpisodeImpacts
from ethbrake_marl.physics.columns import Packed
from ethbrake_marl.physics.state import Bools, Floats, Ints


class State(NamedTuple):
    """Running episodes at one moment, a row for each of n worlds."""

    motion: Floats  # [n, S] time, speeds, gaps and harm so far, in the columns of ``physics.columns``
    params: Floats  # [n, K] what the vehicles can do, and what periodic messages have reached them
    clock: Floats  # [n, CLOCK_WIDTH] first decision, steps taken, last step, whether the episode has ended
    wanted: Floats  # [n, N] acceleration that each vehicle asked for in the last step (m/s2)
    potential: Floats  # [n, N] of a shaped reward; else 0
    memories: dict[int, Memory]  # by vehicle, of the scripts that remember; never changed in place
    guarded: Any = None  # memory of the engine's guard; None without one
    impacts: EpisodeImpacts | None = None  # so far, where a measure of them is rewarded; never changed in place

    @property
    def packed(self) -> Packed:
        """The worlds as rows."""
        return Packed(self.motion, self.params)

    @property
    def ended(self) -> Bools:
        """Episodes that have ended, [n]."""
        return np.asarray(self.clock[:, ENDED] == 1.0, np.bool_)

    @property
    def steps(self) -> Ints:
        """Steps that the episodes have taken, [n]."""
        return self.clock[:, STEP].astype(np.int64)

    @property
    def time_s(self) -> Floats:
        """Time of each world, [n]."""
        return self.motion[:, self.packed.column.time]

    @property
    def ledger(self) -> Ledger:
        """Harm of the episodes so far, in arrays of its own."""
        packed, column = self.packed, self.packed.column
        of_worlds = packed.params[:, column.mass : column.limit], packed.params[:, column.restitution]
        return Ledger(*packed.ledger(), *(each.copy() for each in of_worlds))

    def copy(self) -> State:
        """The same state in arrays of its own; memories are never changed in place."""
        motion, params, clock, wanted, potential = (array.copy() for array in self[:5])
        return State(motion, params, clock, wanted, potential, self.memories, self.guarded, self.impacts)

    def take(self, rows: Ints) -> State:
        """Some of the rows, or one of them several times."""
        guarded = None if self.guarded is None else self.guarded.take(rows)
        motion, params, clock, wanted, potential, memories = take_memory(self[:6], rows)
        impacts = None if self.impacts is None else self.impacts.take(rows)
        return State(motion, params, clock, wanted, potential, memories, guarded, impacts)

    @staticmethod
    def join(states: list[State]) -> State:
        """The rows of all of them, one after the other; all are of one engine without a guard."""
        if states[0].guarded is not None:
            raise InvalidInput("moments: a shield stands in their engine; what it remembers is not joined")
        joined = State(*map_memory(lambda *parts: np.concatenate(parts), *(state[:6] for state in states)))
        impacts = [state.impacts for state in states if state.impacts is not None]
        return joined._replace(impacts=EpisodeImpacts.join(impacts) if impacts else None)
