"""Policies that four libraries have trained, as agents of one table: ``ethbrake evaluate --agents FILE:cleanrl,...``.

Each library's file left its policy in its folder of the runner. The table is made in the environment of BenchMARL,
which has the other three libraries, too.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import ethbrake_marl as eb
from tests.libraries import benchmarl as benchmarl_file, cleanrl as cleanrl_file, torchrl as torchrl_file
from tests.libraries.library import ROOT

WORK = ROOT / ".venvs" / "work"
FILES = {
    "stable_baselines3": WORK / "stable_baselines3" / "sb3.zip",
    "cleanrl": WORK / "cleanrl" / "cleanrl.pt",
    "torchrl": WORK / "torchrl" / "torchrl.pt",
    "benchmarl": WORK / "benchmarl" / "benchmarl.pt",
}
SHOWN = ("agent", "collision_rate", "first_impact_harm", "total_harm", "vehicle_1_shoved_m")


def stable_baselines3() -> Any:
    """A model as it was saved."""
    from stable_baselines3 import PPO

    return eb.policy_agent(PPO.load(FILES["stable_baselines3"]), name="stable_baselines3")


def cleanrl() -> Any:
    """The network, and what its normaliser counted."""
    import torch

    file = torch.load(FILES["cleanrl"], weights_only=False)
    return eb.policy_agent(cleanrl_file.policy_of(file), name="cleanrl")


def torchrl() -> Any:
    """The weights of an actor of TorchRL."""
    import torch

    actor = torchrl_file.make_actor()
    actor.load_state_dict(torch.load(FILES["torchrl"], weights_only=False))
    return eb.policy_agent(torchrl_file.policy_of(actor), name="torchrl", clip=True)


def benchmarl() -> Any:
    """A policy of BenchMARL as a whole."""
    import torch

    policy = torch.load(FILES["benchmarl"], weights_only=False)
    return eb.policy_agent(benchmarl_file.policy_of(policy), name="benchmarl", clip=True)


def make_table(python: Path) -> list[dict[str, Any]]:
    """The rows of ``ethbrake evaluate`` with all of them beside full braking and what ships; prints its text, too."""
    agents = ["full_brake", "e_v2x_bm", *(f"{Path(__file__)}:{name}" for name in FILES), "ppo@shipped"]
    command = [str(python), "-W", "ignore", "-m", "ethbrake_marl", "evaluate", "--episodes", "500"]
    given = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    told = subprocess.run(
        [*command, "--json", "--agents", ",".join(agents)], env=given, check=True, stdout=subprocess.PIPE, text=True
    )
    return [{name: row[name] for name in SHOWN} for row in json.loads(told.stdout)]
