"""Worlds made backwards from chosen contact times: the kernel finds every bit that rational arithmetic finds."""

from __future__ import annotations

from collections import Counter
from fractions import Fraction

import numpy as np
import pytest

from ethbrake_marl.physics import ImpactRows, Worlds, advance
from tests.physics.exact_simulator import line_of
from tests.physics.manufacture import Case, floats, manufactured, pressed, stored, worlds_of

STEP = Fraction(1, 8)


@pytest.fixture(scope="module")
def manufactured_cases() -> list[Case]:
    return stored()


@pytest.fixture(scope="module")
def pressed_cases() -> list[Case]:
    return [case for N in (2, 3, 4, 5) for case in pressed(7, N, 60)]


def told(rows: ImpactRows) -> list[tuple[float, ...]]:
    """The impacts of one world as tuples in the order of ``Hit``."""
    columns = (rows.time_s, rows.pair, rows.closing_speed_mps, rows.first)
    return list(zip(*columns, rows.front_speed_change_mps, rows.rear_speed_change_mps, strict=True))


def differs(case: Case, end: Worlds, impacts: list[tuple[float, ...]]) -> str:
    """What is not exactly as in rational arithmetic, or an empty string."""
    exact = case.outcome
    if impacts != [tuple(hit) for hit in exact.hits]:
        return f"{case.line}: impacts {impacts}, exactly {exact.hits}"
    if end.gaps_m[0].tolist() != floats(exact.gaps) or end.speeds_mps[0].tolist() != floats(exact.speeds):
        return f"{case.line}: ends at {end.gaps_m[0]}, {end.speeds_mps[0]}, exactly {exact.gaps}, {exact.speeds}"
    return ""


def at_once(case: Case) -> str:
    end, impacts = advance(worlds_of([case.line]), floats(case.line.command), float(case.until), record=True)
    return differs(case, end, told(impacts.rows))


def in_steps(case: Case) -> str:
    world, time, impacts = worlds_of([case.line]), Fraction(0), []
    while time < case.until:
        time = min(time + STEP, case.until)
        world, found = advance(world, floats(case.line.command), until_s=float(time), record=True)
        impacts += told(found.rows)
    return differs(case, world, impacts)


def test_manufactured__hundreds_of_worlds_with_every_kind_of_event(manufactured_cases, pressed_cases):
    sizes = Counter(len(case.line.speeds) for case in manufactured_cases)
    assert len(manufactured_cases) >= 500 and set(sizes) == {2, 3, 4, 5}
    kinds = sum((case.outcome.kinds for case in (*manufactured_cases, *pressed_cases)), Counter())
    scarce = {kind: n for kind, n in kinds.items() if n < 20}
    assert not scarce and len(kinds) == 9, kinds


def test_manufactured__the_kernel_finds_every_bit(manufactured_cases):
    assert [wrong for case in manufactured_cases if (wrong := at_once(case))] == []


def test_manufactured__also_in_steps_of_an_eighth_of_a_second(manufactured_cases):
    assert [wrong for case in manufactured_cases[::3] if (wrong := in_steps(case))] == []


def test_manufactured__momentum_is_conserved_to_the_last_bit(manufactured_cases):
    pairs = [case for case in manufactured_cases if len(case.line.speeds) == 2]
    exchanged = 0
    for case in pairs:
        _, impacts = advance(worlds_of([case.line]), floats(case.line.command), float(case.until), record=True)
        front, rear = (Fraction(m) for m in case.line.mass)
        for *_, front_change, rear_change in told(impacts.rows):
            assert front * Fraction(front_change) + rear * Fraction(rear_change) == 0
            exchanged += 1
    assert exchanged > 200


def test_pressed__resting_contact_holding_and_release_to_the_last_bit(pressed_cases):
    assert [wrong for case in pressed_cases if (wrong := at_once(case) or in_steps(case))] == []


def test_manufacture__fresh_worlds_agree_too():
    cases = manufactured(2, 2, 40) + manufactured(2, 3, 5)
    assert [wrong for case in cases if (wrong := at_once(case))] == []


def test_line_of__is_the_inverse_of_worlds_of(manufactured_cases):
    case = manufactured_cases[-1]
    assert line_of(worlds_of([case.line]), floats(case.line.command), 0) == case.line


def test_oracle__by_hand():
    # 10 m at 10 m/s: meets after 1 s; masses 2 and 3, e = 1/2: +9 and -6; one more second opens 5 m
    from tests.physics.exact_simulator import Hit, Line, simulate

    half, whole = Fraction(1, 2), (Fraction(0), Fraction(0))
    line = Line(
        (Fraction(10),),
        (Fraction(0), Fraction(10)),
        whole,
        whole,
        (Fraction(2), Fraction(3)),
        (Fraction(99),) * 2,
        half,
    )
    outcome = simulate(line, Fraction(2))
    assert outcome.hits == [Hit(Fraction(1), 0, Fraction(10), True, Fraction(9), Fraction(-6))]
    assert outcome.gaps == (5,) and outcome.speeds == (9, 4)
    assert np.isclose(float(simulate(line, Fraction(2), bits=80).speeds[0]), 9.0)
