"""Harm of episodes under the counts R1 and R2 (``readings``), in which an impact has no consequence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.record import advance_worlds, simulate_again
from ethbrake_marl.motion.layout import (
    BRAKING,
    FIRST,
    GAP,
    HIT,
    IMPACTS,
    NEXT_CLOSING,
    NEXT_TIME,
    TOTAL,
    Bools,
    Floats,
    scratch_for,
)

APART_M = 1e3  # by which a gap is widened; more than vehicles can overlap


class Counted(NamedTuple):
    last: State  # last states of the episodes
    line_first: Floats  # R1: squared closing speed of the line's first impact, [n] m2/s2; 0 without an impact
    pairs_alone: Floats  # R2: squared closing speeds of both pairs if impacts changed no speed, [n] m2/s2


def play_and_count(game: Game, alert: State, team: Team) -> Counted:
    """The physics must be exact.

    R2: vehicles follow the commands of the episode, and after its end the last one, or brake fully if it was 0. R1:
    impacts of several pairs at the same time all count.
    """
    line_first, alone, before = np.zeros(alert.n), alert.line.copy(), alert
    for _, after in play(game, alert, team):
        for k, scratch in simulate_again(before, after, after.collided & ~before.collided):
            time_s = np.where(after.line[k, IMPACTS] > 0.0, scratch[NEXT_TIME], np.inf)
            line_first[k] = np.square(scratch[NEXT_CLOSING][time_s == time_s.min()]).sum()
        alone = pass_through(alone, after, before.time_s, after.time_s, after.wanted)
        before = after
    end_s = np.full(alert.n, game.settings.horizon_s)
    braking = np.where(before.wanted < 0.0, before.wanted, -before.car[:, BRAKING])
    alone = pass_through(alone, before, before.time_s, end_s, braking)
    return Counted(before, line_first, alone[:, FIRST].sum(axis=1))


def pass_through(line: Floats, state: State, from_s: Floats, until_s: Floats, commands: Floats) -> Floats:
    """``line`` [n, LINE_ROWS, N + 1] at ``until_s``, if vehicles pass through each other: every pair's first contact is
    noted, and changes nothing. Gaps are negative after a contact. ``commands``: [n, N + 1] m/s2.
    """
    hit, scratch = line[:, HIT] == 1.0, scratch_for(line.shape[2])
    after = spread(line, np.ones_like(hit))
    advance_worlds(after, state.car, from_s, until_s, commands, scratch)
    after[:, GAP, 1:-1] -= APART_M
    for pair in range(1, state.vehicles):
        of_pair = spread(line, hit | (np.arange(hit.shape[1]) != pair))
        advance_worlds(of_pair, state.car, from_s, until_s, commands, scratch)
        met = of_pair[:, HIT, pair] > line[:, HIT, pair]
        for row in (HIT, FIRST, TOTAL, IMPACTS):
            after[met, row, pair] = of_pair[met, row, pair]
    return after


def spread(line: Floats, pairs: Bools) -> Floats:
    """A copy of ``line`` in which the gaps of ``pairs`` [n, N + 1] are so much wider that nothing meets there."""
    wide: Floats = line.copy()
    wide[:, GAP, 1:-1] += np.where(pairs[:, 1:-1], APART_M, 0.0)
    return wide
