"""Episodes of ``n`` worlds at once: reset, step, roles, latency gates, episode ends.

Every face of the environment, every evaluation and every search is a thin layer on this. An episode starts at t = 0,
when Vehicle 1 brakes; ``reset`` moves exactly to the first moment at which a learner's latency has elapsed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ethbrake_marl.actions import action_to_command, checked_action
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import Ledger, empty_ledger
from ethbrake_marl.observations import Observations, ObservationSpec, observe
from ethbrake_marl.physics import Bools, Floats, Impacts, Ints, Worlds, advance, assign
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.rewards import RewardParams, potential, reward_params, reward_terms, weighted_sum
from ethbrake_marl.scenario import Scenario

_SAMPLED_AT_ONCE = 1024  # training worlds are drawn in blocks of at least this many


OnBegin = Callable[[Worlds, Ints], None]  # the new worlds at the alert, and the rows where their episodes start


class Script(Protocol):
    """What drives a vehicle that does not learn (see ``agents.protocol``)."""

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """New episodes start in these rows of the batch; ``worlds`` holds those rows only, at the alert."""

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration in every world of the batch, [n] m/s2."""


@dataclass(frozen=True, slots=True)
class Step:
    """What one step brought, for every world of the batch."""

    reward: Floats  # [n, N]
    terms: dict[str, Floats]  # unweighted reward terms, each [n, N]
    terminated: Bools  # [n] everything at rest, no command that would move it
    truncated: Bools  # [n] the horizon was reached
    impacts: Impacts
    command_mps2: Floats  # [n, N] wanted by each vehicle in this step

    @property
    def ended(self) -> Bools:
        """Episodes that ended with this step, [n]."""
        return self.terminated | self.truncated


class Engine:
    """A batch of ``n`` running episodes of one scenario.

    ``learners`` are vehicle indices (0 = front); every other vehicle needs an entry in ``scripts``. Worlds come from
    the scenario's training stream of ``seed`` unless they are given (``worlds``, at t = 0, here or in ``reset``).
    Steps start when the first of the ``deciders`` may act: the learners, or the scripted vehicles named instead (an
    evaluated agent drives its vehicle as a script, on a learner's grid of decisions). With none, they start at t = 0.
    Whoever must see each episode's start (a shield) adds a function to ``on_begin``.
    """

    def __init__(
        self,
        scenario: Scenario,
        n: int,
        *,
        learners: Sequence[int],
        scripts: Mapping[int, Script],
        reward: str | RewardParams = "harm",
        observation: ObservationSpec | None = None,
        seed: int = 0,
        deciders: Sequence[int] | None = None,
        worlds: Worlds | None = None,
    ) -> None:
        if not n >= 1:
            raise InvalidInput(f"engine: n = {n} worlds; at least 1 is needed")
        self.scenario = scenario
        self.n = n
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
        self.reward = reward_params(reward)
        self.observation = observation or ObservationSpec()
        self.seed = seed
        self.on_begin: list[OnBegin] = []
        self.rejected = 0  # draws refused so far because of an impact before anybody could act
        self._drawn = 0
        self._pool: Worlds | None = None
        self._pool_next = 0
        self.reset(worlds=worlds)

    def reset(self, *, seed: int | None = None, worlds: Worlds | None = None) -> None:
        """Start new episodes in all rows: the given worlds (at t = 0), or the next ones of the training stream.

        With ``seed`` the stream starts again from its beginning.
        """
        if seed is not None:
            self.seed, self._drawn, self._pool, self.rejected = seed, 0, None, 0
        if worlds is None:
            worlds = self._next_worlds(self.n)
        elif (worlds.n, worlds.N) != (self.n, self.scenario.vehicles):
            raise InvalidInput(
                f"reset: {worlds.n} worlds of {worlds.N} vehicles given; {self.n} of {self.scenario.vehicles} needed"
            )
        self.worlds = worlds
        self.ledger = empty_ledger(worlds)
        self.ended: Bools = np.zeros(self.n, np.bool_)
        self._potential = np.zeros(worlds.speeds_mps.shape)
        self._start_s = np.zeros(self.n)
        self._step_index = np.zeros(self.n, np.int64)
        self._last_step = np.zeros(self.n, np.int64)
        self._begin(np.arange(self.n), worlds)

    def renew(self, rows: Ints) -> None:
        """Start new episodes of the training stream in these rows (autoreset)."""
        if len(rows):
            self._begin(rows, self._next_worlds(len(rows)))

    def observe(self, vehicle: int) -> Observations:
        """Current observation of one vehicle, [n, F]."""
        return observe(self.worlds, vehicle, self.observation)

    def step(self, actions: Mapping[int, Floats] | Floats) -> Step:
        """Advance every running episode by one time step.

        ``actions``: for each learner (by vehicle index, or as columns [n, L] in the order of ``learners``) a number in
        [-1, 1] per world. Rows whose episode has ended stay as they are until ``renew`` or ``reset``.
        """
        command = self._commands(actions)
        before = self.worlds
        index, until = next_times(
            self._step_index, self._last_step, self._start_s, self.ended, before.time_s, self.scenario.time_step_s,
            self.scenario.horizon_s,
        )  # fmt: skip
        self.worlds, impacts = advance(before, command, until_s=until)
        self.ledger = self.ledger.add(impacts)
        terminated, truncated, safe_end = episode_ends(
            self.worlds.speeds_mps, command, self.ledger.count, self.ended, index >= self._last_step
        )
        terms = reward_terms(self.reward, before, self.worlds, impacts, safe_end, self.scenario.time_step_s)
        if self.reward.shaping > 0.0:
            terms["shaping"] = self._shaping(terminated)
        reward = weighted_sum(self.reward, terms, command.shape)
        reward[self.ended] = 0.0
        self._step_index = index
        self.ended = self.ended | terminated | truncated
        return Step(reward, terms, terminated, truncated, impacts, command)

    def _shaping(self, terminated: Bools) -> Floats:
        """The shaping term [n, N] of this step; keeps the new potentials, which are 0 where an episode terminated."""
        before = self._potential
        self._potential = self._potentials(self.worlds)
        self._potential[terminated] = 0.0
        shaping: Floats = self.reward.shaping_discount * self._potential - before
        return shaping

    def _potentials(self, worlds: Worlds) -> Floats:
        """Potential of every learner, 0 for other vehicles, [n, N]."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        for vehicle in self.learners:
            potentials[:, vehicle] = potential(self.reward, worlds, vehicle, self.scenario.horizon_s)
        return potentials

    def _commands(self, actions: Mapping[int, Floats] | Floats) -> Floats:
        command = np.empty(self.worlds.speeds_mps.shape)
        for vehicle, script in self.scripts.items():
            command[:, vehicle] = script.act(self.worlds, vehicle)
        if not isinstance(actions, Mapping):
            columns = checked_action(actions, (self.n, len(self.learners)), "the learners")
            actions = {vehicle: columns[:, k] for k, vehicle in enumerate(self.learners)}
        for vehicle in self.learners:
            if vehicle not in actions:
                raise InvalidInput(f"step: no action for the learner vehicle_{vehicle + 1}")
            action = checked_action(actions[vehicle], (self.n,), f"vehicle_{vehicle + 1}")
            command[:, vehicle] = action_to_command(action, self.worlds.vehicles, vehicle)
        return command

    def _begin(self, rows: Ints, fresh: Worlds) -> None:
        """Put ``fresh`` worlds (at t = 0) into ``rows`` and move them to their first decision."""
        for watch in self.on_begin:
            watch(fresh, rows)
        for vehicle, script in self.scripts.items():
            script.begin(fresh, vehicle, rows)
        command = self._first_commands(rows, fresh)
        start = np.zeros(len(rows))
        if self.deciders:
            start = fresh.vehicles.latency_s[:, list(self.deciders)].min(axis=1)
        step, horizon = self.scenario.time_step_s, self.scenario.horizon_s
        if not (start < horizon).all():
            late = float(start.max())
            raise InvalidInput(f"reset: nobody decides before the horizon ({late:g} s >= {horizon:g} s)")
        moved, impacts = advance(fresh, command, until_s=start)
        self.worlds = assign(self.worlds, rows, moved)
        self.ledger = _assign_ledger(self.ledger, rows, empty_ledger(fresh).add(impacts))
        if self.reward.shaping > 0.0:
            self._potential[rows] = self._potentials(moved)
        self.ended[rows] = False
        self._start_s[rows] = start
        self._step_index[rows] = 0
        self._last_step[rows] = np.ceil((horizon - start) / step - 1e-9).astype(np.int64)

    def _first_commands(self, rows: Ints, fresh: Worlds) -> Floats:
        """What the scripts want at the alert, learners coasting, [len(rows), N]."""
        command = np.zeros(fresh.speeds_mps.shape)
        if not all(getattr(script, "state_free", False) for script in self.scripts.values()):
            self.worlds = assign(self.worlds, rows, fresh)  # a script with a memory acts on the whole batch
        for vehicle, script in self.scripts.items():
            if getattr(script, "state_free", False):
                command[:, vehicle] = script.act(fresh, vehicle)
            else:
                command[:, vehicle] = script.act(self.worlds, vehicle)[rows]
        return command

    def _next_worlds(self, count: int) -> Worlds:
        if self._pool is None or self._pool_next + count > self._pool.n:
            size = max(count, _SAMPLED_AT_ONCE)
            kept = 0 if self._pool is None else self._pool.n - self._pool_next
            first = self._drawn - kept
            sample = self.scenario.sample(size, self.seed, first=first, channel="training")
            self.rejected += sample.rejected
            self._pool, self._pool_next, self._drawn = sample.worlds, 0, first + size
        rows = np.arange(self._pool_next, self._pool_next + count)
        self._pool_next += count
        return self._pool.take(rows)


@compiled
def next_times(
    index: Ints, last: Ints, start_s: Floats, ended: Bools, time_s: Floats, time_step_s: float, horizon_s: float
) -> tuple[Ints, Floats]:
    """Number of the coming step and its end, [n]; the last step ends exactly at the horizon, ended worlds stay."""
    coming, until = index.copy(), time_s.copy()
    for k in range(index.shape[0]):
        if not ended[k]:
            coming[k] += 1
            until[k] = horizon_s if coming[k] >= last[k] else start_s[k] + coming[k] * time_step_s
    return coming, until


@compiled
def episode_ends(
    speeds: Floats, command: Floats, impacts: Ints, ended: Bools, at_horizon: Bools
) -> tuple[Bools, Bools, Bools]:
    """Which running episodes terminate (at rest, nobody drives), are truncated, and end without a collision, [n]."""
    n, vehicles = speeds.shape
    terminated, truncated, safe = np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    for k in range(n):
        if ended[k]:
            continue
        at_rest = True
        for i in range(vehicles):
            at_rest = at_rest and speeds[k, i] == 0.0 and command[k, i] <= 0.0
        terminated[k] = at_rest
        truncated[k] = at_horizon[k] and not at_rest
        if terminated[k] or truncated[k]:
            safe[k] = True
            for p in range(vehicles - 1):
                safe[k] = safe[k] and impacts[k, p] == 0
    return terminated, truncated, safe


def _assign_ledger(ledger: Ledger, rows: Ints, fresh: Ledger) -> Ledger:
    """The ledger with ``rows`` replaced."""
    first, total, count, mass = (
        ledger.first_impact_harm.copy(), ledger.total_harm.copy(), ledger.count.copy(), ledger.mass_t.copy(),
    )  # fmt: skip
    first[rows], total[rows] = fresh.first_impact_harm, fresh.total_harm
    count[rows], mass[rows] = fresh.count, fresh.mass_t
    return Ledger(first, total, count, mass)
