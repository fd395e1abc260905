"""What a message contains (``v2x: tells``), and therefore what each vehicle believes; numbers by hand."""

import numpy as np
import pytest

from ethbrake_marl.extensions.messages.belief import belief_of, known_pieces
from ethbrake_marl.extensions.messages.links import PIECES
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    DRIVING,
    FORCE,
    GAP,
    LATENCY,
    MASS,
    OWN_LATENCY,
    RELEASE_RATE,
    SPEED,
)
from tests.extensions.messages.line import LINE, played, seen_by, stepped

SEEN = ["own", "front_1", "rear_1", "front_1.intent", "rear_1.intent"]
BLOCK = ("known", "gap", "closing_speed", "acceleration", "braking_capacity", "mass", "latency_left", "hit",
         "stopping_margin", "fitting_deceleration")  # fmt: skip
FRONT = {  # what Vehicle 2 sees of Vehicle 1 after 0.5 s, of which Vehicle 1 has braked with 6 m/s2
    "known": 1.0, "gap": (8 + 9.25 - 9) / 10, "closing_speed": (18 - 17) / 10, "acceleration": -0.6,
    "braking_capacity": 0.6, "mass": 0.45, "latency_left": 0.0, "hit": 0.0,
    "stopping_margin": (8.25 + 17**2 / 12 - 18**2 / 14) / 10,
    "fitting_deceleration": 18**2 / (2 * (8.25 + 17**2 / 12)) / 10,
}  # fmt: skip
REAR = {  # and of Vehicle 3, which may not act before 1 s
    "known": 1.0, "gap": (6 + 9 - 11) / 10, "closing_speed": (22 - 18) / 10, "acceleration": 0.0,
    "braking_capacity": 0.5, "mass": 0.59, "latency_left": 0.5, "hit": 0.0,
    "stopping_margin": (4 + 18**2 / 14 - (22 * 0.5 + 22**2 / 10)) / 10,
    "fitting_deceleration": 18**2 / (2 * (22 * 0.5 + 22**2 / 10 - 4)) / 10,
}  # fmt: skip


def only(block: dict[str, float], *features: str) -> dict[str, float]:
    return {name: value if name in features else 0.0 for name, value in block.items()}


def check(seen: dict[str, float], side: str, block: dict[str, float]) -> None:
    assert {name: seen[f"{side}.{name}"] for name in block} == pytest.approx(block, abs=1e-6)


def test_place_and_speed_alone() -> None:
    each = [f"{side}.{piece}_known" for side in ("front_1", "rear_1") for piece in PIECES]
    game, state = played({"tells": ["speed", "place"]}, [*SEEN, *each, "front_1.build_up_time"])
    seen = seen_by(game, state, 2)
    check(seen, "front_1", only(FRONT, "known", "gap", "closing_speed"))
    check(seen, "rear_1", only(REAR, "known", "gap", "closing_speed"))
    assert [seen[name] for name in each] == 2 * [1.0, 1.0, *(6 * [0.0])]
    assert seen["own.braking_capacity"] == pytest.approx(0.7)
    assert (seen["rear_1.intent"], seen["front_1.build_up_time"]) == (0.0, 0.0)


@pytest.mark.parametrize("missing", ["place", "speed", "braking_capacity", "latency"])
def test_stopping__needs_four_pieces(missing: str) -> None:
    pieces = [piece for piece in ("place", "speed", "braking_capacity", "latency") if piece != missing]
    game, state = played({"tells": {"vehicle_3": pieces}})
    seen = seen_by(game, state, 2)
    assert seen["rear_1.stopping_margin"] == seen["rear_1.fitting_deceleration"] == 0.0
    check(seen, "front_1", FRONT)


def test_each_vehicle_tells_something_else() -> None:
    tells = {"vehicle_1": ["speed", "braking_capacity", "latency"], "vehicle_2": ["intent"], "vehicle_3": [*PIECES]}
    game, state = played({"tells": tells}, SEEN)
    seen = seen_by(game, state, 2)
    check(seen, "front_1", only(FRONT, "known", "closing_speed", "braking_capacity"))
    check(seen, "rear_1", REAR)
    # Vehicle 3 chose full braking at the alert; it is not in force before 1 s. Vehicle 1 does not tell its own.
    assert (seen["rear_1.intent"], seen["front_1.intent"]) == (pytest.approx(-0.5), 0.0)
    intents = []
    for action in (-0.5, 1.0, 0.0):  # of the capacities 7 and 3 m/s2
        seen = seen_by(game, state, 1)
        check(seen, "rear_1", only(dict.fromkeys(BLOCK, 1.0), "known"))
        intents.append(seen["rear_1.intent"])
        state = stepped(game, state, action)
    assert [*intents, seen_by(game, state, 1)["rear_1.intent"]] == pytest.approx([0.0, -0.35, 0.3, 0.0])


def test_belief__is_nan_where_nothing_is_known() -> None:
    tells = {"vehicle_1": ["speed", "mass"], "vehicle_2": [*PIECES], "vehicle_3": []}
    game, state = played({"tells": tells})
    state = stepped(game, state, -1.0)  # at 0.6 s: Vehicle 1 has 16.4 m/s, Vehicle 2 17.3
    two = belief_of(state, 2)
    assert two.line[0, SPEED, 1:] == pytest.approx([16.4, 17.3, np.nan], nan_ok=True)
    assert two.line[0, FORCE, 1:] == pytest.approx([np.nan, -7.0, np.nan], nan_ok=True)
    assert two.car[0, MASS, 1:] == pytest.approx([4.5, 5.5, np.nan], nan_ok=True)
    assert two.car[0, BRAKING, 1:] == pytest.approx([np.nan, 7.0, np.nan], nan_ok=True)
    for row in (DRIVING, BRAKE_RATE, RELEASE_RATE, LATENCY, OWN_LATENCY):
        assert np.isnan(two.car[0, row, 1:]).tolist() == [True, False, True]
    assert two.wanted[0, 1:] == pytest.approx([np.nan, -7.0, np.nan], nan_ok=True)
    assert two.line[0, GAP, 1:3].tolist() == [0.0, 0.0]  # no place is known but its own
    assert two.know[0, 2, 1:].tolist() == [0.5, 0.5, np.inf]  # of Vehicle 3 it has the alert alone
    assert (known_pieces(state, 2)[0, 2].all(), known_pieces(state, 3)[0, 1].any()) == (True, False)  # 3 acts at 1 s
    assert np.isfinite(state.line[:, :6, 1:3]).all()  # the state itself has not changed


def test_sight__measures_place_speed_and_acceleration() -> None:
    v2x = {"link_latency_s": 0.0, "senses": "front", "sensing_s": [0.7, 0.7], "tells": ["mass"]}
    game, state = played(v2x, SEEN)
    check(seen_by(game, state, 2), "front_1", only(FRONT, "known", "mass"))
    state = stepped(game, stepped(game, state, 0.0), 0.0)
    seen = seen_by(game, state, 2)  # after 0.7 s
    check(seen, "rear_1", only(REAR, "known", "mass"))
    expected = {"gap": 8 + 20 * 0.7 - 3 * 0.49 - 18 * 0.7, "closing_speed": 18 - 20 + 6 * 0.7, "acceleration": -6.0}
    check(seen, "front_1", {name: value / 10 for name, value in expected.items()})
    assert seen["front_1.mass"] == pytest.approx(0.45) and seen["front_1.braking_capacity"] == 0.0


def test_intent__of_who_waits_for_news_is_0() -> None:
    # Vehicle 2 hears Vehicle 3 from the alert on. Vehicle 3 hears nobody: it sees Vehicle 2 brake after 1 s, and has
    # chosen nothing before, though it brakes fully by its script, and its own latency is 0.
    v2x = {"link_latency_s": 0.0, "sensing_s": [1.0, 1.0], "senses": "both", "tells": [*PIECES]}
    types = {"vehicle_types": {"usual": {}, "deaf": {"v2x": {"hears": "none"}}}, "types": ["usual", "usual", "deaf"]}
    game, state = played(v2x, SEEN, scenario=LINE.replace(latency_s=[0, 0, 0], v2x=v2x, **types))
    assert state.latency_s.tolist() == [[0.0, 0.0, 1.0]]
    intents = []
    for _ in range(11):
        state = stepped(game, state, 0.0)
        intents.append(seen_by(game, state, 2)["rear_1.intent"])
    assert intents[:9] == 9 * [0.0] and intents[10] == pytest.approx(-0.5)


def test_obstacle__is_known_with_the_place_of_vehicle_1() -> None:
    listed, near = ["own", "front_1", "obstacle"], LINE.replace(obstacle_gap_m=60)
    game, state = played({"tells": {"vehicle_1": ["speed"]}}, listed, scenario=near)
    assert (seen_by(game, state, 1)["obstacle.known"], seen_by(game, state, 2)["obstacle.known"]) == (1.0, 0.0)
    assert belief_of(state, 2).obstacle_gap_m.tolist() == [np.inf]
    game, state = played({"tells": ["place"]}, listed, scenario=near)
    assert seen_by(game, state, 2)["obstacle.gap"] == pytest.approx((60 - 9 + 8) / 10)


def test_forecast__needs_both_neighbours_and_ends_before_a_farther_vehicle_of_which_a_piece_is_missing() -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")  # whose feature is `contact`
    game, state = played({"tells": {"vehicle_1": [*PIECES[:5]]}}, ["contact", "front_1.known"])  # no mass
    seen = seen_by(game, state, 2)
    assert seen.pop("front_1.known") == 1.0 and set(seen.values()) == {0.0}
    while state.time_s[0] < 1.2:  # Vehicle 3 has waited for its latency
        state = stepped(game, state, -1.0)
    assert seen_by(game, state, 3)["contact.brake_front_time"] > 0.0
