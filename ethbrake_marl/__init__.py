"""Research environment for ethical emergency braking: exact physics, multi-agent, with a shield whose bound holds.

Importing it registers ``EthBrake-v0`` with Gymnasium and ``ethbrake/ethbrake-v0`` with PettingZoo, and nothing more: a
public name is imported when it is first used, so torch and matplotlib are loaded only by what needs them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ethbrake_marl.envs.registration import register_environments

if TYPE_CHECKING:
    from ethbrake_marl.agents.registry import make_agent as make_agent
    from ethbrake_marl.agents.registry import register_agent as register_agent
    from ethbrake_marl.engine.engine import Engine as Engine
    from ethbrake_marl.envs.parallel import EthBrakeParallelEnv as EthBrakeParallelEnv
    from ethbrake_marl.envs.parallel import env as env
    from ethbrake_marl.envs.parallel import parallel_env as parallel_env
    from ethbrake_marl.envs.parallel import raw_env as raw_env
    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv as EthBrakeVecEnv
    from ethbrake_marl.envs.sb3 import make_sb3_vec_env as make_sb3_vec_env
    from ethbrake_marl.envs.single import EthBrakeEnv as EthBrakeEnv
    from ethbrake_marl.envs.vector import EthBrakeVectorEnv as EthBrakeVectorEnv
    from ethbrake_marl.errors import EthBrakeError as EthBrakeError
    from ethbrake_marl.evaluation import evaluate as evaluate
    from ethbrake_marl.observations import ObservationSpec as ObservationSpec
    from ethbrake_marl.observations import observation_for as observation_for
    from ethbrake_marl.physics import Worlds as Worlds
    from ethbrake_marl.physics import advance as advance
    from ethbrake_marl.physics import make_worlds as make_worlds
    from ethbrake_marl.policies.policy import load_policy as load_policy
    from ethbrake_marl.rewards import RewardParams as RewardParams
    from ethbrake_marl.scenario import Scenario as Scenario
    from ethbrake_marl.scenario import list_scenarios as list_scenarios
    from ethbrake_marl.scenario import load_scenario as load_scenario
    from ethbrake_marl.shield import HybridShield as HybridShield

__version__ = "0.1.0"

_HOME = {
    "Engine": "engine.engine",
    "EthBrakeEnv": "envs.single",
    "EthBrakeError": "errors",
    "EthBrakeParallelEnv": "envs.parallel",
    "EthBrakeVecEnv": "envs.sb3",
    "EthBrakeVectorEnv": "envs.vector",
    "HybridShield": "shield",
    "ObservationSpec": "observations",
    "RewardParams": "rewards",
    "Scenario": "scenario",
    "Worlds": "physics",
    "advance": "physics",
    "env": "envs.parallel",
    "evaluate": "evaluation",
    "list_scenarios": "scenario",
    "load_policy": "policies.policy",
    "load_scenario": "scenario",
    "make_agent": "agents.registry",
    "make_sb3_vec_env": "envs.sb3",
    "make_worlds": "physics",
    "observation_for": "observations",
    "parallel_env": "envs.parallel",
    "raw_env": "envs.parallel",
    "register_agent": "agents.registry",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    """Import a public name from the file it lives in, once."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})


register_environments()
