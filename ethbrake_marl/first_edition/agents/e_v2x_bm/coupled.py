"""Coupled E-V2X-BM: the constant deceleration of one vehicle with the least harm in a simulation of the whole line.

The closed form in the module ``pairwise`` ignores that pairs influence each other. For every deceleration that it
tries, this module simulates the motion up to the horizon, with the speed changes of impacts, later impacts and lasting
contact. Therefore the predicted harm is the harm that really happens in the engine, and the shield uses the predicted
harm as a bound. docs/evaluate.md says how close the predicted harm comes to the true minimum.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, renumbered
from ethbrake_marl.first_edition.agents.e_v2x_bm.constants import make_line
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import (
    CANDIDATES,
    closed_form,
    find_breakpoints,
    onset_s,
    optimise_pairwise,
)
from ethbrake_marl.first_edition.agents.e_v2x_bm.search import make_room, search_line
from ethbrake_marl.first_edition.agents.protocol import Agent, Source, fixed_commands
from ethbrake_marl.first_edition.agents.registry import variants_of
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.engine.memory import Memory, is_state_free
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.jit import by_parts, compiled
from ethbrake_marl.first_edition.physics.messages import LOOK_AHEAD, refuse_untold
from ethbrake_marl.first_edition.physics.rows import FLAG
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

_MANY = 200  # smallest number of worlds for which a search is cached and uses several threads

_REMEMBERED = 32  # number of cached searches; every shield in the same worlds repeats the search of the baseline

_FOUND: dict[bytes, Floats] = {}  # cache: SHA-256 of the arguments of a search -> result of the search


class CoupledOptimum(NamedTuple):
    """Result of ``optimise_coupled``: the best constant deceleration of one vehicle in each of n worlds."""

    deceleration_mps2: Floats  # [n] best deceleration a*, in [0, braking capacity]
    harm: Floats  # [n] harm with a* under the harm count that was minimised (m2/s2)
    first_impact_harm: Floats  # [n] first-impact harm with a* (m2/s2)
    total_harm: Floats  # [n] total harm with a* (m2/s2)


def optimise_coupled(
    worlds: Worlds,
    vehicle: int,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    others_mps2: Floats | None = None,
) -> CoupledOptimum:
    """Return, for each world, the constant deceleration of ``vehicle`` with the least harm in a simulation.

    If the deceleration of the closed form (``optimise_pairwise``) does no harm in a simulation, this deceleration is
    the result. Otherwise the search simulates evenly spaced decelerations and the breakpoints of the closed form. As a
    function of the deceleration, the harm may jump where the number of impacts changes. The jumps and local minima with
    the least harm are located to 1e-9 m/s2; at a jump the result lies on the side with less harm. If several
    decelerations have the least harm, those with the least harm under the other harm count remain, and the middle one
    of these is the result. The result for a world does not depend on the other worlds.

    Args:
        worlds: n worlds of N vehicles.
        vehicle: index of the controlled vehicle (0 = front).
        harm_count: harm to minimise: ``first`` (first-impact harm) or ``total`` (total harm).
        horizon_s: time at the end of the simulations, s since the alert.
        others_mps2: constant commands of the other vehicles, [n, N] m/s2; the controlled vehicle's column is ignored.
            None: all other vehicles brake fully.

    Raises ``InvalidInput`` for an unknown ``vehicle`` or ``harm_count``, and for commands beyond a vehicle's capacity.
    Raises ``PhysicsError``, which names the worlds, if a deceleration could not be simulated.

    """
    check_harm_count(harm_count)
    capacity = worlds.vehicles.braking_capacity_mps2
    command = -capacity if others_mps2 is None else np.array(others_mps2, dtype=np.float64)
    # The closed form assumes that the other vehicles brake with full capacity, so their capacity is set to their
    # command. It cannot represent a vehicle that coasts or drives; the capacity of such a vehicle is not changed.
    braking = np.where(command < 0.0, -command, capacity)
    braking[:, vehicle] = capacity[:, vehicle]
    closed_form_worlds = replace(worlds, vehicles=replace(worlds.vehicles, braking_capacity_mps2=braking))
    best = closed_form(closed_form_worlds, vehicle).deceleration_mps2  # only a first guess if brakes build up
    command[:, vehicle] = -best
    _, impacts = advance(worlds, command, until_s=horizon_s)
    first = impacts.first_impact_harm.sum(axis=1) + impacts.obstacle_first_harm
    total = impacts.total_harm.sum(axis=1) + impacts.obstacle_total_harm
    hit = np.flatnonzero(total > 0.0)
    if hit.size:
        optimum = _minimise(worlds, closed_form_worlds, command, vehicle, hit, harm_count, horizon_s)
        harms = (first, total) if harm_count == "first" else (total, first)
        for column, values in zip((best, *harms), optimum, strict=True):
            column[hit] = values
    return CoupledOptimum(best, first if harm_count == "first" else total, first, total)


def _minimise(
    worlds: Worlds, told: Worlds, command: Floats, vehicle: int, rows: Ints, harm_count: HarmCount, horizon_s: float
) -> Floats:
    """Return the best deceleration and its harm under both counts in the m worlds with the indices ``rows``, [3, m].

    The results are those of ``search.search_line``. ``command`` [n, N] m/s2 are the constant commands of all vehicles;
    the controlled vehicle's column is ignored. ``told`` are the same worlds with other braking capacities, because the
    closed form assumes full braking: the capacity of each braking vehicle except ``vehicle`` is replaced by the
    deceleration in ``command``.
    """
    v = worlds.vehicles
    lines = (
        worlds.gaps_m, worlds.speeds_mps, worlds.time_s, worlds.pair_hit, worlds.obstacle_gap_m, worlds.obstacle_hit,
        command, told.vehicles.braking_capacity_mps2, onset_s(worlds, vehicle), v.latency_s, v.mass_t,
        v.speed_limit_mps, worlds.command_mps2, v.brake_rate_mps3, v.release_rate_mps3, v.pieces, v.restitution,
    )  # fmt: skip
    question = hashlib.sha256(repr((vehicle, harm_count, horizon_s, worlds.speeds_mps.shape)).encode())
    for column in (rows, *lines):
        question.update(np.ascontiguousarray(column).tobytes())
    key = question.digest()
    if key in _FOUND:
        return _FOUND[key].copy()

    def search(part: slice) -> tuple[Floats, Ints]:
        some = rows[part]
        result, status = np.empty((3, some.size)), np.empty(some.size, np.int64)
        _search_worlds(*lines, vehicle, some, harm_count == "total", horizon_s, result, status)
        return result, status

    parts = by_parts(search, rows.size, (os.cpu_count() or 1) if rows.size >= _MANY else 1)
    result, status = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    if (status != FLAG.DONE).any():
        with renumbered(rows):
            raise FLAG.failure(status, worlds.time_s[rows], np.full(rows.size, horizon_s))
    if rows.size >= _MANY:
        _FOUND[key] = result.copy()
        for old in list(_FOUND)[:-_REMEMBERED]:
            _FOUND.pop(old, None)
    return result


@compiled
def _search_worlds(
    gaps: Floats, speeds: Floats, time: Floats, hit: Bools, obstacle: Floats, obstacle_hit: Bools, command: Floats,
    capacity: Floats, onset: Floats, latency: Floats, mass: Floats, limit: Floats, in_force: Floats, brake_rate: Floats,
    release_rate: Floats, pieces: Floats, restitution: Floats, vehicle: int, rows: Ints, total: bool, horizon: float,
    found: Floats, status: Ints,
) -> None:  # fmt: skip
    """Search for the best deceleration of ``vehicle`` in the m worlds with the indices ``rows``.

    ``found`` [3, m] receives the three results of ``search.search_line``, and ``status`` [m] its status codes.
    ``capacity`` [n, N] are the braking capacities (m/s2), and ``onset`` [n, N] are the times from now until each
    vehicle may brake (s). The other arguments are as in ``constants.make_line``, with a new first axis for the n
    worlds.
    """
    room, at, best = make_room(), np.empty(CANDIDATES), np.empty(3)
    for m in range(rows.shape[0]):
        k = rows[m]
        line = make_line(
            gaps[k], speeds[k], hit[k], obstacle[k], obstacle_hit[k], command[k], latency[k], mass[k], limit[k],
            in_force[k], brake_rate[k], release_rate[k], pieces[k], time[k], restitution[k], horizon, vehicle, total,
        )  # fmt: skip
        find_breakpoints(at, vehicle, gaps[k], speeds[k], capacity[k], onset[k])
        status[m] = search_line(line, room, at, capacity[k, vehicle], best)
        for c in range(3):
            found[c, m] = best[c]


Mode = Literal["coupled", "pairwise"]


class EV2XBM:
    """Agent that brakes with the constant deceleration a* that is predicted to do the least harm.

    Args:
        mode: ``coupled`` minimises the harm in a simulation of the whole line, and assumes that the other vehicles
            follow their scripts, and that vehicles without a script (learners) brake fully. ``pairwise`` is the paper's
            closed form, which assumes that all other vehicles brake fully and that impacts change no speed.
        harm_count: harm that mode ``coupled`` minimises: ``first`` (first-impact harm) or ``total`` (total harm).
        horizon_s: time at the end of the simulations in mode ``coupled``, s since the alert.

    The agent's memory contains ``deceleration_mps2`` [n], which is a*, and ``predicted_harm`` [n] (m2/s2), which is the
    harm predicted for a*. The constructor raises ``InvalidInput`` for an unknown mode or harm count. In mode
    ``coupled``, ``begin`` raises ``InvalidInput`` if the script of another vehicle has a command that is not fixed at
    the alert.

    """

    def __init__(self, mode: Mode = "coupled", *, harm_count: HarmCount = "first", horizon_s: float = 8.0) -> None:
        if mode not in ("coupled", "pairwise"):
            raise InvalidInput(f"e_v2x_bm: mode = {mode!r}: must be 'coupled' or 'pairwise'")
        check_harm_count(harm_count)
        self.name = "e_v2x_bm" if mode == "coupled" else "e_v2x_bm:pairwise"
        self.knows = Source.MODEL if mode == "coupled" else Source.STATE
        self._mode, self._harm_count, self._horizon_s = mode, harm_count, horizon_s

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Choose the best deceleration a* of each world at the alert, and return the agent's memory."""
        if self._mode == "pairwise":
            refuse_untold(alert, [vehicle], f"agent {self.name!r}", LOOK_AHEAD[:-1])  # needs no masses
            closed = optimise_pairwise(alert, vehicle)
            return {"deceleration_mps2": closed.deceleration_mps2, "predicted_harm": closed.harm}

        def is_fixed(script: Script) -> bool:
            """Return whether the script's command is fixed at the alert and does not depend on ``vehicle``."""
            chooses_first = isinstance(script, EV2XBM) and (script._mode == "pairwise" or vehicle not in scripts)
            return is_state_free(script) or chooses_first

        others = fixed_commands(
            scripts, alert, f"agent {self.name!r}", vehicle=vehicle, is_fixed=is_fixed,
            advice=f", or only after vehicle_{vehicle + 1} chose; use e_v2x_bm:pairwise, which does not need the other"
            " vehicles' commands, for one of the two vehicles",
        )  # fmt: skip
        coupled = optimise_coupled(
            alert, vehicle, harm_count=self._harm_count, horizon_s=self._horizon_s, others_mps2=others
        )
        return {"deceleration_mps2": coupled.deceleration_mps2, "predicted_harm": coupled.harm}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the command ``-a*`` [n] m/s2, where a* was chosen at the alert, and the unchanged memory."""
        return -memory["deceleration_mps2"], memory


def make_e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    """Make E-V2X-BM in the mode ``argument`` (None: ``coupled``), with horizon and harm count of ``settings``."""
    if argument not in (None, "coupled", "pairwise"):
        then = "".join(f", then {variant!r}" for variant in variants_of("e_v2x_bm"))
        raise InvalidInput(f"agent {settings.spec!r}: after the first colon, write 'coupled' or 'pairwise'{then}")
    mode: Mode = "pairwise" if argument == "pairwise" else "coupled"
    return EV2XBM(mode, harm_count=settings.harm_count, horizon_s=settings.horizon_s)
