"""The paper's fixed-step map (eq. dynamics2): ``physics: paper-map`` in a scenario.

Impacts are detected, and take effect, only at samples: the decisions, one time step h apart. One step of a vehicle with
command u, from sample n to sample n + 1, is

    x(n + 1) = x(n) + h f(n) + h^2 / 2 u(n)
    v(n + 1) = f(n) + h u(n)

where f(n) is its speed after the impacts of sample n. Where the gap of a pair is at most 0 and its closing speed above
0, its speeds change by eq. (13). Where the paper leaves something open, this map chooses:

* Impacts at one sample happen from the rear pair to the front pair, because the paper applies f1 (front pair) after f3.
  The harm of the front impact follows from the speeds after f3; the paper's J_harm uses the speeds before both impacts.
* The paper's f1 and f3 would pull overlapping vehicles together even while they separate. The text below eq. (13)
  requires a positive closing speed, and so does this map. As in the exact physics, a touch (a closing speed of at most
  1e-5 m/s) does no harm.
* Until the first decision, worlds follow the exact physics and must have no impact, as the paper assumes.
* The command of a step is the one in force at its first sample (zero-order hold).
* ``0 <= v <= v_max`` is a constraint on u in the paper: commands are limited so that the next sample satisfies it. An
  impact can leave a negative speed: brakes bring it back to 0 with the commanded deceleration. It can leave a speed
  above v_max: the engine then has no effect. A coasting vehicle keeps its speed in both cases.
* Times are rounded, so a latency has elapsed at a sample that is at most 1e-6 of a step before the latency's end.

With this map, the reward term ``collision`` is the paper's r_collision at the sample at which a step begins; an overlap
at an episode's last sample does not count. The term ``risk`` is computed at the sample at which the step ends. As in
the exact physics, ``jerk`` is computed from the commands before they are limited. Gaps are negative while vehicles
overlap; nothing pushes them apart. Source: the paper, sections "Optimization Problem" and "MDP formulation".
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ethbrake_marl.episode import step as one_step
from ethbrake_marl.episode.commands import check_actions, commands_of, proposal_array
from ethbrake_marl.episode.counts import OF_FIRST, OF_TOTAL
from ethbrake_marl.episode.departures import BACKWARD, MAP
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.reward import Rewarding, RewardParams
from ethbrake_marl.episode.script_calls import ask_scripts
from ethbrake_marl.episode.state import ENDED, FIRST_DECISION, LAST, STEPS, TIME, State, require as require_covered
from ethbrake_marl.episode.step import COST, FIRST_HARM, OUT_ROWS, SAFE_END, TERMINATED, TOTAL_HARM, TRUNCATED, Step
from ethbrake_marl.episode.terms import pair_energies
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import UNSHOWN, require
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.layout import (
    FIRST,
    FORCE,
    GAP,
    HIT,
    IMPACTS,
    LATENCY,
    LIMIT,
    MASS,
    RESTITUTION,
    SPEED,
    TOTAL,
    Floats,
)
from ethbrake_marl.worlds.scenario import Scenario

ON_SAMPLE = 1e-6  # part of a step: times this close count as one sample, because times are rounded
EXACT_ALONE = ("push", "drove", "still_moving")  # terms of a reward that the map does not know


def exchange(line: Floats, car: Floats) -> None:
    """Change by eq. (13) the speeds of vehicles that overlap and still approach; count impacts and harm; all in place.

    The pairs are treated one after the other, from the rear. With the closing speed w = v_{i+1} - v_i:

    v_i+ = v_i + m_{i+1} (1 + e) w / (m_i + m_{i+1})
    v_{i+1}+ = v_{i+1} - m_i (1 + e) w / (m_i + m_{i+1})

    ``line`` and ``car``: arrays of a ``State``.
    """
    speed, gap = line[:, SPEED], line[:, GAP]
    for p in range(speed.shape[1] - 2, 0, -1):
        closing = speed[:, p + 1] - speed[:, p]
        meets = (gap[:, p] <= 0.0) & (closing > 0.0)
        front, rear = car[:, MASS, p], car[:, MASS, p + 1]
        impulse = np.where(meets, (1.0 + car[:, RESTITUTION, p]) * closing / (front + rear), 0.0)
        speed[:, p] += rear * impulse
        speed[:, p + 1] -= front * impulse
        impact = meets & (closing > TOUCH_MPS)
        harm = np.where(impact, closing * closing, 0.0)
        line[:, FIRST, p] += np.where(line[:, HIT, p] == 0.0, harm, 0.0)
        line[:, TOTAL, p] += harm
        line[:, IMPACTS, p] += impact
        line[:, HIT, p] = np.maximum(line[:, HIT, p], impact)


def sample(state: State, step_s: float) -> State:
    """First impacts, then motion under the commands ``state.wanted`` [n, N + 1] (m/s2)."""
    line, clock = state.line.copy(), state.clock.copy()
    exchange(line, state.car)
    now, speed, limit = clock[:, TIME, np.newaxis], line[:, SPEED], state.car[:, LIMIT]
    command = np.where(state.car[:, LATENCY] <= now + ON_SAMPLE * step_s, state.wanted, 0.0)
    braked = np.where(
        speed >= 0.0, np.maximum(speed + command * step_s, 0.0), np.minimum(speed - command * step_s, 0.0)
    )
    driven = np.where(speed < limit, np.minimum(speed + command * step_s, limit), speed)
    after = np.where(command < 0.0, braked, np.where(command > 0.0, driven, speed))
    way = 0.5 * (speed + after) * step_s
    line[:, GAP, 1:-1] += way[:, 1:-1] - way[:, 2:]
    line[:, SPEED], line[:, FORCE] = after, command
    clock[:, STEPS] += 1.0
    clock[:, TIME] = clock[:, FIRST_DECISION] + clock[:, STEPS] * step_s
    return state._replace(line=line, clock=clock)


def paper_collision(params: RewardParams, before: State, step: Step, after: State) -> Floats:
    """The paper's reward r_collision, [n]: minus ``k_energy w^2`` for every pair that overlaps as the time step begins.

    w is the closing speed in ``before``. A pair counts in every step that begins with its overlap, even while it
    separates, because the paper's collision indicator Gamma depends only on the gap.
    """
    speed, gap = before.line[:, SPEED], before.line[:, GAP]
    closing = np.diff(speed[:, 1:], axis=1)
    squares = np.where(gap[:, 1:-1] <= 0.0, closing * closing, 0.0)
    penalty: Floats = -(pair_energies(params, before.vehicles)[1:-1] * squares).sum(axis=1)
    return penalty


class PaperMap:
    departures = frozenset({MAP})

    def check(self, scenario: Scenario) -> None:
        """Refuses an obstacle, and brakes that build up."""
        right = "is not known to physics: paper-map; leave one of the two out"
        for key in ("obstacle_gap_m", "obstacle_margin_m", "brake_rate_mps3", "release_rate_mps3"):
            require(key not in scenario.sources, (key,), UNSHOWN, right)

    def rewarding(self, game: Game) -> Rewarding:
        """Raises ``InvalidInput`` for the honest cost, push, driving and motion at the horizon, which need exact
        impacts.
        """
        counted = [name for name in game.rewarding.reported if name in EXACT_ALONE]
        count = game.settings.harm_count
        if count.requires or counted:
            what = f"the term {counted[0]}" if counted else f"harm_count {count.name}"
            right = "leave it out" if counted else "write harm_count first or total"
            raise InvalidInput(
                f"scenario {game.name!r}: {what} needs exact impacts, and physics: paper-map has none; {right}"
            )
        terms = tuple(
            (name, weight, partial(paper_collision, game.rewarding.params) if name == "collision" else function)
            for name, weight, function in game.rewarding.terms
        )
        return game.rewarding._replace(terms=terms)

    def first_decision(self, game: Game, alert: State) -> State:
        """Raises ``InvalidInput`` if a world has an impact before, or departs from the plain game."""
        require_covered(alert, "physics: paper-map", {MAP, BACKWARD})
        state = one_step.first_decision(alert, game.deciders, game.settings)
        if state.collided.any():
            raise InvalidInput(
                f"scenario {game.name!r}: row {np.argmax(state.collided)} has an impact before the first decision,"
                " which physics: paper-map does not know; early_impacts: reject draws such worlds again"
            )
        return state

    def follow(self, game: Game, state: State, actions: Floats | None) -> tuple[State, Step]:
        """Episodes that have ended do not change.

        ``actions``: of the L learners, [n, L] in [-1, 1].
        """
        before, settings = with_commands(game, state, actions), game.settings
        after, over = sample(before, settings.time_step_s), state.ended
        np.copyto(after.line, before.line, where=over[:, np.newaxis, np.newaxis])
        np.copyto(after.clock, before.clock, where=over[:, np.newaxis])
        last = after.clock[:, STEPS] >= after.clock[:, LAST]
        after.clock[:, ENDED] = over | last | after.at_rest
        out = np.zeros((OUT_ROWS, state.n))
        for row, of_line in ((FIRST_HARM, FIRST), (TOTAL_HARM, TOTAL)):
            out[row] = (after.line[:, of_line] - before.line[:, of_line]).sum(axis=1)
        ends = after.ended & ~over
        out[TERMINATED], out[TRUNCATED] = ends & after.at_rest, ends & ~after.at_rest
        out[SAFE_END] = ends & ~after.collided
        weights = settings.harm_count.weights
        out[COST] = weights[OF_FIRST] * out[FIRST_HARM] + weights[OF_TOTAL] * out[TOTAL_HARM]
        shared = settings.terminal * out[SAFE_END] - settings.harm * out[COST]
        reward = np.repeat(shared[:, np.newaxis], state.vehicles, axis=1)
        return after, Step(reward, out, settings.time_step_s)


def with_commands(game: Game, state: State, actions: Floats | None) -> State:
    """``actions``: of the L learners, [n, L]. Raises ``InvalidInput`` unless all are in [-1, 1]."""
    learners = game.settings.learners
    proposals = proposal_array(learners, actions, state.n)
    if np.isnan(proposals).any():
        check_actions(learners, proposals[np.isnan(proposals).any(axis=1).argmax()])
    state = ask_scripts(game.agents(game.scripts), state)
    commands = commands_of(state, learners, proposals)
    state.wanted[:, learners] = np.where(state.ended[:, np.newaxis], state.wanted[:, learners], commands)
    return state


PAPER_MAP = PaperMap()
