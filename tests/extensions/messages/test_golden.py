"""Observations of random worlds, by their digests, which version 0.5's observations confirmed to six digits."""

import hashlib

import numpy as np
import pytest

from ethbrake_marl.worlds.catalogue import load_scenario
from tests.extensions.messages.line import played

SEEN = [
    "own", "front_1", "front_2", "rear_1", "obstacle", "contact", "front_1.intent", "rear_1.intent", "front_1.age",
]  # fmt: skip
PIECES = ["place", "speed", "acceleration", "braking_capacity", "latency", "mass", "intent"]
CHANNELS = {
    "blocked": {"preset": "blocked", "persistence": "periodic"},
    "congested": {"preset": "congested", "senses": "front", "message_period_s": 0.13, "persistence": "periodic"},
    "old": {"preset": "nominal", "radio_s": 0.75, "tells": PIECES, "persistence": "periodic"},
    "few": {"preset": "nominal", "tells": {"vehicle_1": ["speed", "intent"], "vehicle_3": PIECES}},
}
DIGESTS = {
    ("cooperation-2-paper", "blocked"): "20e03d350564f6dd",
    ("cooperation-2-paper", "congested"): "8d1f2519b99c126f",
    ("cooperation-2-paper", "old"): "4f4aa495d4933288",
    ("cooperation-2-paper", "few"): "0fddb08f128c9d6b",
    ("cooperation-4-all", "blocked"): "776a728561fe4ddc",
    ("cooperation-4-all", "congested"): "b90a152a61b6d7e3",
    ("cooperation-4-all", "old"): "71171a6657d0d806",
    ("cooperation-4-all", "few"): "2c847acede908648",
}


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("base", ["cooperation-2-paper", "cooperation-4-all"])
def test_observations__keep_their_bits(base: str, channel: str) -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")  # whose feature is `contact`
    scenario, rng = load_scenario(base).replace(early_impacts="keep"), np.random.default_rng(5)
    game, state = played(CHANNELS[channel], SEEN, n=60, scenario=scenario)
    digest = hashlib.sha256()
    for _ in range(15):
        digest.update(game.observe_alike(state, [1, 2, 3]).tobytes())
        state, _ = game.step(state, rng.uniform(-1.0, 0.5, (60, len(game.settings.learners))))
    assert digest.hexdigest()[:16] == DIGESTS[base, channel]
