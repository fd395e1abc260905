"""One step of a batch of episodes: from one decision of the learners to the next, or to the end."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.commands import LARGEST_ACTION, action_array, check_actions, write_commands
from ethbrake_marl.episode.counts import HONEST, OF_FIRST, OF_TOTAL, HarmCount, amount_so_far, cost_of_step
from ethbrake_marl.episode.script_calls import ask_scripts
from ethbrake_marl.episode.state import (
    CLOCK_COLUMNS,
    END,
    ENDED,
    FIRST_DECISION,
    HORIZON,
    LAST,
    NUMBER,
    STEPS,
    TIME,
    State,
)
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.interval import EVENT_BY_EVENT, FAILED, is_line_of_three, move_line, move_lines
from ethbrake_marl.motion.layout import (
    FORCE,
    FOREIGN,
    IMPACTS,
    LATENCY,
    MOVING,
    NEW_FIRST,
    NEW_TOTAL,
    SCRIPTED,
    SPEED,
    Bools,
    Floats,
    Ints,
    scratch_for,
)

# rows of `out`
FIRST_HARM = 0  # first-impact harm of the step (m2/s2)
TOTAL_HARM = 1  # harm of all impacts of the step (m2/s2)
TERMINATED = 2  # 1 if all vehicles have come to rest
TRUNCATED = 3  # 1 if the end of the last step has come first
SAFE_END = 4  # 1 if the episode has ended without any impact
COST = 5  # harm of the step in the reward's count (m2/s2)
OUT_ROWS = 6

ROUNDING = 1e-9  # fraction of a step: a horizon that exceeds whole steps by less needs no further step


class StepSettings(NamedTuple):
    """Settings of a step: learners, times, and weights of the reward."""

    learners: Ints  # [L] bodies (1: Vehicle 1) whose actions a step gets
    time_step_s: float
    horizon_s: float
    harm: float = 1.0  # weight of the line's harm in the reward
    terminal: float = 0.0  # weight of an end without impact in the reward
    harm_count: HarmCount = HONEST  # of harm in the reward (``episode.counts``)
    most_steps: float = np.inf  # number of steps after which an episode is truncated, at no price of motion


class Step(NamedTuple):
    """What happened in one step of n worlds. Nothing happens in episodes that had already ended.

    >>> import numpy as np
    >>> import ethbrake_marl as eb
    >>> scenario, game = eb.open_game("paper-random", reward={"harm": 1.0, "risk": 0.05})
    >>> _, step = game.step(game.reset(scenario.sample(2, seed=7)), np.zeros((2, 1)))
    >>> step.terminated, step.first_impact_harm, [*step.terms]
    (array([False, False]), array([0., 0.]), ['harm', 'risk'])

    """

    reward: Floats  # [n, N] reward of each vehicle
    out: Floats  # [OUT_ROWS, n] the properties below
    time_step_s: float
    # name -> term of the reward without its weight, [n] or [n, N]
    terms: Mapping[str, Floats] = MappingProxyType({})
    vector: Floats | None = None  # [n, N, K] vector reward of each vehicle, if the game has one

    @property
    def first_impact_harm(self) -> Floats:
        """First-impact harm of the line in this step, [n] m2/s2."""
        return self.out[FIRST_HARM]

    @property
    def total_harm(self) -> Floats:
        """Harm of all impacts of the line in this step, [n] m2/s2."""
        return self.out[TOTAL_HARM]

    @property
    def cost(self) -> Floats:
        """Harm of the line in this step, in the count of harm that the reward uses, [n] m2/s2."""
        return self.out[COST]

    @property
    def terminated(self) -> Bools:
        """Whether the episode ended in this step with all vehicles at rest and no command that would move one, [n]."""
        return self.out[TERMINATED] == 1.0

    @property
    def truncated(self) -> Bools:
        """Whether the episode ended in this step at the horizon, or after ``StepSettings.most_steps`` steps, [n]."""
        return self.out[TRUNCATED] == 1.0

    @property
    def safe_end(self) -> Bools:
        """Whether the episode ended in this step without any impact, [n]."""
        return self.out[SAFE_END] == 1.0


def step(
    settings: StepSettings, scripts: Mapping[int, Any], state: State, actions: Floats | None, *, donate: bool = False
) -> tuple[State, Step]:
    """State after one step, and what happened in the step.

    ``actions`` [n, L] are the learners' actions in [-1, 1]. The ``scripts``, body -> script, choose new commands first.
    Raises ``InvalidInput`` for a bad action, and ``PhysicsError`` if a check of the physics fails. ``state`` is
    unchanged, unless ``donate`` allows its arrays to be overwritten.
    """
    n = state.n
    actions = action_array(settings.learners, actions, n)
    line, car, clock, know, wanted, memories = ask_scripts(scripts, state) if scripts else state
    reward, out = np.empty((n, wanted.shape[1] - 1)), np.empty((OUT_ROWS, n))
    old_line, old_clock, old_wanted = line, clock, wanted
    if not donate:
        line, clock, wanted = np.empty(line.shape), np.empty(clock.shape), np.empty(wanted.shape)

    refused_row, failed_row = step_worlds(
        old_line, old_clock, old_wanted, not donate, line, car, clock, wanted, actions, scratch_for(wanted.shape[1]),
        out, reward, settings.learners, settings.time_step_s, settings.harm, settings.terminal,
        settings.harm_count.weight_array,
    )  # fmt: skip
    if refused_row >= 0:
        check_actions(settings.learners, actions[refused_row])
    if failed_row >= 0:
        raise failure(state, failed_row, state.time_s[failed_row], clock[failed_row, TIME])
    return State(line, car, clock, know, wanted, memories), Step(reward, out, settings.time_step_s)


@large
def step_worlds(
    old_line, old_clock, old_wanted, copies, line, car, clock, wanted, actions, scratch, out, reward,
    learners, time_step_s, harm, terminal, weights,
):  # fmt: skip
    """Advance the running episodes by one step, in place.

    Returns the index of a refused world and of a failed world; -1 stands for none. A world is refused if an action is
    not a number in [-1, 1]; then no world of the batch has moved. It fails if a check of the physics fails. ``line``,
    ``car``, ``clock`` and ``wanted`` are arrays of a ``State``, ``out`` and ``reward`` of a ``Step``; if ``copies``,
    ``line``, ``clock`` and ``wanted`` get the contents of ``old_line``, ``old_clock`` and ``old_wanted`` first.
    ``scratch`` is the working memory of the physics. ``harm`` and ``terminal`` are weights of the reward; ``weights``
    [6] belong to the count of harm in the reward.
    """
    for k in range(len(actions)):
        for c in range(learners.shape[0]):
            if not -LARGEST_ACTION <= actions[k, c] <= LARGEST_ACTION:
                return k, -1
    if is_line_of_three(line, car, wanted, scratch):
        return -1, step_rows(
            old_line, old_clock, old_wanted, copies, line, car, clock, wanted, actions, scratch, out,
            reward, learners, time_step_s, harm, terminal, weights,
        )  # fmt: skip
    return -1, step_rows(
        old_line, old_clock, old_wanted, copies, line, car, clock, wanted, actions, scratch, out, reward,
        learners, time_step_s, harm, terminal, weights,
    )  # fmt: skip


@kernel
def step_rows(
    old_line, old_clock, old_wanted, copies, line, car, clock, wanted, actions, scratch, out, reward,
    learners, time_step_s, harm, terminal, weights,
):  # fmt: skip
    """Advance running episodes as ``step_worlds`` does; return the index of a failed world, or -1."""
    bodies, failed = wanted.shape[1], -1
    for k in range(len(clock)):
        if copies:
            copy_world(old_line[k], old_clock[k], old_wanted[k], line[k], clock[k], wanted[k])
        for row in range(out.shape[0]):
            out[row, k] = 0.0
        for i in range(bodies - 1):
            reward[k, i] = 0.0
        if clock[k, ENDED] == 1.0:
            continue
        write_commands(car[k], wanted[k], learners, actions[k])
        before = amount_so_far(line[k], weights)
        outcome, at_rest = advance(line[k], car[k], clock[k], wanted[k], scratch, time_step_s)
        if outcome == FAILED:
            failed = k
        impacts = 0.0
        for p in range(bodies - 1):
            impacts += line[k, IMPACTS, p]
            if outcome == EVENT_BY_EVENT:
                out[FIRST_HARM, k] += scratch[NEW_FIRST, p]
                out[TOTAL_HARM, k] += scratch[NEW_TOTAL, p]
        over = clock[k, ENDED] == 1.0
        out[TERMINATED, k] = 1.0 if at_rest else 0.0
        out[TRUNCATED, k] = 1.0 if over and not at_rest else 0.0
        out[SAFE_END, k] = 1.0 if over and impacts == 0.0 else 0.0
        impact_harm = weights[OF_FIRST] * out[FIRST_HARM, k] + weights[OF_TOTAL] * out[TOTAL_HARM, k]
        cost = cost_of_step(before, line[k], impact_harm, weights)
        shared = (terminal if out[SAFE_END, k] == 1.0 else 0.0) - harm * cost
        out[COST, k] = cost
        for i in range(bodies - 1):
            reward[k, i] = shared
    return failed


@kernel
def copy_world(old_line, old_clock, old_wanted, line, clock, wanted):
    """Copy one world's arrays that a step changes."""
    for row in range(line.shape[0]):
        for i in range(line.shape[1]):
            line[row, i] = old_line[row, i]
    for i in range(wanted.shape[0]):
        wanted[i] = old_wanted[i]
    for column in range(clock.shape[0]):
        clock[column] = old_clock[column]


@kernel
def advance(line, car, clock, wanted, scratch, time_step_s):
    """Advance one running world to its next decision, in place; return the result of ``move_line``, and ``at_rest``.

    ``at_rest``: whether no vehicle moves or would move. The arguments are those of ``step_worlds`` for one world. A
    decision time is computed as the first one plus a multiple of the time step, not by repeated addition, so rounding
    errors do not add up.
    """
    clock[STEPS] += 1.0
    over = clock[STEPS] >= clock[LAST]
    until = clock[END] if over else clock[FIRST_DECISION] + clock[STEPS] * time_step_s
    outcome = move_line(line, car, wanted, scratch, clock[TIME], until)
    clock[TIME] = until
    at_rest = outcome != FAILED and stands(line, wanted)
    clock[ENDED] = 1.0 if over or at_rest or outcome == FAILED else 0.0
    if over and clock[END] >= clock[HORIZON]:
        note_motion(line, car)
    return outcome, at_rest


@kernel
def stands(line, wanted):
    """Whether every vehicle of one world is at rest, and no command (``wanted``, m/s2) or force would move it."""
    at_rest = True
    for i in range(1, line.shape[1]):
        at_rest = at_rest and line[SPEED, i] == 0.0 and wanted[i] <= 0.0 and line[FORCE, i] <= 0.0
    return at_rest


@kernel
def note_motion(line, car):
    """Store what each vehicle's present motion costs (m2/s2) in the row MOVING of one world's ``line``.

    The cost is ``v^2 - s^2``, with the speed v of the vehicle and its *free* speed s. Of a scripted vehicle, s is the
    speed that its script commands: v without what it has from contacts (row FOREIGN). Of any other vehicle, s is the
    free speed of the vehicle ahead (of Vehicle 1: 0), but at most v. It is 0 for a vehicle that moves backward.
    """
    free = 0.0
    for i in range(1, line.shape[1]):
        speed, foreign = line[SPEED, i], line[FOREIGN, i]
        if car[SCRIPTED, i] == 1.0:
            free = speed - foreign if foreign > TOUCH_MPS else speed
        free = max(min(free, speed), 0.0)
        line[MOVING, i - 1] = speed * speed - free * free


def at_alert(line: Floats, car: Floats, know: Floats, wanted: Floats, numbers: Ints) -> State:
    """State of worlds at the alert, when Vehicle 1 begins to brake and no agent has decided yet.

    The arrays are those of ``State``; ``numbers`` [n] are the numbers of the worlds in their list.
    """
    clock = np.zeros((len(line), CLOCK_COLUMNS))
    clock[:, NUMBER] = numbers
    return State(line, car, clock, know, wanted, {})


def first_decision(alert: State, deciders: Ints, settings: StepSettings) -> State:
    """Episodes at their first decision: when the shortest latency of the bodies ``deciders`` has elapsed.

    Until then all vehicles hold the commands ``alert.wanted``.
    """
    first = alert.car[:, LATENCY, deciders].min(axis=1) if len(deciders) else np.zeros(alert.n)
    state, most = hold_commands(alert, first), settings.most_steps
    state.clock[:, FIRST_DECISION] = first
    steps = steps_to_horizon(first, settings)
    state.clock[:, LAST] = np.minimum(steps, most)
    state.clock[:, END] = np.where(steps <= most, settings.horizon_s, first + most * settings.time_step_s)
    return state


def steps_to_horizon(first_s: Any, settings: StepSettings) -> Any:
    """Number of the step that ends at the horizon, if the first decision is at ``first_s`` (s)."""
    return np.ceil((settings.horizon_s - first_s) / settings.time_step_s - ROUNDING)


def hold_commands(state: State, until_s: Floats) -> State:
    """State at the time ``until_s`` [n] if all vehicles hold their commands until then. Raises ``PhysicsError``."""
    line, clock, wanted = state.line.copy(), state.clock.copy(), state.wanted.copy()
    car = np.require(state.car, requirements=("C", "W"))  # a kernel is compiled again for others
    failed = move_lines(line, car, state.time_s.copy(), until_s.copy(), wanted, scratch_for(wanted.shape[1]))
    if failed >= 0:
        raise failure(state, failed, state.time_s[failed], until_s[failed])
    clock[:, TIME] = until_s
    return state._replace(line=line, car=car, clock=clock, wanted=wanted)


def failure(state: State, row: int, start_s: float, until_s: float) -> PhysicsError:
    number = int(state.clock[row, NUMBER])
    reason = f"a check of the physics failed between {start_s:g} s and {until_s:g} s"
    return PhysicsError({row if number < 0 else number: reason})
