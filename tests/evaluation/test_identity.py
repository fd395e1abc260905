"""By which hashes a result is recognised."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.evaluation.inputs import policy_sha256, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.shield_modes import compare_modes
from ethbrake_marl.scenario import Task
from tests.failing_worlds import plant

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
    monkeypatch.setattr("ethbrake_marl.evaluation.inputs._BLOCK", 7)
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


ABOUT = {"worlds_sha256": worlds_sha256(SAMPLE.worlds, SAMPLE.index), "scenario_sha256": scenario_sha256(SCENARIO)}


@pytest.mark.parametrize(
    ("kind", "command"),
    [
        ("evaluate", ("evaluate", "--agents", "full_brake")),
        ("shield", ("shield", "--agents", "full_brake")),
        ("best-harm", ("search", "best-harm", "--budget", "20")),
        pytest.param(
            "robustness",
            ("watch", "picture", "robustness", "--uncertainty", "mass_t.vehicle_3=1%", "--output", "x.png"),
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_every_results_file__says_its_kind_worlds_scenario_and_versions(
    kind: str, command: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_command([*command, "--episodes", "60", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    for part in content if isinstance(content, list) else [content]:
        assert part["kind"] == kind and {key: part[key] for key in ABOUT} == ABOUT
        assert part["versions"]["numpy"] == version("numpy")


def test_shield_results__leave_the_same_worlds_out_of_the_hash() -> None:
    task = Task(SCENARIO, (1,))
    sample = replace(SAMPLE, worlds=plant(SAMPLE.worlds, [3]))
    rows = compare_modes({"ppo": eb.make_agent("ppo@shipped", scenario=SCENARIO)}, sample.worlds, task)
    told = rows.to_json(sample, task)
    kept = np.delete(np.arange(60), 3)
    assert {row["worlds_sha256"] for row in told} == {worlds_sha256(SAMPLE.worlds.take(kept), SAMPLE.index[kept])}
    assert told[0]["episodes"] == 59
    assert told[0]["policy_sha256"] == {"vehicle_2": eb.load_shipped("ppo").manifest.manifest_sha256}
