"""A running engine as plain arrays, and back: its worlds go on as if nothing had happened, to the same bits."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.engine.engine import RUNNING, Engine
from ethbrake_marl.engine.stream import Roster
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observations
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import (
    TIME,
    command_at,
    gap_at,
    harm_at,
    has_messages,
    has_news,
    pack,
    params_at,
    previous_at,
    speed_at,
    vehicles_in,
)
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.messages import hear_rows

Arrays = dict[str, NDArray[Any]]


def engine_snapshot(engine: Engine) -> Arrays:
    """Copies of everything that changes while the engine runs: its rows, its place in the stream, scripts' memories.

    The stream is one number: worlds are pure functions of the seed and of where they stand in it.
    """
    arrays: Arrays = {name.lstrip("_"): getattr(engine, name).copy() for name in RUNNING}
    stream = engine._stream
    arrays["stream"] = np.array([stream.seed, stream.position], np.uint64)
    for vehicle, script in engine._remembering.items():
        arrays |= {f"script.{vehicle}.{name}": array.copy() for name, array in _memory(script).items()}
    return arrays


def restore_engine(engine: Engine, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Bring an engine of the same scenario, size and scripts to the state of ``engine_snapshot``.

    Raises ``InvalidInput``, before anything is changed, naming the array that is missing or has another shape, and
    where a shield stands in the engine, which would know nothing of these worlds.
    """
    if engine.guard is not None:
        raise InvalidInput("engine snapshot: a shield stands in this engine; restore first, then put the shield around")
    for name in RUNNING:
        have, wanted = arrays.get(name.lstrip("_")), getattr(engine, name)
        if have is None or have.shape != wanted.shape:
            shape = "nothing" if have is None else have.shape
            raise InvalidInput(f"engine snapshot: {name.lstrip('_')} is {shape}; {wanted.shape} is needed")
    for name in RUNNING:
        setattr(engine, name, np.array(arrays[name.lstrip("_")], np.float64))
    seed, taken = (int(number) for number in arrays["stream"])
    engine._stream.restart(seed)
    engine._stream._drawn = taken
    engine.roster = Roster(engine.n, seed, None)  # a snapshot does not keep the numbers of running episodes
    for vehicle, script in engine._remembering.items():
        prefix = f"script.{vehicle}."
        _remember(script, {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)})


def _memory(owner: object) -> Arrays:
    """Arrays that an agent keeps, by attribute; those of records (named tuples) and of agents inside it with a dot."""
    arrays: Arrays = {}
    for name, value in vars(owner).items() if hasattr(owner, "__dict__") else ():
        if isinstance(value, np.ndarray):
            arrays[name] = value
        elif _is_record(value):
            arrays |= {f"{name}.{field}": part for field, part in value._asdict().items()}
        elif hasattr(value, "begin") and hasattr(value, "act"):
            arrays |= {f"{name}.{inner}": part for inner, part in _memory(value).items()}
    return arrays


def _remember(owner: Any, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Give an agent its arrays back."""
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for name, array in arrays.items():
        head, dot, inner = name.partition(".")
        if dot:
            groups.setdefault(head, {})[inner] = array
        else:
            setattr(owner, head, array.copy())
    for head, inside in groups.items():
        value = getattr(owner, head)
        if _is_record(value):
            setattr(owner, head, type(value)(**{field: part.copy() for field, part in inside.items()}))
        else:
            _remember(value, inside)


def _is_record(value: object) -> bool:
    """Whether it is a named tuple of arrays."""
    return isinstance(value, tuple) and hasattr(value, "_asdict") and all(isinstance(v, np.ndarray) for v in value)


# Branches of running episodes: the same moment, played on to the end in more than one way.
#
# A learner's action is moved by an offset for a few steps; then the policy goes on in closed loop. What two branches
# gain differs by nothing but the offset: everything else in them is the same, to the bit.

ROUNDING_MPS2 = 1e-5  # a command that differs by less is the same: networks round by the size of their batch

Act = Callable[[Observations], NDArray[np.float32]]  # observations [rows, F] -> actions [rows] in [-1, 1]

Decide = Callable[[Observations, Ints, int], Floats]  # what is seen [m, L, F] in rows [m], steps made -> actions [m, L]


class Moment(NamedTuple):
    """Running worlds between two steps, row by row."""

    state: Floats  # as rows of ``physics.rows``
    params: Floats
    clock: Floats
    wanted: Floats

    def take(self, rows: Ints) -> Moment:
        """Some of the rows, or one of them several times."""
        return Moment(*(array.take(rows, axis=0) for array in self))


class Offsets(NamedTuple):
    """How one learner's actions in each row differ from those of its policy."""

    learner: Ints  # [n] place among the learners
    size: Floats  # [n] added to its action, which stays in [-1, 1]
    steps: Ints  # [n] for so many steps, at least 1


def no_offsets(n: int) -> Offsets:
    """Of the first learner in ``n`` rows: its policy drives."""
    return Offsets(np.zeros(n, np.int64), np.zeros(n), np.zeros(n, np.int64))


def moment_of(engine: Engine) -> Moment:
    """The present moment of all rows, in its own memory."""
    return Moment(engine._state.copy(), engine._params.copy(), engine._clock.copy(), engine._wanted.copy())


def first_moments(engine: Engine, count: int) -> tuple[Worlds, Moment]:
    """The first ``count`` worlds of the engine's training stream, at the alert, and at their first decision."""
    stream = copy.copy(engine._stream)
    stream.restart(engine.seed)
    start = stream.take(count)
    packed = engine._kept(start.packed)
    params = packed.params.copy()
    if has_messages(packed.state, params):
        alert = engine._kept(pack(start.alert)).state
        start_s = packed.state[:, TIME]
        hear_rows(alert, params, start.wanted, start_s, start_s, engine.scenario.time_step_s)
    return start.alert, Moment(packed.state.copy(), params, start.clock.copy(), start.wanted.copy())


def join_moments(moments: list[Moment]) -> Moment:
    """The rows of all of them, one after the other; all are of one engine."""
    return Moment(*(np.concatenate(arrays) for arrays in zip(*moments, strict=True)))


def branch(engine: Engine, moment: Moment) -> Engine:
    """An engine of the same scenario whose rows go on from ``moment``; ``engine`` is not touched.

    Raises ``InvalidInput`` for an engine with a reward that is shaped, which tells of more than what happens, or with a
    script that remembers its episode: it has no memory of the branch.
    """
    if engine.reward.shaping > 0.0:
        raise InvalidInput(f"branches: reward: shaping = {engine.reward.shaping:g}: must be 0; a branch has an end")
    for vehicle, script in engine._remembering.items():
        name = getattr(script, "name", type(script).__name__)
        raise InvalidInput(
            f"branches: vehicle_{vehicle + 1} is driven by {name!r}, which remembers its episode; only scripts whose"
            " command is fixed at the alert can be branched, such as full_brake, coast and constant:A"
        )
    new = copy.copy(engine)
    new.n, new._memories = len(moment.state), {}
    new.protect(None)
    new.roster = Roster(new.n, engine.seed, None)
    new.roster.warns = False
    new._state, new._params, new._clock, new._wanted = (array.copy() for array in moment)
    new._potential = np.zeros(moment.wanted.shape)
    return new


def play_to_the_end(engine: Engine, act: Act, offsets: Offsets, gamma: float) -> tuple[Floats, Floats]:
    """Play every row to the end of its episode; what its learner of ``offsets`` gains, and how far it was moved.

    Args:
        engine: branches, which this changes.
        act: drives all learners, by nothing but what is seen.
        offsets: whose actions are moved in each row, how far, and how long.
        gamma: discount of one time step.

    Returns the return [n] of that learner from now on (NaN for a row that could not be advanced), and the sum of the
    offsets that its actions, which stay in [-1, 1], had room for [n]. Where the reward is of harm alone, a row ends as
    soon as nothing can change any more.

    """
    moved, most = np.zeros(engine.n), int(offsets.steps.max(initial=0))

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        wanted = act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])
        if number < most:
            _add(wanted, offsets, rows, number, moved)
        return wanted

    gained = play_on(engine, decide, gamma, at_least=most)
    return gained[np.arange(engine.n), offsets.learner], moved


def play_on(engine: Engine, decide: Decide, gamma: float, *, at_least: int = 0) -> Floats:
    """Play every row to the end of its episode, ``at_least`` so many steps; what each learner gains, [n, L].

    ``decide`` gives the learners' actions. The rest is as for ``play_to_the_end``.
    """
    vehicles = np.array(engine.learners, np.int64)
    gained, actions = np.zeros((engine.n, len(vehicles))), np.zeros((engine.n, len(vehicles)))
    running, discount, number = np.flatnonzero(~engine.ended), 1.0, 0
    only_harm = set(engine.reward_terms) <= {"harm"}
    while len(running):
        before = engine._state.take(running, axis=0)
        actions[running] = decide(engine.observe_all(vehicles, running), running, number)
        step = engine.step(actions)
        gained[running] += discount * step.reward[running][:, vehicles]
        goes_on = ~engine.ended[running]
        if only_harm and number >= at_least:
            goes_on &= ~_stands_for_good(engine, before, running)
        running = running[goes_on]
        discount *= gamma
        number += 1
    gained[list(engine.roster.failed)] = np.nan
    return gained


def visit(engine: Engine, act: Act) -> tuple[Observations, Moment]:
    """Play every row to its end by ``act``: what is seen at each decision [m, L, F], and those moments [m]."""
    seen_then, moments = [], []

    def decide(seen: Observations, rows: Ints, number: int) -> Floats:
        seen_then.append(seen)
        moments.append(moment_of(engine).take(rows))
        return act(seen.reshape(-1, seen.shape[2])).astype(np.float64).reshape(seen.shape[:2])

    play_on(engine, decide, 1.0)
    return np.concatenate(seen_then), join_moments(moments)


def _stands_for_good(engine: Engine, before: Floats, rows: Ints) -> Bools:
    """In which of ``rows`` everything stands as it stood ``before`` [rows], and the same is going to be done again.

    A policy that sees the same does the same, and no latency or news is left that could change what it sees.
    """
    if has_messages(engine._state, engine._params):
        return np.zeros(len(rows), np.bool_)  # what is still on its way may change what it sees
    stands = np.empty(len(rows), np.bool_)
    find_standing(engine._state, before, engine._params, rows, stands)
    return stands


@compiled
def find_standing(state: Floats, before: Floats, params: Floats, rows: Ints, stands: Bools) -> None:
    """Fill ``stands`` [m] for ``rows`` [m] of ``state``, which stood as ``before`` [m]."""
    N = vehicles_in(state)
    for m in range(rows.shape[0]):
        k, same = rows[m], True
        for c in range(speed_at(N), command_at(N)):
            same = same and before[m, c] == 0.0 and state[k, c] == 0.0
        if same:
            for c in range(gap_at(N), harm_at(N)):
                same = same and state[k, c] == before[m, c]
            for c in range(command_at(N), previous_at(N)):
                same = same and abs(state[k, c] - before[m, c]) < ROUNDING_MPS2
            for c in range(params_at(2, N), params.shape[1]):
                known = params_at(2, N) <= c < params_at(3, N) or (has_news(params, N) and c >= params_at(6, N))
                same = same and (not known or params[k, c] < before[m, TIME] or np.isinf(params[k, c]))
        stands[m] = same


def _add(wanted: Floats, offsets: Offsets, running: Ints, number: int, moved: Floats) -> None:
    """Add the offsets that still last to the actions ``wanted`` [running, L], and to what was ``moved`` so far."""
    some = np.flatnonzero(number < offsets.steps[running])
    rows = running[some]
    before = wanted[some, offsets.learner[rows]]
    after = np.clip(before + offsets.size[rows], -1.0, 1.0)
    wanted[some, offsets.learner[rows]] = after
    moved[rows] += after - before
