"""Worlds whose every number on the way is a multiple of 1/16384: a correct kernel finds the bits of exact arithmetic.

They were built backwards from chosen contact times, and from lines that touch at the start.
"""

from __future__ import annotations

import json
from collections import Counter
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.layout import Floats
from tests.motion.lines import driven, lines
from tests.reference.exact_simulator import Line, Outcome, simulate

GRID = 1 << 14
WORLDS = json.loads(Path(__file__).with_name("manufactured_worlds.json").read_text("utf-8"))["worlds"]


class Case(NamedTuple):
    """A world and what exactly happens in it."""

    numbers: tuple[list[float], ...]  # gaps, speeds, commands, latencies, masses, limits
    restitution: float
    until: float
    outcome: Outcome


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    made = []
    for *rows, restitution, until in WORLDS:
        line = Line(*(tuple(map(Fraction, row)) for row in rows), Fraction(restitution))
        made.append(Case(tuple(rows), restitution, until, simulate(line, Fraction(until), grid=GRID)))
    return made


def played(case: Case, steps: int) -> Floats:
    """Return the line at the end of intervals of equal length."""
    gaps, speeds, commands, latency, mass, limit = case.numbers
    line, car = lines(gaps, speeds, latency_s=latency, mass_t=mass, speed_limit_mps=limit, restitution=case.restitution)
    for k in range(steps):
        line, _, _ = driven(line, car, commands, case.until * k / steps, case.until * (k + 1) / steps)
    return line[0]


def expected(outcome: Outcome) -> list[list[float]]:
    """Return gaps, speeds, harm by both counts and numbers of impacts."""
    harm = np.zeros((3, len(outcome.gaps)))
    for hit in outcome.hits:
        squared = float(hit.closing * hit.closing)
        harm[:, hit.pair] += squared if hit.first else 0.0, squared, 1.0
    return [[float(gap) for gap in outcome.gaps], [float(speed) for speed in outcome.speeds], *harm.tolist()]


def found(line: Floats) -> list[list[float]]:
    pairs = (line[row, 1:-1].tolist() for row in (at.FIRST, at.TOTAL, at.COUNT))
    return [line[at.GAP, 1:-1].tolist(), line[at.SPEED, 1:].tolist(), *pairs]


def test_worlds__have_every_kind_of_event(cases: list[Case]) -> None:
    kinds = sum((case.outcome.kinds for case in cases), Counter[str]())
    assert len(kinds) == 9 and min(kinds.values()) >= 20, kinds


@pytest.mark.parametrize("steps", [1, 2, 8])
def test_motion__has_every_bit_of_exact_arithmetic(cases: list[Case], steps: int) -> None:
    assert [case.numbers for case in cases if found(played(case, steps)) != expected(case.outcome)] == []
