"""Rough upper bound on harm, computed from the largest speeds that the vehicles of a line can still reach.

The bound is used for a path (set of worlds with the same impacts so far) that cannot be simulated. The bound is always
finite.

Without impacts, a vehicle reaches at most its present speed, or the speed that it can reach by driving. An impact with
closing speed w and restitution e changes the speed of each vehicle by (1 + e) w m / M, where m is the mass of the other
vehicle and M the sum of both masses. Let u be the largest speed of any vehicle, and assume that no vehicle moves
backwards yet. An impact slows the rear vehicle, but the new speed is at least -e times the previous speed. An impact
gives a front vehicle at rest at most (1 + e) times the rear vehicle's speed. So, in a line of three vehicles, the speed
of the middle vehicle stays between -e u and (1 + e) u until both its pairs have had contact. If three vehicles are in
contact at once, each vehicle has the speed (1 + e) P - e v after the impact, where v is its speed before the impact,
and P is a weighted mean of the three speeds before the impact. This speed, too, lies between -e u and (1 + e) u.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.extensions.certified.affine import FREE, Cell, Path, high, low
from ethbrake_marl.extensions.certified.touching import blur
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats


@compiled(apart=True)
def driven(cell: Cell, i: int, speed: float, since: float) -> float:
    """Return the largest speed (m/s) that vehicle ``i`` can reach by driving if its speed at the time ``since`` (s
    after the first decision) is at most ``speed``.
    """
    drive, rest = 0.0, cell.times[-1] - since
    if i == cell.vehicle:
        for j in range(cell.action.shape[0]):
            if cell.times[j + 1] > since:
                drive = max(drive, cell.action[j] * high(cell.drive))
                if cell.forces.build[i]:  # an earlier driving force may not be released yet
                    drive = max(drive, high(cell.forces.mean[i, j + 1]) + cell.forces.swing[i, j + 1].max())
    elif cell.constant[i] > 0.0:
        drive = cell.constant[i]
    return float(max(speed, min(cell.limit[i], speed + drive * rest)) if drive > 0.0 else speed)


@compiled(apart=True)
def rough_harm(cell: Cell, path: Path, hit: int) -> float:
    """Return an upper bound (m2/s2) on the harm in all worlds of a path, including the harm so far.

    ``hit`` is the index of one more pair that is treated as if its first impact had already happened, in addition to
    the pairs marked in the path; -1: no such pair.
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
    """Return an upper bound (m2/s2) on the sum of the squared closing speeds of all first impacts that are still to
    come.

    Args:
        cell: the box and the vehicles' commands.
        own: [N] largest speed that each vehicle can reach without an impact, m/s.
        backwards: largest backward speed of any vehicle at the time ``since``, m/s.
        since: present time, s after the first decision.
        path: the function reads only which pairs have had an impact.
        hit: as in ``rough_harm``.

    """
    P, e = cell.gap.shape[0], cell.restitution
    first = path.marks[0] == 1 or hit == 0
    if P == 1:
        return float(0.0 if first else own[1] * own[1])
    second = path.marks[1] == 1 or hit == 1
    fastest = max(own[1], own[2])
    ahead = driven(cell, 1, (1.0 + e) * fastest, since)  # closing speed of the front pair after a push from behind
    back: float = own[2] + max(
        e * driven(cell, 1, fastest, since), backwards
    )  # closing speed of the rear pair after its front vehicle is thrown back
    if first and second:
        return 0.0
    if first:
        return back * back
    if second:
        return ahead * ahead
    return float(max(fastest * fastest + back * back, own[2] * own[2] + ahead * ahead))
