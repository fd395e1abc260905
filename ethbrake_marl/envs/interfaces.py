"""The interfaces of PettingZoo and Gymnasium, and what they share with Stable-Baselines3's: spaces, seeds, infos."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from ethbrake_marl.actions import action_of, checked_action, own_actions
from ethbrake_marl.agents import script_agents
from ethbrake_marl.engine import Engine, Step
from ethbrake_marl.envs.drawing import Viewer
from ethbrake_marl.errors import InvalidInput, check_one_learner, check_whole_number, unknown_name
from ethbrake_marl.harm import front_share
from ethbrake_marl.observations import Feature, Observation, Observations, ObservationSpec
from ethbrake_marl.physics import Bools, Decisions, Floats, Ints, Messages, Packed, Worlds, columns, compiled
from ethbrake_marl.rewards import Reward, RewardParams
from ethbrake_marl.scenario import QUANTITY, Sample, Scenario, full_state, load_scenario, state_features

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
    """``n`` worlds for a training loop of one's own, with any number of learners; needs no other library.

    Args:
        scenario: a shipped name, the path of a YAML file, its content as a mapping, or a ``Scenario``.
        n: worlds that are advanced together, at least 1.
        learners: vehicles that learn instead of the scenario's, by name (``vehicle_2``) or index from 0; any number.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what every vehicle observes, or a mapping from vehicles to what each does; None: the scenario's.
        seed: of the stream of worlds.

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
    )


def only_learner(engine: Engine) -> int:
    """Index of the one learner; ``InvalidInput`` when there is none or more than one."""
    check_one_learner(
        engine.scenario.name,
        [engine.scenario.vehicle_names[i] for i in engine.learners],
        "this environment needs exactly one: pass learners=['vehicle_2'], or use parallel_env or make_sb3_vec_env",
    )
    return engine.learners[0]


def learner_actions(engine: Engine, actions: Mapping[str, Any]) -> Floats | dict[int, Floats]:
    """The learners' actions of one world as [1, L], from an action [1] for each by name; behind a shield by vehicle.

    Raises ``InvalidInput`` naming the vehicle whose action is missing or misshapen; the engine checks the range. Behind
    a shield an action may be missing.
    """
    names, columns = engine.scenario.vehicle_names, np.empty((1, len(engine.learners)))
    for c, vehicle in enumerate(engine.learners):
        name = names[vehicle]
        if actions.get(name) is None:
            if engine.guard is not None:
                given = {i: actions[names[i]] for i in engine.learners if actions.get(names[i]) is not None}
                return {i: checked_action(each, (1,), names[i]) for i, each in given.items()}
            raise InvalidInput(f"step: no action for the learner {name}")
        action = actions[name]
        if type(action) is not np.ndarray or action.shape != (1,) or action.dtype.kind not in "fiu":
            action = checked_action(action, (1,), name)
        columns[0, c] = action.item()
    return columns


INITIAL_STATE = "initial_state"
LISTED_WORLD = "listed_world"
RESET_MASK = "reset_mask"


class UnknownResetOption(UserWarning):
    """A key of ``reset``'s options is not known to this environment; it is ignored."""


class IgnoredAction(UserWarning):
    """An action was passed for a vehicle that follows a script; it is ignored."""


def chosen_seed(seed: int | None) -> int:
    """A seed as it is; for None one of 63 bits from the operating system's entropy.

    Raises ``InvalidInput`` for what is neither None nor a whole number >= 0.
    """
    if seed is None:
        entropy = np.random.SeedSequence().entropy
        assert isinstance(entropy, int)  # always, when SeedSequence chooses it itself
        return entropy % 2**63  # fits the integers of every library that infos are handed to
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r}: must be None or a whole number, at least 0")
    return int(seed)


def _wanted_worlds(engine: Engine, options: Mapping[str, Any]) -> Worlds | None:
    """The worlds that the options ask for, one for each row; None for the stream's."""
    if LISTED_WORLD not in options:
        if INITIAL_STATE not in options:
            return None
        return engine.scenario.worlds_from_state(options[INITIAL_STATE]).take(np.zeros(engine.n, np.int64))
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
    """One warning for all option names that are not ``known``."""
    unknown = sorted({str(name) for name in options} - set(known))
    if unknown:
        names, right = ", ".join(unknown), ", ".join(known)
        warnings.warn(f"reset: unknown option {names}, ignored; known: {right}", UnknownResetOption, stacklevel=4)


# The draws behind the worlds of an environment: every quantity at the alert, type and scenario, as flat columns.
#
# Worlds are pure functions of scenario, seed and number, so nothing is kept while episodes run: it costs nothing until
# somebody asks, and then the worlds are drawn again.

_MOST_APART = 1024  # numbers between two worlds that are still drawn in one go

Columns = dict[str, NDArray[Any]]


def describe_worlds(engine: Engine) -> Columns:
    """What each running world was drawn as: column -> values [n].

    Quantities of the world at the alert, named as in a table of initial states (``gap_1_m``, ``mass_2_t``); where there
    is such, ``scenario`` of a mixture and ``vehicle_2_type``; and ``world_seed`` and ``world`` as in the infos. Where
    worlds were given and others have taken the places of some since, types are of these only. Raises ``InvalidInput``
    for worlds of which nobody knows: given ones after a snapshot was restored, or one that could not be advanced to its
    first decision, where another one stands in its place.
    """
    numbers, given = engine.roster.numbers, engine.roster.given
    named = {"world_seed": np.full(engine.n, engine.roster.seed), "world": numbers.copy()}
    own, found = numbers < 0, dict[str, NDArray[Any]]()
    if own.any():
        if given is None:
            raise InvalidInput(
                "describe_worlds: these episodes go on from a snapshot, which does not keep worlds that were given;"
                " ask again once they have ended, or after a reset"
            )
        found = QUANTITY.columns(given)
    if not own.all():
        sample = _drawn_again(engine, numbers[~own])
        drawn, started = {**sample.kinds, **QUANTITY.columns(sample.worlds)}, found
        found = {name: np.zeros(engine.n, column.dtype) for name, column in drawn.items()}
        for name, column in drawn.items():
            found[name][~own] = column
            if name in started:
                found[name][own] = started[name][own]
    return {**found, **named}


def _drawn_again(engine: Engine, numbers: Ints) -> Sample:
    """These worlds of the training stream, in the order of ``numbers``; ``InvalidInput`` if they do not run here."""
    ordered, places = np.unique(numbers, return_inverse=True)
    breaks = np.flatnonzero(np.diff(ordered) > _MOST_APART) + 1
    parts = []
    for run in np.split(ordered, breaks):
        first = int(run[0])
        span = engine.scenario.sample(int(run[-1]) - first + 1, engine.roster.seed, first=first, channel="training")
        parts.append(span.take(run - first))
    sample = Sample.join(parts, 0).take(places)
    rows = np.flatnonzero(engine.roster.numbers >= 0)
    running, drawn = engine.worlds.vehicles.take(rows), sample.worlds.vehicles
    same = np.ones(len(rows), np.bool_)
    rates = ("brake_rate_mps3", "release_rate_mps3")
    for name in ("mass_t", "braking_capacity_mps2", "driving_capacity_mps2", "latency_s", *rates):
        same &= (getattr(running, name) == getattr(drawn, name)).all(axis=1)
    if not same.all():
        k = int(rows[np.argmin(same)])
        raise InvalidInput(
            f"describe_worlds: world {engine.roster.numbers[k]} of seed {engine.roster.seed} could not be advanced to"
            f" its first decision; another one stands in row {k}"
        )
    return sample


# Infos of every interface, computed once for all vehicles of all worlds: the same keys after a reset and a step.
#
# ``time_s``, ``command_in_force_mps2`` (in force up to now; 0 up to the latency), ``chosen_command_mps2`` and
# ``chosen_action`` (what the vehicle asked for, whoever chose it; 0 before a learner's first step), the vehicle's share
# of the harm so far under both counts, the same for the whole world, and whether anything has collided. Of the last
# step: ``cost`` (the harm it added to the line, as the reward counts impacts; for safe-RL libraries) and
# ``reward_NAME``, each term of the reward before its weight; after a reset they are 0. ``world_seed`` and ``world``
# name the world, so that it can be played again (-1: it was given). Where the scenario has a ``v2x`` channel also
# ``known_from_s`` [N]: from when on this vehicle acts on news of each one (infinite: never; of itself: its latency);
# and where its messages are periodic ``age_s`` [N]: how old the newest sample is that it was told of each (infinite:
# none). Behind a shield also what that reports, as ``shield_NAME``.

COLUMNS = (
    "time_s",
    "command_in_force_mps2",
    "first_impact_harm",
    "total_harm",
    "world_first_impact_harm",
    "world_total_harm",
    "collided",
    "chosen_command_mps2",
    "chosen_action",
)
_FLOAT32 = np.dtype(np.float32)


def shield_columns(engine: Engine, rows: Ints | None = None) -> Columns:
    """What the shield in an engine reports, ``shield_NAME`` -> [n, N]; only of the worlds ``rows`` if given."""
    if engine.guard is None or engine.guarded is None:
        return {}
    every = slice(None) if rows is None else rows
    return {f"shield_{name}": column[every] for name, column in engine.guard.report(engine).items()}


def plain_rows(columns: Columns, vehicles: Ints, count: int) -> list[dict[str, Any]]:
    """Columns [n, N] as plain values by name, for each of these vehicles, world by world: ``count`` in all."""
    values = [column.take(vehicles, axis=1).reshape(-1).tolist() for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)] or [{} for _ in range(count)]


class Report(NamedTuple):
    """What there is to tell about n worlds of N vehicles."""

    values: Floats  # [n, N, len(COLUMNS)]
    cost: Floats  # [n] harm of the step (m2/s2); 0 without one
    terms: dict[str, Floats]  # reward terms of the step, each [n], shared by all vehicles, or [n, N]; 0 without one
    world_seed: int
    world: Ints  # [n] numbers in the stream of that seed
    known_from_s: Floats | None  # [n, N, N] where there is a channel
    age_s: Floats | None  # [n, N, N] where its messages are periodic
    shield: Columns  # each [n, N]; none without a shield

    @classmethod
    def of(cls, engine: Engine, step: Step | None = None, rows: Ints | None = None) -> Report:
        """The engine's worlds as they are now, before any of them is renewed; only the worlds ``rows`` if given."""
        (state, params), wanted, world = engine.packed, engine.wanted_mps2, engine.roster.numbers
        if rows is not None:
            state, params, wanted = (array.take(rows, axis=0) for array in (state, params, wanted))
            world = world.take(rows)
        values = np.empty((*wanted.shape, len(COLUMNS)))
        _report_rows(state, params, wanted, values)
        N = wanted.shape[1]
        shown = Packed(state, params)
        known = shown.known_from_s if shown.has_news else None
        cost = np.zeros(len(world))
        terms = dict.fromkeys(engine.reward_terms, cost)
        if step is not None:
            every = step.shared | step.further
            terms = {name: every[name] for name in engine.reward_terms}
            cost = step.counted_harm
            if rows is not None:
                cost, terms = cost.take(rows), {name: term.take(rows, axis=0) for name, term in terms.items()}
        time_s, messages = state[:, shown.column.time], params[:, shown.column.messages :]
        age = Messages(messages, N).age_s(time_s) if shown.has_messages else None
        return cls(values, cost, terms, engine.roster.seed, world, known, age, shield_columns(engine, rows))

    def columns(self) -> dict[str, Floats]:
        """What is told of every vehicle, by name, each [n, N]."""
        return {name: self.values[:, :, c] for c, name in enumerate(COLUMNS)}

    def plain_infos(self, vehicles: Ints) -> list[dict[str, Any]]:
        """Infos of these vehicles, world by world, as plain numbers; ``chosen_action`` is an array [1]."""
        worlds: list[list[list[Any]]] = self.values.take(vehicles, axis=1).tolist()
        numbers, costs = self.world.tolist(), self.cost.tolist()
        terms = {
            f"reward_{name}": (
                term[:, np.newaxis].repeat(len(vehicles), axis=1) if term.ndim == 1 else term[:, vehicles]
            ).tolist()
            for name, term in self.terms.items()
        }
        infos: list[dict[str, Any]] = []
        for k, world in enumerate(worlds):
            for v, (time, force, first, total, world_first, world_total, collided, chosen, action) in enumerate(world):
                chosen_action = np.empty(1, _FLOAT32)
                chosen_action[0] = action
                info = {
                    "time_s": time,
                    "command_in_force_mps2": force,
                    "first_impact_harm": first,
                    "total_harm": total,
                    "world_first_impact_harm": world_first,
                    "world_total_harm": world_total,
                    "collided": collided == 1.0,
                    "chosen_command_mps2": chosen,
                    "chosen_action": chosen_action,
                    "cost": costs[k],
                    "world_seed": self.world_seed,
                    "world": numbers[k],
                }
                infos.append(info | {name: term[k][v] for name, term in terms.items()})
        for name, news in (("known_from_s", self.known_from_s), ("age_s", self.age_s)):
            if news is not None:
                of_these = news.take(vehicles, axis=1)
                for info, row in zip(infos, of_these.reshape(-1, of_these.shape[2]), strict=True):
                    info[name] = row.copy()
        for info, of_shield in zip(infos, plain_rows(self.shield, vehicles, len(infos)), strict=True):
            info |= of_shield
        return infos

    def batch_info(self, vehicle: int, rows: Bools, stepped: Bools) -> dict[str, Any]:
        """One vehicle in many worlds as Gymnasium's vector infos: ``name`` [n] and its mask ``_name`` [n].

        The worlds marked by ``rows`` are told of. What a step brought is 0 but in the worlds marked by ``stepped``.
        """
        columns: dict[str, NDArray[Any]] = {name: told[:, vehicle] for name, told in self.columns().items()}
        columns["collided"] = columns["collided"] == 1.0
        columns["chosen_action"] = columns["chosen_action"].astype(np.float32)[:, np.newaxis]
        columns["cost"] = np.where(stepped, self.cost, 0.0)
        columns["world_seed"], columns["world"] = np.full(len(rows), self.world_seed), self.world
        for name, term in self.terms.items():
            columns[f"reward_{name}"] = np.where(stepped, term if term.ndim == 1 else term[:, vehicle], 0.0)
        if self.known_from_s is not None:
            columns["known_from_s"] = self.known_from_s[:, vehicle]
        if self.age_s is not None:
            columns["age_s"] = self.age_s[:, vehicle]
        columns |= {name: column[:, vehicle] for name, column in self.shield.items()}
        masked: dict[str, Any] = {}
        for name, column in columns.items():
            masked[name] = np.zeros_like(column, order="C")
            masked[name][rows] = column[rows]
            masked[f"_{name}"] = rows.copy()
        return masked


@compiled
def _report_rows(state: Floats, params: Floats, wanted: Floats, out: Floats) -> None:
    """Fill ``out`` [n, N, ...] with the columns of AFTER_A_STEP."""
    n, N = wanted.shape
    column = columns(state)
    P, harm, mass, obstacle = N - 1, column.harm, column.mass, column.obstacle
    for k in range(n):
        first, total, impacts = 0.0, 0.0, 0.0
        for i in range(N):
            out[k, i, 2] = 0.0
            out[k, i, 3] = 0.0
        if state.shape[1] > obstacle:
            first, total, impacts = state[k, obstacle + 2], state[k, obstacle + 3], state[k, obstacle + 4]
        for p in range(P):
            for count in range(2):
                value = state[k, harm + count * P + p]
                front = front_share(value, params[k, mass + p], params[k, mass + p + 1])
                out[k, p, 2 + count] += front
                out[k, p + 1, 2 + count] += value - front
            first += state[k, harm + p]
            total += state[k, harm + P + p]
            impacts += state[k, harm + 2 * P + p]
        if state.shape[1] > obstacle:  # after the pairs, as in the ledger
            out[k, 0, 2] += state[k, obstacle + 2]
            out[k, 0, 3] += state[k, obstacle + 3]
        for i in range(N):
            out[k, i, 0] = state[k, column.time]
            out[k, i, 1] = state[k, column.command + i]
            out[k, i, 4] = first
            out[k, i, 5] = total
            out[k, i, 6] = 1.0 if impacts > 0.0 else 0.0
            out[k, i, 7] = wanted[k, i]
            braking, driving = params[k, column.braking + i], params[k, column.driving + i]
            out[k, i, 8] = action_of(wanted[k, i], braking, driving)


class Begun:
    """What the interfaces share: an engine in which episodes have begun, or not yet, and the seed of its worlds.

    ``np_random`` and ``np_random_seed`` mean what they mean in ``gymnasium.Env``.
    """

    engine: Engine
    _known_options: Sequence[str] = (INITIAL_STATE, LISTED_WORLD)
    _started = False
    _goes_on = False  # a reset without a seed goes on in the running stream
    _np_random: np.random.Generator | None = None
    _np_random_seed: int | None = None  # -1: nobody knows, since the user set the generator

    @property
    def np_random(self) -> np.random.Generator:
        """A generator for wrappers to draw from; the worlds come from ``np_random_seed`` alone.

        Once you set another generator, each ``reset`` without a seed draws the seed of its worlds from it, until a
        ``reset`` with one.
        """
        if self._np_random is None:
            self._set_seed(chosen_seed(None))
            assert self._np_random is not None
        return self._np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        if not isinstance(generator, np.random.Generator):
            raise InvalidInput(f"np_random = {generator!r}: must be a numpy.random.Generator")
        self._np_random, self._np_random_seed, self._goes_on = generator, -1, False

    @property
    def np_random_seed(self) -> int:
        """Seed of the stream of worlds, from fresh entropy where nobody named one; -1 once ``np_random`` was set."""
        if self._np_random_seed is None:
            self._set_seed(chosen_seed(None))
            assert self._np_random_seed is not None
        return self._np_random_seed

    def _set_seed(self, seed: int) -> None:
        self._np_random, self._np_random_seed = np.random.default_rng(seed), seed

    def _restart(self, seed: int | None, options: Mapping[str, Any] | None) -> None:
        """Start new episodes in all worlds: the stream of ``seed`` from its start, or where the stream stands.

        ``options["initial_state"]`` (see ``Scenario.worlds_from_state``) is the start of every world instead;
        ``options["listed_world"] = {"seed": 7, "number": 3}`` starts in that world of the list on which agents are
        evaluated, a batch in that one and those after it. With autoreset, later episodes come from the stream. Other
        options warn with ``UnknownResetOption`` and are ignored. Raises ``InvalidInput``, with nothing changed, for a
        seed that is not a whole number >= 0, a bad initial state or listed world, or both of them.
        """
        named = None if seed is None else chosen_seed(seed)
        if not (options is None or isinstance(options, Mapping)):
            raise InvalidInput(
                f"reset: options = {options!r}: must be None or a mapping, for instance {{'{INITIAL_STATE}': ...}}"
            )
        warn_of_unknown(options or (), self._known_options)
        self._begin(named, _wanted_worlds(self.engine, options or {}))

    def _begin(self, seed: int | None, worlds: Worlds | None) -> None:
        """Start these worlds, or those of the stream: of ``seed``, of the user's generator, or where it stands."""
        drawn, used = seed is None and self._np_random_seed == -1, seed
        if drawn:
            used = int(copy.deepcopy(self.np_random).integers(2**63))  # a copy: the reset may still be refused
        elif seed is None and not self._goes_on:
            used = self.np_random_seed
        self.engine.reset(seed=used, worlds=worlds)
        if drawn:
            self.np_random.integers(2**63)
        elif seed is not None:
            self._set_seed(seed)
        self._started = self._goes_on = True

    def _check_started(self, what: str) -> None:
        if not self._started:
            raise InvalidInput(f"{what}: no episode was started; call reset first")

    def describe_worlds(self) -> Columns:
        """What each running world was drawn as: columns by name, each [worlds]; see ``describe_worlds`` of the file."""
        self._check_started("describe_worlds")
        return describe_worlds(self.engine)


class _OneWorld(Begun):
    """... of one world, which is shown by a viewer."""

    viewer: Viewer

    def describe_world(self) -> dict[str, Any]:
        """What the running world was drawn as: flat numbers and texts by name; see ``describe_worlds``."""
        self._check_started("describe_world")
        return {name: column[0].item() for name, column in describe_worlds(self.engine).items()}

    def render(self) -> Any:
        """What the render mode says: a frame [H, W, 3] uint8, a list of new ones, a text, or None for ``human``."""
        return self.viewer.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.viewer.close()


# Gymnasium's interface: one learner, one world.


class _Specified:
    """What Gymnasium makes by an id: ``spec`` says how, in settings that JSON keeps."""

    engine: Engine
    max_episode_steps: int | None = None
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How it was made; None where no id was used. No episode has more than its ``max_episode_steps``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            kwargs = {name: _plain(value) for name, value in spec.kwargs.items()}
            if kwargs.get("learners") is not None:  # any iterable, perhaps used up
                kwargs["learners"] = [self.engine.scenario.vehicle_names[i] for i in self.engine.learners]
            scenario = self.engine.scenario
            from_alert = int(Decisions(np.zeros(1), scenario.time_step_s).before(scenario.horizon_s)[0])
            spec = replace(spec, kwargs=kwargs, max_episode_steps=self.max_episode_steps or from_alert)
        self._spec = spec


def _plain(setting: Any) -> Any:
    """A setting of an environment as JSON keeps it."""
    if isinstance(setting, Scenario):
        return setting.declared()
    if isinstance(setting, RewardParams):
        return setting.model_dump(mode="json")
    if isinstance(setting, ObservationSpec):
        return asdict(setting)
    if isinstance(setting, Path):
        return str(setting)
    if isinstance(setting, AutoresetMode):
        return setting.value
    if isinstance(setting, np.generic | np.ndarray):
        return setting.tolist()
    if isinstance(setting, Mapping):
        return {name: _plain(value) for name, value in setting.items()}
    return [_plain(value) for value in setting] if isinstance(setting, list | tuple) else setting


class EthBrakeEnv(_OneWorld, _Specified, gymnasium.Env[Observations, NDArray[Any]]):
    """One learner brakes in a line of vehicles that follow their scripts: ``gymnasium.make("EthBrake-v0")``.

    Observation: float32 [F], the features of ``ObservationSpec``. Action: [1] in [-1, 1]; -1 full braking capacity, 0
    coasts, +1 full driving capacity. Terminated: all at rest and no command that would move one. Truncated: the
    horizon. Infos: see docs/infos.md. ``reset(seed=s)`` starts the stream of worlds of s, ``reset()`` goes on in
    it; ``options={"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}}`` starts from there. Raises
    ``InvalidInput`` for more or fewer than one learner, an action outside [-1, 1], a step without an episode.

    Args:
        scenario: a shipped name, the path of a YAML file, or a ``Scenario``.
        render_mode: ``human``, ``rgb_array``, ``rgb_array_list``, ``ansi``, or None (docs/watching.md).
        learners: the one vehicle that learns instead of the scenario's, by name (``vehicle_2``) or index from 0.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what the learner observes; None: ``observation_for(scenario)``.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random")
    >>> observation, info = env.reset(seed=7)
    >>> observation.shape, info["time_s"]
    ((27,), 0.5)
    >>> observation, reward, terminated, truncated, info = env.step([-1.0])
    >>> reward, terminated, truncated
    (0.0, False, False)

    """

    metadata: dict[str, Any] = dict(Viewer.METADATA)  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
    ) -> None:
        self.engine = make_engine(scenario, 1, learners=learners, reward=reward, observation=observation)
        self.render_mode, self.viewer = render_mode, Viewer(self.engine, render_mode)
        self.metadata = {**self.metadata, **self.viewer.metadata}
        self.learner = only_learner(self.engine)
        self._column = np.array([self.learner])
        self._name = self.engine.scenario.vehicle_names[self.learner]
        self.observation_space = feature_box(self.engine.observations[self.learner].features)
        self.action_space = action_box()
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; see docs/episodes.md."""
        self._restart(seed, options)
        self._running = True
        self.viewer.began()
        return self._observe(), Report.of(self.engine).plain_infos(self._column)[0]

    def step(self, action: NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Advance by one time step."""
        if not self._running:
            raise InvalidInput("step: no episode is running; call reset first")
        step = self.engine.step(learner_actions(self.engine, {self._name: action}))
        self._running = not step.ended[0]
        if self.render_mode is not None:
            self.viewer.play()
        info = Report.of(self.engine, step).plain_infos(self._column)[0]
        reward = float(step.reward[0, self.learner])
        return self._observe(), reward, bool(step.terminated[0]), bool(step.truncated[0]), info

    def _observe(self) -> Observations:
        observation: Observations = self.engine.observe(self.learner)[0].copy()
        return observation


# Gymnasium's vector interface: one learner, many worlds, advanced together.


class CostEnv(gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]]):
    """Cost as a value of its own: ``step`` gives observation, reward, cost, terminated, truncated, info.

    That is what Safety-Gymnasium gives and OmniSafe expects. Cost is the harm that the step added to the line (m2/s2),
    as the reward counts impacts, whatever else the reward says.

    Args:
        env: ``EthBrakeEnv``, or anything around it that hands on its infos.

    Raises ``InvalidInput`` if ``env`` is another, or has a cost of its own already.

    >>> import ethbrake_marl as eb
    >>> env = eb.CostEnv(eb.EthBrakeEnv("paper-random"))
    >>> observation, info = env.reset(seed=7)
    >>> observation, reward, cost, terminated, truncated, info = env.step(env.action_space.sample())

    """

    def __init__(self, env: gymnasium.Env[Observations, NDArray[Any]]) -> None:
        if not isinstance(getattr(env, "unwrapped", None), EthBrakeEnv):
            raise InvalidInput(f"CostEnv: {env!r:.80} tells no cost; must be an EthBrakeEnv, or a wrapper of one")
        within = env
        while isinstance(within, gymnasium.Wrapper):
            if isinstance(within, CostEnv):
                raise InvalidInput(f"CostEnv: {env!r:.80} has one inside; leave one out")
            within = within.env
        super().__init__(env)

    def step(  # type: ignore[override]  # six values, as safe-RL libraries have it
        self, action: NDArray[Any]
    ) -> tuple[Observations, float, float, bool, bool, dict[str, Any]]:
        """One decision; see ``EthBrakeEnv.step``."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "cost" not in info:
            raise InvalidInput(f"CostEnv: {self.env!r:.80} hands on no info['cost']; put CostEnv inside it")
        return observation, float(reward), info["cost"], terminated, truncated, info


class EthBrakeVectorEnv(Begun, _Specified, VectorEnv[Observations, NDArray[Any], NDArray[Any]]):
    """Many worlds of ``EthBrakeEnv``: ``gymnasium.make_vec("EthBrake-v0", num_envs=4096, scenario=...)``.

    All worlds take their episodes from one stream: row k of ``reset(seed=s)`` is world k of s, and each new episode is
    the next world of it. Every array that is returned has its own memory.

    Args:
        num_envs: worlds that are advanced together, at least 1.
        scenario: a shipped name, the path of a YAML file, or a ``Scenario``.
        render_mode: ``rgb_array``, ``ansi``, or None; ``render`` gives one frame or text for each world.
        learners: the one vehicle that learns instead of the scenario's, by name (``vehicle_2``) or index from 0.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what the learner observes; None: ``observation_for(scenario)``.
        autoreset_mode: Gymnasium's. ``NextStep``, its default and ours, returns the last observation and spends the
            next step, whose action is ignored and whose reward is 0, on the reset. ``SameStep`` returns the first
            observation of the new episode, with the last one of the old in ``infos["final_obs"]`` and its infos in
            ``infos["final_info"]``. ``Disabled`` never resets: the next step wants ended rows reset by hand.
        max_episode_steps: truncates an episode after so many steps; None: the horizon does.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.EthBrakeVectorEnv(num_envs=4, scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> observations, rewards, terminated, truncated, infos = env.step(np.full((4, 1), -1.0))
    >>> observations.shape, rewards.shape
    ((4, 27), (4,))

    """

    _known_options = (INITIAL_STATE, LISTED_WORLD, RESET_MASK)

    def __init__(
        self,
        num_envs: int = 1,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
    ) -> None:
        if max_episode_steps is not None:
            check_whole_number("max_episode_steps", max_episode_steps, 1)
        self.max_episode_steps = max_episode_steps
        self.autoreset_mode = _check_mode(autoreset_mode)
        self.engine = make_engine(scenario, num_envs, learners=learners, reward=reward, observation=observation)
        self.render_mode, self.viewer = render_mode, Viewer(self.engine, render_mode, batch=True)
        self.metadata = {"autoreset_mode": self.autoreset_mode, **self.viewer.metadata}
        self.learner = only_learner(self.engine)
        self.num_envs = num_envs
        self.single_observation_space = feature_box(self.engine.observations[self.learner].features)
        self.single_action_space = action_box()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every world, or where ``options["reset_mask"]`` says; see docs/episodes.md."""
        rows = self._rows_to_reset(options)
        if rows.all():
            self._restart(seed, options)
        else:
            self._renew(rows, seed, options or {})
        told = Report.of(self.engine).batch_info(self.learner, rows, np.zeros(self.num_envs, np.bool_))
        return self.engine.observe(self.learner), told

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step, and start new episodes as the autoreset mode says."""
        if not self._started:
            raise InvalidInput("step: no episode is running; call reset first")
        engine, before = self.engine, self.engine.ended
        if self.autoreset_mode is AutoresetMode.DISABLED and before.any():
            over = ", ".join(str(row) for row in np.flatnonzero(before))
            raise InvalidInput(
                f"step: episodes are over in rows {over}; reset(options={{'reset_mask': ...}}) them first"
            )
        step = engine.step(self._fill_ignored(actions, before))
        if self.max_episode_steps is not None:
            engine.cut(step, self.max_episode_steps)
        # all that have ended: an interrupted step may have left some that nobody renewed
        renewed = engine.ended if self.autoreset_mode is AutoresetMode.SAME_STEP else before
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and renewed.any():
            infos = self._final_infos(step)
        engine.renew(np.flatnonzero(renewed))
        every = np.ones(self.num_envs, np.bool_)
        infos |= Report.of(engine, step).batch_info(self.learner, every, ~renewed)
        reward = step.reward[:, self.learner].copy()
        return engine.observe(self.learner), reward, step.terminated, step.truncated, infos

    def render(self) -> tuple[Any, ...]:
        """A frame [H, W, 3] uint8, or a text, of every world; of a world that has just been renewed, its start."""
        return tuple(self.viewer.render())

    def _fill_ignored(self, actions: NDArray[Any], before: Bools) -> NDArray[Any]:
        """The actions with those that the autoreset mode ignores replaced: their worlds had ended ``before``."""
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP or not before.any():
            return actions
        heeded = own_actions(actions, "the learners")
        if heeded.shape[:1] == (self.num_envs,):
            heeded[before] = 0.0
        return heeded

    def _rows_to_reset(self, options: Any) -> Bools:
        """The rows [n] that ``options["reset_mask"]`` marks; all without one. ``InvalidInput`` for what is no mask."""
        if not isinstance(options, Mapping) or RESET_MASK not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options[RESET_MASK]
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not is_mask or np.ma.is_masked(mask) or not mask.any():
            raise InvalidInput(
                f"reset: {RESET_MASK} = {mask!r}: must be an array of {self.num_envs} truth values, one of them True"
            )
        return np.array(mask)

    def _renew(self, rows: Bools, seed: int | None, options: Mapping[str, Any]) -> None:
        """Start the next episodes of the stream in these rows, as an automatic reset does; the others go on."""
        warn_of_unknown(options, self._known_options)
        starts = [name for name in (INITIAL_STATE, LISTED_WORLD) if name in options]
        starts += ["seed"] * (seed is not None)
        if starts or not self._goes_on:
            what = " and ".join(starts) or ("np_random" if self._started else "the first reset")
            raise InvalidInput(f"reset: {what} with a {RESET_MASK} that leaves rows out: must start all rows")
        self.engine.renew(np.flatnonzero(rows))

    def _final_infos(self, step: Step) -> dict[str, Any]:
        """The last observation and infos of the episodes that ended with this step."""
        ended = step.ended
        observations = self.engine.observe(self.learner)
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            final[row] = observations[row].copy()
        info = Report.of(self.engine, step).batch_info(self.learner, ended, ended)
        return {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended.copy()}


def _check_mode(mode: str | AutoresetMode) -> AutoresetMode:
    for known in AutoresetMode:
        if mode in (known, known.value):
            return known
    raise InvalidInput(f"autoreset_mode = {mode!r}: must be {' or '.join(repr(m.value) for m in AutoresetMode)}")


# PettingZoo's interface: the vehicles of one world are agents, to the end; and around it the one
# in which they act in turn (AEC).


class SeededInside:
    """A wrapper of PettingZoo's or SB3's whose ``np_random`` is that of the environment inside, also when it is set."""

    unwrapped: Any

    @property
    def np_random(self) -> np.random.Generator:
        """See ``EthBrakeParallelEnv.np_random``."""
        generator: np.random.Generator = self.unwrapped.np_random
        return generator

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self.unwrapped.np_random = generator

    @property
    def np_random_seed(self) -> int:
        """See ``EthBrakeParallelEnv.np_random_seed``."""
        seed: int = self.unwrapped.np_random_seed
        return seed


class Ordered(SeededInside, OrderEnforcingWrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """PettingZoo's, seeded inside."""

    def __str__(self) -> str:
        return str(self.env)


class InTurns(SeededInside, parallel_to_aec_wrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """As PettingZoo's, but an unusable action is refused in its agent's own turn, which stays: nothing is lost."""

    @classmethod
    def around(cls, env: ParallelEnv[str, Observations, NDArray[Any]]) -> AECEnv[str, Observations, NDArray[Any]]:
        """The AEC environment of a parallel one of this package, whatever wraps it; order is enforced."""
        return Ordered(cls(env))

    def step(self, action: Any) -> None:
        """Take the action of ``agent_selection``; the last one's advances all by one step.

        Raises ``InvalidInput`` for an unusable action of a learner, and for any but None once its episode is over.
        """
        agent, engine = self.agent_selection, self.env.unwrapped.engine
        assert isinstance(engine, Engine)
        if self.terminations[agent] or self.truncations[agent]:
            if action is not None:
                raise InvalidInput(f"step: the episode of {agent} is over; only None may follow, or reset")
        elif engine.scenario.vehicle_names.index(agent) in engine.learners and not (action is None and engine.guard):
            checked_action(action, (1,), agent)  # left out: a shield may choose alone
        super().step(action)


Infos = dict[str, dict[str, Any]]
WhoIsAgent = Literal["all", "learners"]


class EthBrakeParallelEnv(_OneWorld, ParallelEnv[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """A line of vehicles ``vehicle_1`` (front) ... ``vehicle_N``, all of them agents from the alert to the end.

    Learners need an action [1] in [-1, 1] in each step: -1 full braking capacity, 0 coasts, +1 full driving capacity.
    What is passed for scripted vehicles is ignored; ``infos[agent]`` shows what their script did. All agents end
    together: terminated when all are at rest and no command would move one, truncated at the horizon. ``state()`` is
    the full state of the line, for central critics. Observations, rewards, infos and ``reset`` are those of
    ``EthBrakeEnv``.

    Args:
        scenario: a shipped name, the path of a YAML file, its content as a mapping, or a ``Scenario``.
        render_mode: ``human``, ``rgb_array``, ``rgb_array_list``, ``ansi``, or None (docs/watching.md).
        learners: vehicles that learn instead of the scenario's, by name (``vehicle_2``) or index from 0; any number.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what every vehicle observes, or by name what each does; None: the scenario's.
        agents: ``all`` vehicles, or ``learners`` only, for trainers that learn from every agent.
        max_cycles: truncates an episode after so many steps, if it is not over before; None: the horizon does.

    >>> import ethbrake_marl as eb
    >>> env = eb.parallel_env(scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> while env.agents:
    ...     observations, rewards, terminations, truncations, infos = env.step({"vehicle_2": [-1.0]})
    >>> terminations["vehicle_2"], round(infos["vehicle_2"]["world_total_harm"], 2)
    (True, 39.95)

    """

    metadata: dict[str, Any] = {"name": "ethbrake_v0", "is_parallelizable": True, **Viewer.METADATA}  # noqa: RUF012

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
        agents: WhoIsAgent = "all",
        max_cycles: int | None = None,
    ) -> None:
        if max_cycles is not None:
            check_whole_number("max_cycles", max_cycles, 1)
        self.render_mode, self.max_cycles = render_mode, max_cycles
        self.engine = make_engine(scenario, 1, learners=learners, reward=reward, observation=observation)
        self.viewer = Viewer(self.engine, render_mode)
        self.metadata = {**self.metadata, **self.viewer.metadata}
        names = self.engine.scenario.vehicle_names
        self._vehicles = _agent_vehicles(self.engine, agents)
        self.possible_agents = [names[i] for i in self._vehicles.tolist()]
        self.agents: list[str] = []
        learners = [names[i] for i in self.engine.learners]
        self._scripted = [agent for agent in self.possible_agents if agent not in learners]  # to be warned of, once
        seen = self.engine.observations
        self._alike = len({seen[i] for i in self._vehicles.tolist()}) == 1
        self.observation_spaces = {names[i]: feature_box(seen[i].features) for i in self._vehicles.tolist()}
        self.action_spaces = {agent: action_box() for agent in self.possible_agents}
        self.state_space = feature_box(state_features(self.engine.scenario))

    def observation_space(self, agent: str) -> Any:
        """Float32 box [F], the same object on each call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Float32 box [1], the same object on each call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], Infos]:
        """Start an episode; see docs/episodes.md."""
        self._restart(seed, options)
        self.agents = self.possible_agents[:]
        self.viewer.began()
        return self._observations(), self._infos(Report.of(self.engine))

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Observations], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Advance by one time step. Raises ``InvalidInput`` naming the agent whose action is missing or unusable."""
        if not self.agents:
            raise InvalidInput("step: no episode is running; call reset first")
        if not isinstance(actions, (dict, Mapping)):  # dict first: it is found out sooner
            raise InvalidInput(f"step: actions = {actions!r}: must be a mapping such as {{'vehicle_2': [-1.0]}}")
        for agent in actions:
            if agent not in self.action_spaces:
                raise unknown_name("agent", agent, self.possible_agents)
        if self._scripted:
            self._warn_of_ignored(actions)
        step = self.engine.step(learner_actions(self.engine, actions))
        agents = self.possible_agents
        (rewards,) = step.reward.take(self._vehicles, axis=1).tolist()
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        if self.max_cycles is not None and not terminated:
            truncated = truncated or int(self.engine.steps[0]) >= self.max_cycles
        infos = self._infos(Report.of(self.engine, step))
        if terminated or truncated:
            self.agents = []
        if self.render_mode is not None:
            self.viewer.play()
        return (
            self._observations(),
            dict(zip(agents, rewards, strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            infos,
        )

    def state(self) -> Observations:
        """The full state of all vehicles, float32 [S] within ``state_space``."""
        self._check_started("state")
        state: Observations = full_state(self.engine.worlds, self.engine.scenario)[0].copy()
        return state

    def _warn_of_ignored(self, actions: Mapping[str, Any]) -> None:
        """Warn once of actions that are ignored, since their vehicles follow scripts."""
        ignored = [agent for agent in self._scripted if actions.get(agent) is not None]
        if not ignored:
            return
        self._scripted = []
        learners = [self.engine.scenario.vehicle_names[i] for i in self.engine.learners]
        right = "nobody learns: name learners, for instance learners=['vehicle_2']"
        if learners:
            right = f"with agents='learners' the environment has the learners alone: {', '.join(learners)}"
        text = f"step: actions of {', '.join(ignored)} are ignored, as scripts drive them; {right}"
        warnings.warn(text, IgnoredAction, stacklevel=3)

    def _observations(self) -> dict[str, Observations]:
        if not self._alike:
            each = (self.engine.observe(vehicle)[0] for vehicle in self._vehicles.tolist())
            return dict(zip(self.possible_agents, each, strict=True))
        every = self.engine.observe_all(self._vehicles)
        return {agent: every[0, i] for i, agent in enumerate(self.possible_agents)}

    def _infos(self, told: Report) -> Infos:
        return dict(zip(self.possible_agents, told.plain_infos(self._vehicles), strict=True))


def _agent_vehicles(engine: Engine, agents: WhoIsAgent) -> Ints:
    """Indices of the vehicles that are agents."""
    if agents not in get_args(WhoIsAgent):
        raise InvalidInput(f"agents = {agents!r}: must be 'all' or 'learners'")
    if agents == "all":
        return np.arange(engine.scenario.vehicles)
    if not engine.learners:
        raise InvalidInput(
            f"agents = 'learners': nobody learns in {engine.scenario.name!r}; name learners, or take 'all'"
        )
    return np.array(engine.learners)


parallel_env = EthBrakeParallelEnv


def raw_env(scenario: AnyScenario = "paper-random", **settings: Any) -> AECEnv[str, Observations, NDArray[Any]]:
    """The same environment with agents acting in turn (AEC), front to rear; arguments as ``parallel_env``.

    >>> import ethbrake_marl as eb
    >>> env = eb.raw_env("paper-random")
    >>> env.reset(seed=7)
    >>> env.agent_selection
    'vehicle_1'

    """
    return InTurns.around(parallel_env(scenario, **settings))


def env(scenario: AnyScenario = "paper-random", **settings: Any) -> AECEnv[str, Observations, NDArray[Any]]:
    """The AEC environment with PettingZoo's usual wrapper, order enforcement, which ``raw_env`` already has.

    Actions are not clipped and nothing ends an episode early: an unusable action is an ``InvalidInput`` in its agent's
    turn, which stays.
    """
    return raw_env(scenario, **settings)
