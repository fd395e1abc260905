"""All interfaces behind one small class, so that one suite judges them all, and small scenarios for it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ethbrake_marl as eb
from ethbrake_marl.motion.layout import LIMIT, RESTITUTION

Array = NDArray[Any]
Wrap = Callable[[Any], Any]

PAPER = eb.load_scenario("paper-random")
FIVE = eb.Scenario(
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
        "vehicle_5": "full_brake",
    },
)
# Vehicle 1 brakes with 6 m/s2 from 20 m/s; Vehicle 2 may act after 0.5 s. Coasting, it closes 3 m in 1 s and hits with
# w = 6 m/s: harm 36, of which masses 1 and 3 give Vehicle 1 three quarters (27) and Vehicle 2 the rest (9).
CRASH = eb.Scenario(
    name="crash",
    vehicles=2,
    gaps_m=3,
    speeds_mps=20,
    braking_capacity_mps2=[6, 8],
    driving_capacity_mps2=[6, 4],
    mass_t=[1, 3],
    latency_s=[0, 0.5],
    restitution=0,
    horizon_s=1.3,
)

# Far apart and nearly at rest: Vehicle 2, from 5.7 m/s with 6 m/s2 after 0.5 s, rests at 1.45 s, in its 10th step.
REST = eb.Scenario(
    name="rest",
    vehicles=2,
    gaps_m=50,
    speeds_mps=5.7,
    braking_capacity_mps2=6,
    driving_capacity_mps2=6,
    mass_t=1,
    latency_s=[0, 0.5],
)
SCENARIOS = {"paper-random": PAPER, "five": FIVE}


def line(vehicles: int, v2x: str = "congested", horizon_s: int = 12) -> eb.Scenario:
    """All learn, an obstacle ahead, over a channel; each for itself and a little for the others."""
    return eb.Scenario(
        name=f"line-{vehicles}-{v2x}", vehicles=vehicles, gaps_m={"uniform": [5, 10]}, speeds_mps={"uniform": [18, 22]},
        braking_capacity_mps2={"uniform": [5, 9]}, driving_capacity_mps2=3, mass_t={"uniform": [1, 8]},
        latency_s=[0] + [0.3] * (vehicles - 1), horizon_s=horizon_s, v2x=v2x, objective="social:30",
        roles={f"vehicle_{i}": "learner" for i in range(1, vehicles + 1)}, obstacle_gap_m={"uniform": [35, 45]},
    )  # fmt: skip


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
        given = (self.observation, self.reward, self.terminated, self.truncated, *self.final.values())
        return [a for a in given if isinstance(a, np.ndarray)]

    def bits(self) -> bytes:
        parts = [np.asarray(a).tobytes() for a in (self.observation, self.terminated, self.truncated)]
        parts.append(np.asarray(self.reward, np.float32).tobytes())  # the coarsest of the four interfaces
        parts += [str(row).encode() + array.tobytes() for row, array in sorted(self.final.items())]
        return b"".join(parts) + repr(sorted(self.harm.items())).encode()


def harms(info: Mapping[str, Any]) -> tuple[float, float]:
    return float(info["world_first_impact_harm"]), float(info["world_total_harm"])


def unchanged(env: Any) -> Any:
    return env


class Interface:
    """One learner in each of n worlds, ``reset`` and ``step`` of rows; ended episodes are followed by the next ones."""

    n = 1

    def drawn(self) -> list[dict[str, Any]]:
        columns = self.env.unwrapped.describe_worlds()
        worlds = ({name: column[k].item() for name, column in columns.items()} for k in range(self.n))
        return [{name: value for name, value in world.items() if value != ""} for world in worlds]  # of other worlds

    def one_row(self, observation: Array, reward: float, terminated: bool, truncated: bool, info: Any) -> Turn:
        turn = Turn(observation[np.newaxis], np.array([reward]), np.array([terminated]), np.array([truncated]))
        if turn.ended[0]:
            turn.final, turn.harm = {0: observation}, {0: harms(info)}
            turn.observation = self.reset()
        return turn


class Parallel(Interface):
    def __init__(self, scenario: eb.Scenario, n: int, wrap: Wrap = unchanged, **settings: Any) -> None:
        self.env = wrap(eb.EthBrakeParallelEnv(scenario, **settings))
        self.agent = self.env.possible_agents[self.env.unwrapped.game.settings.learners[0] - 1]
        self.space = self.env.observation_space(self.agent)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        return self.env.reset(seed=seed, options=options)[0][self.agent][np.newaxis]

    def step(self, action: Array) -> Turn:
        return self.one_row(*(part[self.agent] for part in self.env.step({self.agent: action[0]})))


class InTurn(Parallel):
    """PettingZoo's other interface: one agent after the other."""

    def __init__(self, scenario: eb.Scenario, n: int, wrap: Wrap = unchanged, **settings: Any) -> None:
        super().__init__(scenario, n, **settings)
        self.env = wrap(eb.raw_env(scenario, **settings))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        self.env.reset(seed=seed, options=options)
        return self.env.observe(self.agent)[np.newaxis]

    def step(self, action: Array) -> Turn:
        acting = ""
        while acting != self.env.possible_agents[-1]:
            acting = self.env.agent_selection
            self.env.step(action[0] if acting == self.agent else None)
        told = (self.env.rewards, self.env.terminations, self.env.truncations, self.env.infos)
        return self.one_row(self.env.observe(self.agent), *(part[self.agent] for part in told))


class Single(Interface):
    def __init__(self, scenario: eb.Scenario, n: int, wrap: Wrap = unchanged, **settings: Any) -> None:
        self.env = wrap(eb.EthBrakeEnv(scenario, **settings))
        self.space = self.env.observation_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        return self.env.reset(seed=seed, options=options)[0][np.newaxis]

    def step(self, action: Array) -> Turn:
        return self.one_row(*self.env.step(action[0]))


class Vector(Interface):
    def __init__(self, scenario: eb.Scenario, n: int, wrap: Wrap = unchanged, **settings: Any) -> None:
        self.env, self.n = wrap(eb.EthBrakeVectorEnv(n, scenario, autoreset_mode="SameStep", **settings)), n
        self.space = self.env.single_observation_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Array:
        return self.env.reset(seed=seed, options=options)[0]

    def step(self, action: Array) -> Turn:
        observation, reward, terminated, truncated, infos = self.env.step(action)
        turn = Turn(observation, reward, terminated, truncated)
        for row in np.flatnonzero(turn.ended).tolist():
            turn.final[row] = infos["final_obs"][row]
            turn.harm[row] = harms({name: column[row] for name, column in infos["final_info"].items()})
        return turn


class Sb3(Interface):
    def __init__(self, scenario: eb.Scenario, n: int, wrap: Wrap = unchanged, **settings: Any) -> None:
        self.env, self.n = wrap(eb.make_sb3_vec_env(scenario, n, seed=None, horizon_is_end=False, **settings)), n
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


# What the suite judges: a new interface is one entry here.
BARE: dict[str, Callable[..., Interface]] = {
    "parallel": Parallel,
    "in turn": InTurn,
    "single": Single,
    "vector": Vector,
    "sb3": Sb3,
}
STEP: dict[str, Callable[..., Interface]] = {
    f"shielded {name}": partial(make, wrap=eb.shield) for name, make in BARE.items()
}
EPISODE = partial(eb.shield, policy="full_brake", mode="episode")  # what is proposed is not asked
SHIELDED = {**STEP, "episode parallel": partial(Parallel, wrap=EPISODE)}
INTERFACES = {**BARE, **SHIELDED}
BATCHED = [name for name in INTERFACES if name.endswith(("vector", "sb3"))]


def rows_of(name: str) -> int:
    return 6 if name in BATCHED else 1


def actions(seed: int, steps: int, n: int) -> Array:
    """Random actions [steps, n, 1], the same ones for the same seed; mostly braking, so that episodes end."""
    return np.clip(np.random.default_rng(seed).normal(-0.8, 0.6, (steps, n, 1)), -1.0, 1.0).astype(np.float32)


def initial_state(worlds: eb.State, row: int) -> dict[str, Any]:
    names = ("gaps_m", "speeds_mps", "braking_capacity_mps2", "driving_capacity_mps2", "latency_s", "mass_t")
    return {
        **{name: getattr(worlds, name)[row] for name in names},
        "speed_limit_mps": worlds.car[row, LIMIT, 1:],
        "restitution": worlds.car[row, RESTITUTION, 1],
    }
