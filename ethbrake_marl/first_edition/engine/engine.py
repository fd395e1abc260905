"""``Engine``: a batch of running episodes of one scenario, on which all environments are built.

Letters in shapes: n worlds, N vehicles, L learners, P pairs, F features. ``rows`` are indices of worlds, and
``columns`` [n, L] are the actions of the learners.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, UncertifiedStep, renumbered
from ethbrake_marl.first_edition.engine.compiled_step import (
    BAD_ACTION,
    ENDED,
    OUTCOME_ROWS,
    START,
    STEP,
    TRUNCATED,
    Rules,
    Step,
)
from ethbrake_marl.first_edition.engine.memory import (
    Arrays,
    Memory,
    ask_script,
    begin_script,
    checked_memory,
    flat,
    is_state_free,
    renew_memory,
    unflat,
    within_capacity,
)
from ethbrake_marl.first_edition.engine.own_grid import OwnGrid, Stop, Way
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.engine.stream import Roster, Start, Stream, check_alert
from ethbrake_marl.first_edition.engine.terms import Terms
from ethbrake_marl.first_edition.game.actions import checked_action
from ethbrake_marl.first_edition.game.definition import Game
from ethbrake_marl.first_edition.game.harm import Ledger
from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts
from ethbrake_marl.first_edition.game.observations import Observation, Observations, ObservationSpec, Plan
from ethbrake_marl.first_edition.game.observed import common_observation, observations_of
from ethbrake_marl.first_edition.game.reward_vector import RewardVector
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.messages import hear_rows
from ethbrake_marl.first_edition.physics.rows import FLAG
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

SNAPSHOT = ("state", "params", "clock", "wanted", "potential")  # names of the arrays of a state in a snapshot

Actions = Mapping[int, NDArray[np.floating]] | NDArray[np.floating]


class Watcher(Protocol):
    """Observer that follows an engine's episodes without changing the episodes, for example to record a picture.

    The engine stores the watcher's memory together with the state of its episodes, and replaces both in a single
    assignment. If a step fails or is interrupted, memory and state stay as they were before the step. For this reason a
    watcher must never change its memory in place.
    """

    def begun(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """Return the watcher's new memory after episodes have started in the worlds ``rows``.

        ``alert`` contains only the worlds in which episodes have started, at t = 0.
        """

    def stepped(self, memory: Any, before: Engine, after: Engine) -> Any:
        """Return the watcher's memory after a step that led from the engine ``before`` to the engine ``after``."""


class Ruling(NamedTuple):
    """Answer of a guard (shield) in one step."""

    proposed: Floats  # [n, L] actions that the learners proposed; NaN: none, or not a number
    applied: Floats  # [n, L] actions to apply, in [-1, 1]
    stepped_in: Bools  # [n] whether the guard replaced an action, or chose E-V2X-BM (in the mode ``episode``)
    asked: Bools  # [n] whether the guard decided in this world; False for ended episodes
    decision: Any  # further details, in the guard's own format
    memory: Any  # the guard's memory after the step


class Guard(Protocol):
    """A shield that, inside an engine, may replace the actions that the learners propose.

    The engine calls the guard in every ``Engine.step``, so no action can bypass the guard. The engine stores the
    guard's memory and answer together with the state of its episodes, and replaces all three in a single assignment. If
    a step fails or is interrupted, all three stay as they were before the step. For this reason a guard must never
    change its memory in place.
    """

    def begin(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """Return the guard's new memory after episodes have started in the worlds ``rows``.

        ``alert`` contains only the worlds in which episodes have started, at t = 0. ``memory`` is None before the first
        episode.
        """

    def decide(self, running: Engine, memory: Any, proposed: Floats) -> Ruling:
        """Return the guard's answer, which contains the actions to apply in the next step.

        ``running`` is the engine before the step. ``proposed`` [n, L] are the learners' actions; a column of NaN means
        that this learner proposed no action.
        """

    def check(self, ruling: Ruling, after: Engine) -> Any:
        """Return the guard's memory after the step. To undo the step, raise ``UncertifiedStep`` instead.

        ``ruling`` is the answer that ``decide`` returned before the step. ``after`` is the engine after the step.
        """

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """Return the infos of the guard about the last step: dictionary from name to values, [n, N].

        Before the first step of an episode, the report describes what the guard decided at the alert.
        """


class Now(NamedTuple):
    """Everything that a reset or a step of an engine changes; the engine replaces all of it in a single assignment."""

    state: State  # the running episodes
    roster: Roster  # the world that runs in each row, and the worlds that could not be advanced
    stream: Stream  # the source of the next episodes
    obstacle: bool  # whether the rows have columns for an obstacle ahead
    by_link: bool  # whether the rows have columns for messages over links between vehicles
    rules: Rules  # settings of every step
    watched: dict[Watcher, Any]  # watcher -> its memory
    ruling: Ruling | None = None  # the guard's answer in the last step; None without a guard
    stops: tuple[Stop, ...] = ()  # decisions of scripts within the last step, see ``own_grid``

    def apart(self) -> Now:
        """Return a copy; a change of the copy's arrays does not change the arrays of this object."""
        return self._replace(state=self.state.copy(), roster=self.roster.apart(), stream=copy.copy(self.stream))

    def kept(self, packed: Packed) -> Packed:
        """Return ``packed`` with the columns of an obstacle and *news by link* if this engine's worlds have them."""
        return packed.widened(self.obstacle, self.by_link)


class Engine:
    """A batch of ``n`` running episodes of one scenario.

    A step leads from one decision of the ``deciders`` to their next decision. The first step begins when the shortest
    latency among the deciders has elapsed. A ``guard`` (a shield) may replace the actions that the learners propose. If
    the physics cannot advance a world, the world's episode is truncated and ``roster`` lists the world; the other
    worlds continue.

    Args:
        scenario: the scenario of all episodes, or another ``Game``.
        n: number of worlds that are advanced together, at least 1.
        learners: indices of the learners (0 = front): the vehicles whose actions the caller passes to ``step``.
        scripts: dictionary from the index of every vehicle that does not learn to the vehicle's script.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: one observation for all vehicles, or a dictionary vehicle name -> observation; None: the
            observation of the scenario.
        seed: seed of the training stream, from which the worlds come if ``worlds`` is None.
        deciders: indices of the vehicles at whose decisions each step begins and ends; None: the learners. In an
            evaluation the engine has no learners; there ``deciders`` are the vehicles that the evaluated agent drives.
        worlds: worlds of the first episodes, at t = 0; None: the first worlds of the training stream.
        guard: function that receives this engine and returns its guard; None: the learners' actions are applied
            unchanged.
        reward_vector: components of a vector reward, which each step returns in addition to the reward
            (``game.reward_vector``); None: no vector reward.

    >>> import ethbrake_marl.first_edition as eb
    >>> engine = eb.make_engine("paper-random", 4, seed=7)
    >>> engine.n, engine.learners, engine.worlds.time_s
    (4, (1,), array([0.5, 0.5, 0.5, 0.5]))

    """

    def __init__(
        self,
        scenario: Game,
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
        reward_vector: RewardVector | None = None,
    ) -> None:
        if not n >= 1:
            raise InvalidInput(f"engine: n = {n}: the number of worlds must be at least 1")
        self.scenario, self.n = scenario, n
        self.learners = tuple(learners)
        self.scripts = dict(scripts)
        unassigned = set(range(scenario.vehicles)) - set(self.learners) - set(self.scripts)
        if unassigned or set(self.learners) & set(self.scripts):
            raise InvalidInput(
                f"engine: learners {self.learners} and scripts {tuple(self.scripts)} must together contain each of the"
                f" {scenario.vehicles} vehicles exactly once"
            )
        self.deciders = self.learners if deciders is None else tuple(deciders)
        if not set(self.deciders) <= set(range(scenario.vehicles)):
            raise InvalidInput(
                f"engine: deciders = {self.deciders}: must be indices of vehicles, from 0 to {scenario.vehicles - 1}"
            )
        self._terms = Terms(reward, scenario, self.learners or self.deciders, reward_vector)
        self.reward, self.components = self._terms.params, self._terms.components  # components of the vector reward
        self.observations = observations_of(scenario, observation)  # of each vehicle
        self._plans = tuple(each.plan for each in self.observations)
        self._alike = len(set(self.observations)) == 1
        self._remembering = {i: s for i, s in self.scripts.items() if not is_state_free(s)}
        times = scenario.time_step_s, scenario.horizon_s
        self._own_grid = OwnGrid({i: s for i, s in self._remembering.items() if i not in self.deciders}, *times)
        self._learner_index = np.array(self.learners, np.int64)
        total = float(self.reward.harm_count == "total")
        self._settings = np.array([*times, self._terms.shared_harm, total, self.reward.terminal])
        self.reward_terms = self.reward.counted  # names of the terms that each step reports
        self.check_time_step(self.scripts)
        self.guard: Guard | None = None if guard is None else guard(self)
        stream = Stream(scenario, self.deciders, self.scripts, seed)
        self._now = self._started(stream, None, worlds, {})

    def check_time_step(self, drivers: Mapping[int, Script]) -> None:
        """Raise ``InvalidInput`` if an agent was made for another time between decisions than the scenario's time step.

        ``drivers`` maps vehicle indices to agents or scripts. An agent without the attribute ``time_step_s`` can be
        used in every scenario.
        """
        for script in drivers.values():
            step, here = getattr(script, "time_step_s", None), self.scenario.time_step_s
            if step not in (None, here):
                raise InvalidInput(
                    f"agent {getattr(script, 'name', type(script).__name__)!r} was made for decisions every {step:g} s;"
                    f" scenario {self.scenario.name!r} has a decision every {here:g} s; make the agent for this"
                    " scenario with make_agent(..., scenario=...)"
                )

    def reset(self, *, seed: int | None = None, worlds: Worlds | None = None) -> None:
        """Start a new episode in each of the n worlds. If this call fails, the running episodes continue.

        Args:
            seed: seed of a new training stream, from whose beginning the next worlds come; None: the present stream
                continues.
            worlds: worlds of the new episodes, n worlds at t = 0; None: the next worlds of the training stream.

        """
        stream = copy.copy(self._now.stream)
        if seed is not None:
            stream.restart(seed)
        self._now = self._started(stream, self._now.state.guarded, worlds, self._now.watched)

    def _started(self, stream: Stream, guarded: Any, worlds: Worlds | None, watched: dict[Watcher, Any]) -> Now:
        """Return new episodes that start in ``worlds`` or, if ``worlds`` is None, in the next worlds of ``stream``.

        ``guarded`` and ``watched`` contain the previous memories of the guard and of the watchers.
        """
        if worlds is not None:
            check_alert(worlds, self.n, self.scenario.vehicles)
        first = None if worlds is not None else stream.position
        start = stream.take(self.n) if worlds is None else stream.prepare(worlds)
        roster, pieces = Roster(self.n, stream.seed, first, worlds), start.origin.vehicles.pieces[0].copy()
        packed, scenario = start.packed, self.scenario
        obstacle, by_link = scenario.has_obstacle or packed.has_obstacle, scenario.by_link or packed.has_news
        builds_up = scenario.builds_up or packed.builds_up or pieces.shape[1] > 0
        motion, params = (array.copy() for array in packed.widened(obstacle, by_link))
        clock, wanted = start.clock.copy(), start.wanted.copy()
        state = State(motion, params, clock, wanted, np.zeros(wanted.shape), {}, guarded)
        rules = Rules(self._learner_index, self._settings, builds_up, pieces)
        new = self._at(Now(state, roster, stream, obstacle, by_link, rules, watched))
        new._begin(np.arange(self.n), start)
        return new._now

    def _begin(self, rows: Ints, start: Start) -> None:
        """Start new episodes in the worlds ``rows``, in place.

        ``start`` contains the worlds of the new episodes, at the alert and at the first decision. Scripts, guard and
        watchers get their memory for the new episodes. Messages that arrive before the first step are delivered, and
        scripts that decide before the first step choose their commands.
        """
        if not self._nobody_refuses_episodes:
            alert, memories = start.alert, self.memories
            with renumbered(rows):
                if self.guard is not None:
                    self.remember(self.guard.begin(self.guarded, alert, rows))
                watched = {w: w.begun(memory, alert, rows) for w, memory in self._now.watched.items()}
                self._now = self._now._replace(watched=watched)
                first_memories = {
                    i: begin_script(s, alert, i, self._now.stream.known) for i, s in self._remembering.items()
                }
            self._change(memories=renew_memory(memories, rows, first_memories) if memories else first_memories)
        (motion, params, _, wanted, potential, *_), rules = self.state, self._now.rules
        if self._own_grid.scripts:
            at_alert = self._now.kept(Packed.of(start.alert)).state
            stops = tuple((there.copy(), last) for there, last in self._now.stops)  # of the episodes that go on
            for there in (motion, *(there for there, _ in stops)):
                there[rows] = at_alert
            way = self._own_grid.drive_to_start(self.state, rules, rows, start.clock[:, START])
            self._change(memories=way.memories)
            self._now = self._now._replace(stops=(*stops, *way.stops))
        elif self.packed.has_messages:
            at_alert, heard = self._now.kept(Packed.of(start.alert)).state, params[rows]
            start_s = self.state.time_s[rows]
            hear_rows(at_alert, heard, wanted[rows], start_s, start_s, self.scenario.time_step_s, rules.pieces)
            params[rows] = heard
        if self._terms.count_impacts:
            alert, now, before = start.alert, self.worlds, self.state.impacts
            impacts = EpisodeImpacts.of(alert) if before is None else before.renewed(rows, alert)
            since_alert = self.segments(now.assign(rows, alert), now.command_mps2)
            self._change(impacts=impacts.and_then(since_alert, np.isin(np.arange(self.n), rows)))
        if self.reward.shaping > 0.0:
            potential[rows] = self._terms.potentials(rules.unpack(Packed(motion[rows], params[rows])), self.scenario)

    def step(self, actions: Actions) -> Step:
        """Advance every running episode by one time step and return the results.

        ``actions`` contains a number in [-1, 1] for each learner: an array [n, L] with columns in the order of
        ``learners``, or a mapping from vehicle index to [n]. If the engine has a guard, the mapping may leave out
        learners that propose no action. The world of an ended episode does not move until ``renew`` or ``reset`` starts
        a new episode. If the guard raises ``UncertifiedStep``, the engine stays as it was before the step.
        """
        columns = self._columns(actions)
        if self._nobody_refuses_steps:
            return self._advance(columns)
        before, new = self._at(self._now), self._at(self._now.apart())
        ruling = None
        if self.guard is not None:
            ruling = self._ruled(before, columns, checked=isinstance(actions, Mapping))
            columns = np.ascontiguousarray(ruling.applied)
        step = new._advance(columns)
        if self.guard is not None and ruling is not None:
            new.remember(self.guard.check(ruling, new))
            new._now = new._now._replace(ruling=ruling)
        watched = {watcher: watcher.stepped(memory, before, new) for watcher, memory in new._now.watched.items()}
        self._now = new._now._replace(watched=watched)
        return step

    @property
    def _nobody_refuses_steps(self) -> bool:
        """True if a step calls nothing that may raise an error; arrays then change in place, which is faster."""
        return not (self.guard or self._now.watched or self._terms.are_foreign or self._own_grid.scripts)

    def _columns(self, actions: Actions) -> Floats:
        """Return the learners' actions as an array [n, L]; ``actions`` is an array or a mapping, as in ``step``.

        If ``actions`` is an array [n, L] of floats or integers, its numbers are not checked.
        """
        shape = (self.n, len(self.learners))
        if type(actions) is np.ndarray and actions.shape == shape and actions.dtype.kind in "fiu":
            return np.ascontiguousarray(actions, np.float64)
        if not isinstance(actions, Mapping):
            return checked_action(actions, shape, "the learners")
        for vehicle in actions:
            if vehicle not in self.learners:
                raise InvalidInput(
                    f"step: vehicle index {vehicle!r} has an action but does not learn; the learners have the indices"
                    f" {self.learners}"
                )
        columns = np.empty(shape)
        for c, vehicle in enumerate(self.learners):
            if vehicle not in actions and self.guard is not None:
                columns[:, c] = np.nan
                continue
            if vehicle not in actions:
                raise InvalidInput(f"step: the action of the learner vehicle_{vehicle + 1} is missing")
            columns[:, c] = checked_action(actions[vehicle], (self.n,), f"vehicle_{vehicle + 1}")
        return columns

    def _in_range(self, columns: Floats) -> Floats:
        """Return ``columns`` with actions just outside [-1, 1] clipped to this range.

        Raises ``InvalidInput`` for an action that is outside [-1, 1] by more than a float32 rounding error.
        """
        each = [checked_action(columns[:, c], (self.n,), f"vehicle_{i + 1}") for c, i in enumerate(self.learners)]
        return np.stack(each, axis=1) if each else columns

    def _ruled(self, before: Engine, columns: Floats, *, checked: bool) -> Ruling:
        """Return the guard's answer to the actions ``columns``, which are not checked again if ``checked`` is True."""
        assert self.guard is not None
        if before.guarded is None:
            raise UncertifiedStep("shield: this episode began before the shield was added; call reset first")
        return self.guard.decide(before, before.guarded, columns if checked else self._in_range(columns))

    def _advance(self, columns: Floats) -> Step:
        """Advance every running episode by one time step, in place."""
        harm_before = self.state.ledger if self._terms.by_objective or self._terms.components else None
        start = None if self.state.impacts is None else self.worlds
        asked = self._ask_scripts()
        step, some_failed = self._move(columns)
        if asked:
            self._change(memories=self.memories | asked)
        if some_failed:
            times = self.state.motion[:, 0]
            self.roster.mark(step.failed, times, np.minimum(times + self.scenario.time_step_s, self.scenario.horizon_s))
        if self._terms.add_something:
            self._add_terms(step, harm_before if self._terms.by_objective else None, start)
        if self._terms.components and harm_before is not None:
            step = step._replace(vector=self._terms.vector(step, harm_before, self.state))
        return step

    def _ask_scripts(self) -> dict[int, Memory]:
        """Let the scripts that have a memory and decide once per step write their commands into ``state.wanted``.

        Returns the new memories of these scripts.
        """
        asked: dict[int, Memory] = {}
        own_grid = self._own_grid.scripts
        if len(self._remembering) > len(own_grid):
            worlds, wanted = self.worlds, self.state.wanted
            for vehicle in self._remembering.keys() - own_grid.keys():
                script = self._remembering[vehicle]
                command, asked[vehicle] = ask_script(script, worlds, self.memories[vehicle], vehicle)
                wanted[:, vehicle] = within_capacity(command, worlds, vehicle, script)
        return asked

    def _move(self, columns: Floats) -> tuple[Step, bool]:
        """Move the worlds by one step, and deliver messages.

        Returns the results of the step, and whether at least one world could not be advanced.
        """
        if self._now.stops:
            self._now = self._now._replace(stops=())
        way = self._drive_own_grid(columns) if self._own_grid.scripts else None
        state, rules = self._now.state, self._now.rules
        was = state.motion.copy() if state.packed.has_messages else None
        reward, outcome = np.empty(state.wanted.shape), np.empty((OUTCOME_ROWS, self.n))
        status = rules.step(state.packed, state.clock, columns, state.wanted, reward, outcome)
        if status == BAD_ACTION:  # nothing was moved
            actions = self._in_range(columns)
            status = rules.step(state.packed, state.clock, actions, state.wanted, reward, outcome)
        if was is not None:
            times = state.time_s, state.time_s, self.scenario.time_step_s
            hear_rows(was, state.params, state.wanted, *times, rules.pieces)
        if way is not None:
            way.add_to(state.motion, state.packed.column, reward, outcome)
        some_failed = status != FLAG.DONE or (way is not None and bool(way.failed.any()))
        return Step(reward, outcome, self.reward, {}), some_failed

    def _drive_own_grid(self, columns: Floats) -> Way:
        """Advance the worlds to the last decision that a script makes within the step; return the results so far."""
        way = self._own_grid.drive_step(self.state, self._now.rules, self._in_range(columns))
        self._change(memories=way.memories)
        self._now = self._now._replace(stops=way.stops)
        return way

    def _add_terms(self, step: Step, harm_before: Ledger | None, start: Worlds | None) -> None:
        """Add to the results of a step, in place, the reward terms that the compiled step cannot compute.

        ``harm_before`` is the harm of each pair from the alert to the beginning of the step; None if every vehicle's
        reward counts the harm of the whole line. ``start`` are the worlds before the step; None if no reward term is
        computed from single impacts.
        """
        impacts = self.state.impacts
        if impacts is not None and start is not None:
            moved = start.time_s < self.state.time_s
            self._change(impacts=impacts.and_then(self.segments(start, self.wanted_mps2), moved))
        worlds = self.worlds if self.reward.shaping > 0.0 else None
        state = self._terms.add(step, self.state, self.scenario, harm_before, impacts, worlds)
        self._now = self._now._replace(state=state)

    def _change(self, **fields: Any) -> None:
        """Replace fields of ``self.state``."""
        self._now = self._now._replace(state=self._now.state._replace(**fields))

    def observe(self, vehicle: int) -> Observations:
        """Return the current observation of vehicle number ``vehicle`` (0 = front) in each world, [n, F]."""
        if not isinstance(vehicle, int | np.integer) or not 0 <= vehicle < self.scenario.vehicles:
            raise InvalidInput(
                f"observe: vehicle = {vehicle!r}: must be a vehicle index in 0..{self.scenario.vehicles - 1}"
            )
        return self.observe_all(np.array([vehicle]))[:, 0]

    def observe_all(self, vehicles: Ints | None = None, rows: Ints | None = None) -> Observations:
        """Return the current observations of several vehicles, [n, len(vehicles), F].

        Args:
            vehicles: indices of the vehicles (0 = front); None: all learners.
            rows: indices of the worlds to observe; None: all n worlds.

        Raises ``InvalidInput`` if the vehicles observe different features.

        """
        vehicles = self._learner_index if vehicles is None else vehicles
        if not self._alike and len({self.observations[i] for i in vehicles.tolist()}) > 1:
            names = ", ".join(self.scenario.vehicle_names[i] for i in vehicles.tolist())
            raise InvalidInput(f"observe_all: {names} observe different features; call observe for each vehicle")
        state = self._now.state
        motion, params, clock = state.motion, state.params, state.clock
        plan: Plan = self._plans[0 if self._alike else int(vehicles[0])]
        if rows is not None:
            motion, params = motion.take(rows, axis=0), params.take(rows, axis=0)
        if not plan.extras:
            return plan.observe(motion, params, vehicles)
        return plan.observe(motion, params, vehicles, clock[:, STEP] if rows is None else clock[rows, STEP])

    def renew(self, rows: Ints) -> None:
        """Start new episodes, in the next worlds of the training stream, in the rows with the indices ``rows``.

        The episodes of all other rows continue. If this call fails, the engine stays as it was. Raises ``InvalidInput``
        if an index occurs twice or is not in 0..n - 1.
        """
        if len(rows) == 0:
            return
        if not 0 <= np.min(rows) <= np.max(rows) < self.n or np.bincount(rows).max() > 1:
            raise InvalidInput(f"renew: rows = {rows}: must be different row numbers from 0 to {self.n - 1}")
        new = self if self._nobody_refuses_episodes else self._at(self._now.apart())
        (state, roster, stream, *_), now = new._now, new._now
        position = stream.position
        start = stream.take(len(rows))
        roster.renew(rows, position)
        state.motion[rows], state.params[rows] = now.kept(start.packed)
        state.clock[rows], state.wanted[rows] = start.clock, start.wanted
        new._begin(rows, start)
        self._now = new._now

    @property
    def _nobody_refuses_episodes(self) -> bool:
        """True if the start of an episode calls nothing that may raise an error; arrays then change in place."""
        return not (self._now.watched or self._remembering or self.guard or self._terms.count_impacts)

    def cut(self, step: Step, most_steps: int) -> None:
        """Truncate the episodes that have taken ``most_steps`` steps or more.

        ``step`` is the result of the last step; ``cut`` marks the truncated episodes in ``step``, in place.
        """
        cut = (self.steps >= most_steps) & (step.ended | ~self.ended)
        step.outcome[TRUNCATED, cut] = self._now.state.clock[cut, ENDED] = 1.0

    def segments(self, before: Worlds, last_mps2: Floats) -> Iterator[tuple[Worlds, Floats, Floats]]:
        """Yield the last step in segments (time intervals), separated by the decisions of scripts within the step.

        After a reset and before the first step, the segments lead from the alert to the first decision. Each segment is
        a tuple: the worlds at the start of the segment, the vehicles' commands in the segment ([n, N] m/s2), and the
        time at the end of the segment ([n] s).

        Args:
            before: the worlds at the start of the last step (after a reset: at the alert).
            last_mps2: the vehicles' commands in the last segment, [n, N] m/s2.

        """
        for motion, wanted in self._now.stops:
            then = Packed(motion, self.state.params).worlds(before.vehicles)
            yield before, wanted, then.time_s
            before = then
        yield before, last_mps2, self.state.time_s.copy()

    def protect(self, guard: Guard | None) -> None:
        """Use ``guard`` as the guard of this engine from the next reset on; None removes the present guard."""
        self.guard = guard
        self._now = self._now._replace(state=self._now.state._replace(guarded=None), ruling=None)

    def remember(self, guarded: Any) -> None:
        """Set the guard's memory to ``guarded``, which ``Guard.begin`` or ``Guard.check`` has returned.

        A caller that moves the worlds by ``place`` instead of ``step`` must set the guard's memory by this method.
        """
        self._now = self._now._replace(state=self._now.state._replace(guarded=guarded))

    def memory(self, watcher: Watcher) -> Any:
        """Return the present memory of a watcher that ``watch`` has added."""
        return self._now.watched[watcher]

    def watch(self, watcher: Watcher, memory: Any) -> None:
        """Add a watcher of the episodes, with ``memory`` as the watcher's first memory."""
        self._now = self._now._replace(watched={**self._now.watched, watcher: memory})

    def snapshot(self) -> Arrays:
        """Return copies of all arrays that change while the engine runs, as a dictionary for ``restore``.

        The snapshot contains the state of the episodes, the position in the stream of worlds, and the scripts'
        memories.
        """
        arrays: Arrays = {name: array.copy() for name, array in zip(SNAPSHOT, self.state, strict=False)}
        arrays["stream"] = np.array([self.seed, self._now.stream.position], np.uint64)
        arrays["numbers"] = self.roster.numbers.copy()
        if self.state.impacts is not None:
            arrays |= self.state.impacts.arrays()
        return arrays | {f"script.{name}": array for name, array in flat(self.memories).items()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue exactly from ``arrays``, a ``snapshot`` of an engine with the same scenario, n and scripts.

        Raises ``InvalidInput``, before anything changes, if an array is missing or has a wrong shape, and if the engine
        has a guard, because a snapshot does not contain a guard's memory.
        """
        if self.guard is not None:
            raise InvalidInput(
                "engine snapshot: this engine has a shield, whose memory a snapshot does not contain; restore the"
                " snapshot first, then add the shield"
            )
        wanted = {name: array.shape for name, array in zip(SNAPSHOT, self.state, strict=False)} | {"numbers": (self.n,)}
        for name, needed in wanted.items():
            have = arrays.get(name)
            if have is None or have.shape != needed:
                what = "is missing" if have is None else f"has the shape {have.shape}"
                raise InvalidInput(f"engine snapshot: the array {name} {what}; must have the shape {needed}")
        impacts = self.state.impacts and self.state.impacts.read(arrays)
        memories = {vehicle: checked_memory(unflat(arrays, f"script.{vehicle}"), self.n) for vehicle in self.memories}
        motion, params, clock, moving, potential = (np.array(arrays[name], np.float64) for name in SNAPSHOT)
        state = State(motion, params, clock, moving, potential, memories, self.guarded, impacts)
        seed, taken = (int(number) for number in arrays["stream"])
        stream, roster = copy.copy(self._now.stream), Roster(self.n, seed, None)
        stream.restart(seed, taken)
        roster.numbers = np.array(arrays["numbers"], np.int64)
        self._now = self._now._replace(state=state, stream=stream, roster=roster, rules=self._rules_for(state))

    def _rules_for(self, state: State) -> Rules:
        """Return the settings of the compiled step for the worlds of ``state``.

        The settings depend on ``state``: brakes may build up in one of its worlds, even if they act at once in all
        worlds of this engine.
        """
        builds_up = self.scenario.builds_up or state.packed.builds_up or self.in_pieces
        return self._now.rules._replace(builds_up=builds_up)

    def moment(self) -> State:
        """Return a copy of the present state, from which ``branch`` can continue."""
        return self.state.copy()

    def first_moments(self, count: int) -> tuple[Worlds, State]:
        """Return the first ``count`` worlds of the training stream, and these worlds at their first decision."""
        stream = copy.copy(self._now.stream)
        stream.restart(self.seed)
        alert, new = stream.take(count).alert, self._unwatched(count, self._now)
        new.protect(None)
        new.reset(worlds=alert)
        return alert, new.moment()

    def branch(self, state: State) -> Engine:
        """Return a new engine whose episodes continue from ``state``, under the same guard.

        This engine does not change. Raises ``InvalidInput`` if the reward is shaped, because the potentials of shaping
        depend on more than ``state``.
        """
        if self.reward.shaping > 0.0:
            raise InvalidInput(f"branch: the reward has shaping = {self.reward.shaping:g}; branch needs shaping = 0")
        n = len(state.motion)
        roster = Roster(n, self.seed, None)
        roster.warns = False
        rules = self._rules_for(state)
        return self._unwatched(n, self._now._replace(state=state.copy(), roster=roster, ruling=None, rules=rules))

    def _unwatched(self, n: int, now: Now) -> Engine:
        """Return a copy of this engine that runs the ``n`` episodes in ``now`` and has no watchers."""
        new = self._at(now._replace(watched={}))
        new.n = n
        return new

    def _at(self, now: Now) -> Engine:
        """Return a copy of this engine that runs the episodes in ``now``."""
        new = copy.copy(self)
        new._now = now
        return new

    @property
    def state(self) -> State:
        """State of the running episodes; not a copy, so do not change it."""
        return self._now.state

    @property
    def worlds(self) -> Worlds:
        """The worlds of the running episodes, as a copy."""
        return self._now.rules.unpack(self.packed)

    @property
    def packed(self) -> Packed:
        """The running worlds in two arrays (layout: ``physics.columns``); not a copy, so only read them."""
        return self._now.state.packed

    @property
    def wanted_mps2(self) -> Floats:
        """Acceleration that each vehicle commanded in the last step, [n, N] m/s2; not a copy, so only read it."""
        return self._now.state.wanted

    @property
    def ledger(self) -> Ledger:
        """Harm and number of impacts of each pair since the running episodes began (a copy)."""
        return self._now.state.ledger

    @property
    def ended(self) -> Bools:
        """Whether each episode has ended, [n]."""
        return self._now.state.ended

    @property
    def steps(self) -> Ints:
        """Number of steps that each running episode has taken, [n]."""
        return self._now.state.steps

    @property
    def roster(self) -> Roster:
        """Record of which world runs in each row, and which worlds could not be advanced."""
        return self._now.roster

    @property
    def seed(self) -> int:
        """Seed of the training stream, the endless sequence of worlds from which new episodes come."""
        return self._now.stream.seed

    @property
    def observation(self) -> ObservationSpec:
        """Observation that all learners have in common.

        Raises ``InvalidInput`` if learners observe different features.
        """
        return common_observation(self.observations, self.scenario)

    @property
    def memories(self) -> dict[int, Memory]:
        """Memories of all scripts that have a memory: vehicle index -> memory."""
        return self._now.state.memories

    @property
    def guarded(self) -> Any:
        """Memory of the guard; None if there is no guard, or before the guard's first episode."""
        return self._now.state.guarded

    @property
    def ruling(self) -> Ruling | None:
        """The guard's answer in the last step; None if there is no guard, or before the first step."""
        return self._now.ruling

    @property
    def in_pieces(self) -> bool:
        """Whether some script follows a braking profile."""
        return bool(self._now.rules.pieces.shape[1] > 0)
