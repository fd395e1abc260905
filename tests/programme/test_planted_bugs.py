"""Every planted bug fits the code as it is: a list of bugs that has gone stale would say nothing any more."""

from __future__ import annotations

import pytest

from tests.physics.programme import planted_bugs as of_physics
from tests.programme import planted_bugs as of_the_rest
from tests.programme.suites import ROOT
from tests.shield import planted_bugs as of_the_shield


@pytest.mark.parametrize("programme", [of_physics, of_the_shield], ids=["physics", "shield"])
def test_planted_bugs__fit_the_code(programme) -> None:
    assert len(programme.BUGS) >= 19
    assert of_physics.misfits(ROOT, programme.BUGS) == []


def test_planted_bugs__of_the_rest_fit_the_code() -> None:
    assert len(of_the_rest.BUGS) >= 44
    assert of_physics.misfits(ROOT, of_the_rest.patches(of_the_rest.BUGS)) == []
