"""Intervals, their written form, and the members that stand for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.physics import make_worlds
from ethbrake_marl.shield.guard import checked_uncertainty
from ethbrake_marl.shield.uncertainty import MOST_CORNERS, Interval, Uncertainty, parse_uncertainty


def line(n=2):
    return make_worlds(
        np.tile([[10.0, 8.0]], (n, 1)), np.tile([[20.0, 18.0, 39.9]], (n, 1)), braking_capacity_mps2=[8.0, 6.0, 5.0],
        driving_capacity_mps2=2.0, latency_s=[0.0, 0.4, 0.7], mass_t=[1.0, 2.0, 4.0], restitution=0.1,
    )  # fmt: skip


def test_parse__reads_what_str_writes():
    text = "braking_capacity_mps2=5%,latency_s.vehicle_2=0.1,gaps_m.pair_1=0.5"
    found = parse_uncertainty(text)
    assert found.intervals == (
        Interval("braking_capacity_mps2", 0.05, relative=True),
        Interval("latency_s", 0.1, place=1),
        Interval("gaps_m", 0.5, place=0),
    )
    assert str(found) == text and parse_uncertainty(str(found)) == found
    assert str(found.scaled(2.0)) == "braking_capacity_mps2=10%,latency_s.vehicle_2=0.2,gaps_m.pair_1=1"


def test_parse__blanks_change_nothing():
    assert parse_uncertainty(" latency_s = 0.1 ,gaps_m= 5% ") == parse_uncertainty("latency_s=0.1,gaps_m=5%")


def test_members__are_the_world_itself_and_every_corner():
    worlds = line()
    members = parse_uncertainty("gaps_m.pair_1=0.5,mass_t.vehicle_3=10%").members(worlds)
    assert members.n == 2 * (1 + 4)
    for first in (0, 5):
        rows = slice(first, first + 5)
        assert members.gaps_m[rows, 0].tolist() == [10.0, 9.5, 10.5, 9.5, 10.5]
        assert members.vehicles.mass_t[rows, 2] == pytest.approx([4.0, 3.6, 3.6, 4.4, 4.4], abs=1e-12)
        assert (members.gaps_m[rows, 1] == 8.0).all() and (members.vehicles.latency_s[rows, 1] == 0.4).all()
    assert worlds.gaps_m[0, 0] == 10.0


def test_members__of_every_vehicle_where_none_is_named():
    assert parse_uncertainty("latency_s=0.1").members(line(1)).n == 1 + 2**3
    assert parse_uncertainty("latency_s=0.1,gaps_m=1").members(line(1)).n == 1 + 2**5


def test_members__stay_within_what_is_possible():
    members = parse_uncertainty("latency_s.vehicle_1=0.1,speeds_mps.vehicle_3=5").members(line(1))
    assert members.vehicles.latency_s[:, 0].tolist() == [0.0, 0.0, 0.1, 0.0, 0.1]
    assert members.speeds_mps[:, 2] == pytest.approx([39.9, 34.9, 34.9, 40.0, 40.0])


def test_members__no_width_leaves_the_world_alone():
    worlds = line()
    members = parse_uncertainty("latency_s=0,gaps_m=0%").members(worlds)
    assert members.n == worlds.n and members.gaps_m.tolist() == worlds.gaps_m.tolist()


def test_draw__is_inside_the_box_or_at_a_corner():
    worlds, uncertainty = line(50), parse_uncertainty("gaps_m=0.5,speeds_mps.vehicle_1=2")
    inside = uncertainty.draw(worlds, np.random.default_rng(0))
    assert (abs(inside.gaps_m - worlds.gaps_m) < 0.5).all() and len(set(inside.gaps_m[:, 0])) == 50
    corners = uncertainty.draw(worlds, np.random.default_rng(0), corners=True)
    assert set(corners.gaps_m[:, 1]) == {7.5, 8.5} and set(corners.speeds_mps[:, 0]) == {18.0, 22.0}
    members = uncertainty.members(worlds.take([0]))
    every = {tuple(row) for row in np.hstack([members.gaps_m, members.speeds_mps])}
    assert {tuple(row) for row in np.hstack([corners.gaps_m, corners.speeds_mps])} <= every


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "entry 1 is empty; it must be quantity=half-width"),
        ("latency_s", "must be quantity=half-width"),
        ("latency_s=", "must be quantity=half-width"),
        ("latency_s=-0.1", "must be quantity=half-width"),
        ("latency_s=nan", "must be quantity=half-width"),
        ("latency_s=1e999", "half-width inf"),
        ("latency_s=0.1;gaps_m=1", "must be quantity=half-width"),
        ("latency_s=0.1,", "entry 2 is empty; it must be quantity=half-width"),
        ("latency_s=٣", "must be quantity=half-width"),
        ("latency_s.vehicle_1٣=1", "must be quantity=half-width"),
        ("latency_s=100%", "below 100 %"),
        ("latency_s.vehicle_0=0.1", "must be quantity=half-width"),
        ("latency_s.pair_1=0.1", "gaps_m is of pairs"),
        ("gaps_m.vehicle_1=0.1", "gaps_m is of pairs"),
        ("latency_s=0.1,latency_s=0.2", "speak of the same quantity"),
        ("latency_s=0.1,latency_s.vehicle_2=0.2", "speak of the same quantity"),
    ],
)
def test_parse__refuses_in_one_line(text, message):
    with pytest.raises(InvalidInput, match=message) as error:
        parse_uncertainty(text)
    assert "\n" not in str(error.value)


def test_parse__an_unknown_quantity_gets_a_suggestion():
    with pytest.raises(UnknownName, match="latency_s"):
        parse_uncertainty("latencys=0.1")


def test_refused__what_the_worlds_do_not_allow():
    with pytest.raises(InvalidInput, match="the line has only 3"):
        parse_uncertainty("mass_t.vehicle_4=0.1").members(line())
    with pytest.raises(InvalidInput, match="the line has only 2"):
        parse_uncertainty("gaps_m.pair_3=0.1").members(line())
    with pytest.raises(InvalidInput, match="vehicle_1 in world 0 may be as low as 0; it must stay above 0"):
        parse_uncertainty("mass_t=1").members(line())
    for text, message in (
        ("gaps_m=1e308", r"10 of vehicle_1 to vehicle_2 in world 0 may be as high as 1e\+308; .* in \[0, 10000\] m"),
        ("driving_capacity_mps2=99", r"2 of vehicle_1 in world 0 may be as high as 101; .* in \[0, 100\] m/s2"),
    ):
        with pytest.raises(InvalidInput, match=message):
            parse_uncertainty(text).members(line())
    with pytest.raises(
        InvalidInput, match=f"11 uncertain numbers in each world make 2048 corners; at most {MOST_CORNERS}"
    ):
        parse_uncertainty("latency_s=0.1,mass_t=0.1,speeds_mps=1,gaps_m=1").members(line())


def test_python_form__is_checked_too():
    with pytest.raises(InvalidInput, match="no interval"):
        Uncertainty(())
    with pytest.raises(InvalidInput, match="half-width -1"):
        Interval("latency_s", -1.0)
    for half_width in ("0.5", None, True, float("nan")):
        with pytest.raises(InvalidInput, match="must be a number, at least 0"):
            Interval("gaps_m", half_width)
    for place in (0.5, "1", -1):
        with pytest.raises(InvalidInput, match="must be an index from 0"):
            Interval("gaps_m", 0.5, place=place)
    for intervals in ("gaps_m=0.5", ["gaps_m=0.5"], ("gaps_m=0.5",)):
        with pytest.raises(InvalidInput, match="must be a tuple of Interval"):
            Uncertainty(intervals)
    with pytest.raises(InvalidInput, match="must be an Uncertainty or text"):
        checked_uncertainty(0.1)
    assert checked_uncertainty(None) is None


def test_draw__without_a_channel_own_part_and_news_go_with_the_latency():
    drawn = parse_uncertainty("latency_s=0.1").draw(line(), np.random.default_rng(3)).vehicles
    assert (drawn.latency_s != line().vehicles.latency_s).all() and drawn.is_known_at_once


def test_draw__over_a_channel_only_the_reaction_is_uncertain():
    vehicles = line().vehicles
    news = vehicles.known_from_s + 0.5
    worlds = replace(line(), vehicles=replace(vehicles, known_from_s=news))
    drawn = parse_uncertainty("latency_s=0.1").draw(worlds, np.random.default_rng(3)).vehicles
    assert drawn.known_from_s.tolist() == news.tolist()
    assert drawn.own_latency_s.tolist() == vehicles.own_latency_s.tolist()
