"""Scripts that decide at times between the beginning and the end of an engine's steps.

A script first decides when the latency of its vehicle has elapsed. The engine's first step begins with the first
decision of the *deciders*: the learners or, in an evaluation, the vehicles that the evaluated agent drives.

Arguments that several methods share: the state ``state`` of all running episodes, the settings ``rules`` of the
engine's steps, and the learners' ``actions`` [n, L], where L may be 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.engine.compiled_step import (
    ENDED,
    FAILED,
    LAST_STEP,
    OUTCOME_ROWS,
    START,
    STEP,
    TERMINAL_WEIGHT,
    TRUNCATED,
    Rules,
)
from ethbrake_marl.first_edition.engine.memory import Memory, ask_script, renew_memory, take_memory, within_capacity
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.physics.columns import Columns, Packed
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.physics.messages import hear_rows
from ethbrake_marl.first_edition.physics.rows import FLAG
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints

ROUNDING = 1e-9  # of a time step: two moments that are closer than this are the same

Stop = tuple[Floats, Floats]  # state [n, S] of all worlds at a script's decision, and the commands [n, N] until then


class Way(NamedTuple):
    """Results of the first part of a step: up to the last decision that a script makes within the step."""

    reward: Floats  # [n, N] reward of this part
    harm: Floats  # [2, n] harm of the line in this part: first-impact harm, total harm (m2/s2)
    stopped: Bools  # [n] whether the world was moved to a decision within the step
    failed: Ints  # [n] status of the physics if the world could not be advanced, else 0
    in_force: Floats  # [n, N] accelerations in force when the step began (m/s2)
    memories: dict[int, Memory]  # vehicle index -> new memory of its script
    stops: tuple[Stop, ...]  # the worlds at each of the decisions, in order

    def add_to(self, motion: Floats, column: Columns, reward: Floats, outcome: Floats) -> None:
        """Add these results to the results of the rest of the step, in place.

        ``motion`` [n, S], with the columns ``column``, is the state of the worlds after the whole step. The results of
        the rest of the step are ``reward`` [n, N] and ``outcome`` [OUTCOME_ROWS, n].
        """
        reward += self.reward
        outcome[: len(self.harm)] += self.harm
        motion[self.stopped, column.previous : column.gap] = self.in_force[self.stopped]
        lost = self.failed != 0
        outcome[TRUNCATED, lost], outcome[FAILED, lost] = 1.0, self.failed[lost]


class OwnGrid:
    """Scripts that have a memory and may decide in the middle of an engine's step, not only at its beginning.

    Each script first decides when the latency of its vehicle has elapsed, and then every ``time_step_s`` seconds. An
    engine's step leads from one decision of its deciders to their next decision, so a script of a vehicle with another
    latency decides within the step. ``scripts`` maps the index of each vehicle (0 = front) to its script. Episodes are
    truncated ``horizon_s`` seconds after the alert.
    """

    def __init__(self, scripts: Mapping[int, Script], time_step_s: float, horizon_s: float) -> None:
        self.scripts = dict(scripts)
        self._time_step_s, self._horizon_s = time_step_s, horizon_s

    def drive_step(self, state: State, rules: Rules, actions: Floats) -> Way:
        """Let the scripts make their decisions within the next step; return the results up to the last decision.

        Each world of ``state`` is moved, in place, to the last decision at which a script changed its command.
        """
        column = state.packed.column
        in_force = state.motion[:, column.command : column.previous].copy()
        steps, last, start_s = (state.clock[:, at] for at in (STEP, LAST_STEP, START))
        until_s = Decisions(start_s, self._time_step_s).at(steps + 1.0)
        until_s = np.where(steps + 1.0 >= last, self._horizon_s, until_s)
        way = self._decide(state, rules, ~state.ended, until_s, actions)
        state.clock[way.failed != 0, ENDED] = 1.0
        return way._replace(in_force=in_force)

    def drive_to_start(self, state: State, rules: Rules, rows: Ints, start_s: Floats) -> Way:
        """Let the scripts make their decisions between the alert and the first step; return the results (``Way``).

        Until the first step the learners and deciders coast, and the scripts observe that these vehicles coast. The new
        episodes, in the worlds ``rows`` of ``state``, are at the alert; they are moved, in place, to the time
        ``start_s`` [len(rows)] s at which their first step begins.

        Raises ``PhysicsError``, which lists the worlds that could not be advanced.
        """
        n, time_s = len(state.motion), state.time_s
        running, until_s, no_actions = np.zeros(n, np.bool_), time_s.copy(), np.empty((n, 0))
        running[rows], until_s[rows] = True, start_s
        way = self._decide(state, rules, running, until_s, no_actions)
        ahead, _, outcome = self._look_ahead(state, rules, until_s, until_s, no_actions)
        failed = np.where(way.failed != 0, way.failed, outcome[FAILED].astype(np.int64))
        if failed.any():
            raise FLAG.failure(np.where(failed == 0, FLAG.DONE, failed), time_s, until_s)
        state.motion[rows], state.params[rows] = ahead.state[rows], ahead.params[rows]
        return way

    def _decide(self, state: State, rules: Rules, running: Bools, until_s: Floats, actions: Floats) -> Way:
        """Let the scripts make all decisions before ``until_s`` [n] s; return the results up to the last decision.

        Only worlds of ``state`` for which the mask ``running`` [n] is True are advanced, in place. ``_decide`` moves a
        world to a decision only if this decision changes a command. If worlds stopped at other decisions, too, their
        motion would be rounded differently.
        """
        motion, params, _, wanted_so_far, *_ = state
        (n, N), column = wanted_so_far.shape, state.packed.column
        vehicles, step_s = list(self.scripts), self._time_step_s
        memories, stops = state.memories, list[Stop]()
        reward, harm = np.zeros((n, N)), np.zeros((2, n))
        stopped, failed = np.zeros(n, np.bool_), np.zeros(n, np.int64)
        first_s = params[:, column.latency : column.mass][:, vehicles].T
        times = np.maximum(Decisions(first_s, step_s).before(motion[:, column.time]), 0.0)
        due = np.where(running, np.maximum(Decisions(first_s, step_s).before(until_s), 0.0), times)
        while (times < due).any():
            next_s = np.where(times < due, first_s + times * step_s, np.inf)
            moment = next_s.min(axis=0)
            asked = next_s <= moment + ROUNDING * step_s
            asked &= times < due
            now = motion[:, column.time]
            moment = np.where((moment < np.inf) & (moment > now + ROUNDING * step_s), moment, now)
            ahead, reward_ahead, outcome = self._look_ahead(state, rules, moment, until_s, actions)
            worlds, wanted = rules.unpack(ahead), wanted_so_far.copy()
            for (vehicle, script), here in zip(self.scripts.items(), asked, strict=True):
                if here.any():
                    before, idle = memories[vehicle], np.flatnonzero(~here)
                    command, after = ask_script(script, worlds, before, vehicle)
                    command = np.where(here, command, 0.0)
                    wanted[here, vehicle] = within_capacity(command, worlds, vehicle, script, here)[here]
                    memories = memories | {vehicle: renew_memory(after, idle, take_memory(before, idle))}
            changed = (wanted != wanted_so_far)[:, vehicles] & (times > 0.0).T  # the first waits for the latency anyway
            stopping = (moment > now) & changed.any(axis=1) & (outcome[FAILED] == 0.0)
            failed[:] = np.where(outcome[FAILED] != 0.0, outcome[FAILED], failed)
            if stopping.any():
                motion[stopping], params[stopping] = ahead.state[stopping], ahead.params[stopping]
                stops.append((motion.copy(), wanted_so_far.copy()))
                reward[stopping] += reward_ahead[stopping]
                harm[:, stopping] += outcome[: len(harm), stopping]
                stopped[stopping] = True
            wanted_so_far[:] = wanted
            times += asked
            times = np.where(failed != 0, due, times)
        return Way(reward, harm, stopped, failed, np.empty(0), memories, tuple(stops))

    def _look_ahead(
        self, state: State, rules: Rules, until_s: Floats, decision_s: Floats, actions: Floats
    ) -> tuple[Packed, Floats, Floats]:
        """Return copies of the worlds at ``until_s``, and the rewards [n, N] and results [OUTCOME_ROWS, n] until then.

        In ``state.wanted`` the learners' commands are overwritten; nothing else in ``state`` changes. A world that has
        reached its time ``until_s`` [n] s does not move. The delivery of periodic messages depends on ``decision_s``
        [n] s, the time of the deciders' next decision.
        """
        n, wanted = len(state.motion), state.wanted
        clock, settings = np.zeros(state.clock.shape), rules.settings.copy()
        clock[:, START], clock[:, STEP], clock[:, LAST_STEP] = until_s, -1.0, np.inf  # a step from -1 to 0 ends there
        clock[:, ENDED] = ~(until_s > state.time_s)
        settings[TERMINAL_WEIGHT] = 0.0
        reward, outcome = np.empty(wanted.shape), np.empty((OUTCOME_ROWS, n))
        ahead = Packed(state.motion.copy(), state.params.copy())
        rules = rules._replace(settings=settings, learners=rules.learners[: actions.shape[1]])
        rules.step(ahead, clock, actions, wanted, reward, outcome)
        if ahead.has_messages:
            time_s = ahead.state[:, ahead.column.time]
            hear_rows(state.motion.copy(), ahead.params, wanted, time_s, decision_s, self._time_step_s, rules.pieces)
        return ahead, reward, outcome
