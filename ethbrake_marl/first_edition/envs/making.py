"""Functions that all environments use: they make spaces and engine, and read actions, seeds and options."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from ethbrake_marl.errors import InvalidInput, check_one_learner, check_whole_number
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.game.actions import checked_action
from ethbrake_marl.first_edition.game.features import Feature
from ethbrake_marl.first_edition.game.observations import Observation, ObservationSpec
from ethbrake_marl.first_edition.game.reward_vector import RewardVector
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario, as_scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state

AnyScenario = str | Path | Mapping[str, Any] | Scenario  # a mapping is the content of a scenario file


def feature_box(features: Sequence[Feature]) -> Box[np.float32]:
    """Return the observation space for ``features``: a float32 box [F] with the bounds of each feature."""
    low, high = (np.array([getattr(f, side) for f in features], np.float32) for side in ("low", "high"))
    return Box(low, high, dtype=np.float32)


def action_box() -> Box[np.float32]:
    """Return the action space, a float32 box [1] from -1 (full braking capacity) to +1 (full driving capacity)."""
    return Box(-1.0, 1.0, (1,), dtype=np.float32)


def reward_box(engine: Engine) -> Box[np.float64]:
    """Return the space of the engine's vector rewards: a float64 box [K], where K is the number of components.

    The type is float64, so that a weighted sum of the components exactly equals the scalar reward with the same
    weights.
    """
    return Box(-np.inf, np.inf, (len(engine.components),), dtype=np.float64)


def learner_action_space(actions: int | None) -> Any:
    """Return the action space of a learner.

    ``actions`` is the number of discrete actions, at least 2; None: the result is ``action_box()``. Raises
    ``InvalidInput`` if ``actions`` is anything else.
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
    """Return an engine with ``n`` worlds and any number of learners, for your own training loop.

    Args:
        scenario: name of a shipped scenario, path of a YAML file, content of such a file as a mapping, or a
            ``Scenario``.
        n: number of worlds that are simulated together, at least 1.
        learners: vehicles that learn, by name (``vehicle_2``) or index (0 = front); None: the learners of the scenario.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping with settings, or a ``RewardParams`` object.
        observation: features that every vehicle observes, or a mapping from the names of some vehicles to their
            features. By default, a vehicle observes the features that the scenario declares or, if it declares none,
            default features (``observation_for``).
        seed: seed of the stream of worlds.
        reward_vector: components of a vector reward, which the result of a step then contains as ``vector``, in
            addition to ``reward``. None: there is no vector reward.

    >>> import ethbrake_marl.first_edition as eb
    >>> import numpy as np
    >>> engine = eb.make_engine("cooperation-3-pair", 4, seed=7)
    >>> engine.observe_all().shape, engine.step(np.full((4, 2), -1.0)).reward.shape
    ((4, 2, 27), (4, 3))

    """
    check_whole_number("number of worlds", n, 1)
    loaded = load_scenario(scenario)
    if not (observation is None or isinstance(observation, ObservationSpec | list | tuple | Mapping)):
        raise InvalidInput(
            f"observation = {observation!r}: must be a list of groups and features such as ['own', 'front_1'], an"
            " ObservationSpec such as ObservationSpec(1, 1), or a mapping with the fields of an ObservationSpec"
        )
    if learners is not None and not isinstance(learners, Iterable):
        raise InvalidInput(f"learners = {learners!r}: must be a list of vehicle names, for instance ['vehicle_2']")
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
        "this environment needs exactly one learner: pass learners=['vehicle_2'], or use parallel_env or"
        " make_sb3_vec_env",
    )
    return engine.learners[0]


def learner_actions(engine: Engine, actions: Mapping[str, Any], count: int | None) -> Floats | dict[int, Floats]:
    """Return the actions of the L learners as an array [1, L], which ``Engine.step`` accepts for one world.

    If the engine has a shield, actions may be missing. If some are missing, the result is a mapping from the index of
    each learner that has an action to this action [1].

    Args:
        engine: engine with one world.
        actions: mapping from the name of each learner to its action [1] or, with discrete actions, to the index of the
            action.
        count: number of discrete actions; None: actions are numbers in [-1, 1].

    Raises ``InvalidInput``, which names the vehicle, if an action has the wrong shape, or if an action is missing and
    the engine has no shield. This function does not check the range of the actions, because ``Engine.step`` checks it.

    """
    names, columns = engine.scenario.vehicle_names, np.empty((1, len(engine.learners)))
    for c, vehicle in enumerate(engine.learners):
        name = names[vehicle]
        if actions.get(name) is None:
            if engine.guard is not None:
                chosen = {i: actions[names[i]] for i in engine.learners if actions.get(names[i]) is not None}
                return {i: checked_action(each, (1,), names[i], count) for i, each in chosen.items()}
            raise InvalidInput(f"step: the action of learner {name} is missing")
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
    """Warning that ``options`` of ``reset`` has an unknown key, which is ignored."""


class IgnoredAction(UserWarning):
    """Warning: an action was passed for a vehicle that follows a script, and is ignored."""


def chosen_seed(seed: int | None) -> int:
    """Return ``seed`` or, if it is None, a random seed of 63 bits from the operating system.

    Raises ``InvalidInput`` unless ``seed`` is None or a whole number >= 0.
    """
    if seed is None:
        entropy = np.random.SeedSequence().entropy
        assert isinstance(entropy, int)  # true if SeedSequence has no arguments
        return entropy % 2**63  # infos contain the seed, and some libraries store it as a signed integer of 64 bits
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r}: must be None or a whole number, at least 0")
    return int(seed)


def wanted_worlds(engine: Engine, options: Mapping[str, Any]) -> Worlds | None:
    """Return the worlds that the ``options`` of a reset choose, one for each of the engine's worlds.

    With the key ``initial_state``, all worlds start in this state. With the key ``listed_world``, the worlds are
    consecutive worlds of an evaluation list. With neither key the result is None: the stream supplies the worlds.
    Raises ``InvalidInput`` for both keys together, and for an invalid value.
    """
    if LISTED_WORLD not in options:
        if INITIAL_STATE not in options:
            return None
        return worlds_from_state(as_scenario(engine.scenario), options[INITIAL_STATE]).take(
            np.zeros(engine.n, np.int64)
        )
    if INITIAL_STATE in options:
        raise InvalidInput(f"reset: options has both {INITIAL_STATE} and {LISTED_WORLD}; pass only one of them")
    wanted = options[LISTED_WORLD]
    if not isinstance(wanted, Mapping) or set(wanted) != {"seed", "number"}:
        raise InvalidInput(
            f"reset: {LISTED_WORLD} = {wanted!r}: must be seed and number of a world in an evaluation list, for"
            " instance {'seed': 7, 'number': 3}"
        )
    for name in ("seed", "number"):
        check_whole_number(f"reset: {LISTED_WORLD}: {name}", wanted[name], 0)
    return engine.scenario.sample(engine.n, int(wanted["seed"]), first=int(wanted["number"])).worlds


def warn_of_unknown(options: Iterable[str], known: Sequence[str]) -> None:
    """Issue one ``UnknownResetOption`` warning about all names in ``options`` that are not in ``known``."""
    unknown = sorted({str(name) for name in options} - set(known))
    if unknown:
        names, right = ", ".join(unknown), ", ".join(known)
        warnings.warn(
            f"reset: options has the unknown keys {names}, which are ignored; known keys: {right}",
            UnknownResetOption,
            stacklevel=4,
        )
