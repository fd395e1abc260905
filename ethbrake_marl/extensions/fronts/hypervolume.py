"""Find the points of a set that no other point dominates, and compute the volume that the points dominate."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Bools, Floats

MOST_DIMENSIONS = 5  # the time grows with the number of points to the power of the dimensions less one


def nondominated(points: Floats) -> Bools:
    """Return a mask [..., Q]: True for each of Q points that no other point dominates.

    Smaller coordinates are better. Point A dominates point B if no coordinate of A is larger than the same coordinate
    of B, and at least one is smaller. ``points`` is [..., Q, N].
    """
    one, other = points[..., :, np.newaxis, :], points[..., np.newaxis, :, :]
    beaten = (other <= one).all(axis=-1) & (other < one).any(axis=-1)
    return np.asarray(~beaten.any(axis=-1))


def hypervolume(points: Floats, reference: Floats) -> float:
    """Return the volume of the region that ``points`` [Q, N] dominate, up to the point ``reference`` [N].

    Smaller coordinates are better. A point of which a coordinate is not below the same coordinate of the reference
    point is ignored. The volume is exact; the function cuts the region into slices along the last coordinate (Zitzler
    1999, "hypervolume by slicing objectives").

    >>> import numpy as np
    >>> from ethbrake_marl.extensions.fronts.hypervolume import hypervolume
    >>> hypervolume(np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([3.0, 3.0]))
    3.0

    Raises ``InvalidInput`` if there are more than ``MOST_DIMENSIONS`` coordinates, if the shapes are wrong, or if a
    number is not finite.
    """
    if len(reference) > MOST_DIMENSIONS:
        raise InvalidInput(
            f"hypervolume: the points have {len(reference)} coordinates, but at most {MOST_DIMENSIONS} are allowed"
        )
    finite = np.isfinite(points).all() and np.isfinite(reference).all()
    if points.ndim != 2 or points.shape[1] != len(reference) or not finite:
        shapes = f"points has shape {points.shape} and reference has shape {reference.shape}"
        raise InvalidInput(
            f"hypervolume: {shapes}; points must be finite numbers of shape [Q, N], and reference of shape [N]"
        )
    return _volume(points[(points < reference).all(axis=1)], reference)


def _volume(points: Floats, reference: Floats) -> float:
    if not len(points):
        return 0.0
    if len(reference) == 1:
        return float(reference[0] - points.min())
    points = points[np.argsort(points[:, -1], kind="stable")]
    ends = np.append(points[1:, -1], reference[-1])
    slices = ((end - points[k, -1], points[: k + 1, :-1]) for k, end in enumerate(ends))
    return sum(float(height) * _volume(below, reference[:-1]) for height, below in slices if height > 0.0)
