"""An entry tells what ``evaluate`` gives on each list; what cannot be driven has no score."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.policies import content_sha256, load_policy, shipped_policies
from ethbrake_marl.studies.benchmark import NotDriven, load_suite, mean_of_lists, read_entry, realised_share, worst_mean
from tests.docs.site import load


def test_realised_share__is_0_for_full_braking_and_1_for_the_best_known():
    full, best = np.array([4.0, 10.0, 0.0, 6.0]), np.array([1.0, 4.0, 0.0, 5.0])
    assert realised_share(full, full, best).value == 0.0
    assert realised_share(best, full, best) == Estimate(1.0, (1.0, 1.0))
    assert realised_share(full - 1.0, full, best).value == pytest.approx(0.4)  # 4 of the 10 that are possible
    assert realised_share(full + 1.0, full, best).value == pytest.approx(-0.4)
    with pytest.raises(InvalidInput, match="nothing to realise"):
        realised_share(full, full, full)


def test_worst_mean__is_that_of_the_worst_tenth():
    regret = np.arange(100.0)
    found = worst_mean(np.random.default_rng(0).permutation(regret))
    assert found.value == pytest.approx(regret[90:].mean())
    low, high = found.interval
    assert low < found.value < high


def test_worst_mean__covers_the_true_one_in_95_of_100_lists():
    truth = 1.0 + np.log(10.0)  # of the worst tenth of an exponential distribution
    intervals = [worst_mean(np.random.default_rng(k).exponential(size=400)).interval for k in range(300)]
    covered = np.mean([low <= truth <= high for low, high in intervals])
    assert 0.89 <= covered <= 0.99


def test_mean_of_lists__half_widths_add_as_squares():
    assert mean_of_lists([Estimate(0.2, (0.1, 0.3)), Estimate(0.8, (0.8, 0.8))]) == Estimate(
        0.5, pytest.approx((0.45, 0.55))
    )
    assert mean_of_lists([Estimate(0.2, None)]) == Estimate(0.2, None)
    with pytest.raises(InvalidInput, match="there is none"):
        mean_of_lists([])


def test_entry__tells_what_an_evaluation_gives(tiny, entries):
    entry = read_entry(entries / "coast.json")
    assert entry.lists_driven == 3 and entry.overall == entry.mean_of_driven
    for each in tiny.lists:
        sample = each.sample()
        lineup = make_lineup(["full_brake", "coast"], each.scenario)
        result = evaluate(sample, lineup, scenario=each.scenario)
        full, coast = (result.outcome(name) for name in lineup)
        told, count = entry.lists[each.name], each.content.harm_count
        best = each.best_known(sample)
        regret = coast.world_harm(count) - best
        assert told.first_impact_harm.value == pytest.approx(coast.first_impact_harm.mean(), rel=1e-12)
        assert told.total_harm.value == pytest.approx(coast.total_harm.mean(), rel=1e-12)
        assert told.collision_rate.value == coast.collided.mean()
        share = 1.0 - regret.mean() / (full.world_harm(count) - best).mean()
        assert told.realised_share.value == pytest.approx(share, abs=1e-12)
        assert told.knows == "own sensors" and told.policies == {} and told.below_best_known == 0


def test_full_braking__realises_nothing_and_every_list_tells_its_worlds(tiny, entries):
    entry = read_entry(entries / "full_brake.json")
    assert [each.realised_share.value for each in entry.driven.values()] == [0.0, 0.0, 0.0]
    assert [each.worlds_sha256 for each in entry.driven.values()] == [e.content.worlds_sha256 for e in tiny.lists]
    assert entry.versions["python"] and entry.suite_sha256 == tiny.sha256


def test_lists_that_an_agent_cannot_drive__have_no_score_and_so_has_the_whole(entries):
    entry = read_entry(entries / "full_brake+episode.json")
    assert isinstance(entry.lists["cooperation-3-pair"], NotDriven)
    assert entry.lists["cooperation-3-pair"].not_driven
    assert entry.lists_driven == 2 and entry.overall is None
    shares = [each.realised_share.value for each in entry.driven.values()]
    assert entry.mean_of_driven.value == pytest.approx(np.mean(shares))


def test_agents_that_drive_nothing__are_refused_with_the_reason(tiny):
    with pytest.raises(InvalidInput, match="can drive no list of it: unknown agent 'full_break'"):
        tiny.make_entry("full_break")
    with pytest.raises(InvalidInput, match="can drive no list of it: agent 'ladder': stands for"):
        tiny.make_entry("ladder")


@pytest.mark.parametrize("purpose", ["training", "evaluation"])
def test_policies_made_with_a_seed_of_the_suite__are_refused(tiny, tmp_path, purpose):
    bundle = copied_policy(tmp_path, {"training": 3, purpose: 902})
    told = f"its policy of vehicle_2 was made with {purpose} seed 902, which is suite tiny's own"
    with pytest.raises(InvalidInput, match=told):
        tiny.make_entry(f"ppo@{bundle}")
    with pytest.raises(InvalidInput, match=told):
        tiny.make_entry(f"ppo@{bundle}+episode")


def copied_policy(folder, seeds):
    """The shipped PPO policy, said to come from these seeds."""
    bundle = folder / "bundle"
    shutil.copytree(shipped_policies()["ppo"] / "policy", bundle)
    policy = load_policy(bundle)
    manifest = policy.manifest.model_copy(update={"seeds": seeds})
    content = manifest.model_dump(mode="json")
    content["manifest_sha256"] = content_sha256(content)
    (bundle / "manifest.json").write_text(json.dumps(content))
    return bundle


def test_another_world__is_refused(suites, tmp_path, tiny, monkeypatch):
    each = tiny.lists[0]
    sample = each.sample()
    gaps = sample.worlds.gaps_m.copy()
    gaps[5, 1] = np.nextafter(gaps[5, 1], 99.0)  # one bit
    monkeypatch.setattr(type(each.scenario), "sample", lambda *a, **k: replace(sample, worlds=moved(sample, gaps)))
    with pytest.raises(InvalidInput, match="list paper-random: the worlds drawn here have SHA-256"):
        tiny.make_entry("coast")


def moved(sample, gaps):
    return replace(sample.worlds, gaps_m=gaps)


def test_damaged_suites__are_refused(suites, tmp_path):
    shutil.copytree(suites, tmp_path / "copy")
    folder = tmp_path / "copy"
    file = folder / "tiny" / "suite.json"
    content = json.loads(file.read_text())
    with pytest.raises(UnknownName, match="suite 'tinny'"):
        load_suite("tinny", folder)
    shorter = content | {"lists": content["lists"][:2]}
    file.write_text(json.dumps(shorter))
    assert load_suite("tiny", folder).sha256 != load_suite("tiny", suites).sha256
    file.write_text(json.dumps(content | {"lists": [content["lists"][0]] * 2}))
    with pytest.raises(InvalidInput, match="list paper-random stands in it twice"):
        load_suite("tiny", folder)
    content["lists"][0]["scenario"]["vehicles"] = "three"
    file.write_text(json.dumps(content))
    with pytest.raises(InvalidInput, match=r"suite.json, list paper-random: .*vehicles"):
        load_suite("tiny", folder)
    file.write_text("{")
    with pytest.raises(InvalidInput, match=r"suite.json: is no JSON"):
        load_suite("tiny", folder)


def test_another_table__is_refused(suites, tmp_path):
    shutil.copytree(suites, tmp_path / "copy")
    (tmp_path / "copy/tiny/paper-random.npz").write_bytes((tmp_path / "copy/tiny/cooperation-3-pair.npz").read_bytes())
    with pytest.raises(InvalidInput, match="is not the table that belongs to the suite"):
        load_suite("tiny", tmp_path / "copy").make_entry("coast")


def test_frozen_suites__stay(suites):
    with pytest.raises(AlreadyExists, match="is frozen"):
        load("../studies/freeze_suite").freeze_suite("tiny", [], suites)
