"""Estimated worlds where messages lack pieces (``v2x: tells``): the scenario's ranges take their place."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.received import Received
from ethbrake_marl.first_edition.physics.messages import PIECES, USUAL_PIECES
from tests.extensions.certified.estimates import ABOVE, WAYS, shielded
from tests.extensions.certified.test_knowledge import BASE, engine_of, estimated
from tests.first_edition.agents.test_knowledge import agent_of, changed_decisions

LACKING = {
    "capacity and mass": ["place", "speed", "acceleration", "latency"],
    "latency and acceleration": ["place", "speed", "braking_capacity", "mass"],
    "place": ["speed", "acceleration", "braking_capacity", "latency", "mass"],
    "everything": [],
}
CORNERS = BASE.replace(  # nine numbers are open, each one of two: every world is a corner of what nobody may tell
    gaps_m=[{"choice": [5.13, 9.71]}, {"choice": [5.37, 9.58]}],
    speeds_mps=[{"choice": [18.23, 21.87]}, 20.3, {"choice": [18.41, 22.19]}],
    braking_capacity_mps2=[{"choice": [5.13, 7.21]}, 7.0, {"choice": [5.41, 8.23]}],
    latency_s=[0.0, 0.5, {"choice": [0.61, 0.93]}],
    mass_t=[4.5, 5.5, {"choice": [3.0, 9.0]}],
)


def telling(pieces: object, base: eb.Scenario = BASE, **channel: object) -> eb.Scenario:
    return base.replace(v2x={**channel, "tells": pieces})


def test_estimated__of_a_missing_piece_is_the_middle_of_its_range() -> None:
    base = BASE.replace(mass_t=[4.5, 5.5, {"uniform": [2.0, 9.0]}], braking_capacity_mps2={"uniform": [6, 8]})
    pieces = {"vehicle_1": ["place", "speed", "mass"], "vehicle_3": ["place", "speed", "braking_capacity"]}
    engine = engine_of(telling(pieces, base))
    now, taken = engine.worlds, estimated(engine)
    assert taken.gaps_m == pytest.approx(now.gaps_m, abs=1e-9) and taken.speeds_mps == pytest.approx(now.speeds_mps)
    v, own = taken.vehicles, now.vehicles
    assert v.mass_t[:, :2].tolist() == own.mass_t[:, :2].tolist() and (v.mass_t[:, 2] == 5.5).all()
    assert (v.braking_capacity_mps2[:, 0] == 7.0).all()
    assert v.braking_capacity_mps2[:, 1:].tolist() == own.braking_capacity_mps2[:, 1:].tolist()
    engine = engine_of(telling({"vehicle_3": ["place", "mass"]}, base))  # without its speed its place is of no use
    now, taken, told = engine.worlds, estimated(engine), Received.by(engine.worlds, 1)
    assert not told.known[:, 2].any() and told.known[:, :2].all() and told.pieces[:, 2].sum(axis=1).max() == 2
    assert (taken.gaps_m[:, 1] != now.gaps_m[:, 1]).all() and taken.vehicles.mass_t[:, 2].tolist() == (
        own.mass_t[:, 2].tolist()
    )


@pytest.mark.parametrize("spec", ["e_v2x_bm:estimated", "coast+step:estimated", "ppo+episode:estimated"])
def test_estimated__messages_that_contain_everything_change_nothing(spec: str) -> None:
    harms = []
    for scenario in (BASE, telling([*USUAL_PIECES]), telling([*PIECES])):
        episodes = drive(scenario.sample(12, 7).worlds, make_agent(spec, scenario=scenario), scenario, 1)
        harms.append(episodes.ledger.world_harm("total").tolist())
    assert harms[0] == pytest.approx(harms[1], abs=1e-6) and harms[1] == harms[2]


@pytest.mark.parametrize("without", USUAL_PIECES)
@pytest.mark.parametrize("spec", ["e_v2x_bm:estimated", "coast+step:estimated"])
@pytest.mark.parametrize("channel", [{}, {"preset": "blocked", "persistence": "periodic"}], ids=str)
def test_estimated__what_no_message_contains_changes_no_action(spec: str, without: str, channel: dict) -> None:
    scenario = telling([piece for piece in USUAL_PIECES if piece != without], **channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=10) == 0


@pytest.mark.parametrize("lacking", LACKING)
@pytest.mark.parametrize("way", WAYS)
def test_robust__at_the_corners_no_world_is_above_the_first_bound(lacking: str, way: str) -> None:
    harm, bound, replaced = shielded(way, telling(LACKING[lacking], CORNERS), 6, 7)
    assert (harm <= bound + ABOVE).all() and np.isfinite(bound).all() and replaced > 4


def test_step__in_the_middle_promises_nothing_where_a_piece_is_missing() -> None:
    harm, bound, _ = shielded("coast", telling(LACKING["everything"], CORNERS), 30, 7, robust=False)
    assert (harm > bound + 1.0).any()


def test_field__a_controller_refuses_to_do_without_what_it_reads() -> None:
    for without in ("place", "speed", "acceleration"):
        lacking = telling([piece for piece in USUAL_PIECES if piece != without])
        with pytest.raises(InvalidInput, match=f"agent 'acc': messages of vehicle_1 do not contain its {without}"):
            drive(lacking.sample(2, 7).worlds, make_agent("acc", scenario=lacking), lacking, 1)
    sees = {"link_latency_s": 0.3, "senses": "front", "sensing_s": [0.0, 0.0]}
    harms = [
        drive(each.sample(5, 7).worlds, make_agent("acc", scenario=each), each, 1).ledger.world_harm("total").tolist()
        for each in (telling([], **sees), telling([*USUAL_PIECES], **sees))
    ]
    assert harms[0] == harms[1]
