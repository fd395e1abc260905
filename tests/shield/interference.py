"""Refused calls, exceptions, interrupts and wrappers in between, on every face: what was realised against the bound.

``FACES[name](episodes, seed)`` plays episodes in which calls are refused, raise or are interrupted at random lines;
``WRAPPED[name](how, calls, seed)`` steps with a wrapper between the shield and the engine. Both return a ``Tally``.
Harm is read by a watcher of its own from the engine's ledger, of every episode that ended.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from pettingzoo.utils import BaseParallelWrapper

from ethbrake_marl.agents.driving import episode_engine
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.envs.parallel import EthBrakeParallelEnv, parallel_env
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.envs.vector import EthBrakeVectorEnv
from ethbrake_marl.errors import EthBrakeError, UncertifiedStep
from ethbrake_marl.shield import (
    HybridShield,
    MovingAtHorizon,
    ShieldedEnv,
    ShieldedVectorEnv,
    StepShieldAgent,
    shielded_aec,
)
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from tests.shield.lines import line

ROWS = 5  # worlds of the batched faces
SCENARIO = line(3)
LINES = 1_500  # an interrupt comes at one of the first lines of a call, if it has so many


class Tally(NamedTuple):
    """What happened."""

    episodes: int
    above: int  # episodes that ended above the bound told at their alert
    refused: int  # calls that raised
    interrupted: int
    broken: int  # times that bound, plan, trust or place in the episode were not as they should be after that


class Failure(Exception):
    """Raised by a policy or a wrapper of the tests."""


class Recorder:
    """A watcher that notes harm and bound of every episode that ends."""

    def __init__(self, shield_of: Callable[[], Any]) -> None:
        self.shield_of = shield_of

    def begun(self, memory: Any, alert: Any, rows: Any) -> Any:
        return memory

    def stepped(self, memory: Any, before: Any, after: Any) -> Any:
        over = after.ended & ~before.ended
        if not over.any():
            return memory
        harm, bound = after.ledger.world_harm("first"), self.shield_of().first_bound
        return [*memory, *zip(harm[over].tolist(), bound[over].tolist(), strict=True)]


class Failing:
    """A policy that brakes by turns, and raises when it is told to."""

    name, fails = "failing", False

    def begin(self, worlds: Any, vehicle: int, rows: Any) -> None:
        pass

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        if self.fails:
            raise Failure
        wave = np.sin(17.0 * worlds.time_s + worlds.gaps_m[:, 0])
        return np.where(wave > 0.0, 0.0, wave * worlds.vehicles.braking_capacity_mps2[:, vehicle])


class Play:
    """One face behind the shield: ``step`` makes a step with fresh proposals, ``bad`` are calls that must raise."""

    def __init__(self, seed: int) -> None:
        self.rng, self.policy = np.random.default_rng(seed), Failing()
        self.raises: str | None = None  # where the wrapper in between raises
        self.how: Callable[..., Any] = self._failing
        self.bad: list[Callable[[], Any]] = []
        self._watched()

    def _watched(self) -> None:
        self.recorder = Recorder(self.shield)
        self.engine().watch(self.recorder, [])

    def engine(self) -> Any:
        raise NotImplementedError

    def shield(self) -> Any:
        raise NotImplementedError

    def step(self) -> None:
        raise NotImplementedError

    def _failing(self, step: Callable[[Any], Any], actions: Any) -> Any:
        if self.raises == "before":
            raise Failure
        told = step(actions)
        if self.raises == "after":
            raise Failure
        return told

    def drawn(self, *shape: int) -> np.ndarray:
        return self.rng.choice([self.rng.uniform(-1.0, 1.0), -1.0, 1.0]) * np.ones(shape)

    def known(self) -> list[Any]:
        """What must not change when nothing happens: bound, plan, trust, place in the episodes."""
        shield = self.shield()
        held = [shield.bound, shield.backup.plan, shield.distrusted, shield.running.steps, shield.running.states]
        return [array.tolist() for array in held]


class Parallel(Play):
    """PettingZoo parallel."""

    def _watched(self) -> None:
        inner = _ParallelBetween(parallel_env(SCENARIO), self)
        self.env = HybridShield(inner, self.policy, mode="step")
        self.bad = [
            lambda: self.env.step({"vehicle_2": np.zeros(1), "vehicle_9": np.zeros(1)}),
            lambda: self.env.step({"vehicle_2": np.array([np.nan])}),
            lambda: self.env.step({"vehicle_2": np.zeros(3)}),
            lambda: self.env.step([0.0]),
            lambda: self.env.reset(options={"initial_state": {"gaps_m": [-1, 1], "speeds_mps": [1, 1, 1]}}),
            self._policy_fails,
        ]
        super()._watched()
        self.env.reset(seed=int(self.rng.integers(10**6)))

    def _policy_fails(self) -> None:
        self.policy.fails = True
        try:
            self.env.step({})
        finally:
            self.policy.fails = False

    def engine(self) -> Any:
        return self.env.unwrapped.engine

    def shield(self) -> Any:
        return self.env.attached.shield

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        self.env.step({} if self.rng.random() < 0.3 else {"vehicle_2": self.drawn(1)})


class Aec(Play):
    """PettingZoo AEC."""

    def _watched(self) -> None:
        self.env = shielded_aec(_ParallelBetween(parallel_env(SCENARIO), self), mode="step")
        shielded: Any = self.env
        while not isinstance(shielded, HybridShield):
            shielded = shielded.env
        self.shielded = shielded
        super()._watched()
        self.env.reset(seed=int(self.rng.integers(10**6)))

    def engine(self) -> Any:
        return self.shielded.unwrapped.engine

    def shield(self) -> Any:
        return self.shielded.attached.shield

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        before = self.engine().steps_made
        while self.engine().steps_made == before:
            self.env.step(self.drawn(1).astype(np.float32))


class Single(Play):
    """Gymnasium."""

    def _watched(self) -> None:
        plain = gymnasium.make("EthBrake-v0", scenario=SCENARIO).unwrapped
        self.env = ShieldedEnv(_SingleBetween(plain, self))
        self.bad = [
            lambda: self.env.step(np.array([np.nan])),
            lambda: self.env.step(np.zeros(2)),
            lambda: self.env.step(np.array([1j])),
            lambda: self.env.reset(seed=-1),
            lambda: self.env.reset(options={"initial_state": {"gaps_m": [1], "speeds_mps": [1, 1, 1]}}),
        ]
        super()._watched()
        self.env.reset(seed=int(self.rng.integers(10**6)))

    def engine(self) -> Any:
        return self.env.attached.engine

    def shield(self) -> Any:
        return self.env.attached.shield

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        self.env.step(self.drawn(1))


class Vector(Single):
    """Gymnasium vector."""

    mode = "SameStep"

    def _watched(self) -> None:
        inner = _VectorBetween(ROWS, SCENARIO, autoreset_mode=self.mode)
        inner.play = self
        self.env = ShieldedVectorEnv(inner)
        self.bad = [
            lambda: self.env.step(self._one_bad(np.nan)),
            lambda: self.env.step(np.zeros((ROWS + 1, 1))),
            lambda: self.env.step(np.full((ROWS, 1), 1.0 + 1j)),
            lambda: self.env.reset(seed=-1),
        ]
        Play._watched(self)
        self.env.reset(seed=int(self.rng.integers(10**6)))

    def _one_bad(self, value: float) -> np.ndarray:
        actions = np.zeros((ROWS, 1))
        actions[int(np.argmin(self.engine().ended))] = value  # of a row that runs: others are ignored
        return actions

    def step(self) -> None:
        self.env.step(self.drawn(ROWS, 1).astype(np.float32))


class NextStepVector(Vector):
    """Gymnasium vector, the other autoreset mode."""

    mode = "NextStep"


class Sb3(Vector):
    """Stable-Baselines3."""

    def _watched(self) -> None:
        inner = make_sb3_vec_env(SCENARIO, ROWS, seed=int(self.rng.integers(10**6)))
        inner.__class__ = _Sb3Between
        inner.play = self
        self.env = ShieldedVecEnv(inner)
        self.bad = [
            lambda: self.env.step(self._one_bad(np.nan)),
            lambda: self.env.step(np.zeros((ROWS, 2))),
            lambda: self.env.env_method("no_such_method"),
            self._options,
        ]
        Play._watched(self)
        self.env.reset()

    def _options(self) -> None:
        self.env.set_options({"initial_state": {"gaps_m": [1], "speeds_mps": [1]}})
        self.env.reset()

    def step(self) -> None:
        if self.rng.random() < 0.2:  # one too many
            self.env.step_async(self.drawn(ROWS, 1))
        super().step()


class Evaluation(Play):
    """The shielded agent that evaluation drives by."""

    def _watched(self) -> None:
        self._begin()
        self.bad = [self._policy_fails]

    def _begin(self) -> None:
        worlds = SCENARIO.sample(ROWS, int(self.rng.integers(10**6))).worlds
        self.agent = StepShieldAgent(self.policy, SCENARIO)
        before = getattr(self, "_engine", None)
        self._engine = episode_engine(worlds, self.agent, SCENARIO, 1)
        self.recorder = Recorder(self.shield)
        self.done = [*getattr(self, "done", []), *([] if before is None else before.memory(before.watchers[0]))]
        self._engine.watch(self.recorder, [])
        self._engine.step({})

    def _policy_fails(self) -> None:
        self.policy.fails = True
        try:
            self._engine.step({})
            raise Failure  # nobody asked it again: what was decided stands
        finally:
            self.policy.fails = False

    def engine(self) -> Any:
        return self._engine

    def shield(self) -> Any:
        return self.agent.shield

    def step(self) -> None:
        if self._engine.ended.all():
            self._begin()
        if self.rng.random() < 0.2:  # one too many
            self.agent.act(self._engine.worlds, 1)
        self.how(self._engine.step, {})


class _ParallelBetween(BaseParallelWrapper):
    def __init__(self, env: EthBrakeParallelEnv, play: Play) -> None:
        super().__init__(env)
        self.play = play

    def step(self, actions: Any) -> Any:
        return self.play.how(super().step, actions)


class _SingleBetween(gymnasium.Wrapper):
    def __init__(self, env: Any, play: Play) -> None:
        super().__init__(env)
        self.play = play

    def step(self, action: Any) -> Any:
        return self.play.how(self.env.step, action)


class _VectorBetween(EthBrakeVectorEnv):
    play: Play

    def step(self, actions: Any) -> Any:
        return self.play.how(super().step, actions)


class _Sb3Between(EthBrakeVecEnv):
    play: Play

    def step_wait(self) -> Any:
        def step(actions: Any) -> Any:
            self._actions = actions
            return EthBrakeVecEnv.step_wait(self)

        return self.play.how(step, self._actions)


PLAYS: dict[str, type[Play]] = {
    "parallel": Parallel, "aec": Aec, "single": Single, "vector": Vector, "vector, next step": NextStepVector,
    "sb3": Sb3, "evaluation": Evaluation,
}  # fmt: skip


@contextlib.contextmanager
def interrupt_at(line: int) -> Iterator[None]:
    """Ctrl-C at that line of Python, counted from here, whoever's it is."""
    left = line

    def trace(frame: Any, event: str, argument: Any) -> Any:
        nonlocal left
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
    """Play so many episodes through a face; before every second step something is refused, raises or is interrupted."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MovingAtHorizon)
        play = PLAYS[name](seed)
        refused = interrupted = broken = 0
        while len(_ended(play)) < episodes:
            kind, before, made = int(play.rng.integers(5)), play.known(), play.engine().steps_made
            if kind == 0 and play.bad and not play.engine().ended.all():
                with contextlib.suppress(EthBrakeError, Failure, AttributeError):
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
                    with interrupt_at(int(play.rng.integers(1, LINES))):
                        play.step()
                except KeyboardInterrupt:
                    interrupted += 1
            else:
                play.step()
            if play.engine().steps_made == made and kind != 2:
                broken += play.known() != before
            broken += _astray(play)
        ended = _ended(play)
    above = sum(harm > bound + 1e-9 for harm, bound in ended)
    return Tally(len(ended), above, refused, interrupted, broken)


def _astray(play: Play) -> int:
    """1 where the shield is not where the engine is, or trusts it no longer."""
    shield, engine = play.shield(), play.engine()
    if isinstance(play, Evaluation) and play.agent._asked is not None:
        return 0  # it follows at the next call
    there = (shield.running.steps == engine.steps)[~engine.ended].all()
    return int(not there or shield.distrusted.any())


def _ended(play: Play) -> list[tuple[float, float]]:
    """Harm and bound of the episodes that have ended."""
    done: list[tuple[float, float]] = play.engine().memory(play.recorder)
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
    """So many steps with a wrapper inside; who calls catches what is raised, and goes on."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MovingAtHorizon)
        play = PLAYS[name](seed)
        play.how = WRAPPERS[wrapper]()
        refused = broken = 0
        for _ in range(calls):
            with contextlib.suppress(UncertifiedStep):
                play.step()
                refused -= 1
            refused += 1
            broken += _astray(play)
        ended = _ended(play)
    return Tally(len(ended), sum(harm > bound + 1e-9 for harm, bound in ended), refused, 0, broken)


def make_policy(name: str) -> Any:
    return make_agent(name)
