"""The search for a way past the bound finds none, and finds one where a leak was planted; the programme goes on."""

from __future__ import annotations

import argparse

import pytest

from tests.shield import programme
from tests.shield.lines import ADVERSARIES, attack, line
from tests.shield.sabotage import LEAKS
from tests.shield.search import search


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


def test_programme__goes_on_where_it_stopped_and_shares_its_chunks(tmp_path, capsys) -> None:
    done = []

    def run(seed, *, first):
        done.append(first)
        if len(done) == 2 and first == 1:
            raise KeyboardInterrupt
        return {"worlds": 1, "decisions": 2, "above": 0, "excess": 0.0}

    chunks = [(f"cell-{k:03d}", {"first": k}) for k in range(4)]
    given = argparse.Namespace(results=tmp_path / "results", seed=1, part="1/1")
    with pytest.raises(KeyboardInterrupt):
        programme.run_chunks(chunks, run, given, "code")
    assert not programme.run_chunks(chunks, run, argparse.Namespace(**{**vars(given), "part": "2/2"}), "code")
    assert programme.run_chunks(chunks, run, given, "code")
    assert done == [0, 1, 1, 3, 2]
    assert "4 worlds, 8 decisions, 0 above the bound" in capsys.readouterr().out
    assert not programme.run_chunks(chunks, run, given, "other code")


def test_programme__its_million_worlds_are_all_different() -> None:
    chunks = [arguments for _, arguments in programme.bound_chunks(1_000_000)]
    assert sum(chunk["worlds"] for chunk in chunks) == 1_000_000
    assert len({chunk["first"] for chunk in chunks}) == len(chunks)
    assert {(chunk["N"], chunk["harm_count"]) for chunk in chunks} == {
        (3, "first"),
        (3, "total"),
        (5, "first"),
        (5, "total"),
    }
