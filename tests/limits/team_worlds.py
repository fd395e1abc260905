"""Lines of two to six vehicles in many unlike regions, for the bounds of teams."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import make_worlds


def plain(n, N, rng):
    """Lines in ordinary traffic, as a dictionary that a region changes."""
    return {
        "gaps": rng.uniform(1, 12, (n, N - 1)),
        "speeds": np.clip(rng.uniform(5, 30, (n, 1)) + rng.normal(0, 2, (n, N)), 0, None),
        "braking": rng.uniform(4, 9, (n, N)),
        "driving": rng.uniform(2, 8, (n, N)),
        "latency": np.concatenate([np.zeros((n, 1)), np.sort(rng.uniform(0, 1.5, (n, N - 1)), axis=1)], axis=1),
        "mass": rng.uniform(1, 20, (n, N)),
        "restitution": rng.uniform(0, 0.3, n),
        "limit": np.full((n, N), 60.0),
    }


def every(low, high):
    """A number per vehicle."""
    return lambda n, N, rng, _: rng.uniform(low, high, (n, N))


def rising(low, high):
    """A number per vehicle, sorted from front to rear."""
    return lambda n, N, rng, _: np.sort(rng.uniform(low, high, (n, N)), axis=1)


def falling(low, high):
    return lambda n, N, rng, line: rising(low, high)(n, N, rng, line)[:, ::-1].copy()


def of(column, low, high):
    """The numbers of ``plain``, but those of one vehicle."""

    def draw(n, N, rng, line, name):
        values = line[name].copy()
        values[:, min(column, N - 1)] = rng.uniform(low, high, n)
        return values

    return draw


def between(low, high):
    """A number per pair."""
    return lambda n, N, rng, _: rng.uniform(low, high, (n, N - 1))


def one(low, high):
    """One number per world."""
    return lambda n, N, rng, _: rng.uniform(low, high, n)


def masses(n, N, rng, _):
    return 10 ** rng.uniform(-1.3, 2, (n, N))


def together(n, N, rng, line):
    """The speed of the first vehicle for all."""
    return np.repeat(line["speeds"][:, :1], N, axis=1)


def first_gap_zero(n, N, rng, line):
    return line["gaps"] * (np.arange(N - 1) > 0)


def last_gap_zero(n, N, rng, line):
    return line["gaps"] * (np.arange(N - 1) < N - 2)


def unsorted(n, N, rng, line):
    """Any vehicle may react last, Vehicle 1 too."""
    return rng.uniform(0, 1.5, (n, N))


def first_late(n, N, rng, line):
    return line["latency"] + rng.uniform(0, 2, (n, 1)) * (np.arange(N) == 0)


def as_the_rear(n, N, rng, line):
    """Of those behind Vehicle 1 the last one reacts first."""
    return np.concatenate([line["latency"][:, :1], line["latency"][:, :0:-1]], axis=1)


REGIONS = {
    "plain": {},
    "masses 0.05 to 100 t": {"mass": masses},
    "masses 0.05 to 100 t, restitution to 1": {"mass": masses, "restitution": one(0, 1)},
    "restitution to 1": {"restitution": one(0, 1)},
    "restitution near 1": {"restitution": one(0.9, 1)},
    "late leader": {"latency": first_late},
    "any latency": {"latency": unsorted},
    "rear reacts first": {"latency": as_the_rear},
    "weak brakes in the middle": {"braking": of(1, 1, 3)},
    "weak brakes behind": {"braking": of(2, 1, 3)},
    "weak brakes in front": {"braking": of(0, 1, 3)},
    "brakes rise to the rear": {"braking": rising(1, 10)},
    "brakes fall to the rear": {"braking": falling(1, 10)},
    "equal brakes": {"braking": lambda n, N, rng, _: np.repeat(rng.uniform(3, 9, (n, 1)), N, axis=1)},
    "standing leader": {"speeds": of(0, 0, 0)},
    "slow leader": {"speeds": of(0, 0, 5)},
    "standing in the middle": {"speeds": of(1, 0, 0), "latency": unsorted},
    "fast behind": {"speeds": of(2, 20, 35)},
    "touching in front": {"speeds": together, "gaps": first_gap_zero},
    "touching behind": {"speeds": together, "gaps": last_gap_zero},
    "all touching": {"speeds": together, "gaps": between(0, 0)},
    "tiny gaps": {"gaps": between(0, 0.5)},
    "no drive": {"driving": every(0, 0)},
    "strong drive": {"driving": every(10, 30)},
    "low limits": {"limit": lambda n, N, rng, line: line["speeds"] + rng.exponential(1, (n, N))},
    "any speeds": {"speeds": every(0, 40)},
    "slow traffic": {"speeds": every(0, 5), "gaps": between(0, 2)},
    "heavy in front": {"mass": of(0, 40, 100)},
    "heavy behind": {"mass": of(2, 40, 100)},
    "at once": {"latency": every(0, 0)},
}


def worlds_of(region, n, N, seed, obstacle=None):
    """Worlds of a region; with ``obstacle``, one stands so far beyond where Vehicle 1 stops alone (m, drawn)."""
    rng = np.random.default_rng(seed)
    line = plain(n, N, rng)
    for name, draw in REGIONS[region].items():
        extra = (name,) if draw.__code__.co_argcount == 5 else ()
        line[name] = draw(n, N, rng, line, *extra)
    v, a = line["speeds"][:, 0], line["braking"][:, 0]
    stops = v * line["latency"][:, 0] + v * v / (2 * a)
    place = None if obstacle is None else np.maximum(stops + rng.uniform(*obstacle, n), 0.01)
    return make_worlds(
        line["gaps"],
        line["speeds"],
        braking_capacity_mps2=line["braking"],
        driving_capacity_mps2=line["driving"],
        latency_s=line["latency"],
        mass_t=line["mass"],
        restitution=line["restitution"],
        speed_limit_mps=np.maximum(line["limit"], line["speeds"] + 1e-3),
        obstacle_gap_m=place,
    )
