"""Let agents drive vehicles that a *host* moves: another simulator or a test bench.

The host only moves the vehicles. This package asks the agents for decisions, applies latencies, keeps standing vehicles
at rest, resolves impacts and records the harm. Every time step has three parts:

1. *Decide.* Agents whose decision is due choose actions in the state that the host reported. A shield may replace
   these actions.
2. *Move.* The host receives a command and moves the vehicles for one step.
3. *Meet.* A host that resolves impacts itself reports them. Otherwise this package resolves them: vehicles that overlap
   and still approach each other get the speeds after an impact.

Latencies are rounded up to whole steps of the host, because commands can change only between two steps. If an agent
knows a latency, it knows the rounded latency.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.agents.driving import Episodes, episode_engine
from ethbrake_marl.agents.protocol import Driver, Team, check_agent
from ethbrake_marl.engine.memory import (
    ask_script,
    begin_script,
    is_state_free,
    renew_memory,
    take_memory,
    within_capacity,
)
from ethbrake_marl.engine.own_grid import ROUNDING
from ethbrake_marl.engine.stream import check_alert
from ethbrake_marl.errors import EthBrakeError, InvalidInput, describe_error
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import outcome_of
from ethbrake_marl.game.actions import action_to_command
from ethbrake_marl.game.harm import Ledger, empty_ledger
from ethbrake_marl.physics.episode import Decisions
from ethbrake_marl.physics.left_out import Impacts
from ethbrake_marl.physics.motion import BOUND, has_acted
from ethbrake_marl.physics.paper_map import held_speeds
from ethbrake_marl.physics.state import Bools, Floats, Ints, Vehicles, Worlds
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shields.step import StepShield

STANDS_MPS = 1e-3  # below this speed a vehicle of a host with a fixed step counts as standing

STARTS_WITHIN = 0.01  # m, m/s: tolerance between the first state of the host and the worlds

READ_WITHIN = 0.2  # m, m/s: tolerance for the change between two states

# tolerances of a vehicle that follows commands: delay, constant error, and error as a share of the command
LAG_S, OFF_MPS2, OFF_SHARE = 0.5, 0.5, 0.2

SNAP = 1e-6  # times count as equal if they differ by less than this share of a step


class HostState(NamedTuple):
    """State of ``n`` lines of ``N`` vehicles, as a host reports it.

    >>> import ethbrake_marl as eb

    >>> from ethbrake_marl.extensions.hosts import HostState
    >>> HostState(0.0, [[5.0, 6.0]], [[20.0, 18.0, 20.0]]).impacts is None
    True
    """

    time_s: ArrayLike  # time on the clock of the host (s), which may start at any number; a number or [n]
    gaps_m: ArrayLike  # [n, N - 1] gaps from bumper to bumper; negative if vehicles overlap
    speeds_mps: ArrayLike  # [n, N] speeds of the vehicles, front to rear
    impacts: Impacts | None = None  # impacts since the last state; None: this host does not resolve impacts


class HostCommand(NamedTuple):
    """Commands that a host receives for one step.

    >>> import ethbrake_marl as eb

    >>> from ethbrake_marl.extensions.hosts import HostCommand
    >>> HostCommand._fields
    ('acceleration_mps2', 'speeds_mps', 'wanted_mps2', 'until_s')
    """

    acceleration_mps2: Floats  # [n, N] acceleration for this step, after latency, standstill and speed limit
    speeds_mps: Floats  # [n, N] speeds at the start of the step: the reported speeds, changed by impacts
    wanted_mps2: Floats  # [n, N] acceleration that the agents chose, for a host that applies latencies and standstill
    until_s: Floats  # [n] time at which the step ends, measured from the alert (s)


class Host(Protocol):
    """Interface of a host: a simulator that moves ``n`` lines of vehicles, one line per world, from the alert on.

    The class of a host need not inherit from ``Host``.

    The attribute ``dt`` is the length of every step (s). If ``dt = math.inf``, each call of ``apply`` moves every world
    to the time ``command.until_s`` of its next decision. A world that has already reached ``command.until_s`` does not
    move.

    >>> import ethbrake_marl as eb

    >>> from ethbrake_marl.extensions.hosts import HostState, drive_host
    >>> class Bench:
    ...     dt = 0.1
    ...     def __init__(self, worlds):
    ...         self.told = HostState(0.0, worlds.gaps_m, worlds.speeds_mps)
    ...     def state(self):
    ...         return self.told
    ...     def apply(self, command):
    ...         after = command.speeds_mps + self.dt * command.acceleration_mps2
    ...         way = self.dt * (command.speeds_mps + after) / 2
    ...         gaps = self.told.gaps_m + way[:, :-1] - way[:, 1:]
    ...         self.told = HostState(self.told.time_s + self.dt, gaps, after)
    >>> worlds = eb.load_scenario("paper-random").sample(5, seed=7).worlds
    >>> drive_host(Bench(worlds), eb.make_agent("full_brake"), "paper-random", worlds).outcome.at_rest.all()
    np.True_
    """

    dt: float

    def state(self) -> HostState:
        """Return the present time, gaps, speeds and, if the host resolves impacts, the impacts since the last call."""

    def apply(self, command: HostCommand) -> None:
        """Move all vehicles for one time step with the accelerations in ``command``."""


class HostFailed(EthBrakeError):
    """Raised if a host raises an exception or reports an impossible state.

    Args:
        reason: error message.
        ledger: harm until the failure, also an attribute of the exception.
        worlds: last valid state of the worlds, also an attribute of the exception.

    >>> import ethbrake_marl as eb

    >>> from ethbrake_marl.extensions.hosts import HostFailed
    >>> issubclass(HostFailed, eb.EthBrakeError)
    True

    """

    def __init__(self, reason: str, ledger: Ledger, worlds: Worlds) -> None:
        super().__init__(reason)
        self.ledger, self.worlds = ledger, worlds


class Hosted(NamedTuple):
    """Result of episodes in which an agent drove vehicles of a host."""

    outcome: Outcome  # harm and final state of each world
    # [n] whether the motion in the host differed from the shield's prediction; the bound of the shield then has no
    # guarantee. None without a shield of mode step or robust, because other shields make no predictions.
    distrusted: Bools | None

    @classmethod
    def join(cls, parts: list[Hosted]) -> Hosted:
        """Join the results of different worlds into one result, in the order of ``parts``."""
        distrusted = [part.distrusted for part in parts if part.distrusted is not None]
        outcome = Outcome.join([part.outcome for part in parts])
        return cls(outcome, np.concatenate(distrusted) if distrusted else None)


def drive_host(host: Host, agent: Driver, scenario: str | Path | Scenario, worlds: Worlds) -> Hosted:
    """Let an agent or a team drive the scenario's learners in a host, from the alert to the end of every episode.

    Args:
        host: the host, in which all worlds must be at the alert.
        agent: agent or team that drives the learners, with or without a shield, for instance from ``make_agent``. It is
            not changed.
        scenario: the scenario; its scripts drive all vehicles that do not learn, and agents know these scripts.
        worlds: the worlds at the alert, with whose gaps and speeds the vehicles of the host must begin.

    Returns the outcome of the episodes, and a mask [n]: True for the worlds in which the motion differed from the
    prediction of the shield. The mask is None if no shield makes predictions. Raises ``InvalidInput`` if the scenario,
    agent or worlds cannot be used with a host. Raises ``HostFailed`` if the host raises an exception or reports an
    impossible state.

    """
    scenario = load_scenario(scenario)
    if not isinstance(worlds, Worlds):
        raise InvalidInput(
            f"host: worlds = {worlds!r}: must be a Worlds object, for instance scenario.sample(n, seed).worlds"
        )
    check_alert(worlds, worlds.n, scenario.vehicles)
    check_agent(agent, "host", alone=False)
    team = Team.of(agent, scenario.learners)
    if not team.drivers:
        raise InvalidInput(
            f"host: scenario {scenario.name!r} has no learner; give one with a learner, for instance"
            " scenario.with_learners([1])"
        )
    return _Run(host, worlds, team, scenario).to_the_end()


class _Grid:
    """Decision times of vehicles that always decide together: in each world at ``first_s``, then once per time step.

    The attribute ``made`` [n] is the number of decisions so far, and ``all`` [n] the number from the alert to the
    horizon.
    """

    def __init__(self, first_s: Floats, vehicles: list[int], scenario: Scenario) -> None:
        self.decisions, self.horizon_s = Decisions(first_s, scenario.time_step_s), scenario.horizon_s
        self.vehicles, self.made = vehicles, np.zeros(len(first_s))
        self.all = self.decisions.before(scenario.horizon_s)

    @property
    def next_s(self) -> Floats:
        """Time of the next decision in each world, [n] s; the horizon if no decision is left."""
        return np.where(self.made < self.all, self.decisions.at(self.made), self.horizon_s)

    def is_due(self, time_s: Floats) -> Bools:
        """Return a mask [n]: True where ``time_s`` has reached ``next_s``."""
        return self.next_s <= time_s + ROUNDING * self.decisions.time_step_s


class _Run:
    """Episodes that run in a host.

    ``team`` has the agents of all learners; the other arguments mean the same as in ``drive_host``.
    """

    def __init__(self, host: Host, worlds: Worlds, team: Team, scenario: Scenario) -> None:
        self.host, self.team, self.scenario = host, team, scenario
        self.dt = _checked_dt(host, scenario)
        self.exact = math.isinf(self.dt)
        _check_known(worlds, scenario, tuple(team.drivers))
        self.ledger, self.time_s, self.ticks = empty_ledger(worlds), np.zeros(worlds.n), 0
        self.origin_s: Floats = np.zeros(worlds.n)
        self.told_s: Floats = np.zeros(worlds.n)
        self.alert = self.final = worlds
        self.gaps_m, self.speeds_mps, self.wanted_mps2 = worlds.gaps_m, worlds.speeds_mps, worlds.command_mps2
        self.gaps_m, self.speeds_mps = self._first_state()
        if not self.exact:
            worlds = replace(worlds, vehicles=_on_steps(worlds, self.dt))
        self.alert = self.final = worlds.running(0.0, self.gaps_m, self.speeds_mps)
        self.engine = engine = episode_engine(self.alert, team, scenario)
        first = self.alert.first_decision_s
        asked = [i for i, script in engine.scripts.items() if not is_state_free(script)]
        drivers = [*engine.deciders]
        self.grids = [_Grid(first(drivers), [i for i in asked if i in drivers], scenario)]
        self.grids += [_Grid(first([i]), [i], scenario) for i in asked if i not in drivers]
        known = {i: script for i, script in engine.scripts.items() if i not in drivers}
        others = [i for i in asked if i not in drivers]
        self.memories = engine.memories | {i: begin_script(known[i], self.alert, i, known) for i in others}
        self.wanted_mps2 = engine.wanted_mps2.copy()
        self.wanted_mps2[:, asked] = 0.0
        self.motion = _Motion(self.alert, self.dt)
        self.ended: Bools = np.zeros(worlds.n, np.bool_)
        self.at_rest: Bools = np.zeros(worlds.n, np.bool_)

    def to_the_end(self) -> Hosted:
        """Run every world to the end of its episode."""
        if self.exact:
            self._move()  # to the first decision
        while not self.ended.all():
            self._decide()
            self._move()
            self._end()
        guarded = self.engine.guarded
        memories = {i: memory for i, memory in self.memories.items() if i in self.team.drivers}
        outcome = outcome_of(self.team, Episodes(self.ledger, self.final, self.at_rest, guarded, memories))
        shield = None if guarded is None else guarded.shield
        return Hosted(outcome, shield.memory.distrusted if isinstance(shield, StepShield) else None)

    # decisions
    def _decide(self) -> None:
        """Let all vehicles whose decision is due choose a command; all of them see the same state."""
        each = [~self.ended & (grid.made < grid.all) & grid.is_due(self.time_s) for grid in self.grids]
        if not np.any(each):
            return
        worlds = self._seen()
        for number, (grid, due) in enumerate(zip(self.grids, each, strict=True)):
            idle = np.flatnonzero(~due)
            if len(idle) == len(due):
                continue
            for i in grid.vehicles:
                script, before = self.engine.scripts[i], self.memories[i]
                command, after = ask_script(script, worlds, before, i)
                self.wanted_mps2[due, i] = within_capacity(command, worlds, i, script, due)[due]
                self.memories[i] = renew_memory(after, idle, take_memory(before, idle))
            if number == 0 and self.engine.guard is not None:
                self._ask_guard(worlds, due, idle)
            grid.made = grid.made + due

    def _ask_guard(self, worlds: Worlds, due: Bools, idle: Ints) -> None:
        """Let the learners' policies propose actions, and let the shield accept or replace them.

        ``due`` [n] says where a decision is due. In the worlds ``idle``, where none is due, the agents' memories do not
        change.
        """
        engine = self.engine
        assert engine.guard is not None
        engine.place(worlds, self.ledger, ended=~due)
        before: Any = engine.guarded
        nothing = np.full((worlds.n, len(engine.learners)), np.nan)
        ruling = engine.guard.decide(engine, before, nothing)
        policies = renew_memory(ruling.memory.policies, idle, take_memory(before.policies, idle))
        engine.remember(ruling.memory._replace(policies=policies))
        for c, i in enumerate(engine.learners):
            self.wanted_mps2[due, i] = action_to_command(ruling.applied[:, c], worlds.vehicles, i)[due]

    def _seen(self) -> Worlds:
        """Return the present state as agents see it: very low speeds and negative gaps are set to 0."""
        latency, speeds = self.alert.vehicles.latency_s, self.speeds_mps
        in_force = np.where(has_acted(latency, self.time_s[:, np.newaxis]), self.wanted_mps2, 0.0)
        if not self.exact:
            speeds = np.where(np.abs(speeds) < STANDS_MPS, 0.0, speeds)
        gaps = np.maximum(self.gaps_m, 0.0)
        return self.alert.running(self.time_s, gaps, speeds, command_mps2=in_force, pair_hit=self.ledger.count > 0)

    def _end(self) -> None:
        """Mark the episodes that ended in the most recent step, and let their learners brake fully."""
        first = self.grids[0]
        if not (stepped := ~self.ended & first.is_due(self.time_s) & (first.made > 0)).any():
            return
        worlds = self._seen()
        rests = ((worlds.speeds_mps == 0.0) & (self.wanted_mps2 <= 0.0)).all(axis=1)
        over = stepped & (rests | (self.time_s >= self.scenario.horizon_s - SNAP * self.scenario.time_step_s))
        self.at_rest |= over & rests
        self.ended |= over
        rows, drivers = np.flatnonzero(over), list(self.team.drivers)
        self.final = self.final.assign(rows, worlds.take(rows))
        self.wanted_mps2[np.ix_(over, drivers)] = -worlds.vehicles.braking_capacity_mps2[np.ix_(over, drivers)]

    # the host's steps
    def _move(self) -> None:
        """Let the host make one step, check the reported state, and resolve impacts if the host does not."""
        if self.exact:
            until = np.minimum.reduce([grid.next_s for grid in self.grids])
            until = np.where(self.ended, self.time_s, np.maximum(until, self.time_s))
        else:
            self.ticks += 1
            until = np.full(len(self.ended), self.ticks * self.dt)
        v, begin = self.alert.vehicles, self.speeds_mps
        acceleration = np.where(v.latency_s <= self.time_s[:, np.newaxis], self.wanted_mps2, 0.0)
        if not self.exact:
            acceleration = (held_speeds(begin, acceleration, v.speed_limit_mps, self.dt) - begin) / self.dt
        command = HostCommand(acceleration.copy(), begin.copy(), self.wanted_mps2.copy(), until.copy())
        try:
            self.host.apply(command)
        except Exception as error:
            self._fail(f"apply raised {describe_error(error)}", error)
        time_s, gaps, speeds, impacts = self._read()
        self._check_clock(time_s, until)
        before_m, step_s = self.gaps_m, until - self.time_s
        step = _Step(self.wanted_mps2, begin, until, time_s - self.told_s, gaps, speeds, impacts)
        if refusal := self.motion.refusal(step):
            self._fail(refusal[1], world=refusal[0])
        self.told_s, self.time_s, self.gaps_m = time_s, until, gaps
        self.speeds_mps = speeds.copy()
        self.ledger = self.ledger.add(self._meet(before_m, begin, step_s) if impacts is None else impacts)

    def _meet(self, before_m: Floats, begin: Floats, step_s: Floats) -> Impacts:
        """Resolve the impacts of a step by the paper's eq. (13), for one pair after another from rear to front.

        A pair has an impact if, at the end of the step, its gap g is at most 0 and its closing speed w is above 0. Let
        b be the mean closing acceleration of the pair in the step. Harm and eq. (13) are computed with the closing
        speed at the contact, ``sqrt(w^2 + 2 b g)``, or, if the pair was already in contact before the step, with w.

        ``before_m`` [n, P] are the gaps before the step (m), ``begin`` [n, N] the speeds at its start (m/s), and
        ``step_s`` [n] its length (s). Returns the impacts, and writes the speeds after the impacts into
        ``self.speeds_mps``.
        """
        v, gaps, speeds, speeds_seen = self.alert.vehicles, self.gaps_m, self.speeds_mps, self.speeds_mps.copy()
        first, total, count = np.zeros(gaps.shape), np.zeros(gaps.shape), np.zeros(gaps.shape, np.int64)
        pressing = np.diff(speeds_seen - begin, axis=1) / np.maximum(step_s, SNAP)[:, np.newaxis]
        for p in range(gaps.shape[1] - 1, -1, -1):
            closing = speeds[:, p + 1] - speeds[:, p]
            meets = (gaps[:, p] <= 0.0) & (closing > 0.0)
            then = np.sqrt(np.maximum(closing * closing + 2.0 * pressing[:, p] * gaps[:, p], 0.0))
            closing = np.where(meets, np.where(before_m[:, p] > 0.0, then, closing), 0.0)
            front, rear = v.mass_t[:, p], v.mass_t[:, p + 1]
            impulse = (1.0 + v.restitution) * closing / (front + rear)
            speeds[:, p] += rear * impulse
            speeds[:, p + 1] -= front * impulse
            count[:, p] = closing > BOUND.TOUCH_SPEED_MPS
            total[:, p] = np.where(count[:, p], closing * closing, 0.0)
            first[:, p] = np.where(self.ledger.count[:, p], 0.0, total[:, p])
        return Impacts(first, total, count, *Impacts.no_obstacle(len(gaps)))

    def _read(self) -> tuple[Floats, Floats, Floats, Impacts | None]:
        """Read the state of the host, check the shapes and numbers of its arrays, and return copies.

        Returns the time since the alert [n], gaps [n, P], speeds [n, N], and impacts (None if the host does not report
        impacts). Raises ``HostFailed`` if the host raises an exception, or if an array has a wrong shape or a number
        that is not finite.
        """
        (n, N), read = self.alert.speeds_mps.shape, list[Floats]()
        try:
            state = HostState(*self.host.state())
            numbers = [np.array(np.ma.filled(each, np.nan), np.float64) for each in state[:3]]
        except Exception as error:
            self._fail(f"state raised {describe_error(error)}", error)
        numbers[0] = numbers[0] if numbers[0].ndim else np.full(n, numbers[0])
        for name, each, shape in zip(HostState._fields, numbers, ((n,), (n, N - 1), (n, N)), strict=False):
            if each.shape != shape:
                self._fail(f"{name} has shape {each.shape}; must have shape {shape}: (worlds, vehicles or pairs)")
            if not np.isfinite(each).all():
                at = np.argwhere(~np.isfinite(each))[0].tolist()
                self._fail(f"{name}{at} is {each[tuple(at)]}; every number must be finite")
            read.append(each)
        impacts = state.impacts
        if impacts is not None:
            if not isinstance(impacts, Impacts):
                self._fail(f"impacts is of type {type(impacts).__name__}; must be None, or as eb.advance returns it")
            for place, column in enumerate(fields(Impacts)[:6]):
                values, shape = np.asarray(getattr(impacts, column.name)), (n, N - 1) if place < 3 else (n,)
                whole = values.dtype.kind in ("iu" if column.name.endswith("count") else "fiu")
                if not (whole and values.shape == shape and np.isfinite(values).all() and (values >= 0).all()):
                    self._fail(
                        f"impacts.{column.name} must have shape {shape} and finite numbers of at least 0; counts must"
                        " be whole numbers"
                    )
        return read[0] - self.origin_s, read[1], read[2], impacts

    def _first_state(self) -> tuple[Floats, Floats]:
        """Return the host's gaps [n, P] and speeds [n, N] at the alert, and store its clock time at the alert.

        Raises ``HostFailed`` if the gaps or speeds differ from those of the worlds.
        """
        self.origin_s, gaps, speeds, _ = self._read()
        for name, told, given in (("gaps_m", gaps, self.alert.gaps_m), ("speeds_mps", speeds, self.alert.speeds_mps)):
            if not (close := np.abs(told - given) <= STARTS_WITHIN).all():
                at = tuple(np.argwhere(~close)[0].tolist())
                self._fail(
                    f"{name}{list(at)} is {told[at]:g} in the host, but {given[at]:g} in worlds; the host must start"
                    f" with the gaps and speeds of worlds, with a difference of at most {STARTS_WITHIN:g}"
                )
        return np.maximum(gaps, 0.0), speeds

    def _check_clock(self, time_s: Floats, until: Floats) -> None:
        """Raise ``HostFailed`` if the host's clock ``time_s`` [n] is not within half a step of ``until`` [n]."""
        within = SNAP * self.scenario.time_step_s if self.exact else self.dt / 2.0
        if not (good := np.abs(time_s - until) <= within).all():
            k = int(np.argmin(good))
            went = "skips" if time_s[k] > until[k] else "goes back" if time_s[k] < self.told_s[k] else "loses a step"
            self._fail(
                f"world {k} {went}: its clock went from {self.told_s[k]:g} s to {time_s[k]:g} s, but should be at"
                f" {until[k]:g} s (tolerance {within:g} s); each call of apply must make one step of dt"
            )

    def _fail(self, what: str, error: Exception | None = None, world: int | None = None) -> NoReturn:
        at = float(self.time_s.max(initial=0.0) if world is None else self.time_s[world])
        raise HostFailed(f"host {type(self.host).__name__} at {at:.2f} s: {what}", self.ledger, self._seen()) from error


class _Step(NamedTuple):
    """One step of a host: the command that it received, and the state that it reported at the end of the step."""

    wanted_mps2: Floats  # [n, N] acceleration that the agents chose
    begin_mps: Floats  # [n, N] commanded speeds at the start of the step
    until_s: Floats  # [n] time at which the step should end, measured from the alert
    clock_s: Floats  # [n] length of the step on the clock of the host (s)
    gaps_m: Floats  # [n, N - 1] reported gaps at the end; negative if vehicles overlap
    speeds_mps: Floats  # [n, N] reported speeds at the end
    impacts: Impacts | None  # impacts in the step; None: the host does not report impacts


class _Motion:
    """Checks whether the states that a host reports can follow from the commands since the alert.

    ``refusal`` returns an error for a state that breaks one of three rules:

    1. *Speed in a step.* In one step, a vehicle's speed changes by no more than its commands since the alert allow.
    2. *Gaps since the alert.* Each gap changes in each step as the speeds at the start and the end of the step require.
    3. *Speed since the alert.* A vehicle follows its commands with a delay of at most ``LAG_S``, and its acceleration
       differs from the command by at most ``OFF_MPS2`` plus ``OFF_SHARE`` times the command.

    If the host does not report impacts, the rules assume that its vehicles pass through one another. If the host
    reports impacts, the rules allow that vehicles in contact push one another. For vehicles that may have been pushed,
    rule 1 allows every speed that the commands of the whole line make possible, and after an impact every speed that
    the energy of the line makes possible. For these vehicles, rules 2 and 3 start again from the reported state.

    ``dt`` is the length of the host's steps (s); math.inf if each step ends at the time of a decision.
    """

    def __init__(self, alert: Worlds, dt: float) -> None:
        self.vehicles, self.jitter_s = alert.vehicles, 0.0 if math.isinf(dt) else dt
        self.time_s, self.gaps_m, self.speeds_mps = alert.time_s, alert.gaps_m, alert.speeds_mps
        self.least_mps2 = self.most_mps2 = np.zeros(alert.speeds_mps.shape)  # range of the commands so far
        self.least_m = self.most_m = alert.gaps_m  # range of the gaps that agree with the speeds
        self.led_mps = alert.speeds_mps  # speeds of vehicles that follow the commands exactly
        self.off_mps = np.full(alert.speeds_mps.shape, READ_WITHIN)  # tolerance for led_mps, without the delay

    def refusal(self, step: _Step) -> tuple[int, str] | None:
        """Check the state that the host reported at the end of ``step``.

        Returns the index of a world with an impossible state, and an error message; None if all states are possible.
        """
        acting_s = np.maximum(step.until_s[:, np.newaxis] - np.maximum(self._now, self.vehicles.latency_s), 0.0)
        command = np.where(acting_s > 0.0, step.wanted_mps2, 0.0)
        met = self._met(step)
        low, high = self._reachable(step, met)
        wrong = (
            _refused(
                step.speeds_mps, low, high,
                lambda k, i, right: f"vehicle_{i + 1} of world {k} goes from {step.begin_mps[k, i]:g} to"
                f" {step.speeds_mps[k, i]:g} m/s within {step.until_s[k] - self.time_s[k]:g} s, but its command of"
                f" {command[k, i]:g} m/s2 allows {right} m/s; begin each step with command.speeds_mps and let vehicles"
                " pass through one another, or report every impact",
            )
            or self._wrong_gap(step, met, low, high)
            or self._wrong_speed(step, met, command * acting_s)
        )  # fmt: skip
        self.time_s, self.gaps_m, self.speeds_mps = step.until_s, step.gaps_m, step.speeds_mps
        return wrong

    @property
    def _now(self) -> Floats:
        return self.time_s[:, np.newaxis]

    def _met(self, step: _Step) -> Bools:
        """Return a mask [n, N]: True for vehicles that another vehicle may have pushed during the step."""
        met = np.zeros(step.speeds_mps.shape, np.bool_)
        if step.impacts is not None:
            touch = (step.impacts.count > 0) | (np.minimum(step.gaps_m, self.gaps_m) <= READ_WITHIN)
            met[:, :-1] |= touch
            met[:, 1:] |= touch
        return met

    def _reachable(self, step: _Step, met: Bools) -> tuple[Floats, Floats]:
        """Return the least and the greatest speed that rule 1 allows at the end of the step, each [n, N] m/s."""
        # a host that handles latencies itself does not round them up to whole steps
        acting = step.until_s[:, np.newaxis] + self.jitter_s > self.vehicles.latency_s
        command = np.where(acting, step.wanted_mps2, 0.0)
        self.least_mps2, self.most_mps2 = np.minimum(self.least_mps2, command), np.maximum(self.most_mps2, command)
        least = np.where(met, self.least_mps2.min(axis=1, keepdims=True), self.least_mps2)
        most = np.where(met, self.most_mps2.max(axis=1, keepdims=True), self.most_mps2)
        begin, seconds = step.begin_mps, np.maximum(step.until_s - self.time_s, step.clock_s)[:, np.newaxis]
        low = begin + least * seconds - READ_WITHIN
        high = np.maximum(begin, 0.0) + most * seconds + READ_WITHIN  # brakes may stop a vehicle that rolls backwards
        if step.impacts is None:
            return low, high
        mass, fastest = self.vehicles.mass_t, np.maximum(np.abs(low), np.abs(high))
        by_energy = np.sqrt((mass * fastest * fastest).sum(axis=1, keepdims=True) / mass)
        struck = met & (step.impacts.count > 0).any(axis=1, keepdims=True)
        return np.where(struck, -by_energy, low), np.where(struck, by_energy, high)

    def _wrong_gap(self, step: _Step, met: Bools, low: Floats, high: Floats) -> tuple[int, str] | None:
        seconds = (step.until_s - self.time_s)[:, np.newaxis]
        low = np.where(met, low, np.minimum(step.begin_mps, step.speeds_mps))
        high = np.where(met, high, np.maximum(step.begin_mps, step.speeds_mps))
        closing = np.abs(np.diff(step.speeds_mps, axis=1))
        jitter = self.jitter_s / 2.0 * np.abs(np.diff(step.speeds_mps - self.speeds_mps, axis=1))
        least = self.least_m + seconds * (low[:, :-1] - high[:, 1:]) - jitter
        most = self.most_m + seconds * (high[:, :-1] - low[:, 1:]) + jitter
        off, pushed = READ_WITHIN + self.jitter_s * closing, met[:, :-1] | met[:, 1:]
        self.least_m, self.most_m = np.where(pushed, step.gaps_m, least), np.where(pushed, step.gaps_m, most)
        return _refused(
            step.gaps_m, least - off, most + off,
            lambda k, p, right: f"the gap between vehicle_{p + 1} and vehicle_{p + 2} of world {k} is"
            f" {step.gaps_m[k, p]:g} m at {step.until_s[k]:g} s, but must be {right} m by the reported speeds",
        )  # fmt: skip

    def _wrong_speed(self, step: _Step, met: Bools, change: Floats) -> tuple[int, str] | None:
        """Find a reported speed that does not agree with the commands since the alert (rule 3).

        The speed of pushed vehicles (``met`` [n, N]) is not checked. ``change`` [n, N] is the change of speed in the
        step of a vehicle that follows its command exactly (m/s). Returns the index of the world with the wrong speed,
        and an error message; None if all speeds agree.
        """
        began = self.led_mps + step.begin_mps - self.speeds_mps
        led = held_speeds(began, change, self.vehicles.speed_limit_mps, 1.0)
        seconds = (step.until_s - self.time_s)[:, np.newaxis]
        self.off_mps = self.off_mps + OFF_MPS2 * seconds + OFF_SHARE * np.abs(led - began)
        self.led_mps = np.where(met, step.speeds_mps, led)
        off = self.off_mps + LAG_S * (self.most_mps2 - self.least_mps2)
        led = np.where(step.speeds_mps >= 0.0, np.maximum(led, 0.0), led)  # some hosts have no negative speeds
        return _refused(
            step.speeds_mps, np.where(met, -np.inf, led - off), np.where(met, np.inf, led + off),
            lambda k, i, right: f"vehicle_{i + 1} of world {k} drives at {step.speeds_mps[k, i]:g} m/s at"
            f" {step.until_s[k]:g} s, but should drive at {right} m/s; the host must follow command.acceleration_mps2",
        )  # fmt: skip


def _refused(
    values: Floats, low: Floats, high: Floats, describe: Callable[[int, int, str], str]
) -> tuple[int, str] | None:
    """Find the first element of ``values`` [n, k] that is outside its range, ``low`` to ``high`` (both [n, k]).

    Returns its row, and the error message ``describe(row, column, range as text)``; None if all are in their ranges.
    """
    good = (low <= values) & (values <= high)
    if good.all():
        return None
    k, i = np.argwhere(~good)[0].tolist()
    return k, describe(k, i, f"{low[k, i]:g} to {high[k, i]:g}")


def _checked_dt(host: Host, scenario: Scenario) -> float:
    """Return the length of the host's steps (s).

    Raises ``InvalidInput`` if ``host`` is not a host, or if the scenario's time step is not a multiple of ``dt``.
    """
    missing = [what for what in ("dt", "state", "apply") if not hasattr(host, what)]
    if missing:
        raise InvalidInput(
            f"host {type(host).__name__}: has no {' and no '.join(missing)}; docs/extensions/hosts.md shows what a host"
            " needs"
        )
    dt, step = host.dt, scenario.time_step_s
    if isinstance(dt, bool) or not isinstance(dt, int | float | np.number) or not dt > 0.0:
        raise InvalidInput(f"host: dt = {dt!r}: the step length must be a number of seconds above 0, or math.inf")
    if not math.isinf(dt) and not (dt <= step * (1.0 + SNAP) and abs(step / dt - round(step / dt)) <= SNAP):
        raise InvalidInput(
            f"host: dt = {dt:g} s: the time between decisions, {step:g} s, must be a multiple of dt; for instance"
            f" dt = {step / math.ceil(step / dt):g} s"
        )
    return float(dt)


def _check_known(worlds: Worlds, scenario: Scenario, vehicles: tuple[int, ...]) -> None:
    """Raise ``InvalidInput`` for brakes that build up, periodic messages and obstacles, which hosts do not support.

    ``vehicles`` are the indices of the controlled vehicles.
    """
    scenario.play_pieces(worlds, vehicles).refuse_build_up("host")
    if worlds.messages.shape[1] or worlds.obstacle_ahead.any():
        what = "periodic messages or tells (v2x)" if worlds.messages.shape[1] else "an obstacle ahead (obstacle_gap_m)"
        raise InvalidInput(f"host: scenario {scenario.name!r} has {what}, which hosts do not support")


def _on_steps(worlds: Worlds, dt: float) -> Vehicles:
    """Return the parameters of the vehicles, with latencies rounded up to multiples of the step length ``dt`` (s)."""

    def up(seconds: Floats) -> Floats:
        return np.ceil(seconds / dt - SNAP) * dt

    v = worlds.vehicles
    latency = up(v.latency_s)
    if v.is_known_at_once:
        return replace(v, latency_s=latency, own_latency_s=latency, known_from_s=Vehicles.known_at_once(latency))
    return replace(v, latency_s=latency, own_latency_s=up(v.own_latency_s), known_from_s=up(v.known_from_s))
