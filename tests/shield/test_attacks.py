"""Samples of the long programme: the search finds no way past the bound, but each leak, and nothing interferes."""

from __future__ import annotations

import pytest

from tests.shield.interference import PLAYS, WRAPPERS, disturbed, wrapped
from tests.shield.lines import ADVERSARIES, LEAKS, attack, line, search


def test_search__finds_no_way_past_the_shield_but_many_without_it() -> None:
    found = search(60, 5)
    assert (found.above, found.excess) == (0, 0.0)
    assert found.loose > 0.5


@pytest.mark.parametrize("name", [name for name in LEAKS if "further off" not in name])  # that one takes longer lines
def test_search__finds_each_leak(name: str) -> None:
    found = search(100, 5, LEAKS[name], until_found=True)
    assert found.first is not None and found.excess > 1e-6


def test_trained_adversary__does_more_harm_under_the_shield_than_chance_does() -> None:
    worlds = line(3).sample(80, 21).worlds
    harm = {name: attack(line(3), worlds, ADVERSARIES[name]).realised.mean() for name in ("trained", "random_actions")}
    assert harm["trained"] > harm["random_actions"]


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
    found = wrapped(name, wrapper, 8 if wrapper == "frame skip 80" else 60, seed=5)
    assert found.episodes > 0 and (found.above, found.broken) == (0, 0)
