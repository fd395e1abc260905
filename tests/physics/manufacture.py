"""Worlds built backwards from chosen contact times, in dyadic rationals.

Vehicles are added one behind the other. Each new one gets its own motion (latency, command, speed limit) and a contact
time on a grid of 1/8 s; its initial gap is then the way by which it gains on the vehicle before it until then. Every
number of such a world is a multiple of a power of two with few digits, so a double holds it exactly and a correct kernel
must find the same bits as rational arithmetic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise

import numpy as np

from ethbrake_marl.physics import Worlds, make_worlds
from tests.physics.exact_simulator import Irrational, Line, Outcome, Rationals, simulate

GRID = 1 << 14  # every state on the way is a multiple of 1 / GRID: squares and products then fit in 53 bits
FAR = Fraction(1 << 20)
CAPACITY_MPS2 = 16.0
MASSES = (  # touching neighbours weigh a power of two together, so that common speeds are dyadic
    (1, 1, 2, 4, 8), (2, 2, 4, 8, 16), (1, 3, 1, 3, 1), (3, 1, 3, 1, 3), (3, 5, 3, 5, 3), (7, 1, 7, 1, 7), (1, 7, 1, 7, 1),
    (1, 1, 1, 1, 1), (8, 4, 2, 1, 1), (2, 6, 2, 6, 2), (1, 15, 1, 15, 1), (6, 2, 6, 2, 6),
)  # fmt: skip
RESTITUTIONS = (0, Fraction(1, 4), Fraction(1, 2), Fraction(3, 4), 1)
COMMANDS = (-8, -4, -2, -2, -1, Fraction(-1, 2), 0, 0, Fraction(1, 2), 1, 2, 4)


@dataclass(frozen=True)
class Case:
    """A manufactured world, how long it runs, and what exactly happens."""

    line: Line
    until: Fraction
    outcome: Outcome


def manufactured(seed: int, N: int, count: int) -> list[Case]:
    """``count`` worlds of ``N`` vehicles, each with at least one contact at a chosen time."""
    rng = np.random.default_rng([seed, N])
    cases: list[Case] = []
    while len(cases) < count:
        cases += attempt(rng, N)
    return cases[:count]


def attempt(rng: np.random.Generator, N: int) -> Iterator[Case]:
    """Build one world; nothing when a vehicle cannot be placed as chosen."""
    mass = MASSES[rng.integers(len(MASSES))][:N]
    line = Line((), (), (), (), (), (), Fraction(RESTITUTIONS[rng.integers(len(RESTITUTIONS))]))
    last = Fraction(0)
    for k in range(N):
        contact = last + eighths(rng, 0, 9)
        placed = add_vehicle(rng, line, Fraction(mass[k]), contact)
        if placed is None:
            return
        line, last = placed, contact if k else last
    for more in (4, 2, 1, Fraction(1, 2), Fraction(1, 8), 0):
        outcome = run(line, last + more)
        if outcome is not None:
            yield Case(line, last + more, outcome)
            return


def add_vehicle(rng: np.random.Generator, line: Line, mass: Fraction, contact: Fraction) -> Line | None:
    """``line`` with one more vehicle that meets the last one at time ``contact``, or None where that cannot be."""
    speed, limit = eighths(rng, 0, 200), Fraction(int(rng.integers(10, 40)))
    latency = eighths(rng, 0, 8) if rng.random() < 0.6 else Fraction(0)
    command = Fraction(COMMANDS[rng.integers(len(COMMANDS))])
    own = (min(speed, limit), command, latency, mass, limit)
    if not line.speeds:
        return append(line, *own)
    if rng.random() < 0.15:  # a touch: as fast as the vehicle before it at the contact
        far = run(append(line, *own, gap=FAR), contact)
        speed = own[0] if far is None else own[0] + far.speeds[-2] - far.speeds[-1]
        own = (min(max(speed, Fraction(0)), limit), *own[1:])
    far = run(append(line, *own, gap=FAR), contact)
    if far is None or far.gaps[-1] >= FAR:
        return None
    placed = append(line, *own, gap=FAR - far.gaps[-1])
    met = run(placed, contact)
    early = run(placed, contact - Fraction(1, 1024)) if contact > 0 else met
    pair = len(placed.gaps) - 1
    if met is None or early is None or any(hit.pair == pair and hit.time < contact for hit in met.hits):
        return None
    return placed if met.gaps[-1] == 0 and (contact == 0 or early.gaps[-1] > 0) else None


def append(line: Line, speed: Fraction, command: Fraction, latency: Fraction, mass: Fraction, limit: Fraction,
           gap: Fraction | None = None) -> Line:  # fmt: skip
    """``line`` with one more vehicle behind."""
    return replace(
        line,
        gaps=line.gaps if gap is None else (*line.gaps, gap),
        speeds=(*line.speeds, speed),
        command=(*line.command, command),
        latency=(*line.latency, latency),
        mass=(*line.mass, mass),
        limit=(*line.limit, limit),
    )


def run(line: Line, until: Fraction) -> Outcome | None:
    """The exact outcome, or None unless every number on the way is a multiple of 1 / GRID."""
    try:
        outcome = simulate(line, until)
    except Irrational:
        return None
    return outcome if GRID % outcome.grid == 0 and len(outcome.hits) < 60 else None


def eighths(rng: np.random.Generator, low: int, high: int) -> Fraction:
    """A random multiple of 1/8, ``low``/8 up to ``high``/8."""
    return Fraction(int(rng.integers(low, high + 1)), 8)


def worlds_of(lines: Sequence[Line]) -> Worlds:
    """The lines as one batch; their numbers must be doubles."""
    rows = {
        name: [floats(getattr(line, name)) for line in lines] for name in ("gaps", "speeds", "latency", "mass", "limit")
    }
    return make_worlds(
        rows["gaps"],
        rows["speeds"],
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=rows["latency"],
        mass_t=rows["mass"],
        speed_limit_mps=rows["limit"],
        restitution=[float(line.restitution) for line in lines],
    )


def floats(row: Rationals) -> list[float]:
    """The same numbers as doubles; raises where one would be rounded."""
    for x in row:
        if Fraction(float(x)) != x:
            raise ValueError(f"{x} is not a double")
    return [float(x) for x in row]


def distinct_times(case: Case) -> bool:
    """Whether no two impacts of the case happen at one instant."""
    return all(a.time < b.time for a, b in pairwise(case.outcome.hits))
