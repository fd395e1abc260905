"""A bound on harm that needs no path: by the speeds that the vehicles of a line may still have.

Where a path cannot be followed, this is what is said of the worlds that go it, so that no bound is ever infinite.

A vehicle on its own is at most as fast as it is, or as it drives up to its limit. In an impact of a pair whose
closing speed is w each one's speed changes by its share of (1 + e) w. Let u be the largest of all own speeds, e
restitution, and nobody move backwards yet. A rear vehicle is slowed by an impact, and left with at least -e times its
speed; a front one that was at rest has at most (1 + e) times the rear one's. So the middle one of three is between -e
u and (1 + e) u until its second pair meets. (Three that touch are one cluster, in which each ends with P + e (P - v)
for a mean P of their speeds v: between the same bounds.)
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.extensions.certified.affine import FREE, Cell, Path, high, low
from ethbrake_marl.extensions.certified.touching import blur
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats


@compiled(apart=True)
def driven(cell: Cell, i: int, speed: float, since: float) -> float:
    """Largest speed of a vehicle that is at most as fast as this at a time, by its own drive from then on."""
    drive, rest = 0.0, cell.times[-1] - since
    if i == cell.vehicle:
        for j in range(cell.action.shape[0]):
            if cell.times[j + 1] > since:
                drive = max(drive, cell.action[j] * high(cell.drive))
                if cell.forces.build[i]:  # what it had before may still be released
                    drive = max(drive, high(cell.forces.mean[i, j + 1]) + cell.forces.swing[i, j + 1].max())
    elif cell.constant[i] > 0.0:
        drive = cell.constant[i]
    return float(max(speed, min(cell.limit[i], speed + drive * rest)) if drive > 0.0 else speed)


@compiled(apart=True)
def rough_harm(cell: Cell, path: Path, hit: int) -> float:
    """Upper bound on the harm of all worlds of a path, from the present piece on, if pair ``hit`` was hit by now.

    ``hit`` -1: by the marks of the path.
    """
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    since = cell.times[path.marks[2 * P]]
    own, backwards = np.zeros(N), 0.0
    for i in range(N):
        around = 0.0
        for p in range(max(i - 1, 0), min(i + 1, P)):
            if path.marks[P + p] != FREE:
                around += blur(cell, path, p, i - p)
        own[i] = driven(cell, i, max(high(path.forms[i]) + around, 0.0), since)
        backwards = max(backwards, around - low(path.forms[i]))
    return high(path.forms[-1]) + rough_rest(cell, own, backwards, since, path, hit)


@compiled(apart=True)
def rough_rest(cell: Cell, own: Floats, backwards: float, since: float, path: Path, hit: int) -> float:
    """Largest sum of the squared closing speeds of first impacts that are still to come."""
    P, e = cell.gap.shape[0], cell.restitution
    first = path.marks[0] == 1 or hit == 0
    if P == 1:
        return float(0.0 if first else own[1] * own[1])
    second = path.marks[1] == 1 or hit == 1
    fastest = max(own[1], own[2])
    ahead = driven(cell, 1, (1.0 + e) * fastest, since)  # closing speed of the front pair, its rear one pushed
    back: float = own[2] + max(
        e * driven(cell, 1, fastest, since), backwards
    )  # of the rear pair, its front one thrown back
    if first and second:
        return 0.0
    if first:
        return back * back
    if second:
        return ahead * ahead
    return float(max(fastest * fastest + back * back, own[2] * own[2] + ahead * ahead))
