"""A search over readings of the paper: which one comes nearest to all numbers of ``Table:Random`` together?

The eight independent numbers are collision rate and average harm of four strategies; the others follow from them. The
*difference* of a number is |ours / printed - 1|. The *distance* of a reading is the root mean square of the eight.
By the plain mean another reading is as near as the nearest, and which of both is nearer depends on the list of worlds.

The nearest reading is a hypothesis: among so many readings some come near by chance. To judge this, the search also
looks for tables that nobody has printed, each number of which comes from a reading drawn at random.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from ethbrake_marl.extensions.report.paper_rows import RANDOM_TEST
from ethbrake_marl.extensions.reproduction.made import Made, Settings
from ethbrake_marl.extensions.reproduction.random_test import DEPENDS, SHIPPED, Table, table_of
from ethbrake_marl.extensions.reproduction.readings import STATED, Reading
from ethbrake_marl.extensions.reproduction.verdicts import PERCENT
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.progress import OnProgress, Progress

WORLDS, WORLDS_AGAIN = 1_000, 10_000  # of the search, and of the nearest readings
KEPT, SHOWN = 30, 10  # nearest readings that are measured again, and that are shown
FAKES = 200  # tables that nobody has printed
SEARCH_S = 240.0  # processor time of a search

ONLY_BRAKES = (("driving_capacity_mps2", (6.0, 0.0, 6.0)),)  # keys of the scenario

Grid = Mapping[str, Sequence[Any]]  # field of a reading -> values
GRID: Grid = {
    "acts_s": (None, 0.3, 0.2),
    "rear_s": (None, 0.95, 1.3),
    "step_s": (None, 0.1, 0.2, 0.25, 0.5),
    "restitution": (None, 0.0, 0.3),
    "others": ((), ONLY_BRAKES),
    "counted": ("first", "total"),
    "after_impact": ("brakes on", "coasts", "ends"),
    "plans_as_stated": (False, True),
    "star": ("middle", "low end", "high end"),
    "baseline": ("realised", "predicted", "predicted harm, realised collisions"),
    "hybrid": (
        "realised",
        "predicted",
        "predicted harm, realised collisions",
        "realised, by the coupled H*",
        "policy alone",
    ),
}

PRINTED = np.array([(row.collision_rate, row.average_harm) for row in RANDOM_TEST])  # [4, 2], in the order of DEPENDS
NEAREST = STATED._replace(
    acts_s=0.2,
    step_s=0.2,
    plans_as_stated=True,
    star="low end",
    baseline="predicted harm, realised collisions",
    hybrid="policy alone",
)


def readings_of(grid: Grid) -> Iterator[Reading]:
    """Yield all readings in a grid, field -> values, except those with the coupled H* in the paper's map."""
    for values in product(*grid.values()):
        reading = STATED._replace(**dict(zip(grid, values, strict=True)))
        if reading.step_s is None or reading.hybrid != "realised, by the coupled H*":
            yield reading


def search(
    grid: Grid = GRID,
    episodes: int = WORLDS,
    policies: Mapping[str, str] = SHIPPED,
    tell: OnProgress = lambda progress: None,
) -> tuple[list[Reading], Floats]:
    """Return the R readings of a grid, and for each the 4 rows of Table III, [R, 4, 2]: collision rate and mean harm.

    Of readings with the same numbers only the first is returned. ``policies``: agent names of ``SAC`` and ``PPO``.
    """
    every, different = [*readings_of(grid)], dict[bytes, tuple[Reading, Floats]]()
    for number, reading in enumerate(every):
        if number % 1_000 == 0:
            tell(Progress("readings", number, len(every)))
        numbers = numbers_of(table_of(reading, episodes, policies))
        different.setdefault(numbers.tobytes(), (reading, numbers))
    readings, found = zip(*different.values(), strict=True)
    return [*readings], np.array(found)


def numbers_of(table: Table) -> Floats:
    return np.array([[each.value for each in row] for row in table.values()])


def differences(numbers: Floats, printed: Floats = PRINTED) -> Floats:
    """Return the relative differences |ours / printed - 1| of a table's numbers [..., 4, 2], as [..., 8]."""
    return np.abs(numbers / printed - 1.0).reshape(*numbers.shape[:-2], -1)


def distance(numbers: Floats, printed: Floats = PRINTED) -> Any:
    """Return the root mean square of the relative differences of a table's eight numbers, [...]."""
    return np.sqrt(np.square(differences(numbers, printed)).mean(axis=-1))


def by_chance(numbers: Floats) -> Floats:
    """Return the distance between each of some random tables and the reading nearest to it, [FAKES].

    Each number of a random table comes from a random reading. ``numbers`` [R, 4, 2]: tables of all readings.
    """
    drawn = np.random.default_rng(0).integers(len(numbers), size=(FAKES, *PRINTED.shape))
    fakes = np.take_along_axis(numbers, drawn, axis=0)
    return np.array([distance(numbers, fake).min() for fake in fakes])


def reproduce_search(settings: Settings) -> Made:
    if not settings.full:
        return Made(notes=["The search needs `--full`."])
    episodes, again = min(WORLDS, settings.episodes), min(WORLDS_AGAIN, settings.episodes)
    readings, numbers = search(GRID, episodes, settings.policies, settings.tell)
    distances = distance(numbers)
    kept = [readings[k] for k in np.argsort(distances, kind="stable")[:KEPT]]
    measured = {reading: numbers_of(table_of(reading, again, settings.policies)) for reading in (*kept, STATED)}
    nearest = sorted(kept, key=lambda reading: float(distance(measured[reading])))[:SHOWN]
    rows: list[tuple[Any, ...]] = [("printed", 0.0, 0.0, 0.0, *PRINTED.T.ravel().tolist())]
    for reading in (*nearest, STATED):
        own, off = measured[reading], differences(measured[reading])
        rows.append((reading.name, float(distance(own)), float(off.mean()), float(off.max()), *own.T.ravel().tolist()))
    fakes = by_chance(numbers)
    note = (
        "The nearest reading is a hypothesis: the paper does not say that its numbers were made like this, and among"
        f" {sum(1 for _ in readings_of(GRID)):,} readings ({len(readings):,} with different numbers) some come near by"
        f" chance. For {FAKES} tables that nobody"
        " has printed, whose numbers are each drawn from a reading at random, the nearest reading has a distance of"
        f" {100.0 * np.median(fakes):.1f} % in the median; for {100.0 * (fakes <= distances.min()).mean():.1f} % of"
        f" them it is as near as to the printed table. {settings.who_drives}"
    )
    part = replace(PERCENT, heading="Distance")
    columns: list[Column | str] = [
        *("Reading", part, replace(part, heading="Mean difference"), replace(part, heading="Largest")),
        *(replace(PERCENT, heading=f"Collisions, {row}") for row in DEPENDS),
        *(Column(f"Harm, {row}") for row in DEPENDS),
    ]
    sheets = [Sheet("The nearest readings", columns, rows, f"{again:,} worlds; harm in m²/s².")]
    same = "the same as" if nearest[0] == NEAREST else "another one than"
    return Made(sheets=sheets, notes=[f"The nearest reading is {same} that of the tables.", note])
