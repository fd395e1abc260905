"""Policies of the second edition: the same files, the same bits, the same harm as in the first."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.agents.drive import Team, drive
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.episode.observe import View
from ethbrake_marl.first_edition.agents.driving import drive as first_drive
from ethbrake_marl.first_edition.game.features import register_feature as first_register
from ethbrake_marl.first_edition.policies.bundle import load_policy as first_load
from ethbrake_marl.first_edition.policies.layers import dense as first_dense, squash as first_squash
from ethbrake_marl.first_edition.policies.network_spec import NetworkSpec as FirstSpec
from ethbrake_marl.first_edition.policies.policy import Policy as FirstPolicy
from ethbrake_marl.first_edition.policies.shipped import load_shipped as first_shipped
from ethbrake_marl.policies.bundle import load_policy, load_shipped, shipped_policies
from ethbrake_marl.policies.layers import dense, squash
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.worlds.game import game_of

FIELDS: dict[str, Any] = {
    "algorithm": "ppo", "learners": ("vehicle_2",), "scenario": {"name": "paper-random", "time_step_s": 0.1},
    "reward": {"harm": 1.0}, "seeds": {"training": 3}, "steps": 1024,
}  # fmt: skip
SMALL: dict[str, Any] = {"action_size": 1, "policy_hidden": (13, 9), "value_hidden": (5,), "activation": "relu"}
CHOOSES: dict[str, Any] = {**SMALL, "value_hidden": ()}
EXPERTS: dict[str, Any] = {**CHOOSES, "output": "clip", "networks": 3, "gate_hidden": (6,)}
NETWORKS: dict[str, dict[str, Any]] = {
    "clip": {**SMALL, "output": "clip"},
    "tanh": {**SMALL, "output": "tanh", "activation": "tanh"},
    "choice": {**CHOOSES, "output": "choice", "choices": 33},
    "experts": EXPERTS,
}
FEATURES = {
    "usual": ["own", "front_1", "rear_1"],
    "two ahead": ["own", "front_1", "front_2"],
    "picked": ["rear_1.gap", "own.speed", "obstacle", "role.vehicles_ahead"],
    "functions": ["own", "place", "own_build_up_time", "front_2.release_time", "rear_1.harm_weight", "own_harm_weight"],
    "forecasts": ["own", "contact", "contact_far.brake_front_time", "front_1.age"],
}


def tensors_for(spec: Any, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = spec.tensors if isinstance(spec.tensors, dict) else dict(spec.tensors)
    return {name: (rng.normal(size=s) / np.sqrt(s[-1])).astype(np.float32) for name, s in shapes.items()}


@pytest.mark.parametrize("kind", [*NETWORKS, "among"])
def test_actor__has_the_bits_of_the_first(kind: str) -> None:
    given = NETWORKS.get(kind, {**NETWORKS["choice"], "choices": 3}) | {"observation_size": 27}
    first, second = FirstSpec(**given), NetworkSpec(**given)
    if kind == "among":
        inside = [NETWORKS[name] | {"observation_size": 27} for name in ("experts", "tanh")]
        first = first.model_copy(update={"among": tuple(FirstSpec(**each) for each in inside)})
        second = second.model_copy(update={"among": tuple(NetworkSpec(**each) for each in inside)})
    assert dict(first.tensors) == second.tensors
    tensors, view = tensors_for(second), View(FEATURES["usual"])
    one = FirstPolicy.make(tensors, network=first, observation=eb.ObservationSpec(), **FIELDS)
    other = Policy.make(tensors, network=second, observation=view, **FIELDS)
    seen = np.random.default_rng(1).uniform(-2.0, 2.0, (3000, 27)).astype(np.float32)
    actions = other(seen)
    assert np.array_equal(actions, one(seen)) and len(np.unique(actions)) > 2


@pytest.mark.parametrize("inputs", [1, 3, 4, 27, 78])
def test_layers__have_the_bits_of_the_first(inputs: int) -> None:
    rng = np.random.default_rng(inputs)
    weight, bias, x = (rng.normal(size=s).astype(np.float32) for s in ((17, inputs), 17, (inputs, 300)))
    found, expected = np.empty((2, 17, 300), np.float32)
    dense(weight, bias, x, found)
    first_dense(weight, bias, x, expected)
    assert np.array_equal(found, expected)
    for values, function in ((found, squash), (expected, first_squash)):
        values *= np.float32(3.0)
        function(values)
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("name", shipped_policies())
def test_shipped_policy__is_the_same_and_is_written_as_the_first_reads_it(name: str, tmp_path: Path) -> None:
    policy, first = load_shipped(name), first_shipped(name)
    assert policy.manifest.model_dump() == first.manifest.model_dump()
    policy.save(tmp_path / "second")
    first.save(tmp_path / "first")
    for file in ("manifest.json", "weights.safetensors"):
        assert (tmp_path / "second" / file).read_bytes() == (tmp_path / "first" / file).read_bytes()


@pytest.mark.parametrize("features", FEATURES)
@pytest.mark.parametrize("kind", ["clip", "experts"])
def test_new_bundle__is_read_by_the_other_edition(features: str, kind: str, tmp_path: Path) -> None:
    view, spec = View(FEATURES[features]), eb.choose_observation(FEATURES[features])
    given = NETWORKS[kind] | {"observation_size": len(view.features)}
    tensors = tensors_for(NetworkSpec(**given))
    Policy.make(tensors, network=NetworkSpec(**given), observation=view, **FIELDS).save(tmp_path / "second")
    FirstPolicy.make(tensors, network=FirstSpec(**given), observation=spec, **FIELDS).save(tmp_path / "first")
    one, other = first_load(tmp_path / "second"), load_policy(tmp_path / "first")
    assert one.manifest.observation.model_dump() == other.manifest.observation.model_dump()
    assert other.observation == view and [f.name for f in one.observation.features] == list(view.names)
    seen = np.random.default_rng(1).uniform(-1.0, 1.0, (50, len(view.features))).astype(np.float32)
    assert np.array_equal(one(seen), other(seen))


def test_feature_of_a_user__is_tried_in_the_same_worlds(tmp_path: Path) -> None:
    """What was written of it is the same, as far as the two editions show it alike."""

    def lead(worlds: Any, vehicle: int, neighbour: int) -> Any:
        """Speeds, capacities, masses, latencies and time of two vehicles, in one number."""
        v = worlds.vehicles
        values = [worlds.speeds_mps, v.braking_capacity_mps2, v.driving_capacity_mps2, v.mass_t, v.latency_s]
        return sum((k + 1.5) * each[:, vehicle] + each[:, neighbour] for k, each in enumerate(values)) + worlds.time_s

    def lead_again(state: Any, body: int, other: int) -> Any:
        """The same of bodies."""
        values = [state.speeds_mps, state.braking_capacity_mps2, state.driving_capacity_mps2]
        values += [state.mass_t, state.latency_s]
        one, two = body - 1, other - 1
        return sum((k + 1.5) * each[:, one] + each[:, two] for k, each in enumerate(values)) + state.time_s

    settings: dict[str, Any] = {"unit": "1", "scale": 1.0, "low": -1e6, "high": 1e6, "of": "neighbour", "unknown": 2.5}
    from ethbrake_marl.episode.features import register_feature  # the second edition's

    first_register("lead_of_two", lead, **settings)
    register_feature("lead_of_two", lead_again, **settings)
    spec, view = eb.choose_observation(["own", "front_1.lead_of_two"]), View(["own", "front_1.lead_of_two"])
    given = NETWORKS["clip"] | {"observation_size": 8}
    tensors = tensors_for(NetworkSpec(**given))
    FirstPolicy.make(tensors, network=FirstSpec(**given), observation=spec, **FIELDS).save(tmp_path / "first")
    Policy.make(tensors, network=NetworkSpec(**given), observation=view, **FIELDS).save(tmp_path / "second")
    one, other = first_load(tmp_path / "second"), load_policy(tmp_path / "first")
    assert one.manifest.observation.registered[0].tried == other.manifest.observation.registered[0].tried


@pytest.mark.parametrize(
    ("scenario", "name", "first_impacts", "total"),
    [
        ("paper-random", "ppo", 6.66, 6.94),
        ("paper-random", "universal", 6.33, 6.43),
        ("paper-random-obstacle", "rollout-obstacle", 29.63, 36.96),
    ],
)
def test_row_of_the_readme__has_its_digits(scenario: str, name: str, first_impacts: float, total: float) -> None:
    opened, game = game_of(scenario)
    agent = LearnedAgent(load_shipped(name), name)
    last = drive(game, opened.sample(2000, 7), Team(name, {2: agent}))
    assert round(last.harm("first").mean(), 2) == first_impacts
    assert round(last.harm("total").mean(), 2) == total


@pytest.mark.parametrize(
    ("scenario", "name", "n"),
    [
        ("paper-random", "ppo", 10_000),
        ("paper-random", "sac", 1_000),
        ("paper-random", "universal", 500),
        ("paper-random-obstacle", "rollout-obstacle", 500),
        ("paper-random-obstacle", "ppo-obstacle", 500),
        ("paper-random-preference", "vine-preference", 500),
        ("cooperation-1-front", "vine-front", 500),
        ("cooperation-3-pair", "vine-pair", 500),
        ("cooperation-4-all", "vine-all", 500),
    ],
)
def test_shipped_policy__drives_every_world_to_the_same_bits(scenario: str, name: str, n: int) -> None:
    opened, game = game_of(scenario)
    bodies = game.rules.learners.tolist()
    last = drive(game, opened.sample(n, 7), Team(name, dict.fromkeys(bodies, LearnedAgent(load_shipped(name), name))))
    first = eb.load_scenario(scenario)
    agent = eb.LearnedAgent(eb.load_shipped(name))
    team = eb.Team(dict.fromkeys((body - 1 for body in bodies), agent), name)
    expected = first_drive(first.sample(n, 7).worlds, team, first).ledger
    for count in ("first", "total"):
        assert np.array_equal(last.harm(count), expected.world_harm(count))
