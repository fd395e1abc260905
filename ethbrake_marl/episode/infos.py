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
world_honest_cost         honest cost of the whole line so far, m2/s2; NaN under a physics of one's own
collided                  whether the world has had an impact
cut                       whether the episode was truncated before the horizon; later harm and motion then cost nothing
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
from ethbrake_marl.episode.counts import ALL_IMPACTS, FIRST_IMPACTS, HONEST, amount_so_far
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import ENDED, FIRST_IN_LIST, HORIZON, NUMBER, TIME, State, split_world
from ethbrake_marl.episode.step import Step, stands
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import FIRST, FORCE, IMPACTS, MASS, TOTAL, Floats, Ints

# rows of `out`
(
    TIME_NOW, FORCE_NOW, BORNE_FIRST, BORNE_TOTAL, LINE_FIRST, LINE_TOTAL, LINE_HONEST, COLLIDED, COMMAND, ACTION, CUT,
    LISTED, WORLD,
) = range(13)  # fmt: skip
OUT_ROWS = 13
FIRST_WEIGHTS, TOTAL_WEIGHTS, HONEST_WEIGHTS = FIRST_IMPACTS.weight_array, ALL_IMPACTS.weight_array, HONEST.weight_array


@large
def report(line, car, clock, wanted, bodies, borne, out):
    """Write the infos of the B ``bodies`` that follow from the state to ``out`` [OUT_ROWS, n, B].

    ``line``, ``car``, ``clock`` and ``wanted`` are arrays of a ``State``; ``borne`` [2, N] is working memory.
    """
    for k in range(out.shape[1]):
        split_world(line[k, FIRST], car[k, MASS], borne[0])
        split_world(line[k, TOTAL], car[k, MASS], borne[1])
        first, total = amount_so_far(line[k], FIRST_WEIGHTS), amount_so_far(line[k], TOTAL_WEIGHTS)
        honest = amount_so_far(line[k], HONEST_WEIGHTS)
        impacts, number = 0.0, clock[k, NUMBER]
        listed = number <= FIRST_IN_LIST
        cut = clock[k, ENDED] == 1.0 and clock[k, TIME] < clock[k, HORIZON] and not stands(line[k], wanted[k])
        for p in range(line.shape[2] - 1):
            impacts += line[k, IMPACTS, p]
        for o in range(len(bodies)):
            i = bodies[o]
            info, time, command = out[:, k, o], clock[k, TIME], wanted[k, i]
            info[TIME_NOW], info[FORCE_NOW], info[COLLIDED] = time, line[k, FORCE, i], 1.0 if impacts > 0.0 else 0.0
            info[BORNE_FIRST], info[BORNE_TOTAL] = borne[0, i - 1], borne[1, i - 1]
            info[LINE_FIRST], info[LINE_TOTAL], info[LINE_HONEST] = first, total, honest
            info[COMMAND], info[ACTION], info[CUT] = command, action_of(car[k], i, command), 1.0 if cut else 0.0
            info[WORLD], info[LISTED] = FIRST_IN_LIST - number if listed else number, 1.0 if listed else 0.0


def numbers(state: State, bodies: Ints) -> Floats:
    """Infos of the B ``bodies`` that follow from the state, [OUT_ROWS, n, B]."""
    out = np.empty((OUT_ROWS, state.n, len(bodies)))
    report(state.line, state.car, state.clock, state.wanted, bodies, np.empty((2, state.vehicles)), out)
    if not state.defines(HONEST):
        out[LINE_HONEST] = np.nan
    return out


def named(values: Any, world: Any, cost: Any, seed: Any) -> dict[str, Any]:
    """Infos without reward terms, of one vehicle in one world (numbers) or in n worlds (arrays [n]).

    ``values``: the rows of ``numbers`` before the last one, ``WORLD``. ``world``: number of the world, a whole number.
    """
    time, force, borne_first, borne_total, *line, collided, command, action, cut, listed = values
    line_first, line_total, line_honest = line
    return {
        "time_s": time,
        "command_in_force_mps2": force,
        "first_impact_harm": borne_first,
        "total_harm": borne_total,
        "world_first_impact_harm": line_first,
        "world_total_harm": line_total,
        "world_honest_cost": line_honest,
        "collided": collided == 1.0,
        "chosen_command_mps2": command,
        "chosen_action": action,
        "cut": cut == 1.0,
        "cost": cost,
        "world_seed": seed,
        "world": world,
        "world_listed": listed == 1.0,
    }


def reward_infos(game: Game, state: State, step: Step | None) -> dict[str, Floats]:
    """Terms of the reward in the last step, ``reward_NAME`` -> [n] or [n, N]; 0 after a reset (``step`` is None)."""
    reported = game.rewarding.reported
    if step is None:
        return {f"reward_{name}": np.zeros(state.n) for name in reported}
    terms = step.terms or game.rewarding.shared(step)
    return {f"reward_{name}": terms[name] for name in reported}


def dictionaries(game: Game, state: State, step: Step | None, seed: Any, bodies: Ints) -> list[dict[str, Any]]:
    """Infos of the ``bodies`` in all worlds: a list of dictionaries, one for each world and body, world by world.

    ``step`` is None after a reset; cost and terms are then 0. ``seed``: an int for all worlds, or [n].
    """
    infos, vehicles = [], len(bodies)
    seeds = [seed] * state.n if isinstance(seed, int) else seed.tolist()
    costs = [0.0] * state.n if step is None else step.cost.tolist()
    others = {name: column.tolist() for name, column in other_infos(game, state, step, bodies).items()}
    for k, (*values, world) in enumerate(numbers(state, bodies).reshape(OUT_ROWS, -1).T.tolist()):
        info = named(values, int(world), costs[k // vehicles], seeds[k // vehicles])
        for name, column in others.items():
            info[name] = column[k]
        infos.append(info)
    return infos


def arrays(game: Game, state: State, step: Step | None, seed: Any, bodies: Ints) -> dict[str, Any]:
    """Infos of the body in ``bodies`` [1] in all worlds: name -> a new array [n]. Arguments as in ``dictionaries``."""
    *values, world = numbers(state, bodies)[:, :, 0]
    cost = np.zeros(state.n) if step is None else step.cost.copy()
    infos = named(values, world.astype(np.int64), cost, np.full(state.n, seed))
    return infos | other_infos(game, state, step, bodies)


def other_infos(game: Game, state: State, step: Step | None, bodies: Ints) -> dict[str, Any]:
    """Infos of the reward, of the shield and of layers, name -> [n * B], as ``by_body`` gives them."""
    return by_body(reward_infos(game, state, step) | game.extra_infos(state), bodies)


def by_body(columns: dict[str, Any], bodies: Ints) -> dict[str, Any]:
    """Columns of worlds [n], then those of vehicles [n, N], as new arrays [n * B], world by world."""
    worlds = {name: value.repeat(len(bodies)) for name, value in columns.items() if value.ndim == 1}
    of_vehicles = {name: value.take(bodies - 1, axis=1) for name, value in columns.items() if value.ndim == 2}
    return worlds | {name: value.reshape(-1) for name, value in of_vehicles.items()}
