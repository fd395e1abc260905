"""Gates on worlds made backwards, on impacts and on the motion between them."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.harm import empty_ledger, split
from ethbrake_marl.physics import Impacts, Worlds, advance
from tests.physics.manufacture import manufactured, pressed, stored
from tests.physics.programme.gates import Figure, gate
from tests.physics.random_worlds import (
    Draws,
    Watched,
    driving_lines,
    energy_rise_eps,
    momentum_eps,
    restitution_eps,
    rounds,
    touching_lines,
)
from tests.physics.test_oracles import at_once, in_steps
from tests.reference.tolerances import ENERGY_EPS, GAP_M, MOMENTUM_EPS, RESTITUTION_EPS

# ---------------------------------------------------------------- manufactured worlds


@gate("manufactured worlds, not bit for bit")
def manufactured_worlds() -> Figure:
    """Worlds built backwards from contact times: stored ones and fresh ones."""
    cases = stored() + manufactured(9, 2, 1_500) + manufactured(9, 3, 400) + manufactured(9, 4, 100)
    wrong = sum(bool(at_once(case) or in_steps(case)) for case in cases)
    hits = sum(len(case.outcome.hits) for case in cases)
    return Figure(wrong, 0, f"{len(cases)} worlds, {hits} impacts, at once and in steps of 1/8 s")


@gate("resting contact worlds, not bit for bit")
def pressed_worlds() -> Figure:
    """Worlds that touch at the start."""
    cases = [case for N in (2, 3, 4, 5) for case in pressed(11, N, 1_000)]
    return Figure(sum(bool(at_once(case) or in_steps(case)) for case in cases), 0, f"{len(cases)} worlds")


# ---------------------------------------------------------------- invariants of impacts


def impact_batches() -> list[tuple[Worlds, Worlds, Impacts]]:
    """Touching lines of 2 to 50 vehicles before and after their impacts, with mass ratios up to a million."""
    batches = []
    for N in (2, 3, 5, 10, 50):
        for ratio in (1.0, 1e3, 1e6):
            before, command = touching_lines(21, 1_000_000 // N, N, heaviest_ratio=ratio)
            batches.append((before, *advance(before, command, 0.0)))
    return batches


@gate("momentum at impacts [eps of sum m |v|, per round]")
def momentum() -> Figure:
    """Momentum before and after."""
    batches = impact_batches()
    worst = max(float(np.max(momentum_eps(b, a) / rounds(i))) for b, a, i in batches)
    return Figure(worst, MOMENTUM_EPS, f"{sum(int(i.count.sum()) for *_, i in batches):,} impacts, N = 2 to 50")


@gate("energy rise at impacts [eps of the energy, per round]")
def energy() -> Figure:
    """Kinetic energy over ground."""
    worst = max(float(np.max(energy_rise_eps(b, a) / rounds(i))) for b, a, i in impact_batches())
    return Figure(worst, ENERGY_EPS, "the same impacts")


@gate("restitution of pairs [eps of the larger speed]")
def restitution() -> Figure:
    """Separation speed against e times closing speed."""
    worst, pairs = 0.0, 0
    for key in range(5):
        before, command = touching_lines(30 + key, 1_000_000, 2, heaviest_ratio=10.0**key)
        after, impacts = advance(before, command, 0.0)
        worst, pairs = max(worst, float(restitution_eps(before, after).max())), pairs + int(impacts.count.sum())
    return Figure(worst, RESTITUTION_EPS, f"{pairs:,} impacts of two vehicles")


# ---------------------------------------------------------------- invariants of the motion


@gate("gap against its closed form, and below 0 [m]")
def gaps() -> Figure:
    """Stored gaps against those that follow from the speeds."""
    runs = [Watched(41 + N, 3_000 // N, N, drive=drive) for N in (2, 3, 5, 10) for drive in (False, True)]
    return Figure(max(run.worst for run in runs), GAP_M, f"{sum(run.checked for run in runs):,} steady steps")


@gate("speeds below 0 that no bounce-back explains")
def negative_speeds() -> Figure:
    """Braking lines in short steps."""
    runs = [Watched(51 + N, 3_000 // N, N, drive=False) for N in (2, 3, 5, 10)]
    seen = sum(int((state.speeds_mps < 0).sum()) for run in runs for state in run.states)
    return Figure(sum(run.unexplained_negative_speeds() for run in runs), 0, f"{seen:,} negative speeds seen")


@gate("steps in which energy rose though nobody drives")
def energy_in_motion() -> Figure:
    """Braking lines in short steps."""
    runs = [Watched(51 + N, 3_000 // N, N, drive=False) for N in (2, 3, 5, 10)]
    return Figure(sum(run.energy_rises() for run in runs), 0, f"{len(runs) * 300:,} steps of {3_000:,} vehicles")


@gate("harm shares that do not add up to the last bit")
def shares() -> Figure:
    """Random harm and masses."""
    draws, n = Draws(61), 2_000_000
    harm, mass = draws.uniform(0.0, 2_000.0, (n, 1)), 10.0 ** draws.uniform(-2.0, 4.0, (n, 2))
    both = split(harm, mass)
    rest = harm[:, 0] - both.max(axis=1)  # exact: the larger share is at least half
    return Figure(int(np.sum(rest != both.min(axis=1))), 0, f"{n:,} impacts")


@gate("worlds whose ledger is not the sum of its rows")
def ledger() -> Figure:
    """First-impact and total harm, to the last bit, over three segments."""
    wrong, impacts_seen = 0, 0
    for N in (2, 3, 6, 20):
        worlds, command = driving_lines(62, 60_000 // N, N)
        book, first, total = empty_ledger(worlds), np.zeros(worlds.gaps_m.shape), np.zeros(worlds.gaps_m.shape)
        for until in (0.7, 2.0, 6.0):
            worlds, impacts = advance(worlds, command, until_s=until, record=True)
            book, rows = book.add(impacts), impacts.rows
            assert rows is not None
            segment = np.zeros((2, *first.shape))
            harm = rows.closing_speed_mps * rows.closing_speed_mps
            np.add.at(segment[0], (rows.world[rows.first], rows.pair[rows.first]), harm[rows.first])
            np.add.at(segment[1], (rows.world, rows.pair), harm)
            first, total, impacts_seen = first + segment[0], total + segment[1], impacts_seen + rows.world.size
        same = (first == book.first_impact_harm) & (total == book.total_harm)
        wrong += int((~same).any(axis=1).sum())
    return Figure(wrong, 0, f"{impacts_seen:,} impacts")
