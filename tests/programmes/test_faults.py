"""The faults fit the code as it is, and the tests that may notice one are found."""

from __future__ import annotations

import ast

from tests.programmes import faults
from tests.programmes.calls import PACKAGE, Callers, functions_of


def test_bugs__each_patch_stands_in_the_code_exactly_once() -> None:
    bugs, misfits = faults.planted()
    assert misfits == []
    assert {bug.folder for bug in bugs} >= {"physics", "shield", "limits", "learning", "evaluation", "ethbrake_marl"}


def test_mutants__are_code_of_as_many_lines_and_the_same_for_the_same_seed() -> None:
    mutants = faults.sample_of("limits", 40, 3)
    assert len(mutants) == 40
    assert [m.digest for m in faults.sample_of("limits", 5, 3)] == [m.digest for m in mutants[:5]]
    for mutant in mutants:
        ((file, text),) = mutant.texts
        original = (PACKAGE / file).read_text("utf-8")
        ast.parse(text)
        assert text != original
        assert text.count("\n") == original.count("\n")


def test_tests_of_a_function__are_those_that_call_it_or_who_mentions_it() -> None:
    recorded = {
        "tests/test_a.py::test_one": (0.1, ["physics/batch.py:advance"]),
        "tests/test_b.py::test_two": (0.2, ["physics/worlds.py:sum_rows"]),
        "tests/physics/test_c.py::test_three": (9.0, ["physics/worlds.py:sum_rows"]),
        "tests/test_d.py::test_shoving": (9.0, ["physics/worlds.py:sum_rows"]),
    }
    tests = Callers(recorded)
    kernel = next(f for f in functions_of(PACKAGE / "physics/batch.py") if f.key.endswith(":advance_worlds"))
    assert kernel.compiled
    assert tests.of(kernel) == {"tests/test_a.py::test_one"}  # advance calls _advance_part, which mentions the kernel
    file = PACKAGE / "physics/worlds.py"
    line = file.read_text("utf-8").splitlines().index("def sum_rows(values: Floats) -> Floats:") + 1
    summed = tests.at(file, line + 2)
    assert summed.key == "physics/worlds.py:sum_rows"
    three, two, shoving = (
        "tests/physics/test_c.py::test_three",
        "tests/test_b.py::test_two",
        "tests/test_d.py::test_shoving",
    )
    assert tests.ordered(summed, (), "", 10.0, 9) == [three, two]
    assert tests.ordered(summed, (), "", 5.0, 9) == [two]
    assert tests.ordered(summed, (), "shoving counted twice", 10.0, 9) == [shoving, two]
