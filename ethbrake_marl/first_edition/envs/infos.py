"""Infos of all environments. The dictionary ``info`` has the same keys after a reset and after a step:

- ``time_s``: time since the alert (s).
- ``command_in_force_mps2``: command that the vehicle executes (m/s2); 0 until the vehicle's latency has elapsed.
- ``chosen_command_mps2``, ``chosen_action``: command (m/s2) and action that the vehicle's policy, the caller or the
  vehicle's script has chosen last; 0 before a learner's first step.
- ``first_impact_harm``, ``total_harm``: harm that the vehicle has borne so far (m2/s2).
- ``world_first_impact_harm``, ``world_total_harm``: harm of the whole line so far (m2/s2).
- ``collided``: whether an impact has happened in this world.
- ``cost``: harm that the last step added to the whole line (m2/s2); 0 after a reset. It is first-impact harm or total
  harm, whichever the reward uses.
- ``reward_NAME``: value of the reward term ``NAME`` in the last step, before it is weighted; 0 after a reset.
- ``world_seed``, ``world``: seed and number of the world. The number is -1 if the caller passed the world.
- ``known_from_s`` [N], only with a ``v2x`` channel: time from which this vehicle acts on news of each vehicle (s;
  infinite: never). The entry for this vehicle itself is its latency.
- ``age_s`` [N], only with periodic messages: age of the newest data received from each vehicle (s; infinite: none).
- ``shield_NAME``, only with a shield: the shield's info ``NAME``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.compiled_step import Step
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.draws import Columns, describe_worlds
from ethbrake_marl.first_edition.envs.making import (
    INITIAL_STATE,
    LISTED_WORLD,
    chosen_seed,
    wanted_worlds,
    warn_of_unknown,
)
from ethbrake_marl.first_edition.envs.viewer import Viewer
from ethbrake_marl.first_edition.game.actions import action_of
from ethbrake_marl.first_edition.game.harm import front_share
from ethbrake_marl.first_edition.physics.columns import Packed, columns
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.messages import Messages
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

COLUMNS = (
    "time_s",
    "command_in_force_mps2",
    "first_impact_harm",
    "total_harm",
    "world_first_impact_harm",
    "world_total_harm",
    "collided",
    "chosen_command_mps2",
    "chosen_action",
)

_FLOAT32 = np.dtype(np.float32)


def shield_columns(engine: Engine, rows: Ints | None = None) -> Columns:
    """Return a mapping from ``shield_NAME`` to the shield's info ``NAME``, [n, N]; it is empty without a shield.

    ``rows`` are the indices of the worlds whose infos are returned; None: all worlds.
    """
    if engine.guard is None or engine.guarded is None:
        return {}
    every = slice(None) if rows is None else rows
    return {f"shield_{name}": column[every] for name, column in engine.guard.report(engine).items()}


def plain_rows(columns: Columns, vehicles: Ints, count: int) -> list[dict[str, Any]]:
    """Return one dictionary of plain values for each world and vehicle, such as ``{"time_s": 0.5, "collided": 0.0}``.

    The list begins with the dictionaries for the vehicles of the first world. ``columns`` maps the name of an info to
    its values, [n, N]. ``vehicles`` are the indices of the vehicles whose infos are returned. If ``columns`` is empty,
    the result is a list of ``count`` empty dictionaries.
    """
    values = [column.take(vehicles, axis=1).reshape(-1).tolist() for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)] or [{} for _ in range(count)]


class Report(NamedTuple):
    """Values of all infos at one moment, for n worlds of N vehicles."""

    values: Floats  # [n, N, len(COLUMNS)] values of the infos in COLUMNS, in the same order
    cost: Floats  # [n] harm that the last step added to the line (m2/s2); 0 after a reset
    terms: dict[str, Floats]  # name of a reward term -> its value in the last step, [n] or [n, N]; 0 after a reset
    world_seed: int  # seed of the worlds
    world: Ints  # [n] number of each world among the worlds of this seed
    known_from_s: Floats | None  # [n, N, N] time from which vehicle i may use news of vehicle j (s); None: no channel
    age_s: Floats | None  # [n, N, N] age of vehicle i's newest sample of vehicle j (s); None: no periodic messages
    shield: Columns  # name of an info of the shield -> values [n, N]; empty without a shield

    @classmethod
    def of(cls, engine: Engine, step: Step | None = None, rows: Ints | None = None) -> Report:
        """Return the values of all infos at the present moment in an engine's worlds.

        After a step, call this method before new episodes start in the worlds whose episodes have ended.

        Args:
            engine: the engine.
            step: results of the last step; None after a reset.
            rows: indices of the worlds whose infos are returned; None: all worlds.

        """
        now, world = engine.state, engine.roster.numbers
        motion, params, wanted = now.motion, now.params, now.wanted
        if rows is not None:
            motion, params, wanted = (array.take(rows, axis=0) for array in (motion, params, wanted))
            world = world.take(rows)
        values = np.empty((*wanted.shape, len(COLUMNS)))
        _report_rows(motion, params, wanted, values)
        N = wanted.shape[1]
        shown = Packed(motion, params)
        known = shown.known_from_s if shown.has_news else None
        cost = np.zeros(len(world))
        terms = dict.fromkeys(engine.reward_terms, cost)
        if step is not None:
            every = step.terms
            terms = {name: every[name] for name in engine.reward_terms}
            cost = step.counted_harm
            if rows is not None:
                cost, terms = cost.take(rows), {name: term.take(rows, axis=0) for name, term in terms.items()}
        time_s, messages = motion[:, shown.column.time], params[:, shown.column.messages :]
        age = Messages(messages, N).age_s(time_s) if shown.has_messages else None
        return cls(values, cost, terms, engine.roster.seed, world, known, age, shield_columns(engine, rows))

    def columns(self) -> dict[str, Floats]:
        """Return a mapping from the name of each info in ``COLUMNS`` to its values, [n, N]."""
        return {name: self.values[:, :, c] for c, name in enumerate(COLUMNS)}

    def plain_infos(self, vehicles: Ints) -> list[dict[str, Any]]:
        """Return one dictionary of infos for each world and each vehicle in ``vehicles`` (indices).

        The list begins with the dictionaries for the first world. The values are plain numbers, except the arrays
        ``chosen_action`` [1], ``known_from_s`` [N] and ``age_s`` [N].
        """
        worlds: list[list[list[Any]]] = self.values.take(vehicles, axis=1).tolist()
        numbers, costs = self.world.tolist(), self.cost.tolist()
        terms = {
            f"reward_{name}": (
                term[:, np.newaxis].repeat(len(vehicles), axis=1) if term.ndim == 1 else term[:, vehicles]
            ).tolist()
            for name, term in self.terms.items()
        }
        infos: list[dict[str, Any]] = []
        for k, world in enumerate(worlds):
            for v, (time, force, first, total, world_first, world_total, collided, chosen, action) in enumerate(world):
                chosen_action = np.empty(1, _FLOAT32)
                chosen_action[0] = action
                info = {
                    "time_s": time,
                    "command_in_force_mps2": force,
                    "first_impact_harm": first,
                    "total_harm": total,
                    "world_first_impact_harm": world_first,
                    "world_total_harm": world_total,
                    "collided": collided == 1.0,
                    "chosen_command_mps2": chosen,
                    "chosen_action": chosen_action,
                    "cost": costs[k],
                    "world_seed": self.world_seed,
                    "world": numbers[k],
                }
                infos.append(info | {name: term[k][v] for name, term in terms.items()})
        for name, news in (("known_from_s", self.known_from_s), ("age_s", self.age_s)):
            if news is not None:
                of_these = news.take(vehicles, axis=1)
                for info, row in zip(infos, of_these.reshape(-1, of_these.shape[2]), strict=True):
                    info[name] = row.copy()
        for info, of_shield in zip(infos, plain_rows(self.shield, vehicles, len(infos)), strict=True):
            info |= of_shield
        return infos

    def batch_info(self, vehicle: int, rows: Bools, stepped: Bools) -> dict[str, Any]:
        """Return the infos of one vehicle (index) in all n worlds, in the format of Gymnasium's vector environments.

        The result contains two arrays for each info, for example ``time_s`` [n] and ``_time_s`` [n]. ``_time_s`` is
        ``rows`` [n], which is true for the worlds in which ``time_s`` has a value. ``stepped`` [n] is true for each
        world in which the last step belongs to the running episode, not to the episode before it; in all other worlds
        ``cost`` and the reward terms are 0.
        """
        columns: dict[str, NDArray[Any]] = {name: info[:, vehicle] for name, info in self.columns().items()}
        columns["collided"] = columns["collided"] == 1.0
        columns["chosen_action"] = columns["chosen_action"].astype(np.float32)[:, np.newaxis]
        columns["cost"] = np.where(stepped, self.cost, 0.0)
        columns["world_seed"], columns["world"] = np.full(len(rows), self.world_seed), self.world
        for name, term in self.terms.items():
            columns[f"reward_{name}"] = np.where(stepped, term if term.ndim == 1 else term[:, vehicle], 0.0)
        if self.known_from_s is not None:
            columns["known_from_s"] = self.known_from_s[:, vehicle]
        if self.age_s is not None:
            columns["age_s"] = self.age_s[:, vehicle]
        columns |= {name: column[:, vehicle] for name, column in self.shield.items()}
        masked: dict[str, Any] = {}
        for name, column in columns.items():
            masked[name] = np.zeros_like(column, order="C")
            masked[name][rows] = column[rows]
            masked[f"_{name}"] = rows.copy()
        return masked


@compiled
def _report_rows(state: Floats, params: Floats, wanted: Floats, out: Floats) -> None:
    """Write the values of the infos in ``COLUMNS`` to ``out``, [n, N, len(COLUMNS)].

    ``state`` and ``params`` are the packed states and parameters of the worlds (``physics.columns``), and ``wanted``
    [n, N] are the chosen commands, m/s2.
    """
    n, N = wanted.shape
    column = columns(state)
    P, harm, mass, obstacle = N - 1, column.harm, column.mass, column.obstacle
    for k in range(n):
        first, total, impacts = 0.0, 0.0, 0.0
        for i in range(N):
            out[k, i, 2] = 0.0
            out[k, i, 3] = 0.0
        if state.shape[1] > obstacle:
            first, total, impacts = state[k, obstacle + 2], state[k, obstacle + 3], state[k, obstacle + 4]
        for p in range(P):
            for count in range(2):
                value = state[k, harm + count * P + p]
                front = front_share(value, params[k, mass + p], params[k, mass + p + 1])
                out[k, p, 2 + count] += front
                out[k, p + 1, 2 + count] += value - front
            first += state[k, harm + p]
            total += state[k, harm + P + p]
            impacts += state[k, harm + 2 * P + p]
        if state.shape[1] > obstacle:  # added after the pairs, in the same order as in the ledger
            out[k, 0, 2] += state[k, obstacle + 2]
            out[k, 0, 3] += state[k, obstacle + 3]
        for i in range(N):
            out[k, i, 0] = state[k, column.time]
            out[k, i, 1] = state[k, column.command + i]
            out[k, i, 4] = first
            out[k, i, 5] = total
            out[k, i, 6] = 1.0 if impacts > 0.0 else 0.0
            out[k, i, 7] = wanted[k, i]
            braking, driving = params[k, column.braking + i], params[k, column.driving + i]
            out[k, i, 8] = action_of(wanted[k, i], braking, driving)


class Begun:
    """Base class of all environments, which starts episodes with a seed and options.

    A subclass sets ``engine`` in its constructor, and calls ``_restart`` in its ``reset``. The worlds of a seed form a
    *stream*: each new episode takes the next world of this seed. ``np_random`` and ``np_random_seed`` have the same
    meaning as in ``gymnasium.Env``.
    """

    engine: Engine  # engine that moves the worlds
    _known_options: Sequence[str] = (INITIAL_STATE, LISTED_WORLD)  # keys that ``options`` of ``reset`` may have
    _started = False  # whether an episode has begun
    _goes_on = False  # whether a reset without a seed continues the current stream
    _np_random: np.random.Generator | None = None
    _np_random_seed: int | None = None  # -1: unknown, because the user set the generator

    @property
    def np_random(self) -> np.random.Generator:
        """Random generator that wrappers may use. The worlds depend on ``np_random_seed`` only.

        If you set another generator, each ``reset`` without a seed draws a new seed from your generator. The next
        ``reset`` with a seed replaces your generator.
        """
        if self._np_random is None:
            self._set_seed(chosen_seed(None))
            assert self._np_random is not None
        return self._np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        if not isinstance(generator, np.random.Generator):
            raise InvalidInput(f"np_random = {generator!r}: must be a numpy.random.Generator")
        self._np_random, self._np_random_seed, self._goes_on = generator, -1, False

    @property
    def np_random_seed(self) -> int:
        """Seed of the stream of worlds: random if no seed was passed; -1 after the user has set ``np_random``."""
        if self._np_random_seed is None:
            self._set_seed(chosen_seed(None))
            assert self._np_random_seed is not None
        return self._np_random_seed

    def _set_seed(self, seed: int) -> None:
        self._np_random, self._np_random_seed = np.random.default_rng(seed), seed

    def _restart(self, seed: int | None, options: Mapping[str, Any] | None) -> None:
        """Start new episodes in all worlds. The method ``reset`` of each environment calls this method.

        With ``options["initial_state"]``, every world starts in this state, which ``scenario.tables.worlds_from_state``
        reads. With ``options["listed_world"] = {"seed": 7, "number": 3}``, the first world is world 3 of the evaluation
        list with seed 7, the second world is world 4, and so on. Later episodes, which start without a call of
        ``reset``, take the next worlds of the stream. For other options a warning ``UnknownResetOption`` is issued, and
        these options are ignored. ``seed`` starts with the first world of this seed; None: continue with the next world
        of the stream.

        Raises ``InvalidInput`` for a seed that is not a whole number >= 0, for an invalid initial state or listed
        world, or if the options contain both an initial state and a listed world. The environment then stays unchanged.
        """
        named = None if seed is None else chosen_seed(seed)
        if not (options is None or isinstance(options, Mapping)):
            raise InvalidInput(
                f"reset: options = {options!r}: must be None or a mapping, for instance {{'{INITIAL_STATE}': ...}}"
            )
        warn_of_unknown(options or (), self._known_options)
        self._begin(named, wanted_worlds(self.engine, options or {}))

    def _begin(self, seed: int | None, worlds: Worlds | None) -> None:
        """Start episodes in ``worlds`` (at the alert), or in the next worlds of the stream if ``worlds`` is None.

        With a ``seed``, a new stream of worlds begins. Without a seed, the current stream continues, unless the user
        has set ``np_random``: then a new stream begins, with a seed that is drawn from ``np_random``.
        """
        drawn, used = seed is None and self._np_random_seed == -1, seed
        if drawn:
            used = int(copy.deepcopy(self.np_random).integers(2**63))  # drawn from a copy, because the reset may fail
        elif seed is None and not self._goes_on:
            used = self.np_random_seed
        self.engine.reset(seed=used, worlds=worlds)
        if drawn:
            self.np_random.integers(2**63)
        elif seed is not None:
            self._set_seed(seed)
        self._started = self._goes_on = True

    def _check_started(self, what: str) -> None:
        if not self._started:
            raise InvalidInput(f"{what}: no episode has started; call reset first")

    def describe_worlds(self) -> Columns:
        """Return what was drawn at random for each running world: a mapping from column names to values [n].

        See ``envs.draws.describe_worlds`` for the columns.
        """
        self._check_started("describe_worlds")
        return describe_worlds(self.engine)


class OneWorld(Begun):
    """Base class of environments with a single world. A subclass sets ``viewer`` in its constructor."""

    viewer: Viewer  # object that draws pictures of the running episode

    def describe_world(self) -> dict[str, Any]:
        """Return what was drawn at random for the running world: a mapping from names to numbers or texts."""
        self._check_started("describe_world")
        return {name: column[0].item() for name, column in describe_worlds(self.engine).items()}

    def render(self) -> Any:
        """Return a picture of the present moment. The type of the picture depends on the render mode:

        ``rgb_array``: a frame [H, W, 3] uint8. ``rgb_array_list``: a list of all frames since the last call of
        ``render``. ``ansi``: a text. ``human``: None, because a window already shows every step.
        """
        return self.viewer.render()

    def close(self) -> None:
        """Close the window of the render mode ``human``, if it is open."""
        self.viewer.close()
