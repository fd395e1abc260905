"""The benchmark: scores by hand, entries and the leaderboard of a small suite, and suite v2 with its frozen bits."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.limits.limits import BestHarmTable, task_problem
from ethbrake_marl.policies import content_sha256, load_policy, shipped_policies
from ethbrake_marl.scenario import Task
from ethbrake_marl.studies.benchmark import (
    NotDriven,
    Suite,
    load_suite,
    mean_of_lists,
    plain_sha256,
    read_entry,
    read_leaderboard,
    realised_share,
    suite_names,
    worst_mean,
)
from tests.docs.site import load
from tests.studies.conftest import check_snapshot


def test_realised_share__is_0_for_full_braking_and_1_for_the_best_known():
    full, best = np.array([4.0, 10.0, 0.0, 6.0]), np.array([1.0, 4.0, 0.0, 5.0])
    found = [realised_share(harm, full, best).value for harm in (full, best, full - 1.0, full + 1.0)]
    assert found == pytest.approx([0.0, 1.0, 0.4, -0.4])  # 4 of the 10 that are possible
    assert realised_share(best, full, best).interval == (1.0, 1.0)


def test_worst_mean__is_that_of_the_worst_tenth_and_covers_the_true_one_in_95_of_100_lists():
    regret = np.arange(100.0)
    assert worst_mean(np.random.default_rng(0).permutation(regret)).value == pytest.approx(regret[90:].mean())
    truth = 1.0 + np.log(10.0)  # of the worst tenth of an exponential distribution
    intervals = [worst_mean(np.random.default_rng(k).exponential(size=400)).interval for k in range(300)]
    assert 0.89 <= np.mean([low <= truth <= high for low, high in intervals]) <= 0.99


def test_mean_of_lists__half_widths_add_as_squares():
    found = mean_of_lists([Estimate(0.2, (0.1, 0.3)), Estimate(0.8, (0.8, 0.8))])
    assert found == Estimate(0.5, pytest.approx((0.45, 0.55)))
    assert mean_of_lists([Estimate(0.2, None)]) == Estimate(0.2, None)


def test_entry__tells_what_an_evaluation_gives(suite, entries):
    entry = read_entry(entries / "coast.json")
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


def test_full_braking__realises_nothing_and_every_list_tells_its_worlds(suite, entries):
    entry = read_entry(entries / "full_brake.json")
    assert [each.realised_share.value for each in entry.driven.values()] == [0.0, 0.0, 0.0]
    assert [each.worlds_sha256 for each in entry.driven.values()] == [e.content.worlds_sha256 for e in suite.lists]
    assert entry.versions["python"] and entry.suite_sha256 == suite.sha256


def test_lists_that_an_agent_cannot_drive__have_no_score_and_so_has_the_whole(entries):
    entry = read_entry(entries / "full_brake+episode.json")
    undriven = entry.lists["cooperation-3-pair"]
    assert isinstance(undriven, NotDriven) and undriven.not_driven and (entry.lists_driven, entry.overall) == (2, None)
    shares = [each.realised_share.value for each in entry.driven.values()]
    assert entry.mean_of_driven.value == pytest.approx(np.mean(shares))


def test_entries__are_ranked_by_their_score_and_those_of_some_lists_stand_below(suite, entries):
    found = read_leaderboard(paths(entries), suite)
    *ranked, last = [entry for _, entry in found.entries]
    assert last.agent == "full_brake+episode" and last.overall is None and len(ranked) == 2
    shares = [entry.overall.value for entry in ranked]
    assert shares == sorted(shares, reverse=True)
    assert read_leaderboard(paths(entries)[::-1], suite) == found


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


NAMES = ("full_brake", "coast", "full_brake+episode")


def paths(folder: Path) -> list[Path]:
    return [folder / f"{name}.json" for name in NAMES]


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
    table, _ = told("table", *map(str, paths(entries)), "--output", "table.md")
    text = "\n".join([printed, partly, table, Path("table.md").read_text()])
    own = load_suite("tiny", suites).sha256  # of zip archives, whose headers and packing are those of each Python
    assert text.count(own) == 1
    check_snapshot("benchmark.txt", text.replace(own, "(its own)"))
    found = json.loads(told("table", *map(str, paths(entries)), "--json")[0])
    assert {entry["agent"] for entry in found["entries"]} == set(NAMES)


@pytest.mark.parametrize("purpose", ["training", "evaluation"])
def test_policies_made_with_a_seed_of_the_suite__are_refused(suite: Suite, tmp_path: Path, purpose: str) -> None:
    bundle = tmp_path / "bundle"
    shutil.copytree(shipped_policies()["ppo"] / "policy", bundle)
    manifest = load_policy(bundle).manifest.model_copy(update={"seeds": {"training": 3, purpose: 902}})
    content = manifest.model_dump(mode="json")
    (bundle / "manifest.json").write_text(json.dumps({**content, "manifest_sha256": content_sha256(content)}))
    for around in ("", "+episode"):
        told = f"its policy of vehicle_2 was made with {purpose} seed 902, which is suite tiny's own"
        with pytest.raises(InvalidInput, match=told):
            suite.make_entry(f"ppo@{bundle}{around}")


def test_suite__is_refused_by_what_is_damaged(suites: Path, tmp_path: Path, suite: Suite, monkeypatch) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(suites, folder)
    file = folder / "tiny" / "suite.json"
    content, wrong = (json.loads(file.read_text()) for _ in range(2))
    wrong["lists"][0]["scenario"]["vehicles"] = "three"
    for text, told in (
        (json.dumps(content | {"lists": [content["lists"][0]] * 2}), "list paper-random stands in it twice"),
        (json.dumps(wrong), r"suite.json, list paper-random: .*vehicles"),
        ("{", r"suite.json: is no JSON"),
    ):
        file.write_text(text)
        with pytest.raises(InvalidInput, match=told):
            load_suite("tiny", folder)
    file.write_text(json.dumps(content | {"lists": content["lists"][:2]}))
    assert load_suite("tiny", folder).sha256 != suite.sha256
    (folder / "tiny/paper-random.npz").write_bytes((folder / "tiny/cooperation-3-pair.npz").read_bytes())
    with pytest.raises(InvalidInput, match="is not the table that belongs to the suite"):
        load_suite("tiny", folder).make_entry("coast")
    with pytest.raises(AlreadyExists, match="is frozen"):
        load("../studies/freeze_suite").freeze_suite("tiny", [], suites)
    each = suite.lists[0]
    sample = each.sample()
    sample.worlds.gaps_m[5, 1] = np.nextafter(sample.worlds.gaps_m[5, 1], 99.0)  # one bit
    monkeypatch.setattr(type(each.scenario), "sample", lambda *a, **k: sample)
    with pytest.raises(InvalidInput, match="list paper-random: the worlds drawn here have SHA-256"):
        suite.make_entry("coast")


def edited(edit: Callable[[dict[str, Any]], object], *, bind: bool = True) -> Callable[[str], str]:
    """An entry as somebody would write it who knows how its hash is made."""

    def change(text: str) -> str:
        content = json.loads(text)
        edit(content)
        if bind:
            content["entry_sha256"] = plain_sha256({k: v for k, v in content.items() if k != "entry_sha256"})
        return json.dumps(content)

    return change


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (edited(lambda entry: entry["lists"].pop("cooperation-3-pair")), "is about another suite: tiny with SHA-256 "),
        (edited(lambda entry: entry.update(suite_sha256="0" * 64)), "another suite: tiny with SHA-256 000000000000"),
        (
            edited(lambda entry: entry["lists"].update(easy=entry["lists"]["paper-random"])),
            "is about another suite: tiny with SHA-256 ",
        ),
        (edited(lambda entry: entry.pop("versions")), "versions: is missing"),
        (edited(lambda entry: entry.update(score=1)), "score: unknown key"),
        (edited(lambda entry: entry.update(lists_driven=True)), "lists_driven: must be"),
        (edited(lambda entry: entry["overall"].update(value="1")), "overall.value: must be a number"),
        (edited(lambda entry: entry["overall"].update(mean=1.0)), "overall.mean: "),
        (edited(lambda entry: entry.update(agent="mine"), bind=False), "was changed after it was made"),
        (lambda text: "[]", ""),
        (lambda text: "{", "is no JSON"),
    ],
)
def test_leaderboard__refuses_an_entry_that_was_edited_by_its_name(suite, entries, tmp_path, change, told) -> None:
    shutil.copytree(entries, tmp_path / "kept")
    file = tmp_path / "kept" / "coast.json"
    file.write_text(change(file.read_text()))
    with pytest.raises(InvalidInput, match=rf"coast\.json.*{re.escape(told)}"):
        read_leaderboard(paths(tmp_path / "kept"), suite)


def test_leaderboard__needs_entries_of_a_suite_that_is_there(suite: Suite, entries: Path) -> None:
    with pytest.raises(InvalidInput, match="no entries given"):
        read_leaderboard([], suite)
    with pytest.raises(UnknownName, match="suite 'tiny'"):
        read_leaderboard([entries / "full_brake.json"])
