"""What a user's code raises in a reset or step loses nothing: the state before stands, and the same call goes on."""

from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import register_agent
from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.faces.rendering import Renderer, register_renderer
from ethbrake_marl.worlds.channel import register_v2x_key
from tests.contract.interfaces import BARE, PAPER, STEP, Vector, actions
from tests.fixtures.layer import UsersKey


class NextStep(Vector):
    """The vector environment whose next episodes begin in the step after the last one."""

    def __init__(self, scenario: eb.Scenario, n: int, wrap: Any, **settings: Any) -> None:
        self.env, self.n = wrap(eb.EthBrakeVectorEnv(n, scenario, **settings)), n

    def step(self, action: Any) -> Any:
        told = repr(self.env.step(action)).encode()
        return SimpleNamespace(bits=lambda: told)


INTERFACES: dict[str, Callable[..., Any]] = {**BARE, "next step": NextStep}
SHORT = PAPER.replace(horizon_s=1.0)  # five steps; Vehicle 3 may act at 0.8 s


class Trap:
    """A part of a user that raises while it is set."""

    is_set = False

    def spring(self) -> None:
        if self.is_set:
            raise ZeroDivisionError("the user's own")


TRAP = Trap()


class Script:
    name, knows = "trapped", "true state"

    def __init__(self, deed: str) -> None:
        self.deed = deed

    def begin(self, alert: eb.State, body: int) -> Any:
        if self.deed == "begin":
            TRAP.spring()
        return np.zeros(alert.n)

    def act(self, state: eb.State, memory: Any, body: int) -> Any:
        if self.deed == "act":
            TRAP.spring()
        kept = memory + 1.0
        return -np.minimum(kept, state.braking_capacity_mps2[:, body - 1]), kept[: 0 if self.spoils() else None]

    def spoils(self) -> bool:
        return self.deed == "memory" and TRAP.is_set


class Picture(Renderer):
    def __init__(self, environment: Any) -> None:
        """Draw nothing."""

    def began(self, state: eb.State) -> None:
        TRAP.spring()

    stepped = began


class Reporting(Layer):
    def infos(self, state: eb.State) -> dict[str, Any]:
        TRAP.spring()
        return {"mine": state.time_s}


def feature(state: eb.State, body: int) -> Any:
    """Time, where the trap is not set."""
    TRAP.spring()
    return state.time_s


def term(before: eb.State, step: eb.Step, after: eb.State) -> Any:
    """Time, where the trap is not set."""
    TRAP.spring()
    return after.time_s


def scripted(deed: str) -> tuple[eb.Scenario, dict[str, Any]]:
    register_agent("trapped", lambda argument, settings: Script(deed))
    return SHORT.replace(roles={**SHORT.roles, "vehicle_3": "trapped"}, early_impacts="keep"), {}


def featured() -> tuple[eb.Scenario, dict[str, Any]]:
    eb.register_feature("trap", feature, unit="s", scale=1.0, low=0.0, high=9.0)
    return SHORT, {"observation": ["own", "front_1", "trap"]}


def rewarded() -> tuple[eb.Scenario, dict[str, Any]]:
    eb.register_term("trap", term)
    return SHORT, {"reward": {"harm": 1.0, "shaping": 0.1, "trap": 0.5}}


def shown() -> tuple[eb.Scenario, dict[str, Any]]:
    register_renderer("trap", Picture)
    return SHORT, {"render_mode": "trap"}


def layered() -> tuple[eb.Scenario, dict[str, Any]]:
    register_v2x_key("mine", UsersKey("mine", Reporting()))
    return SHORT.replace(v2x={"mine": 1}), {}


CULPRITS: dict[str, Callable[[], tuple[eb.Scenario, dict[str, Any]]]] = {
    "feature": featured, "term": rewarded, "renderer": shown, "infos of a layer": layered,
    "act": lambda: scripted("act"), "begin": lambda: scripted("begin"), "memory": lambda: scripted("memory"),
}  # fmt: skip


def standing(env: Any) -> str:
    """Everything that the next call begins from."""
    base = env.unwrapped
    saved = base.snapshot() if hasattr(base, "snapshot") else None
    parts = [
        base.episode,
        base.stream[2:],
        saved,
        getattr(base, "_np_random_seed", None),
        getattr(base, "_options", None),
    ]
    with np.printoptions(override_repr=lambda array: f"{array.dtype} {array.shape} {array.tobytes().hex()}"):
        return repr(parts)


def failing_first(env: Any, failures: list[bool]) -> Any:
    """The environment whose every reset and step is called with the trap set, and once more where that fails."""

    def twice(method: Callable[..., Any], ends: Callable[[], bool]) -> Callable[..., Any]:
        def call(*given: Any, **settings: Any) -> Any:
            before, TRAP.is_set = standing(env), True
            with suppress(EthBrakeError, ZeroDivisionError):
                try:
                    return method(*given, **settings)
                finally:
                    TRAP.is_set = False
            assert standing(env) == before
            result = method(*given, **settings)
            failures.append(ends())
            return result

        return call

    base = env.unwrapped
    env.step = twice(env.step, lambda: bool((base.episode.ended | (base.episode.steps == 0)).any()))
    env.reset = twice(env.reset, lambda: False)
    return env


@pytest.mark.parametrize(
    ("name", "culprit"), [*(("next step", each) for each in CULPRITS), *((name, "act") for name in BARE)]
)
def test_reset_and_step__that_fail_can_be_called_again(name: str, culprit: str) -> None:
    scenario, settings = CULPRITS[culprit]()
    n, failures, runs = 3 if name in ("vector", "sb3", "next step") else 1, list[bool](), []
    for wrap in (lambda env: env, lambda env: failing_first(env, failures)):
        interface = INTERFACES[name](scenario, n, wrap=wrap, **settings)
        seen = [interface.reset(7).tobytes(), interface.reset().tobytes()]
        runs.append(seen + [interface.step(action).bits() for action in actions(3, 13, interface.n)])
    assert runs[0] == runs[1] and len(failures) >= 2
    assert any(failures) or (culprit == "begin" and n == 1)  # an episode alone begins only in a reset


@pytest.mark.parametrize(
    ("name", "culprit"), [("shielded vector", "feature"), ("shielded sb3", "act"), ("shielded parallel", "renderer")]
)
def test_shield__that_stands_behind_it_remembers_the_same(name: str, culprit: str) -> None:
    scenario, settings = CULPRITS[culprit]()
    n, failures, runs = 1 if name == "shielded parallel" else 3, list[bool](), []
    for wrap in (eb.shield, lambda env: failing_first(eb.shield(env), failures)):
        interface = STEP[name].func(scenario, n, wrap=wrap, **settings)  # type: ignore[attr-defined]
        interface.reset(7)
        runs.append([interface.step(action).bits() for action in actions(3, 13, interface.n)])
    assert runs[0] == runs[1] and any(failures)
