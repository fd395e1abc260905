"""Types of vehicles: drawn first, then their quantities together; checked like everything else in a scenario."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from scipy import stats

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import scenario_sha256, worlds_sha256
from ethbrake_marl.scenario import Scenario, load_scenario, parse_yaml, shipped_folder
from ethbrake_marl.scenario.sampling import QUANTITY, uniform_numbers

MIXED = load_scenario("realistic-mixed")
N = 20_000
KINDS = {
    "car": {"weight": 3, "mass_t": {"uniform": [1, 2]}, "braking_capacity_mps2": {"normal": {
        "mean": 8, "sd": 1, "low": 6, "high": 10}}},
    "truck": {"mass_t": {"with_load": [14, 40]}, "braking_capacity_mps2": {"with_load": [7, 4]}},
}  # fmt: skip


def line(**given: Any) -> Scenario:
    rest = {"gaps_m": 30, "speeds_mps": 20, "driving_capacity_mps2": 3, "latency_s": 0.2}
    return Scenario(**{"name": "typed", **rest, "vehicle_types": KINDS, **given})


def test_types__stand_as_often_as_their_weights_say():
    sample = MIXED.sample(N, 7)
    assert sample.types is not None
    for vehicle in range(3):
        seen = [int((sample.types[:, vehicle] == name).sum()) for name in ("car", "van", "truck")]
        assert stats.chisquare(seen, np.array([0.7, 0.1, 0.2]) * N).pvalue > 0.001
    pairs = np.char.add(sample.types[:, 0], sample.types[:, 1])
    table = [[int((pairs == a + b).sum()) for b in ("car", "van", "truck")] for a in ("car", "van", "truck")]
    assert stats.chi2_contingency(table).pvalue > 0.001  # vehicles have their types independently


def test_quantities__follow_the_distribution_of_their_type():
    sample = line().sample(N, 3)
    assert sample.types is not None
    car, truck = (sample.types == name for name in ("car", "truck"))
    mass, braking = (QUANTITY.declared[key].of(sample.worlds) for key in ("mass_t", "braking_capacity_mps2"))
    shape = stats.truncnorm(-2, 2, loc=8, scale=1)
    assert stats.kstest(mass[car], stats.uniform(1, 1).cdf).pvalue > 0.001
    assert stats.kstest(braking[car], shape.cdf).pvalue > 0.001
    assert stats.kstest(mass[truck], stats.uniform(14, 26).cdf).pvalue > 0.001
    assert abs(stats.pearsonr(mass[car], braking[car]).statistic) < 0.02  # a car's are drawn apart


def test_with_load__moves_a_vehicles_quantities_together():
    sample = line().sample(2_000, 3)
    truck = sample.types == "truck"
    mass, braking = (QUANTITY.declared[key].of(sample.worlds)[truck] for key in ("mass_t", "braking_capacity_mps2"))
    load = (mass - 14.0) / 26.0
    np.testing.assert_allclose(braking, 7.0 - 3.0 * load, rtol=1e-12)
    assert 0.0 <= load.min() < 0.01 < 0.99 < load.max() <= 1.0


def test_load__may_be_declared():
    kinds = {"van": {"mass_t": {"with_load": [2, 4]}, "braking_capacity_mps2": 6, "load": {"choice": [0, 0.5]}}}
    masses = line(vehicle_types=kinds).sample(1_000, 1).worlds.vehicles.mass_t
    assert set(np.unique(masses)) == {2.0, 3.0}


def test_types__of_each_place():
    scenario = line(types=["truck", {"car": 1, "truck": 9}, "any"])
    types = scenario.sample(N, 1).types
    assert types is not None
    assert set(types[:, 0]) == {"truck"}
    counts = [int((types[:, i] == "truck").sum()) for i in (1, 2)]
    assert stats.binomtest(counts[0], N, 0.9).pvalue > 0.001
    assert stats.binomtest(counts[1], N, 0.25).pvalue > 0.001
    assert scenario.bounds("mass_t") == ((14.0, 40.0), (1.0, 40.0), (1.0, 40.0))
    assert set(line(types="truck").sample(50, 1).types.ravel()) == {"truck"}  # type: ignore[union-attr]


def test_what_a_type_leaves_out__is_as_beside_the_types():
    plain, typed = line(vehicle_types=only_brakes(), mass_t=[1, 2, 3]), line()
    assert plain.sample(5, 7).worlds.vehicles.mass_t.tolist() == [[1.0, 2.0, 3.0]] * 5
    assert (typed.sample(5, 7).worlds.vehicles.latency_s == 0.2).all()


def only_brakes() -> dict[str, Any]:
    return {"car": {"braking_capacity_mps2": 7}}


def test_types__leave_all_other_draws_alone():
    given = {"name": "plain", "gaps_m": {"uniform": [5, 50]}, "speeds_mps": {"uniform": [10, 20]}, "latency_s": 0.2}
    given |= {"driving_capacity_mps2": {"uniform": [1, 3]}, "mass_t": 2, "braking_capacity_mps2": {"uniform": [5, 9]}}
    plain = Scenario(**given)
    typed = Scenario(**{**given, "vehicle_types": {"car": {}, "bus": {"mass_t": 12}}})
    one, other = plain.sample(500, 7).worlds, typed.sample(500, 7).worlds
    for key in ("gaps_m", "speeds_mps", "braking_capacity_mps2", "driving_capacity_mps2"):
        assert (QUANTITY.declared[key].of(one) == QUANTITY.declared[key].of(other)).all()
    assert set(np.unique(other.vehicles.mass_t)) == {2.0, 12.0}


def test_worlds__are_the_same_alone_and_in_any_list():
    whole = MIXED.sample(50, 7)
    assert whole.types is not None
    for first in (0, 17, 49):
        part = MIXED.sample(1, 7, first=first)
        assert part.types is not None
        assert (part.types == whole.types[[first]]).all()
        assert worlds_sha256(part.worlds, part.index) == worlds_sha256(whole.worlds.take([first]), part.index)
    other, training = MIXED.sample(50, 8), MIXED.sample(50, 7, channel="training")
    assert (other.types != whole.types).any()
    assert (training.types != whole.types).any()


def test_types__of_refused_worlds_are_drawn_again():
    near = line(gaps_m={"uniform": [0.1, 4]}, speeds_mps=[15, 20, 20], latency_s=[0, 0.5, 0.8], early_impacts="reject")
    sample = near.sample(300, 7)
    assert sample.rejected > 0
    assert (sample.index == np.arange(300)).all()
    heavy = QUANTITY.declared["mass_t"].of(sample.worlds) >= 14.0
    assert (heavy == (sample.types == "truck")).all()


def test_type__is_the_first_number_of_its_own_stream():
    u = uniform_numbers(7, "list", 0, 0, 100, 12, of=(3,)).reshape(100, 3, 4)
    assert (line().sample(100, 7).types == np.where(u[..., 0] < 0.75, "car", "truck")).all()


def test_scenario__copies_and_is_told_by_its_hash():
    scenario = line(types=["truck", "any", {"car": 2}])
    for again in (copy.deepcopy(scenario), pickle.loads(pickle.dumps(scenario)), Scenario(**scenario.declared())):
        assert again == scenario
    assert scenario_sha256(scenario) != scenario_sha256(line())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("vehicle_types: {car: {mass_tt: 3}}", "line 33: vehicle_types.car.mass_tt: unknown key; did you mean mass_t"),
        ("vehicle_types: {car: {mass_t: -3}}", "line 33: vehicle_types.car.mass_t = -3: must be finite and in (0, 100"),
        ("vehicle_types: {any: {}}", "line 33: vehicle_types.any: any stands for every type; give another name"),
        ("vehicle_types: {}", "line 33: vehicle_types = {}: must not be empty"),
        ("vehicle_types: null", "line 33: vehicle_types = null: must not be empty; a key that is not used is left out"),
        ("vehicle_types: {car: {mass_t: null}}", "vehicle_types.car.mass_t = null: must be a number or a distribution"),
        ("vehicle_types: {car: {load: 2}}", "line 33: vehicle_types.car.load = 2: must be in [0, 1]: 0 empty, 1 full"),
        ("vehicle_types: {car: {weight: 0}}", "line 33: vehicle_types.car.weight = 0: must be greater than 0"),
        ("vehicle_types: {car: {latency_s: 3}}", "line 19: latency_s = [0, 0.5, 0.8]: every type declares it"),
        ("types: car", "line 33: types = car: needs vehicle_types, which says what the types are"),
        ("vehicle_types: {car: {}}\ntypes: [car, car]", "line 34: types: has 2 entries; 3 vehicles need 3, or one for"),
        ("vehicle_types: {car: {}}\ntypes: [car, cra, car]", "line 34: types[1] = cra: unknown type cra; did you mean"),
        ("vehicle_types: {car: {}}\ntypes: {}", "line 34: types = {}: must not be empty"),
        (
            "vehicle_types: {car: {}, bus: {speed_limit_mps: 20}}",
            "speeds_mps = {uniform: [18, 22]}: must not be above speed_limit_mps of vehicle_1, 20 m/s",
        ),
        ("vehicle_types: {a: {}, b: {latency_s: 8}}", "line 33: vehicle_types.b.latency_s = 8: must be below"),
    ],
)  # fmt: skip
def test_bad_types__are_one_error_with_its_line(given: str, message: str):
    text = (shipped_folder() / "paper" / "paper-random.yaml").read_text()
    with pytest.raises(InvalidInput) as caught:
        Scenario.from_document(parse_yaml(f"{text}\n{given}\n", "my.yaml"))
    assert message in str(caught.value), str(caught.value)


def test_a_quantity_that_some_type_lacks__must_stand_beside_the_types():
    with pytest.raises(InvalidInput, match="mass_t: type bus does not declare it: give it there, or here"):
        line(vehicle_types={**KINDS, "bus": {"braking_capacity_mps2": 5}})


def test_with_load__is_of_types_only():
    with pytest.raises(InvalidInput, match=r"mass_t = .*must be a number, "):
        load_scenario("paper-random").replace(mass_t={"with_load": [1, 2]})


def test_constant_scripts__are_within_the_capacity_of_every_type():
    roles = {"vehicle_1": "constant:5", "vehicle_2": "learner"}
    with pytest.raises(InvalidInput, match="above this vehicle's braking_capacity_mps2, 4 m/s2"):
        line(roles=roles)
    assert line(roles=roles, types=["car", "any", "any"]).scripts[0] == "constant:5"


def test_results__tell_the_type_and_can_be_grouped():
    sample = MIXED.sample(200, 7)
    found = eb.evaluate(sample, {"full_brake": eb.make_agent("full_brake")}, scenario=MIXED, seed=7)
    columns = found.to_frame("columns")
    assert sample.types is not None
    assert columns["vehicle_3_type"].tolist() == sample.types[:, 2].tolist()
    groups = eb.summarise_by(found, "vehicle_3_type")
    assert list(groups) == ["car", "truck", "van"]
    assert sum(rows[0].episodes for rows in groups.values()) == 200
    assert sum(rows[0].collisions for rows in groups.values()) == eb.summarise(found)[0].collisions
    with pytest.raises(InvalidInput, match="did you mean 'vehicle_3_type'"):
        eb.summarise_by(found, "vehicle_3_typ")
