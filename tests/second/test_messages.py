"""Vehicles with messages believe in the second edition what they believe in the first."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
import ethbrake_marl.first_edition.scenario as first
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.physics.messages import Messages
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.channel import EXTENSIONS
from ethbrake_marl.worlds.game import game_of

pytestmark = pytest.mark.skipif("tells" not in EXTENSIONS, reason="messages are an extension")

PIECES = ["place", "speed", "acceleration", "braking_capacity", "latency", "mass", "intent"]
SEEN = [
    *("own", "front_1", "front_2", "rear_1", "role", "obstacle", "contact", "contact_far"),
    *(f"{side}.{name}" for side in ("front_1", "rear_1") for name in ("intent", "age", "build_up_time")),
    *(f"front_1.{piece}_known" for piece in PIECES),
]
PERIODIC = {"persistence": "periodic"}
CHANNELS = {
    "fixed": {"link_latency_s": 0.2, "senses": "none", "loss_begins": 1.0, "loss_ends": 1.0, **PERIODIC},
    "nominal": {"preset": "nominal", **PERIODIC},
    "blocked": {"preset": "blocked", **PERIODIC},
    "congested": {"preset": "congested", "senses": "front", "message_period_s": 0.13, **PERIODIC},
    "slow": {"preset": "nominal", "radio_s": 0.75, "sensing_s": [0.3, 0.6], **PERIODIC},
    "all": {"tells": PIECES},
    "place": {"tells": ["place"]},
    "no speed": {"preset": "nominal", "tells": ["place", "acceleration", "braking_capacity", "latency", "mass"]},
    "alert": {"preset": "blocked", "tells": []},
    "each": {"tells": {"vehicle_1": ["speed", "intent"], "vehicle_2": ["intent", "mass"], "vehicle_3": PIECES}},
    "each old": {"preset": "blocked", "tells": {"vehicle_1": ["speed", "intent"], "vehicle_3": PIECES}, **PERIODIC},
    "intent old": {"preset": "congested", "tells": PIECES, **PERIODIC},
    "first": {"preset": "nominal", "persistence": "first"},
}
CONTACTS = {"contact", "contact_far"}  # jump at a force of 0, which a build-up reaches up to rounding
BASES = ["cooperation-2-paper", "cooperation-4-all", "paper-random-buildup"]


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("base", BASES)
def test_observations__are_those_of_the_first_edition(base: str, channel: str) -> None:
    v2x = CHANNELS[channel]
    one, other = (load(base).replace(v2x=v2x, early_impacts="keep") for load in (first.load_scenario, load_scenario))
    worlds, listed = one.sample(60, 7).worlds, [name for name in SEEN if "buildup" not in base or name not in CONTACTS]
    scripts = script_agents(one, except_for=one.learners)
    engine = eb.Engine(one, 60, learners=one.learners, scripts=scripts, worlds=worlds, observation=listed)
    _, game = game_of(other, observation=listed)
    state, rng = game.begin(other.sample(60, 7)), np.random.default_rng(5)
    bodies = np.arange(1, other.vehicles + 1)
    for _ in range(25):
        expected, seen = engine.observe_all(bodies - 1), np.stack(game.observe(state, bodies), axis=1)
        np.testing.assert_allclose(seen, expected, rtol=2e-6, atol=2e-6)
        age = Messages.of(engine.worlds).age_s(engine.worlds.time_s)
        for name, value in game.own_infos(state).items():
            if name.startswith("age_s"):
                np.testing.assert_allclose(value, age[:, :, int(name[-1]) - 1], rtol=1e-9, atol=1e-9)
        shape = 60, len(one.learners)
        actions = np.where(rng.random(shape) < 0.5, -1.0, rng.uniform(-1.0, 1.0, shape))
        engine.step(actions)
        state, _ = game.step(state, actions)
    assert state.ended.mean() < 1.0


def test_worlds__have_the_same_bits() -> None:
    for base in BASES:
        v2x = CHANNELS["congested"]
        one, other = (load(base).replace(v2x=v2x) for load in (first.load_scenario, load_scenario))
        old, new = one.sample(300, 3).worlds, other.sample(300, 3)
        assert new.know[:, 1:, 1:].tobytes() == old.vehicles.known_from_s.tobytes()
        messages, memory = Messages.of(old), new.memories["messages"]
        assert memory.channel.tobytes() == messages.columns[:, :5].tobytes()
        itself = np.eye(other.vehicles, dtype=bool)
        for row, column in ((memory.links[:, 0], 0), (memory.seen_s, 3)):
            np.testing.assert_array_equal(row[:, 1:, 1:][:, ~itself], messages.links[..., column][:, ~itself])
