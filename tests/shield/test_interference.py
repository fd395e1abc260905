"""A sample of the gate "interference": nothing that fails, and nothing in between, gets above the bound."""

from __future__ import annotations

import pytest

from tests.shield.interference import PLAYS, WRAPPERS, disturbed, wrapped

BATCHED = ("vector", "vector, next step", "sb3", "team, sb3")
INSIDE = [name for name in PLAYS if "evaluation" not in name]  # the engine itself asks that one: nothing is in between


@pytest.mark.parametrize("name", PLAYS)
def test_disturbed__calls_that_fail_or_are_interrupted_change_nothing_and_no_episode_gets_above_its_bound(name):
    found = disturbed(name, 8 if name in BATCHED or "evaluation" in name else 5, seed=3)
    assert found.refused > 5 and found.interrupted > 3
    assert (found.above, found.broken) == (0, 0)


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("name", INSIDE)
def test_wrapped__whatever_reaches_the_engine_is_shielded_and_no_episode_gets_above_its_bound(name, wrapper):
    found = wrapped(name, wrapper, 120, seed=5)
    assert found.episodes > 0 and (found.above, found.broken) == (0, 0)
