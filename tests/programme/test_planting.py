"""The lists of planted bugs fit the code as it is, so that `make planted-bugs` and `make shield-bugs` can run."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import pytest

from tests.physics.programme import planted_bugs as of_physics
from tests.programme import planted_bugs as elsewhere
from tests.programme.copies import KERNELS, mutated
from tests.programme.planting import Patch, misfits, plant
from tests.programme.suites import ROOT
from tests.shield import planted_bugs as of_shield

PATCHES = {**of_physics.BUGS, **of_shield.BUGS, **elsewhere.patches(elsewhere.BUGS)}
TRIED = (*of_physics.QUICK, *of_physics.WHOLE, *of_shield.QUICK, *of_shield.WHOLE)


def test_bugs__each_patch_stands_in_the_code_exactly_once() -> None:
    assert misfits(PATCHES) == []
    assert len(PATCHES) == len(of_physics.BUGS) + len(of_shield.BUGS) + len(elsewhere.BUGS)


def test_bugs__the_tests_that_are_tried_are_there() -> None:
    tests = chain(TRIED, *(bug.tests for bug in elsewhere.BUGS.values()))
    assert {test for test in tests if not (ROOT / test.partition("::")[0]).exists()} == set()


def test_misfit__is_named_with_its_file_and_count(tmp_path: Path) -> None:
    twice, gone = Patch("ethbrake_marl/harm.py", "def ", "async def "), Patch("ethbrake_marl/gone.py", "a", "b")
    assert [line.split(":")[0] for line in misfits({"twice": (twice,), "gone": (gone,)})] == ["twice", "gone"]
    assert "gone.py holds 'a' 0 times" in misfits({"gone": (gone,)})[0]
    (tmp_path / "a.py").write_text("one\none\n")
    with pytest.raises(ValueError, match="stands there 2 times, not once"):
        plant(tmp_path, (Patch("a.py", "one", "two"),))
    plant(tmp_path, (Patch("a.py", "one\none", "two"),))
    assert (tmp_path / "a.py").read_text() == "two\n"


def test_mutated__leaves_the_source_and_the_kernels_that_were_there_before(tmp_path: Path) -> None:
    source, kernels = tmp_path / "ethbrake_marl" / "harm.py", tmp_path / KERNELS / "ethbrake_marl"
    for folder in (source.parent, kernels):
        folder.mkdir(parents=True)
    (kernels / "before.entry").touch()
    with mutated(tmp_path, "ethbrake_marl/harm.py", "a bug"):
        assert source.read_text() == "a bug"
        (kernels / "of_the_bug.entry").touch()
    assert source.read_text("utf-8") == (ROOT / "ethbrake_marl" / "harm.py").read_text("utf-8")
    assert [each.name for each in kernels.iterdir()] == ["before.entry"]
