"""Draw random templates of commands, and return the best template of each world.

A *template* is a random braking profile of three phases: one command, then another command for a short while, then full
braking. From templates a policy can learn different ways to drive. The best template is not improved by a search: a
random template with little harm tolerates small errors of the commands, so a policy can imitate it.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.extensions.search.problem import seeded
from ethbrake_marl.extensions.search.refine import Plan, copy_steps, draw_templates
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, copy_rows, make_search_world
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.state import Floats, Ints, UInt64s


def best_templates(problem: ProfileProblem, bound: Floats, *, number: int, seed: int = 0) -> tuple[Floats, Ints]:
    """Draw random templates in each world, and return the template with the least harm.

    Returns the commands of this template, [n, T] m/s2, and the number of steps of the episode under these commands,
    [n]. The number of steps is 0 if no template does less harm than ``bound`` [n], m2/s2. The result for a world does
    not depend on the other worlds. Raises ``InvalidInput`` if several vehicles are controlled, or if ``number`` is
    below 1.

    ``number`` templates are drawn in each world.
    """
    check_whole_number("templates", number, 1)
    if len(problem.vehicles) != 1:
        raise InvalidInput(
            f"templates: the problem has {len(problem.vehicles)} controlled vehicles; give a problem with one"
            " controlled vehicle"
        )
    commands = np.zeros((problem.n, int(problem.last_step.max(initial=0))))
    steps = np.zeros(problem.n, np.int64)
    _best_templates(problem, seeded(problem.identity, seed), bound, number, commands, steps)
    return commands, steps


@compiled
def _best_templates(
    problem: ProfileProblem, random: UInt64s, bound: Floats, number: int, commands: Floats, steps: Ints
) -> None:
    """Write the commands and the number of steps of each world's best template to ``commands`` and ``steps``.

    ``random`` [n] is the initial state of each world's random stream.
    """
    start, T, S = problem.start, commands.shape[1], problem.start.shape[1]
    best, room = Plan(np.zeros(T), np.zeros((T + 1, S))), Plan(np.zeros(T), np.zeros((T + 1, S)))
    for k in range(start.shape[0]):
        world = make_search_world(problem, k, random)
        copy_rows(start[k : k + 1], best.states, 1)
        copy_rows(start[k : k + 1], room.states, 1)
        steps[k] = draw_templates(world, best, room, bound[k], number)[1]
        if steps[k] > 0:
            copy_steps(best.commands, commands[k], 0)
