"""Equilibria of the levels of cooperation, and teams with own or common objectives: docs/results/equilibria.json.

    .venv/bin/python docs/studies/equilibria.py runs/equilibria --jobs 2

Trains the teams that are missing in the folder, searches equilibria, and writes the tables, all on the same worlds.
Searches minimise first-impact harm. Processor seconds of a search do not contain compiling.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.evaluation.seeds import mean_over_seeds
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.extensions.cooperation import (
    Equilibrium,
    best_joint_harm,
    compare_starts,
    find_equilibria,
    price_of_anarchy,
)
from ethbrake_marl.extensions.cooperation.levels import STANDARD
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.files.store import write_file
from ethbrake_marl.game.harm import HARM_COUNTS
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.training.recipe import Scheme
from ethbrake_marl.training.team import load_team

LEVELS = [name for name in STANDARD if eb.load_scenario(name).learners]
WORLDS, SEED, BUDGET, ROUNDS, JOINT_BUDGET = 200, 6005, 10_000, 20, 50_000
OBJECTIVES = ("own", "total", "maximin")
TRAINED = ("cooperation-3-pair", "cooperation-4-all")
SCHEMES: dict[str, Scheme] = {"cooperation": "shared", "cooperation-ppo": "independent"}  # recipe -> scheme
SEEDS = {"cooperation": (0, 1, 2), "cooperation-ppo": (0, 1)}
DOCS = Path(__file__).resolve().parents[1]
RESULTS = DOCS / "results" / "equilibria.json"


class Level(NamedTuple):
    """Results of the searches on one level."""

    name: str
    ends: Mapping[str, Mapping[str, Equilibrium]]  # objective -> start -> where the best responses end
    seconds: Mapping[str, float]  # objective -> processor seconds of the search
    optimum: Floats  # [n, N] first-impact harm of each vehicle in the joint optimum, m2/s2


def search(name: str, worlds: int) -> Level:
    """Search the equilibria of a level for every objective, and its joint optimum."""
    scenario = eb.load_scenario(name)
    lines, ends, seconds = scenario.sample(worlds, SEED).worlds, {}, {}
    find_equilibria(scenario, lines.take(np.arange(1)), "own", budget=10, rounds=1)  # compiles
    for objective in OBJECTIVES:
        begun = time.process_time()
        ends[objective] = find_equilibria(scenario, lines, objective, budget=BUDGET, rounds=ROUNDS)
        seconds[objective] = time.process_time() - begun
    every = [end for starts in ends.values() for end in starts.values()]
    optimum = best_joint_harm(scenario, lines, every, budget=JOINT_BUDGET, threads=1)
    return Level(name, ends, seconds, optimum["first"])


def train(folder: Path, name: str, objective: str, recipe: str, seed: int) -> None:
    """Train a team in the folder, unless the folder exists."""
    import torch

    torch.set_num_threads(1)
    if not folder.exists():
        scenario = eb.load_scenario(name).replace(objective=objective)
        eb.train(eb.load_recipe(recipe), scenario, folder, scheme=SCHEMES[recipe], seed=seed, on_progress=None)


def drive(folders: Sequence[Path], name: str, worlds: int) -> Floats:
    """Return the first-impact harm of each vehicle with every trained team, [seeds, n, N] in m2/s2."""
    scenario = eb.load_scenario(name)
    teams = {folder.name: load_team(folder, scenario, folder.name) for folder in folders}
    result = eb.evaluate(scenario.sample(worlds, SEED), teams, scenario=scenario, aftermath=False).complete()
    return np.stack([result.outcome(each).vehicle_harm("first") for each in teams])


def show(estimate: Estimate | None, digits: int = 2) -> str:
    return "–" if estimate is None else estimate.in_words(digits=digits)


def percent(flags: Any) -> str:
    return rate(int(np.sum(flags)), int(np.size(flags))).in_words(digits=0, scale=100.0, unit=" %")


def price_rows(level: Level) -> list[list[str]]:
    """Return rows with the rates of convergence and of different ends, and the prices of anarchy and stability."""
    rows = []
    for objective, ends in level.ends.items():
        spread, best = compare_starts(ends, "first"), level.optimum
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


def bearing_rows(level: Level) -> list[list[str]]:
    """Return rows with the harm of each vehicle where the best responses end, per start, and in the joint optimum."""
    rows = [[f"`{level.name}`", "total", "joint optimum", *(show(mean(each)) for each in level.optimum.T), "", ""]]
    rows[0][-2] = show(mean(level.optimum.sum(axis=1)))
    rows[0][-1] = "–"
    for objective, ends in level.ends.items():
        for start, end in ends.items():
            first, total = (end.borne[count] for count in HARM_COUNTS)
            each = [show(mean(vehicle)) for vehicle in first.T]
            line = [show(mean(harm.sum(axis=1))) for harm in (first, total)]
            rows.append([f"`{level.name}`", objective, start, *each, *line])
    return rows


def learned_rows(place: Path, name: str, worlds: int) -> list[list[str]]:
    """Return rows with the harm of each vehicle with trained teams."""
    rows = []
    for recipe, objective in product(SCHEMES, ("own", "total")):
        borne = drive([place / job(name, objective, recipe, seed) for seed in SEEDS[recipe]], name, worlds)
        each = [show(mean_over_seeds(borne[:, :, i])) for i in range(borne.shape[2])]
        line = show(mean_over_seeds(borne.sum(axis=2)))
        rows.append([f"`{name}`", f"`{recipe}`, {SCHEMES[recipe]}", objective, *each, line])
    return rows


def job(name: str, objective: str, recipe: str, seed: int) -> str:
    return f"{name}-{objective}-{recipe}-seed{seed}"


def write(levels: Sequence[Level], learned: list[list[str]], worlds: int, file: Path) -> str:
    """Write the tables in the format of docs/results, and return them as Markdown."""
    spec = importlib.util.spec_from_file_location("docs_results", DOCS / "extension" / "results.py")
    assert spec is not None and spec.loader is not None
    results = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = results  # its data classes look up annotations here
    spec.loader.exec_module(results)
    about = f"{worlds} worlds of seed {SEED}; first-impact harm in m²/s², mean per world with 95 % intervals."
    how = f"Best responses in turn from three starts, with {BUDGET:,} candidates per response"
    how += f" and at most {ROUNDS} rounds."
    vehicles = ["Vehicle 1", "Vehicle 2", "Vehicle 3"]
    tables = {
        "price-of-anarchy": (
            "Cost of separate decisions",
            [
                *("level", "objective", "ends converged", "worlds where ends differ", "joint optimum"),
                *("best end", "worst end", "price of stability", "price of anarchy", "processor s"),
            ],
            [row for level in levels for row in price_rows(level)],
            f"{about} {how} Ends differ if the harm of some vehicle differs by more than 0.1. Best and worst end are"
            " chosen per world, among converged ends. A price is a ratio of means.",
            "a long search",
        ),
        "equilibria-borne": (
            "Harm of each vehicle where best responses end",
            ["level", "objective", "start", *vehicles, "line, first-impact", "line, total"],
            [row for level in levels for row in bearing_rows(level)],
            f"{about} {how} All worlds, with and without convergence.",
            "a long search",
        ),
        "equilibria-learned": (
            "Harm of each vehicle with trained teams, own and common objectives",
            ["level", "recipe, scheme", "objective", *vehicles, "line"],
            learned,
            f"{about} Three seeds of `cooperation`, two of `cooperation-ppo`, a million decisions each; intervals over"
            " seeds and worlds.",
            "a training",
        ),
    }
    made = [
        results.Table(
            id=name,
            title=title,
            columns=columns,
            rows=rows,
            commands=["python docs/studies/equilibria.py runs/equilibria --jobs 2"],
            machine=this_machine().processor + ", shared with other work",
            date=datetime.datetime.now(datetime.UTC).date().isoformat(),
            compared=compared,
            note=note,
        )
        for name, (title, columns, rows, note, compared) in tables.items()
    ]
    write_file(file, results.text_of(made).encode())
    return "\n\n".join(f"{each.title}\n\n{each.markdown}" for each in made)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, search, write the tables and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the trainings; existing ones are not repeated")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel processes, with one thread each")
    parser.add_argument("--worlds", type=int, default=WORLDS, help="worlds of the list")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file for the tables")
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
    print(write(levels, learned, given.worlds, given.output))


if __name__ == "__main__":
    main()
