"""From a scenario's name to a running engine: the one way in which every face is built."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.driving import scripted
from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.physics import Floats
from ethbrake_marl.rewards import Reward
from ethbrake_marl.scenario import Scenario, load_scenario


def make_engine(
    scenario: str | Path | Scenario,
    n: int,
    *,
    learners: Sequence[str | int] | None = None,
    reward: Reward = "harm",
    observation: ObservationSpec | None = None,
    seed: int = 0,
) -> Engine:
    """Build ``n`` running worlds of a scenario (a shipped name, a path to a YAML file, or a ``Scenario``).

    ``learners`` (names such as ``vehicle_2``, or indices from 0) replace the scenario's own; a vehicle that learned
    and is not listed brakes fully. Scripts come from the scenario's roles.
    """
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or not n >= 1:
        raise InvalidInput(f"number of worlds = {n!r}: must be a whole number, at least 1")
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    if observation is not None and not isinstance(observation, ObservationSpec):
        raise InvalidInput(
            f"observation = {observation!r}: must be an ObservationSpec, for instance ObservationSpec(1, 1)"
        )
    if learners is not None and not isinstance(learners, Iterable):
        raise InvalidInput(f"learners = {learners!r}: must be a list of vehicles, for instance ['vehicle_2']")
    if learners is not None:
        loaded = loaded.with_learners(learners)
    return Engine(
        loaded,
        int(n),
        learners=loaded.learners,
        scripts=scripted(loaded),
        reward=reward,
        observation=observation,
        seed=seed,
    )


def only_learner(engine: Engine) -> int:
    """Index of the one learner; ``InvalidInput`` when there is none or more than one."""
    if len(engine.learners) != 1:
        names = ", ".join(engine.scenario.vehicle_names[i] for i in engine.learners) or "none"
        raise InvalidInput(
            f"scenario {engine.scenario.name!r} has {len(engine.learners)} learners ({names}), this environment needs"
            " exactly one: pass learners=['vehicle_2'], or use parallel_env or make_sb3_vec_env"
        )
    return engine.learners[0]


def learner_columns(learners: Sequence[str], actions: Mapping[str, Any]) -> Floats:
    """The learners' actions of one world as [1, L], from an action [1] for each by name.

    Raises ``InvalidInput`` naming the vehicle whose action is missing or misshapen; the engine checks the range.
    """
    columns = np.empty((1, len(learners)))
    for c, name in enumerate(learners):
        if name not in actions:
            raise InvalidInput(f"step: no action for the learner {name}")
        action = np.asarray(actions[name])
        if action.shape != (1,) or action.dtype.kind not in "fiu":
            action = checked_action(actions[name], (1,), name)
        columns[0, c] = action.item()
    return columns


def check_render_mode(render_mode: str | None) -> None:
    """Refuse every render mode: there is no drawing yet."""
    if render_mode is not None:
        raise InvalidInput(f"render_mode = {render_mode!r}: must be None; this environment draws nothing")
