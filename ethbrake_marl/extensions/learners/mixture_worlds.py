"""Selection of the worlds and templates with which a new expert of a mixture is trained.

Arguments that several functions share: ``engine`` is the engine of the training run; it is not changed. ``plan`` is the
value of the recipe key ``experts``. ``explored`` is the result of ``explore``. ``act`` is a policy: a function from
observations [rows, F] to actions [rows]. ``gamma`` is the discount factor per time step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.learners.branches import Act, Offsets, counted_harm, play_on, play_to_the_end
from ethbrake_marl.extensions.learners.mixture_plan import ExpertsPlan
from ethbrake_marl.extensions.search.problem import minimising
from ethbrake_marl.extensions.search.templates import best_templates
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.game.actions import command_to_action
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.observations import Observations
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.policies.network_spec import Float32s

NO_DIFFERENCE = 1e-2  # returns that differ by less than this count as equal


class Explored(NamedTuple):
    """The first n worlds of the training run, with the highest return and least harm of the earlier experts."""

    alert: Worlds  # the worlds at the alert
    start: State  # states of the worlds at the first decision
    gained: Floats  # [n] highest return of the earlier experts
    harm: Floats  # [n] least harm of the earlier experts (m2/s2)


class Shown(NamedTuple):
    """Observations and actions at m decisions of templates, which a new expert imitates."""

    seen: Float32s  # [m, F] observations
    action: Float32s  # [m] actions of the templates, in [-1, 1]


def explore(engine: Engine, plan: ExpertsPlan, acts: Sequence[Act], gamma: float) -> Explored:
    """Let every earlier expert of ``acts`` drive the first ``plan.worlds`` worlds of the training run."""
    alert, start = engine.first_moments(plan.worlds)
    gained, harm = np.full(plan.worlds, -np.inf), np.full(plan.worlds, np.inf)
    for act in acts:
        its_gain, its_harm = drive_from(engine, start, act, gamma)
        gained, harm = np.fmax(gained, its_gain), np.fmin(harm, its_harm)
    return Explored(alert, start, gained, harm)


def drive_from(
    engine: Engine, start: State, act: Act, gamma: float, count: HarmCount | None = None
) -> tuple[Floats, Floats]:
    """Let one policy drive from each of n states to the end of the episode, and measure its return and harm.

    Returns two arrays [n] for the first learner: the return (NaN if the simulation failed), and the harm that this
    learner should make small (m2/s2) under ``count`` (None: the count that the reward uses).
    """
    rows = engine.branch(start)
    nowhere = np.zeros(rows.n, np.int64)
    gained, _ = play_to_the_end(rows, act, Offsets(nowhere, np.zeros(rows.n), nowhere), gamma)
    return gained, counted_harm(rows, engine.reward.harm_count if count is None else count)[:, 0]


def show_templates(engine: Engine, plan: ExpertsPlan, explored: Explored, gamma: float, seed: int) -> Shown:
    """Draw templates; return the decisions of templates that have a higher return than all earlier experts.

    In each world ``plan.templates`` templates are drawn. If the template with the least harm does less harm than every
    earlier expert, this template is simulated. Its observations and actions are returned if its return exceeds the
    return of the best earlier expert by more than ``plan.gain``. ``seed`` is the seed with which the templates are
    drawn.
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
    """Select the worlds in which the new expert ``act`` is to be trained; return their states at the first decision.

    A world is selected if the return of the new expert is above the return of the best earlier expert, or less than
    ``plan.margin`` below it. Worlds in which these two returns are equal, or in which an earlier expert does no harm,
    are not selected.
    """
    gained, _ = drive_from(engine, explored.start, act, gamma)
    more = gained - explored.gained
    rows = np.flatnonzero((more > -plan.margin) & (np.abs(more) > NO_DIFFERENCE) & (explored.harm > 0.0))
    return explored.start.take(rows)


class NoBetterTemplate(EthBrakeError, ValueError):
    """Raised if no template has a higher return than the earlier experts, so a further expert has nothing to learn."""
