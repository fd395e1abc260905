"""Search every world of a problem for the best profile, or for an improvement of given commands."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ethbrake_marl.errors import PhysicsError, check_whole_number
from ethbrake_marl.extensions.search.kernels import CHANGE, DRAWING, PLAN, STEPWISE, Field, Room, World, gather, improve
from ethbrake_marl.extensions.search.pricing import MOST_PHASES, Problem, Profiles, UInt64s, best_of
from ethbrake_marl.motion.layout import Floats, Ints, scratch_for
from ethbrake_marl.parallel import chosen_threads

# of a search for profiles
DRAWN_SHARE = 0.35  # part of the budget for given and random profiles,
ROUNDS_SHARE = 0.50  # for rounds of improvement, each of which halves the field,
STEPWISE_SHARE = 0.02  # for the last one, step by step, which takes several times longer,
POLISHING_SHARE = 0.2  # and for changes at every decision; half as many more of several decisions at once follow
PER_PROFILE = 400  # the first field has one profile for this part of the budget,
SMALLEST_FIELD, LARGEST_FIELD = 4, 128  # but at least and at most so many
SAME_VALUE = 1e-6  # profiles whose values (m2/s2) are closer count as the same
LONGEST_TOGETHER = 50  # decisions that polishing changes at once
ATTENTION_STEPS = 30  # phases are halved within this number of steps from the first decision

PROFILES = np.zeros(DRAWING, np.int64)  # `drawing` of the kind PROFILE


def search_profiles(
    problem: Problem, starts: Sequence[Profiles], *, budget: int, seed: int = 0, threads: int = 1
) -> tuple[Profiles, dict[str, Floats]]:
    """Search each world for the best profile; return the profiles, and what they cost, name of a count -> [n] m2/s2.

    The result is at least as good as all of ``starts``, each with Q profiles for each world, [n * Q]: first those of
    world 0. ``budget``: about the number of profiles that are simulated in each world. The number of threads changes
    nothing. Finally the commands of the best profile are changed at single decisions and, if one vehicle is controlled,
    at several at once.

    Raises ``InvalidInput`` for an invalid budget, seed or number of threads, and ``PhysicsError`` for worlds in which
    no profile can be simulated.
    """
    threads = chosen_threads(threads)
    for name, value, least in (("budget", budget, 1), ("seed", seed, 0)):
        check_whole_number(name, value, least)
    n = problem.n
    ends, commands = join_profiles([part.shorten() for part in starts], n)
    long_starts = [part for part in starts if part.ends.shape[1] > MOST_PHASES]  # in the search they are shortened
    random, polishing = random_states(problem.identity, seed), int(POLISHING_SHARE * budget)

    def work(k: int) -> Profiles | None:
        world, room = prepare_world(problem, k, random, MOST_PHASES, False)
        last = int(problem.last_step[k])
        return search_world(world, room, Profiles(ends[k], commands[k]), last, max(budget - polishing, 1))

    def polish(k: int) -> Profiles:
        last = int(problem.last_step[k])
        world, room = prepare_world(problem, k, random, last, True)
        step_ends, step_commands = np.arange(1, last + 1), np.ascontiguousarray(best.take([k]).stepwise(last)[0])
        _, active = improve(world, room, step_ends, step_commands, polishing, PROFILES)
        if len(problem.bodies) == 1 and active > 0:
            together = np.array([PLAN, last, LONGEST_TOGETHER])
            _, active = improve(world, room, step_ends, step_commands, polishing // 2, together)
        step_ends[max(active - 1, 0) :] = last
        return compact(step_ends, step_commands)

    with ThreadPoolExecutor(threads) as pool:
        leading_profiles = list(pool.map(work, range(n)))
        failed = [k for k in range(n) if leading_profiles[k] is None]
        if failed:
            raise PhysicsError(dict.fromkeys(failed, "no profile could be simulated"))
        best = Profiles.join([profile for profile in leading_profiles if profile is not None])
        candidates = [
            best,
            *(
                part.take(slice(q, None, len(part.ends) // n))
                for part in long_starts
                for q in range(len(part.ends) // n)
            ),
        ]
        best = best_of([(problem.value(problem.follow(candidate)), candidate) for candidate in candidates])[1]
        better = Profiles.join(list(pool.map(polish, range(n))))
    best = best_of([(problem.value(problem.follow(candidate)), candidate) for candidate in (best, better)])[1]
    return best, problem.values(best)


def join_profiles(parts: Sequence[Profiles], n: int) -> Profiles:
    """``parts``: [n * q] each, of equally many phases; arranged by world, [n, Q]."""
    K, B = parts[0].commands_mps2.shape[1:]
    ends = np.concatenate([part.ends.reshape(n, -1, K) for part in parts], axis=1)
    return Profiles(ends, np.concatenate([part.commands_mps2.reshape(n, -1, K, B) for part in parts], axis=1))


def search_world(world: World, room: Room, starts: Profiles, last: int, budget: int) -> Profiles | None:
    """Best profile of one world, [1]; None if no profile can be simulated.

    Many profiles are improved in rounds, each of which keeps the better half. Then the phases of the best profile are
    divided, and it is improved again, at last with a step-by-step simulation, because rounding decides how large harm
    is where harm jumps. ``last``: number of decisions. ``budget``: number of profiles to simulate.
    """
    K, B = room.commands.shape
    M, rounds = SMALLEST_FIELD, 3
    while budget >= 2 * M * PER_PROFILE and M < LARGEST_FIELD:
        M, rounds = 2 * M, rounds + 1
    field = field_for(M, K, B)
    random_count = max(int(DRAWN_SHARE * budget) - len(starts.ends), 0)
    in_rounds, stepwise = int(ROUNDS_SHARE * budget), int(STEPWISE_SHARE * budget)
    gather(world, room, *starts, (starts.ends == last).argmax(axis=1) + 1, random_count, SAME_VALUE, field)
    sort(field, M)
    for stage in range(rounds + 2):
        survivors = max(M >> stage, 1)
        profile_budget = in_rounds // (rounds * survivors)
        if stage == rounds:
            halve_phases(field, min(ATTENTION_STEPS, last))
            profile_budget = budget - random_count - in_rounds - stepwise
        elif stage == rounds + 1:
            select(world, room, starts, field)
            profile_budget = stepwise
        for m in range(survivors):
            phase_count = field.phases[m]
            if phase_count > 0 and field.values[0] > 0.0:
                profile = field.ends[m, :phase_count], field.commands[m, :phase_count]
                field.values[m], active = improve(world, room, *profile, profile_budget, PROFILES)
                field.ends[m, max(active - 1, 0) : phase_count] = last  # the episode ends before later phases begin
        sort(field, survivors)
    phase_count = field.phases[0]
    return compact(field.ends[0, :phase_count], field.commands[0, :phase_count]) if phase_count else None


def sort(field: Field, survivors: int) -> None:
    order = np.argsort(field.values[:survivors], kind="stable")
    for array in field:
        array[:survivors] = array[order]


def compact(ends: Ints, commands: Floats) -> Profiles:
    """One profile without empty phases, [1]. Neighbouring phases with equal commands are joined."""
    there = np.diff(ends, prepend=0) > 0
    ends, commands = ends[there], commands[there]
    changes = (commands[1:] != commands[:-1]).any(axis=1)
    return Profiles(ends[np.append(changes, True)][np.newaxis], commands[np.append(True, changes)][np.newaxis])


def halve_phases(field: Field, attention: int) -> None:
    """Halve the longest phases within the first ``attention`` steps of the best profile in ``field`` until it has K
    phases.
    """
    phase_count, K = field.phases[0], field.ends.shape[1]
    if phase_count > 0 and field.values[0] > 0.0:
        (ends,), (commands,) = compact(field.ends[0, :phase_count], field.commands[0, :phase_count])
        while len(ends) < K:
            length = np.diff(np.minimum(ends, attention), prepend=0)
            j = int(length.argmax())
            ends = np.insert(ends, j, (ends[j - 1] if j > 0 else 0) + length[j] // 2)
            commands = np.insert(commands, j, commands[j], axis=0)
        field.ends[0], field.commands[0], field.phases[0] = ends, commands, K


def select(world: World, room: Room, starts: Profiles, field: Field) -> None:
    """Put the best of ``field`` and ``starts`` at index 0 of ``field``. Then ``world`` is simulated step by step."""
    world.numbers[STEPWISE] = 1.0
    best, few = field_for(1, *field.commands.shape[1:]), slice(SMALLEST_FIELD)
    gather(world, room, field.ends[few], field.commands[few], field.phases[few], 0, 0.0, best)
    gather(world, room, *starts, np.full(len(starts.ends), starts.ends.shape[1]), 0, 0.0, best)
    for array, best_array in zip(field, best, strict=True):
        array[0] = best_array[0]


def random_states(identity: UInt64s, seed: int) -> UInt64s:
    """Initial state of each world's random number generator, [n], from its ``identity`` [n] and the seed."""
    with np.errstate(over="ignore"):
        z = identity ^ np.uint64((int(seed) * 0xD1342543DE82EF95) % 2**64)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def field_for(profiles: int, phases: int, controlled: int) -> Field:
    commands = np.zeros((profiles, phases, controlled))
    ends, phase_counts = np.zeros((profiles, phases), np.int64), np.zeros(profiles, np.int64)
    return Field(ends, commands, phase_counts, np.full(profiles, np.inf))


def prepare_world(problem: Problem, k: int, random: UInt64s, phases: int, stepwise: bool) -> tuple[World, Room]:
    """The compiled search's form of world ``k``, and working memory for profiles of up to ``phases`` phases."""
    state = problem.state
    numbers = np.array([problem.time_step_s, problem.aim, stepwise])
    weights = np.stack([problem.harm_count.weights, problem.harm_count.tie_breaker.weights])
    world = World(
        state.car[k], state.clock[k], state.wanted[k].copy(), problem.bodies, problem.bounds[k], problem.shares[k],
        numbers, weights, random[k : k + 1], scratch_for(state.wanted.shape[1]),
    )  # fmt: skip
    lines = np.zeros((phases + 1, *state.line[k].shape))
    lines[0] = state.line[k]
    profile = np.zeros(phases, np.int64), np.zeros((phases, len(problem.bodies)))
    return world, Room(lines, lines.copy(), *profile, np.zeros(CHANGE))
