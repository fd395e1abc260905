"""Spaces of observations, states and actions."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

from ethbrake_marl.actions import checked_action
from ethbrake_marl.agents.rollout import script_agents
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput, check_one_learner, check_whole_number
from ethbrake_marl.observations import Feature, Observation, ObservationSpec, choose_observation
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.rewards import Reward, RewardParams
from ethbrake_marl.scenario import Scenario, initial_state_worlds, load_scenario, read_scenario

AnyScenario = str | Path | Mapping[str, Any] | Scenario  # a mapping: what a file would say


def feature_box(features: Sequence[Feature]) -> Box[np.float32]:
    """Float32 box [F] with the features' bounds, which are finite."""
    low, high = (np.array([getattr(f, side) for f in features], np.float32) for side in ("low", "high"))
    return Box(low, high, dtype=np.float32)


def action_box() -> Box[np.float32]:
    """Float32 box [1]: -1 full braking capacity, 0 coasts, +1 full driving capacity."""
    return Box(-1.0, 1.0, (1,), dtype=np.float32)


def make_engine(
    scenario: AnyScenario,
    n: int,
    *,
    learners: Sequence[str | int] | None = None,
    reward: Reward = "harm",
    observation: Observation | None = None,
    seed: int = 0,
) -> Engine:
    """Build ``n`` running worlds of a scenario: a shipped name, a path to a YAML file, its content, or a ``Scenario``.

    ``learners`` (names such as ``vehicle_2``, or indices from 0) replace the scenario's own; a vehicle that learned
    and is not listed brakes fully. Scripts come from the scenario's roles.
    """
    check_whole_number("number of worlds", n, 1)
    loaded = resolve_scenario(scenario)
    if not (observation is None or isinstance(observation, ObservationSpec | list | tuple | Mapping)):
        raise InvalidInput(
            f"observation = {observation!r}: must be an ObservationSpec, for instance ObservationSpec(1, 1), its fields"
            " as a mapping, or a list of groups and features, for instance ['own', 'front_1']"
        )
    chosen = None if observation is None else choose_observation(observation)
    if learners is not None and not isinstance(learners, Iterable):
        raise InvalidInput(f"learners = {learners!r}: must be a list of vehicles, for instance ['vehicle_2']")
    if learners is not None:
        loaded = loaded.with_learners(learners)
    return Engine(
        loaded,
        int(n),
        learners=loaded.learners,
        scripts=script_agents(loaded),
        reward=reward,
        observation=chosen,
        seed=seed,
    )


def only_learner(engine: Engine) -> int:
    """Index of the one learner; ``InvalidInput`` when there is none or more than one."""
    check_one_learner(
        engine.scenario.name,
        [engine.scenario.vehicle_names[i] for i in engine.learners],
        "this environment needs exactly one: pass learners=['vehicle_2'], or use parallel_env or make_sb3_vec_env",
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


def resolve_scenario(scenario: AnyScenario) -> Scenario:
    """The scenario of a shipped name, of a YAML file, of what such a file would say, or itself."""
    if isinstance(scenario, Mapping):
        return read_scenario(scenario)
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)


def plain_spec(spec: EnvSpec | None) -> EnvSpec | None:
    """The specification with objects among its settings as plain mappings, so that JSON keeps it."""
    if spec is None:
        return None
    kwargs = dict(spec.kwargs)
    for name, value in kwargs.items():
        if isinstance(value, Scenario):
            kwargs[name] = value.declared()
        elif isinstance(value, RewardParams):
            kwargs[name] = value.model_dump(mode="json")
        elif isinstance(value, ObservationSpec):
            kwargs[name] = asdict(value)
    return replace(spec, kwargs=kwargs)


INITIAL_STATE = "initial_state"
LISTED_WORLD = "listed_world"


class UnknownResetOption(UserWarning):
    """A key of ``reset``'s options is not known to this environment; it is ignored."""


def fresh_seed() -> int:
    """A seed of 63 bits from the operating system's entropy, for an environment that was never given one."""
    entropy = np.random.SeedSequence().entropy
    assert isinstance(entropy, int)  # always, when SeedSequence chooses it itself
    return entropy % 2**63  # fits the integers of every library that infos are handed to


def restart(engine: Engine, seed: int | None, options: Mapping[str, Any] | None) -> None:
    """Start new episodes in all worlds: the stream of ``seed`` from its start, or where the stream stands.

    ``options["initial_state"]`` (see ``scenario.initial_state_worlds``) is the start of every world instead;
    ``options["listed_world"] = {"seed": 7, "number": 3}`` starts in that world of the list on which agents are
    evaluated, a batch in that one and those after it. With autoreset, later episodes come from the stream. Other
    options warn with ``UnknownResetOption`` and are ignored. Raises ``InvalidInput``, with nothing changed, for a seed
    that is not a whole number >= 0, a bad initial state or listed world, or both of them.
    """
    check_seed(seed)
    if not (options is None or isinstance(options, Mapping)):
        raise InvalidInput(
            f"reset: options = {options!r}: must be None or a mapping, for instance {{'{INITIAL_STATE}': ...}}"
        )
    warn_of_unknown(options or (), (INITIAL_STATE, LISTED_WORLD))
    restart_from(engine, seed, _wanted_worlds(engine, options or {}))


def _wanted_worlds(engine: Engine, options: Mapping[str, Any]) -> Worlds | None:
    """The worlds that the options ask for, one for each row; None for the stream's."""
    if LISTED_WORLD not in options:
        if INITIAL_STATE not in options:
            return None
        return initial_state_worlds(options[INITIAL_STATE], engine.scenario).take(np.zeros(engine.n, np.int64))
    if INITIAL_STATE in options:
        raise InvalidInput(f"reset: {INITIAL_STATE} and {LISTED_WORLD} are both given; an episode has one start")
    wanted = options[LISTED_WORLD]
    if not isinstance(wanted, Mapping) or set(wanted) != {"seed", "number"}:
        raise InvalidInput(
            f"reset: {LISTED_WORLD} = {wanted!r}: must name a world of a list, for instance {{'seed': 7, 'number': 3}}"
        )
    for name in ("seed", "number"):
        check_whole_number(f"reset: {LISTED_WORLD}: {name}", wanted[name], 0)
    return engine.scenario.sample(engine.n, int(wanted["seed"]), first=int(wanted["number"])).worlds


def restart_from(engine: Engine, seed: int | None, worlds: Worlds | None) -> None:
    """Start new episodes from ``worlds`` (None: from the stream)."""
    engine.reset(seed=None if seed is None else int(seed), worlds=worlds)


def check_seed(seed: int | None) -> None:
    """Refuse a seed that is neither None nor a whole number >= 0."""
    if seed is None:
        return
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r}: must be None or a whole number, at least 0")


def warn_of_unknown(options: Iterable[str], known: Sequence[str]) -> None:
    """One warning for all option names that are not ``known``."""
    unknown = sorted({str(name) for name in options} - set(known))
    if unknown:
        names, right = ", ".join(unknown), ", ".join(known)
        warnings.warn(f"reset: unknown option {names}, ignored; known: {right}", UnknownResetOption, stacklevel=4)
