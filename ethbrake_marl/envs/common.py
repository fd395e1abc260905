"""Spaces of observations, states and actions."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from numpy.typing import NDArray

from ethbrake_marl.actions import action_of, checked_action
from ethbrake_marl.agents import script_agents
from ethbrake_marl.engine import Engine, Step
from ethbrake_marl.errors import InvalidInput, check_one_learner, check_whole_number
from ethbrake_marl.harm import front_share
from ethbrake_marl.observations import Feature, Observation, ObservationSpec, choose_observation
from ethbrake_marl.physics import Bools, Floats, Ints, Messages, Packed, Worlds, columns, compiled
from ethbrake_marl.rewards import Reward, RewardParams
from ethbrake_marl.scenario import QUANTITY, Sample, Scenario, load_scenario

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
                given = {
                    i: np.atleast_1d(actions[names[i]]) for i in engine.learners if actions.get(names[i]) is not None
                }
                return {i: checked_action(each, (1,), names[i]) for i, each in given.items()}
            raise InvalidInput(f"step: no action for the learner {name}")
        action = np.asarray(actions[name])
        if action.shape != (1,) or action.dtype.kind not in "fiu":
            action = checked_action(actions[name], (1,), name)
        columns[0, c] = action.item()
    return columns


def resolve_scenario(scenario: AnyScenario) -> Scenario:
    """The scenario of a shipped name, of a YAML file, of what such a file would say, or itself."""
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

    ``options["initial_state"]`` (see ``Scenario.worlds_from_state``) is the start of every world instead;
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


# The draws behind the worlds of an environment: every quantity at the alert, type and scenario, as flat columns.
#
# Worlds are pure functions of scenario, seed and number, so nothing is kept while episodes run: it costs nothing until
# somebody asks, and then the worlds are drawn again.

_MOST_APART = 1024  # numbers between two worlds that are still drawn in one go

Columns = dict[str, NDArray[Any]]


def describe_worlds(engine: Engine) -> Columns:
    """What each running world was drawn as: column -> values [n].

    Quantities of the world at the alert, named as in a table of initial states (``gap_1_m``, ``mass_2_t``); where there
    is such, ``scenario`` of a mixture and ``vehicle_2_type``; and ``world_seed`` and ``world`` as in the infos. Raises
    ``InvalidInput`` for worlds of which nobody knows: after a snapshot was restored, or where a world could not be
    advanced to its first decision and another one stands in its place.
    """
    numbers, given = engine.roster.numbers, engine.roster.given
    named = {"world_seed": np.full(engine.n, engine.roster.seed), "world": numbers.copy()}
    if (numbers < 0).all() and given is not None:
        return {**QUANTITY.columns(given), **named}
    if (numbers < 0).any():
        return _describe_mixed(engine, named)
    sample = _drawn_again(engine, numbers)
    _check_same(engine, sample.worlds)
    return {**sample.kinds, **QUANTITY.columns(sample.worlds), **named}


def describe_world(engine: Engine) -> dict[str, Any]:
    """The same of the only world, as plain numbers and texts."""
    return {name: column[0].item() for name, column in describe_worlds(engine).items()}


def _describe_mixed(engine: Engine, named: Columns) -> Columns:
    """Of a batch in which some worlds were given, and others have taken their places since; types are of these only."""
    numbers, given = engine.roster.numbers, engine.roster.given
    if given is None:
        raise InvalidInput(
            "describe_worlds: these episodes go on from a snapshot, which does not keep what they were drawn as; ask"
            " again once they have ended, or after a reset"
        )
    own = numbers < 0
    found: Columns = {}
    renewed = _drawn_again(engine, numbers[~own])
    _check_same(engine, renewed.worlds, np.flatnonzero(~own))
    drawn = {**renewed.kinds, **QUANTITY.columns(renewed.worlds)}
    started = QUANTITY.columns(given.take(own))
    for name, column in drawn.items():
        found[name] = np.zeros(engine.n, column.dtype)
        found[name][~own] = column
        if name in started:
            found[name][own] = started[name]
    return {**found, **named}


def _drawn_again(engine: Engine, numbers: Ints) -> Sample:
    """These worlds of the training stream, in the order of ``numbers``."""
    ordered, places = np.unique(numbers, return_inverse=True)
    breaks = np.flatnonzero(np.diff(ordered) > _MOST_APART) + 1
    parts = []
    for run in np.split(ordered, breaks):
        first = int(run[0])
        span = engine.scenario.sample(int(run[-1]) - first + 1, engine.roster.seed, first=first, channel="training")
        parts.append(span.take(run - first))
    return Sample.join(parts, 0).take(places)


def _check_same(engine: Engine, drawn: Worlds, rows: Ints | None = None) -> None:
    """Refuse worlds that do not stand in the engine."""
    running = engine.worlds.vehicles if rows is None else engine.worlds.vehicles.take(rows)
    same = np.ones(drawn.n, np.bool_)
    for name in ("mass_t", "braking_capacity_mps2", "driving_capacity_mps2", "latency_s"):
        same &= (getattr(running, name) == getattr(drawn.vehicles, name)).all(axis=1)
    if not same.all():
        k = int(np.argmin(same)) if rows is None else int(rows[np.argmin(same)])
        raise InvalidInput(
            f"describe_worlds: world {engine.roster.numbers[k]} of seed {engine.roster.seed} could not be advanced to"
            f" its first decision; another one stands in row {k}"
        )


# Infos of every interface, computed once for all vehicles of all worlds: the same keys after a reset and a step.
#
# ``time_s``, ``command_in_force_mps2`` (in force now; 0 until the latency has elapsed), ``chosen_command_mps2`` and
# ``chosen_action`` (what the vehicle asked for, whoever chose it; 0 before a learner's first step), the vehicle's share
# of the harm so far under both counts, the same for the whole world, and whether anything has collided. Of the last
# step: ``cost`` (the harm it added to the line, as the reward counts impacts; for safe-RL libraries) and
# ``reward_NAME``, each term of the reward before its weight; after a reset they are 0. ``world_seed`` and ``world``
# name the world, so that it can be played again (-1: it was given). Where the scenario has a ``v2x`` channel also
# ``known_from_s`` [N]: from when on this vehicle acts on news of each one (infinite: never; of itself: its latency);
# and where its messages are periodic ``age_s`` [N]: how old the newest sample is that it was told of each (infinite:
# none).

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


class Report(NamedTuple):
    """What there is to tell about n worlds of N vehicles."""

    values: Floats  # [n, N, len(COLUMNS)]
    cost: Floats  # [n] harm of the step (m2/s2); 0 without one
    terms: dict[str, Floats]  # reward terms of the step, each [n], shared by all vehicles, or [n, N]; 0 without one
    world_seed: int
    world: Ints  # [n] numbers in the stream of that seed
    known_from_s: Floats | None  # [n, N, N] where there is a channel
    age_s: Floats | None  # [n, N, N] where its messages are periodic


def report(engine: Engine, step: Step | None = None, rows: Ints | None = None) -> Report:
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
    cost, terms = _of_the_step(engine, step, rows)
    time_s, messages = state[:, shown.column.time], params[:, shown.column.messages :]
    age = Messages(messages, N).age_s(time_s) if shown.has_messages else None
    return Report(values, cost, terms, engine.roster.seed, world, known, age)


def _of_the_step(engine: Engine, step: Step | None, rows: Ints | None) -> tuple[Floats, dict[str, Floats]]:
    """Cost and reward terms of a step in these worlds; without a step both are 0."""
    if step is None:
        nothing = np.zeros(engine.n if rows is None else len(rows))
        return nothing, dict.fromkeys(engine.reward_terms, nothing)
    every = step.shared | step.further
    terms = {name: every[name] for name in engine.reward_terms}
    if rows is None:
        return step.counted_harm, terms
    return step.counted_harm.take(rows), {name: term.take(rows, axis=0) for name, term in terms.items()}


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


def plain_infos(told: Report, vehicles: Ints | None = None) -> list[dict[str, Any]]:
    """Infos of these vehicles (None: of all), world by world, as plain numbers; ``chosen_action`` is an array [1]."""
    shown = np.arange(told.values.shape[1]) if vehicles is None else vehicles
    worlds: list[list[list[Any]]] = told.values.take(shown, axis=1).tolist()
    numbers, costs = told.world.tolist(), told.cost.tolist()
    terms = [(f"reward_{name}", _by_vehicle(term, shown)) for name, term in told.terms.items()]
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
                "world_seed": told.world_seed,
                "world": numbers[k],
            }
            for name, term in terms:
                info[name] = term[k][v]
            infos.append(info)
    for name, news in (("known_from_s", told.known_from_s), ("age_s", told.age_s)):
        if news is not None:
            of_shown = news.take(shown, axis=1)
            for info, row in zip(infos, of_shown.reshape(-1, of_shown.shape[2]), strict=True):
                info[name] = row.copy()
    return infos


def _by_vehicle(term: Floats, vehicles: Ints) -> list[list[float]]:
    """A term of every world and of these vehicles, [n][V]."""
    each = term[:, np.newaxis].repeat(len(vehicles), axis=1) if term.ndim == 1 else term.take(vehicles, axis=1)
    values: list[list[float]] = each.tolist()
    return values


def batch_info(told: Report, vehicle: int, rows: Bools, stepped: Bools) -> dict[str, Any]:
    """One vehicle in many worlds as Gymnasium's vector infos: ``name`` [n] and its mask ``_name`` [n].

    The worlds marked by ``rows`` are told of. What a step brought is 0 but in the worlds marked by ``stepped``.
    """
    columns: dict[str, NDArray[Any]] = {name: told.values[:, vehicle, c] for c, name in enumerate(COLUMNS)}
    columns["collided"] = columns["collided"] == 1.0
    columns["chosen_action"] = columns["chosen_action"].astype(np.float32)[:, np.newaxis]
    columns["cost"] = np.where(stepped, told.cost, 0.0)
    columns["world_seed"], columns["world"] = np.full(len(rows), told.world_seed), told.world
    for name, term in told.terms.items():
        columns[f"reward_{name}"] = np.where(stepped, term if term.ndim == 1 else term[:, vehicle], 0.0)
    if told.known_from_s is not None:
        columns["known_from_s"] = told.known_from_s[:, vehicle]
    if told.age_s is not None:
        columns["age_s"] = told.age_s[:, vehicle]
    return _mask(columns, rows)


def _mask(columns: dict[str, NDArray[Any]], rows: Bools) -> dict[str, Any]:
    """Each column where ``rows`` marks it, else zeros, and its mask beside it."""
    masked: dict[str, Any] = {}
    for name, column in columns.items():
        kept = np.zeros_like(column, order="C")
        kept[rows] = column[rows]
        masked[name] = kept
        masked[f"_{name}"] = rows.copy()
    return masked
