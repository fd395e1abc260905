from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl import policies as bundle
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, UnknownName
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


def test_shipped_name__is_by_kind_scenario_and_count(folder: Path) -> None:
    assert shipped_name("ppo", "paper-random", "first") == "ppo"
    assert shipped_name("ppo", "paper-random", "total") == "ppo-total"
    assert shipped_name("ppo", "paper-distance", "total") == "ppo-paper-distance"  # better than none
    assert shipped_name("universal", "paper-delay-low", "first") == "universal"
    assert shipped_name("ppo", None, "total") == "ppo-total"
    assert shipped_name("policy", "paper-random", "total") == "ppo-total"
    assert shipped_name("policy", "paper-delay-low", "first") == "universal"


@pytest.mark.parametrize(("kind", "scenario"), [("sac", "paper-random"), ("ppo", "paper-delay-low"), ("sac", None)])
def test_shipped_name__lists_what_ships_when_there_is_none(kind: str, scenario: str | None, folder: Path) -> None:
    listed = "ppo, ppo-paper-distance, ppo-total, universal"
    with pytest.raises(InvalidInput, match=f"shipped policy {kind}.*: there is none; shipped are: {listed}"):
        shipped_name(kind, scenario, "first")


def test_load_named_policy__by_its_own_name(folder: Path) -> None:
    assert load_named_policy("shipped/universal").manifest.steps == 1024
    with pytest.raises(UnknownName, match="unknown shipped policy 'universel'; did you mean 'universal'"):
        load_named_policy("shipped/universel")


def test_lineup__takes_what_ships(folder: Path, policy: Policy) -> None:
    worlds = SCENARIO.sample(5, 1).worlds
    specs = ["ppo@shipped", "universal@shipped", "ppo@shipped+episode", "ppo@shipped/ppo-paper-distance"]
    lineup = make_lineup(specs, SCENARIO)
    assert list(lineup) == specs
    assert isinstance(lineup["ppo@shipped+episode"], HybridAgent)
    assert lineup["universal@shipped"].name == "universal@shipped"
    alone = lineup["ppo@shipped"].act(worlds, 1)
    assert np.array_equal(alone, eb.make_agent("universal@shipped").act(worlds, 1))


def test_team__is_what_ships_for_the_scenario(folder: Path) -> None:
    pair = SCENARIO.with_learners(["vehicle_2", "vehicle_3"])
    worlds = pair.sample(5, 1).worlds
    team, policy = (eb.make_agent(f"{name}@shipped", scenario=pair) for name in ("team", "policy"))
    assert team.name == "team@shipped" and np.array_equal(team.act(worlds, 2), policy.act(worlds, 2))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("universal@runs/x", "must be universal@shipped"),
        ("sac@shipped/universal", "that policy was trained by PPO: ppo@shipped/universal"),
        ("ppo@", "a path is needed after '@'"),
        ("sac", "a policy is needed: sac@PATH, where PATH is a run or a policy bundle"),
    ],
)
def test_lineup__says_what_a_policy_is_called(spec: str, message: str, folder: Path) -> None:
    with pytest.raises(InvalidInput, match=message):
        make_lineup([spec], SCENARIO)


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


def test_policy__whatever_trained_it(folder: Path, policy: Policy) -> None:
    assert make_lineup(["policy@shipped/ppo"], SCENARIO)["policy@shipped/ppo"].name == "policy@shipped/ppo"
    with pytest.raises(InvalidInput, match="policy@PATH, where PATH is a run or a policy bundle"):
        make_lineup(["policy"], SCENARIO)


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
