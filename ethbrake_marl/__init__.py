"""Research environment for ethical emergency braking: exact physics of several vehicles, and a shield that bounds harm.

Importing the package registers ``EthBrake-v1`` with Gymnasium and ``ethbrake/ethbrake-v1`` with PettingZoo. Each public
name is imported when it is first used, so torch and matplotlib are loaded only if they are needed.

The ``if TYPE_CHECKING`` block below lists every public name once. Type checkers read this block as imports; at run time
the package reads the names from it.
"""

from __future__ import annotations

import sys
from difflib import get_close_matches
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ethbrake_marl.doors import names_behind
from ethbrake_marl.first_edition.envs.registration import register_environments
from ethbrake_marl.errors import naming_extras

if TYPE_CHECKING:
    # Environments
    from ethbrake_marl.first_edition.engine.engine import Engine as Engine
    from ethbrake_marl.first_edition.envs.making import make_engine as make_engine
    from ethbrake_marl.first_edition.envs.pettingzoo import (
        EthBrakeParallelEnv as EthBrakeParallelEnv,
        env as env,
        parallel_env as parallel_env,
        raw_env as raw_env,
    )
    from ethbrake_marl.first_edition.envs.sb3 import (
        EthBrakeVecEnv as EthBrakeVecEnv,
        make_sb3_vec_env as make_sb3_vec_env,
    )
    from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv as EthBrakeEnv
    from ethbrake_marl.first_edition.envs.vector import CostEnv as CostEnv, EthBrakeVectorEnv as EthBrakeVectorEnv

    # Scenarios, and the worlds drawn from them
    from ethbrake_marl.first_edition.scenario.catalogue import (
        list_scenarios as list_scenarios,
        load_scenario as load_scenario,
    )
    from ethbrake_marl.first_edition.scenario.sample import Sample as Sample
    from ethbrake_marl.first_edition.scenario.schema import Scenario as Scenario
    from ethbrake_marl.first_edition.scenario.tables import (
        read_worlds as read_worlds,
        worlds_from_table as worlds_from_table,
    )
    from ethbrake_marl.first_edition.physics.advance import advance as advance
    from ethbrake_marl.first_edition.physics.state import Worlds as Worlds, make_worlds as make_worlds

    # Observations and rewards
    from ethbrake_marl.first_edition.game.observations import (
        ObservationSpec as ObservationSpec,
        choose_observation as choose_observation,
    )
    from ethbrake_marl.first_edition.game.observed import observation_for as observation_for
    from ethbrake_marl.first_edition.game.rewards import RewardParams as RewardParams

    # Agents, teams and policies
    from ethbrake_marl.first_edition.agents.foreign import policy_agent as policy_agent
    from ethbrake_marl.first_edition.agents.learned import LearnedAgent as LearnedAgent
    from ethbrake_marl.first_edition.agents.protocol import Agent as Agent, Team as Team
    from ethbrake_marl.first_edition.agents.making import make_agent as make_agent
    from ethbrake_marl.first_edition.agents.registry import agent_names as agent_names
    from ethbrake_marl.first_edition.agents.settings import AgentSettings as AgentSettings
    from ethbrake_marl.first_edition.policies.bundle import load_policy as load_policy
    from ethbrake_marl.first_edition.policies.policy import Policy as Policy
    from ethbrake_marl.first_edition.policies.shipped import load_shipped as load_shipped

    # Shields: for any interface, and one for each
    from ethbrake_marl.first_edition.shields.wrappers import shield as shield
    from ethbrake_marl.first_edition.shields.reasons import ShieldReason as ShieldReason
    from ethbrake_marl.first_edition.shields.contract import ShieldMode as ShieldMode
    from ethbrake_marl.first_edition.shields.options import ShieldOptions as ShieldOptions
    from ethbrake_marl.first_edition.shields.wrappers import (
        HybridShield as HybridShield,
        ShieldedEnv as ShieldedEnv,
        ShieldedVectorEnv as ShieldedVectorEnv,
        shielded_aec as shielded_aec,
    )
    from ethbrake_marl.first_edition.shields.sb3 import ShieldedVecEnv as ShieldedVecEnv

    # Training
    from ethbrake_marl.first_edition.training.recipe import TrainingRecipe as TrainingRecipe, load_recipe as load_recipe
    from ethbrake_marl.first_edition.training.session import (
        TrainResult as TrainResult,
        resume as resume,
        train as train,
    )
    from ethbrake_marl.progress import Progress as Progress

    # Evaluation
    from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation as Evaluation
    from ethbrake_marl.first_edition.evaluation.outcome import Outcome as Outcome
    from ethbrake_marl.first_edition.evaluation.record import (
        EpisodeRecord as EpisodeRecord,
        record_episode as record_episode,
    )
    from ethbrake_marl.first_edition.evaluation.rollout import evaluate as evaluate
    from ethbrake_marl.first_edition.evaluation.summary import SummaryTable as SummaryTable, summarise as summarise
    from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow as SummaryRow
    from ethbrake_marl.first_edition.evaluation.comparison import compare_results as compare_results
    from ethbrake_marl.first_edition.evaluation.per_world import read_result as read_result
    from ethbrake_marl.first_edition.evaluation.groups import summarise_by as summarise_by

    # Your own parts
    from ethbrake_marl.first_edition.agents.registry import register_agent as register_agent
    from ethbrake_marl.first_edition.game.measures import register_measure as register_measure
    from ethbrake_marl.first_edition.training.recipe import register_algorithm as register_algorithm
    from ethbrake_marl.first_edition.game.objectives import register_objective as register_objective
    from ethbrake_marl.first_edition.game.features import register_feature as register_feature
    from ethbrake_marl.first_edition.scenario.catalogue import register_scenarios as register_scenarios
    from ethbrake_marl.first_edition.scenario.channel import register_preset as register_preset
    from ethbrake_marl.registry import Part as Part

    # Errors
    from ethbrake_marl.errors import EthBrakeError as EthBrakeError, MissingExtra as MissingExtra

__version__ = "0.5.0"


_HOMES = names_behind(__file__)
_NEED_TRAIN = ("EthBrakeVecEnv", "ShieldedVecEnv", "TrainResult", "make_sb3_vec_env", "resume", "train")


def _usable() -> list[str]:
    """Return the public names that can be imported with the packages that are installed.

    Importing any other public name raises an error that says which optional extra to install.
    """
    missing = _NEED_TRAIN if find_spec("stable_baselines3") is None else ()
    return [name for name in _HOMES if name not in missing]


def _import_public(name: str) -> Any:
    """Import the public name ``name`` from its module, on first use (the ``__getattr__`` of the package)."""
    if name == "__all__":
        return ["__version__", *_usable()]
    if name not in _HOMES:
        close = get_close_matches(name, _HOMES, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    register_environments()
    with naming_extras():
        value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


if not TYPE_CHECKING:  # a type checker that sees __getattr__ accepts any name
    __getattr__ = _import_public


def __dir__() -> list[str]:
    return sorted(["__version__", *_usable()])


# The command line registers the environments only when a command runs: importing Gymnasium would slow down --help.
if Path(sys.argv[0] if sys.argv else "").name != "ethbrake":
    register_environments()
