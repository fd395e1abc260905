"""The sequence of worlds of an environment: the training worlds of a seed, or the worlds that a reset specifies."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.describe import columns_of
from ethbrake_marl.worlds.given import worlds_from_state
from ethbrake_marl.worlds.sampling import Drawn, merged
from ethbrake_marl.worlds.scenario import Scenario

OPTIONS = ("initial_state", "listed_world")


class UnknownResetOption(UserWarning):
    """``options`` of ``reset`` has an unknown key."""


class Stream(NamedTuple):
    """The training worlds of a seed, one after the other. World k of a seed is always the same, in any row.

    It is never changed: who begins episodes gets the stream of the worlds that follow.
    """

    scenario: Scenario
    game: Game
    seed: int | None = None
    next: int = 0  # number of the next world
    given: Drawn | None = None  # the worlds that the last reset asked for

    def reset(self, n: int, seed: int | None, options: Any = None) -> tuple[Stream, State]:
        """Return new episodes in the first n worlds of ``seed``, or in the next n worlds if it is None.

        The first reset without a seed draws a random one. ``options`` may specify the worlds instead. Raises
        ``InvalidInput`` for a bad seed or option; warns of unknown options.
        """
        first = self.next if seed is None else 0
        seed = chosen_seed(self.seed if seed is None else seed)
        given = self._asked_for(n, options)
        state = self.game.reset(self.game.draw(n, seed, first) if given is None else given.worlds)
        return self._replace(seed=seed, next=first + (n if given is None else 0), given=given), state

    def next_episodes(self, n: int) -> tuple[Stream, State]:
        """Return new episodes in the next n worlds. They share no memory with other episodes."""
        assert self.seed is not None
        return self._replace(next=self.next + n), self.game.reset(self.game.draw(n, self.seed, self.next))

    def describe(self, state: State) -> dict[str, Any]:
        """Return the drawn values of each running world: name such as ``gap_1_m`` or ``scenario`` -> [n]."""
        numbers, seed = state.clock[:, NUMBER].astype(np.int64), self.seed or 0
        place, parts = np.arange(state.n), [] if self.given is None else [self.given]
        of_stream = np.flatnonzero(numbers >= 0)
        place[of_stream] = np.arange(len(of_stream)) + len(parts) * state.n
        parts += [self.scenario.draw(1, seed, first=int(k), channel="training") for k in numbers[of_stream]]
        drawn = merged(parts, np.arange(sum(part.worlds.n for part in parts)))
        columns = {name: column[place] for name, column in columns_of(drawn).items()}
        return {**columns, "world_seed": np.full(state.n, seed), "world": numbers}

    def _asked_for(self, n: int, options: Any) -> Drawn | None:
        """Return the worlds that ``options`` of a reset specify, or None."""
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
            one = worlds_from_state(self.scenario, options["initial_state"])
            return Drawn.given(one.take(np.zeros(n, np.int64)))
        if "listed_world" not in options:
            return None
        wanted = options["listed_world"]
        if not isinstance(wanted, Mapping) or set(wanted) != {"seed", "number"}:
            raise InvalidInput(
                f"reset: listed_world = {wanted!r}: must be seed and number of a world in an evaluation list, for"
                " instance {'seed': 7, 'number': 3}"
            )
        drawn = self.scenario.draw(n, wanted["seed"], first=wanted["number"])
        drawn.worlds.clock[:, NUMBER] = -1.0
        return drawn


def chosen_seed(seed: int | None) -> int:
    """Return the seed, or for None a random one of 63 bits. Raises ``InvalidInput`` for a bad seed."""
    if seed is None:
        return int.from_bytes(np.random.SeedSequence().generate_state(2).tobytes(), "little") % 2**63
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r}: must be None or a whole number, at least 0")
    return int(seed)
