"""Search the ranges of a scenario for the worlds where an agent is worst."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Literal, NamedTuple, get_args

import numpy as np

from ethbrake_marl.agents import Driver
from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number, unknown_name
from ethbrake_marl.evaluation import NamedWorld, evaluate, make_lineup, states_of
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.scenario import Sample, Scenario

# Measures of an agent's weakness, world by world.

MeasureName = Literal["harm", "regret", "difference", "bound"]
MEASURES: tuple[MeasureName, ...] = get_args(MeasureName)
HINDSIGHT = "best_harm"  # the reference of regret, unless another is given


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured in some worlds, [n] each, m2/s2; minus infinity and NaN where the physics failed."""

    score: Floats
    harm: Floats
    reference: Floats | None  # harm of the agent that it is compared with, or the bound that a shield told


@dataclass(frozen=True, slots=True)
class Measure:
    """How bad a world is for an agent.

    ``harm``: its harm. ``regret``: what it does more than the reference, by default the best profile that a search
    finds with hindsight. ``difference``: by how much it and the reference differ, either way. ``bound``: its harm less
    the bound that its shield told at the alert; above zero the bound is broken.
    """

    name: MeasureName
    agents: Mapping[str, Driver]  # the agent, and the reference if there is one
    scenario: Scenario
    harm_count: HarmCount

    def __call__(self, sample: Sample) -> Measured:
        """Measure in these worlds; where the physics fails with one of the agents the score is minus infinity."""
        n = sample.worlds.n
        score, harm, reference = np.full(n, -np.inf), np.full(n, np.nan), np.full(n, np.nan)
        try:
            found = evaluate(sample, self.agents, scenario=self.scenario, aftermath=False)
        except PhysicsError:
            return Measured(score, harm, reference)
        rows = np.searchsorted(sample.index, found.index)
        agent, *other = (found.outcome(name) for name in self.agents)
        harm[rows] = agent.ledger.world_harm(self.harm_count)
        if self.name == "harm":
            score[rows] = harm[rows]
            return Measured(score, harm, None)
        beside = other[0].ledger.world_harm(self.harm_count) if other else agent.predicted_harm
        if beside is None:
            raise InvalidInput(
                f"agent {next(iter(self.agents))!r}: tells no bound; --measure bound is for an agent behind a shield,"
                " for instance ppo@shipped+step"
            )
        reference[rows] = beside
        more = harm[rows] - beside
        score[rows] = np.abs(more) if self.name == "difference" else more
        return Measured(score, harm, reference)

    def falsify(
        self, budget: int, seed: int, *, most: int = 20, adaptive: bool = True, on_round: Watcher | None = None
    ) -> Falsified:
        """Try ``budget`` worlds of the scenario, and keep the worst, at most ``most``, that are far apart.

        Worlds without harm, regret or difference are not kept: the result may hold none.

        Raises ``InvalidInput`` where the scenario draws nothing, or has none of the worlds that were tried, and what
        ``Scenario.ranges`` raises.
        """
        ranges = self.scenario.ranges()

        def score(points: Floats) -> Floats:
            sample, accepted = ranges.sample(points)
            found, rows = np.full(len(points), -np.inf), np.flatnonzero(accepted)
            if len(rows):
                found[rows] = self(sample.take(rows)).score
            return found

        tried = search(score, len(ranges.names), budget, seed, adaptive=adaptive, on_round=on_round)
        worst = far_apart(tried, most)
        if self.name != "bound":
            worst = worst[tried.scores[worst] > 0.0]
        if not np.isfinite(tried.scores).any():
            raise InvalidInput(
                f"scenario {self.scenario.name!r}: none of {budget:,} worlds tried counts: all have an impact before"
                " anybody may act, or the physics fails; give early_impacts: keep, or a larger --budget"
            )
        above = np.flatnonzero(tried.scores > 0.0)
        sample, kept = ranges.sample(tried.points[worst])[0], []
        if len(worst):
            found = self(sample)
            kept = [
                NamedWorld(
                    name=f"{self.name}-{k + 1}",
                    score=float(found.score[k]),
                    harm=float(found.harm[k]),
                    reference=None if found.reference is None else float(found.reference[k]),
                    state={name: each for name, each in state.items() if each is not None},
                )
                for k, state in enumerate(states_of(sample.worlds, self.scenario))
            ]
        return Falsified(sample, kept, tried.scores, int(above[0]) + 1 if len(above) else None)

    @classmethod
    def of(cls, name: str, agent: str, against: str | None, scenario: Scenario, harm_count: HarmCount) -> Measure:
        """The measure of that name; raises ``InvalidInput`` for a reference that is missing or not asked for."""
        chosen = next((each for each in MEASURES if each == name), None)
        if chosen is None:
            raise unknown_name("measure", name, MEASURES)
        if name in ("harm", "bound") and against is not None:
            raise InvalidInput(f"--against {against}: --measure {name} compares with nobody; use regret or difference")
        if name == "difference" and against is None:
            raise InvalidInput("--measure difference: compares two agents; say which is the other one, --against AGENT")
        specs = [agent] if name in ("harm", "bound") else [agent, against or HINDSIGHT]
        lineup = make_lineup(specs, scenario, harm_count=harm_count)
        if len(lineup) != len(specs):
            raise InvalidInput(f"agent {' or '.join(specs)}: stands for several agents; one is needed here")
        return cls(chosen, lineup, scenario, harm_count)


# An adaptive search of the unit cube for the points of highest score, of which several far apart are wanted.

Score = Callable[[Floats], Floats]  # points [n, d] of [0, 1) -> scores [n]; minus infinity: the point does not count
Watcher = Callable[[int, int], None]  # points scored so far, and in all

ROUND = 256  # points that are scored together
APART = 0.1  # of two finds, in some coordinate
_PARENTS = 24  # of the next round, far apart
_EXPLORING = 0.5  # share of each round that is spread evenly over the cube
_NEAREST, _FARTHEST = 1e-3, 0.3  # typical steps from a parent
_LAST = np.nextafter(1.0, 0.0)


class Scored(NamedTuple):
    """All points that were tried, in their order."""

    points: Floats  # [n, d]
    scores: Floats  # [n]


def search(
    score: Score, dimensions: int, budget: int, seed: int, *, adaptive: bool = True, on_round: Watcher | None = None
) -> Scored:
    """Score ``budget`` points. ``adaptive``: look around the best so far; otherwise independent uniform points.

    A round's points are partly spread evenly (scrambled Sobol), partly one step from the best points so far that are
    far apart: a normal step in some coordinates, or the difference of two other ones (differential evolution). While
    no point is better than the median, all are spread evenly. The same seed gives the same points.
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
    """Scrambled Sobol points, drawn a whole round at a time: their balance needs powers of two."""
    from scipy.stats import qmc  # takes a second to load, and most commands search nothing

    sobol = qmc.Sobol(dimensions, rng=np.random.default_rng([seed, dimensions, 1]))
    while True:
        yield from np.minimum(sobol.random(ROUND), _LAST)


def far_apart(found: Scored, count: int) -> Ints:
    """Rows of the best points, at most ``count``, best first, of which any two are ``APART`` in some coordinate."""
    order = np.argsort(-found.scores, kind="stable")
    order = order[np.isfinite(found.scores[order])]
    kept: list[int] = []
    while len(order) and len(kept) < count:
        best = order[0]
        kept.append(int(best))
        order = order[np.abs(found.points[order] - found.points[best]).max(axis=1) >= APART]
    return np.array(kept, np.int64)


def _above_median(found: Scored) -> Scored:
    """The same points, but those that are no better than the median do not count."""
    good = np.isfinite(found.scores)
    if not good.any():
        return found
    return found._replace(scores=np.where(found.scores > np.median(found.scores[good]), found.scores, -np.inf))


def _children(parents: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Points near parents, [count, d]; every parent has as many as any other."""
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
    inside: Floats = 1.0 - np.abs(np.mod(moved_to, 2.0) - 1.0)  # what left the cube is thrown back at its faces
    return np.clip(inside, 0.0, _LAST)


@dataclass(frozen=True, slots=True)
class Falsified:
    """The worst worlds that a search found, worst first, and what all that it tried were like."""

    sample: Sample  # the worst worlds
    worlds: list[NamedWorld]  # the same by name, and what was measured in them
    scores: Floats  # of every world tried, in their order; minus infinity: the scenario does not have it
    first_above: int | None  # how many worlds were tried until one had a score above zero

    @property
    def share_above(self) -> float:
        """Share of the tried worlds, of those that count, with a score above zero."""
        good = self.scores[np.isfinite(self.scores)]
        return float((good > 0.0).mean()) if len(good) else 0.0
