"""Lines for the limits: one by hand, random ones far beyond the paper's ranges, and many unlike regions."""

from dataclasses import replace

import numpy as np

from ethbrake_marl.physics.state import Floats, Worlds, make_worlds


def line(
    gaps, speeds, braking, latency=0.0, *, driving=0.0, mass=5.0, restitution=0.1, limit=40.0, obstacle=None, time_s=0.0
):
    """One world."""
    worlds = make_worlds(
        [gaps], [speeds], braking_capacity_mps2=braking, driving_capacity_mps2=driving, latency_s=latency, mass_t=mass,
        restitution=restitution, speed_limit_mps=limit, obstacle_gap_m=obstacle,
    )  # fmt: skip
    return replace(worlds, time_s=np.array([time_s]))


def paper_line(gaps, speeds, latency):
    """One world with the capacities and masses of the paper."""
    return line(gaps, speeds, [6, 7, 6], latency, driving=[6, 7, 6], mass=[4.5, 5.5, 5.9])


def opening(gap):
    """Vehicle 1 drives away from one that is 4 m/s faster and brakes less."""
    return line([gap], [10, 14], [5, 2], driving=[2, 0])


def wide_worlds(n: int, vehicles: int, seed: int, *, zeros: float = 0.03, strong: bool = False) -> Worlds:
    """Lines with any capacities, low speed limits, standing vehicles, exact zeros; Vehicle 1 brakes at 0.

    ``strong``: Vehicle 2 brakes at least as hard as the others.
    """
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0, 40, (n, vehicles - 1)) * rng.choice([0.1, 0.4, 1.0], (n, vehicles - 1))
    speeds = rng.uniform(0, 35, (n, 1)) + rng.normal(0, 1, (n, vehicles)) * rng.choice([0.5, 3, 10], (n, 1))
    speeds = np.clip(speeds, 0, 35)
    braking = rng.uniform(1, 10, (n, vehicles))
    braking[:, 1] = np.where(rng.random(n) < 0.1, braking[:, 0], braking[:, 1])
    if strong:
        braking[:, 1] = braking.max(axis=1) * rng.choice([1.0, 1.05, 1.3], n)
    driving = rng.uniform(0, 8, (n, vehicles))
    latency = rng.uniform(0, 1.5, (n, vehicles))
    latency[:, 0] = 0
    above = rng.exponential(5, (n, vehicles)) * rng.choice([0, 1], (n, vehicles), p=[0.2, 0.8])
    for part in (gaps, speeds, driving, latency):
        part[rng.random(part.shape) < zeros] = 0
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=braking,
        driving_capacity_mps2=driving,
        latency_s=latency,
        mass_t=rng.uniform(1, 20, (n, vehicles)),
        restitution=rng.uniform(0, 0.5, n),
        speed_limit_mps=np.maximum(speeds + above, 1e-3),
    )


def random_profiles(worlds: Worlds, vehicle: int, rng: np.random.Generator, pieces: int = 5) -> tuple[Floats, Floats]:
    """Switch times and commands [n, pieces]: most commands extreme, most switches soon after the latency."""
    v, n = worlds.vehicles, worlds.n
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    span = np.max(v.latency_s + worlds.speeds_mps / v.braking_capacity_mps2, axis=1, keepdims=True)
    part = np.sort(rng.uniform(0, 1, (n, pieces - 1)) ** rng.choice([1, 2, 4], (n, 1)), axis=1)
    switch = np.column_stack([worlds.time_s, v.latency_s[:, [vehicle]] + part * span])
    share = rng.uniform(0, 1, (n, pieces))
    share = np.where(rng.random((n, pieces)) < 0.6, np.round(share), share)
    return in_order(worlds, switch), np.clip(low + (high - low) * share, low, high)


def moved_profiles(
    worlds: Worlds, vehicle: int, switch: Floats, command: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """The profiles, each changed a little or a lot in some of its numbers."""
    v, n = worlds.vehicles, worlds.n
    low, high = -v.braking_capacity_mps2[:, [vehicle]], v.driving_capacity_mps2[:, [vehicle]]
    scale = 10.0 ** rng.uniform(-5, 0, (n, 1))
    switch = switch + 3 * scale * rng.normal(size=switch.shape) * (rng.random(switch.shape) < 0.5)
    command = command + 7 * scale * rng.normal(size=command.shape) * (rng.random(command.shape) < 0.3)
    return in_order(worlds, switch), np.clip(command, low, high)


def in_order(worlds: Worlds, switch: Floats) -> Floats:
    """Switch times from the worlds' own time on that never fall."""
    switch = np.maximum.accumulate(np.maximum(switch, worlds.time_s[:, None]), axis=1)
    switch[:, 0] = worlds.time_s
    return switch


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


def drawn(low, high):
    """A number for each vehicle, pair or world."""
    return lambda name, line, rng: rng.uniform(low, high, line[name].shape)


def rising(low, high):
    """A number per vehicle, sorted from front to rear."""
    return lambda name, line, rng: np.sort(rng.uniform(low, high, line[name].shape), axis=1)


def of(column, low, high):
    """The numbers of ``plain``, but those of one vehicle."""

    def draw(name, line, rng):
        values = line[name]
        mine = np.arange(values.shape[1]) == min(column, values.shape[1] - 1)
        return np.where(mine, rng.uniform(low, high, (len(values), 1)), values)

    return draw


def alike(name, line, rng):
    """The number of the first vehicle for all."""
    return np.repeat(line[name][:, :1], line[name].shape[1], axis=1)


def masses(name, line, rng):
    """From 0.05 to 100 t."""
    return 10 ** rng.uniform(-1.3, 2, line[name].shape)


REGIONS = {
    "plain": {},
    "masses 0.05 to 100 t": {"mass": masses},
    "masses 0.05 to 100 t, restitution to 1": {"mass": masses, "restitution": drawn(0, 1)},
    "restitution to 1": {"restitution": drawn(0, 1)},
    "restitution near 1": {"restitution": drawn(0.9, 1)},
    "late leader": {  # by up to 2 s
        "latency": lambda name, line, rng: (
            line[name] + rng.uniform(0, 2, (len(line[name]), 1)) * (np.arange(line[name].shape[1]) == 0)
        )
    },
    "any latency": {"latency": drawn(0, 1.5)},
    "rear reacts first": {  # of those behind Vehicle 1 the last one
        "latency": lambda name, line, rng: np.concatenate([line[name][:, :1], line[name][:, :0:-1]], axis=1)
    },
    "weak brakes in the middle": {"braking": of(1, 1, 3)},
    "weak brakes behind": {"braking": of(2, 1, 3)},
    "weak brakes in front": {"braking": of(0, 1, 3)},
    "brakes rise to the rear": {"braking": rising(1, 10)},
    "brakes fall to the rear": {"braking": lambda name, line, rng: rising(1, 10)(name, line, rng)[:, ::-1].copy()},
    "equal brakes": {"braking": alike},
    "standing leader": {"speeds": of(0, 0, 0)},
    "slow leader": {"speeds": of(0, 0, 5)},
    "standing in the middle": {"speeds": of(1, 0, 0), "latency": drawn(0, 1.5)},
    "fast behind": {"speeds": of(2, 20, 35)},
    "touching in front": {"speeds": alike, "gaps": of(0, 0, 0)},
    "touching behind": {"speeds": alike, "gaps": of(9, 0, 0)},
    "all touching": {"speeds": alike, "gaps": drawn(0, 0)},
    "tiny gaps": {"gaps": drawn(0, 0.5)},
    "no drive": {"driving": drawn(0, 0)},
    "strong drive": {"driving": drawn(10, 30)},
    "low limits": {"limit": lambda name, line, rng: line["speeds"] + rng.exponential(1, line[name].shape)},
    "any speeds": {"speeds": drawn(0, 40)},
    "slow traffic": {"speeds": drawn(0, 5), "gaps": drawn(0, 2)},
    "heavy in front": {"mass": of(0, 40, 100)},
    "heavy behind": {"mass": of(2, 40, 100)},
    "at once": {"latency": drawn(0, 0)},
}


def worlds_of(region, n, N, seed, obstacle=None):
    """Worlds of a region; with ``obstacle``, one stands so far beyond where Vehicle 1 stops alone (m, drawn)."""
    rng = np.random.default_rng(seed)
    given = plain(n, N, rng)
    for name, draw in REGIONS[region].items():
        given[name] = draw(name, given, rng)
    v, a = given["speeds"][:, 0], given["braking"][:, 0]
    stops = v * given["latency"][:, 0] + v * v / (2 * a)
    return make_worlds(
        given["gaps"],
        given["speeds"],
        braking_capacity_mps2=given["braking"],
        driving_capacity_mps2=given["driving"],
        latency_s=given["latency"],
        mass_t=given["mass"],
        restitution=given["restitution"],
        speed_limit_mps=np.maximum(given["limit"], given["speeds"] + 1e-3),
        obstacle_gap_m=None if obstacle is None else np.maximum(stops + rng.uniform(*obstacle, n), 0.01),
    )


def with_rates(worlds, seed):
    """The same worlds, each brake built up and released at 3 to 100 m/s3, one in five at once."""
    rng, shape = np.random.default_rng(seed), worlds.speeds_mps.shape
    brake, release = (
        np.where(rng.random(shape) < 0.2, np.inf, 10 ** rng.uniform(np.log10(3), 2, shape)) for _ in range(2)
    )
    return replace(worlds, vehicles=replace(worlds.vehicles, brake_rate_mps3=brake, release_rate_mps3=release))
