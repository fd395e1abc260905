"""The sequence of worlds of an environment: the training worlds of a seed, or the worlds that a reset specifies."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.infos import WORLD, numbers
from ethbrake_marl.episode.state import FIRST_IN_LIST, NUMBER, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import Ints
from ethbrake_marl.worlds.describe import columns_of
from ethbrake_marl.worlds.sampling import DrawnWorlds, merge_draws
from ethbrake_marl.worlds.scenario import Scenario
from ethbrake_marl.worlds.user_worlds import worlds_from_state

OPTIONS = ("initial_state", "listed_world")


class UnknownResetOption(UserWarning):
    """``options`` of ``reset`` has an unknown key."""


class Stream(NamedTuple):
    """The training worlds of a seed, one after the other. World k of a seed is the same in every row.

    A stream never changes. A method that begins episodes also returns a new stream, which continues after their worlds.
    """

    scenario: Scenario
    game: Game
    seed: Any = None  # of all rows, or of each row, [n]
    next: Any = 0  # number of the next world, of all rows or of each row
    option_worlds: tuple[DrawnWorlds, int] | None = (
        None  # the worlds that the last reset asked for, and their seed or -1
    )

    def reset(self, n: int, seed: Any, options: Any = None) -> tuple[Stream, State]:
        """Stream for later episodes, and new episodes in the first n worlds of a seed.

        Without a seed the next n worlds begin; the first reset without a seed draws a random seed. With a list of n
        seeds each row begins with the first world of its own seed. ``options`` may specify the worlds instead. Raises
        ``InvalidInput`` for a bad seed or option; warns of unknown options.
        """
        chosen, first = self.seed, self.next
        if isinstance(seed, list | tuple | range) or (isinstance(seed, np.ndarray) and seed.ndim):
            if len(seed) != n:
                raise InvalidInput(f"reset: seed has {len(seed)} entries; must be one seed, or a list of {n} seeds")
            chosen, first = [chosen_seed(row_seed) for row_seed in seed], np.zeros(n, np.int64)
        elif seed is not None or chosen is None:
            chosen, first = chosen_seed(seed), 0
        option_worlds = self._worlds_of_options(n, options)
        worlds, after = (
            self._draw(np.arange(n), chosen, first) if option_worlds is None else (option_worlds[0].worlds, first)
        )
        return self._replace(seed=chosen, next=after, option_worlds=option_worlds), self.game.reset(worlds)

    def next_episodes(self, rows: Ints) -> tuple[Stream, State]:
        """The new episodes share no arrays with others."""
        worlds, after = self._draw(rows, self.seed, self.next)
        return self._replace(next=after), self.game.reset(worlds)

    def _draw(self, rows: Ints, seed: Any, first: Any) -> tuple[State, Any]:
        if isinstance(seed, int):
            return self.game.draw(len(rows), seed, first), first + len(rows)
        row_worlds = [self.scenario.sample(1, int(seed[k]), first=int(first[k]), purpose="training") for k in rows]
        return State.join(row_worlds), first + np.isin(np.arange(len(first)), rows)

    def seeds_of(self, state: State, rows: Any = slice(None)) -> Any:
        """-1 for a world that the caller supplied."""
        seed = self.seed if isinstance(self.seed, int) else exact_array(self.seed)[rows]
        if self.option_worlds is None:
            return seed
        is_of_options = state.clock[:, NUMBER] < 0.0
        return exact_array(np.where(is_of_options, self.option_worlds[1], np.asarray(seed, object)).tolist())

    def describe(self, state: State) -> dict[str, Any]:
        """Name such as ``gap_1_m`` or ``scenario`` -> [n]."""
        index, seeds = state.clock[:, NUMBER].astype(np.int64), np.full(state.n, self.seed, object)
        place, parts = np.arange(state.n), [] if self.option_worlds is None else [self.option_worlds[0]]
        of_stream = np.flatnonzero(index >= 0)
        place[of_stream] = np.arange(len(of_stream)) + len(parts) * state.n
        parts += [self.scenario.draw(1, int(seeds[k]), first=int(index[k]), purpose="training") for k in of_stream]
        drawn_worlds = merge_draws(parts, np.arange(sum(part.worlds.n for part in parts)))
        columns = {name: column[place] for name, column in columns_of(drawn_worlds).items()}
        world = numbers(state, np.array([1]))[WORLD, :, 0].astype(np.int64)
        return {**columns, "world_seed": np.full(state.n, self.seeds_of(state)), "world": world}

    def _worlds_of_options(self, n: int, options: Any) -> tuple[DrawnWorlds, int] | None:
        """With their seed (-1: no seed); None if there are none."""
        if options is None:
            return None
        if not isinstance(options, Mapping):
            example = f"{{'{OPTIONS[0]}': ...}}"
            raise InvalidInput(f"reset: options = {options!r}: must be None or a mapping, for instance {example}")
        if unknown := sorted(str(name) for name in options if name not in OPTIONS):
            warnings.warn(
                f"reset: options has the unknown keys {', '.join(unknown)}, which are ignored; known keys:"
                f" {', '.join(OPTIONS)}",
                UnknownResetOption,
                stacklevel=4,
            )
        if all(name in options for name in OPTIONS):
            raise InvalidInput(f"reset: options has both {OPTIONS[0]} and {OPTIONS[1]}; pass only one of them")
        if "initial_state" in options:
            initial_world = worlds_from_state(self.scenario, options["initial_state"])
            return DrawnWorlds.from_state(initial_world.take(np.zeros(n, np.int64))), -1
        if "listed_world" not in options:
            return None
        listed_world = options["listed_world"]
        if not isinstance(listed_world, Mapping) or set(listed_world) != {"seed", "number"}:
            raise InvalidInput(
                f"reset: listed_world = {listed_world!r}: must be seed and number of a world in an evaluation list, for"
                " instance {'seed': 7, 'number': 3}"
            )
        drawn_worlds = self.scenario.draw(n, listed_world["seed"], first=listed_world["number"])
        drawn_worlds.worlds.clock[:, NUMBER] = FIRST_IN_LIST - drawn_worlds.worlds.clock[:, NUMBER]
        return drawn_worlds, int(listed_world["seed"])


def exact_array(values: Sequence[int]) -> NDArray[Any]:
    """Whole numbers without rounding: int64, else uint64, else objects. (numpy makes floats of 1 and 2**63.)"""
    for kind in (np.int64, np.uint64):
        try:
            return np.array(values, kind)
        except OverflowError:
            continue
    return np.array(values, object)


def chosen_seed(seed: int | None) -> int:
    """A random seed of 63 bits for None. Raises ``InvalidInput``."""
    if seed is None:
        return int.from_bytes(np.random.SeedSequence().generate_state(2).tobytes(), "little") % 2**63
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r:.60}: must be None or a whole number, at least 0")
    return int(seed)
