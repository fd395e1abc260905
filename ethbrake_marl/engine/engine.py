"""``Engine``: a batch of running episodes of one scenario. Every interface steps one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.engine.compiled_step import (
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
from ethbrake_marl.engine.memory import (
    Arrays,
    Memory,
    ask_script,
    begin_script,
    checked_memory,
    flat,
    is_state_free,
    map_memory,
    renew_memory,
    take_memory,
    unflat,
    within_capacity,
)
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.engine.stream import NO_ROWS, RUNNING, Roster, Start, Stream, check_alert, packed_with
from ethbrake_marl.errors import InvalidInput, UncertifiedStep, renumbered
from ethbrake_marl.game.actions import checked_action
from ethbrake_marl.game.harm import Ledger, empty_ledger
from ethbrake_marl.game.objectives import objective_harm
from ethbrake_marl.game.observations import Observation, Observations, ObservationSpec, Plan
from ethbrake_marl.game.rewards import Reward, StepOutcome, reward_params
from ethbrake_marl.physics.columns import Packed
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.messages import hear_rows
from ethbrake_marl.physics.rows import FLAG
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.observed import common_observation, observations_of
from ethbrake_marl.scenario.schema import Scenario


class Terms:
    """The reward of a batch, resolved: what is added to every step beside the terms that all vehicles share.

    Args:
        reward: a name, a mapping of settings, or ``RewardParams``.
        scenario: whose objective holds where the reward names none.
        learners: indices of the vehicles (0 = front) that learn.

    """

    def __init__(self, reward: Reward, scenario: Scenario, learners: Sequence[int]) -> None:
        self.params, self._objectives = reward_params(reward).settled(scenario.objective, scenario.vehicles)
        self._learners, self._learner_index = tuple(learners), np.array(learners, np.int64)
        self._moving, self._own = self.params.moving, self.params.registered
        self.by_objective = bool(self._objectives)  # each vehicle's harm by an objective
        self.are_foreign = bool(self._own)  # one is code that somebody registered, and so may fail
        self.add_something = bool(self._moving or self._own) or self.params.shaping > 0.0 or self.by_objective

    @property
    def shared_harm(self) -> float:
        """Weight of the harm of the whole line, which the compiled step counts: 0 where each has its objective."""
        return 0.0 if self._objectives else self.params.harm

    def objective_harm(self, running: Engine) -> Floats:
        """What the objective of each vehicle makes of the harm so far, [n, N]; only where there are objectives."""
        return objective_harm(running.ledger, self.params.harm_count, self._objectives)

    def add(self, step: Step, running: Engine, before: Floats | None) -> None:
        """Add what a step has brought to its reward; nothing for rows that stood still.

        ``before``: ``objective_harm`` before the step, None without objectives.
        """
        if before is not None and self.params.harm > 0.0:
            step.further["harm"] = before - self.objective_harm(running)
        standing = running.ended & ~step.ended
        if self._moving or self._own:
            (state, params), column = running.packed, running.packed.column
            outcome = StepOutcome(
                step.first_impact_harm,
                step.total_harm,
                step.safe_end,
                state[:, column.gap : column.hit],
                state[:, column.speed : column.command],
                state[:, column.command : column.previous],
                state[:, column.previous : column.gap],
                running.scenario.time_step_s,
                state[:, column.time],
                params[:, column.braking : column.driving],
                params[:, column.driving : column.latency],
                params[:, column.latency : column.mass],
                params[:, column.mass : column.limit],
                self._learner_index.view(),
            )
            step.further.update(outcome.built_in(self._moving, self.params))
            if self._own:
                counts = ~standing & (step.failed == 0)
                step.further.update(outcome.registered(self._own, counts, running.steps))
        if self.params.shaping > 0.0:  # potentials are 0 where an episode terminated
            old = running._potential
            running._potential = self.potentials(running.worlds, running.scenario)
            running._potential[step.terminated] = 0.0
            step.further["shaping"] = self.params.shaping_discount * running._potential - old
        extra = self.params.weighted_sum(step.further, step.reward.shape)
        extra[standing] = 0.0
        step.reward[:] += extra

    def potentials(self, worlds: Worlds, scenario: Scenario) -> Floats:
        """Potential of every learner, 0 for other vehicles, [n, N]."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        shared = self.params.potential(worlds, self._learners, scenario.horizon_s)
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

    def decide(self, running: Engine, memory: Any, proposed: Floats) -> Ruling:
        """What is applied instead of the actions [n, L]. A column of NaN: nothing was proposed for that learner."""

    def check(self, ruling: Ruling, after: Engine) -> Any:
        """The memory now that the step led to ``after``. Raises ``UncertifiedStep``: then it was not made."""

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """What infos say of each vehicle, by name, each [n, N]: of its last step, or of the alert before the first."""


class Moment(NamedTuple):
    """Running worlds between two steps, row by row."""

    state: Floats  # as rows of ``physics.batch``
    params: Floats
    clock: Floats
    wanted: Floats
    memories: dict[int, Memory]  # by vehicle, of the scripts that remember
    guarded: Any = None  # what the engine's guard remembers; None without one

    def take(self, rows: Ints) -> Moment:
        """Some of the rows, or one of them several times."""
        guarded = None if self.guarded is None else self.guarded.take(rows)
        state, params, clock, wanted, memories = take_memory(self[:5], rows)
        return Moment(state, params, clock, wanted, memories, guarded)

    @staticmethod
    def join(moments: list[Moment]) -> Moment:
        """The rows of all of them, one after the other; all are of one engine without a guard."""
        if moments[0].guarded is not None:
            raise InvalidInput("moments: a shield stands in their engine; what it remembers is not joined")
        return Moment(*map_memory(lambda *parts: np.concatenate(parts), *(moment[:5] for moment in moments)))


class Engine:
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
        observation: what vehicles observe, or by name what each does; None: as the scenario says.
        seed: of the scenario's training stream, from which worlds come unless they are given.
        deciders: indices of the vehicles that set the grid of decisions; None: the learners. An evaluated agent drives
            its vehicle as a script, on a learner's grid.
        worlds: of the first episodes, at t = 0; None: from the stream.
        guard: makes what stands between proposed and applied actions; None: what is proposed is applied.

    >>> import ethbrake_marl as eb
    >>> engine = eb.make_engine("paper-random", 4, seed=7)
    >>> engine.n, engine.learners, engine.worlds.time_s
    (4, (1,), array([0.5, 0.5, 0.5, 0.5]))

    """

    roster: Roster  # who runs in which row, and which worlds failed
    _state: Floats  # of the running episodes, as rows of ``physics.batch``
    _params: Floats
    _clock: Floats  # [n, CLOCK_WIDTH]
    _wanted: Floats  # [n, N] m/s2
    _potential: Floats  # [n, N]
    _obstacle: bool  # the rows have columns of an obstacle
    _by_link: bool  # ... of news by link
    _builds_up: bool  # brakes of some world may build up, or come in pieces
    _pieces: Floats  # [N, 2 K] of all worlds, as in ``Vehicles``
    _plans: tuple[Plan, ...]  # of what each vehicle observes
    _alike: bool  # all observe the same features

    def __init__(
        self,
        scenario: Scenario,
        n: int,
        *,
        learners: Sequence[int],
        scripts: Mapping[int, Script],
        reward: Reward = "harm",
        observation: Observation | None = None,
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
        self.observations = observations_of(scenario, observation)  # of each vehicle
        self._plans = tuple(each.plan for each in self.observations)
        self._alike = len(set(self.observations)) == 1
        self._watched: dict[Watcher, Any] = {}
        self.memories: dict[int, Memory] = {}  # by vehicle, of the scripts that remember; never changed in place
        self._remembering = {i: s for i, s in self.scripts.items() if not is_state_free(s)}
        self._on_own_grid = {i: s for i, s in self._remembering.items() if i not in self.deciders}
        self._stops: list[tuple[Floats, Floats]] = []  # of the last step: the states there, and what led to them
        self._learner_index = np.array(self.learners, np.int64)
        total = float(self.reward.harm_count == "total")
        times = scenario.time_step_s, scenario.horizon_s
        self._settings = np.array([*times, self._terms.shared_harm, total, self.reward.terminal])
        self.reward_terms = self.reward.counted  # names of those whose values each step tells
        self.check_time_step(self.scripts)
        self._stream = Stream(scenario, self.deciders, self.scripts, seed)
        self.protect(None if guard is None else guard(self))
        self.reset(worlds=worlds)

    def check_time_step(self, drivers: Mapping[int, Script]) -> None:
        """Raise ``InvalidInput`` for one that was made for decisions at another distance in time (``time_step_s``)."""
        for script in drivers.values():
            step, here = getattr(script, "time_step_s", None), self.scenario.time_step_s
            if step not in (None, here):
                raise InvalidInput(
                    f"agent {getattr(script, 'name', type(script).__name__)!r} was made for decisions every {step:g} s;"
                    f" scenario {self.scenario.name!r} has one every {here:g} s: make_agent(..., scenario=...) knows"
                )

    @property
    def observation(self) -> ObservationSpec:
        """What all learners observe; raises ``InvalidInput`` where they observe different features."""
        return common_observation(self.observations, self.scenario)

    @property
    def seed(self) -> int:
        """Seed of the training stream."""
        return self._stream.seed

    @property
    def packed(self) -> Packed:
        """The running worlds themselves, as rows of ``physics.batch``: for kernels to read, not to be changed."""
        return Packed(self._state, self._params)

    @property
    def wanted_mps2(self) -> Floats:
        """What each vehicle wanted in the last step, [n, N]: for kernels to read, not to be changed."""
        return self._wanted

    @property
    def worlds(self) -> Worlds:
        """The worlds as they are now, in their own memory."""
        return self._unpacked(self.packed)

    @property
    def in_pieces(self) -> bool:
        """Whether some script brakes in pieces."""
        return bool(self._pieces.shape[1] > 0)

    def _unpacked(self, packed: Packed) -> Worlds:
        worlds = packed.worlds()
        if not self.in_pieces:
            return worlds
        pieces = np.repeat(self._pieces[np.newaxis], worlds.n, axis=0)
        return replace(worlds, vehicles=replace(worlds.vehicles, pieces=pieces))

    @property
    def ledger(self) -> Ledger:
        """Harm of the running episodes so far, in its own memory."""
        packed, column = self.packed, self.packed.column
        of_worlds = packed.params[:, column.mass : column.limit], packed.params[:, column.restitution]
        return Ledger(*packed.ledger(), *(each.copy() for each in of_worlds))

    @property
    def ended(self) -> Bools:
        """Episodes that have ended, [n]."""
        return np.asarray(self._clock[:, ENDED] == 1.0, np.bool_)

    @property
    def steps(self) -> Ints:
        """Steps that the running episodes have taken, [n]."""
        return self._clock[:, STEP].astype(np.int64)

    def observe(self, vehicle: int) -> Observations:
        """Current observation of one vehicle, [n, F]."""
        if not isinstance(vehicle, int | np.integer) or not 0 <= vehicle < self.scenario.vehicles:
            raise InvalidInput(f"observe: vehicle index {vehicle!r}; must be in 0..{self.scenario.vehicles - 1}")
        return self.observe_all(np.array([vehicle]))[:, 0]

    def observe_all(self, vehicles: Ints | None = None, rows: Ints | None = None) -> Observations:
        """Current observations of several vehicles, of all learners if none are given, [n, len(vehicles), F].

        Only of the worlds ``rows`` if given. Raises ``InvalidInput`` where these vehicles observe different features.
        """
        vehicles = self._learner_index if vehicles is None else vehicles
        if not self._alike and len({self.observations[i] for i in vehicles.tolist()}) > 1:
            names = ", ".join(self.scenario.vehicle_names[i] for i in vehicles.tolist())
            raise InvalidInput(f"observe_all: {names} observe different features; use observe for each")
        state, params = self._state, self._params
        plan: Plan = self._plans[0 if self._alike else int(vehicles[0])]
        if rows is not None:
            state, params = state.take(rows, axis=0), params.take(rows, axis=0)
        if not plan.extras:
            return plan.observe(state, params, vehicles)
        steps = self._clock[:, STEP] if rows is None else self._clock[rows, STEP]
        return plan.observe(state, params, vehicles, steps)

    def _kept(self, packed: Packed) -> Packed:
        """Rows as wide as they are kept: with columns of an obstacle, and of news by link, if the first had such."""
        return packed.widened(self._obstacle, self._by_link)

    def memory(self, watcher: Watcher) -> Any:
        """What a watcher remembers of the running episodes."""
        return self._watched[watcher]

    def watch(self, watcher: Watcher, memory: Any) -> None:
        """Let a watcher follow, from ``memory`` on."""
        self._watched = {**self._watched, watcher: memory}

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
        new._obstacle = self.scenario.has_obstacle or start.packed.has_obstacle
        new._by_link = self.scenario.by_link or start.packed.has_news
        new._pieces = start.origin.vehicles.pieces[0].copy()
        new._builds_up = new._may_build_up(start.packed)
        new._state, new._params = (array.copy() for array in new._kept(start.packed))
        new._clock, new._wanted = start.clock.copy(), start.wanted.copy()
        new._potential = np.zeros(start.wanted.shape)
        new._stops, new.ruling, new.memories = [], None, {}
        new._begin(np.arange(self.n), start)
        self.__dict__.update(new.__dict__)  # in one piece: not even an interrupt comes between

    def _may_build_up(self, packed: Packed) -> bool:
        return self.scenario.builds_up or packed.builds_up or self.in_pieces

    def renew(self, rows: Ints) -> None:
        """Start new episodes of the training stream in these rows (autoreset). Whatever fails, nothing is changed."""
        if len(rows) == 0:
            return
        if not 0 <= np.min(rows) <= np.max(rows) < self.n or np.bincount(rows).max() > 1:
            raise InvalidInput(f"renew: rows {rows}; must be different numbers from 0 to {self.n - 1}")
        if not (self._watched or self._remembering or self.guard):
            self._renew(rows)
            return
        new = self._apart()
        new._stream = copy.copy(self._stream)
        new._renew(rows)
        self.__dict__.update(new.__dict__)

    def cut(self, step: Step, most_steps: int) -> None:
        """Truncate the episodes that have taken ``most_steps`` with the last ``step``, here and in what that tells."""
        cut = (self.steps >= most_steps) & (step.ended | ~self.ended)
        step.outcome[TRUNCATED, cut] = self._clock[cut, ENDED] = 1.0

    def _apart(self) -> Engine:
        """An engine that goes on from here without changing this one."""
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
        if not (self.guard or self._watched or self._terms.are_foreign or self._on_own_grid):  # nobody can refuse it
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
        new._watched = {w: w.stepped(memory, before, new) for w, memory in self._watched.items()}
        self.__dict__.update(new.__dict__)  # in one piece: not even an interrupt comes between
        return step

    def _advance(self, columns: Floats) -> Step:
        """Advance every running episode by one time step, in place."""
        asked: dict[int, Memory] = {}
        if len(self._remembering) > len(self._on_own_grid):
            worlds = self.worlds
            for vehicle in self._remembering.keys() - self._on_own_grid.keys():
                script = self._remembering[vehicle]
                command, asked[vehicle] = ask_script(script, worlds, self.memories[vehicle], vehicle)
                self._wanted[:, vehicle] = within_capacity(command, worlds, vehicle, script)
        before = self._terms.objective_harm(self) if self._terms.by_objective else None
        self._stops = []
        way = self._start_on_own_grid(columns) if self._on_own_grid else None
        was = self._state.copy() if self.packed.has_messages else None
        reward, outcome = np.empty(self._wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        status = self._step_worlds(columns, reward, outcome)
        if status == BAD_ACTION:  # nothing was moved
            status = self._step_worlds(self._in_range(columns), reward, outcome)
        self.memories = self.memories | asked
        if was is not None:
            until_s = self._state[:, self.packed.column.time]
            hear_rows(was, self._params, self._wanted, until_s, until_s, self.scenario.time_step_s, self._pieces)
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
        if type(actions) is np.ndarray and actions.shape == shape and actions.dtype.kind in "fiu":
            return np.ascontiguousarray(actions, np.float64)
        if not isinstance(actions, Mapping):
            return checked_action(actions, shape, "the learners")
        for vehicle in actions:
            if vehicle not in self.learners:
                raise InvalidInput(
                    f"step: an action for vehicle index {vehicle!r}; the learners have the indices {self.learners}"
                )
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
            self._builds_up, self._pieces, self._wanted, reward, outcome,
        )  # fmt: skip
        return status

    def _in_range(self, columns: Floats) -> Floats:
        """The actions [n, L] without the last rounding of a float32; ``InvalidInput`` for one out of range."""
        each = [checked_action(columns[:, c], (self.n,), f"vehicle_{i + 1}") for c, i in enumerate(self.learners)]
        return np.stack(each, axis=1) if each else columns

    def _begin(self, rows: Ints, start: Start) -> None:
        """Tell those who must know that episodes start in ``rows``, and move what depends on them."""
        if self.guard or self._watched or self._remembering:
            alert = start.alert
            with renumbered(rows):
                if self.guard is not None:
                    self.guarded = self.guard.begin(self.guarded, alert, rows)
                self._watched = {w: w.begun(memory, alert, rows) for w, memory in self._watched.items()}
                begun = {i: begin_script(s, alert, i, self._stream.known) for i, s in self._remembering.items()}
            self.memories = renew_memory(self.memories, rows, begun) if self.memories else begun
        if self._on_own_grid:
            self._begin_on_own_grid(rows, start.alert, start.clock[:, START])
        elif self.packed.has_messages:
            moving, params, start_s = (
                self._kept(Packed.of(start.alert)).state,
                self._params[rows],
                self._state[rows, self.packed.column.time],
            )
            hear_rows(moving, params, self._wanted[rows], start_s, start_s, self.scenario.time_step_s, self._pieces)
            self._params[rows] = params
        if self.reward.shaping > 0.0:
            worlds = self._unpacked(Packed(self._state[rows], self._params[rows]))
            self._potential[rows] = self._terms.potentials(worlds, self.scenario)

    def _start_on_own_grid(self, columns: Floats) -> Way:
        """Let the scripts on their own grids decide within the step that begins; what comes of the way there."""
        column = self.packed.column
        in_force = self._state[:, column.command : column.previous].copy()
        steps, last, start_s = (self._clock[:, at] for at in (STEP, LAST_STEP, START))
        until_s = Decisions(start_s, self.scenario.time_step_s).at(steps + 1.0)
        until_s = np.where(steps + 1.0 >= last, self.scenario.horizon_s, until_s)
        way = self._decide_on_the_way(~self.ended, until_s, self._in_range(columns))
        self._clock[way.failed != 0, ENDED] = 1.0
        return way._replace(in_force=in_force)

    def _add_way(self, way: Way, reward: Floats, outcome: Floats, status: int) -> int:
        """Add the way to the last stop to what came after it, in place; the status of both."""
        reward += way.reward
        outcome[: len(way.harm)] += way.harm
        column = self.packed.column
        self._state[way.stopped, column.previous : column.gap] = way.in_force[way.stopped]
        lost = way.failed != 0
        outcome[TRUNCATED, lost], outcome[FAILED, lost] = 1.0, way.failed[lost]
        return int(way.failed[lost][0]) if lost.any() else status

    def _decide_on_the_way(self, running: Bools, until_s: Floats, columns: Floats) -> Way:
        """Let the scripts on their own grids make all decisions before ``until_s`` [n] in the ``running`` worlds.

        A world is moved to a decision only where that changes a command: the bits depend on where motion changes.
        """
        (n, N), column = self._wanted.shape, self.packed.column
        vehicles, step_s = list(self._on_own_grid), self.scenario.time_step_s
        first_s = self._params[:, column.latency : column.mass][:, vehicles].T
        made = np.maximum(Decisions(first_s, step_s).before(self._state[:, column.time]), 0.0)
        due = np.where(running, np.maximum(Decisions(first_s, step_s).before(until_s), 0.0), made)
        way = Way(np.zeros((n, N)), np.zeros((2, n)), np.zeros(n, np.bool_), np.zeros(n, np.int64), np.empty(0))
        while (made < due).any():
            next_s = np.where(made < due, first_s + made * step_s, np.inf)
            moment = next_s.min(axis=0)
            asked = next_s <= moment + ROUNDING * step_s
            asked &= made < due
            now = self._state[:, column.time]
            moment = np.where((moment < np.inf) & (moment > now + ROUNDING * step_s), moment, now)
            ahead, reward, outcome = self._look_ahead(moment, until_s, columns)
            worlds, wanted = self._unpacked(ahead), self._wanted.copy()
            for (vehicle, script), here in zip(self._on_own_grid.items(), asked, strict=True):
                if here.any():
                    before, idle = self.memories[vehicle], np.flatnonzero(~here)
                    command, after = ask_script(script, worlds, before, vehicle)
                    command = np.where(here, command, 0.0)
                    wanted[here, vehicle] = within_capacity(command, worlds, vehicle, script, here)[here]
                    self.memories = self.memories | {vehicle: renew_memory(after, idle, take_memory(before, idle))}
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
        clock[:, ENDED] = ~(until_s > self._state[:, self.packed.column.time])
        settings[TERMINAL_WEIGHT] = 0.0
        reward, outcome = np.empty(self._wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        state, params = self._state.copy(), self._params.copy()
        step_worlds(
            state, params, clock, columns, self._learner_index[: columns.shape[1]], settings, NO_ROWS,
            self._builds_up, self._pieces, self._wanted, reward, outcome,
        )  # fmt: skip
        if self.packed.has_messages:
            time_s = state[:, self.packed.column.time]
            step_s = self.scenario.time_step_s
            hear_rows(self._state.copy(), params, self._wanted, time_s, decision_s, step_s, self._pieces)
        return Packed(state, params), reward, outcome

    def _stop(self, rows: Bools, ahead: Packed) -> None:
        """Move these rows to where the look ahead found them."""
        self._state[rows], self._params[rows] = ahead.state[rows], ahead.params[rows]
        self._stops.append((self._state.copy(), self._wanted.copy()))

    def _begin_on_own_grid(self, rows: Ints, alert: Worlds, start_s: Floats) -> None:
        """From the alert on scripts with a memory decide on their own grids; then the first decision is near.

        Deciders do not: like a learner they coast, and are seen to coast, until their first decision.
        """
        began = self._kept(Packed.of(alert)).state
        self._stops = [(state.copy(), wanted) for state, wanted in self._stops]  # of who goes on; the others did not
        for state in (self._state, *(state for state, _ in self._stops)):
            state[rows] = began
        time_s = self._state[:, self.packed.column.time]
        running, until_s, none = np.zeros(self.n, np.bool_), time_s.copy(), np.empty((self.n, 0))
        running[rows], until_s[rows] = True, start_s
        way = self._decide_on_the_way(running, until_s, none)
        ahead, _, outcome = self._look_ahead(until_s, until_s, none)
        failed = np.where(way.failed != 0, way.failed, outcome[FAILED].astype(np.int64))
        if failed.any():
            raise FLAG.failure(np.where(failed == 0, FLAG.DONE, failed), time_s, until_s)
        self._state[rows], self._params[rows] = ahead.state[rows], ahead.params[rows]

    def segments(self, before: Worlds, last_mps2: Floats) -> Iterator[tuple[Worlds, Floats, Floats]]:
        """The last step, made from ``before`` (after a reset: the alert), in parts within which nobody decides.

        Each is worlds, the commands [n, N] that they followed, ``last_mps2`` in the last part, and until when [n].
        """
        for state, wanted in self._stops:
            then = Packed(state, self._params).worlds(before.vehicles)
            yield before, wanted, then.time_s
            before = then
        yield before, last_mps2, self._state[:, self.packed.column.time].copy()

    def snapshot(self) -> Arrays:
        """Copies of everything that changes while it runs: its rows, its place in the stream, the scripts' memories.

        The stream is one number: worlds are pure functions of the seed and of where they stand in it.
        """
        arrays: Arrays = {name.lstrip("_"): getattr(self, name).copy() for name in RUNNING}
        arrays["stream"] = np.array([self.seed, self._stream.position], np.uint64)
        arrays["numbers"] = self.roster.numbers.copy()
        return arrays | {f"script.{name}": array for name, array in flat(self.memories).items()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on from the ``snapshot`` of an engine of the same scenario, size and scripts, as if nothing had happened.

        Raises ``InvalidInput``, before anything is changed, naming the array that is missing or has another shape, and
        where a shield stands in the engine, which would know nothing of these worlds.
        """
        if self.guard is not None:
            raise InvalidInput(
                "engine snapshot: a shield stands in this engine; restore first, then put the shield around"
            )
        wanted = {name.lstrip("_"): getattr(self, name).shape for name in RUNNING} | {"numbers": (self.n,)}
        for name, needed in wanted.items():
            have = arrays.get(name)
            if have is None or have.shape != needed:
                shape = "nothing" if have is None else have.shape
                raise InvalidInput(f"engine snapshot: {name} is {shape}; {needed} is needed")
        memories = {vehicle: checked_memory(unflat(arrays, f"script.{vehicle}"), self.n) for vehicle in self.memories}
        for name in RUNNING:
            setattr(self, name, np.array(arrays[name.lstrip("_")], np.float64))
        self._builds_up = self._may_build_up(self.packed)
        seed, taken = (int(number) for number in arrays["stream"])
        self._stream.restart(seed, taken)
        self.roster = Roster(self.n, seed, None)
        self.roster.numbers = np.array(arrays["numbers"], np.int64)
        self.memories = memories

    def place(self, worlds: Worlds, ledger: Ledger | None = None, *, ended: Bools | None = None) -> None:
        """Put the running worlds in all rows as somebody else has moved them, with their ``ledger`` so far.

        Vehicles, memories and the grid of decisions stay those of the last reset: the next step goes to the next
        decision after the worlds' time. ``ended`` [n]: those that no step moves; None: those at the horizon. Raises
        ``InvalidInput`` for another number of worlds or vehicles.
        """
        if worlds.speeds_mps.shape != self._wanted.shape:
            n, N = self._wanted.shape
            raise InvalidInput(f"place: {worlds.n} worlds of {worlds.N} vehicles; {n} of {N} needed")
        state = self._kept(packed_with(worlds, empty_ledger(worlds) if ledger is None else ledger)).state
        made = Decisions(self._clock[:, START], self.scenario.time_step_s).latest(worlds.time_s)
        self._state, self._clock, self.ruling = state, self._clock.copy(), None
        self._clock[:, STEP] = np.maximum(made, 0)
        self._clock[:, ENDED] = worlds.time_s >= self.scenario.horizon_s if ended is None else ended

    def moment(self) -> Moment:
        """The present moment of all rows, in its own memory."""
        rows = [array.copy() for array in (self._state, self._params, self._clock, self._wanted)]
        return Moment(rows[0], rows[1], rows[2], rows[3], self.memories, self.guarded)

    def first_moments(self, count: int) -> tuple[Worlds, Moment]:
        """The first ``count`` worlds of the training stream, at the alert, and at their first decision."""
        stream = copy.copy(self._stream)
        stream.restart(self.seed)
        alert, new = stream.take(count).alert, self._unwatched(count)
        new.protect(None)
        new.reset(worlds=alert)
        return alert, new.moment()

    def branch(self, moment: Moment) -> Engine:
        """An engine of the same scenario whose rows go on from ``moment``, under the same guard; this one stays.

        Raises ``InvalidInput`` for an engine with a reward that is shaped, which tells of more than what happens.
        """
        if self.reward.shaping > 0.0:
            raise InvalidInput(f"branches: reward: shaping = {self.reward.shaping:g}: must be 0; a branch has an end")
        new = self._unwatched(len(moment.state))
        new.memories, new.guarded, new.ruling = moment.memories, moment.guarded, None
        new.roster = Roster(new.n, self.seed, None)
        new.roster.warns = False
        new._state, new._params, new._clock, new._wanted = (array.copy() for array in moment[:4])
        new._builds_up = new._may_build_up(new.packed)
        new._potential = np.zeros(moment.wanted.shape)
        return new

    def _unwatched(self, n: int) -> Engine:
        """An engine of the same scenario for ``n`` worlds, which nobody watches; its rows are still to be set."""
        new = copy.copy(self)
        new.n, new._watched = n, {}
        return new
