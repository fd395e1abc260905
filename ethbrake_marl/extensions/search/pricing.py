"""Which harm do commands lead to? Profiles of commands, and problems: worlds whose best commands are searched.

A *profile* holds the commands of the controlled vehicles from the first decision to the horizon: K phases, each with
constant commands. Phases begin and end at decisions, so agents can follow a profile, and its predicted harm is the harm
that then happens, to the last bit. B is the number of controlled vehicles.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.counts import (
    HONEST,
    AnyCount,
    HarmCount,
    all_counts,
    amount_so_far,
    conduct_amount,
    pair_amount,
    unshared_amount,
)
from ethbrake_marl.episode.departures import SHOWN
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Declared, objectives_of
from ethbrake_marl.episode.state import END, ENDED, FIRST_DECISION, HORIZON, LAST, STEPS, State, require
from ethbrake_marl.episode.step import advance, first_decision
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.interval import FAILED
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    DRIVING,
    FAR_M,
    FORCE,
    GAP,
    HIT,
    LATENCY,
    LIMIT,
    MASS,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    Floats,
    Ints,
    scratch_for,
)

UInt64s = NDArray[np.uint64]

MOST_PHASES = 12  # of a profile in a search, before every decision is a phase
FEW_ENDS = (
    1,
    2,
    3,
    4,
    6,
    8,
    11,
    14,
    18,
    23,
    30,
)  # decisions at which phases of a shortened profile end, but for the last

# what a search minimises
WHOLE_LINE = 0.0  # harm of the line
WEIGHTED = 1.0  # weighted sum of the vehicles' harm
LARGEST = 2.0  # largest weighted harm of a vehicle


class Profiles(NamedTuple):
    """Profiles of n worlds: in world k, ``commands_mps2[k, j]`` holds until decision ``ends[k, j]``.

    Phases that a profile does not need begin and end at the last step.
    """

    ends: Ints  # [n, K] number of the decision at which each phase ends
    commands_mps2: Floats  # [n, K, B] commands in each phase; negative brakes

    def take(self, rows: Any) -> Profiles:
        return Profiles(self.ends[rows], self.commands_mps2[rows])

    def stepwise(self, decisions: int) -> Floats:
        """Commands at each of the first ``decisions`` decisions, [n, decisions, B] m/s2."""
        phase = (self.ends[:, np.newaxis] <= np.arange(decisions)[:, np.newaxis]).sum(axis=2)
        phase = np.minimum(phase, self.ends.shape[1] - 1)
        return np.take_along_axis(self.commands_mps2, phase[:, :, np.newaxis], 1)

    def shorten(self) -> Profiles:
        """Profiles with ``MOST_PHASES`` phases: the commands at some decisions, each held until the next."""
        ends, commands = Profiles.pad([self], MOST_PHASES)[0]
        fits = ends[:, MOST_PHASES - 1] == ends[:, -1]
        few = np.minimum(np.array([*FEW_ENDS, np.iinfo(np.int64).max]), ends[:, -1:])
        begun = self.stepwise(FEW_ENDS[-1] + 1)[:, [0, *FEW_ENDS]]
        ends = np.where(fits[:, np.newaxis], ends[:, :MOST_PHASES], few)
        return Profiles(ends, np.where(fits[:, np.newaxis, np.newaxis], commands[:, :MOST_PHASES], begun))

    @staticmethod
    def of_steps(commands_mps2: Floats, last_step: Ints) -> Profiles:
        """Profiles with one phase for each of T decisions, from the commands [n, T, B] (m/s2). ``last_step`` [n]."""
        ends = np.minimum(np.arange(1, commands_mps2.shape[1] + 1), last_step[:, np.newaxis])
        return Profiles(ends, np.ascontiguousarray(commands_mps2))

    @staticmethod
    def pad(parts: Sequence[Profiles], least: int = 1) -> list[Profiles]:
        width = max([least, *(part.ends.shape[1] for part in parts)])
        return [
            Profiles(
                np.pad(part.ends, ((0, 0), (0, width - part.ends.shape[1])), mode="edge"),
                np.pad(part.commands_mps2, ((0, 0), (0, width - part.ends.shape[1]), (0, 0)), mode="edge"),
            )
            for part in parts
        ]

    @staticmethod
    def join(parts: Sequence[Profiles]) -> Profiles:
        return Profiles(*(np.concatenate(arrays) for arrays in zip(*Profiles.pad(parts), strict=True)))


def best_of(results: Sequence[tuple[Floats, Profiles]]) -> tuple[Floats, Profiles]:
    """Least of several harms in each world, [n], and its profile, [n]; of equal harms the first."""
    harms = np.stack([harm for harm, _ in results])
    pick, rows = harms.argmin(axis=0), np.arange(harms.shape[1])
    padded_profiles = Profiles.pad([profiles for _, profiles in results])
    return harms[pick, rows], Profiles(*(np.stack(arrays)[pick, rows] for arrays in zip(*padded_profiles, strict=True)))


class Problem(NamedTuple):
    """n worlds in which the best commands of some vehicles are searched. Made by ``problem_of``.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.extensions.search.pricing import problem_of
    >>> scenario, game = eb.open_game("paper-random")
    >>> problem = problem_of(game, scenario.sample(2, seed=7))
    >>> problem.follow(problem.constant(problem.even_grid(3)[:, 1:2])).harm("first")
    array([80.51086128, 64.27142879])
    """

    bodies: Ints  # [B] vehicles that are controlled (1: Vehicle 1)
    state: State  # at the first decision; all other vehicles hold ``wanted``
    time_step_s: float
    harm_count: HarmCount  # what is minimised
    aim: float  # WHOLE_LINE, WEIGHTED or LARGEST
    shares: Floats  # [n, 3, N + 1] weights of what a pair's front and rear vehicle share, and of the rear's own amount
    identity: UInt64s  # [n] hash of everything that decides the harm of a profile (``identities``)

    @property
    def n(self) -> int:
        return self.state.n

    @property
    def last_step(self) -> Ints:
        """Number of decisions from the first one to the horizon, [n]."""
        return self.state.clock[:, LAST].astype(np.int64)

    @property
    def bounds(self) -> Floats:
        """Smallest and largest command of each controlled vehicle, [n, B, 2] m/s2."""
        braking, driving = self.state.braking_capacity_mps2, self.state.driving_capacity_mps2
        return np.ascontiguousarray(np.stack([-braking, driving], axis=2)[:, self.bodies - 1])

    def take(self, rows: Any) -> Problem:
        return self._replace(state=self.state.take(rows), shares=self.shares[rows], identity=self.identity[rows])

    def with_count(self, count: HarmCount) -> Problem:
        return self._replace(harm_count=count)

    def even_grid(self, number: int) -> Floats:
        """Evenly spaced commands from full braking to full driving, [n, number, B] m/s2."""
        low, high = self.bounds[:, np.newaxis, :, 0], self.bounds[:, np.newaxis, :, 1]
        share = np.linspace(0.0, 1.0, number)[:, np.newaxis]
        return np.minimum(low + share * (high - low), high)

    def constant(self, commands_mps2: Floats) -> Profiles:
        """Profiles that hold one of Q commands [n, Q, B] to the end, [n * Q]: first the Q profiles of world 0, and so
        on.

        They have several phases with the same command, which a search can change one by one.
        """
        n, Q, B = commands_mps2.shape
        borders = np.array([2, 5, 9, 14, 20] + (MOST_PHASES - 5) * [np.iinfo(np.int64).max])
        ends = np.minimum(borders, self.last_step[:, np.newaxis])
        commands = np.repeat(commands_mps2.reshape(n * Q, 1, B), MOST_PHASES, axis=1)
        return Profiles(np.repeat(ends, Q, axis=0), commands)

    def coasting(self) -> Profiles:
        return Profiles(self.last_step[:, np.newaxis].copy(), np.zeros((self.n, 1, len(self.bodies))))

    def follow(self, profiles: Profiles) -> State:
        """Last states of episodes whose controlled vehicles follow ``profiles``, with the bits of such agents.

        Raises the errors of ``check``, and ``PhysicsError`` if a check of the physics fails.
        """
        self.check(profiles)
        line, car, clock, know, wanted, memories = self.state
        line, clock, wanted = line.copy(), clock.copy(), wanted.copy()
        failed = np.zeros(self.n, np.bool_)
        ends, commands = np.ascontiguousarray(profiles.ends, np.int64), np.ascontiguousarray(profiles.commands_mps2)
        follow_worlds(
            line, car, clock, wanted, ends, commands, self.bodies, self.time_step_s,
            scratch_for(wanted.shape[1]), failed,
        )  # fmt: skip
        if failed.any():
            raise PhysicsError({k: "its profile could not be simulated" for k in np.flatnonzero(failed).tolist()})
        return State(line, car, clock, know, wanted, memories)

    def value(self, last: State, count: HarmCount | None = None) -> Floats:
        """What the search minimises, for episodes with the last states ``last``, [n] m2/s2."""
        value = np.empty(self.n)
        worths(last.line, self.shares, (count or self.harm_count).weight_array, self.aim, value)
        return value

    def values(self, profiles: Profiles) -> dict[str, Floats]:
        """What the search minimises if the vehicles follow ``profiles``: name of a count of harm -> [n] m2/s2."""
        last = self.follow(profiles)
        return {count.name: self.value(last, count) for count in all_counts(self.harm_count)}

    def with_weights(self, weights: Floats, *, largest: bool = False) -> Problem:
        """Problem of the sum (``largest``: the largest) of the vehicles' harms times ``weights`` [n, N]."""
        mass = self.state.car[:, MASS]
        weights = np.pad(np.broadcast_to(weights, (self.n, mass.shape[1] - 1)), ((0, 0), (1, 0)))
        front = mass[:, 1:] / (mass[:, :-1] + mass[:, 1:])  # 0 of the obstacle, whose mass is infinite
        shares = np.zeros((self.n, 3, mass.shape[1]))
        shares[:, 0, :-1], shares[:, 1, :-1] = weights[:, :-1] * front, weights[:, 1:] * (1.0 - front)
        shares[:, 2, :-1] = weights[:, 1:]
        return self._replace(shares=shares, aim=LARGEST if largest else WEIGHTED)

    def check(self, profiles: Profiles) -> None:
        K, B = profiles.ends.shape[-1], len(self.bodies)
        if profiles.ends.shape != (self.n, K) or profiles.commands_mps2.shape != (self.n, K, B):
            raise InvalidInput(
                f"profiles: ends has the shape {profiles.ends.shape} and commands_mps2 {profiles.commands_mps2.shape};"
                f" must be ({self.n}, K) and ({self.n}, K, {B})"
            )
        low, high = self.bounds[:, np.newaxis, :, 0], self.bounds[:, np.newaxis, :, 1]
        good = (profiles.commands_mps2 >= low) & (profiles.commands_mps2 <= high)
        if not good.all():
            k, j, b = np.argwhere(~good)[0]
            raise InvalidInput(
                f"profiles: command {profiles.commands_mps2[k, j, b]:g} m/s2 of vehicle_{self.bodies[b]} in row {k};"
                f" must be in [{low[k, 0, b]:g}, {high[k, 0, b]:g}] m/s2"
            )
        rising = (np.diff(profiles.ends, axis=1, prepend=0) >= 0).all()
        if not rising or not (profiles.ends[:, -1] == self.last_step).all():
            raise InvalidInput("profiles: ends must not decrease, and the last phase must end at the last step")


def problem_of(
    game: Game,
    alert: State,
    bodies: Sequence[int] | None = None,
    *,
    harm_count: AnyCount = HONEST,
    objective: Declared = "total",
    deciders: Sequence[int] | None = None,
) -> Problem:
    """Problem of finding the best commands of some vehicles in worlds at the alert.

    Learners that are not among ``bodies`` brake fully; all other vehicles hold the commands of their roles. ``bodies``:
    controlled vehicles (1: Vehicle 1); None: the learners. ``objective``: whose harm counts, as in a scenario.
    ``deciders``: vehicles whose shortest latency is the time of the first decision; None: ``bodies``.

    Raises ``InvalidInput`` for vehicles that do not exist, an unknown count, an objective that is not a weighted sum of
    harm or ``maximin``, and a script that observes the state, whose commands are not known at the alert.
    """
    alert = game.marked(alert)
    require(alert, "a search for the best braking", SHOWN)
    count = HarmCount.of(harm_count)
    chosen = np.array(game.settings.learners if bodies is None else bodies, np.int64)
    if not len(chosen) or len(np.intersect1d(chosen, range(1, alert.vehicles + 1))) < len(chosen):
        raise InvalidInput(f"vehicles {chosen.tolist()}: must be one or more of 1 to {alert.vehicles}, each once")
    for body, script in game.scripts.items():
        if body not in chosen:
            raise InvalidInput(
                f"scenario {game.name!r}: vehicle_{body} is driven by {getattr(script, 'name', script)!r}, whose"
                " commands are not known at the alert; a search needs scripts that hold one command"
            )
    wanted = with_braking(alert, game.settings.learners).wanted
    wanted[:, chosen] = 0.0
    dt = game.settings.time_step_s
    decide = chosen if deciders is None else np.array(deciders, np.int64)
    state = first_decision(alert._replace(wanted=wanted, memories={}), decide, game.settings)
    shares = np.zeros((alert.n, 3, wanted.shape[1]))
    times = [state.clock[:, [FIRST_DECISION]], np.full((alert.n, 1), dt), state.clock[:, [LAST, END]]]
    times += [state.clock[:, [HORIZON]]] if (state.clock[:, END] < state.clock[:, HORIZON]).any() else []
    identity = identities(alert._replace(wanted=wanted), chosen, np.hstack(times))
    return with_objective(Problem(chosen, state, dt, count, WHOLE_LINE, shares, identity), objective)


def with_braking(alert: State, bodies: Sequence[int] | Ints) -> State:
    wanted = alert.wanted.copy()
    wanted[:, bodies] = -capacities(alert.car, BRAKING)[:, bodies]
    return alert._replace(wanted=wanted)


def beside_braking(problem: Problem, single_problem: Problem, profiles: Profiles) -> Profiles:
    """Profiles for ``problem`` in which one vehicle follows ``profiles`` and the other controlled vehicles brake fully.

    ``profiles`` solve ``single_problem``, the vehicle alone, whose first decision may be later. Times between two
    decisions of ``problem`` are rounded to the nearest.
    """
    later = single_problem.state.clock[:, FIRST_DECISION] - problem.state.clock[:, FIRST_DECISION]
    last = problem.last_step[:, np.newaxis]
    ends = np.minimum(profiles.ends + np.rint(later / problem.time_step_s).astype(np.int64)[:, np.newaxis], last)
    ends[:, -1:] = last
    commands = np.repeat(problem.bounds[:, np.newaxis, :, 0], ends.shape[1], axis=1)
    commands[:, :, problem.bodies == single_problem.bodies[0]] = profiles.commands_mps2
    return Profiles(ends, commands)


def identities(alert: State, bodies: Ints, times: Floats) -> UInt64s:
    """Hash of everything that decides the harm of a profile, [n]: 8 bytes of BLAKE2b of each world.

    ``times`` [n, 4]: first decision, time step, number of steps, end; and the horizon if some end is before it.
    """
    line, car, digests = alert.line, alert.car, np.empty(alert.n, np.uint64)
    controlled = np.zeros(alert.wanted.shape)
    controlled[:, bodies] = 1.0
    for first_body in (0, 1):  # an obstacle counts as a vehicle; a world's hash does not depend on the other worlds
        rows = np.flatnonzero((line[:, GAP, 0] >= FAR_M) == bool(first_body))
        of_line, of_car = line[rows][:, :, first_body:], car[rows][:, :, first_body:]
        parts = [alert.time_s[rows, np.newaxis], of_line[:, SPEED], of_line[:, GAP, :-1], of_line[:, HIT, :-1]]
        parts += [of_car[:, RESTITUTION, :1], *(of_car[:, row] for row in (BRAKING, DRIVING, LATENCY, MASS, LIMIT))]
        parts += [alert.wanted[rows, first_body:], times[rows], controlled[rows, first_body:]]
        # forces matter only if brakes build up
        forces = [of_line[:, FORCE], of_car[:, BRAKE_RATE], of_car[:, RELEASE_RATE]]
        brakes_build_up = np.isfinite(of_car[:, [BRAKE_RATE, RELEASE_RATE]]).sum(axis=(1, 2))
        motion_rows, force_rows = (
            np.ascontiguousarray(np.hstack(arrays) + 0.0, "<f8") for arrays in (parts, forces)
        )  # -0.0 is 0.0
        for k, row in enumerate(rows):
            content = motion_rows[k].tobytes() + (force_rows[k].tobytes() if brakes_build_up[k] else b"")
            digests[row] = int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "little")
    return digests


def with_objective(problem: Problem, objective: Declared) -> Problem:
    """Problem whose search minimises ``objective``, as in a scenario's key. Raises ``InvalidInput`` for other
    objectives than ``problem_of``.
    """
    car, chosen = problem.state.car, [body - 1 for body in problem.bodies.tolist()]
    objectives = objectives_of(objective, problem.state.vehicles)
    forms = [objectives[i].kind.form for i in chosen]
    if set(forms) == {"total"}:
        return problem
    if set(forms) == {"maximin"}:
        return problem.with_weights(np.ones(problem.state.vehicles), largest=True)
    if not have_one_objective(problem.state, objective, problem.bodies.tolist()):
        raise InvalidInput(
            f"objective {objective!r}: the {len(chosen)} controlled vehicles have different objectives, but a search"
            " minimises one; give all of them the same, for instance weighted:1,4,1"
        )
    return problem.with_weights(objectives[chosen[0]].weights(car, chosen[0]))


def have_one_objective(state: State, objective: Declared, bodies: Sequence[int]) -> bool:
    """Whether several vehicles minimise the same: all the harm of the line, ``maximin``, or one weighted sum."""
    objectives = objectives_of(objective, state.vehicles)
    forms = {objectives[body - 1].kind.form for body in bodies}
    if len(forms) == 1 and forms <= {"total", "maximin"}:
        return True
    weights = [] if "maximin" in forms else [objectives[body - 1].weights(state.car, body - 1) for body in bodies]
    return len(weights) > 0 and all(np.array_equal(weights[0], vector) for vector in weights[1:])


@kernel
def worth(line, shares, weights, aim):
    """What a search minimises (m2/s2), in one world at one time. The value never decreases during an episode.

    ``line`` [LINE_ROWS, N + 1]: the state, with the harm so far. ``shares`` [3, N + 1], ``aim``: as in ``Problem``.
    """
    if aim == WHOLE_LINE:
        return amount_so_far(line, weights)
    value, from_ahead = 0.0, 0.0
    for i in range(line.shape[1]):
        borne = from_ahead
        if i < line.shape[1] - 1:
            unshared = unshared_amount(line, i, weights)
            shared = pair_amount(line, i, weights) - unshared
            borne += shares[0, i] * shared
            from_ahead = shares[1, i] * shared + shares[2, i] * conduct_amount(line, i, weights)
        value = max(value, borne) if aim == LARGEST else value + borne
    return value


@large
def worths(line, shares, weights, aim, out):
    for k in range(len(out)):
        out[k] = worth(line[k], shares[k], weights, aim)


@large
def follow_worlds(line, car, clock, wanted, ends, commands, bodies, time_step_s, scratch, failed):
    """Simulate every world's profile to the end, decision by decision, in place.

    ``failed`` [n] becomes True where a check of the physics failed.
    """
    for k in range(len(failed)):
        phase = 0
        while clock[k, ENDED] == 0.0:
            while phase < ends.shape[1] - 1 and ends[k, phase] <= clock[k, STEPS]:
                phase += 1
            for b in range(len(bodies)):
                wanted[k, bodies[b]] = commands[k, phase, b]
            outcome, _ = advance(line[k], car[k], clock[k], wanted[k], scratch, time_step_s)
            failed[k] = outcome == FAILED
