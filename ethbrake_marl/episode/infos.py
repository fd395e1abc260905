"""Infos of a vehicle: the same numbers after a reset and after every step, in all environments.

========================  ==========================================================================================
time_s                    time since the alert, s
command_in_force_mps2     acceleration that the vehicle's brakes or engine cause, m/s2
chosen_command_mps2       last command of its policy or script, m/s2; it takes effect after the latency
chosen_action             this command as an action, in [-1, 1]
first_impact_harm         harm that the vehicle has borne so far, first impact of each pair, m2/s2
total_harm                harm that the vehicle has borne so far, all impacts, m2/s2
world_first_impact_harm   harm of the whole line so far, first impact of each pair, m2/s2
world_total_harm          harm of the whole line so far, all impacts, m2/s2
collided                  whether the world has had an impact
cost                      harm of the line in the last step, in the reward's count, m2/s2
reward_NAME               term NAME in the last step, without its weight, if the reward or ``report`` has it
world_seed, world         seed and number of the world; -1 and -1 for a world made by the caller
world_listed              whether the world is in the evaluation list of the seed, not among its training worlds
shield_NAME               values that a shield reports
========================  ==========================================================================================
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ethbrake_marl.episode.commands import action_of
from ethbrake_marl.episode.counts import COUNTS, amount_so_far
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import FIRST_IN_LIST, NUMBER, TIME, State, split_world
from ethbrake_marl.episode.step import Step
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import FIRST, FORCE, IMPACTS, MASS, TOTAL, Floats, Ints

NUMBERS = (
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
TIME_NOW, FORCE_NOW, BORNE_FIRST, BORNE_TOTAL, LINE_FIRST, LINE_TOTAL, COLLIDED, COMMAND, ACTION = range(len(NUMBERS))
FIRST_WEIGHTS, TOTAL_WEIGHTS = COUNTS["first"], COUNTS["total"]


@large
def report(line, car, clock, wanted, bodies, borne, out):
    """Write the infos in ``NUMBERS`` of the ``bodies`` to ``out`` [n, bodies, len(NUMBERS)].

    ``line``, ``car``, ``clock`` and ``wanted`` are arrays of a ``State``; ``borne`` [2, N] is working memory.
    """
    for k in range(len(out)):
        split_world(line[k, FIRST], car[k, MASS], borne[0])
        split_world(line[k, TOTAL], car[k, MASS], borne[1])
        first, total = amount_so_far(line[k], FIRST_WEIGHTS), amount_so_far(line[k], TOTAL_WEIGHTS)
        impacts = 0.0
        for p in range(line.shape[2] - 1):
            impacts += line[k, IMPACTS, p]
        for o in range(len(bodies)):
            i = bodies[o]
            info, time, command = out[k, o], clock[k, TIME], wanted[k, i]
            info[TIME_NOW], info[FORCE_NOW], info[COLLIDED] = time, line[k, FORCE, i], 1.0 if impacts > 0.0 else 0.0
            info[BORNE_FIRST], info[BORNE_TOTAL] = borne[0, i - 1], borne[1, i - 1]
            info[LINE_FIRST], info[LINE_TOTAL] = first, total
            info[COMMAND], info[ACTION] = command, action_of(car[k], i, command, time)


def numbers(state: State, bodies: Ints) -> Floats:
    out = np.empty((state.n, len(bodies), len(NUMBERS)))
    report(state.line, state.car, state.clock, state.wanted, bodies, np.empty((2, state.vehicles)), out)
    return out


def names_of_worlds(state: State, seed: Any) -> dict[str, Any]:
    """Infos ``world_seed``, ``world`` and ``world_listed``, name -> [n]. ``seed``: a number for all worlds, or [n]."""
    number = state.clock[:, NUMBER].astype(np.int64)
    in_evaluation_list = number <= FIRST_IN_LIST
    number_in_list = np.where(in_evaluation_list, FIRST_IN_LIST - number, number)
    return {"world_seed": np.full(state.n, seed), "world": number_in_list, "world_listed": in_evaluation_list}


def of_step(game: Game, state: State, step: Step | None, seed: Any) -> dict[str, Any]:
    """Infos of the last step: cost, reward terms, seed and number of the world; name -> [n] or [n, N].

    ``step`` is None after a reset; cost and terms are then 0.
    """
    reported = game.rewarding.reported
    worlds = names_of_worlds(state, seed)
    if step is None:
        nothing = np.zeros(state.n)
        return {"cost": nothing, **worlds, **{f"reward_{name}": nothing for name in reported}}
    terms = step.terms or game.rewarding.shared(step)
    return {"cost": step.cost, **worlds, **{f"reward_{name}": terms[name] for name in reported}}


def dictionaries(game: Game, state: State, step: Step | None, seed: int, bodies: Ints) -> list[dict[str, Any]]:
    """Infos of the ``bodies`` in all worlds: a list of dictionaries, one for each world and body, world by world."""
    infos = []
    shared = per_body(of_step(game, state, step, seed) | game.extra_infos(state), state.n, bodies)
    for values, common in zip(numbers(state, bodies).reshape(-1, len(NUMBERS)).tolist(), shared, strict=True):
        info = dict(zip(NUMBERS, values, strict=True))
        info["collided"] = values[COLLIDED] == 1.0
        infos.append(info | common)
    return infos


def per_body(columns: dict[str, Any], n: int, bodies: Ints) -> list[dict[str, Any]]:
    """Split ``columns``, [n] or [n, N] each, into one dictionary for each world and body, world by world."""
    shared = {name: value.tolist() for name, value in columns.items() if value.ndim == 1}
    vehicle_columns = {name: value[:, bodies - 1].tolist() for name, value in columns.items() if value.ndim == 2}
    rows = []
    for k in range(n):
        common = {name: column[k] for name, column in shared.items()}
        rows += [common | {name: column[k][o] for name, column in vehicle_columns.items()} for o in range(len(bodies))]
    return rows


def arrays(game: Game, state: State, step: Step | None, seed: int, body: int) -> dict[str, Any]:
    """Infos of one body in all worlds: name -> [n]."""
    columns = dict(zip(NUMBERS, numbers(state, np.array([body]))[:, 0].T, strict=True))
    columns["collided"] = columns["collided"] == 1.0
    for name, value in (of_step(game, state, step, seed) | game.extra_infos(state)).items():
        columns[name] = value if value.ndim == 1 else value[:, body - 1]
    return columns
