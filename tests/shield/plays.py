"""Every interface behind the shield, with something in between: to be stepped, disturbed and looked into."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper

from ethbrake_marl.agents.registry import episode_engine
from ethbrake_marl.envs.interfaces import EthBrakeParallelEnv, EthBrakeVectorEnv, parallel_env
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.shield import HybridShield, ShieldedDriver, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from tests.shield.lines import line

ROWS = 5  # worlds of the batched interfaces
SCENARIO = line(3)


class Failure(Exception):
    """Raised by a policy or a wrapper of the tests."""


class Recorder:
    """A watcher that counts the steps, and notes harm and bound of every episode that ends."""

    def begun(self, memory: Any, alert: Any, rows: Any) -> Any:
        return memory

    def stepped(self, memory: Any, before: Any, after: Any) -> Any:
        made, ended = memory
        over = after.ended & ~before.ended
        harm, bound = after.ledger.world_harm("first"), after.guarded.shield.first_bound
        return made + 1, [*ended, *zip(harm[over].tolist(), bound[over].tolist(), strict=True)]


class Failing:
    """A policy that brakes by turns, and raises when it is told to."""

    name, fails, remembers = "failing", False, False

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        if self.fails:
            raise Failure
        wave = np.sin(17.0 * worlds.time_s + worlds.gaps_m[:, 0])
        return np.where(wave > 0.0, 0.0, wave * worlds.vehicles.braking_capacity_mps2[:, vehicle])


class Play:
    """One interface, shielded: ``step`` makes a step with fresh proposals, ``bad`` are calls that must raise."""

    scenario = SCENARIO

    def __init__(self, seed: int) -> None:
        self.rng, self.policy = np.random.default_rng(seed), Failing()
        self.raises: str | None = None  # where the wrapper in between raises
        self.how: Callable[..., Any] = self._failing
        self.bad: list[Callable[[], Any]] = []
        self._watched()

    def _watched(self) -> None:
        self.recorder = Recorder()
        self.engine().watch(self.recorder, (0, []))

    def made(self) -> int:
        """Steps that the engine made."""
        made: int = self.engine().memory(self.recorder)[0]
        return made

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
        inner = _ParallelBetween(parallel_env(self.scenario), self)
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
            raise AssertionError("nobody asked it")
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
        self.env = shielded_aec(_ParallelBetween(parallel_env(self.scenario), self), mode="step")
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
        before = self.made()
        while self.made() == before:
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
        inner = make_sb3_vec_env(self.scenario, ROWS, seed=int(self.rng.integers(10**6)))
        inner.__class__ = _Sb3Between
        inner.play = self
        self.env = ShieldedVecEnv(inner)
        self.bad = [
            lambda: self.env.step(self._one_bad(np.nan)),
            lambda: self.env.step(np.zeros((self.env.num_envs, 2))),
            self._missing,
            self._options,
        ]
        Play._watched(self)
        self.env.reset()

    def _missing(self) -> None:
        with pytest.raises(AttributeError, match="no_such_method"):
            self.env.env_method("no_such_method")
        raise Failure

    def _options(self) -> None:
        self.env.set_options({"initial_state": {"gaps_m": [1], "speeds_mps": [1]}})
        self.env.reset()

    def step(self) -> None:
        rows = self.env.num_envs
        if self.rng.random() < 0.2:  # one too many
            self.env.step_async(self.drawn(rows, 1))
        self.env.step(self.drawn(rows, 1).astype(np.float32))


class Evaluation(Play):
    """The shielded driver of an evaluation."""

    def _watched(self) -> None:
        self._begin()
        self.bad = [self._policy_fails]

    def _begin(self) -> None:
        worlds = self.scenario.sample(ROWS, int(self.rng.integers(10**6))).worlds
        before = getattr(self, "_engine", None)
        self._engine = self._driven(worlds)
        made, ended = (0, []) if before is None else before.memory(self.recorder)
        self.done, self.recorder = [*getattr(self, "done", []), *ended], Recorder()
        self._engine.watch(self.recorder, (made, []))
        self._engine.step({})

    def _driven(self, worlds: Any) -> Any:
        """An engine over these worlds in which a new driver proposes."""
        return episode_engine(worlds, ShieldedDriver(self.policy, self.scenario), self.scenario, 1)

    def _policy_fails(self) -> None:
        self.policy.fails = True
        try:
            self._engine.step({})
            raise AssertionError("nobody asked it")
        finally:
            self.policy.fails = False

    def engine(self) -> Any:
        return self._engine

    def shield(self) -> Any:
        return self._engine.guarded.shield

    def step(self) -> None:
        if self._engine.ended.all():
            self._begin()
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
