"""Research environment for ethical emergency braking: exact physics of several vehicles, and a shield that bounds harm.

Importing the package registers ``EthBrake-v3`` with Gymnasium, and ``ethbrake/ethbrake-v3`` with PettingZoo (from
version 1.27 on). A public name is imported when it is first used, so torch and matplotlib are loaded only if needed.
"""

from __future__ import annotations

from ethbrake_marl.program import is_program  # first: the other imports take long, and Ctrl-C may come
from difflib import get_close_matches
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ethbrake_marl.lazy_imports import names_behind
from ethbrake_marl.faces.registration import register_environments
from ethbrake_marl.errors import naming_extras

if TYPE_CHECKING:
    # Environments
    from ethbrake_marl.faces.pettingzoo import (
        EthBrakeParallelEnv as EthBrakeParallelEnv,
        env as env,
        parallel_env as parallel_env,
        raw_env as raw_env,
    )
    from ethbrake_marl.faces.sb3 import EthBrakeVecEnv as EthBrakeVecEnv, make_sb3_vec_env as make_sb3_vec_env
    from ethbrake_marl.faces.gymnasium import EthBrakeEnv as EthBrakeEnv
    from ethbrake_marl.faces.vector import EthBrakeVectorEnv as EthBrakeVectorEnv
    from ethbrake_marl.faces.driver import Driver as Driver
    from ethbrake_marl.faces.shield import shield as shield
    from ethbrake_marl.shields.shield import ShieldReason as ShieldReason

    # Scenarios, and the worlds drawn from them
    from ethbrake_marl.worlds.catalogue import list_scenarios as list_scenarios, load_scenario as load_scenario
    from ethbrake_marl.worlds.scenario import Scenario as Scenario
    from ethbrake_marl.worlds.user_worlds import read_worlds as read_worlds, worlds_from_table as worlds_from_table

    # The game: its state, its one step, what would happen
    from ethbrake_marl.agent_names import open_game as open_game
    from ethbrake_marl.episode.game import Game as Game, Physics as Physics, Shield as Shield
    from ethbrake_marl.episode.state import State as State
    from ethbrake_marl.episode.step import Step as Step
    from ethbrake_marl.episode.hold import hold as hold
    from ethbrake_marl.episode.play import price as price
    from ethbrake_marl.episode.observe import View as View
    from ethbrake_marl.episode.reward import RewardParams as RewardParams

    # Agents, teams and policies
    from ethbrake_marl.agent_names import AgentSettings as AgentSettings, make_agent as make_agent
    from ethbrake_marl.agents.team import Agent as Agent, Team as Team, play_to_end as play_to_end, play as play
    from ethbrake_marl.agents.action_scale import ActionScale as ActionScale
    from ethbrake_marl.agents.policy_agent import LearnedAgent as LearnedAgent, policy_agent as policy_agent
    from ethbrake_marl.policies.bundle import load_policy as load_policy, load_shipped as load_shipped
    from ethbrake_marl.policies.policy import Policy as Policy

    # Training
    from ethbrake_marl.training.recipe import TrainingRecipe as TrainingRecipe, load_recipe as load_recipe
    from ethbrake_marl.training.train import TrainResult as TrainResult, resume as resume, train as train
    from ethbrake_marl.progress import Progress as Progress

    # Evaluation
    from ethbrake_marl.evaluation.evaluate import evaluate as evaluate
    from ethbrake_marl.evaluation.evaluate import Result as Result
    from ethbrake_marl.evaluation.record import EpisodeRecord as EpisodeRecord, record_episode as record_episode
    from ethbrake_marl.evaluation.summary import SummaryRow as SummaryRow
    from ethbrake_marl.evaluation.summary import (
        SummaryTable as SummaryTable,
        summarise as summarise,
        summarise_by as summarise_by,
    )
    from ethbrake_marl.evaluation.results import (
        read_result as read_result,
        write_results as write_results,
        write_rows as write_rows,
    )

    # Your own parts
    from ethbrake_marl.agent_names import register_agent as register_agent, register_shield as register_shield
    from ethbrake_marl.evaluation.measure_registry import register_measure as register_measure
    from ethbrake_marl.episode.terms import register_term as register_term
    from ethbrake_marl.episode.counts import HarmCount as HarmCount, register_count as register_count
    from ethbrake_marl.training.recipe import register_algorithm as register_algorithm
    from ethbrake_marl.episode.objectives import register_objective as register_objective
    from ethbrake_marl.episode.features import (
        register_feature as register_feature,
        register_feature_group as register_feature_group,
    )
    from ethbrake_marl.episode.layer import Layer as Layer
    from ethbrake_marl.worlds.physics import register_physics as register_physics
    from ethbrake_marl.worlds.catalogue import register_scenarios as register_scenarios
    from ethbrake_marl.worlds.channel import (
        ChannelKey as ChannelKey,
        register_preset as register_preset,
        register_v2x_key as register_v2x_key,
    )
    from ethbrake_marl.registry import Part as Part

    # Errors
    from ethbrake_marl.errors import EthBrakeError as EthBrakeError, MissingExtra as MissingExtra

__version__ = "3.0.0"


_HOMES = names_behind(__name__)
_NEED_TRAIN = ("EthBrakeVecEnv", "TrainResult", "make_sb3_vec_env", "resume", "train")


def _usable() -> list[str]:
    """Public names that can be imported; the others need a package that is not installed."""
    missing = _NEED_TRAIN if find_spec("stable_baselines3") is None else ()
    return [name for name in _HOMES if name not in missing]


def _import_public(name: str) -> Any:
    """Public object called ``name``, imported at its first use (the package's ``__getattr__``)."""
    if name == "__all__":
        return ["__version__", *_usable()]
    if name not in _HOMES:
        folder = f"{__name__}.extensions"
        if find_spec(folder) is not None and find_spec(f"{folder}.{name}") is not None:
            return import_module(f"{folder}.{name}")
        close = ["parallel_env"] if name in ("make", "make_env") else get_close_matches(name, _HOMES, n=1)
        hint = f"did you mean {close[0]!r}?" if close else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint and '; '}{hint}")
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
if not is_program():
    register_environments()
