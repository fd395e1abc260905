"""The interfaces that take several learners, with a team of them behind one shield: see ``tests.shield.plays``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ethbrake_marl.agents.registry import Team, episode_engine
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridShield, ShieldedDriver
from tests.shield.plays import Aec, Evaluation, Failing, Failure, Parallel, Play, Sb3

PAIR = load_scenario("cooperation-3-pair")
LEARNERS = (1, 2)


class Unreliable(Failing):
    """Brakes by turns; where it is told to, it raises, gives too many commands, or (``mute``) no number."""

    misshapen = mute = False

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        told = super().act(worlds, vehicle)
        if self.misshapen:
            return np.zeros((worlds.n, 2))
        return np.full(worlds.n, np.nan) if self.mute else told


class Members:
    """What fails in one member of a team while the others are well."""

    rng: np.random.Generator

    def members(self) -> dict[int, Unreliable]:
        raise NotImplementedError

    def asked(self) -> Any:
        """A step in which the members are asked."""
        raise NotImplementedError

    def fails(self, how: str) -> Callable[[], None]:
        """A call in which one member fails so."""

        def call() -> None:
            one = self.members()[int(self.rng.choice(LEARNERS))]
            setattr(one, how, True)
            try:
                self.asked()
                raise AssertionError("nobody asked it")
            except (ValueError, IndexError) as error:
                raise Failure from error
            finally:
                setattr(one, how, False)

        return call

    def sometimes_mute(self) -> None:
        """One of them, now and then, says nothing that is a number: that is no failure, but replaced."""
        for member in self.members().values():
            member.mute = self.rng.random() < 0.15


class TeamParallel(Members, Parallel):
    """PettingZoo parallel."""

    scenario = PAIR

    def _watched(self) -> None:
        super()._watched()
        self.team = {i: Unreliable() for i in LEARNERS}
        team = {f"vehicle_{i + 1}": member for i, member in self.team.items()}
        inner = self.env.env
        self.env.close()
        self.env = HybridShield(inner, team, mode="step", cap="baseline")
        self.bad = [
            lambda: self.env.step({"vehicle_2": np.zeros(1), "vehicle_9": np.zeros(1)}),
            lambda: self.env.step({"vehicle_2": np.zeros(1), "vehicle_3": np.array([np.nan])}),
            lambda: self.env.step({"vehicle_3": np.zeros(3)}),
            lambda: self.env.step([0.0, 0.0]),
            lambda: self.env.reset(options={"initial_state": {"gaps_m": [-1, 1], "speeds_mps": [1, 1, 1]}}),
            self.fails("fails"),
            self.fails("misshapen"),
        ]
        self.engine()._watched.clear()
        Play._watched(self)
        self.env.reset(seed=int(self.rng.integers(10**6)))

    def members(self) -> dict[int, Unreliable]:
        return self.team

    def asked(self) -> None:
        self.env.step({})

    def step(self) -> None:
        if self.engine().ended[0]:
            self.env.reset()
        self.sometimes_mute()
        try:
            given = {f"vehicle_{i + 1}": self.drawn(1) for i in LEARNERS if self.rng.random() < 0.6}
            self.env.step(given)
        finally:
            for member in self.members().values():
                member.mute = False


class TeamAec(Aec):
    """PettingZoo AEC."""

    scenario = PAIR


class TeamSb3(Sb3):
    """Stable-Baselines3: two rows of each world."""

    scenario = PAIR

    def _one_bad(self, value: float) -> np.ndarray:
        actions = np.zeros((self.env.num_envs, 1))
        actions[int(self.rng.integers(self.env.num_envs))] = value
        return actions


class TeamEvaluation(Members, Evaluation):
    """The shielded team that evaluation drives by."""

    scenario = PAIR

    def _watched(self) -> None:
        super()._watched()
        self.bad = [self.fails("fails"), self.fails("misshapen")]

    def _driven(self, worlds: Any) -> Any:
        self.team = {i: Unreliable() for i in LEARNERS}
        team = Team(self.team, "unreliable")
        return episode_engine(worlds, ShieldedDriver(team, self.scenario, cap="baseline").on(LEARNERS), self.scenario)

    def members(self) -> dict[int, Unreliable]:
        return self.team

    def asked(self) -> None:
        self._engine.step({})

    def step(self) -> None:
        self.sometimes_mute()
        try:
            super().step()
        finally:
            for member in self.members().values():
                member.mute = False


TEAM_PLAYS: dict[str, type[Play]] = {
    "team, parallel": TeamParallel, "team, aec": TeamAec, "team, sb3": TeamSb3, "team, evaluation": TeamEvaluation,
}  # fmt: skip
