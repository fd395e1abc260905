"""Worlds built backwards from chosen contact times, in dyadic rationals.

Vehicles are added one behind the other. Each new one gets its own motion (latency, command, speed limit) and a contact
time on a grid of 1/8 s; its initial gap is then the way by which it gains on the vehicle before it until then. Every
number of such a world is a multiple of a power of two with few digits: a double holds it exactly, and a correct kernel
must find the same bits as rational arithmetic.

Lines of many vehicles are rare finds (a chain of impacts soon leaves the grid), so those of the tests are kept
in ``tests/golden/manufactured_worlds.json``; ``python -m tests.first_edition.physics.manufacture`` writes it anew.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from ethbrake_marl.first_edition.physics.state import Worlds, make_worlds
from tests.reference.exact_simulator import Line, Outcome, Rationals, Unexact, simulate

GRID = 1 << 14  # every state on the way is a multiple of 1 / GRID: squares and products then fit in 53 bits
FAR = Fraction(1 << 20)
CAPACITY_MPS2 = 16.0
GOLDEN = Path(__file__).parents[2] / "golden" / "manufactured_worlds.json"
COUNTS = {2: 300, 3: 200, 4: 150, 5: 100}
MASSES = (  # touching neighbours weigh a power of two together, so that common speeds are dyadic
    (1, 1, 2, 4, 8), (2, 2, 4, 8, 16), (1, 3, 1, 3, 1), (3, 1, 3, 1, 3), (3, 5, 3, 5, 3), (7, 1, 7, 1, 7),
    (1, 7, 1, 7, 1), (1, 1, 1, 1, 1), (8, 4, 2, 1, 1), (2, 6, 2, 6, 2), (1, 15, 1, 15, 1), (6, 2, 6, 2, 6),
)  # fmt: skip
RESTITUTIONS = (0, 0, Fraction(1, 4), Fraction(1, 2), Fraction(3, 4), 1)
COMMANDS = (-8, -4, -2, -2, -1, Fraction(-1, 2), 0, 0, 0, 0, 0, 0, Fraction(1, 2), 1, 2, 4)


@dataclass(frozen=True)
class Case:
    """A manufactured world, how long it runs, and what exactly happens."""

    line: Line
    until: Fraction
    outcome: Outcome


def manufactured(seed: int, N: int, count: int) -> list[Case]:
    """``count`` worlds of ``N`` vehicles, each with contacts at chosen times."""
    return collect(attempt, seed, N, count)


def pressed(seed: int, N: int, count: int) -> list[Case]:
    """``count`` worlds of ``N`` vehicles that touch at the start: resting contact, holding brakes, release."""
    return collect(press, seed, N, count)


def collect(build: Callable[[np.random.Generator, int], Iterator[Case]], seed: int, N: int, count: int) -> list[Case]:
    rng = np.random.default_rng([seed, N])
    cases: list[Case] = []
    while len(cases) < count:
        cases += build(rng, N)
    return cases


def press(rng: np.random.Generator, N: int) -> Iterator[Case]:
    """A line that starts at one speed, often 0, with most gaps closed."""
    start = Fraction(int(rng.choice([0, 0, 0, 2, 4, 12])))
    mass = MASSES[rng.integers(len(MASSES))][:N]
    line = Line((), (), (), (), (), (), Fraction(RESTITUTIONS[rng.integers(len(RESTITUTIONS))]))
    for k in range(N):
        own = {
            "command": Fraction(COMMANDS[rng.integers(len(COMMANDS))]),
            "latency": eighths(rng, 0, 8) if rng.random() < 0.5 else Fraction(0),
            "limit": Fraction(int(rng.choice([16, 16, 20]))),
        }
        gap = eighths(rng, 0, 8) if rng.random() < 0.2 else Fraction(0)
        line = append(line, gap, speeds=start, mass=Fraction(mass[k]), **own)
    outcome = run(line, Fraction(4))
    kinds = ("held", "standstill", "released", "limit", "impact")
    if outcome is not None and outcome.kinds["joined"] and any(outcome.kinds[kind] for kind in kinds):
        yield Case(line, Fraction(4), outcome)


def attempt(rng: np.random.Generator, N: int) -> Iterator[Case]:
    """Build one world; nothing when a vehicle cannot be placed as chosen."""
    mass = MASSES[rng.integers(len(MASSES))][:N]
    line = Line((), (), (), (), (), (), Fraction(RESTITUTIONS[rng.integers(len(RESTITUTIONS))]))
    last = Fraction(0)
    for k in range(N):
        contact = last + Fraction(int(rng.choice([0, 1, 1, 2, 2, 3, 4, 6])), 8)
        tries = (add_vehicle(rng, line, Fraction(mass[k]), contact) for _ in range(12))
        placed = next((found for found in tries if found is not None), None)
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
    own = {
        "speeds": min(speed, limit),
        "limit": limit,
        "latency": eighths(rng, 0, 8) if rng.random() < 0.6 else Fraction(0),
        "command": Fraction(COMMANDS[rng.integers(len(COMMANDS))]),
        "mass": mass,
    }
    if not line.speeds:
        return append(line, FAR, **own)
    if rng.random() < 0.07:  # a touch: as fast as the vehicle before it at the contact, and slowing down
        own |= {"command": Fraction(-8), "latency": Fraction(0)}
        far = run(append(line, FAR, **own), contact)
        if far is not None:
            own["speeds"] = min(max(own["speeds"] + far.speeds[-2] - far.speeds[-1], Fraction(0)), limit)
    far = run(append(line, FAR, **own), contact)
    if far is None or far.gaps[-1] >= FAR:
        return None
    placed = append(line, FAR - far.gaps[-1], **own)
    met = run(placed, contact)
    early = run(placed, contact - Fraction(1, 64)) if contact > 0 else met
    pair = len(placed.gaps) - 1
    if met is None or early is None or any(hit.pair == pair and hit.time < contact for hit in met.hits):
        return None
    return placed if met.gaps[-1] == 0 and (contact == 0 or early.gaps[-1] > 0) else None


def append(line: Line, gap: Fraction, **own: Fraction) -> Line:
    """``line`` with one more vehicle behind, by a gap where it is not the first."""
    columns = {name: (*getattr(line, name), value) for name, value in own.items()}
    return replace(line, gaps=(*line.gaps, gap) if line.speeds else (), **columns)


def run(line: Line, until: Fraction) -> Outcome | None:
    """The exact outcome, or None unless every number on the way is a multiple of 1 / GRID."""
    try:
        outcome = simulate(line, until, grid=GRID)
    except Unexact:
        return None
    return outcome if len(outcome.hits) < 60 else None


def eighths(rng: np.random.Generator, low: int, high: int) -> Fraction:
    """A random multiple of 1/8, ``low``/8 up to ``high``/8."""
    return Fraction(int(rng.integers(low, high + 1)), 8)


def worlds_of(lines: Sequence[Line]) -> Worlds:
    """The lines as one batch; their numbers must be doubles."""
    names = ("gaps", "speeds", "latency", "mass", "limit")
    gaps, speeds, latency, mass, limit = ([floats(getattr(line, name)) for line in lines] for name in names)
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=CAPACITY_MPS2,
        driving_capacity_mps2=CAPACITY_MPS2,
        latency_s=latency,
        mass_t=mass,
        speed_limit_mps=limit,
        restitution=[float(line.restitution) for line in lines],
    )


def floats(row: Rationals) -> list[float]:
    """The same numbers as doubles; raises where one would be rounded."""
    for x in row:
        if Fraction(float(x)) != x:
            raise ValueError(f"{x} is not a double")
    return [float(x) for x in row]


def stored() -> list[Case]:
    """The manufactured worlds of the golden file, with their exact outcomes computed anew."""
    cases = []
    for *rows, restitution, until in json.loads(GOLDEN.read_text("utf-8"))["worlds"]:
        line = Line(*(tuple(map(Fraction, row)) for row in rows), Fraction(restitution))
        cases.append(Case(line, Fraction(until), simulate(line, Fraction(until), grid=GRID)))
    return cases


def write_golden() -> None:
    """Manufacture the worlds of the golden file."""
    rows = []
    for N, count in COUNTS.items():
        for case in manufactured(20, N, count)[:count]:
            line = case.line
            numbers = (line.gaps, line.speeds, line.command, line.latency, line.mass, line.limit)
            rows.append(json.dumps([*map(floats, numbers), float(line.restitution), float(case.until)]))
    columns = "gaps_m, speeds_mps, command_mps2, latency_s, mass_t, speed_limit_mps, restitution, until_s"
    worlds = ",\n".join(rows)
    GOLDEN.write_text(f'{{"columns": "{columns}", "worlds": [\n{worlds}\n]}}\n', "utf-8")


if __name__ == "__main__":
    write_golden()
