"""Search every world of a problem: for the best profile, around given commands, or among random templates."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.extensions.search.kernels import (
    DRAWING,
    PLAN,
    STEPWISE,
    Field,
    Room,
    World,
    follow,
    gather,
    improve,
    room_for,
)
from ethbrake_marl.extensions.search.pricing import MOST_PHASES, Problem, Profiles, UInt64s
from ethbrake_marl.motion.layout import Floats, Ints, scratch_for

# of a search for profiles
DRAWN_SHARE = 0.35  # part of the budget for given and random profiles,
ROUNDS_SHARE = 0.50  # for rounds of improvement, each of which halves the field,
STEPWISE_SHARE = 0.02  # and for the last one, step by step, which takes several times longer
PER_PROFILE = 400  # the first field has one profile for this part of the budget,
SMALLEST_FIELD, LARGEST_FIELD = 4, 128  # but at least and at most so many
SAME = 1e-6  # profiles whose values (m2/s2) are closer count as the same
ATTENTION_STEPS = 30  # phases are halved within this number of steps from the first decision

# of a search around commands
TEMPLATE_SHARE, THEIR_SHARE = 0.3, 0.3  # parts of the budget for templates, and for improving the best of them
ATTENTION_S = 3.0  # changes and templates begin within this time from the first decision
LONGEST_CHANGE_S = 0.6
LONGEST_WHILE_S = 0.8  # of the second command of a template
WORSE = 5.0  # a template is improved if it is worse than the given commands by at most this (m2/s2)
NO_HARM = 1e-9  # less (m2/s2) counts as none

PROFILES = np.zeros(DRAWING, np.int64)  # random profiles and changes are those of profiles


def search_profiles(
    problem: Problem, given: Profiles, *, budget: int, seed: int = 0, threads: int = 1
) -> tuple[Profiles, dict[str, Floats]]:
    """Search each world for the best profile; return it, and its values in both counts of harm, [n] m2/s2.

    It has at most ``MOST_PHASES`` phases and is at least as good as every given one.

    Args:
        problem: n worlds, and what is minimised in them.
        given: profiles with which the search starts, [n * Q]: first the Q profiles of world 0, and so on.
        budget: number of profiles that are simulated in each world, about.
        seed: of the random search.
        threads: number of threads; the result is the same for any.

    Raises ``InvalidInput`` for a bad number, and ``PhysicsError`` for worlds in which no profile can be simulated.

    """
    for name, value, least in (("budget", budget, 1), ("threads", threads, 1), ("seed", seed, 0)):
        check_whole_number(name, value, least)
    n, B = problem.n, len(problem.bodies)
    given = Profiles.padded([given], MOST_PHASES)[0]
    ends = np.ascontiguousarray(given.ends.reshape(n, -1, MOST_PHASES))
    commands = np.ascontiguousarray(given.commands_mps2.reshape(n, -1, MOST_PHASES, B))
    random = seeded(problem.identity, seed)

    def work(k: int) -> Profiles | None:
        world, room = prepared(problem, k, random, MOST_PHASES, False)
        return search_world(world, room, Profiles(ends[k], commands[k]), int(problem.last_step[k]), budget)

    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(work, range(n)))
    failed = [k for k in range(n) if found[k] is None]
    if failed:
        raise PhysicsError(dict.fromkeys(failed, "no profile could be simulated"))
    best = Profiles.join([profile for profile in found if profile is not None])
    best = Profiles.padded([best], MOST_PHASES)[0]
    return best, problem.values(best)


def search_world(world: World, room: Room, given: Profiles, last: int, budget: int) -> Profiles | None:
    """Return the best profile of one world, [1]; None if no profile can be simulated.

    Gathers a field, improves it in rounds that halve it, divides the phases of the best to improve it again, and at
    last goes step by step: where the harm jumps, rounding decides how much harm a profile does.
    """
    K, B = room.commands.shape
    M, rounds = SMALLEST_FIELD, 3
    while budget >= 2 * M * PER_PROFILE and M < LARGEST_FIELD:
        M, rounds = 2 * M, rounds + 1
    field = Field(np.zeros((M, K), np.int64), np.zeros((M, K, B)), np.zeros(M, np.int64), np.full(M, np.inf))
    drawn = max(int(DRAWN_SHARE * budget) - len(given.ends), 0)
    in_rounds, stepwise = int(ROUNDS_SHARE * budget), int(STEPWISE_SHARE * budget)
    gather(world, room, *given, (given.ends == last).argmax(axis=1) + 1, drawn, PROFILES, SAME, field)
    sort(field, M)
    for stage in range(rounds + 2):
        left = max(M >> stage, 1)
        each = in_rounds // (rounds * left)
        if stage == rounds:
            divide(field, min(ATTENTION_STEPS, last))
            each = budget - drawn - in_rounds - stepwise
        elif stage == rounds + 1:
            select(world, room, given, field)
            each = stepwise
        for m in range(left):
            used = field.phases[m]
            if used > 0 and field.values[0] > 0.0:
                one = field.ends[m, :used], field.commands[m, :used]
                field.values[m], active = improve(world, room, *one, each, PROFILES, 0.0)
                field.ends[m, max(active - 1, 0) : used] = last  # the episode ends before later phases begin
        sort(field, left)
    used = field.phases[0]
    return compact(field.ends[0, :used], field.commands[0, :used]) if used else None


def sort(field: Field, left: int) -> None:
    """Sort the first ``left`` profiles of a field, the best first."""
    order = np.argsort(field.values[:left], kind="stable")
    for array in field:
        array[:left] = array[order]


def compact(ends: Ints, commands: Floats) -> Profiles:
    """Return a profile [1] without empty phases, and with one phase for neighbours of equal commands."""
    there = np.diff(ends, prepend=0) > 0
    ends, commands = ends[there], commands[there]
    changes = (commands[1:] != commands[:-1]).any(axis=1)
    return Profiles(ends[np.append(changes, True)][np.newaxis], commands[np.append(True, changes)][np.newaxis])


def divide(field: Field, attention: int) -> None:
    """Halve phases of the best profile until it has all; always the one with the most steps within ``attention``."""
    used, K = field.phases[0], field.ends.shape[1]
    if used > 0 and field.values[0] > 0.0:
        (ends,), (commands,) = compact(field.ends[0, :used], field.commands[0, :used])
        while len(ends) < K:
            length = np.diff(np.minimum(ends, attention), prepend=0)
            j = int(length.argmax())
            ends = np.insert(ends, j, (ends[j - 1] if j > 0 else 0) + length[j] // 2)
            commands = np.insert(commands, j, commands[j], axis=0)
        field.ends[0], field.commands[0], field.phases[0] = ends, commands, K


def select(world: World, room: Room, given: Profiles, field: Field) -> None:
    """Simulate step by step from now on; the best one of the field's first and of the given profiles becomes first."""
    world.numbers[STEPWISE] = 1.0
    K, few = field.ends.shape[1], slice(SMALLEST_FIELD)
    phases = np.concatenate([field.phases[few], np.full(len(given.ends), K)])
    ends = np.concatenate([field.ends[few], given.ends])
    commands = np.concatenate([field.commands[few], given.commands_mps2])
    best = Field(
        np.zeros((1, K), np.int64), np.zeros((1, *commands.shape[1:])), np.zeros(1, np.int64), np.array([np.inf])
    )
    gather(world, room, ends, commands, phases, 0, PROFILES, 0.0, best)
    for array, one in zip(field, best, strict=True):
        array[0] = one[0]


def refine(problem: Problem, commands_mps2: Floats, *, budget: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Improve one vehicle's commands of every decision; return the best, [n, T] m/s2, and their values, [n] m2/s2.

    They are at least as good as the given commands ``commands_mps2`` [n, T]. Beside these, the best of some random
    templates is improved, because small changes may miss the best commands.

    Raises ``InvalidInput`` for several controlled vehicles, commands that do not fit, or a budget below 1, and
    ``PhysicsError`` for worlds in which the given commands cannot be simulated.
    """
    check_whole_number("budget", budget, 1)
    best, last_step, random = commands_mps2.copy(), problem.last_step, seeded(problem.identity, seed)
    problem.check(Profiles.of_steps(best[:, :, np.newaxis], last_step))
    templates, theirs = int(TEMPLATE_SHARE * budget), int(THEIR_SHARE * budget)
    failed = []
    for k in range(problem.n):
        drawing = drawing_of(problem, k)
        world, room = prepared(problem, k, random, best.shape[1], True)
        ends, mine = steps_of(best.shape[1], last_step[k]), best[k][:, np.newaxis]
        value, active = improve(world, room, ends, mine, budget - templates - theirs, drawing, NO_HARM)
        if active == 0:
            failed.append(k)
        elif value > NO_HARM:
            other = best_template(world, room, value + WORSE, templates, drawing)
            if other is not None and improve(world, room, ends, other, theirs, drawing, NO_HARM)[0] < value:
                mine[:] = other
    if failed:
        raise PhysicsError(dict.fromkeys(failed, "the given commands cannot be simulated"))
    return best, problem.value(problem.follow(Profiles.of_steps(best[:, :, np.newaxis], last_step)))


def best_templates(problem: Problem, bound: Floats, *, number: int, seed: int = 0) -> tuple[Floats, Ints]:
    """Draw random templates for one vehicle; return the best one's commands, [n, T] m/s2, and number of steps, [n].

    A template is one command, another for a while, then full braking. A random one that does little harm tolerates
    small errors, so a policy can imitate it. The number of steps is 0 where none is better than ``bound`` [n] (m2/s2).

    Raises ``InvalidInput`` for several controlled vehicles, or if ``number``, of templates in each world, is below 1.
    """
    check_whole_number("templates", number, 1)
    T, random = int(problem.last_step.max(initial=0)), seeded(problem.identity, seed)
    commands, steps = np.zeros((problem.n, T)), np.zeros(problem.n, np.int64)
    for k in range(problem.n):
        world, room = prepared(problem, k, random, T, True)
        best = best_template(world, room, bound[k], number, drawing_of(problem, k))
        if best is not None:
            steps[k] = follow(world, room.lines, steps_of(T, problem.last_step[k]), best, 0, np.inf)[1]
            commands[k] = best[:, 0]
    return commands, steps


def best_template(world: World, room: Room, bound: float, number: int, drawing: Ints) -> Floats | None:
    """Return the commands of the best of some templates, [T, 1] m/s2; None if none is better than ``bound``."""
    field = Field(np.zeros((1, 3), np.int64), np.zeros((1, 3, 1)), np.zeros(1, np.int64), np.array([bound]))
    nothing = np.zeros((0, 3), np.int64), np.zeros((0, 3, 1)), np.zeros(0, np.int64)
    gather(world, room, *nothing, number, drawing, 0.0, field)
    if field.phases[0] == 0:
        return None
    return np.ascontiguousarray(Profiles(field.ends, field.commands).stepwise(len(room.ends))[0])


def seeded(identity: UInt64s, seed: int) -> UInt64s:
    """Return the initial state of each world's random stream, [n]."""
    with np.errstate(over="ignore"):
        z = identity ^ np.uint64((int(seed) * 0xD1342543DE82EF95) % 2**64)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def prepared(problem: Problem, k: int, random: UInt64s, phases: int, stepwise: bool) -> tuple[World, Room]:
    """Return world k of a problem, and working memory for profiles of so many phases."""
    state = problem.state
    numbers = np.array([problem.time_step_s, problem.horizon_s, problem.total, problem.aim, stepwise])
    world = World(
        state.car[k], state.clock[k], state.wanted[k].copy(), problem.bodies, problem.bounds[k], problem.shares[k],
        numbers, random[k : k + 1], scratch_for(state.wanted.shape[1]),
    )  # fmt: skip
    return world, room_for(state.line[k], phases, len(problem.bodies))


def steps_of(decisions: int, last_step: int) -> Ints:
    """Return the ends of a plan with one phase for each decision."""
    return np.minimum(np.arange(1, decisions + 1), last_step)


def drawing_of(problem: Problem, k: int) -> Ints:
    """Return how changes and templates are drawn for plans. Raises ``InvalidInput`` for several controlled vehicles."""
    if len(problem.bodies) != 1:
        raise InvalidInput(f"vehicles {problem.bodies.tolist()}: plans are searched for one controlled vehicle")
    times = ATTENTION_S, LONGEST_CHANGE_S, LONGEST_WHILE_S
    return np.array([PLAN, *(max(int(time / problem.time_step_s + 0.5), 1) for time in times)])
