"""Mixtures: world k is world k of the member it was drawn from; members must fit into one batch."""

from __future__ import annotations

import copy
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import scenario_sha256, worlds_sha256
from ethbrake_marl.learning.training import Training
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario, load_scenario

DELAYS = load_scenario("mixture-delays")
MEMBERS = ("paper-delay-low", "paper-delay-middle", "paper-delay-high")


def mixed(*members: str, **beside: object) -> Scenario:
    return load_scenario({"name": "mixed", "mixture": [{"scenario": name} for name in members], **beside})


def same(one: Worlds, other: Worlds) -> bool:
    rows = np.arange(one.n)
    return worlds_sha256(one, rows) == worlds_sha256(other, rows)


@pytest.mark.parametrize("channel", ["list", "training"])
@pytest.mark.parametrize(
    ("mixture", "members"),
    [
        (DELAYS, MEMBERS),
        (mixed("paper-random", "stress-wide", horizon_s=16), ("paper-random", "stress-wide")),  # with early impacts
        (mixed("realistic-mixed", "realistic-truck"), ("realistic-mixed", "realistic-truck")),  # with types
    ],
)
def test_world__is_that_of_its_member(mixture: Scenario, members: tuple[str, ...], channel: str):
    sample = mixture.sample(300, 7, channel=channel)  # type: ignore[arg-type]
    assert sample.scenarios is not None
    assert set(sample.scenarios) == set(members)
    for name in members:
        own = load_scenario(name).sample(300, 7, channel=channel)  # type: ignore[arg-type]
        rows = np.flatnonzero(sample.scenarios == name)
        assert same(sample.worlds.take(rows), own.worlds.take(rows))
        if own.types is not None and sample.types is not None:
            assert (sample.types[rows] == own.types[rows]).all()
        elif sample.types is not None:
            assert (sample.types[rows] == "").all()


def test_members_with_a_channel_and_without__are_one_batch():
    mixture = mixed("cooperation-3-pair", "cooperation-3-congested")
    sample = mixture.sample(60, 7)
    assert sample.scenarios is not None
    for name in ("cooperation-3-pair", "cooperation-3-congested"):
        rows = np.flatnonzero(sample.scenarios == name)
        own = load_scenario(name).sample(60, 7).worlds.take(rows)
        assert (sample.worlds.vehicles.known_from_s[rows] == own.vehicles.known_from_s).all()
    assert mixture.by_link
    env = eb.parallel_env(scenario=mixture)
    seen = {env.reset(seed=seed)[1]["vehicle_2"]["known_from_s"].shape for seed in range(6)}
    assert seen == {(3,)}


def test_weights__decide_how_often():
    entries = [{"scenario": name, "weight": weight} for name, weight in zip(MEMBERS, (1, 2, 5), strict=True)]
    names = load_scenario({"name": "mixed", "mixture": entries}).sample(20_000, 3).scenarios
    seen = [int((names == name).sum()) for name in MEMBERS]
    assert stats.chisquare(seen, np.array([1, 2, 5]) / 8 * 20_000).pvalue > 0.001


def test_world__does_not_depend_on_the_list():
    whole = DELAYS.sample(40, 7)
    part = DELAYS.sample(5, 7, first=20)
    assert whole.scenarios is not None
    assert part.scenarios is not None
    assert part.index.tolist() == list(range(20, 25))
    assert (part.scenarios == whole.scenarios[20:25]).all()
    assert same(part.worlds, whole.worlds.take(np.arange(20, 25)))
    assert (DELAYS.sample(40, 8).scenarios != whole.scenarios).any()


def test_what_stands_beside__holds_for_every_member():
    heavy = DELAYS.replace(mass_t=[40, 1, 1])
    assert heavy.bounds("mass_t")[0] == (40.0, 40.0)
    assert (heavy.sample(20, 7).worlds.vehicles.mass_t[:, 0] == 40.0).all()
    assert (heavy.sample(20, 7).worlds.gaps_m == DELAYS.sample(20, 7).worlds.gaps_m).all()
    assert DELAYS.bounds("latency_s") == ((0.0, 0.0), (0.1, 0.8), (0.3, 1.2))
    third = DELAYS.with_learners(["vehicle_3"])
    assert third.learners == (2,)
    assert all(member.learners == (2,) for member in third.members)


def test_scenario__copies_and_is_told_by_its_hash():
    again = [copy.deepcopy(DELAYS), pickle.loads(pickle.dumps(DELAYS)), Scenario(**DELAYS.declared())]
    again.append(Scenario.model_validate_json(json.dumps(DELAYS.declared())))
    for each in again:
        assert each == DELAYS
        assert [member.name for member in each.members] == list(MEMBERS)
        assert scenario_sha256(each) == scenario_sha256(DELAYS)
    assert scenario_sha256(DELAYS.replace(mass_t=3)) != scenario_sha256(DELAYS)
    assert Training.of("ppo", DELAYS).identity != Training.of("ppo", DELAYS.replace(mass_t=3)).identity


def test_file__may_name_a_file_beside_it(tmp_path: Path):
    own = load_scenario("paper-random").replace(name="own", title="")
    (tmp_path / "own.yaml").write_text(json.dumps(own.declared()))
    (tmp_path / "mine.yaml").write_text("name: mine\nmixture: [{scenario: own.yaml}, {scenario: paper-random-early}]\n")
    mine = load_scenario(tmp_path / "mine.yaml")
    assert [member.name for member in mine.members] == ["own", "paper-random-early"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("mixture: 3", "mine.yaml, line 2: mixture = 3: must be a list"),
        ("mixture: []", "mine.yaml, line 2: mixture = []: must not be empty"),
        ("mixture: [3]", "mine.yaml, line 2: mixture[0] = 3: must be a mapping"),
        ("mixture: [{weight: 1}]", "mixture[0].scenario: missing; it is needed, for instance {scenario: paper-random"),
        ("mixture:\n  - scenario: paper-randon", "line 3: mixture[0].scenario = paper-randon: unknown scenario"),
        ("mixture: [{scenario: paper-random, weigt: 3}]", "mixture[0].weigt: unknown key; did you mean weight?"),
        ("mixture: [{scenario: paper-random, weight: 0}]", "mixture[0].weight = 0: must be greater than 0"),
        ("mixture: [{scenario: mixture-delays}]", "mixture-delays is a mixture itself; list its scenarios here"),
        ("mixture: [{scenario: paper-random}, {scenario: paper-random}]", "mixture[1]: paper-random is given twice"),
        ("mixture: [{scenario: paper-random, weigth: 2}, {scenario: paper-random}]", "mixture[0].weigth: unknown key"),
        (
            "mixture: [{scenario: paper-random}, {scenario: stress-wide}]",
            "line 2: mixture: horizon_s must be the same in all: paper-random has 8, stress-wide has 16; give horizon_s"
            " beside mixture, and it holds for all",
        ),
        (
            "mixture: [{scenario: paper-random}, {scenario: cooperation-4-five}]",
            "vehicles must be the same in all: paper-random has 3, cooperation-4-five has 5",
        ),
        (
            "mixture: [{scenario: paper-random}, {scenario: paper-random-obstacle}]",
            "an obstacle ahead must be there in all or in none: paper-random has none, paper-random-obstacle has one",
        ),
        (
            "mixture: [{scenario: paper-random}]\nvehicles: 5",
            "line 2: mixture: vehicles = 5: its scenarios have 3, which nothing beside them can change",
        ),
        ("mixture: [{scenario: paper-random}]\nmass_tt: 3", "line 3: mass_tt: unknown key; did you mean mass_t"),
        ("mixture: [{scenario: paper-random}]\nhorizon_s: -8", "mixture[0] (paper-random), line 3: horizon_s = -8"),
        ("mixture: [{scenario: {name: x,\n   massx: 3}}]", "mixture[0] (x), line 3: massx: unknown key; did you mean"),
    ],
)
def test_bad_mixtures__are_one_error(tmp_path: Path, given: str, message: str):
    (tmp_path / "mine.yaml").write_text(f"name: mine\n{given}\n")
    with pytest.raises(InvalidInput) as caught:
        load_scenario(tmp_path / "mine.yaml")
    assert message in str(caught.value), str(caught.value)


def test_vehicles__beside_members_written_out_holds_for_those_that_say_nothing_else(tmp_path: Path):
    line = "gaps_m: 7, speeds_mps: 20, braking_capacity_mps2: 9, driving_capacity_mps2: 5, latency_s: 0.5, mass_t: 1"
    text = "name: mine\nvehicles: 5\nmixture:\n  - scenario: {name: a, %s%s}\n  - scenario: {name: b, %s}\n"
    (tmp_path / "mine.yaml").write_text(text % (line, "", line))
    assert [member.vehicles for member in load_scenario(tmp_path / "mine.yaml").members] == [5, 5]
    (tmp_path / "mine.yaml").write_text(text % (line, ", vehicles: 3", line))
    with pytest.raises(InvalidInput, match="vehicles = 5: its scenarios have 3, which nothing beside them can change"):
        load_scenario(tmp_path / "mine.yaml")


def test_names__are_read_from_files_only():
    with pytest.raises(InvalidInput, match=r"mixture\[0\].scenario = paper-random: must be what a scenario says"):
        Scenario(name="x", mixture=[{"scenario": "paper-random"}])
    assert Scenario(name="x", mixture=[{"scenario": load_scenario("paper-random")}]).vehicles == 3


def test_given_worlds__belong_to_no_member():
    env = eb.parallel_env(scenario=DELAYS)
    with pytest.raises(InvalidInput, match="is a mixture, and nothing says which of its scenarios a world belongs to"):
        env.reset(options={"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}})


def test_notebook__names_the_members():
    assert "1 x paper-delay-low, 1 x paper-delay-middle, 1 x paper-delay-high" in DELAYS._repr_html_()


def test_quantities__are_those_of_the_members():
    with pytest.raises(InvalidInput, match="is a mixture; its members say what mass_t is"):
        DELAYS.quantities("mass_t")


def test_results__tell_the_scenario_and_agree_with_the_members():
    agents = {"full_brake": eb.make_agent("full_brake"), "e_v2x_bm": eb.make_agent("e_v2x_bm")}
    sample = DELAYS.sample(120, 7)
    found = eb.evaluate(sample, agents, scenario=DELAYS, seed=7)
    columns = found.to_frame("columns")
    assert sample.scenarios is not None
    assert columns["scenario"].tolist() == sample.scenarios.tolist() * 2
    groups = eb.summarise_by(found, "scenario")
    for name in MEMBERS:
        member, rows = load_scenario(name), np.flatnonzero(sample.scenarios == name)
        own = eb.evaluate(member.sample(120, 7).take(rows), agents, scenario=member, seed=7)
        assert (own.outcome("e_v2x_bm").total_harm == found.outcome("e_v2x_bm").total_harm[rows]).all()
        assert [row.total_harm for row in groups[name]] == [row.total_harm for row in eb.summarise(own)]
    assert not isinstance(found.limits, str)


def test_engine__goes_through_the_training_list():
    env = eb.EthBrakeVectorEnv(num_envs=8, scenario=DELAYS)
    env.reset(seed=5)
    expected = DELAYS.sample(8, 5, channel="training").worlds.vehicles.latency_s
    assert (env.engine.worlds.vehicles.latency_s == expected).all()


def test_shields_and_searches__take_a_mixture():
    agents = {name: eb.make_agent(name, scenario=DELAYS) for name in ("full_brake+step", "constant:3+episode")}
    plain = eb.evaluate(DELAYS.sample(20, 7), {"b": eb.make_agent("full_brake")}, scenario=DELAYS).outcome("b")
    shielded = eb.evaluate(DELAYS.sample(20, 7), agents, scenario=DELAYS).outcome("full_brake+step")
    assert (shielded.first_impact_harm <= plain.first_impact_harm + 1e-9).all()
