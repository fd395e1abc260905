"""Tests of Euro NCAP, FMVSS 127 and UN R157 with a human driver behind: the table of docs/standards.md.

    .venv/bin/python docs/studies/followed.py runs/followed

Trains the recipe ``ppo`` with five seeds on four of the tests together, with 200,000 decisions each (a minute on one
core), and evaluates it and the agents without training in all five tests. A training that exists in the folder is not
repeated.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.worlds.catalogue import group_of_scenarios

TRAINED_ON, DECISIONS, SEEDS = "mixture-standards-followed", 200_000, (1, 2, 3, 4, 5)
AGENTS = ("full_brake", "aeb", "r157_fsm", "idm", "plan", "plan:reaction=1.25")
WORLDS = 500
COLUMNS = ("collided", "honest_cost", "injury_lr4s")


def trained(folder: Path) -> list[str]:
    """Train the policies that the folder lacks; return the names of all."""
    recipe, runs = eb.load_recipe("ppo"), [folder / f"seed-{seed}" for seed in SEEDS]
    for seed, run in zip(SEEDS, runs, strict=True):
        if not run.exists():
            eb.train(recipe.replace(seed=seed), TRAINED_ON, run, steps=DECISIONS)
    return [f"policy@{run}" for run in runs]


def cells(scenario: str, policies: list[str]) -> list[str]:
    """For each agent, and the policies together: share with an impact, honest cost, severe injuries."""
    agents = [*AGENTS, *policies]
    result = eb.evaluate(scenario, agents, episodes=WORLDS, harm_count="honest", measures="injury_lr4s")
    means = {agent: [float(result[agent][column].mean()) for column in COLUMNS] for agent in agents}
    row = [f"{100 * rate:.1f} % / {cost:.2f} / {severe:.2f}" for rate, cost, severe in map(means.get, AGENTS)]
    rates, costs, injuries = (mean(np.array(column)) for column in zip(*map(means.get, policies), strict=True))
    return [*row, f"{100 * rates.value:.1f} % / {costs.in_words()} / {injuries.value:.2f}"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder for the trainings")
    policies = trained(parser.parse_args().folder)
    print("| test | " + " | ".join(f"`{agent}`" for agent in AGENTS) + f" | PPO, mean of {len(SEEDS)} seeds |")
    print("|---|" + "---:|" * (len(AGENTS) + 1))
    for scenario in group_of_scenarios("followed"):
        print(" | ".join([f"| `{scenario}`", *cells(scenario, policies)]) + " |", flush=True)
