"""``search``: the best profiles of many worlds at once, on a GPU, with many threads for each world."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ethbrake_marl.episode.counts import other_count, weights_of
from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.extensions.cuda.device import Kernel, device_named, enough_memory
from ethbrake_marl.extensions.cuda.search_kernels import Own, Plans, Searched, search_each, shapes_of
from ethbrake_marl.extensions.proofs.line import rows_of
from ethbrake_marl.extensions.search.kernels import STEPWISE
from ethbrake_marl.extensions.search.pricing import MOST_PHASES, Problem, Profiles, best_of
from ethbrake_marl.extensions.search.search import PROFILES, joined, seeded
from ethbrake_marl.motion.layout import BRAKING, Floats

WHOLE_NUMBERS = ("ends", "best_ends", "kind")  # in a thread's own memory


def search(
    problem: Problem,
    given: Profiles | None = None,
    *,
    seconds: float | None = None,
    rounds: int = 6,
    restarts: int = 16,
    drawn: int = 50,
    changes: int = 400,
    seed: int = 0,
    device: str = "cuda",
) -> tuple[Profiles, dict[str, Floats]]:
    """Search each world for the best profile; return it, and its values in all counts, [n] m2/s2.

    In each world, each of ``restarts`` threads draws random profiles and improves its best one. After each round,
    threads meet in pairs, and both continue with the better profile. The last round is simulated decision by decision.
    Several controlled vehicles are first searched one by one, while the others brake fully; the result is at least as
    good.

    Args:
        problem: n worlds, and what is minimised in them (``problem_of``). For a front, repeat its worlds, each time
            with other weights: ``problem.take(rows).minimising(weights)``.
        given: profiles with which threads begin, [n * Q]: first the Q profiles of world 0, and so on.
        seconds: time (s) after which no further round begins; the result then depends on the speed. None: do all
            ``rounds``. Of several controlled vehicles, each one by itself has an equal part of this time.
        rounds: number of rounds of random changes.
        restarts: threads in each world, a power of two.
        drawn: random profiles that each thread tries in the first round, beside some of full driving and braking.
        changes: random changes that each thread tries in a round.
        seed: seed of the random numbers.
        device: as for ``Worlds``.

    Raises ``InvalidInput`` for a bad number or device, and for more worlds than the device has memory for, and
    ``PhysicsError`` for worlds in which no profile can be simulated.

    """
    for name, value, least in (("rounds", rounds, 1), ("drawn", drawn, 1), ("changes", changes, 1), ("seed", seed, 0)):
        check_whole_number(name, value, least)
    check_whole_number("restarts", restarts, 1, 1024)
    if restarts & (restarts - 1):
        raise InvalidInput(f"restarts = {restarts!r}: must be a power of two, from 1 to 1024")
    if not (seconds is None or 0.0 <= seconds < np.inf):
        raise InvalidInput(f"seconds = {seconds!r}: must be None, or a number of 0 or more")
    if not problem.n:
        raise InvalidInput("problem: has no world; must have one or more")
    on, n, begun = device_named(device), problem.n, time.monotonic()
    if len(problem.bodies) > 1:
        part = None if seconds is None else seconds / (1 + len(problem.bodies))
        effort: Any = {"rounds": rounds, "restarts": restarts, "drawn": drawn, "changes": changes, "seed": seed}
        alone = best_alone(problem, partial(search, seconds=part, device=device, **effort))
        both = joined([part.shortened() for part in (given, alone) if part is not None], n)
        ends, commands = both
        given = Profiles(ends.reshape(-1, *ends.shape[2:]), commands.reshape(-1, *commands.shape[2:]))
    with enough_memory(f"n = {n} worlds, restarts = {restarts} threads in each, on device {str(on)!r}"):
        searched, kernel = searched_worlds(problem, on)
        plans = started(problem, given, restarts, seed, on)
        drawing = torch.from_numpy(PROFILES.copy()).to(on)
        for number in range(rounds if seconds is None else 1 << 20):
            asked = (searched, plans, drawing, drawn if number == 0 else 0, changes)
            kernel.launch(on, n * restarts, *asked)
            plans = met(plans, n, restarts, number)
            if seconds is not None:
                plans.values[0].item()  # waits for the device
                if time.monotonic() - begun >= seconds:
                    break
        searched.numbers[STEPWISE] = 1.0
        kernel.launch(on, n * restarts, searched, plans, drawing, 0, changes)
    values, best = plans.values.reshape(restarts, n).min(dim=0)
    failed = torch.isinf(values).nonzero()[:, 0].tolist()
    if failed:
        raise PhysicsError(dict.fromkeys(failed, "no profile could be simulated"))
    rows = best * n + torch.arange(n, device=on)
    ends, commands = plans.ends[:, rows].cpu().numpy(), plans.commands[..., rows].cpu().numpy()
    found = Profiles(ends.T.copy(), np.moveaxis(commands, -1, 0).copy())
    return found, problem.values(found)


def best_alone(problem: Problem, search: Callable[..., Any]) -> Profiles:
    """Search the best profile of each controlled vehicle while the others brake fully; return the best one, [n].

    ``search``: searches a problem with one vehicle and returns profiles first.
    """
    results, braking = [], -problem.state.car[:, BRAKING][:, problem.bodies]
    for c, body in enumerate(problem.bodies.tolist()):
        wanted = problem.state.wanted.copy()
        wanted[:, problem.bodies] = braking
        wanted[:, body] = 0.0
        best, _ = search(problem._replace(bodies=problem.bodies[[c]], state=problem.state._replace(wanted=wanted)))
        commands = np.repeat(braking[:, np.newaxis], best.ends.shape[1], axis=1)
        commands[:, :, c] = best.commands_mps2[:, :, 0]
        both = Profiles(best.ends, commands)
        results.append((problem.value(problem.follow(both)), both))
    return best_of(results)[1]


def searched_worlds(problem: Problem, on: torch.device) -> tuple[Searched, Kernel]:
    def moved(array: Any) -> Tensor:
        return torch.from_numpy(np.moveaxis(array, 0, -1).copy()).to(on)

    count, state = problem.harm_count, problem.state
    numbers = np.array([problem.time_step_s, problem.aim, 0.0])
    weights = np.stack([weights_of(count), weights_of(other_count(count))])
    at = rows_of(state, int(problem.bodies[0]))
    forward = (state.speeds_mps >= 0.0).all(axis=1) & (len(problem.bodies) == 1)
    by_world = (state.line, state.car, state.clock, state.wanted, problem.bounds, problem.shares, at, forward)
    searched = Searched(
        *(moved(each) for each in by_world),
        *(torch.from_numpy(each.copy()).to(on) for each in (problem.bodies, numbers, weights)),
    )
    size = state.vehicles + 1, len(problem.bodies)
    shapes = shapes_of(*size)
    kinds = [
        np.uint64 if name == "random" else np.int64 if name in WHOLE_NUMBERS else np.float64 for name in Own._fields
    ]
    memory = Own(*(np.zeros(shape, kind) for shape, kind in zip(shapes, kinds, strict=True)))
    return searched, Kernel("search", size, shapes, search_each, memory)


def started(problem: Problem, given: Profiles | None, restarts: int, seed: int, on: torch.device) -> Plans:
    """Return the profiles of all ``restarts`` n threads before the first round: those in ``given``, or none.

    ``on``: device of the tensors. Raises ``InvalidInput`` if ``given`` does not fit.
    """
    n, C = problem.n, len(problem.bodies)
    ends = np.repeat(problem.last_step[:, np.newaxis], MOST_PHASES, axis=1)[np.newaxis].repeat(restarts, axis=0)
    commands, phases = np.zeros((restarts, n, MOST_PHASES, C)), np.zeros((restarts, n), np.int64)
    if given is not None:
        short = given.shortened()
        Q = len(short.ends) // n
        if len(short.ends) != n * Q or not Q:
            raise InvalidInput(f"given: has {len(short.ends)} profiles; must have some for each of the {n} worlds")
        if not restarts >= Q:
            what = "with one for several vehicles, " if C > 1 else ""
            raise InvalidInput(
                f"given: has {Q} profiles for each world, {what}but {restarts} threads search it (restarts)"
            )
        problem.take(np.repeat(np.arange(n), Q)).check(short)
        ends[:Q] = np.moveaxis(short.ends.reshape(n, Q, -1), 1, 0)
        commands[:Q] = np.moveaxis(short.commands_mps2.reshape(n, Q, MOST_PHASES, C), 1, 0)
        phases[:Q] = (ends[:Q] == problem.last_step[:, np.newaxis]).argmax(axis=2) + 1
    random = np.concatenate([seeded(problem.identity, seed * restarts + r) for r in range(restarts)])
    arrays = (
        np.moveaxis(ends.reshape(-1, MOST_PHASES), 0, -1),
        np.moveaxis(commands.reshape(-1, MOST_PHASES, C), 0, -1),
        phases.reshape(-1),
        np.full(restarts * n, np.inf),
        random.view(np.int64),
    )
    return Plans(*(torch.from_numpy(each.copy()).to(on) for each in arrays))


def met(plans: Plans, n: int, restarts: int, number: int) -> Plans:
    """Return the profiles after threads of the same world have met in pairs: both have the better one.

    ``number``: round, from 0. From round to round a thread meets a nearer one, so after log2(``restarts``) rounds the
    best can have reached all.
    """
    if restarts == 1:
        return plans
    apart = restarts >> (1 + number % (restarts.bit_length() - 1))
    values = plans.values.reshape(-1, 2, apart, n)
    rows = torch.arange(restarts * n, device=values.device).reshape(values.shape)
    better = torch.where(values[:, :1] <= values[:, 1:], rows[:, :1], rows[:, 1:]).expand_as(rows).reshape(-1)
    ends, commands = plans.ends[:, better].contiguous(), plans.commands[..., better].contiguous()
    return Plans(ends, commands, plans.phases[better], plans.values[better], plans.random)
