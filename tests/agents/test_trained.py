"""Trained policies by name: from the folder of a run, of the algorithm that the name says, one for each learner."""

import shutil
from pathlib import Path
from typing import Any

from ethbrake_marl import policies
from ethbrake_marl.agent_names import make_agent, open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.policies.bundle import load_shipped
from tests.refused import refused

SHIPPED = Path(policies.__file__).parents[1] / "shipped" / "policies" / "ppo"


def test_policy__drives_by_the_name_of_its_algorithm(tmp_path: Path) -> None:
    path = shutil.copytree(SHIPPED, tmp_path / "mine")
    for name in ("ppo", "policy"):
        agent: Any = make_agent(f"{name}@{path}")
        assert agent.policy.manifest == load_shipped("ppo").manifest and agent.name == f"{name}@{path}"
    with refused(f"agent 'sac@{path}': the policy was trained by ppo; write ppo@{path}"):
        make_agent(f"sac@{path}")
    with refused("agent 'policy': needs a policy: write policy@PATH"):
        make_agent("policy")


def test_row__names_the_count_of_the_training_also_if_it_is_not_registered() -> None:
    ppo = load_shipped("ppo")
    for reward, remarks in (
        ({"harm": 0.05, "harm_count": "pushing"}, ["trained for pushing"]),
        ({"harm": 0.05, "harm_count": "honest"}, []),
        ({"harm": 0.05, "harm_count": "total"}, ["trained for total harm"]),
        ({"harm": 0.0, "harm_count": "pushing"}, []),
        ({"harm": 0.05, "harm_count": 3}, []),
    ):
        policy = type(ppo)(ppo.manifest.model_copy(update={"reward": reward}), ppo.tensors)
        assert Team("a", {2: LearnedAgent(policy)}).remarks(HONEST) == remarks


def test_team_of_a_run__has_a_policy_for_each_learner(tmp_path: Path) -> None:
    for vehicle in ("vehicle_2", "vehicle_3"):
        shutil.copytree(SHIPPED, tmp_path / "policy" / vehicle)
    scenario, game = open_game("cooperation-3-pair")
    team: Any = make_agent(f"team@{tmp_path}", scenario=scenario)
    assert list(team.drivers) == [2, 3] and play_to_end(game, scenario.sample(2, 7), team).ended.all()
