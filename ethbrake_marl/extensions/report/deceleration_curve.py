"""Harm of one world against the constant deceleration of one vehicle: predicted, realised, and the best known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_harm
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.search.best_harm import scripted_commands
from ethbrake_marl.extensions.search.limits import Limits, Unproven, known_limits
from ethbrake_marl.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.forecast import forecast
from ethbrake_marl.physics.state import Floats, Worlds, make_worlds
from ethbrake_marl.scenario.task import Task

POINTS = 2001  # evenly spaced decelerations; the breakpoints of the closed form come on top

_LONG_S = 1e4  # whoever still coasts has met or will never meet


@dataclass(frozen=True, slots=True)
class Choice:
    """A constant deceleration that E-V2X-BM takes in the world, and the harm that it minimises there (m2/s2)."""

    deceleration_mps2: float
    harm: float


@dataclass(frozen=True, slots=True)
class DecelerationCurve:
    """Harm (m2/s2) of one world at K constant decelerations of one vehicle, in rising order."""

    task: Task  # its one vehicle has the deceleration
    world: Worlds  # n = 1, at the alert
    deceleration_mps2: Floats  # [K] from 0 to the braking capacity
    predicted: Floats  # [K] pairwise, in closed form
    first_impact_harm: Floats  # [K] realised
    total_harm: Floats  # [K] realised
    regimes: dict[str, NDArray[np.str_]]  # per pair of the vehicle ("front pair", "rear pair"): [K] how it first meets
    closed_form: Choice  # its harm is the predicted one
    coupled: Mapping[HarmCount, Choice]  # minimising either count in the simulation
    limits: Limits | Unproven  # what is known of the world over all time-varying commands

    def harm(self, harm_count: HarmCount) -> Floats:
        """The realised harm under a counting rule, [K] m2/s2."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm


def deceleration_curve(world: Worlds, task: Task, *, points: int = POINTS) -> DecelerationCurve:
    """The three harms of one world at evenly spaced decelerations of the vehicle, and at those of the closed form.

    The prediction lets all others brake fully; in the simulation they follow the scenario's scripts. Raises
    ``InvalidInput`` unless there is exactly one world, ``points`` is at least 2 and every script is fixed at the alert.
    """
    if world.n != 1:
        raise InvalidInput(f"deceleration curve: {world.n} worlds given; exactly one is drawn")
    if not points >= 2:
        raise InvalidInput(f"deceleration curve: points = {points}; at least 2 are needed")
    scenario, vehicle = task.scenario, task.vehicle
    capacity = float(world.vehicles.braking_capacity_mps2[0, vehicle])
    pairwise = optimise_pairwise(world, vehicle)
    chosen = pairwise.deceleration_mps2
    special = np.append(pairwise.breakpoints_mps2[0], chosen)
    at = np.union1d(np.linspace(0.0, capacity, points), special)
    others = scripted_commands(world, task)
    first, total = forecast(world, others, vehicle, -at[None, :], scenario.horizon_s)
    deceleration = np.repeat(world.vehicles.braking_capacity_mps2, at.size, axis=0)
    deceleration[:, vehicle] = at
    copies = world.take(np.zeros(at.size, np.int64))
    contacts = pairwise_harm(copies, deceleration)
    pairs = {"front pair": vehicle - 1, "rear pair": vehicle}
    own = {name: p for name, p in pairs.items() if 0 <= p < world.N - 1}
    regimes = {name: regimes_of(copies, p, deceleration) for name, p in own.items()}
    predicted = contacts[:, list(own.values())].sum(axis=1)
    coupled = {}
    for rule in HARM_COUNTS:
        best = optimise_coupled(world, vehicle, harm_count=rule, horizon_s=scenario.horizon_s, others_mps2=others)
        coupled[rule] = Choice(float(best.deceleration_mps2[0]), float(best.harm[0]))
    closed_form = Choice(float(chosen[0]), float(predicted[np.searchsorted(at, chosen[0])]))
    return DecelerationCurve(
        task, world, at, predicted, first[0], total[0], regimes, closed_form,
        coupled, known_limits(world, task),
    )  # fmt: skip


def regimes_of(worlds: Worlds, pair: int, deceleration_mps2: Floats) -> NDArray[np.str_]:
    """How one pair, alone, first meets under constant decelerations [n, N] from now (t = 0) on, [n].

    ``A``, ``A'``, ``B`` or ``C`` as in docs/proofs/constant-deceleration.md, ``early``: before the pair's leader
    brakes, or ``none``.
    """
    own = slice(pair, pair + 2)
    v = worlds.vehicles
    alone = make_worlds(
        worlds.gaps_m[:, [pair]], worlds.speeds_mps[:, own], braking_capacity_mps2=v.braking_capacity_mps2[:, own],
        driving_capacity_mps2=0.0, latency_s=v.latency_s[:, own], mass_t=1.0, restitution=0.0,
        speed_limit_mps=v.speed_limit_mps[:, own],
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):  # when each would stand; inf without braking
        speed = worlds.speeds_mps[:, own]
        stop_s = np.where(speed > 0.0, v.latency_s[:, own] + speed / deceleration_mps2[:, own], 0.0)
    rows = advance(alone, -deceleration_mps2[:, own], until_s=_LONG_S, record=True)[1].rows
    assert rows is not None
    meets_s = np.full(worlds.n, np.inf)
    meets_s[rows.world[rows.first]] = rows.time_s[rows.first]
    coasting, stands = meets_s <= v.latency_s[:, pair + 1], meets_s >= stop_s[:, 0]
    cases = [np.isinf(meets_s), meets_s < v.latency_s[:, pair], coasting & stands, coasting, stands]
    return np.select(cases, ["none", "early", "A'", "A", "C"], "B")
