"""Plans and members that a shield goes on with where it begins anew in the middle of an episode."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.shield.certify import plan_harm
from ethbrake_marl.shield.rollouts import put
from ethbrake_marl.shield.step_shield import StepShield


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
