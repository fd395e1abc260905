"""Adaptive search of the unit cube for several points with high scores that are far apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from ethbrake_marl.motion.layout import Floats, Ints

Score = Callable[[Floats], Floats]  # points [n, d] of [0, 1) -> scores [n]; minus infinity: the point is invalid

ROUND = 256  # points that are scored together
LEAST_DISTANCE = 0.1  # least difference of two results, in at least one coordinate

_PARENTS = 24  # parents of the next round; they are far apart
_EXPLORING = 0.5  # fraction of each round that is spread evenly over the cube
_NEAREST, _FARTHEST = 1e-3, 0.3  # smallest and largest typical step from a parent
_LAST = np.nextafter(1.0, 0.0)


def search_cube(
    score: Score, dimensions: int, budget: int, seed: int, on_round: Callable[[int], None]
) -> tuple[Floats, Floats]:
    """Points that a search of the unit cube for high scores tries, [budget, d], and their scores [budget].

    Points are tried in rounds. Half of a round is spread evenly over the cube (scrambled Sobol points). Every point of
    the other half is one step away from a *parent*: parents are the best points so far that are not close to each
    other. A step is normally distributed in some coordinates, or half the difference between two random parents
    (differential evolution). While no score is above the median, all points are spread evenly. ``on_round``: called
    with the number of points tried so far.
    """
    rng, spread = np.random.default_rng([seed, dimensions]), _spread(dimensions, seed)
    points, scores = np.empty((0, dimensions)), np.empty(0)
    while len(points) < budget:
        count = min(ROUND, budget - len(points))
        good = scores[np.isfinite(scores)]
        above = np.where(scores > np.median(good), scores, -np.inf) if len(good) else scores
        parents = points[far_apart(points, above, _PARENTS)]
        steps = int(count * (1.0 - _EXPLORING)) if len(parents) else 0
        new = np.vstack([_children(parents, steps, rng), *islice(spread, count - steps)])
        points, scores = np.vstack([points, new]), np.concatenate([scores, score(new)])
        on_round(len(points))
    return points, scores


def _spread(dimensions: int, seed: int) -> Iterator[Floats]:
    from scipy.stats import qmc  # imported here, because it takes a second to load

    sobol = qmc.Sobol(dimensions, rng=np.random.default_rng([seed, dimensions, 1]))
    while True:
        yield from np.minimum(sobol.random(ROUND), _LAST)


def far_apart(points: Floats, scores: Floats, count: int) -> Ints:
    """Rows of at most ``count`` of the ``points`` [m, d] with high finite ``scores`` [m], highest score first.

    Any two of these points differ by at least ``LEAST_DISTANCE`` in some coordinate.
    """
    order = np.argsort(-scores, kind="stable")
    order = order[np.isfinite(scores[order])]
    chosen: list[int] = []
    while len(order) and len(chosen) < count:
        chosen.append(int(order[0]))
        order = order[np.abs(points[order] - points[order[0]]).max(axis=1) >= LEAST_DISTANCE]
    return np.array(chosen, np.int64)


def _children(parents: Floats, count: int, rng: np.random.Generator) -> Floats:
    """New points of the cube, [count, d], one step (``search_cube``) away from ``parents`` [p, d]."""
    if count == 0:
        return parents[:0]
    parent = parents[np.arange(count) % len(parents)]
    size = _NEAREST * (_FARTHEST / _NEAREST) ** rng.random((count, 1))
    moved = rng.random(parent.shape) < 0.5
    moved[np.arange(count), rng.integers(parent.shape[1], size=count)] = True
    step = np.where(moved, size * rng.standard_normal(parent.shape), 0.0)
    first_parent, second_parent = (parents[rng.integers(len(parents), size=count)] for _ in range(2))
    crossing = rng.random((count, 1)) < 1.0 / 3.0
    moved_to = parent + np.where(crossing, 0.5 * (first_parent - second_parent) + 0.1 * step, step)
    inside: Floats = 1.0 - np.abs(np.mod(moved_to, 2.0) - 1.0)  # reflects points that left the cube at its faces
    return np.clip(inside, 0.0, _LAST)
