"""Facts about each world that hold for any agent: avoidable contact, a lower bound on harm, and the best known harm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.extensions.search.shipped import best_known
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.physics.motion import stopping_distances
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.first_edition.scenario.task import Task

_VEHICLES, _DRIVEN = 3, 1

_DECIDED = ({1}, {1, 2})  # indices of the controlled vehicles, of three, for which ``avoidability`` is proven


class IncompleteTable(UserWarning):
    """Warning that a table of best known harm covers only some of the worlds of an evaluation."""


@dataclass(frozen=True, slots=True)
class Unproven:
    """Result of ``prove`` and ``known_limits`` if the proofs do not cover some of the worlds."""

    because: str  # the reason, such as "brakes build up; the proofs assume instant brakes"


@dataclass(frozen=True, slots=True)
class Proof:
    """Proven facts about each world, as arrays [n]."""

    avoidable: Bools | None  # True if some command avoids all contact; None if that is not known
    reason: NDArray[np.str_] | None  # reason if unavoidable: "early", "front" or "rear"; "" if avoidable
    harm: Floats | None  # lower bound on the harm of any command, under either count (m2/s2); None: nothing is proven

    @property
    def impact(self) -> Bools | None:
        """True for worlds in which no commands avoid an impact, [n]; None: nothing is proven."""
        return None if self.harm is None else np.asarray(self.harm > 0.0, np.bool_)

    @property
    def contact(self) -> Bools | None:
        """True for worlds in which all commands lead to contact, [n]; None if that is not known."""
        return None if self.avoidable is None else ~self.avoidable


@dataclass(frozen=True, slots=True)
class Limits:
    """Proofs and best known harm of each world, as arrays [n], before any agent drives."""

    proof: Proof  # the proven facts
    # best known first-impact harm (m2/s2): 0 if contact is avoidable, else from a table; NaN if in no table
    first_impact_harm: Floats
    total_harm: Floats  # best known total harm (m2/s2), likewise

    @property
    def known(self) -> Bools:
        """True for worlds with a best known harm under both harm counts, [n]."""
        return np.isfinite(self.first_impact_harm) & np.isfinite(self.total_harm)

    @property
    def warning(self) -> str:
        """Warning text if a table contains the best known harm of only some of the worlds; otherwise empty."""
        known, avoidable = self.known, self.proof.avoidable
        listed = known if avoidable is None else known & ~avoidable
        missing = int((~known).sum())
        if not (missing and listed.any()):
            return ""
        return (
            f"the table of best known harm contains {listed.sum():,} of the {len(known):,} worlds. The best known harm"
            f" of {count_of(missing, 'world')} ({100.0 * missing / len(known):.1f} %) is missing; the least harm of the"
            " agents of this evaluation replaces it. Regrets are therefore lower bounds, and the share of the possible"
            " reduction is omitted. A table is made for one list: to make a table for this list, call search_list"
        )


def known_limits(worlds: Worlds, task: Task) -> Limits | Unproven:
    """Return the proven facts and the best known harm of worlds at the alert.

    Returns ``Unproven`` if the proofs do not cover ``task``.
    """
    proof = prove(worlds, task)
    if isinstance(proof, Unproven):
        return proof
    limits = best_known(worlds, task)
    avoidable = np.zeros(worlds.n, np.bool_) if proof.avoidable is None else proof.avoidable
    first, total = (np.where(avoidable, 0.0, limits[harm_count]) for harm_count in HARM_COUNTS)
    return Limits(proof, first, total)


def prove(worlds: Worlds, task: Task) -> Proof | Unproven:
    """Return what is proven about each world at the alert: whether contact is avoidable, and a lower bound on harm.

    The bound covers one controlled vehicle with brakes that act at once and a free road ahead. Returns ``Unproven`` if
    the proofs do not cover ``task``.
    """
    because = unproven_because(worlds, task)
    if because is not None:
        return Unproven(because)
    if undecided_because(worlds, task) is not None:
        return Proof(None, None, None)
    if len(task.vehicles) > 1 or np.isfinite(worlds.obstacle_gap_m).any():
        contact = avoidability(worlds, _DRIVEN)
        return Proof(contact.avoidable, contact.reason_name, None)
    bound = lower_bound(worlds, task.vehicle, horizon_s=task.scenario.horizon_s, time_step_s=task.scenario.time_step_s)
    return Proof(bound.contact.avoidable, bound.contact.reason_name, bound.harm)


def unproven_because(worlds: Worlds, task: Task) -> str | None:
    """Return, as a clause, the reason why the limits do not cover ``task``; None if they do."""
    if worlds.vehicles.in_pieces.any() or (_is_team(task) and worlds.vehicles.build_up.any()):
        return _uneven_because(worlds)
    if not _is_team(task):
        return _uncovered_because(worlds, task)
    return _script_because(task, "the best known harm holds")


def undecided_because(worlds: Worlds, task: Task) -> str | None:
    """Return, as a clause, the reason why avoidability of contact is unknown; None if it is known.

    ``worlds`` must be at the alert.
    """
    return _uneven_because(worlds) if worlds.vehicles.build_up.any() else _uncovered_because(worlds, task)


def _uncovered_because(worlds: Worlds, task: Task) -> str | None:
    """Return, as a clause, the reason why the proof ``avoidability`` does not cover ``task``; None if it does.

    The proof assumes that brakes act at once; the function does not check this.
    """
    scenario, names = task.scenario, task.scenario.vehicle_names
    if not task.vehicles or (len(task.vehicles) > 1 and set(task.vehicles) not in _DECIDED):
        return f"the controlled vehicles are {task.names}; avoidability is proven for one controlled vehicle"
    if scenario.vehicles != _VEHICLES:
        return f"the line has {scenario.vehicles} vehicles; avoidability is proven for {_VEHICLES} vehicles"
    if set(task.vehicles) not in _DECIDED:
        return f"the controlled vehicle is {task.names}; avoidability is proven for {names[_DRIVEN]}"
    because = _script_because(task, "avoidability is proven")
    if because is not None:
        return because
    latency_s = worlds.vehicles.latency_s
    first = (each[:, 0] for each in (worlds.vehicles.braking_capacity_mps2, worlds.vehicles.brake_rate_mps3))
    way_m = stopping_distances(worlds.speeds_mps[:, 0], latency_s[:, 0], *first)
    if not (way_m < worlds.obstacle_gap_m).all():
        return "vehicle_1 reaches the obstacle although it brakes; avoidability is proven where it stops in time"
    if (latency_s[:, 0] > latency_s[:, _DRIVEN]).any():
        return f"{names[0]} may brake later than {names[_DRIVEN]}; avoidability is proven where it brakes first"
    return None


def _uneven_because(worlds: Worlds) -> str:
    if worlds.vehicles.in_pieces.any():
        return "a vehicle brakes with a profile of several decelerations; the proofs assume one"
    return "brakes build up; the proofs assume instant brakes"


def _is_team(task: Task) -> bool:
    """Return True for several controlled vehicles, or for one in a line of more than three vehicles."""
    return len(task.vehicles) > 1 or (len(task.vehicles) == 1 and task.scenario.vehicles > _VEHICLES)


def _script_because(task: Task, proven: str) -> str | None:
    """Return a clause that names a vehicle with a script other than full_brake; None if there is no such vehicle.

    ``proven`` says what is proven if the vehicle follows full_brake, for instance "avoidability is proven".
    """
    scenario = task.scenario
    for i in range(scenario.vehicles):
        script = scenario.scripts.get(i, "full_brake")
        if i not in task.vehicles and script != "full_brake":
            return f"{scenario.vehicle_names[i]} follows the script {script}; {proven} where it follows full_brake"
    return None
