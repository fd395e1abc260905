"""The volume that a set of points dominates."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.motion.layout import Floats

MOST_DIMENSIONS = 5  # the time grows with the number of points to the power of the dimensions less one


def hypervolume(points: Floats, reference: Floats) -> float:
    """Return the exact volume of the region between ``points`` [Q, N], which dominate it, and ``reference`` [N].

    Smaller coordinates are better. A point is ignored unless all its coordinates are below the reference point's. The
    region is cut into slices along the last coordinate (Zitzler 1999, "hypervolume by slicing objectives").

    >>> import numpy as np
    >>> from ethbrake_marl.extensions.fronts.hypervolume import hypervolume
    >>> hypervolume(np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([3.0, 3.0]))
    3.0
    """
    points = points[(points < reference).all(axis=1)]
    if not len(points):
        return 0.0
    if len(reference) == 1:
        return float(reference[0] - points.min())
    points = points[np.argsort(points[:, -1], kind="stable")]
    ends = np.append(points[1:, -1], reference[-1])
    slices = ((end - points[k, -1], points[: k + 1, :-1]) for k, end in enumerate(ends))
    return sum(float(height) * hypervolume(below, reference[:-1]) for height, below in slices if height > 0.0)
