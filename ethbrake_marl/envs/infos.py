"""Infos of every interface, computed once for all vehicles of all worlds: the same keys after a reset and a step.

``time_s``, ``command_in_force_mps2`` (in force now; 0 until the latency has elapsed), ``chosen_command_mps2`` and
``chosen_action`` (what the vehicle asked for, whoever chose it; 0 before a learner's first step), the vehicle's share
of the harm so far under both counts, the same for the whole world, and whether anything has collided. Of the last
step: ``cost`` (the harm it added to the line, as the reward counts impacts; for safe-RL libraries) and
``reward_NAME``, each term of the reward before its weight; after a reset they are 0. ``world_seed`` and ``world`` name
the world, so that it can be played again (-1: it was given). Where the scenario has a ``v2x`` channel also
``known_from_s`` [N]: from when on this vehicle acts on news of each one (infinite: never; of itself: its latency);
and where its messages are periodic ``age_s`` [N]: how old the newest sample is that it was told of each (infinite:
none).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_of
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.step import Step
from ethbrake_marl.harm import front_share
from ethbrake_marl.physics import Bools, Floats, Ints
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.estimates import age_by_rows
from ethbrake_marl.physics.rows import (
    TIME,
    command_at,
    harm_at,
    has_messages,
    has_news,
    messages_at,
    own_latency_and_news,
    params_at,
    state_width,
)

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
    known = own_latency_and_news(params, N)[1] if has_news(params, N) else None
    cost, terms = _of_the_step(engine, step, rows)
    age = age_by_rows(state[:, TIME], params[:, messages_at(N) :], N) if has_messages(state, params) else None
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
    P, harm, mass, obstacle = N - 1, harm_at(N), params_at(3, N), state_width(N)
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
            out[k, i, 0] = state[k, TIME]
            out[k, i, 1] = state[k, command_at(N) + i]
            out[k, i, 4] = first
            out[k, i, 5] = total
            out[k, i, 6] = 1.0 if impacts > 0.0 else 0.0
            out[k, i, 7] = wanted[k, i]
            out[k, i, 8] = action_of(wanted[k, i], params[k, params_at(0, N) + i], params[k, params_at(1, N) + i])


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
