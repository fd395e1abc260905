"""Adaptive search of the unit cube for several points that have high scores and are far apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import check_whole_number
from ethbrake_marl.extensions.studies.named_worlds import NamedWorld
from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.scenario.sample import Sample

Score = Callable[[Floats], Floats]  # points [n, d] of [0, 1) -> scores [n]; minus infinity: the point is invalid

Watcher = Callable[[int, int], None]  # called with the number of points scored so far, and the number of all points

ROUND = 256  # number of points that are scored together

APART = 0.1  # least difference of two results, in at least one coordinate

_PARENTS = 24  # number of parents of the next round; they are far apart

_EXPLORING = 0.5  # fraction of each round that is spread evenly over the cube

_NEAREST, _FARTHEST = 1e-3, 0.3  # smallest and largest typical step from a parent

_LAST = np.nextafter(1.0, 0.0)


class Scored(NamedTuple):
    """The n points of the unit cube that a search tried, in the order of the search, with their scores."""

    points: Floats  # [n, d] coordinates in [0, 1)
    scores: Floats  # [n] score of each point, the larger the better; minus infinity: the point is invalid


def search(
    score: Score, dimensions: int, budget: int, seed: int, *, adaptive: bool = True, on_round: Watcher | None = None
) -> Scored:
    """Search the unit cube for points with a high score, and return all points that were tried.

    The points are tried in rounds of at most 256 points (``ROUND``). Half of the points of a round are spread evenly
    over the cube (scrambled Sobol points). Each other point of the round is one step away from a *parent*. The parents
    are points with the highest scores so far; no two parents are close to each other. A step is a normally distributed
    random step in some coordinates, or half the difference between two random parents (differential evolution). In the
    first round, and later while no score is above the median score, all points are spread evenly. The same seed gives
    the same points.

    Args:
        score: function from points [n, d] to scores [n].
        dimensions: number of coordinates, d.
        budget: number of points to try.
        seed: seed of the random numbers.
        adaptive: True: search around the best points; False: all points are uniform random points.
        on_round: called after each round with the number of points tried so far and ``budget``.

    """
    check_whole_number("search: budget", budget, 1)
    check_whole_number("search: seed", seed, 0)
    rng = np.random.default_rng([seed, dimensions])
    spread = _spread(dimensions, seed)
    points, scores = np.empty((0, dimensions)), np.empty(0)
    while len(points) < budget:
        count = min(ROUND, budget - len(points))
        if not adaptive:
            new = rng.random((count, dimensions))
        else:
            parents = points[far_apart(_above_median(Scored(points, scores)), _PARENTS)]
            steps = int(count * (1.0 - _EXPLORING)) if len(parents) else 0
            new = np.vstack([_children(parents, steps, rng), *islice(spread, count - steps)])
        points, scores = np.vstack([points, new]), np.concatenate([scores, score(new)])
        if on_round is not None:
            on_round(len(points), budget)
    return Scored(points, scores)


def _spread(dimensions: int, seed: int) -> Iterator[Floats]:
    """Yield, without end, points [d] that are spread evenly over the unit cube (scrambled Sobol points).

    The same seed gives the same points.
    """
    from scipy.stats import qmc  # imported here, because it takes a second to load

    sobol = qmc.Sobol(dimensions, rng=np.random.default_rng([seed, dimensions, 1]))
    while True:
        yield from np.minimum(sobol.random(ROUND), _LAST)


def far_apart(scored: Scored, count: int) -> Ints:
    """Choose at most ``count`` points of ``scored`` that have high scores and are far apart.

    Return their row numbers, highest score first. Any two of the points differ by at least 0.1 in some coordinate.
    Points whose score is not finite are never chosen.
    """
    order = np.argsort(-scored.scores, kind="stable")
    order = order[np.isfinite(scored.scores[order])]
    chosen: list[int] = []
    while len(order) and len(chosen) < count:
        best = order[0]
        chosen.append(int(best))
        order = order[np.abs(scored.points[order] - scored.points[best]).max(axis=1) >= APART]
    return np.array(chosen, np.int64)


def _above_median(scored: Scored) -> Scored:
    """Return a copy of ``scored`` in which every score that is not above the median score is minus infinity."""
    good = np.isfinite(scored.scores)
    if not good.any():
        return scored
    return scored._replace(scores=np.where(scored.scores > np.median(scored.scores[good]), scored.scores, -np.inf))


def _children(parents: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Return ``count`` new points [count, d], about equally many near each point of ``parents`` [m, d]."""
    if count == 0:
        return parents[:0]
    parent = parents[np.arange(count) % len(parents)]
    size = _NEAREST * (_FARTHEST / _NEAREST) ** rng.random((count, 1))
    moved = rng.random(parent.shape) < 0.5
    moved[np.arange(count), rng.integers(parent.shape[1], size=count)] = True
    step = np.where(moved, size * rng.standard_normal(parent.shape), 0.0)
    one, other = (parents[rng.integers(len(parents), size=count)] for _ in range(2))
    crossing = rng.random((count, 1)) < 1.0 / 3.0
    moved_to = parent + np.where(crossing, 0.5 * (one - other) + 0.1 * step, step)
    inside: Floats = 1.0 - np.abs(np.mod(moved_to, 2.0) - 1.0)  # reflects points that left the cube at its faces
    return np.clip(inside, 0.0, _LAST)


@dataclass(frozen=True, slots=True)
class Falsified:
    """Result of a search for worlds in which an agent does badly: the worst worlds, and the scores of all worlds."""

    sample: Sample  # the worst worlds at the alert
    worlds: list[NamedWorld]  # the same worlds with names, initial states and measurements
    # Score of every tried world, m2/s2; minus infinity: the scenario rejects the world, or the physics failed.
    scores: Floats
    first_above: int | None  # number of worlds tried until the first score above 0; None: no score is above 0

    @property
    def share_above(self) -> float:
        """Fraction of worlds with a score above 0, among the worlds with a finite score."""
        good = self.scores[np.isfinite(self.scores)]
        return float((good > 0.0).mean()) if len(good) else 0.0
