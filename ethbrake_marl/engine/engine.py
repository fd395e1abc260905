"""Episodes of ``n`` worlds at once: reset, step, roles, latency gates, episode ends.

Every interface of the environment, every evaluation and every search is a thin layer on this. An episode starts at
t = 0, when Vehicle 1 brakes; ``reset`` moves exactly to the first moment at which a learner's latency has elapsed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import checked_action
from ethbrake_marl.engine.step import (
    BAD_ACTION,
    ENDED,
    FAILED,
    LAST_STEP,
    OUTCOME_ROWS,
    START,
    STEP,
    TERMINAL_WEIGHT,
    TRUNCATED,
    Step,
    step_worlds,
)
from ethbrake_marl.engine.stream import (
    Roster,
    Script,
    Start,
    Stream,
    ask_script,
    ask_where_due,
    begin_script,
    check_alert,
    is_state_free,
    within_capacity,
)
from ethbrake_marl.errors import InvalidInput, UncertifiedStep, renumbered
from ethbrake_marl.harm import Ledger, objective_harm
from ethbrake_marl.observations import Observations, ObservationSpec, Plan, observation_for, observe_packed, plan_of
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import (
    NO_ROWS,
    TIME,
    Packed,
    command_at,
    failure,
    gap_at,
    has_messages,
    has_news,
    has_obstacle,
    ledger_columns,
    obstacle_ledger_columns,
    own_latency_and_news,
    pack,
    params_at,
    previous_at,
    speed_at,
    unpack,
    with_news_columns,
    with_obstacle_columns,
)
from ethbrake_marl.physics.kernel import FLAG, decision_s, number_of_decisions
from ethbrake_marl.physics.messages import hear_rows
from ethbrake_marl.rewards import (
    Reward,
    StepOutcome,
    counted_terms,
    further_terms,
    moving_terms_of,
    own_terms,
    potential,
    registered_terms_of,
    resolved_objective,
    reward_params,
    weighted_sum,
)
from ethbrake_marl.scenario import Scenario

# The running episodes of a batch: their rows, and what can be read from them.

RUNNING = ("_state", "_params", "_clock", "_wanted", "_potential")  # arrays of an engine that every step changes


class Running:
    """``n`` running episodes of one scenario, to be read; ``Engine`` moves them."""

    scenario: Scenario  # of every episode
    n: int  # worlds that are advanced together
    roster: Roster  # who runs in which row, and which worlds failed
    _state: Floats  # of the running episodes, as rows of ``physics.rows``
    _params: Floats
    _clock: Floats  # [n, CLOCK_WIDTH]
    _wanted: Floats  # [n, N] m/s2
    _potential: Floats  # [n, N]
    _obstacle: bool  # the rows have columns of an obstacle
    _by_link: bool  # ... of news by link
    _plan: Plan  # of what a vehicle observes

    @property
    def packed(self) -> Packed:
        """The running worlds themselves, as rows of ``physics.rows``: for kernels to read, not to be changed."""
        return Packed(self._state, self._params)

    @property
    def wanted_mps2(self) -> Floats:
        """What each vehicle wanted in the last step, [n, N]: for kernels to read, not to be changed."""
        return self._wanted

    @property
    def worlds(self) -> Worlds:
        """The worlds as they are now, in their own memory."""
        return unpack(self.packed)

    @property
    def ledger(self) -> Ledger:
        """Harm of the running episodes so far, in its own memory."""
        vehicles = self.scenario.vehicles
        first, total, count = ledger_columns(self._state, vehicles)
        mass = self._params[:, params_at(3, vehicles) : params_at(4, vehicles)].copy()
        return Ledger(first, total, count, *obstacle_ledger_columns(self._state, vehicles), mass)

    @property
    def known_from_s(self) -> Floats:
        """From when on vehicle i acts on news of vehicle j, [n, N, N]: ``known_from_s`` of the worlds' vehicles."""
        return own_latency_and_news(self._params, self.scenario.vehicles)[1]

    @property
    def ended(self) -> Bools:
        """Episodes that have ended, [n]."""
        ended: Bools = self._clock[:, ENDED] == 1.0
        return ended

    @property
    def steps(self) -> Ints:
        """Steps that the running episodes have taken, [n]."""
        return self._clock[:, STEP].astype(np.int64)

    def observe(self, vehicle: int) -> Observations:
        """Current observation of one vehicle, [n, F]."""
        if not 0 <= vehicle < self.scenario.vehicles:
            raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{self.scenario.vehicles - 1}")
        return self.observe_all(np.array([vehicle]))[:, 0]

    def observe_all(self, vehicles: Ints, rows: Ints | None = None) -> Observations:
        """Current observations of several vehicles, [n, len(vehicles), F]; only of the worlds ``rows`` if given."""
        state, params = self._state, self._params
        if rows is not None:
            state, params = state.take(rows, axis=0), params.take(rows, axis=0)
        if not self._plan.extras:
            return observe_packed(state, params, vehicles, self._plan)
        steps = self._clock[:, STEP] if rows is None else self._clock[rows, STEP]
        return observe_packed(state, params, vehicles, self._plan, steps)

    def _kept(self, packed: Packed) -> Packed:
        """Rows as wide as they are kept: with columns of an obstacle, and of news by link, if the first had such."""
        (state, params), N = packed, self.scenario.vehicles
        return Packed(
            with_obstacle_columns(state, N) if self._obstacle else state,
            with_news_columns(params, N) if self._by_link else params,
        )


# Terms of the reward that the compiled step does not know: they need the motion, the future or an objective.


class Terms:
    """The reward of a batch, resolved: what is added to every step beside the terms that all vehicles share.

    Args:
        reward: a name, a mapping of settings, or ``RewardParams``.
        scenario: whose objective holds where the reward names none.
        learners: indices of the vehicles (0 = front) that learn.

    """

    def __init__(self, reward: Reward, scenario: Scenario, learners: Sequence[int]) -> None:
        self.params, self._objectives = resolved_objective(reward_params(reward), scenario.objective, scenario.vehicles)
        self._learners, self._learner_index = tuple(learners), np.array(learners, np.int64)
        self._moving, self._own = moving_terms_of(self.params), registered_terms_of(self.params)
        self._moves_reward = bool(self._moving or self._own)
        self.by_objective = bool(self._objectives)  # each vehicle's harm by an objective
        self.are_foreign = bool(self._own)  # one is code that somebody registered, and so may fail
        self.add_something = self._moves_reward or self.params.shaping > 0.0 or self.by_objective

    @property
    def shared_harm(self) -> float:
        """Weight of the harm of the whole line, which the compiled step counts: 0 where each has its objective."""
        return 0.0 if self._objectives else self.params.harm

    def objective_harm(self, running: Running) -> Floats:
        """What the objective of each vehicle makes of the harm so far, [n, N]; only where there are objectives."""
        return objective_harm(running.ledger, self.params.harm_count, self._objectives)

    def add(self, step: Step, running: Running, before: Floats | None) -> None:
        """Add what a step has brought to its reward; nothing for rows that stood still.

        ``before``: ``objective_harm`` before the step, None without objectives.
        """
        if before is not None and self.params.harm > 0.0:
            step.further["harm"] = before - self.objective_harm(running)
        standing = running.ended & ~step.ended
        if self._moves_reward:
            outcome = self._outcome(step, running)
            step.further.update(further_terms(self._moving, self.params, outcome))
            if self._own:
                counts = ~standing & (step.failed == 0)
                step.further.update(own_terms(self._own, outcome, counts, running.steps))
        if self.params.shaping > 0.0:
            step.further["shaping"] = self._shaping(running, step.terminated)
        extra = weighted_sum(self.params, step.further, step.reward.shape)
        extra[standing] = 0.0
        step.reward[:] += extra

    def _outcome(self, step: Step, running: Running) -> StepOutcome:
        """What terms are computed from: views of the running rows."""
        vehicles, state, params = running.scenario.vehicles, running._state, running._params
        gaps = gap_at(vehicles)
        braking, driving, latency, mass = (
            params[:, params_at(k, vehicles) : params_at(k + 1, vehicles)] for k in range(4)
        )
        return StepOutcome(
            step.first_impact_harm,
            step.total_harm,
            step.safe_end,
            state[:, gaps : gaps + vehicles - 1],
            state[:, speed_at(vehicles) : command_at(vehicles)],
            state[:, command_at(vehicles) : previous_at(vehicles)],
            state[:, previous_at(vehicles) : gaps],
            running.scenario.time_step_s,
            state[:, TIME],
            braking,
            driving,
            latency,
            mass,
            self._learner_index.view(),
        )

    def _shaping(self, running: Running, terminated: Bools) -> Floats:
        """The shaping term [n, N] of this step; keeps the new potentials, which are 0 where an episode terminated."""
        before = running._potential
        running._potential = self.potentials(running.worlds, running.scenario)
        running._potential[terminated] = 0.0
        shaping: Floats = self.params.shaping_discount * running._potential - before
        return shaping

    def potentials(self, worlds: Worlds, scenario: Scenario) -> Floats:
        """Potential of every learner, 0 for other vehicles, [n, N]."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        shared = potential(self.params, worlds, self._learners, scenario.horizon_s)
        potentials[:, self._learner_index] = shared[:, np.newaxis]
        return potentials


ROUNDING = 1e-9  # of a time step: moments that are so close are one
Actions = Mapping[int, NDArray[np.floating]] | NDArray[np.floating]


class Way(NamedTuple):
    """What a step brought before the last stop on its way, where a script on a grid of its own decided."""

    reward: Floats  # [n, N] of what all vehicles share
    harm: Floats  # [2, n] of the line, by both counts
    stopped: Bools  # [n]
    failed: Ints  # [n] status of the kernel where the world could not be moved, else 0
    in_force: Floats  # [n, N] commands when the step began


class Watcher(Protocol):
    """Looks on while an engine's episodes run, as the trace of a picture does; it changes nothing.

    What it remembers is kept by the engine beside the worlds (``Engine.memory``): both change in one piece, or, where
    anything fails or is interrupted, neither does. A memory is therefore never changed in place.
    """

    def begun(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """The memory once episodes start in these rows; ``alert`` holds those worlds only, at t = 0."""

    def stepped(self, memory: Any, before: Engine, after: Engine) -> Any:
        """The memory once the engine, as it was ``before`` this step, is as ``after``."""


class Ruling(NamedTuple):
    """What a guard lets happen in one step, of n worlds and L learners."""

    proposed: Floats  # [n, L] actions; NaN: none, or no number
    applied: Floats  # [n, L] actions
    stepped_in: Bools  # [n] something else is applied than what was proposed
    asked: Bools  # [n] worlds that it is about
    decision: Any  # what else there is to tell of it
    memory: Any  # the guard's once the step is made


class Guard(Protocol):
    """Stands between what is proposed to an engine and what is applied: a shield.

    It is asked inside ``Engine.step``, so nothing that reaches the engine passes it by. What it remembers is kept by
    the engine: worlds, memory and ruling change in one piece, or, where anything fails or is interrupted, none does. A
    memory is therefore never changed in place.
    """

    def begin(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """The memory once episodes start in these rows, None before; ``alert`` holds those worlds only, at t = 0."""

    def decide(self, running: Running, memory: Any, proposed: Floats) -> Ruling:
        """What is applied instead of the actions [n, L]. A column of NaN: nothing was proposed for that learner."""

    def check(self, ruling: Ruling, after: Running) -> Any:
        """The memory now that the step led to ``after``. Raises ``UncertifiedStep``: then it was not made."""


class Engine(Running):
    """A batch of ``n`` running episodes of one scenario.

    Steps start when the first of the ``deciders`` may act; with none, at t = 0. A ``guard`` (a shield) may stand
    between what is proposed and what is applied. A world that the physics cannot advance takes no other with it: its
    episode is cut off (truncated), and the ``roster`` names it.

    Args:
        scenario: of every episode.
        n: worlds that are advanced together, at least 1.
        learners: indices of the vehicles (0 = front) that need an action in every step.
        scripts: vehicle index -> what drives it, for every vehicle that does not learn.
        reward: a name, a mapping of settings, or ``RewardParams``.
        observation: what a vehicle observes; None: ``observation_for(scenario)``.
        seed: of the scenario's training stream, from which worlds come unless they are given.
        deciders: indices of the vehicles that set the grid of decisions; None: the learners. An evaluated agent drives
            its vehicle as a script, on a learner's grid.
        worlds: of the first episodes, at t = 0; None: from the stream.
        guard: makes what stands between proposed and applied actions; None: what is proposed is applied.

    >>> import ethbrake_marl as eb
    >>> engine = eb.make_sb3_vec_env("paper-random", 4, seed=7).engine
    >>> engine.n, engine.learners, engine.worlds.time_s
    (4, (1,), array([0.5, 0.5, 0.5, 0.5]))

    """

    def __init__(
        self,
        scenario: Scenario,
        n: int,
        *,
        learners: Sequence[int],
        scripts: Mapping[int, Script],
        reward: Reward = "harm",
        observation: ObservationSpec | None = None,
        seed: int = 0,
        deciders: Sequence[int] | None = None,
        worlds: Worlds | None = None,
        guard: Callable[[Engine], Guard] | None = None,
    ) -> None:
        if not n >= 1:
            raise InvalidInput(f"engine: n = {n} worlds; at least 1 is needed")
        self.scenario, self.n = scenario, n
        self.learners = tuple(learners)
        self.scripts = dict(scripts)
        unassigned = set(range(scenario.vehicles)) - set(self.learners) - set(self.scripts)
        if unassigned or set(self.learners) & set(self.scripts):
            raise InvalidInput(
                f"engine: learners {self.learners} and scripts {tuple(self.scripts)} must name each of the"
                f" {scenario.vehicles} vehicles exactly once"
            )
        self.deciders = self.learners if deciders is None else tuple(deciders)
        if not set(self.deciders) <= set(range(scenario.vehicles)):
            raise InvalidInput(f"engine: deciders {self.deciders} must be from 0 to {scenario.vehicles - 1}")
        self._terms = Terms(reward, scenario, self.learners)
        self.reward = self._terms.params
        self.observation = (observation or observation_for(scenario)).at_steps_of(scenario.time_step_s)
        self._plan = plan_of(self.observation)
        self._memories: dict[Watcher, Any] = {}
        self._remembering = {i: s for i, s in self.scripts.items() if not is_state_free(s)}
        self._on_own_grid = {i: s for i, s in self._remembering.items() if i not in self.deciders}
        self._stops: list[tuple[Floats, Floats]] = []  # of the last step: the states there, and what led to them
        self._learner_index = np.array(self.learners, np.int64)
        total = float(self.reward.harm_count == "total")
        times = scenario.time_step_s, scenario.horizon_s
        self._settings = np.array([*times, self._terms.shared_harm, total, self.reward.terminal])
        self.reward_terms = counted_terms(self.reward)  # names of those whose values each step tells
        self._stream = Stream(scenario, self.deciders, self.scripts, seed)
        self.protect(None if guard is None else guard(self))
        self.reset(worlds=worlds)

    @property
    def seed(self) -> int:
        """Seed of the training stream."""
        return self._stream.seed

    @property
    def watchers(self) -> tuple[Watcher, ...]:
        """Who follows this engine."""
        return tuple(self._memories)

    def memory(self, watcher: Watcher) -> Any:
        """What a watcher remembers of the running episodes."""
        return self._memories[watcher]

    def watch(self, watcher: Watcher, memory: Any) -> None:
        """Let a watcher follow, from ``memory`` on."""
        self._memories = {**self._memories, watcher: memory}

    def protect(self, guard: Guard | None) -> None:
        """Let a guard stand between what is proposed and what is applied, from the next reset on; None: nobody does."""
        self.guard, self.guarded, self.ruling = guard, None, None

    def reset(self, *, seed: int | None = None, worlds: Worlds | None = None) -> None:
        """Start new episodes in all rows: the given worlds (at t = 0), or the next ones of the training stream.

        With ``seed`` the stream starts again from its beginning. Whatever fails, the running episodes go on.
        """
        if worlds is not None:
            check_alert(worlds, self.n, self.scenario.vehicles)
        stream = copy.copy(self._stream)
        if seed is not None:
            stream.restart(seed)
        first = None if worlds is not None else stream.position
        start = stream.take(self.n) if worlds is None else stream.prepare(worlds)
        new = copy.copy(self)
        new._stream, new.roster = stream, Roster(self.n, stream.seed, first, worlds)
        new._obstacle = self.scenario.has_obstacle or has_obstacle(start.packed.state, self.scenario.vehicles)
        new._by_link = self.scenario.by_link or has_news(start.packed.params, self.scenario.vehicles)
        new._state, new._params = (array.copy() for array in new._kept(start.packed))
        new._clock, new._wanted = start.clock.copy(), start.wanted.copy()
        new._potential = np.zeros(start.wanted.shape)
        new._stops, new.ruling = [], None
        new._begin(np.arange(self.n), start)
        self.__dict__.update(new.__dict__)  # in one piece: not even an interrupt comes between

    def renew(self, rows: Ints) -> None:
        """Start new episodes of the training stream in these rows (autoreset). Whatever fails, nothing is changed."""
        if len(rows) == 0:
            return
        if not (self._memories or self._remembering or self.guard):
            self._renew(rows)
            return
        new = self._apart()
        new._stream = copy.copy(self._stream)
        new._renew(rows)
        self.__dict__.update(new.__dict__)

    def _apart(self) -> Engine:
        """An engine that goes on from here without changing this one (scripts that remember are shared)."""
        new = copy.copy(self)
        new.__dict__.update({name: getattr(new, name).copy() for name in RUNNING})
        new.roster = new.roster.apart()
        return new

    def _renew(self, rows: Ints) -> None:
        position = self._stream.position
        start = self._stream.take(len(rows))
        self.roster.renew(rows, position)
        self._state[rows], self._params[rows] = self._kept(start.packed)
        self._clock[rows], self._wanted[rows] = start.clock, start.wanted
        self._begin(rows, start)

    def step(self, actions: Actions) -> Step:
        """Advance every running episode by one time step.

        ``actions``: for each learner (by vehicle index, or as columns [n, L] in the order of ``learners``) a number in
        [-1, 1] per world; by index a guarded one may be left out. Rows whose episode has ended stay as they are until
        ``renew`` or ``reset``. What the guard refuses does not happen: the worlds stay as they are.
        """
        columns = self._columns(actions)
        if not (self.guard or self._memories or self._terms.are_foreign or self._on_own_grid):  # nobody can refuse it
            return self._advance(columns)
        before = copy.copy(self)  # of one moment, whatever another thread does meanwhile
        new = before._apart()
        if self.guard is not None:
            if before.guarded is None:
                raise UncertifiedStep("shield: this episode began before the shield was put around it; reset first")
            proposed = columns if isinstance(actions, Mapping) else self._in_range(columns)  # those of one are checked
            ruling = self.guard.decide(before, before.guarded, proposed)
            columns = np.ascontiguousarray(ruling.applied)
        step = new._advance(columns)
        if self.guard is not None:
            new.ruling, new.guarded = ruling, self.guard.check(ruling, new)
        new._memories = {w: w.stepped(memory, before, new) for w, memory in self._memories.items()}
        self.__dict__.update(new.__dict__)  # in one piece: not even an interrupt comes between
        return step

    def _advance(self, columns: Floats) -> Step:
        """Advance every running episode by one time step, in place."""
        if len(self._remembering) > len(self._on_own_grid):
            worlds = self.worlds
            for vehicle in self._remembering.keys() - self._on_own_grid.keys():
                script = self._remembering[vehicle]
                self._wanted[:, vehicle] = within_capacity(ask_script(script, worlds, vehicle), worlds, vehicle, script)
        before = self._terms.objective_harm(self) if self._terms.by_objective else None
        self._stops = []
        way = self._start_on_own_grid(columns) if self._on_own_grid else None
        was = self._state.copy() if has_messages(self._state, self._params) else None
        reward, outcome = np.empty(self._wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        status = self._step_worlds(columns, reward, outcome)
        if status == BAD_ACTION:  # nothing was moved
            status = self._step_worlds(self._in_range(columns), reward, outcome)
        if was is not None:
            until_s = self._state[:, TIME]
            hear_rows(was, self._params, self._wanted, until_s, until_s, self.scenario.time_step_s)
        if way is not None:
            status = self._add_way(way, reward, outcome, status)
        step = Step(reward, outcome, self.reward, {})
        if status != FLAG.DONE:
            times = self._state[:, 0]
            self.roster.mark(step.failed, times, np.minimum(times + self.scenario.time_step_s, self.scenario.horizon_s))
        if self._terms.add_something:
            self._terms.add(step, self, before)
        return step

    def _columns(self, actions: Actions) -> Floats:
        """The learners' actions as [n, L]; their range is checked where they are used."""
        shape = (self.n, len(self.learners))
        if isinstance(actions, np.ndarray) or not isinstance(actions, Mapping):
            given = np.asarray(actions)
            if given.shape != shape or given.dtype.kind not in "fiu":
                return checked_action(actions, shape, "the learners")
            return np.ascontiguousarray(given, np.float64)
        columns = np.empty(shape)
        for c, vehicle in enumerate(self.learners):
            if vehicle not in actions and self.guard is not None:
                columns[:, c] = np.nan
                continue
            if vehicle not in actions:
                raise InvalidInput(f"step: no action for the learner vehicle_{vehicle + 1}")
            columns[:, c] = checked_action(actions[vehicle], (self.n,), f"vehicle_{vehicle + 1}")
        return columns

    def _step_worlds(self, columns: Floats, reward: Floats, outcome: Floats) -> int:
        _, status = step_worlds(
            self._state, self._params, self._clock, columns, self._learner_index, self._settings, NO_ROWS,
            self._wanted, reward, outcome,
        )  # fmt: skip
        return status

    def _in_range(self, columns: Floats) -> Floats:
        """The actions [n, L] without the last rounding of a float32; ``InvalidInput`` for one out of range."""
        each = [checked_action(columns[:, c], (self.n,), f"vehicle_{i + 1}") for c, i in enumerate(self.learners)]
        return np.stack(each, axis=1) if each else columns

    def _begin(self, rows: Ints, start: Start) -> None:
        """Tell those who must know that episodes start in ``rows``, and move what depends on them."""
        if self.guard or self._memories or self._remembering:
            alert = start.alert
            with renumbered(rows):
                if self.guard is not None:
                    self.guarded = self.guard.begin(self.guarded, alert, rows)
                self._memories = {w: w.begun(memory, alert, rows) for w, memory in self._memories.items()}
                for vehicle, script in self._remembering.items():
                    begin_script(script, alert, vehicle, rows)
        if self._on_own_grid:
            self._begin_on_own_grid(rows, start.alert, start.clock[:, START])
        elif has_messages(self._state, self._params):
            moving, params, start_s = self._kept(pack(start.alert)).state, self._params[rows], self._state[rows, TIME]
            hear_rows(moving, params, self._wanted[rows], start_s, start_s, self.scenario.time_step_s)
            self._params[rows] = params
        if self.reward.shaping > 0.0:
            worlds = unpack(Packed(self._state[rows], self._params[rows]))
            self._potential[rows] = self._terms.potentials(worlds, self.scenario)

    def _start_on_own_grid(self, columns: Floats) -> Way:
        """Let the scripts on their own grids decide within the step that begins; what comes of the way there."""
        in_force = self._state[:, command_at(self.scenario.vehicles) : previous_at(self.scenario.vehicles)].copy()
        steps, last, start_s = (self._clock[:, at] for at in (STEP, LAST_STEP, START))
        until_s = decision_s(start_s, self.scenario.time_step_s, steps + 1.0)
        until_s = np.where(steps + 1.0 >= last, self.scenario.horizon_s, until_s)
        way = self._decide_on_the_way(~self.ended, until_s, self._in_range(columns))
        self._clock[way.failed != 0, ENDED] = 1.0
        return way._replace(in_force=in_force)

    def _add_way(self, way: Way, reward: Floats, outcome: Floats, status: int) -> int:
        """Add the way to the last stop to what came after it, in place; the status of both."""
        reward += way.reward
        outcome[: len(way.harm)] += way.harm
        vehicles = self.scenario.vehicles
        self._state[way.stopped, previous_at(vehicles) : gap_at(vehicles)] = way.in_force[way.stopped]
        lost = way.failed != 0
        outcome[TRUNCATED, lost], outcome[FAILED, lost] = 1.0, way.failed[lost]
        return int(way.failed[lost][0]) if lost.any() else status

    def _decide_on_the_way(self, running: Bools, until_s: Floats, columns: Floats) -> Way:
        """Let the scripts on their own grids make all decisions before ``until_s`` [n] in the ``running`` worlds.

        A world is moved to a decision only where that changes a command: the bits depend on where motion changes.
        """
        n, N = self._wanted.shape
        vehicles, step_s = list(self._on_own_grid), self.scenario.time_step_s
        first_s = self._params[:, params_at(2, N) : params_at(3, N)][:, vehicles].T
        made = np.maximum(number_of_decisions(first_s, step_s, self._state[:, TIME]), 0.0)
        due = np.where(running, np.maximum(number_of_decisions(first_s, step_s, until_s), 0.0), made)
        way = Way(np.zeros((n, N)), np.zeros((2, n)), np.zeros(n, np.bool_), np.zeros(n, np.int64), np.empty(0))
        while (made < due).any():
            next_s = np.where(made < due, first_s + made * step_s, np.inf)
            moment = next_s.min(axis=0)
            asked = next_s <= moment + ROUNDING * step_s
            asked &= made < due
            now = self._state[:, TIME]
            moment = np.where((moment < np.inf) & (moment > now + ROUNDING * step_s), moment, now)
            ahead, reward, outcome = self._look_ahead(moment, until_s, columns)
            worlds, wanted = unpack(ahead), self._wanted.copy()
            for (vehicle, script), here in zip(self._on_own_grid.items(), asked, strict=True):
                if here.any():
                    wanted[here, vehicle] = ask_where_due(script, worlds, vehicle, here)[here]
            changed = (wanted != self._wanted)[:, vehicles] & (made > 0.0).T  # a first one waits for the latency anyway
            stops = (moment > now) & changed.any(axis=1) & (outcome[FAILED] == 0.0)
            way.failed[:] = np.where(outcome[FAILED] != 0.0, outcome[FAILED], way.failed)
            if stops.any():
                self._stop(stops, ahead)
                way.reward[stops] += reward[stops]
                way.harm[:, stops] += outcome[: len(way.harm), stops]
                way.stopped[stops] = True
            self._wanted[:] = wanted
            made += asked
            made = np.where(way.failed != 0, due, made)
        return way

    def _look_ahead(self, until_s: Floats, decision_s: Floats, columns: Floats) -> tuple[Packed, Floats, Floats]:
        """The worlds at ``until_s`` [n], and reward [n, N] and outcome of the way there; ``decision_s``: the next one.

        Only the learners' commands in ``_wanted`` are changed, by ``columns`` [n, L]; none without any.
        """
        clock, settings = np.zeros(self._clock.shape), self._settings.copy()
        clock[:, START], clock[:, STEP], clock[:, LAST_STEP] = until_s, -1.0, np.inf  # a step from -1 to 0 ends there
        clock[:, ENDED] = ~(until_s > self._state[:, TIME])
        settings[TERMINAL_WEIGHT] = 0.0
        reward, outcome = np.empty(self._wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        state, params = self._state.copy(), self._params.copy()
        step_worlds(
            state, params, clock, columns, self._learner_index[: columns.shape[1]], settings, NO_ROWS, self._wanted,
            reward, outcome,
        )  # fmt: skip
        if has_messages(state, params):
            hear_rows(self._state.copy(), params, self._wanted, state[:, TIME], decision_s, self.scenario.time_step_s)
        return Packed(state, params), reward, outcome

    def _stop(self, rows: Bools, ahead: Packed) -> None:
        """Move these rows to where the look ahead found them."""
        self._state[rows], self._params[rows] = ahead.state[rows], ahead.params[rows]
        self._stops.append((self._state.copy(), self._wanted.copy()))

    def _begin_on_own_grid(self, rows: Ints, alert: Worlds, start_s: Floats) -> None:
        """From the alert on scripts with a memory decide on their own grids; then the first decision is near.

        Deciders do not: like a learner they coast, and are seen to coast, until their first decision.
        """
        began = self._kept(pack(alert)).state
        self._stops = [(state.copy(), wanted) for state, wanted in self._stops]  # of who goes on; the others did not
        for state in (self._state, *(state for state, _ in self._stops)):
            state[rows] = began
        running, until_s, none = np.zeros(self.n, np.bool_), self._state[:, TIME].copy(), np.empty((self.n, 0))
        running[rows], until_s[rows] = True, start_s
        way = self._decide_on_the_way(running, until_s, none)
        ahead, _, outcome = self._look_ahead(until_s, until_s, none)
        failed = np.where(way.failed != 0, way.failed, outcome[FAILED].astype(np.int64))
        if failed.any():
            raise failure(np.where(failed == 0, FLAG.DONE, failed), self._state[:, TIME], until_s)
        self._state[rows], self._params[rows] = ahead.state[rows], ahead.params[rows]

    def segments(self, before: Worlds, last_mps2: Floats) -> Iterator[tuple[Worlds, Floats, Floats]]:
        """The last step, made from ``before`` (after a reset: the alert), in parts within which nobody decides.

        Each is worlds, the commands [n, N] that they followed, ``last_mps2`` in the last part, and until when [n].
        """
        for state, wanted in self._stops:
            then = unpack(Packed(state, self._params), before.vehicles)
            yield before, wanted, then.time_s
            before = then
        yield before, last_mps2, self._state[:, TIME].copy()
