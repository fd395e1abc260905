from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.scenario import Scenario, Uniform

GIVEN = {
    "name": "given",
    "gaps_m": {"uniform": [5, 10]},
    "speeds_mps": [20, 18, 20],
    "braking_capacity_mps2": [6, 7, 6],
    "driving_capacity_mps2": [6, 7, 6],
    "mass_t": [4.5, 5.5, 5.9],
    "latency_s": [0, 0.5, 0.8],
}


def build(**changes: object) -> Scenario:
    return Scenario(**{**GIVEN, **changes})


def test_defaults__are_the_labelled_ones():
    scenario = build()
    assert scenario.vehicles == 3
    assert scenario.time_step_s == 0.1
    assert scenario.horizon_s == 8.0
    assert scenario.speed_limit_mps == 40.0
    assert scenario.restitution == 0.1
    assert scenario.early_impacts == "keep"
    assert scenario.roles == {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "full_brake"}


@pytest.mark.parametrize(
    "change",
    [
        lambda roles: roles.__setitem__("vehicle_3", "learner"),
        lambda roles: roles.__delitem__("vehicle_3"),
        lambda roles: roles.__ior__({"vehicle_3": "learner"}),
        lambda roles: roles.update(vehicle_3="learner"),
        lambda roles: roles.setdefault("vehicle_4", "learner"),
        lambda roles: roles.pop("vehicle_3"),
        lambda roles: roles.popitem(),
        lambda roles: roles.clear(),
    ],
)
@pytest.mark.parametrize("given", [{}, {"roles": {"vehicle_2": "learner"}}])
def test_roles__cannot_be_changed(given: dict[str, Any], change: Callable[[Any], object]):
    scenario = build(**given)
    with pytest.raises(InvalidInput, match=r"roles of a scenario are frozen; use scenario.replace"):
        change(scenario.roles)
    assert scenario.learners == (1,)


def test_roles__survive_copies():
    scenario = build()
    for again in (copy.deepcopy(scenario), pickle.loads(pickle.dumps(scenario)), scenario.replace(title="Mine")):
        assert again.roles == scenario.roles
        with pytest.raises(InvalidInput, match="frozen"):
            again.roles["vehicle_3"] = "learner"
    assert type(scenario.model_dump()["roles"]) is dict


def test_python__arguments_raise_the_same_errors():
    with pytest.raises(InvalidInput, match=r"scenario 'bad': gaps_km: .* gaps_m \(metres\)\? \(and 4 more\)$"):
        Scenario(name="bad", gaps_km=7)
    with pytest.raises(InvalidInput, match=r"^scenario 'given': mass_t\[0\] \(vehicle_1\) = -1: "):
        build(mass_t=[-1, 2, 3])
    with pytest.raises(InvalidInput, match=r"gaps_m = \.nan"):
        build(gaps_m=float("nan"))
    with pytest.raises(InvalidInput, match="gaps_m = true"):
        build(gaps_m=True)
    with pytest.raises(InvalidInput, match="unknown key"):
        build(latency=0.1)


def test_scenario__is_frozen():
    with pytest.raises(ValidationError, match="frozen"):
        build().vehicles = 4


def test_quantities__one_entry_stands_for_all():
    scenario = build(mass_t=5, gaps_m=[7, {"uniform": [5, 10]}])
    assert scenario.quantities("mass_t") == (5.0, 5.0, 5.0)
    assert scenario.quantities("gaps_m") == (7.0, Uniform(uniform=(5.0, 10.0)))
    assert scenario.quantities("restitution") == (0.1,)


def test_roles__left_out_of_a_mapping_brake_fully():
    scenario = build(roles={"vehicle_3": "learner"})
    assert scenario.roles == {"vehicle_1": "full_brake", "vehicle_2": "full_brake", "vehicle_3": "learner"}
    assert scenario.learners == (2,)
    assert scenario.scripts == {0: "full_brake", 1: "full_brake"}


def test_replace__changes_one_field_and_checks_again():
    scenario = build().replace(latency_s=[0, 0.2, 0.8])
    assert scenario.latency_s == (0.0, 0.2, 0.8)
    assert scenario.mass_t == build().mass_t
    assert build().latency_s == (0.0, 0.5, 0.8)
    assert build(speeds_mps=np.array([20, 18, 20]), restitution=np.float64(0.3)).speeds_mps == (20.0, 18.0, 20.0)
    with pytest.raises(InvalidInput, match=r"latency_s\[1\] \(vehicle_2\) = 9"):
        build().replace(latency_s=[0, 9, 0.8])


def test_replace__another_number_of_vehicles_when_every_entry_stands_for_all():
    same = {key: 5 for key in ("speeds_mps", "braking_capacity_mps2", "driving_capacity_mps2", "mass_t")}
    scenario = Scenario(name="any", gaps_m=7, latency_s=0.1, **same)
    assert scenario.replace(vehicles=5).sample(1, 0).worlds.N == 5
    assert scenario.replace(vehicles=5).learners == (1,)
    assert scenario.replace(vehicles=2).roles == {"vehicle_1": "full_brake", "vehicle_2": "learner"}
    with pytest.raises(InvalidInput, match=r"latency_s: has 3 entries; 5 vehicles need 5 .*"):
        scenario.replace(vehicles=5, latency_s=[0, 1, 2])


@pytest.mark.parametrize("learners", [["vehicle_2", "vehicle_3"], [1, 2], (np.int64(2), "vehicle_2")])
def test_learners__by_name_or_index(learners):
    scenario = build(roles={"vehicle_1": "constant:3", "vehicle_2": "learner"}).with_learners(learners)
    assert scenario.learners == (1, 2)
    assert scenario.roles == {"vehicle_1": "constant:3", "vehicle_2": "learner", "vehicle_3": "learner"}


def test_learners__not_listed_brake_fully():
    scenario = build().with_learners(["vehicle_3"])
    assert scenario.roles == {"vehicle_1": "full_brake", "vehicle_2": "full_brake", "vehicle_3": "learner"}
    assert build(early_impacts="keep").with_learners([]).learners == ()


@pytest.mark.parametrize(
    ("learners", "reason"),
    [
        (["vehicle_4"], "did you mean 'vehicle_"),
        (["Bob"], "unknown vehicle 'Bob'; known: vehicle_1, vehicle_2, vehicle_3"),
        ([3], "index from 0 to 2"),
        ([-1], "index from 0 to 2"),
        ([True], "index from 0 to 2"),
        ([1.0], "index from 0 to 2"),
        (["vehicle_2", 1], "vehicle_2 is listed twice"),
        ("vehicle_2", "must be a list of vehicles"),
    ],
)
def test_learners__unknown_or_repeated_are_errors(learners, reason):
    with pytest.raises(InvalidInput, match=reason):
        build().with_learners(learners)
    with pytest.raises(UnknownName):
        build().with_learners(["Bob"])


def test_declared__builds_the_same_scenario():
    scenario = build(mass_t={"choice": [4, 5], "weights": [1, 2]})
    assert Scenario(**scenario.declared()) == scenario
    assert scenario.declared()["gaps_m"] == {"uniform": [5.0, 10.0]}


def test_scenario__survives_pickling():
    scenario = build()
    assert pickle.loads(pickle.dumps(scenario)) == scenario
