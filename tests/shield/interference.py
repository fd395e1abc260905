"""Refused calls, exceptions, interrupts and wrappers, on every interface: what was realised against the bound.

``disturbed(interface, episodes, seed)`` plays episodes in which calls are refused, raise, or are interrupted at random
lines; ``wrapped(interface, wrapper, calls, seed)`` steps with a wrapper between the shield and the engine. Harm is read
by a watcher of its own from the engine's ledger, of every episode that ended.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.shield import MovingAtHorizon
from tests.shield.plays import PLAYS as ONE_SHIELDED, Failure, Play
from tests.shield.team_plays import TEAM_PLAYS

PLAYS: dict[str, type[Play]] = {**ONE_SHIELDED, **TEAM_PLAYS}
LINES = (50, 200, 800)  # an interrupt comes at one of the first so many lines of a call, if it has so many


class Tally(NamedTuple):
    """What happened."""

    episodes: int
    above: int  # episodes that ended above the bound told at their alert
    refused: int  # calls that raised
    interrupted: int
    broken: int  # times that bound, plan, trust or place in the episode were not as they should be after that


@contextlib.contextmanager
def interrupt_at(line: int) -> Iterator[None]:
    """Ctrl-C at that line of Python, counted from here; not within the compiler, which would be left half done."""
    left = line

    def trace(frame: Any, event: str, argument: Any) -> Any:
        nonlocal left
        if "numba" in frame.f_code.co_filename:
            return None
        if event == "line":
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


def disturbed(name: str, episodes: int, seed: int) -> Tally:
    """Play so many episodes through an interface; before every second step something fails or is interrupted."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MovingAtHorizon)
        play = PLAYS[name](seed)
        for _ in range(3):
            play.step()  # compiles what is not compiled yet: whose lines would be counted
        refused = interrupted = broken = 0
        while len(_ended(play)) < episodes:
            if play.engine().ended.all():
                play.step()  # begins the next episode
            kind, before, made = int(play.rng.integers(5)), play.known(), play.made()
            if kind == 0 and play.bad:
                with contextlib.suppress(EthBrakeError, Failure):
                    play.bad[int(play.rng.integers(len(play.bad)))]()
                    broken += 1  # it did not raise
                refused += 1
            elif kind == 1:
                play.raises = str(play.rng.choice(["before", "after"]))
                with contextlib.suppress(Failure):
                    play.step()
                play.raises, refused = None, refused + 1
            elif kind == 2:
                try:
                    with interrupt_at(int(play.rng.integers(1, play.rng.choice(LINES)))):
                        play.step()
                except KeyboardInterrupt:
                    interrupted += 1
            else:
                play.step()
            if play.made() == made and kind != 2:
                broken += play.known() != before
            broken += _astray(play)
        ended = _ended(play)
    above = sum(harm > bound + 1e-9 for harm, bound in ended)
    return Tally(len(ended), above, refused, interrupted, broken)


def _astray(play: Play) -> int:
    """1 where the shield is not where the engine is, or trusts it no longer."""
    shield, engine = play.shield(), play.engine()
    there = (shield.running.steps == engine.steps)[~engine.ended].all()
    return int(not there or shield.distrusted.any())


def _ended(play: Play) -> list[tuple[float, float]]:
    """Harm and bound of the episodes that have ended."""
    done: list[tuple[float, float]] = play.engine().memory(play.recorder)[1]
    return [*getattr(play, "done", []), *done]


def _scaled(actions: Any, factor: float) -> Any:
    if isinstance(actions, dict):
        return {name: _scaled(action, factor) for name, action in actions.items()}
    return np.asarray(actions) * factor


def skip(frames: int) -> Callable[..., Any]:
    """A frame skip."""

    def how(step: Callable[[Any], Any], actions: Any) -> Any:
        for _ in range(frames):
            told = step(actions)
        return told

    return how


def changing(step: Callable[[Any], Any], actions: Any) -> Any:
    return step(_scaled(actions, 0.5))


def twice(step: Callable[[Any], Any], actions: Any) -> Any:
    step(_scaled(actions, 0.0))
    return step(actions)


class Swallowing:
    """Every third step is not made; the last answer is given again."""

    def __init__(self) -> None:
        self.calls, self.told = 0, None

    def __call__(self, step: Callable[[Any], Any], actions: Any) -> Any:
        self.calls += 1
        if self.calls % 3:
            self.told = step(actions)
        return self.told


WRAPPERS: dict[str, Callable[[], Callable[..., Any]]] = {
    "frame skip 2": lambda: skip(2), "frame skip 80": lambda: skip(80), "changes actions": lambda: changing,
    "steps twice": lambda: twice, "swallows steps": Swallowing,
}  # fmt: skip


def wrapped(name: str, wrapper: str, calls: int, seed: int) -> Tally:
    """So many steps with a wrapper inside, whose actions reach the engine; what is raised is caught."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MovingAtHorizon)
        play = PLAYS[name](seed)
        play.how = WRAPPERS[wrapper]()
        refused = broken = 0
        for _ in range(calls):
            with contextlib.suppress(
                EthBrakeError
            ):  # at the end of an episode also the plain one, "no episode is running"
                play.step()
                refused -= 1
            refused += 1
            broken += _astray(play)
        ended = _ended(play)
    return Tally(len(ended), sum(harm > bound + 1e-9 for harm, bound in ended), refused, 0, broken)
