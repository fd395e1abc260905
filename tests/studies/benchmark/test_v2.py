"""Suite v2 is frozen: every list is drawn again, and its worlds, tables and levels are those of its file."""

from __future__ import annotations

import pytest

from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.limits.limits import BestHarmTable, task_problem
from ethbrake_marl.scenario import Task
from ethbrake_marl.studies.benchmark import load_suite, suite_names

V2 = load_suite("v2")
SHA256 = "ab2cae246cc6f27760b83dd3ce2e14f2e3e2cef4040ac7b1793a0409abcd4f28"  # a change of the suite is v3


def test_v2__is_what_it_was_frozen_as():
    assert suite_names() == ["v2"] and V2.sha256 == SHA256
    assert len(V2.lists) == 13 and len(V2.seeds) == 13 and DEFAULT.LIST_SEED not in V2.seeds


@pytest.mark.parametrize("each", V2.lists, ids=lambda each: each.name)
def test_lists_of_v2__are_drawn_again_with_the_same_bits(each):
    sample = each.sample()  # compares the hash
    best, content = each.best_known(sample), each.content
    assert float(best.mean()) == pytest.approx(content.best_known_harm, rel=1e-12)
    full = evaluate(sample, make_lineup(["full_brake"], each.scenario), scenario=each.scenario, aftermath=False)
    harm = full.outcome("full_brake").world_harm(content.harm_count)
    assert float(harm.mean()) == pytest.approx(content.full_brake_harm, rel=1e-9)
    assert (best <= harm + 1e-6).all()
    table = BestHarmTable.load(each.folder / f"{each.name}.npz")
    assert list(table.best) == [content.harm_count]


def test_tables_of_v2__tell_harms_that_their_profiles_do():
    for name in ("paper-random", "cooperation-3-pair"):
        each = next(each for each in V2.lists if each.name == name)
        table = BestHarmTable.load(each.folder / f"{name}.npz")
        task = Task(each.scenario, each.scenario.learners, each.content.harm_count)
        first, total = task_problem(each.sample().worlds, task).follow(table.best[each.content.harm_count].profiles)
        driven = first if each.content.harm_count == "first" else total
        assert driven == pytest.approx(table.best[each.content.harm_count].harm, abs=1e-6)
