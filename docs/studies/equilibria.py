"""Equilibria of the levels of cooperation, and teams with own or common objectives.

    .venv/bin/python docs/studies/equilibria.py runs/equilibria --jobs 2

Trains the teams that are missing in the folder, searches equilibria, and prints the tables, all on the same worlds.
Searches minimise first-impact harm. Processor seconds of a search do not contain compiling.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.extensions.cooperation import (
    Equilibrium,
    best_joint_harm,
    compare_starts,
    find_equilibria,
    mean_over_seeds,
    price_of_anarchy,
)
from ethbrake_marl.extensions.cooperation.levels import STANDARD
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.training.recipe import Scheme

LEVELS = [name for name in STANDARD if eb.load_scenario(name).learners]
WORLDS, SEED, BUDGET, ROUNDS, JOINT_BUDGET = 200, 6005, 10_000, 20, 50_000
OBJECTIVES = ("own", "total", "maximin")
TRAINED = ("cooperation-3-pair", "cooperation-4-all")
SCHEMES: dict[str, Scheme] = {"cooperation": "shared", "cooperation-ppo": "independent"}  # recipe -> scheme
SEEDS = {"cooperation": (0, 1, 2), "cooperation-ppo": (0, 1)}
PRICES = (
    *("level", "objective", "ends converged", "worlds where ends differ", "joint optimum"),
    *("best end", "worst end", "price of stability", "price of anarchy", "processor s"),
)
LEARNED = ("level", "recipe, scheme", "objective", "Vehicle 1", "Vehicle 2", "Vehicle 3", "line")


class Level(NamedTuple):
    name: str
    ends: Mapping[str, Mapping[str, Equilibrium]]  # objective -> start -> where the best responses end
    seconds: Mapping[str, float]  # objective -> processor seconds of the search
    optimum: Floats  # [n, N] first-impact harm of each vehicle in the joint optimum, m2/s2


def search(name: str, worlds: int) -> Level:
    scenario = eb.load_scenario(name)
    lines, ends, seconds = scenario.sample(worlds, SEED), {}, {}
    find_equilibria(scenario, lines.take([0]), "own", budget=10, rounds=1)  # compiles
    for objective in OBJECTIVES:
        begun = time.process_time()
        ends[objective] = find_equilibria(scenario, lines, objective, budget=BUDGET, rounds=ROUNDS)
        seconds[objective] = time.process_time() - begun
    every = [end for starts in ends.values() for end in starts.values()]
    optimum = best_joint_harm(scenario, lines, every, budget=JOINT_BUDGET)
    return Level(name, ends, seconds, optimum)


def train(folder: Path, name: str, objective: str, recipe: str, seed: int) -> None:
    import torch

    torch.set_num_threads(1)
    if not folder.exists():
        scenario = eb.load_scenario(name).replace(objective=objective)
        plan = eb.load_recipe(recipe)
        plan = plan.replace(reward={**plan.reward.model_dump(mode="json"), "harm_count": "first"})
        eb.train(plan, scenario, folder, scheme=SCHEMES[recipe], seed=seed, on_progress=None)


def drive(folders: Sequence[Path], name: str, worlds: int) -> Floats:
    """Return the first-impact harm of each vehicle with every trained team, [seeds, n, N] in m2/s2."""
    result = eb.evaluate(name, {each.name: f"team@{each}" for each in folders}, episodes=worlds, seed=SEED)
    vehicles = range(1, eb.load_scenario(name).vehicles + 1)
    return np.stack(
        [np.stack([own[f"first_impact_harm_{i}"] for i in vehicles], axis=1) for own in result.columns.values()]
    )


def show(estimate: Estimate | None, digits: int = 2) -> str:
    return "–" if estimate is None else estimate.in_words(digits=digits)


def percent(flags: Any) -> str:
    return rate(np.ravel(flags)).in_words(digits=0, scale=100.0, unit=" %")


def price_rows(level: Level) -> list[list[str]]:
    """Return rows with the rates of convergence and of different ends, and the prices of anarchy and stability."""
    rows = []
    for objective, ends in level.ends.items():
        spread, best = compare_starts(ends), level.optimum
        there = spread.found > 0
        rows.append(
            [
                f"`{level.name}`",
                objective,
                percent([end.converged for end in ends.values()]),
                percent(spread.differs[there]),
                show(mean(best.sum(axis=1))),
                show(mean(spread.best[there].sum(axis=1))),
                show(mean(spread.worst[there].sum(axis=1))),
                show(price_of_anarchy(spread.best, best)),
                show(price_of_anarchy(spread.worst, best)),
                f"{level.seconds[objective]:.0f}",
            ]
        )
    return rows


def learned_rows(place: Path, name: str, worlds: int) -> list[list[str]]:
    rows = []
    for recipe, objective in product(SCHEMES, ("own", "total")):
        borne = drive([place / job(name, objective, recipe, seed) for seed in SEEDS[recipe]], name, worlds)
        each = [show(mean_over_seeds(borne[:, :, i])) for i in range(borne.shape[2])]
        line = show(mean_over_seeds(borne.sum(axis=2)))
        rows.append([f"`{name}`", f"`{recipe}`, {SCHEMES[recipe]}", objective, *each, line])
    return rows


def job(name: str, objective: str, recipe: str, seed: int) -> str:
    return f"{name}-{objective}-{recipe}-seed{seed}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the trainings; existing ones are not repeated")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel processes, with one thread each")
    parser.add_argument("--worlds", type=int, default=WORLDS, help="worlds of the list")
    given = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        trainings = [
            pool.submit(train, given.folder / job(*each), *each)
            for recipe, seeds in SEEDS.items()
            for each in product(TRAINED, ("own", "total"), [recipe], seeds)
        ]
        levels = list(pool.map(search, LEVELS, [given.worlds] * len(LEVELS)))
        for each in trainings:
            each.result()
    learned = [row for name in TRAINED for row in learned_rows(given.folder, name, given.worlds)]
    print(table(PRICES, [row for level in levels for row in price_rows(level)]), table(LEARNED, learned), sep="\n\n")


if __name__ == "__main__":
    main()
