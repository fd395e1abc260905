"""The infos of every interface, computed once for all vehicles of all worlds.

After a reset: ``time_s``, ``command_in_force_mps2`` (in force now; 0 until the latency has elapsed), the vehicle's
share of the harm so far under both counts, the same for the whole world, and whether anything has collided. After a
step also ``chosen_command_mps2``, ``chosen_action`` (the vehicle's command as an action, whoever chose it), and the
reward terms before their weights. Where the scenario has a ``v2x`` channel, always also ``known_from_s`` [N]: from
when on this vehicle acts on news of each one (infinite: never; of itself: its latency).
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
from ethbrake_marl.physics.rows import (
    TIME,
    command_at,
    harm_at,
    has_news,
    own_latency_and_news,
    params_at,
    state_width,
)

AT_ANY_TIME = (
    "time_s",
    "command_in_force_mps2",
    "first_impact_harm",
    "total_harm",
    "world_first_impact_harm",
    "world_total_harm",
    "collided",
)
AFTER_A_STEP = (*AT_ANY_TIME, "chosen_command_mps2", "chosen_action")
_FLOAT32 = np.dtype(np.float32)


class Report(NamedTuple):
    """What there is to tell about some worlds."""

    values: Floats  # [n, N, len(AFTER_A_STEP)]
    step: Step | None  # whose reward terms are told; None: there was none
    known_from_s: Floats | None = None  # [n, N, N] where the news comes link by link


def report(engine: Engine, step: Step | None = None, rows: Ints | None = None) -> Report:
    """The engine's worlds as they are now, before any of them is renewed; only the worlds ``rows`` if given."""
    (state, params), wanted = engine.packed, engine.wanted_mps2
    if rows is not None:
        state, params, wanted = (array.take(rows, axis=0) for array in (state, params, wanted))
    values = np.empty((*wanted.shape, len(AFTER_A_STEP)))
    _report_rows(state, params, wanted, values)
    N = wanted.shape[1]
    return Report(values, step, own_latency_and_news(params, N)[1] if has_news(params, N) else None)


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
    infos = _without_news(told, vehicles)
    if told.known_from_s is not None:
        news = told.known_from_s if vehicles is None else told.known_from_s.take(vehicles, axis=1)
        for info, known in zip(infos, news.reshape(-1, news.shape[2]), strict=True):
            info["known_from_s"] = known.copy()
    return infos


def _without_news(told: Report, vehicles: Ints | None) -> list[dict[str, Any]]:
    worlds: list[list[list[Any]]] = (told.values if vehicles is None else told.values.take(vehicles, axis=1)).tolist()
    if told.step is None:
        return [_at_any_time(values) for world in worlds for values in world]
    infos: list[dict[str, Any]] = []
    for k, world in enumerate(worlds):
        terms = told.step.shared_in(k)
        for time, applied, first, total, world_first, world_total, collided, wanted, action in world:
            chosen_action = np.empty(1, _FLOAT32)
            chosen_action[0] = action
            infos.append(
                {
                    "time_s": time,
                    "command_in_force_mps2": applied,
                    "first_impact_harm": first,
                    "total_harm": total,
                    "world_first_impact_harm": world_first,
                    "world_total_harm": world_total,
                    "collided": collided == 1.0,
                    "chosen_command_mps2": wanted,
                    "chosen_action": chosen_action,
                    "reward_terms": terms.copy(),
                }
            )
    for name, term in told.step.further.items():
        told_of = term if vehicles is None else term.take(vehicles, axis=1)
        for info, value in zip(infos, told_of.ravel().tolist(), strict=True):
            info["reward_terms"][name] = value
    return infos


def _at_any_time(values: list[Any]) -> dict[str, Any]:
    time, applied, first, total, world_first, world_total, collided, *_ = values
    return {
        "time_s": time,
        "command_in_force_mps2": applied,
        "first_impact_harm": first,
        "total_harm": total,
        "world_first_impact_harm": world_first,
        "world_total_harm": world_total,
        "collided": collided == 1.0,
    }


def batch_info(told: Report, vehicle: int, rows: Bools, stepped: Bools | None) -> dict[str, Any]:
    """One vehicle in many worlds as Gymnasium's vector infos: ``name`` [n] and its mask ``_name`` [n].

    What can be told at any time is told of the worlds marked by ``rows``; what a step adds (None: nothing), of those
    marked by ``stepped``.
    """
    columns: dict[str, NDArray[Any]] = {name: told.values[:, vehicle, c] for c, name in enumerate(AFTER_A_STEP)}
    columns["collided"] = columns["collided"] == 1.0
    always = {name: columns[name] for name in AT_ANY_TIME}
    if told.known_from_s is not None:
        always["known_from_s"] = told.known_from_s[:, vehicle]
    info = _mask(always, rows)
    if stepped is None:
        return info
    columns["chosen_action"] = columns["chosen_action"].astype(np.float32)[:, np.newaxis]
    info |= _mask({name: columns[name] for name in AFTER_A_STEP[len(AT_ANY_TIME) :]}, stepped)
    terms = {} if told.step is None else told.step.shared | _column(told.step.further, vehicle)
    info["reward_terms"] = _mask(terms, stepped)
    info["_reward_terms"] = stepped.copy()
    return info


def _column(terms: dict[str, Floats], vehicle: int) -> dict[str, Floats]:
    return {name: term[:, vehicle] for name, term in terms.items()}


def _mask(columns: dict[str, NDArray[Any]], rows: Bools) -> dict[str, Any]:
    """Each column where ``rows`` marks it, else zeros, and its mask beside it."""
    masked: dict[str, Any] = {}
    for name, column in columns.items():
        kept = np.zeros_like(column, order="C")
        kept[rows] = column[rows]
        masked[name] = kept
        masked[f"_{name}"] = rows.copy()
    return masked
