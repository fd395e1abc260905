"""The first edition: what extensions still use of it. Nothing new imports it; it is deleted at the end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    # Environments
    # Errors
    from ethbrake_marl.errors import EthBrakeError as EthBrakeError, MissingExtra as MissingExtra

    # Agents, teams and policies
    from ethbrake_marl.first_edition.agents.foreign import policy_agent as policy_agent
    from ethbrake_marl.first_edition.agents.learned import LearnedAgent as LearnedAgent
    from ethbrake_marl.first_edition.agents.making import make_agent as make_agent
    from ethbrake_marl.first_edition.agents.protocol import Agent as Agent, Team as Team

    # Your own parts
    from ethbrake_marl.first_edition.agents.registry import agent_names as agent_names, register_agent as register_agent
    from ethbrake_marl.first_edition.agents.settings import AgentSettings as AgentSettings
    from ethbrake_marl.first_edition.engine.engine import Engine as Engine
    from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv as EthBrakeEnv
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
    from ethbrake_marl.first_edition.envs.vector import CostEnv as CostEnv, EthBrakeVectorEnv as EthBrakeVectorEnv
    from ethbrake_marl.first_edition.evaluation.comparison import compare_results as compare_results

    # Evaluation
    from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation as Evaluation
    from ethbrake_marl.first_edition.evaluation.groups import summarise_by as summarise_by
    from ethbrake_marl.first_edition.evaluation.outcome import Outcome as Outcome
    from ethbrake_marl.first_edition.evaluation.per_world import read_result as read_result
    from ethbrake_marl.first_edition.evaluation.record import (
        EpisodeRecord as EpisodeRecord,
        record_episode as record_episode,
    )
    from ethbrake_marl.first_edition.evaluation.rollout import evaluate as evaluate
    from ethbrake_marl.first_edition.evaluation.summary import SummaryTable as SummaryTable, summarise as summarise
    from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow as SummaryRow
    from ethbrake_marl.first_edition.game.features import register_feature as register_feature
    from ethbrake_marl.first_edition.game.measures import register_measure as register_measure
    from ethbrake_marl.first_edition.game.objectives import register_objective as register_objective

    # Observations and rewards
    from ethbrake_marl.first_edition.game.observations import (
        ObservationSpec as ObservationSpec,
        choose_observation as choose_observation,
    )
    from ethbrake_marl.first_edition.game.observed import observation_for as observation_for
    from ethbrake_marl.first_edition.game.rewards import RewardParams as RewardParams
    from ethbrake_marl.first_edition.physics.advance import advance as advance
    from ethbrake_marl.first_edition.physics.state import Worlds as Worlds, make_worlds as make_worlds
    from ethbrake_marl.first_edition.policies.bundle import load_policy as load_policy
    from ethbrake_marl.first_edition.policies.policy import Policy as Policy
    from ethbrake_marl.first_edition.policies.shipped import load_shipped as load_shipped

    # Scenarios, and the worlds drawn from them
    from ethbrake_marl.first_edition.scenario.catalogue import (
        list_scenarios as list_scenarios,
        load_scenario as load_scenario,
        register_scenarios as register_scenarios,
    )
    from ethbrake_marl.first_edition.scenario.channel import register_preset as register_preset
    from ethbrake_marl.first_edition.scenario.sample import Sample as Sample
    from ethbrake_marl.first_edition.scenario.schema import Scenario as Scenario
    from ethbrake_marl.first_edition.scenario.tables import (
        read_worlds as read_worlds,
        worlds_from_table as worlds_from_table,
    )
    from ethbrake_marl.first_edition.shields.contract import ShieldMode as ShieldMode
    from ethbrake_marl.first_edition.shields.options import ShieldOptions as ShieldOptions
    from ethbrake_marl.first_edition.shields.reasons import ShieldReason as ShieldReason
    from ethbrake_marl.first_edition.shields.sb3 import ShieldedVecEnv as ShieldedVecEnv

    # Shields: for any interface, and one for each
    from ethbrake_marl.first_edition.shields.wrappers import (
        HybridShield as HybridShield,
        ShieldedEnv as ShieldedEnv,
        ShieldedVectorEnv as ShieldedVectorEnv,
        shield as shield,
        shielded_aec as shielded_aec,
    )

    # Training
    from ethbrake_marl.first_edition.training.recipe import (
        TrainingRecipe as TrainingRecipe,
        load_recipe as load_recipe,
        register_algorithm as register_algorithm,
    )
    from ethbrake_marl.first_edition.training.session import (
        TrainResult as TrainResult,
        resume as resume,
        train as train,
    )
    from ethbrake_marl.progress import Progress as Progress
    from ethbrake_marl.registry import Part as Part
else:
    __getattr__ = front_door(__name__, __file__)
