"""Cross-play: the front learner of one team drives with the other learners of another team.

    python docs/studies/cross_play.py benchmark-pair \\
        train/benchmark/vine.py:make_agent:runs/benchmark/runs/benchmark-pair-cooperation-seed{0,1,2}

Prints the honest cost as a matrix (row: team of the front learner; column: team of the others), the mean on the
diagonal, where teams drive as they were trained, and the mean off the diagonal, with bootstrap intervals over teams.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.evaluation.benchmark import evaluate_task
from ethbrake_marl.files.sheet import Estimate


def cross_play(task: str, agents: Sequence[str]) -> tuple[list[str], NDArray[Any]]:
    """Names of the teams; mean honest cost, [teams of the front learner, teams of the others] m2/s2.

    A group of agents stands for several teams.
    """
    scenario = eb.load_scenario(task)
    front, *others = scenario.learners
    teams = make_teams(agents, scenario)
    if not others or len(teams) < 2:
        raise InvalidInput(
            f"cross-play needs two agents or more, and two learners or more; {task} has {1 + len(others)}"
        )
    mixed = {
        f"{i},{j}": eb.Team(f"{i},{j}", {**rear.drivers, front: first.drivers[front]})
        for i, first in enumerate(teams.values())
        for j, rear in enumerate(teams.values())
    }
    result = evaluate_task(scenario, mixed)
    cost = [[result[f"{i},{j}"]["honest_cost"].mean() for j in range(len(teams))] for i in range(len(teams))]
    return [Path(name).name for name in teams], np.array(cost)


def summary(cost: NDArray[Any]) -> tuple[Estimate, Estimate]:
    """Mean on and off the diagonal of a matrix, with bootstrap intervals over the teams."""
    teams = len(cost)
    drawn = np.random.default_rng(0).choice(teams, (10_000, teams))
    drawn = drawn[(drawn != drawn[:, :1]).any(axis=1)]  # samples with two teams or more
    pairings = cost[drawn[:, :, None], drawn[:, None, :]]
    off = np.nanmean(np.where(drawn[:, :, None] != drawn[:, None, :], pairings, np.nan), axis=(1, 2))
    ends = [np.percentile(means, (2.5, 97.5)).tolist() for means in (cost.diagonal()[drawn].mean(axis=1), off)]
    values = cost.diagonal().mean(), cost[~np.eye(teams, dtype=bool)].mean()
    on, apart = (Estimate(float(value), (low, high)) for value, (low, high) in zip(values, ends, strict=True))
    return on, apart


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="name of a scenario with several learners")
    parser.add_argument("agents", nargs="+", help="names of agents, teams or groups")
    args = parser.parse_args()
    try:
        names, cost = cross_play(args.task, args.agents)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    for row in cost:
        print(" ".join(f"{value:7.2f}" for value in row))
    on, off = summary(cost)
    print(f"on the diagonal {on.in_words()}, off {off.in_words()}")
