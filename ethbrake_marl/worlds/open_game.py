"""Makes a game from a scenario: worlds, settings, scripts, observations and rewards."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.episode.game import Game, Script
from ethbrake_marl.episode.objectives import Declared, free_pairs, objectives_of, with_every_weight
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.reward import Reward, Rewarding
from ethbrake_marl.episode.script_calls import guard_scripts
from ethbrake_marl.errors import FreeImpacts
from ethbrake_marl.worlds.physics import PHYSICS
from ethbrake_marl.worlds.sampling import WorldPool
from ethbrake_marl.worlds.scenario import Scenario

AnyScenario = str | Path | Mapping[str, Any] | Scenario  # a mapping is the content of a scenario file


def game_of(
    scenario: Scenario,
    scripts: Mapping[int, Script],
    reward: Reward = "honest",
    observation: Any = None,
    reward_vector: Any = None,
    report: Sequence[str] = (),
) -> tuple[Scenario, Game]:
    """The scenario with this ``observation``, and its game.

    ``scripts``: vehicle (1: Vehicle 1) -> script, for vehicles whose role is the name of an agent. Warns
    (``FreeImpacts``) if an impact costs nothing under a learner's objective.
    """
    if observation is not None:
        current_features = {
            name: view.names for name, view in zip(scenario.vehicle_names, views_of(scenario), strict=True)
        }
        scenario = scenario.replace(
            observation={**current_features, **observation} if isinstance(observation, Mapping) else observation
        )
    bodies = np.array(scenario.learners, np.int64)
    rewarding, settings = Rewarding.of(
        reward, scenario.objective, scenario.vehicles, bodies, (scenario.time_step_s, scenario.horizon_s),
        reward_vector, report,
    )  # fmt: skip
    if rewarding.params.harm:
        _warn_of_ties(scenario, rewarding.params.objective or scenario.objective)
    views = (View(), *views_of(scenario))
    game = Game(
        WorldPool(scenario, "training"), scenario.name, settings, rewarding, views, bodies, guard_scripts(scripts)
    )
    v2x = (scenario.members or (scenario,))[0].v2x  # members of a mixture have the same
    layers = [key.layer(v2x) for key in v2x.channel_keys]
    game = game.with_layers(sorted(layers, key=lambda layer: layer.stage))
    if scenario.physics is not None:
        physics = PHYSICS[scenario.physics]
        game = game._replace(physics=physics, rewarding=physics.rewarding(game))
    return scenario, game


def _warn_of_ties(scenario: Scenario, declared: Declared) -> None:
    objectives = objectives_of(declared, scenario.vehicles)
    for body in scenario.learners:
        pairs = free_pairs(objectives[body - 1], body - 1, scenario.vehicles, obstacle=scenario.has_obstacle)
        if pairs:
            text = declared if isinstance(declared, str) else declared[body - 1]
            partner = f"vehicle_{pairs[0] + 1}" if pairs[0] else "the obstacle"
            better = with_every_weight(objectives[body - 1], scenario.vehicles)
            _warn_once(
                f"objective {text}: an impact between vehicle_{max(pairs[0], 1)} and {partner} has no weight, so"
                f" vehicle_{body} may cause it; write {better} to let the harm of the whole line decide between actions"
                " that are equal otherwise"
            )


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, FreeImpacts, stacklevel=2)


def views_of(scenario: Scenario) -> tuple[View, ...]:
    """Features that each vehicle observes, front to rear."""
    usual = View(["own", "front_1", "rear_1", *(["role", "obstacle"] if scenario.has_obstacle else [])])
    observation = scenario.observation
    if not isinstance(observation, dict):
        return (usual if observation is None else View(observation),) * scenario.vehicles
    return tuple(View(observation[name]) if name in observation else usual for name in scenario.vehicle_names)
