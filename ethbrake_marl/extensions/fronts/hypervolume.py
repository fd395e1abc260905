"""Points that no other point beats, and the volume that they dominate."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.state import Bools, Floats

MOST_DIMENSIONS = 5  # the time grows with the number of points to the power of the dimensions less one


def nondominated(points: Floats) -> Bools:
    """Return which points no other point beats, [..., Q] bool; less is better.

    A point beats another one if it is at most as large in every coordinate and smaller in one. ``points`` is
    [..., Q, N]: Q points of N coordinates.
    """
    one, other = points[..., :, np.newaxis, :], points[..., np.newaxis, :, :]
    beaten = (other <= one).all(axis=-1) & (other < one).any(axis=-1)
    return np.asarray(~beaten.any(axis=-1))


def hypervolume(points: Floats, reference: Floats) -> float:
    """Return the volume between the reference and the points: of all places that some point beats, none beyond it.

    Less is better. A point that is not below the reference in every coordinate adds nothing. The result is exact: it
    slices the volume along the last coordinate (Zitzler 1999; "hypervolume by slicing objectives").

    >>> import numpy as np
    >>> from ethbrake_marl.extensions.fronts.hypervolume import hypervolume
    >>> hypervolume(np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([3.0, 3.0]))
    3.0

    Args:
        points: [Q, N].
        reference: [N].

    Raises ``InvalidInput`` for more than ``MOST_DIMENSIONS`` coordinates, other shapes, or infinite numbers.

    """
    if len(reference) > MOST_DIMENSIONS:
        raise InvalidInput(f"hypervolume: {len(reference)} vehicles; it is computed for at most {MOST_DIMENSIONS}")
    finite = np.isfinite(points).all() and np.isfinite(reference).all()
    if points.ndim != 2 or points.shape[1] != len(reference) or not finite:
        shapes = f"points {points.shape}, reference {reference.shape}"
        raise InvalidInput(f"hypervolume: {shapes}: must be finite numbers, as [Q, N] and [N]")
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
