"""The lower bound against searched profiles in many unlike regions: never above what is realised."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.limits.lower_bound import lower_bound
from ethbrake_marl.physics import make_worlds
from ethbrake_marl.search import profile_problem

HORIZON_S, TIME_STEP_S = 60.0, 0.1


def plain(n, rng):
    """Lines of three in ordinary traffic, as a dictionary that a region changes."""
    return {
        "gaps": rng.uniform(1, 15, (n, 2)),
        "speeds": np.clip(rng.uniform(5, 30, (n, 1)) + rng.normal(0, 2, (n, 3)), 0, None),
        "braking": rng.uniform(4, 9, (n, 3)),
        "driving": rng.uniform(2, 8, (n, 3)),
        "latency": rng.uniform(0, 1, (n, 3)) * [0, 1, 1.5],
        "mass": rng.uniform(1, 20, (n, 3)),
        "restitution": rng.uniform(0, 0.3, n),
        "limit": np.full((n, 3), 60.0),
    }


def each(*ranges):
    """A number per vehicle, drawn from its own range."""
    return lambda n, rng, _: np.stack([rng.uniform(*one, n) for one in ranges], axis=1)


def same(*values):
    """The same numbers in every world."""
    return lambda n, rng, _: np.tile(np.array(values, float), (n, 1))


def one(low, high):
    """One number per world."""
    return lambda n, rng, _: rng.uniform(low, high, n)


def masses(n, rng, _):
    return 10 ** rng.uniform(-1.3, 2, (n, 3))


def times(*factors):
    """The latencies, each with its own factor."""
    return lambda n, rng, line: line["latency"] * factors


def close(n, rng, line):
    """Speeds of the first vehicle for all three."""
    return np.repeat(line["speeds"][:, :1], 3, axis=1)


REGIONS = {
    "plain": {},
    "masses 0.05 to 100 t": {"mass": masses},
    "masses 0.05 to 100 t, restitution to 1": {"mass": masses, "restitution": one(0, 1)},
    "restitution to 1": {"restitution": one(0, 1)},
    "restitution near 1": {"restitution": one(0.9, 1)},
    "late leader": {
        "latency": lambda n, rng, line: line["latency"][:, [1, 1, 2]] * rng.uniform(0, 1, (n, 3)) ** [1, 0, 0]
    },
    "weakest brakes in the middle": {"braking": each((5, 10), (1, 4), (5, 10))},
    "brakes fall to the rear": {"braking": each((6, 10), (4, 6), (1, 4))},
    "brakes rise to the rear": {"braking": each((1, 4), (4, 6), (6, 10))},
    "equal brakes": {"braking": lambda n, rng, _: np.repeat(rng.uniform(3, 9, (n, 1)), 3, axis=1)},
    "standing leader": {"speeds": each((0, 0), (5, 30), (5, 30))},
    "slow leader": {"speeds": each((0, 4), (5, 30), (5, 30))},
    "standing in the middle": {"speeds": each((5, 20), (0, 0), (5, 20)), "latency": times(0, 0.2, 1)},
    "touching in front": {"speeds": close, "gaps": each((0, 0), (0, 10)), "latency": times(0, 0, 1)},
    "touching behind": {"speeds": close, "gaps": each((1, 10), (0, 0))},
    "touching both": {"speeds": close, "gaps": same(0, 0), "latency": times(0, 0, 1)},
    "no drive": {"driving": same(0, 0, 0)},
    "strong drive": {"driving": each((10, 30), (10, 30), (10, 30))},
    "low limits": {"limit": lambda n, rng, line: line["speeds"] + rng.exponential(1, (n, 3))},
    "tiny gaps": {"gaps": each((0, 0.5), (0, 0.5)), "latency": times(0, 0.05, 1)},
    "any speeds": {"speeds": each((0, 40), (0, 40), (0, 40))},
    "fast behind": {"speeds": each((5, 20), (5, 20), (15, 35))},
    "late behind": {"latency": times(0, 0.3, 2)},
    "heavy in front": {"mass": each((20, 40), (3, 20), (1, 40))},
    "heavy behind": {"mass": each((1, 5), (1, 5), (10, 90))},
    "slow traffic": {"speeds": each((0, 5), (0, 5), (0, 5)), "gaps": each((0, 2), (0, 2))},
}


def worlds_of(region, n, seed):
    rng = np.random.default_rng(seed)
    line = plain(n, rng)
    for name, draw in REGIONS[region].items():
        line[name] = draw(n, rng, line)
    return make_worlds(
        line["gaps"],
        line["speeds"],
        braking_capacity_mps2=line["braking"],
        driving_capacity_mps2=line["driving"],
        latency_s=line["latency"],
        mass_t=line["mass"],
        restitution=line["restitution"],
        speed_limit_mps=np.maximum(line["limit"], line["speeds"] + 1e-3),
    )


def searched(worlds, harm_count, time_step_s, budget):
    problem = profile_problem(worlds, [1], harm_count=harm_count, horizon_s=HORIZON_S, time_step_s=time_step_s)
    given = problem.constant(problem.even_grid(9))
    return problem.search(given, budget=budget)[1][harm_count]


def check_region(region, n, budget, seed):
    worlds = worlds_of(region, n, seed)
    any_time = lower_bound(worlds, horizon_s=HORIZON_S)
    decided = lower_bound(worlds, horizon_s=HORIZON_S, time_step_s=TIME_STEP_S)
    assert np.all(any_time.harm <= decided.harm)
    for harm_count in ("first", "total"):
        assert np.all(decided.harm <= searched(worlds, harm_count, TIME_STEP_S, budget))
    assert np.all(any_time.harm <= searched(worlds, "first", 0.25 * TIME_STEP_S, budget))


@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_searched_profile(region):
    check_region(region, 15, 300, seed=51)


@pytest.mark.long
@pytest.mark.parametrize("region", REGIONS)
def test_bound__is_never_above_a_longer_search_of_many_worlds(region):
    check_region(region, 400, 5000, seed=52)
