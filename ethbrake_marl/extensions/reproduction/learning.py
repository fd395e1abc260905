"""Trainings by the paper's own process, and its learning curves.

The process is the recipes ``ppo-paper`` and ``sac-paper`` in the paper's map, five seeds each: in the random test, and
at a high and a low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``). A further PPO of ours is stopped
before it has converged.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import RULES
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.curves import curves_figure, over_seeds
from ethbrake_marl.extensions.report.style import TITLES
from ethbrake_marl.extensions.reproduction.made import Drawn, Made, Settings
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Less, judge, not_run
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

RANDOM, HIGH, LOW, STOPPED = "random", "high", "low", "stopped"
STATUS = "run.json"  # of a run


class Plan(NamedTuple):
    """Trainings by one recipe in one scenario, one for each seed."""

    scenario: str
    recipe: str
    seeds: int
    seconds: float  # of each on one core, to tell how long it takes
    decisions: int | None = None  # None: those of the recipe
    mapped: bool = True  # in the paper's map


def _process(scenario: str) -> tuple[Plan, ...]:
    return Plan(scenario, "ppo-paper", 5, 200.0), Plan(scenario, "sac-paper", 5, 200.0)


GROUPS = {
    STOPPED: (Plan("paper-random", "ppo", 1, 6.0, 100_000, mapped=False),),  # a fifteenth of the recipe's decisions
    RANDOM: _process("paper-random"),
    HIGH: _process("paper-delay-high"),
    LOW: _process("paper-delay-low"),
}


def runs_of(folder: Path, group: str, plan: Plan) -> list[Path]:
    """Return the folders of the runs of a plan, one for each seed."""
    return [folder / "trainings" / group / f"{plan.recipe}-seed{seed}" for seed in range(plan.seeds)]


def is_finished(run: Path) -> bool:
    """Return whether a run has finished. Raises ``InvalidInput`` if its status is damaged."""
    status = run / STATUS
    return status.is_file() and read_object(status).get("status") == "finished"


def trained(folder: Path, group: str) -> dict[str, list[Path]]:
    """Return the runs of a group: recipe -> folder for each seed. A recipe with an unfinished run is left out."""
    every = {plan.recipe: runs_of(folder, group, plan) for plan in GROUPS[group]}
    return {recipe: runs for recipe, runs in every.items() if all(map(is_finished, runs))}


def seconds_left(folder: Path, groups: Iterable[str]) -> float:
    """Return about how long the runs take that have not finished, in processor seconds."""
    plans = [(group, plan) for group in groups for plan in GROUPS[group]]
    return sum(plan.seconds for group, plan in plans for run in runs_of(folder, group, plan) if not is_finished(run))


def train(settings: Settings, groups: Iterable[str]) -> bool:
    """Do, or continue, the runs of some groups that have not finished. Return False if Ctrl-C stopped one.

    Raises ``MissingExtra`` without torch, and the errors of ``eb.train`` and ``eb.resume``.
    """
    for group in groups:
        for plan in GROUPS[group]:
            for seed, run in enumerate(runs_of(settings.folder, group, plan)):
                if not (is_finished(run) or _train(plan, run, seed, settings)):
                    return False
    return True


def _train(plan: Plan, run: Path, seed: int, settings: Settings) -> bool:
    import ethbrake_marl as eb

    if (run / STATUS).is_file():
        return eb.resume(run, on_progress=settings.tell).status == "finished"
    scenario, recipe = eb.load_scenario(plan.scenario), eb.load_recipe(plan.recipe)
    if plan.mapped:
        scenario = scenario.replace(physics="paper-map")
    reward = {**recipe.reward.model_dump(mode="json"), "harm_count": RULES["paper"]}
    recipe = recipe.replace(reward=reward)
    result = eb.train(recipe, scenario, run, seed=seed, steps=plan.decisions, on_progress=settings.tell)
    return result.status == "finished"


def unconverged(folder: Path) -> str:
    """Return the spec of the policy "obtained from training before convergence occurred", which has been trained."""
    ((run,),) = trained(folder, STOPPED).values()
    return f"policy@{run / 'policy-last'}"
