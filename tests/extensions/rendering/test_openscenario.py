"""An emergency as OpenSCENARIO, read back: the record's gaps, a vertex at each impact, and what stands on the road.

ASAM's own schema and checker read such files in ``make programme NAME=field``.
"""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.rendering.openscenario import LENGTH_M, TO_FRONT_M, to_openscenario
from tests.fixtures.commands import Command, check_refused

CASES = {
    "paper-random": "full_brake",
    "paper-random-obstacle": "ppo",
    "cooperation-2-five": "full_brake",
    "realistic-truck-buildup": "coast",
}


def trajectories(root: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    """Times [k], and places of the rear axles [k, N]."""
    read = [
        [(float(vertex.get("time")), float(vertex.find("Position/WorldPosition").get("x"))) for vertex in line]
        for line in root.iter("Polyline")
    ]
    times, places = np.moveaxis(np.array(read), 2, 0)
    assert (times == times[0]).all()
    return times[0], places.T


@pytest.mark.parametrize("scenario", CASES)
def test_file__read_back__has_the_gaps_of_the_record_and_a_vertex_at_each_impact(scenario: str) -> None:
    record = eb.record_episode(scenario, CASES[scenario], number=1)
    text, road = to_openscenario(record, "line.xodr")
    root = ElementTree.fromstring(text)
    times, places = trajectories(root)
    assert (np.diff(times) > 0.0).all() and times[0] == 0.0 and times[-1] == record.time_s[-1]
    gaps = places[:, :-1] - places[:, 1:] - LENGTH_M
    assert np.abs(gaps[np.isin(times, record.time_s)] - record.gaps_m).max() < 1e-9
    assert len(record.impacts.time_s) > 0
    impacts = (record.impacts.time_s, record.impacts.pair, record.impacts.closing_speed_mps)
    for time, pair, closing in zip(*(column.tolist() for column in impacts), strict=True):
        if pair > 0:
            assert abs(gaps[times == time][0, pair - 1]) < 1e-9
            for body in (pair, pair + 1):
                (vehicle,) = (each for each in root.iter("Vehicle") if each.get("name") == f"vehicle_{body}")
                named = {each.get("name"): each.get("value") for each in vehicle.iter("Property")}
                assert named[f"impact of pair {pair} at {time!r} s"] == f"{closing!r} m/s"
    moved = places - places[0]
    assert np.abs(moved[np.isin(times, record.time_s)] - (record.positions_m - record.positions_m[0])).max() < 1e-9
    length = float(ElementTree.fromstring(road).find("road").get("length"))
    assert places.min() > LENGTH_M and places.max() < length - LENGTH_M
    starts = [float(place.get("x")) for place in root.find("Storyboard/Init").iter("WorldPosition")]
    assert starts[: places.shape[1]] == places[0].tolist()
    if np.isfinite(record.initial.obstacle_gap_m[0]):
        assert starts[-1] - starts[0] == pytest.approx(record.initial.obstacle_gap_m[0] + TO_FRONT_M, abs=1e-9)


def test_watch__writes_the_scenario_and_its_road(ethbrake: Command, empty_folder: Path) -> None:
    words: Any = ("watch", "--agents", "full_brake", "--world", "1", "--output", "new.xosc")
    assert ethbrake(*words).status == 0
    root = ElementTree.parse("new.xosc").getroot()
    assert root.find("RoadNetwork/LogicFile").get("filepath") == "new.xodr" and Path("new.xodr").is_file()
    assert root.find("FileHeader").get("description") == "paper-random, full_brake"
    check_refused(ethbrake(*words), "already exists")
    Path("new.xosc").unlink()
    check_refused(ethbrake(*words), "new.xodr")  # the road of another scenario stays
    check_refused(
        ethbrake("watch", "--agents", "full_brake,coast", "--output", "two.xosc"),
        "--output two.xosc: holds the motion under one agent; --agents names 2",
    )
