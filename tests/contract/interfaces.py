"""The four interfaces behind one small protocol, so that one suite judges them all, and the scenarios for it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from ethbrake_marl.envs.interfaces import EthBrakeEnv, EthBrakeParallelEnv, EthBrakeVectorEnv
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario, load_scenario

Array = NDArray[Any]

PAPER = load_scenario("paper-random")
FIVE = Scenario(
    name="five",
    vehicles=5,
    gaps_m={"uniform": [3, 12]},
    speeds_mps={"uniform": [15, 20]},
    braking_capacity_mps2=[6, 7, 6, {"uniform": [6, 9]}, 5],
    driving_capacity_mps2=3,
    mass_t={"uniform": [1, 8]},
    latency_s=[0, 0.4, 0.33, 0.51, 0.7],
    restitution={"uniform": [0, 0.3]},
    roles={
        "vehicle_1": "full_brake",
        "vehicle_2": "constant:3",
        "vehicle_3": "e_v2x_bm:pairwise",
        "vehicle_4": "learner",
        "vehicle_5": "copy_leader",
    },
)
SCENARIOS = {"paper-random": PAPER, "five": FIVE}


@dataclass
class Turn:
    """One step of n rows: what was returned, and the last observation and harms of rows whose episode ended."""

    observation: Array  # [n, F]; of the new episode where one ended
    reward: Array  # [n]
    terminated: Array  # [n]
    truncated: Array  # [n]
    final: dict[int, Array] = field(default_factory=dict)
    harm: dict[int, tuple[float, float]] = field(default_factory=dict)  # of the world: first-impact, total

    @property
    def ended(self) -> Array:
        return self.terminated | self.truncated

    def arrays(self) -> list[Array]:
        """Every array that the caller was given."""
        given = (self.observation, self.reward, self.terminated, self.truncated, *self.final.values())
        return [a for a in given if isinstance(a, np.ndarray)]

    def bits(self) -> bytes:
        parts = [np.asarray(a).tobytes() for a in (self.observation, self.terminated, self.truncated)]
        parts.append(np.asarray(self.reward, np.float32).tobytes())  # the coarsest of the four interfaces
        parts += [str(row).encode() + array.tobytes() for row, array in sorted(self.final.items())]
        return b"".join(parts) + repr(sorted(self.harm.items())).encode()


class Interface(Protocol):
    """An interface with one learner in each of n worlds; ended episodes are followed by the next of the stream."""

    env: Any
    n: int
    space: Box

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array: ...

    def step(self, action: Array) -> Turn: ...


def harms(info: Mapping[str, Any]) -> tuple[float, float]:
    return float(info["world_first_impact_harm"]), float(info["world_total_harm"])


class Parallel:
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        assert n == 1
        self.env, self.n = EthBrakeParallelEnv(scenario, **settings), 1
        self.agent = self.env.possible_agents[self.env.engine.learners[0]]
        self.space = self.env.observation_space(self.agent)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        return self.env.reset(seed=seed, options=options)[0][self.agent][np.newaxis]

    def step(self, action: Array) -> Turn:
        given = self.env.step({self.agent: action[0]})
        observation, reward, terminated, truncated, info = (part[self.agent] for part in given)
        return one_row(self, observation, reward, terminated, truncated, info)


class Single:
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        assert n == 1
        self.env, self.n = EthBrakeEnv(scenario, **settings), 1
        self.space = self.env.observation_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        return self.env.reset(seed=seed, options=options)[0][np.newaxis]

    def step(self, action: Array) -> Turn:
        return one_row(self, *self.env.step(action[0]))


def one_row(
    interface: Interface, observation: Array, reward: float, terminated: bool, truncated: bool, info: Any
) -> Turn:
    turn = Turn(observation[np.newaxis], np.array([reward]), np.array([terminated]), np.array([truncated]))
    if turn.ended[0]:
        turn.final, turn.harm = {0: observation}, {0: harms(info)}
        turn.observation = interface.reset()
    return turn


class Vector:
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        self.env, self.n = EthBrakeVectorEnv(n, scenario, autoreset_mode="SameStep", **settings), n
        self.space = self.env.single_observation_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        return self.env.reset(seed=seed, options=options)[0]

    def step(self, action: Array) -> Turn:
        observation, reward, terminated, truncated, infos = self.env.step(action)
        turn = Turn(observation, reward, terminated, truncated)
        for row in np.flatnonzero(turn.ended).tolist():
            final = infos["final_info"]
            turn.final[row] = infos["final_obs"][row]
            turn.harm[row] = float(final["world_first_impact_harm"][row]), float(final["world_total_harm"][row])
        return turn


class Sb3:
    def __init__(self, scenario: Scenario, n: int, **settings: Any) -> None:
        self.env, self.n = make_sb3_vec_env(scenario, n, seed=None, **settings), n
        self.space = self.env.observation_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        if seed is not None:
            self.env.seed(seed)
        self.env.set_options(options)
        return self.env.reset()

    def step(self, action: Array) -> Turn:
        observation, reward, done, infos = self.env.step(action)
        truncated = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        turn = Turn(observation, reward, done & ~truncated, truncated)
        for row in np.flatnonzero(done).tolist():
            turn.final[row], turn.harm[row] = infos[row]["terminal_observation"], harms(infos[row])
        return turn


INTERFACES: dict[str, type[Parallel] | type[Single] | type[Vector] | type[Sb3]] = {
    "parallel": Parallel,
    "single": Single,
    "vector": Vector,
    "sb3": Sb3,
}
BATCHED = ("vector", "sb3")


def rows_of(name: str) -> int:
    """Worlds that the suite runs an interface with."""
    return 6 if name in BATCHED else 1


def actions(seed: int, steps: int, n: int) -> Array:
    """Random actions [steps, n, 1], the same ones for the same seed; mostly braking, so that episodes end."""
    drawn = np.random.default_rng(seed).normal(-0.8, 0.6, (steps, n, 1))
    return np.clip(drawn, -1.0, 1.0).astype(np.float32)


def digest(name: str, scenario: Scenario, seed: int, steps: int = 160, n: int | None = None) -> str:
    """Hash of everything that a fresh environment returns in ``steps`` steps: several whole episodes."""
    interface = INTERFACES[name](scenario, rows_of(name) if n is None else n)
    hash_ = hashlib.sha256(interface.reset(seed).tobytes())
    for action in actions(3, steps, interface.n):
        hash_.update(interface.step(action).bits())
    return hash_.hexdigest()


def all_digests() -> dict[str, str]:
    """One digest for each interface and scenario, for another process to compare."""
    return {
        f"{interface} {name}": digest(interface, scenario, 11)
        for interface in INTERFACES
        for name, scenario in SCENARIOS.items()
    }


def initial_state(worlds: Worlds, row: int) -> dict[str, Any]:
    """The option ``initial_state`` that describes one world at t = 0 completely."""
    vehicles = worlds.vehicles
    names = ("braking_capacity_mps2", "driving_capacity_mps2", "latency_s", "mass_t", "speed_limit_mps", "restitution")
    return {
        "gaps_m": worlds.gaps_m[row],
        "speeds_mps": worlds.speeds_mps[row],
        **{name: getattr(vehicles, name)[row] for name in names},
    }
