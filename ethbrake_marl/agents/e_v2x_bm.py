"""E-V2X-BM: brakes with the constant deceleration that does the least harm, chosen at the alert.

``pairwise`` is the paper's closed form. ``coupled`` plays the whole line in the physics of the episode, with the changes
of speed, later impacts and lasting contact that the closed form leaves out, so its harm is the harm that happens.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import MODEL, NOBODY, STATE
from ethbrake_marl.agents.pairwise import Choice, closed_form, pairwise
from ethbrake_marl.episode.play import hold
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Rules, begin, step
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import BRAKING, Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.worlds.roles import HELD, LEARNER
from ethbrake_marl.worlds.scenario import Scenario

FIRST_PARTS = 64  # number of parts into which all decelerations are split, and
PARTS = 8  # into which a cell of them is split
EVENLY = np.arange(PARTS + 1)
NARROWEST_MPS2 = 1e-5  # narrower cells are not split
SMALL = 1e-3  # harm (m2/s2) that is not worth a further split
TIE = 1e-9  # harms (m2/s2) closer than this count as equal


def coupled(alert: State, body: int, count: str = "first", horizon_s: float = 8.0) -> Choice:
    """Return the constant deceleration of vehicle ``body`` that does the least harm, in every world, and this harm.

    All others hold ``alert.wanted``. ``count``: harm of the ``first`` impact of each pair, or ``total``. If the choice
    of the closed form does no harm, it is the result. If several do equally little, the least harm of the other count
    decides, then the middle one. As a function of the deceleration the harm has kinks and jumps: it is not proven that
    no deceleration between two samples does less.
    """
    braking = np.maximum(-alert.wanted, 0.0)
    braking[:, body] = alert.car[:, BRAKING, body]
    best = closed_form(alert, braking, body).deceleration_mps2
    harm = harms(alert, body, best[:, np.newaxis], count, horizon_s)[:, :, 0]
    rows = np.flatnonzero(harm[1 if count == "first" else 0])
    if len(rows):
        alert = alert.take(rows)
        found = search(alert, body, np.stack([best[rows], *harm[:, rows]], axis=1), count, horizon_s)
        best[rows], harm[0, rows] = found[:, 0], found[:, 1]
    return Choice(best, harm[0])


def harms(alert: State, body: int, tried: Floats, count: str, horizon_s: float) -> Floats:
    """Return the harm of both counts, first the one asked for, [2, n, C], for decelerations ``tried`` [n, C]."""
    return hold(alert, alert.wanted, [body], -tried[:, :, np.newaxis], horizon_s, count)


def search(alert: State, body: int, best: Floats, count: str, horizon_s: float) -> Floats:
    """Return decelerations that do the least harm, [n] m/s2. ``best`` [n, 3] are known ones and their harms.

    All decelerations of a world are split into equal parts, then again and again the parts that may hold a better one.
    """
    rows, step = np.arange(alert.n), alert.car[:, BRAKING, body] / FIRST_PARTS
    at = step[:, np.newaxis] * np.arange(FIRST_PARTS + 1)
    harm = np.ascontiguousarray(harms(alert, body, at, count, horizon_s).swapaxes(0, 1))
    while len(rows):
        found = np.empty((2, harm[:, 0, 1:].size), np.int64)
        cell, part = found[:, : find_cells(rows, at, harm, step, best, found)]
        rows, low, ends, step = rows[cell], at[cell, part], (harm[cell, :, part], harm[cell, :, part + 1]), step / PARTS
        at, harm = low[:, np.newaxis] + step[rows, np.newaxis] * EVENLY, np.empty((len(rows), 2, PARTS + 1))
        harm[:, :, 0], harm[:, :, PARTS] = ends
        harm[:, :, 1:PARTS] = harms(alert.take(rows), body, at[:, 1:PARTS], count, horizon_s).swapaxes(0, 1)
    return best


@large
def find_cells(rows, at, harm, step, best, found):
    """Update the best decelerations, and return the number of cells in which there may be better ones.

    Row j of ``at`` [m, C] and ``harm`` [m, 2, C] are samples of the world ``rows[j]``, ``step`` [n] m/s2 apart. ``best``
    [n, 3] are decelerations and their harms. A cell, the interval between two neighbouring samples, may hold a better
    one if it lies below its lower end by the largest change of the harm in the cell and in those beside it. ``found``
    [2, .] receives j and the number of the cell in row j.
    """
    count, last = 0, at.shape[1] - 1
    for j in range(at.shape[0]):
        known, better = best[rows[j]], False
        for c in range(last + 1):
            if compare(harm[j, :, c], known) < 0:
                known[1], known[2], better = harm[j, 0, c], harm[j, 1, c], True
        if better:
            ties = 0
            for c in range(last + 1):
                ties += 1 if compare(harm[j, :, c], known) == 0 else 0
            for c in range(last + 1):
                ties -= 2 if compare(harm[j, :, c], known) == 0 else 0
                if ties <= 0:  # the middle one
                    known[0] = at[j, c]
                    break
    for j in range(at.shape[0]):
        if step[rows[j]] <= NARROWEST_MPS2:
            continue
        for c in range(last):
            change = 0.0
            for beside in range(max(c - 1, 0), min(c + 2, last)):
                change = max(change, abs(harm[j, 0, beside + 1] - harm[j, 0, beside]))
            if min(harm[j, 0, c], harm[j, 0, c + 1]) - change < best[rows[j], 1] - SMALL:
                found[0, count], found[1, count] = j, c
                count += 1
    return count


@kernel
def compare(harm, known):
    """Return -1 if ``harm`` [2] is less than the harms ``known[1:]``, 1 if it is more; the other count decides ties."""
    for count in range(2):
        if abs(harm[count] - known[count + 1]) > TIE:
            return -1 if harm[count] < known[count + 1] else 1
    return 0

