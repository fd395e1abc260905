"""The agent ``plan``: at every decision, the best plan of up to three phases of constant braking.

A candidate is a command for each phase and the duration of all phases but the last. Its cost is forecast in one or
several possible lines (``Forecast``), from the present to ``contacts.FORECAST_S``; a change of phase falls on a
decision, because within a step it would not be executed. The candidates are constant brakings, what is left of the
last plan, and numbers from a fixed pattern: the first part anywhere, then around the best so far. The pattern depends
on the decision and on the vehicle's place in the row that it can predict, so a world has the same plan in every batch.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.commands import action_of, command_of
from ethbrake_marl.episode.counts import amount_so_far
from ethbrake_marl.episode.hold import exceeds
from ethbrake_marl.episode.plans import PHASES
from ethbrake_marl.episode.state import ENDED, STEPS, TIME
from ethbrake_marl.episode.step import note_motion
from ethbrake_marl.extensions.forecasts.contacts import FORECAST_S, known_line
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.elementary import hash_number
from ethbrake_marl.motion.forces import capacity
from ethbrake_marl.motion.interval import FAILED, STOPPED, move_line
from ethbrake_marl.motion.layout import BRAKING, CAR_ROWS, FORCE, LATENCY, LINE_ROWS, Floats, scratch_for

SAME_COST = 1e-6  # costs that differ by less are equal (m2/s2)
SAME_S = 1e-9  # moments that differ by less are the same (s)
BRAKES_MPS2 = 0.5  # a vehicle that brakes harder has begun to brake
CONSTANTS = 9  # constant brakings, from full braking to coasting
FIRST_PLAN = 6  # how many times as many candidates a plan without forerunner has
PLACES = 4  # candidates around which others are tried
ANYWHERE = 0.4  # share of candidates anywhere
AROUND_ALL = 0.6  # share of the rest that is tried around all places in turn, before the best place alone
FULL_SHARE = 0.4  # share of phases of full braking among candidates anywhere
MOVED_SHARE = 0.6  # share of numbers that differ from those of the place
WIDTH, ROUNDS, SHRINK = 0.5, 4, 0.6  # largest difference of an action at first; it shrinks by a factor in each round
WIDTH_S = 2.0  # the same of durations, per width of an action (s)
SHORTEST_S, USUAL_S, LONGEST_S = 0.1, 0.5, 2.5  # durations of a phase
OF_PLAN, OF_BRAKING, OF_CONSTANT, LOW_TIE, HIGH_TIE = range(5)  # columns of `costs`
COSTS = 5


class Forecast(NamedTuple):
    """M possible lines of n worlds, as one vehicle assumes them, and what it assumes that the others do.

    Each body has a command (m/s2) for each phase, and times (s from now) at which phases end; infinite: never.
    """

    line: Floats  # [n, M, LINE_ROWS, N + 1] without harm so far
    car: Floats  # [n, M, CAR_ROWS, N + 1] with latencies from now
    commands: Floats  # [n, M, PHASES, N + 1]
    ends: Floats  # [n, M, PHASES - 1, N + 1]
    weight: Floats  # [n, M] of the lines in the mean cost; their sum is 1
    known: Floats  # [n, 2] first and last body of the row around the vehicle that can be predicted


def empty_forecast(n: int, M: int, bodies: int) -> Forecast:
    line, car, commands, ends = (np.zeros((n, M, rows, bodies)) for rows in (LINE_ROWS, CAR_ROWS, PHASES, PHASES - 1))
    return Forecast(line, car, commands, ends, np.full((n, M), 1.0 / M), np.zeros((n, 2)))


@large
def foresee_worlds(line, car, clock, know, plans, i, forecast):
    """Write the one line that body i knows to the ``forecast``; a plan that it has heard replaces a constant force.

    ``line``, ``car``, ``clock``, ``know``: as in ``State``. ``plans`` [n, PLAN_NUMBERS, N + 1]: NaN: there is none.
    """
    for k in range(len(line)):
        here, commands, ends = forecast.line[k, 0], forecast.commands[k, 0], forecast.ends[k, 0]
        here[:] = 0.0
        first, last = known_line(line[k], car[k], clock[k], know[k], i, here, forecast.car[k, 0], commands[0])
        forecast.known[k, 0], forecast.known[k, 1] = first, last
        for j in range(commands.shape[1]):
            for p in range(PHASES - 1):
                commands[p + 1, j], ends[p, j] = commands[0, j], math.inf
            if max(first, 1) <= j <= last and not math.isnan(plans[k, 0, j]):
                for p in range(PHASES):
                    commands[p, j] = plans[k, PHASES - 1 + p, j]
                for p in range(PHASES - 1):
                    ends[p, j] = max(plans[k, p, j] - clock[k, TIME], 0.0)


@kernel
def write_candidate(x, phases, team, step_s, onset, car, commands, ends):
    """Write the candidate ``x`` to the ``commands`` and ``ends`` of all bodies of the ``team`` in one line.

    ``x``: the action of each body in the first phase, in the second, ...; then the durations (s). The first phase
    begins after ``onset`` (s).
    """
    end = onset
    for p in range(phases):
        for b in range(len(team)):
            commands[p, team[b]] = command_of(car, team[b], x[p * len(team) + b])
        if p < phases - 1:
            end += x[phases * len(team) + p]
            for b in range(len(team)):
                ends[p, team[b]] = max(math.floor(end / step_s + 0.5), p + 1.0) * step_s


@kernel
def write_reaction(i, start, reaction_s, car, commands, ends):
    """Let the vehicle behind body i coast, and brake fully ``reaction_s`` after body i begins to at ``start`` (s)."""
    commands[0, i + 1], ends[0, i + 1] = 0.0, max(start + reaction_s, 0.0)
    for p in range(1, PHASES):
        commands[p, i + 1] = -capacity(car, BRAKING, i + 1)


@kernel
def start_of_braking(i, onset, commands, ends):
    """When body i begins to brake (s from now)."""
    for p in range(PHASES):
        if commands[p, i] < -BRAKES_MPS2:
            return onset if p == 0 else ends[p - 1, i]
    return math.inf


@kernel
def cost_of(x, k, settings, forecast, memory, weights, most):
    """Forecast cost of the candidate ``x`` in world k (m2/s2): the weighted mean over its lines; infinite if surely
    above ``most``, NaN if a check of the physics fails.
    """
    i, phases, team, step_s, reaction_s, begun = settings
    scratch, here, wanted = memory
    mean = 0.0
    for m in range(forecast.line.shape[1]):
        share = forecast.weight[k, m]
        if share == 0.0:
            continue
        car, commands, ends = forecast.car[k, m], forecast.commands[k, m], forecast.ends[k, m]
        line, onset = forecast.line[k, m], car[LATENCY, i]
        write_candidate(x, phases, team, step_s, onset, car, commands, ends)
        if reaction_s > 0.0:
            start = begun if begun < math.inf else start_of_braking(i, onset, commands, ends)
            write_reaction(i, start, reaction_s, car, commands, ends)
        for row in range(LINE_ROWS):
            for j in range(here.shape[1]):
                here[row, j] = line[row, j]
        now, limit = 0.0, (most - mean) / share
        while now < FORECAST_S:
            until = FORECAST_S
            for j in range(here.shape[1]):
                p = 0
                while p < PHASES - 1 and ends[p, j] <= now + SAME_S:
                    p += 1
                wanted[j] = commands[p, j]
                if p < PHASES - 1:
                    until = min(until, ends[p, j])
            outcome = move_line(here, car, wanted, scratch, now, until, exceeds, (weights, limit))
            if outcome == FAILED:
                return math.nan
            if outcome == STOPPED:
                return math.inf
            now = until
        note_motion(here, car)
        mean += share * amount_so_far(here, weights)
        if mean > most:
            return math.inf
    return mean


@kernel
def write_rest(plans, time, onset, phases, team, car, x):
    """Write what is left of the team's last ``plans`` [PLAN_NUMBERS, N + 1] to ``x``; return whether there are any."""
    lead = team[0]
    planned = not math.isnan(plans[PHASES - 1, lead])
    gone = 0
    while planned and gone < phases - 1 and plans[gone, lead] - time < SAME_S:
        gone += 1
    for p in range(phases):
        q = min(p + gone, phases - 1)
        for b in range(len(team)):
            command = plans[PHASES - 1 + q, team[b]]
            x[p * len(team) + b] = action_of(car, team[b], command) if planned else -1.0
        if p < phases - 1:
            begin = time + onset if q == 0 or p == 0 else plans[q - 1, lead]
            ahead = planned and q < phases - 1
            x[phases * len(team) + p] = max(plans[q, lead] - begin, SHORTEST_S) if ahead else USUAL_S
    return planned


@kernel
def copy_to(target, x):
    for f in range(len(x)):
        target[f] = x[f]


@kernel
def write_anywhere(x, actions, seed, number):
    """Write candidate ``number`` of the pattern ``seed`` to ``x``, whose first ``actions`` numbers are actions."""
    for f in range(len(x)):
        u = hash_number(seed, number, f)
        if f >= actions:
            x[f] = SHORTEST_S + LONGEST_S * u * u
        else:
            x[f] = -1.0 if hash_number(seed, number, 100 + f) < FULL_SHARE else u - 1.0


@kernel
def write_around(place, width, x, actions, seed, number):
    """Write candidate ``number`` of the pattern ``seed``, which differs from ``place`` by up to ``width``, to ``x``."""
    for f in range(len(x)):
        move = 0.0
        if hash_number(seed, number, 100 + f) < MOVED_SHARE:
            move = width * (2.0 * hash_number(seed, number, f) - 1.0)
        if f < actions:
            x[f] = min(max(place[f] + move, -1.0), 0.0)
        else:
            x[f] = min(max(place[f] + WIDTH_S * move, SHORTEST_S), LONGEST_S)


@kernel
def write_number(c, most, actions, seed, tops, worth, x):
    """Write candidate ``c`` of ``most``, after constants and rest, to ``x``; return the place that it may take."""
    begin, place = CONSTANTS + 1, 0
    anywhere = begin + int(ANYWHERE * (most - begin))
    if c < anywhere:
        write_anywhere(x, actions, seed, c)
        for s in range(PLACES):
            place = s if worth[s] > worth[place] else place
        return place
    done = (c - anywhere) / float(most - anywhere)
    place = c % PLACES if done < AROUND_ALL else worth.argmin()
    turn = done / AROUND_ALL if done < AROUND_ALL else (done - AROUND_ALL) / (1.0 - AROUND_ALL)
    shrink = 1.0
    for _ in range(int(ROUNDS * turn)):
        shrink *= SHRINK
    write_around(tops[place], WIDTH * shrink, x, actions, seed, c)
    return place


@kernel
def is_hopeless(c, moving, worth):
    """Whether no candidate from ``c`` on can matter."""
    return c > CONSTANTS and (not moving or worth[worth.argmin()] <= SAME_COST)


@large
def plan_worlds(car, clock, moving, plans, begun_s, forecast, settings, count, weights, memory, arrays, costs):
    """Write the new plans of the ``team`` to ``plans`` [n, PLAN_NUMBERS, N + 1], which are the last ones before.

    Returns the number of a world in which a forecast failed, or -1. ``car``, ``clock``: as in ``State``. ``moving``
    [n]: whether body i moves. ``begun_s`` [n]: when it began to brake (s after the alert). ``settings``: body i,
    phases, team (body i first), time between decisions (s), and reaction time of the vehicle behind (s; 0: it is
    foreseen as others are). ``count``: candidates (``FIRST_PLAN``). ``weights``: of the cost. ``costs`` [n, COSTS]:
    forecast cost of the plan, of full braking and of the best constant, and the actions between which constants are as
    good.
    """
    i, phases, team, step_s, reaction_s = settings
    x, rest, tops, worth = arrays
    actions, failed = phases * len(team), -1
    for k in range(len(plans)):
        if clock[k, ENDED] == 1.0:
            continue
        time, onset = clock[k, TIME], forecast.car[k, 0, LATENCY, i]
        first, last = forecast.known[k, 0], forecast.known[k, 1]
        seed = 1000 * (i - int(max(first, 1.0)) + 1) + int(clock[k, STEPS])
        reacts = i < last and forecast.line[k, 0, FORCE, i + 1] == 0.0
        world = i, phases, team, step_s, reaction_s if reacts else 0.0, begun_s[k] - time
        planned = write_rest(plans[k], time, onset, phases, team, car[k], rest)
        worth[:] = math.inf
        low = high = -1.0
        most = count if planned else FIRST_PLAN * count
        for c in range(most):
            if is_hopeless(c, moving[k], worth):
                break
            place = 0
            if c > CONSTANTS:
                place = write_number(c, most, actions, seed, tops, worth, x)
            else:
                copy_to(x, rest)
                for p in range(phases if c < CONSTANTS else 0):
                    x[p * len(team)] = c / (CONSTANTS - 1.0) - 1.0
            cost = cost_of(x, k, world, forecast, memory, weights, worth[place] + SAME_COST)
            failed = k if math.isnan(cost) else failed
            if c == 0:
                costs[k, OF_BRAKING] = cost
            if c < CONSTANTS and cost <= worth[0] + SAME_COST:
                low, high = x[0] if cost < worth[0] - SAME_COST else low, x[0]
            if c == CONSTANTS:
                place = 1
            if cost < worth[place] - SAME_COST and (c != CONSTANTS or cost < worth[0] - SAME_COST):
                copy_to(tops[place], x)
                worth[place] = cost
            if c == CONSTANTS - 1:
                costs[k, OF_CONSTANT], costs[k, LOW_TIE], costs[k, HIGH_TIE] = worth[0], low, high
                for p in range(phases):  # of equal constants the middle one; the strongest if nothing is known ahead
                    tops[0, p * len(team)] = 0.5 * (low + high) if first < i else low
        place = worth.argmin()
        best = tops[place]
        for p in range(phases if first == last and first == i else 0):  # nothing is known of anybody
            best[p * len(team)] = -1.0
        write_plans(best, k, world, time, car[k], forecast, plans[k])
        costs[k, OF_PLAN] = worth[place]
    return failed


@kernel
def write_plans(x, k, settings, time, car, forecast, plans):
    """Write the candidate ``x`` to the ``plans`` [PLAN_NUMBERS, N + 1] of world k."""
    i, phases, team, step_s, _, _ = settings
    commands, ends = forecast.commands[k, 0], forecast.ends[k, 0]
    write_candidate(x, phases, team, step_s, forecast.car[k, 0, LATENCY, i], car, commands, ends)
    for b in range(len(team)):
        for p in range(PHASES):
            plans[PHASES - 1 + p, team[b]] = commands[min(p, phases - 1), team[b]]
            if p < PHASES - 1:
                plans[p, team[b]] = time + ends[p, team[b]] if p < phases - 1 else math.inf


def working_memory(bodies: int, phases: int, team: int) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """Arrays ``memory`` and ``arrays`` of ``plan_worlds``."""
    size = phases * team + phases - 1
    memory = scratch_for(bodies), np.zeros((LINE_ROWS, bodies)), np.zeros(bodies)
    return memory, (np.zeros(size), np.zeros(size), np.zeros((PLACES, size)), np.zeros(PLACES))
