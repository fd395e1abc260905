"""Dynamics, observations and rewards of the second edition against those of the first, in every scenario."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import ethbrake_marl.first_edition.scenario as first
from ethbrake_marl.episode.injury import CURVES
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.motion import layout as at
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.game import game_of
from tests.second.same import LEARNING, draws, same

FEATURES = [
    "own", "front_1", "front_2", "front_3", "rear_1", "rear_2", "rear_5", "role", "obstacle", "contact", "contact_far",
    "place", "own_build_up_time", "own_release_time", "own_harm_weight", "front_1.build_up_time", "rear_2.release_time",
    "rear_1.harm_weight",
]  # fmt: skip
RECIPES = sorted(Path(__file__).parents[2].glob("train/**/*.yaml"))
OBJECTIVES = [
    "own", "social:0", "social:45", "social:90", "maximin", "mass-weighted", "weighted:1,4,1", "preference",
    *(f"injury:{curve}" for curve in CURVES), ("own", "total", "maximin"),
]  # fmt: skip


def both(name: str, n: int, **settings: Any) -> tuple[Any, Any, Any]:
    """Return an engine of the first edition, the game of the second and its state, in the same worlds."""
    engine = make_engine(name, n, **settings)
    engine.reset(worlds=first.load_scenario(name).sample(n, 11).worlds)
    _, game = game_of(name, **settings)
    return engine, game, game.begin(load_scenario(name).sample(n, 11))


@pytest.mark.parametrize("kind", ["random", "constant", "extreme"])
@pytest.mark.parametrize("name", LEARNING)
def test_dynamics__are_those_of_the_first_edition(name: str, kind: str) -> None:
    engine, game, state = both(name, 10)
    rng, shape = np.random.default_rng(5), (10, len(game.rules.learners))
    constant = rng.uniform(-1.0, 1.0, shape)
    while not engine.ended.all():
        action = {"random": draws(rng, shape), "constant": constant, "extreme": np.sign(rng.uniform(-1.0, 1.0, shape))}
        expected, (state, step) = engine.step(action[kind]), game.step(state, action[kind])
        worlds, ledger, line = engine.worlds, engine.ledger, state.line
        for key, found, old in (
            ("speeds", state.speeds_mps, worlds.speeds_mps), ("gaps", state.gaps_m, worlds.gaps_m),
            ("forces", state.forces_mps2, worlds.command_mps2), ("time", state.time_s, worlds.time_s),
            ("obstacle", state.obstacle_gap_m, worlds.obstacle_gap_m), ("hit", state.pair_hit, worlds.pair_hit),
            ("first", line[:, at.FIRST, 1:-1], ledger.first_impact_harm), ("ended", state.ended, engine.ended),
            ("total", line[:, at.TOTAL, 1:-1], ledger.total_harm), ("count", line[:, at.COUNT, 1:-1], ledger.count),
            ("with obstacle", line[:, at.TOTAL, 0], ledger.obstacle_total_harm),
            ("harm", state.harm("total"), ledger.world_harm("total")), ("reward", step.reward, expected.reward),
            ("terminated", step.terminated, expected.terminated), ("truncated", step.truncated, expected.truncated),
            ("safe end", step.safe_end, expected.safe_end),
        ):  # fmt: skip
            same(name, found, old, key)


@pytest.mark.parametrize("name", LEARNING)
def test_every_feature__is_observed_as_in_the_first_edition(name: str) -> None:
    engine, game, state = both(name, 6, observation=FEATURES)
    rng, shape, vehicles = np.random.default_rng(0), (6, len(game.rules.learners)), np.arange(state.vehicles)
    while not engine.ended.all():
        if engine.steps.max() % 6 == 0:
            same(name, game.observe_alike(state, vehicles + 1), engine.observe_all(vehicles))
        action = draws(rng, shape)
        engine.step(action)
        state, _ = game.step(state, action)
    same(name, game.observe_alike(state, vehicles + 1), engine.observe_all(vehicles))


def rewards() -> list[Any]:
    """Return the rewards of all recipes, every objective with both counts, and names."""
    recipes = [yaml.safe_load(path.read_text("utf-8")).get("reward") for path in RECIPES]
    own = [
        {"harm": 0.05, "harm_count": count, "objective": objective}
        for objective, count in product(OBJECTIVES, ("first", "total"))
    ]
    every = {"harm": 1.0, "objective": "own", "shaping": 0.1, "jerk": 1e-4, "risk": 0.3, "collision": 0.2}
    different = {str(each): each for each in recipes if each}
    return [*different.values(), *own, every, "harm", "total-harm", "paper"]


@pytest.mark.parametrize("reward", rewards(), ids=str)
@pytest.mark.parametrize("name", ["paper-random-obstacle", "cooperation-3-pair", "paper-random-buildup"])
def test_rewards__are_those_of_the_first_edition(name: str, reward: Any) -> None:
    counted = game_of(name, reward=reward)[1].rewarding.counted
    vector = ["harm_1", "harm_3", "pair_1_2", "obstacle", *counted]
    engine, game, state = both(name, 8, reward=reward, reward_vector=vector)
    rng = np.random.default_rng(1)
    while not engine.ended.all():
        running = ~engine.ended
        action = draws(rng, (8, len(game.rules.learners)))
        expected, (state, step) = engine.step(action), game.step(state, action)
        same(name, step.reward, expected.reward, "reward")
        same(name, step.vector[running], expected.vector[running], "vector")
        for term in counted:
            same(name, step.terms[term][running], expected.terms[term][running], term)
