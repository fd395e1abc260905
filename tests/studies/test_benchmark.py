"""The benchmark: scores by hand, entries and the leaderboard of a small suite, and suite v2 with its frozen bits."""

import json
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.limits.limits import BestHarmTable, task_problem
from ethbrake_marl.scenario import Task
from ethbrake_marl.studies.benchmark import load_suite, read_entry, suite_names
from tests.studies.conftest import check_snapshot


def test_entry__tells_what_an_evaluation_gives(suites, entries):
    entry, suite = read_entry(entries / "coast.json"), load_suite("tiny", suites)
    assert entry.lists_driven == 3 and entry.overall == entry.mean_of_driven
    for each in suite.lists:
        sample, told, count = each.sample(), entry.lists[each.name], each.content.harm_count
        lineup = make_lineup(["full_brake", "coast"], each.scenario)
        result = evaluate(sample, lineup, scenario=each.scenario)
        full, coast = (result.outcome(name) for name in lineup)
        best = each.best_known(sample)
        share = 1.0 - (coast.world_harm(count) - best).mean() / (full.world_harm(count) - best).mean()
        found = [told.first_impact_harm, told.total_harm, told.collision_rate, told.realised_share]
        expected = [coast.first_impact_harm.mean(), coast.total_harm.mean(), coast.collided.mean(), share]
        assert [estimate.value for estimate in found] == pytest.approx(expected, rel=1e-12, abs=1e-12)
        assert told.knows == "own sensors" and told.policies == {} and told.below_best_known == 0
        assert told.worlds_sha256 == each.content.worlds_sha256
    assert entry.versions["python"] and entry.suite_sha256 == suite.sha256


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


@pytest.mark.parametrize("each", [each for each in V2.lists if each.name in ("paper-random", "cooperation-3-pair")])
def test_tables_of_v2__tell_harms_that_their_profiles_do(each):
    count = each.content.harm_count
    best = BestHarmTable.load(each.folder / f"{each.name}.npz").best[count]
    first, total = task_problem(each.sample().worlds, Task(each.scenario, each.scenario.learners, count)).follow(
        best.profiles
    )
    assert (first if count == "first" else total) == pytest.approx(best.harm, abs=1e-6)


def test_commands__write_and_print_entries_and_the_leaderboard(suites, entries, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("ethbrake_marl.studies.benchmark.SUITES", suites)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)

    def told(*words: str) -> tuple[str, str]:
        assert run_command(["benchmark", *words]) == 0
        captured = capsys.readouterr()
        return captured.out, captured.err

    printed, said = told("tiny", "--agent", "coast", "--output", "coast.json")
    assert "entry: coast.json" in said
    assert json.loads(told("tiny", "--agent", "coast", "--json")[0]) == json.loads(Path("coast.json").read_text())
    partly, _ = told("tiny", "--agent", "full_brake+episode")
    files = [str(entries / f"{name}.json") for name in ("full_brake+episode", "coast", "full_brake")]  # the worst first
    table, _ = told("table", *files, "--output", "table.md")
    text = "\n".join([printed, partly, table, Path("table.md").read_text()])
    own = load_suite("tiny", suites).sha256  # of zip archives, whose headers and packing are those of each Python
    assert text.count(own) == 1
    check_snapshot("benchmark.txt", text.replace(own, "(its own)"))
    found = json.loads(told("table", *files, "--json")[0])
    assert [entry["agent"] for entry in found["entries"]] == ["full_brake", "coast", "full_brake+episode"]
