"""Trainings of a reproduction: learning curves at two delays, and a PPO that is stopped before it has converged."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ethbrake_marl.errors import InvalidInput, need
from ethbrake_marl.files.plain import read_object

if TYPE_CHECKING:
    from ethbrake_marl.extensions.reproduction.made import Settings

HIGH, LOW, STOPPED = "high", "low", "stopped"
STATUS = "run.json"  # of a run


class Plan(NamedTuple):
    """Trainings by one recipe in one scenario, one for each seed."""

    scenario: str
    recipe: str
    decisions: int
    every_updates: int  # between two measurements
    seeds: int
    per_s: int  # decisions in a second on one core (Intel Xeon), to tell how long it takes


def _curves(scenario: str) -> tuple[Plan, ...]:
    return (
        Plan(scenario, "ppo", 400_000, 4, 3, 16_000),
        Plan(scenario, "sac", 60_000, 30, 3, 3_000),
        Plan(scenario, "ppo-paper", 100_000, 1, 3, 5_000),
        Plan(scenario, "sac-paper", 20_000, 1_000, 3, 170),
    )


GROUPS = {
    STOPPED: (Plan("paper-random", "ppo", 100_000, 4, 1, 16_000),),  # a fifteenth of the recipe's decisions
    HIGH: _curves("paper-delay-high"),
    LOW: _curves("paper-delay-low"),
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
    left = [
        plan.decisions / plan.per_s
        for group in groups
        for plan in GROUPS[group]
        for run in runs_of(folder, group, plan)
        if not is_finished(run)
    ]
    return sum(left)


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
    need("torch")
    from ethbrake_marl.training.recipe import load_recipe
    from ethbrake_marl.training.train import resume, train as train_policy

    if (run / STATUS).is_file():
        return resume(run, on_progress=settings.tell).status == "finished"
    recipe = load_recipe(plan.recipe)
    changes = {"log_every_updates": plan.every_updates} if hasattr(recipe, "log_every_updates") else {}
    measured = {**recipe.evaluation.model_dump(), "every_updates": plan.every_updates}
    recipe = recipe.replace(evaluation=measured, **changes)
    run.parent.mkdir(parents=True, exist_ok=True)
    result = train_policy(recipe, plan.scenario, run, seed=seed, steps=plan.decisions, on_progress=settings.tell)
    return result.status == "finished"


def unconverged(settings: Settings) -> str:
    """Return the spec of a policy "obtained from training before convergence occurred", which is trained if need be.

    Raises ``InvalidInput`` if Ctrl-C stopped its training.
    """
    if not train(settings, [STOPPED]):
        raise InvalidInput("the training of the policy that has not converged was interrupted; repeat the command")
    ((run,),) = trained(settings.folder, STOPPED).values()
    return f"policy@{run / 'policy-last'}"
