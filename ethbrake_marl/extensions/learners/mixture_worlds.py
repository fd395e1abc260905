"""Worlds in which random templates do better than all experts so far, and the templates to imitate in them.

A *template* is a random braking profile from the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.profiles import profile_problem
from ethbrake_marl.engine.state import State
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.learners.branches import Act, Offsets, counted_harm, play_on, play_to_the_end
from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan
from ethbrake_marl.extensions.search.problem import minimising
from ethbrake_marl.extensions.search.templates import best_templates
from ethbrake_marl.game.actions import command_to_action
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.observations import Observations
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.policies.network_spec import Float32s

NO_DIFFERENCE = 1e-2  # returns closer than this are equal


class Explored(NamedTuple):
    """The first n worlds of the training, and the best results of the experts so far in them."""

    alert: Worlds  # the worlds at the alert
    start: State  # their states at the first decision
    gained: Floats  # [n] highest return of any expert
    harm: Floats  # [n] least harm of any expert (m2/s2)


class Shown(NamedTuple):
    """Observations and actions of m decisions of templates (random braking profiles), for an expert to imitate."""

    seen: Float32s  # [m, F] observations
    action: Float32s  # [m] actions in [-1, 1]


def explore(engine: Engine, plan: ExpertsPlan, acts: Sequence[Act], gamma: float) -> Explored:
    """Let every expert drive the first ``plan.worlds`` worlds of the training, and return the best results.

    Args:
        engine: engine of the training; it is not changed.
        plan: the key ``experts`` of the recipe.
        acts: function of each expert from observations [rows, F] to actions [rows].
        gamma: discount of one time step.

    """
    alert, start = engine.first_moments(plan.worlds)
    gained, harm = np.full(plan.worlds, -np.inf), np.full(plan.worlds, np.inf)
    for act in acts:
        its_gain, its_harm = drive_from(engine, start, act, gamma)
        gained, harm = np.fmax(gained, its_gain), np.fmin(harm, its_harm)
    return Explored(alert, start, gained, harm)


def drive_from(
    engine: Engine, start: State, act: Act, gamma: float, count: HarmCount | None = None
) -> tuple[Floats, Floats]:
    """Play states to the end of their episodes with one policy.

    Args:
        engine: engine of the training; it is not changed.
        start: the n states to continue from.
        act: policy, from observations [rows, F] to actions [rows].
        gamma: discount of one time step.
        count: impacts that the harm counts; None: as the reward does.

    Returns the first learner's return [n] (NaN for a row that could not be advanced), and the harm [n] (m2/s2) by its
    objective.

    """
    rows = engine.branch(start)
    nowhere = np.zeros(rows.n, np.int64)
    gained, _ = play_to_the_end(rows, act, Offsets(nowhere, np.zeros(rows.n), nowhere), gamma)
    return gained, counted_harm(rows, engine.reward.harm_count if count is None else count)[:, 0]


def show_templates(engine: Engine, plan: ExpertsPlan, explored: Explored, gamma: float, seed: int) -> Shown:
    """Draw templates (random braking profiles), and return the actions of those that do better than all experts.

    In each world the best of ``plan.templates`` is taken, if its return exceeds every expert's by ``plan.gain``.

    Args:
        engine: engine of the training; it is not changed.
        plan: the key ``experts`` of the recipe.
        explored: worlds and results of the experts, from ``explore``.
        gamma: discount of one time step.
        seed: seed of the templates.

    """
    (vehicle,) = engine.learners
    problem = profile_problem(
        explored.alert,
        [vehicle],
        harm_count=engine.reward.harm_count,
        horizon_s=engine.scenario.horizon_s,
        time_step_s=engine.scenario.time_step_s,
        others_mps2=explored.start.wanted,
    )
    problem = minimising(problem, explored.alert, engine.reward.objective or "total", [vehicle])
    commands, steps = best_templates(problem, explored.harm, number=plan.templates, seed=seed)
    rows = np.flatnonzero(steps > 0)
    worlds = explored.alert.take(rows).vehicles
    each = [command_to_action(commands[rows, t], worlds, vehicle) for t in range(commands.shape[1])]
    actions = np.stack(each, axis=1)  # [rows, T]
    seen_then: list[Observations] = []
    where: list[Ints] = []

    def decide(seen: Observations, some: Ints, number: int) -> Floats:
        seen_then.append(seen[:, 0])
        where.append(some)
        wanted: Floats = actions[some, number][:, np.newaxis]
        return wanted

    gained = play_on(engine.branch(explored.start.take(rows)), decide, gamma)[:, 0]
    better: Bools = gained > explored.gained[rows] + plan.gain
    if not where:
        return Shown(np.zeros((0, engine.observation.size), np.float32), np.zeros(0, np.float32))
    wanted = np.concatenate([actions[some, number] for number, some in enumerate(where)]).astype(np.float32)
    shown = better[np.concatenate(where)]
    return Shown(np.concatenate(seen_then)[shown], wanted[shown])


def own_worlds(engine: Engine, plan: ExpertsPlan, explored: Explored, act: Act, gamma: float) -> State:
    """Return the starting states of the worlds in which a new expert is to be trained.

    These are the worlds in which its return is at most ``plan.margin`` below the best of the earlier experts. Worlds in
    which it has the same return as the best one, or in which an earlier expert does no harm, are left out: it could
    learn nothing there.

    Args:
        engine: engine of the training; it is not changed.
        plan: the key ``experts`` of the recipe.
        explored: worlds and results of the earlier experts, from ``explore``.
        act: the new expert, from observations [rows, F] to actions [rows].
        gamma: discount of one time step.

    """
    gained, _ = drive_from(engine, explored.start, act, gamma)
    more = gained - explored.gained
    rows = np.flatnonzero((more > -plan.margin) & (np.abs(more) > NO_DIFFERENCE) & (explored.harm > 0.0))
    return explored.start.take(rows)


class NoBetterTemplate(EthBrakeError, ValueError):
    """No template (random braking profile) does better than the experts so far, so another has nothing to learn."""
