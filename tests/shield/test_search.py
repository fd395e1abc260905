"""The search for a way past the bound finds none, and finds one where a leak was planted."""

from __future__ import annotations

import pytest

from tests.shield.attacks import ADVERSARIES, LEAKS, attack, line, search


def test_search__finds_no_way_past_the_shield_but_many_without_it() -> None:
    found = search(60, 5)
    assert (found.above, found.excess) == (0, 0.0)
    assert found.loose > 0.5


EASY = [name for name in LEAKS if "further off" not in name]  # that one takes longer lines


@pytest.mark.parametrize("name", [*EASY[:3], *(pytest.param(name, marks=pytest.mark.slow) for name in EASY[3:])])
def test_search__finds_each_leak(name: str) -> None:
    found = search(100, 5, LEAKS[name], until_found=True)
    assert found.first is not None and found.excess > 1e-6


def test_trained_adversary__does_more_harm_under_the_shield_than_chance_does() -> None:
    worlds = line(3).sample(80, 21).worlds
    harm = {name: attack(line(3), worlds, ADVERSARIES[name]).realised.mean() for name in ("trained", "random_actions")}
    assert harm["trained"] > harm["random_actions"]
