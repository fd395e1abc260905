"""Every mode and every option on every interface."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.envs.interfaces import EthBrakeVectorEnv, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import HybridShield, ShieldedEnv, ShieldedVectorEnv, ShieldOptions
from ethbrake_marl.shield.sb3 import ShieldedVecEnv

PAPER = load_scenario("paper-random")
INTERFACES = {
    HybridShield: parallel_env,
    ShieldedEnv: lambda: gymnasium.make("EthBrake-v0").unwrapped,
    ShieldedVectorEnv: lambda: EthBrakeVectorEnv(2, PAPER),
    ShieldedVecEnv: lambda: make_sb3_vec_env(PAPER, 2),
}
MODES = {
    "episode": {"mode": "episode"},
    "episode:pairwise": {"mode": "episode", "bound": "pairwise"},
    "step": {"mode": "step", "allowance": 1.0, "logging": True},
    "robust": {"mode": "robust", "uncertainty": "gaps_m=0.2", "harm_count": "total"},
}


def step(interface, env):
    """One step with full driving everywhere: (rewards, what the shield tells of each world)."""
    if interface is HybridShield:
        _, rewards, *_, infos = env.step({"vehicle_2": np.array([1.0])})
        return np.array([rewards["vehicle_2"]]), [infos["vehicle_2"]["shield"]]
    if interface is ShieldedEnv:
        _, reward, *_, info = env.step(np.array([1.0], np.float32))
        return np.array([reward]), [info["shield"]]
    if interface is ShieldedVectorEnv:
        _, rewards, *_, infos = env.step(np.ones((2, 1)))
        return rewards, [{key: value[k] for key, value in infos["shield"].items()} for k in range(2)]
    _, rewards, _, infos = env.step(np.ones((2, 1), np.float32))
    return rewards, [info["shield"] for info in infos]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("interface", INTERFACES)
def test_interfaces__have_every_mode_and_the_penalty(interface, mode):
    paid = []
    for penalty in (0.0, 7.0):
        env = interface(INTERFACES[interface](), make_agent("full_brake"), intervention_penalty=penalty, **MODES[mode])
        env.seed(3) if interface is ShieldedVecEnv else None
        env.reset() if interface is ShieldedVecEnv else env.reset(seed=3)
        first = [step(interface, env) for _ in range(3)]
        told = [world for _, worlds in first for world in worlds]
        assert {each["mode"] for each in told} == {mode.partition(":")[0]}
        paid.append(np.array([rewards for rewards, _ in first]))
        intervened = np.array([[bool(each["intervened"]) for each in worlds] for _, worlds in first])
    assert intervened.any()
    assert paid[0] - paid[1] == pytest.approx(7.0 * intervened, abs=1e-5)


@pytest.mark.parametrize("interface", INTERFACES)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "episode", "allowance": 5.0}, "allowance = 5.0: mode episode takes none"),
        ({"mode": "episode", "logging": True}, "logging = True: mode episode takes none"),
        ({"mode": "step", "bound": "pairwise"}, "bound = 'pairwise': mode step takes none"),
        ({"mode": "robust"}, "mode robust needs an uncertainty"),
        ({"mode": "step", "uncertainty": "gaps_m=1"}, "mode step takes no uncertainty"),
        ({"intervention_penalty": -1.0}, "intervention_penalty = -1.0: must be a number, at least 0"),
        ({"allowence": 1.0}, "option 'allowence'; did you mean 'allowance'"),
    ],
)
def test_interfaces__refuse_what_does_not_fit_in_the_same_words(interface, options, message):
    with pytest.raises(InvalidInput, match=message) as error:
        interface(INTERFACES[interface](), make_agent("coast"), **options)
    assert interface.__name__ in str(error.value)


def test_options__choose_the_mode_by_the_uncertainty():
    assert ShieldOptions().mode == "step" and ShieldOptions(uncertainty="gaps_m=1").mode == "robust"
    with pytest.raises(UnknownName, match="did you mean 'robust'"):
        ShieldOptions(mode="robus")
