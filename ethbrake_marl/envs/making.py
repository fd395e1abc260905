"""Build the parts that all interfaces share: spaces, engine, actions, seeds and reset options."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ethbrake_marl.agents.driving import script_agents
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput, check_one_learner, check_whole_number
from ethbrake_marl.game.actions import checked_action
from ethbrake_marl.game.features import Feature
from ethbrake_marl.game.observations import Observation, ObservationSpec
from ethbrake_marl.game.reward_vector import RewardVector
from ethbrake_marl.game.rewards import Reward
from ethbrake_marl.physics.state import Floats, Worlds
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario, as_scenario
from ethbrake_marl.scenario.tables import worlds_from_state

AnyScenario = str | Path | Mapping[str, Any] | Scenario  # a mapping holds the content of a scenario file


def feature_box(features: Sequence[Feature]) -> Box[np.float32]:
    """Return the observation space of the features: a float32 box [F] with their bounds, which are finite."""
    low, high = (np.array([getattr(f, side) for f in features], np.float32) for side in ("low", "high"))
    return Box(low, high, dtype=np.float32)


def action_box() -> Box[np.float32]:
    """Return the action space, a float32 box [1]: -1 full braking capacity, 0 coasts, +1 full driving capacity."""
    return Box(-1.0, 1.0, (1,), dtype=np.float32)


def reward_box(engine: Engine) -> Box[np.float64]:
    """Return the space of vector rewards of an engine that has them: a float64 box [K].

    It is float64, so that weighted sums of a vector equal the reward of the same weights to the bit.
    """
    return Box(-np.inf, np.inf, (len(engine.components),), dtype=np.float64)


def learner_action_space(actions: int | None) -> Any:
    """Return the action space of a learner: ``action_box()``, or that of as many discrete ``actions``.

    Raises ``InvalidInput`` unless ``actions`` is None or a whole number, at least 2.
    """
    if actions is None:
        return action_box()
    check_whole_number("actions", actions, 2)
    return Discrete(int(actions))


def make_engine(
    scenario: AnyScenario,
    n: int,
    *,
    learners: Sequence[str | int] | None = None,
    reward: Reward = "harm",
    observation: Observation | None = None,
    seed: int = 0,
    reward_vector: RewardVector | None = None,
) -> Engine:
    """Return an engine with ``n`` worlds and any number of learners, for a training loop of your own.

    Args:
        scenario: a shipped name, the path of a YAML file, its content as a mapping, or a ``Scenario``.
        n: number of worlds that are advanced together, at least 1.
        learners: vehicles that learn instead of the scenario's, by name (``vehicle_2``) or index from 0; any number.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what every vehicle observes, or a mapping from vehicle to its observation; None: the scenario's.
        seed: seed of the stream of worlds.
        reward_vector: components of a vector reward, which each step tells as ``vector`` beside its ``reward``; None:
            there is none.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> engine = eb.make_engine("cooperation-3-pair", 4, seed=7)
    >>> engine.observe_all().shape, engine.step(np.full((4, 2), -1.0)).reward.shape  # of learners, of all vehicles
    ((4, 2, 27), (4, 3))

    """
    check_whole_number("number of worlds", n, 1)
    loaded = load_scenario(scenario)
    if not (observation is None or isinstance(observation, ObservationSpec | list | tuple | Mapping)):
        raise InvalidInput(
            f"observation = {observation!r}: must be an ObservationSpec, for instance ObservationSpec(1, 1), its fields"
            " as a mapping, or a list of groups and features, for instance ['own', 'front_1']"
        )
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
        observation=observation,
        seed=seed,
        reward_vector=reward_vector,
    )


def only_learner(engine: Engine) -> int:
    """Return the index of the engine's only learner (0 = front); raise ``InvalidInput`` unless there is exactly one."""
    check_one_learner(
        engine.scenario.name,
        [engine.scenario.vehicle_names[i] for i in engine.learners],
        "this environment needs exactly one: pass learners=['vehicle_2'], or use parallel_env or make_sb3_vec_env",
    )
    return engine.learners[0]


def learner_actions(engine: Engine, actions: Mapping[str, Any], count: int | None) -> Floats | dict[int, Floats]:
    """Return the learners' actions of an engine with one world, as ``Engine.step`` takes them: [1, L].

    ``actions`` maps vehicle names to actions [1], or to indices of ``count`` discrete actions. Raises ``InvalidInput``
    naming the vehicle whose action is missing or has the wrong shape; the engine checks the range. Behind a shield,
    actions may be missing; then the result is a mapping from vehicle index to action [1].
    """
    names, columns = engine.scenario.vehicle_names, np.empty((1, len(engine.learners)))
    for c, vehicle in enumerate(engine.learners):
        name = names[vehicle]
        if actions.get(name) is None:
            if engine.guard is not None:
                chosen = {i: actions[names[i]] for i in engine.learners if actions.get(names[i]) is not None}
                return {i: checked_action(each, (1,), names[i], count) for i, each in chosen.items()}
            raise InvalidInput(f"step: no action for the learner {name}")
        action = actions[name]
        is_plain = type(action) is np.ndarray and action.shape == (1,) and action.dtype.kind in "fiu"
        if count is not None or not is_plain:
            action = checked_action(action, (1,), name, count)
        columns[0, c] = action.item()
    return columns


INITIAL_STATE = "initial_state"

LISTED_WORLD = "listed_world"

RESET_MASK = "reset_mask"


class UnknownResetOption(UserWarning):
    """Warning: the environment does not know a key of ``reset``'s options, and ignores it."""


class IgnoredAction(UserWarning):
    """Warning: an action was passed for a vehicle that follows a script, and is ignored."""


def chosen_seed(seed: int | None) -> int:
    """Return ``seed``, or, for None, a seed of 63 bits from the operating system's entropy.

    Raises ``InvalidInput`` unless ``seed`` is None or a whole number >= 0.
    """
    if seed is None:
        entropy = np.random.SeedSequence().entropy
        assert isinstance(entropy, int)  # always, when SeedSequence chooses it itself
        return entropy % 2**63  # fits into the integers of every library that receives infos
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r}: must be None or a whole number, at least 0")
    return int(seed)


def wanted_worlds(engine: Engine, options: Mapping[str, Any]) -> Worlds | None:
    """Return the worlds that the ``options`` of a reset choose, one for each of the engine's worlds.

    ``initial_state`` puts all of them in one state; ``listed_world`` chooses consecutive worlds of an evaluation list.
    Without either key the result is None: the worlds come from the stream. Raises ``InvalidInput`` if both keys are
    present, or if one is invalid.
    """
    if LISTED_WORLD not in options:
        if INITIAL_STATE not in options:
            return None
        return worlds_from_state(as_scenario(engine.scenario), options[INITIAL_STATE]).take(
            np.zeros(engine.n, np.int64)
        )
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


def warn_of_unknown(options: Iterable[str], known: Sequence[str]) -> None:
    """Warn with ``UnknownResetOption``, once, about all names in ``options`` that are not in ``known``."""
    unknown = sorted({str(name) for name in options} - set(known))
    if unknown:
        names, right = ", ".join(unknown), ", ".join(known)
        warnings.warn(f"reset: unknown option {names}, ignored; known: {right}", UnknownResetOption, stacklevel=4)
