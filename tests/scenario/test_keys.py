"""Keys as engineers think of them, outcomes by hand; refusals: ``refusals/keys.txt``."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import lognorm

from ethbrake_marl.agents import Team, drive, make_agent
from ethbrake_marl.evaluation import states_of
from ethbrake_marl.limits import prove
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import QUANTITY, Scenario, Task, load_scenario
from ethbrake_marl.shield import ShieldedDriver, parse_uncertainty

PAPER = load_scenario("paper-random")
FIXED = PAPER.replace(gaps_m=40, speeds_mps=20, latency_s=0, early_impacts="keep", horizon_s=30)
TABLE = {"columns": ["gap_1_m", "speed_2_mps"], "rows": [[5.0, 18.0], [6.0, 19.0], [7.0, 20.0]]}


def final(scenario: Scenario, worlds: Worlds | None = None) -> Worlds:
    """The worlds once everybody has braked fully, or as its script says."""
    worlds = scenario.sample(1, 7).worlds if worlds is None else worlds
    return drive(worlds, Team.of(make_agent("full_brake"), list(scenario.learners)), scenario).final


# Friction: stopping ways are v^2 / (2 min(capacity, 9.81 mu)).


@pytest.mark.parametrize(
    ("friction", "capacity", "gaps"),
    [
        # 4 < 5.886 < 7: 50, 33.979, 33.979 m
        (0.6, [4.0, 7.0, 7.0], [40 + 50 - 400 / 11.772, 40.0]),
        # all 2.943: the same way of 67.96 m for all
        (0.3, [4.0, 7.0, 7.0], [40.0, 40.0]),
        # dry enough: 50, 28.571, 33.333 m
        (1.0, [4.0, 7.0, 6.0], [40 + 50 - 400 / 14, 40 + 400 / 14 - 400 / 12]),
    ],
)
def test_friction__gaps_at_rest_by_hand(friction: float, capacity: list[float], gaps: list[float]) -> None:
    found = final(FIXED.replace(friction=friction, braking_capacity_mps2=capacity))
    assert found.gaps_m[0] == pytest.approx(gaps, abs=1e-9)


def test_friction__is_one_number_for_the_whole_line_and_moves_nothing_else() -> None:
    wet = PAPER.replace(friction={"uniform": [0.2, 0.9]}, early_impacts="keep")
    worlds, dry = wet.sample(200, 7).worlds, PAPER.replace(early_impacts="keep").sample(200, 7).worlds
    friction = worlds.friction
    assert 0.2 <= friction.min() < 0.22 and 0.88 < friction.max() <= 0.9
    for name in ("braking_capacity_mps2", "driving_capacity_mps2"):
        own = getattr(dry.vehicles, name)
        assert (getattr(worlds.vehicles, name) == np.minimum(own, 9.81 * friction[:, np.newaxis])).all()
        assert (worlds.dry(name) == own).all()
    for name in ("gaps_m", "speeds_mps"):
        assert (getattr(worlds, name) == getattr(dry, name)).all()
    assert wet.bounds("braking_capacity_mps2") == ((9.81 * 0.2, 6.0), (9.81 * 0.2, 7.0), (9.81 * 0.2, 6.0))
    assert wet.bounds("braking_capacity_mps2", dry=True) == ((6.0, 6.0), (7.0, 7.0), (6.0, 6.0))
    assert wet.ranges().names[-1] == "friction"


def test_friction__of_a_margin() -> None:
    short = FIXED.replace(friction=0.3, obstacle_margin_m=1.7)
    assert short.sample(1, 7).worlds.obstacle_gap_m[0] == pytest.approx(1.7 + 400 / (2 * 2.943), abs=1e-9)
    assert short.farthest_obstacle_m == pytest.approx(1.7 + 400 / (2 * 2.943), abs=1e-9)


def test_friction__a_table_of_initial_states_gives_the_same_worlds() -> None:
    wet = PAPER.replace(friction={"uniform": [0.2, 0.9]}, braking_capacity_mps2={"uniform": [3, 9]})
    worlds = wet.sample(50, 3).worlds
    states = states_of(worlds, wet)
    assert list(states[0])[-1] == "friction" and "braking_capacity_2_mps2" in states[0]
    again = wet.worlds_from_table({name: [state[name] for state in states] for name in states[0]})
    assert (again.road == worlds.road).all()
    assert (again.vehicles.braking_capacity_mps2 == worlds.vehicles.braking_capacity_mps2).all()
    assert wet.worlds_from_state({name: 0.5 for name in ("friction",)} | state_of(worlds)).friction.tolist() == [0.5]


def state_of(worlds: Worlds) -> dict[str, Any]:
    return {"gaps_m": worlds.gaps_m[0].tolist(), "speeds_mps": worlds.speeds_mps[0].tolist(),
            "braking_capacity_mps2": worlds.dry("braking_capacity_mps2")[0].tolist()}  # fmt: skip


def test_friction__its_uncertainty_moves_all_capacities_together() -> None:
    worlds = FIXED.replace(friction=0.6, braking_capacity_mps2=[4, 7, 9]).sample(1, 7).worlds
    members = parse_uncertainty("friction=0.2,braking_capacity_mps2.vehicle_3=3").members(worlds)
    shares, dry = [0, 0.125, 0.25, 0.375, 0.625, 0.75, 0.875, 1], ([4, 7, 6], [4, 7, 12])
    expected = [[4, 5.886, 5.886]] + [np.minimum(d, 9.81 * (0.4 + 0.4 * share)) for d in dry for share in shares]
    assert members.vehicles.braking_capacity_mps2 == pytest.approx(np.array(expected), abs=1e-12)


def test_friction__of_some_members_of_a_mixture() -> None:
    wet = PAPER.replace(name="wet", friction=0.4).declared()
    mixed = Scenario(name="road", mixture=[{"scenario": PAPER}, {"scenario": wet}])
    worlds = mixed.sample(40, 7).worlds
    assert set(worlds.friction.tolist()) == {0.4, math.inf}
    braking = worlds.vehicles.braking_capacity_mps2
    assert set(braking[:, 1].tolist()) == {7.0, 9.81 * 0.4}
    told = QUANTITY.columns(worlds)  # no friction is told for all: then the capacities are what the road allows
    assert "friction" not in told and (told["braking_capacity_2_mps2"] == braking[:, 1]).all()
    assert [state["braking_capacity_2_mps2"] for state in states_of(worlds, mixed)] == braking[:, 1].tolist()


def test_friction__the_proof_reads_what_the_road_allows() -> None:
    near = FIXED.replace(gaps_m=30, braking_capacity_mps2=[9, 7, 6], latency_s=[0, 0.5, 0.8])
    proofs = {mu: prove(near.replace(friction=mu).sample(1, 7).worlds, Task(near, (1,))) for mu in (0.3, 1.0)}
    assert proofs[0.3].avoidable.tolist() == [True] == proofs[1.0].avoidable.tolist()
    apart = FIXED.replace(gaps_m=[4, 40], latency_s=[0, 0.5, 0.5])  # 20 x 0.5 = 10 m are lost where all brake alike
    assert final(apart.replace(friction=0.3)).pair_hit[0].tolist() == [True, False]


def test_friction__no_truth_of_its_box_is_distrusted_and_no_corner_is_above_the_bound() -> None:
    wet = load_scenario("engineering-wet-road").replace(time_gaps_s={"uniform": [0.2, 0.9]})
    told, rng = wet.sample(60, 7).worlds, np.random.default_rng(0)
    uncertainty = parse_uncertainty("friction=0.1")
    for corners, spec in ((True, "coast"), (True, "full_brake"), (False, "full_brake")):
        shield = ShieldedDriver(make_agent(spec), wet, told=told, uncertainty=uncertainty)
        found = drive(uncertainty.draw(told, rng, corners=corners), shield, wet, 1)
        assert not found.guarded.shield.distrusted.any()
        harm = found.ledger.world_harm("first")
        assert not corners or (harm <= found.guarded.shield.predicted_harm + 1e-9).all()


# A table: one row for each world, the rest drawn.


def without(scenario: Scenario, *keys: str) -> dict[str, Any]:
    """What a scenario declares, but these keys."""
    return {key: value for key, value in scenario.declared().items() if key not in keys}


def tabled(**changes: Any) -> Scenario:
    given = {"gaps_m": 9.0, "speeds_mps": {"uniform": [18, 22]}, "table": TABLE, **changes}
    return Scenario(**without(PAPER, *given), **given)


def test_table__rows_are_never_torn_and_the_rest_is_drawn_as_without_it() -> None:
    found = tabled().sample(600, 7).worlds
    rows = np.stack([found.gaps_m[:, 0], found.speeds_mps[:, 1]], axis=1)
    kinds, counts = np.unique(rows, axis=0, return_counts=True)
    assert kinds.tolist() == TABLE["rows"] and (np.abs(counts - 200) < 60).all()
    assert (found.gaps_m[:, 1] == 9.0).all()
    alone = tabled(table={**TABLE, "weights": [1, 1, 8]}).sample(600, 7).worlds
    assert (alone.speeds_mps[:, [0, 2]] == found.speeds_mps[:, [0, 2]]).all()  # early impacts: none here
    assert np.mean(alone.gaps_m[:, 0] == 7.0) == pytest.approx(0.8, abs=0.05)


def test_table__a_world_by_hand() -> None:
    one = Scenario(**{**FIXED.declared(), "table": {"columns": ["gap_1_m", "mass_3_t"], "rows": [[12, 30]]}})
    worlds = one.sample(3, 7).worlds
    assert worlds.gaps_m.tolist() == [[12.0, 40.0]] * 3 and worlds.vehicles.mass_t[:, 2].tolist() == [30.0] * 3
    assert final(one).gaps_m[0] == pytest.approx([12 + 400 / 12 - 400 / 14, 40 + 400 / 14 - 400 / 12], abs=1e-9)
    assert tabled().ranges().names[-1] == "row of the table"
    assert tabled().bounds("gaps_m") == ((5.0, 7.0), (9.0, 9.0))
    assert tabled().middle_world().gaps_m[0].tolist() == [6.0, 9.0]


def test_table__of_a_file_is_read_once_and_goes_along(tmp_path: Path) -> None:
    whole = {"gap_1_m": 5.5, "gap_2_m": 6.5, "speed_1_mps": 20, "speed_2_mps": 19, "speed_3_mps": 18, "count": 3}
    lines = [",".join(whole), *(",".join(str(value + k) for value in whole.values()) for k in range(14))]
    (tmp_path / "rows.csv").write_text("\n".join(lines) + "\n\n")
    table = {"file": "rows.csv", "columns": [*whole][:5], "weights": "count"}
    declared = {**without(PAPER, "gaps_m", "speeds_mps"), "name": "mine", "early_impacts": "keep"}
    (tmp_path / "mine.yaml").write_text(json.dumps({**declared, "table": table}))
    mine = load_scenario(tmp_path / "mine.yaml")
    (tmp_path / "rows.csv").unlink()
    again = Scenario(**mine.declared()).replace(horizon_s=9)
    assert (len(again.table.rows), again.table.weights) == (14, (*range(3, 17),))
    assert (again.sample(50, 7).worlds.gaps_m == mine.sample(50, 7).worlds.gaps_m).all()


# Lognormal: the logarithm is normal.


def test_lognormal__is_the_truncated_one_of_the_textbook() -> None:
    shape = {"median": 1.1, "sigma": 0.4, "low": 0.3, "high": 3.0}
    law, u = lognorm(s=0.4, scale=1.1), np.array([0.0, 0.5, 0.975])
    low, high = law.cdf(0.3), law.cdf(3.0)
    (entry, _) = PAPER.replace(time_gaps_s={"lognormal": shape}).quantities("time_gaps_s")
    assert entry.value(u) == pytest.approx(law.ppf(low + (high - low) * u), rel=1e-9)


# Equipage: who sends, who hears.

FIXED_LINKS = {"preset": "nominal", "link_latency_s": 0.3, "sensing_s": [1.0, 1.0]}


@pytest.mark.parametrize(
    ("vehicles", "latency", "known_of_2_by_3"),
    [
        ({}, [0.0, 0.3, 0.3], 0.3),
        ({"vehicle_1": {"sends": False}}, [0.0, 1.0, 2.0], 2.0),  # one sees it brake, the other one that
        ({"vehicle_3": {"sends": False, "hears": "none"}}, [0.0, 0.3, 1.3], 1.3),
        ({"vehicle_2": {"sends": False, "hears": "front"}}, [0.0, 0.3, 0.3], 1.0),
    ],
)
def test_equipage__reactions_by_hand(vehicles: dict[str, Any], latency: list[float], known_of_2_by_3: float) -> None:
    v2x = {**FIXED_LINKS, **({"vehicles": vehicles} if vehicles else {})}
    found = FIXED.replace(v2x=v2x).sample(1, 7).worlds.vehicles
    assert found.latency_s[0] == pytest.approx(latency, abs=1e-12)
    assert found.known_from_s[0, 2, 1] == pytest.approx(known_of_2_by_3, abs=1e-12)
    if "vehicle_2" in vehicles:
        assert found.known_from_s[0, 1, 2] == pytest.approx(1.0, abs=1e-12)  # of vehicle_3 it sees only


def test_equipage__of_types_is_drawn_with_them() -> None:
    kinds = {"equipped": {"weight": 7}, "without": {"weight": 3, "v2x": {"sends": False, "hears": "none"}}}
    sample = FIXED.replace(vehicle_types=kinds, v2x=FIXED_LINKS).sample(2000, 7)
    silent = sample.types == "without"
    latency = sample.worlds.vehicles.latency_s
    second = np.where(silent[:, 0] | silent[:, 1], 1.0, 0.3)
    third = np.where(silent[:, 0] | silent[:, 2], second + 1.0, 0.3)
    assert (latency[:, 1] == second).all() and np.abs(latency[:, 2] - third).max() < 1e-12


# Spread around what the load gives.


def lorries(spread: Any) -> Scenario:
    capacity = {"with_load": [7, 5], **({} if spread is None else {"spread": spread})}
    kinds = {"lorry": {"mass_t": {"with_load": [10, 40]}, "braking_capacity_mps2": capacity}}
    return Scenario(**without(FIXED, "mass_t", "braking_capacity_mps2"), vehicle_types=kinds)


def test_spread__is_added_to_what_the_load_gives() -> None:
    plain, wide = (lorries(spread).sample(3000, 7).worlds.vehicles for spread in (None, {"uniform": [-0.5, 0.5]}))
    by_load = 7 - 2 * (plain.mass_t - 10) / 30
    assert plain.braking_capacity_mps2 == pytest.approx(by_load, abs=1e-12)
    more = wide.braking_capacity_mps2 - by_load
    assert (wide.mass_t == plain.mass_t).all() and -0.5 <= more.min() < -0.49 and 0.49 < more.max() <= 0.5
    assert abs(np.corrcoef(wide.mass_t.ravel(), more.ravel())[0, 1]) < 0.02  # drawn apart from the load
    assert lorries({"uniform": [-0.5, 0.5]}).bounds("braking_capacity_mps2")[0] == (4.5, 7.5)
    names = lorries({"uniform": [-0.5, 0.5]}).ranges().names
    assert "braking_capacity_mps2 of vehicle_1" in names and "mass_t of vehicle_1" not in names


# The alert comes later.


def test_alert__everybody_goes_on_until_then() -> None:
    late = FIXED.replace(alert_s=2, speeds_mps=[20, 18, 20], latency_s=[0, 0.5, 0.8])
    assert late.sample(1, 7).worlds.vehicles.latency_s.tolist() == [[2.0, 2.5, 2.8]]
    now = late.replace(gaps_m=[40 + 2 * 2, 40 - 2 * 2])
    assert final(late).gaps_m == pytest.approx(final(Scenario(**without(now, "alert_s"))).gaps_m, abs=1e-9)
    drawn = FIXED.replace(alert_s={"uniform": [1, 5]})
    latency = drawn.sample(100, 7).worlds.vehicles.latency_s
    assert (latency == latency[:, :1]).all() and 1 <= latency.min() < 1.2 and 4.8 < latency.max() <= 5
    assert drawn.bounds("latency_s") == ((1.0, 5.0),) * 3 and drawn.ranges().names == ("alert_s",)
