"""Random templates of a whole episode, of which the best one in each world is kept: brake fully, give way, brake again.

They show how a world could be driven quite otherwise than a policy drives it (``search.refine`` climbs from the same
ones). Nothing is improved: what does little harm as it was drawn stands on no edge, and a policy can imitate it.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.physics import Floats, Ints, UInt64s
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.search.kernel import copy_rows
from ethbrake_marl.search.problem import ProfileProblem, seeded
from ethbrake_marl.search.profiles import make_search_world
from ethbrake_marl.search.refine import Plan, copy_steps, draw_templates


def best_templates(problem: ProfileProblem, bound: Floats, *, number: int, seed: int = 0) -> tuple[Floats, Ints]:
    """The best of ``number`` templates below ``bound`` [n] (m2/s2) in each world, of the one controlled vehicle.

    Returns its commands [n, T] (m/s2), and in how many steps it was played to its end [n]: 0 where none was below.
    Each world draws its own; worlds are independent of each other. Raises ``InvalidInput`` for several vehicles, or no
    template.
    """
    check_whole_number("templates", number, 1)
    if len(problem.vehicles) != 1:
        raise InvalidInput(f"templates: {len(problem.vehicles)} vehicles; they are of one")
    commands = np.zeros((problem.n, int(problem.last_step.max(initial=0))))
    steps = np.zeros(problem.n, np.int64)
    _best_templates(
        problem.start, problem.clock, problem.bounds, problem.command, problem.latency, problem.mass, problem.limit,
        problem.vehicles, seeded(problem.identity, seed), bound, number, commands, steps,
    )  # fmt: skip
    return commands, steps


@compiled
def _best_templates(
    start: Floats, clock: Floats, bounds: Floats, command: Floats, latency: Floats, mass: Floats, limit: Floats,
    vehicles: Ints, random: UInt64s, bound: Floats, number: int, commands: Floats, steps: Ints,
) -> None:  # fmt: skip
    """Fill ``commands`` and ``steps``."""
    T, S = commands.shape[1], start.shape[1]
    best, room = Plan(np.zeros(T), np.zeros((T + 1, S))), Plan(np.zeros(T), np.zeros((T + 1, S)))
    for k in range(start.shape[0]):
        world = make_search_world(
            clock[k], bounds[k], command[k], latency[k], mass[k], limit[k], vehicles, random[k : k + 1]
        )
        copy_rows(start[k : k + 1], best.states, 1)
        copy_rows(start[k : k + 1], room.states, 1)
        steps[k] = draw_templates(world, best, room, bound[k], number)[1]
        if steps[k] > 0:
            copy_steps(best.commands, commands[k], 0)
