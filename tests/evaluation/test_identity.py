"""By which hashes a result is recognised."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.evaluation.identity import policy_sha256, scenario_sha256, worlds_sha256

SCENARIO = eb.load_scenario("paper-random")
SAMPLE = SCENARIO.sample(60, seed=7)


def test_worlds__the_same_list_has_the_same_hash_and_any_other_bit_another() -> None:
    worlds, index = SAMPLE.worlds, SAMPLE.index
    own = worlds_sha256(worlds, index)
    assert own == worlds_sha256(SCENARIO.sample(60, seed=7).worlds, index)
    nudged = replace(worlds, gaps_m=np.nextafter(worlds.gaps_m, 0.0))
    heavier = replace(worlds, vehicles=replace(worlds.vehicles, mass_t=2.0 * worlds.vehicles.mass_t))
    others = [worlds_sha256(nudged, index), worlds_sha256(heavier, index), worlds_sha256(worlds, index + 1)]
    others += [
        worlds_sha256(worlds.take(np.arange(59)), index[:59]),
        worlds_sha256(SCENARIO.sample(60, 8).worlds, index),
    ]
    assert len({own, *others}) == 6


def test_worlds__how_they_lie_in_memory_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds, index = SAMPLE.worlds, SAMPLE.index
    own = worlds_sha256(worlds, index)
    copied = worlds.take(np.arange(60))  # the news of a world is a view here, and an array of its own there
    fortran = replace(copied, gaps_m=np.asfortranarray(copied.gaps_m))
    monkeypatch.setattr("ethbrake_marl.evaluation.identity._BLOCK", 7)
    assert worlds_sha256(fortran, index) == own


def test_scenario__values_count_and_words_do_not() -> None:
    own = scenario_sha256(SCENARIO)
    assert scenario_sha256(SCENARIO.replace(name="mine", title="t", description="d", source="s")) == own
    others = [SCENARIO.replace(restitution=0.2), SCENARIO.replace(horizon_s=9.0), SCENARIO.with_learners(["vehicle_3"])]
    assert len({own, *map(scenario_sha256, others)}) == 4


def test_policy__is_found_inside_what_is_around_it() -> None:
    policy = eb.load_shipped("ppo")
    sha = policy.manifest.manifest_sha256
    for spec in ("ppo@shipped", "ppo@shipped+refined", "ppo@shipped+refined+episode", "ppo@shipped+step"):
        assert policy_sha256(eb.make_agent(spec, scenario=SCENARIO)) == sha
    assert policy_sha256(eb.make_agent("full_brake+step", scenario=SCENARIO)) is None


def test_results__say_worlds_scenario_policy_and_versions() -> None:
    agents = {"full_brake": eb.make_agent("full_brake"), "ppo": eb.make_agent("ppo@shipped", scenario=SCENARIO)}
    found = eb.evaluate(SAMPLE, agents, scenario=SCENARIO, seed=7, chunk=25, aftermath=False)
    braking, learned = (row.to_json() for row in eb.summarise(found))
    assert braking["worlds_sha256"] == learned["worlds_sha256"] == worlds_sha256(SAMPLE.worlds, SAMPLE.index)
    assert braking["scenario_sha256"] == scenario_sha256(SCENARIO)
    assert braking["policy_sha256"] == {}
    assert learned["policy_sha256"] == {"vehicle_2": eb.load_shipped("ppo").manifest.manifest_sha256}
    assert set(learned["versions"]) == {"python", "ethbrake-marl", "numpy", "numba"}
    assert learned["versions"]["numpy"] == version("numpy")
    assert found.outcome("ppo").take(np.array([0])).policies == found.outcome("ppo").policies
