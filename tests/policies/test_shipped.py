"""Policies that ship: found by name, scenario and count, and as good as their pages say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl import policies as bundle
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.evaluation.measures import TESTS
from ethbrake_marl.policies import Policy, load_named_policy, shipped_name, shipped_policies
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridAgent

SCENARIO = load_scenario("paper-random")


@pytest.fixture
def folder(policy: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package in which four policies ship; they were trained on paper-random."""
    for name in ("ppo", "ppo-total", "ppo-paper-distance", "universal"):
        policy.save(tmp_path / name / "policy")
        (tmp_path / name / "card.md").write_text(f"# {name}\n")
    monkeypatch.setattr(bundle, "_FOLDER", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "scenario", "harm_count", "name"),
    [
        ("ppo", "paper-random", "first", "ppo"),
        ("ppo", "paper-random", "total", "ppo-total"),
        ("ppo", "paper-distance", "total", "ppo-paper-distance"),  # better than none
        ("universal", "paper-delay-low", "first", "universal"),
        ("ppo", None, "total", "ppo-total"),
        ("policy", "paper-random", "total", "ppo-total"),
        ("policy", "paper-delay-low", "first", "universal"),
    ],
)
def test_shipped_name__is_by_kind_scenario_and_count(
    kind: str, scenario: str | None, harm_count: HarmCount, name: str, folder: Path
) -> None:
    assert shipped_name(kind, scenario, harm_count) == name


def test_lineup__takes_what_ships(folder: Path) -> None:
    specs = ["ppo@shipped", "universal@shipped", "policy@shipped", "team@shipped", "ppo@shipped+episode"]
    lineup = make_lineup([*specs, "ppo@shipped/ppo-paper-distance"], SCENARIO)
    assert [each.name for each in lineup.values()] == list(lineup)
    assert isinstance(lineup["ppo@shipped+episode"], HybridAgent)
    worlds = SCENARIO.sample(5, 1).worlds
    acts = [lineup[spec].act(worlds, 1).tolist() for spec in specs[:4]]
    assert acts == [acts[0]] * 4  # four copies of one policy ship here


def test_shipped_policies__each_that_ships_is_small_and_has_a_card() -> None:
    for name, path in shipped_policies().items():
        assert load_named_policy(f"shipped/{name}").manifest.steps > 0
        assert sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) < 1_000_000
        assert (path / "card.md").read_text("utf-8").startswith("# ")


@pytest.mark.parametrize("harm_count", HARM_COUNTS)
@pytest.mark.parametrize("test", list(TESTS))
def test_shipped__one_for_each_of_the_three_tests_drives_alone_and_behind_its_shield(
    test: str, harm_count: HarmCount
) -> None:
    scenario = load_scenario(test)
    name = shipped_name("ppo", test, harm_count)
    assert load_named_policy(f"shipped/{name}").manifest.scenario["name"] == test
    lineup = make_lineup(["ppo@shipped", "ppo@shipped+episode"], scenario, harm_count=harm_count)
    result = evaluate(scenario.sample(20, 7), lineup, scenario=scenario, seed=7)
    alone, shielded = (result.outcome(spec).ledger.world_harm(harm_count) for spec in lineup)
    assert shielded.mean() <= alone.mean()
    assert (shielded <= result.outcome("ppo@shipped+episode").predicted_harm + 1e-9).all()


@pytest.mark.slow
@pytest.mark.parametrize("harm_count", HARM_COUNTS)
@pytest.mark.parametrize("test", list(TESTS))
def test_policy_shipped__is_the_best_that_ships(test: str, harm_count: HarmCount) -> None:
    """By the mean harm in 2,000 worlds, within a hundredth of the best of all but those of levels of cooperation."""
    scenario = load_scenario(test)
    each = [
        f"ppo@shipped/{name}" if name.startswith("ppo") else f"policy@shipped/{name}"
        for name in shipped_policies()
        if "cooperation" not in name
    ]
    lineup = make_lineup(["policy@shipped", *each], scenario, harm_count=harm_count)
    result = evaluate(scenario.sample(2_000, 21), lineup, scenario=scenario, seed=21, aftermath=False)
    harm = {spec: result.outcome(spec).ledger.world_harm(harm_count).mean() for spec in lineup}
    assert harm["policy@shipped"] <= 1.01 * min(harm.values())


@pytest.mark.parametrize(
    ("level", "share_of_full_braking", "collisions"),
    [
        ("cooperation-1-front", 0.60, 0.80),
        ("cooperation-2-paper", 0.33, 0.70),
        ("cooperation-2-blocked", 0.52, 0.87),
        ("cooperation-3-pair", 0.33, 0.70),
        ("cooperation-4-all", 0.03, 0.15),
    ],
)
def test_policy_shipped__drives_all_learners_of_a_level_of_cooperation(
    level: str, share_of_full_braking: float, collisions: float
) -> None:
    """At least as well as docs/cooperation.md says, by and large: level 3 collides no more often than level 2."""
    scenario = load_scenario(level)
    assert shipped_name("policy", level, "total") == f"counterfactual-{level}"
    assert load_named_policy(f"shipped/counterfactual-{level}").manifest.learners == tuple(
        scenario.vehicle_names[i] for i in scenario.learners
    )
    lineup = make_lineup(["full_brake", "policy@shipped", "team@shipped"], scenario)
    result = evaluate(scenario.sample(300, 7), lineup, scenario=scenario, seed=7, aftermath=False)
    braking, policy, team = (result.outcome(spec) for spec in lineup)
    assert policy.first_impact_harm.mean() <= share_of_full_braking * braking.first_impact_harm.mean()
    assert policy.collided.mean() <= collisions
    assert np.array_equal(policy.first_impact_harm, team.first_impact_harm)


@pytest.mark.parametrize("harm_count", HARM_COUNTS)
def test_shipped__counterfactual_does_less_harm_than_ppo(harm_count: HarmCount) -> None:
    """On worlds that are no training's: several networks and a gate, trained for this count."""
    name = shipped_name("counterfactual", "paper-random", harm_count)
    manifest = load_named_policy(f"shipped/{name}").manifest
    assert manifest.reward["harm_count"] == harm_count and manifest.network.networks == 2
    lineup = make_lineup(["ppo@shipped", "counterfactual@shipped"], SCENARIO, harm_count=harm_count)
    result = evaluate(SCENARIO.sample(600, 9), lineup, scenario=SCENARIO, seed=9, aftermath=False)
    ppo, counterfactual = (result.outcome(spec).ledger.world_harm(harm_count).mean() for spec in lineup)
    assert counterfactual < 0.98 * ppo


# Of each list of 10,000 (seed 7) the worlds in which a shipped policy, refined, was furthest below an earlier table.
LOWERED = {
    "paper-random": (["ppo", "sac"], [400, 1058, 1261, 2987, 4300, 4408, 5872, 5976, 8752]),
    "paper-random-brake-only": (["ppo"], [1325, 2801, 5278, 5547, 5814, 5984, 7228, 8020, 8166]),
}


@pytest.mark.parametrize("harm_count", ["first", pytest.param("total", marks=pytest.mark.slow)])
@pytest.mark.parametrize("test", list(LOWERED))
def test_shipped__refined_is_nowhere_below_the_shipped_table(test: str, harm_count: HarmCount) -> None:
    scenario = load_scenario(test)
    kinds, numbers = LOWERED[test]
    every = scenario.sample(10_000, 7)
    rows = np.array(numbers)
    sample = replace(every, worlds=every.worlds.take(rows), index=every.index[rows])
    lineup = make_lineup([f"{kind}@shipped+refined+episode" for kind in kinds], scenario, harm_count=harm_count)
    found = summarise(evaluate(sample, lineup, scenario=scenario, seed=7))
    assert [(row.agent, row.known_best_share, row.below_best_known) for row in found] == [
        (name, 1.0, 0) for name in lineup
    ]
