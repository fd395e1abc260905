"""Who hears of whom, and when: by hand, and against a loop over the links."""

import numpy as np
import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.channel import PER_LINK, PRESETS, V2X, burst_periods, register_preset
from tests.refused import refused

PAPER = load_scenario("paper-random")
LATE = PAPER.replace(latency_s=[0, 0.2, 0.5], early_impacts="keep")


EVERYBODY = np.zeros((1, 4, 4), bool)  # nobody is unheard


def test_burst__lasts_as_long_as_the_gilbert_elliott_channel_says() -> None:
    # p = 0.05, r = 0.5: P(k >= 1) = 1 / 11 = 0.0909, P(k >= 2) = 0.04545, P(k >= 3) = 0.02273, P(k >= 4) = 0.01136
    u = np.array([0.5, 0.0910, 0.0908, 0.0455, 0.0454, 0.0228, 0.0227, 0.0114])
    assert burst_periods(u, 0.05, 0.5).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert burst_periods(u, 0.0, 0.5).tolist() == [0] * 8
    # 0.02 + 0.1 + 0.2 s on the way, every 0.1 s, 5 % lost; P(k >= 1) = 0.25
    links = np.array([[0.5, 0.9, 0.5, 0.0], [0.5, 0.24, 0.5, 0.0], [0.5, 0.9, 0.04, 0.0]])
    assert V2X.model_validate("congested").first_message_s(links).tolist() == pytest.approx([0.37, 0.47, np.inf])


FIXED = {"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1]}  # messages take 0.4 s, a hop takes 1 s


@pytest.mark.parametrize(
    ("v2x", "old", "known"),
    [
        ("paper", {}, [[0.0] * 3, [0.2] * 3, [0.5] * 3]),
        # Vehicle 2 acts when it hears of Vehicle 1, Vehicle 3 after its own 0.5 s
        (FIXED, {}, [[0.0, 0.4, 0.4], [0.4, 0.4, 0.4], [0.5, 0.5, 0.5]]),
        ({**FIXED, "hears": "front"}, {}, [[0.0, 1.0, np.inf], [0.4, 0.4, 1.0], [0.5, 0.5, 0.5]]),
        ({"preset": "sensors-only", "sensing_s": [1, 1]}, {}, [[0, 1, np.inf], [1, 1, 1], [np.inf, 2, 2]]),
        # Vehicles 1 and 3 are of a type without V2X
        (FIXED, {"sends": False}, [[0.0, 0.4, np.inf], [1, 1, 1], [np.inf, 2, 2]]),
        (FIXED, {"hears": "none"}, [[0, 1, np.inf], [0.4, 0.4, 0.4], [np.inf, 1.4, 1.4]]),
        (FIXED, {"hears": "front"}, [[0, 1, np.inf], [0.4, 0.4, 0.4], [0.5, 0.5, 0.5]]),
    ],
)
def test_news__by_hand(v2x: object, old: dict[str, object], known: list[list[float]]) -> None:
    types = {"vehicle_types": {"old": {"v2x": old}, "new": {}}, "types": ["old", "new", {"old": 1, "new": 1e-9}]}
    worlds = LATE.replace(v2x=v2x, **(types if old else {})).sample(1, 7)
    assert worlds.know[0, 1:, 1:].tolist() == known
    assert worlds.latency_s[0].tolist() == np.diag(known).tolist()


def test_latest_reaction__is_that_of_the_type_with_the_least_equipment() -> None:
    types = {"old": {"v2x": {"sends": False, "hears": "none"}}, "new": {}}
    LATE.replace(v2x=FIXED, vehicle_types=types, types="new", horizon_s=2)
    with refused(
        "v2x = {preset: nominal, link_latency_s: 0.4, sensing_s: [1, 1]}: vehicle_3 may not be able to act until 2"
    ):
        LATE.replace(v2x=FIXED, vehicle_types=types, types="any", horizon_s=2)


@pytest.mark.parametrize("preset", PRESETS)
def test_latest_reaction__bounds_all_that_is_drawn(preset: str) -> None:
    channel, own = V2X.model_validate(preset), np.tile([0.0, 0.2, 0.9, 0.1], (2000, 1))
    u = np.random.default_rng(3).random((2000, 16 * PER_LINK))
    latency, known = channel.news(own, u, EVERYBODY)
    assert (latency <= channel.latest_reaction_s(own[:1], EVERYBODY)).all()
    assert (known >= latency[:, :, np.newaxis]).all()


def test_presets_of_ones_own() -> None:
    for _ in range(2):
        register_preset("test-lossy", {"preset": "nominal", "silent_links": 0.5})
        register_preset("test-mute", {"hears": "front"})
    lossy, mute = V2X.model_validate({"preset": "test-lossy", "loss_ends": 1.0}), V2X.model_validate("test-mute")
    assert (lossy.timing, lossy.loss_begins, lossy.loss_ends, lossy.silent_links) == ("messages", 0.05, 1.0, 0.5)
    assert (mute.timing, mute.hears, mute.by_link) == ("latency", "front", True)
    with refused("preset 'test-lossy': another channel is already registered under this name", AlreadyExists):
        register_preset("test-lossy", {"preset": "nominal"})
    with refused("preset 'Lossy': the name must be 1 to 64 characters"):
        register_preset("Lossy", {})
    with refused("preset 'y': must be a mapping such as {'loss_begins': 0.1}"):
        register_preset("y", 3)  # type: ignore[arg-type]
