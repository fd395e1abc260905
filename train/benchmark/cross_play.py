"""Cross-play: the front learner of one team drives with the other learners of another team.

    python train/benchmark/cross_play.py benchmark-pair team@runs/benchmark/runs/benchmark-pair-cooperation-seed{0,1,2}

Prints the honest cost as a matrix (row: team of the front learner; column: team of the others), the mean on the
diagonal, where teams drive as they were trained, and the mean off the diagonal, with intervals over the worlds.
`--csv` writes the matrix to a file, one row for each pairing.
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
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import check_target, write_file


def cross_play(task: str, agents: Sequence[str]) -> tuple[list[str], NDArray[Any]]:
    """Names of the teams; honest cost of each world, [teams of the front learner, teams of the others, worlds] m2/s2.

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
    cost = [[result[f"{i},{j}"]["honest_cost"] for j in range(len(teams))] for i in range(len(teams))]
    return [Path(name).name for name in teams], np.array(cost)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="name of a scenario with several learners")
    parser.add_argument("agents", nargs="+", help="names of agents, teams or groups")
    parser.add_argument("--csv", type=Path, help="also write the matrix to this file")
    args = parser.parse_args()
    try:
        if args.csv:
            check_target(args.csv, force=True)
        names, cost = cross_play(args.task, args.agents)
        if args.csv:
            pairings = [
                {"task": args.task, "front": front, "others": others, "honest_cost": value}
                for front, row in zip(names, cost.mean(axis=2), strict=True)
                for others, value in zip(names, row, strict=True)
            ]
            write_file(args.csv, csv_text(pairings).encode())
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    for row in cost.mean(axis=2):
        print(" ".join(f"{value:7.2f}" for value in row))
    same = np.eye(len(cost), dtype=bool)
    print(
        f"on the diagonal {mean(cost[same].mean(axis=0)).in_words()}, off {mean(cost[~same].mean(axis=0)).in_words()}"
    )
