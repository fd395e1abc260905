"""Who hears of whom, and when: by hand, and against a loop over the links."""

import numpy as np
import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.channel import PER_LINK, PRESETS, V2X, burst_periods, register_preset
from ethbrake_marl.worlds.scenario import Scenario
from tests.refused import refused

PAPER = load_scenario("paper-random")
LATE = PAPER.replace(latency_s=[0, 0.2, 0.5], early_impacts="keep")


EVERYBODY = np.zeros((1, 4, 4), bool)  # nobody is unheard


def test_burst__lasts_as_long_as_the_gilbert_elliott_channel_says() -> None:
    # p = 0.05, r = 0.5: P(k >= 1) = 1 / 11 = 0.0909, P(k >= 2) = 0.04545, P(k >= 3) = 0.02273, P(k >= 4) = 0.01136
    u = np.array([0.5, 0.0910, 0.0908, 0.0455, 0.0454, 0.0228, 0.0227, 0.0114])
    assert burst_periods(u, 0.05, 0.5).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert burst_periods(u, 0.0, 0.5).tolist() == [0] * 8
    grid = (np.arange(1_000_000) + 0.5) / 1e6
    assert (burst_periods(grid, 0.2, 0.2) >= 3).mean() == pytest.approx(0.5 * 0.8**2, abs=2e-6)


def test_first_message__by_hand() -> None:
    channel = V2X.model_validate("congested")  # 0.02 + 0.1 + 0.2 s on the way, every 0.1 s, 5 % lost; P(k >= 1) = 0.25
    u = np.array([[0.5, 0.9, 0.5, 0.0], [0.5, 0.24, 0.5, 0.0], [0.5, 0.9, 0.04, 0.0]])
    assert channel.first_message_s(u).tolist() == pytest.approx([0.37, 0.47, np.inf])


def test_news__by_hand() -> None:
    # Vehicle 2 acts when it hears of Vehicle 1 (0.4 s), Vehicle 3 after its own 0.5 s.
    know = LATE.replace(v2x={"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1]}).sample(1, 7).know[0]
    assert know[1:, 1:].tolist() == [[0.0, 0.4, 0.4], [0.4, 0.4, 0.4], [0.5, 0.5, 0.5]]
    ahead = LATE.replace(v2x={"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1], "hears": "front"})
    assert ahead.sample(1, 7).know[0, 1:, 1:].tolist() == [[0.0, 1.0, np.inf], [0.4, 0.4, 1.0], [0.5, 0.5, 0.5]]
    seen = LATE.replace(v2x={"preset": "sensors-only", "sensing_s": [1, 1]}).sample(1, 7)
    assert seen.latency_s[0].tolist() == [0.0, 1.0, 2.0]  # one hop after the other
    assert seen.know[0, 3, 1] == np.inf
    assert (PAPER.sample(1, 7).know[0, 1:, 1:] == PAPER.sample(1, 7).latency_s[0][:, np.newaxis]).all()


def test_vehicle__that_does_not_send_is_only_seen() -> None:
    def of(**v2x: object) -> Scenario:
        types = {"vehicle_types": {"old": {"v2x": v2x}, "new": {}}, "types": ["old", "new", {"old": 1, "new": 1e-9}]}
        return LATE.replace(v2x={"preset": "nominal", "link_latency_s": 0.4, "sensing_s": [1, 1]}, **types)

    silent, deaf = (of(**v2x).sample(1, 7) for v2x in ({"sends": False}, {"hears": "none"}))
    assert silent.know[0, 1:, 1:].tolist() == [[0.0, 0.4, np.inf], [1.0, 1.0, 1.0], [np.inf, 2.0, 2.0]]
    assert silent.latency_s[0].tolist() == [0.0, 1.0, 2.0]
    assert deaf.know[0, 1:, 1:].tolist() == [[0.0, 1.0, np.inf], [0.4, 0.4, 0.4], [np.inf, 1.4, 1.4]]
    ahead = of(hears="front").sample(1, 7)
    assert ahead.know[0, 1:, 1:].tolist() == [[0.0, 1.0, np.inf], [0.4, 0.4, 0.4], [0.5, 0.5, 0.5]]


@pytest.mark.parametrize("preset", PRESETS)
def test_latest_reaction__bounds_all_that_is_drawn(preset: str) -> None:
    channel, own = V2X.model_validate(preset), np.tile([0.0, 0.2, 0.9, 0.1], (2000, 1))
    u = np.random.default_rng(3).random((2000, 16 * PER_LINK))
    latency, known = channel.news(own, u, EVERYBODY)
    assert (latency <= channel.latest_reaction_s(own[:1], EVERYBODY)).all()
    assert (known >= latency[:, :, np.newaxis]).all()


def test_presets_of_ones_own() -> None:
    register_preset("test-lossy", {"preset": "nominal", "lost": 0.5})
    register_preset("test-lossy", {"preset": "nominal", "lost": 0.5})
    assert V2X.model_validate("test-lossy").lost == 0.5
    with refused("preset 'test-lossy': another channel is already registered under this name", AlreadyExists):
        register_preset("test-lossy", {"preset": "nominal"})
    with refused("preset 'Lossy': the name must be 1 to 64 characters"):
        register_preset("Lossy", {})
    with refused("preset 'y': must be a mapping such as {'lost': 0.1}"):
        register_preset("y", 3)  # type: ignore[arg-type]
