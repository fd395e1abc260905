"""The agents that drive a vehicle: one protocol, scripts, baselines and the registry. See docs/baselines.md."""

from ethbrake_marl.agents.e_v2x_bm import EV2XBM, CoupledOptimum, optimise_coupled
from ethbrake_marl.agents.e_v2x_bm_kernel import PairwiseOptimum, optimise_pairwise, pairwise_harm
from ethbrake_marl.agents.protocol import Agent, PredictingAgent
from ethbrake_marl.agents.registry import AgentSettings, agent_names, make_agent, register_agent

__all__ = [
    "EV2XBM",
    "Agent",
    "AgentSettings",
    "CoupledOptimum",
    "PairwiseOptimum",
    "PredictingAgent",
    "agent_names",
    "make_agent",
    "optimise_coupled",
    "optimise_pairwise",
    "pairwise_harm",
    "register_agent",
]
