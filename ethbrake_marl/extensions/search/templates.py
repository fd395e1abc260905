"""Random templates of a whole episode: brake fully, give way, brake again. The best one in each world is returned.

Templates show how a world could be driven differently from a policy (``refine`` climbs from the same templates). They
are not improved: a random template with little harm is robust, so a policy can imitate it.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.engine.profiles import ProfileProblem, copy_rows, make_search_world
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.extensions.search.problem import seeded
from ethbrake_marl.extensions.search.refine import Plan, copy_steps, draw_templates
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats, Ints, UInt64s


def best_templates(problem: ProfileProblem, bound: Floats, *, number: int, seed: int = 0) -> tuple[Floats, Ints]:
    """Return the best of ``number`` templates below ``bound`` [n] (m2/s2) in each world, for one controlled vehicle.

    Returns its commands [n, T] (m/s2), and the number of steps to its end [n]: 0 if none is below the bound. Each world
    draws its own templates and is independent of the others. Raises ``InvalidInput`` for several vehicles, or no
    template.
    """
    check_whole_number("templates", number, 1)
    if len(problem.vehicles) != 1:
        raise InvalidInput(f"templates: {len(problem.vehicles)} vehicles; they are of one")
    commands = np.zeros((problem.n, int(problem.last_step.max(initial=0))))
    steps = np.zeros(problem.n, np.int64)
    _best_templates(problem, seeded(problem.identity, seed), bound, number, commands, steps)
    return commands, steps


@compiled
def _best_templates(
    problem: ProfileProblem, random: UInt64s, bound: Floats, number: int, commands: Floats, steps: Ints
) -> None:
    """Fill ``commands`` [n, T] and ``steps`` [n] with the best template of each world."""
    start, T, S = problem.start, commands.shape[1], problem.start.shape[1]
    best, room = Plan(np.zeros(T), np.zeros((T + 1, S))), Plan(np.zeros(T), np.zeros((T + 1, S)))
    for k in range(start.shape[0]):
        world = make_search_world(problem, k, random)
        copy_rows(start[k : k + 1], best.states, 1)
        copy_rows(start[k : k + 1], room.states, 1)
        steps[k] = draw_templates(world, best, room, bound[k], number)[1]
        if steps[k] > 0:
            copy_steps(best.commands, commands[k], 0)
