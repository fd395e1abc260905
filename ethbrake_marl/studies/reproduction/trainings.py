"""The trainings of ``ethbrake reproduce --full``: learning curves, a policy stopped early, open weights of the reward.

Each group is a folder of learning curves: finished trainings are kept, begun ones go on, by the rules of
``learning_curves.train_all``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.learning.run_folder import is_finished
from ethbrake_marl.progress import OnProgress
from ethbrake_marl.scenario import Scenario, load_scenario

FOLDER = "trainings"  # inside the folder of a reproduction
STOPPED, OPEN = "stopped", "open"
CURVES = {delay: (delay, f"{delay}-ppo-paper", f"{delay}-sac-paper") for delay in ("low", "high")}  # -> groups
SEEDS = 3
TRAINED_HARM = "eval/first_impact_harm"  # column of a training's table
STATED_STATE = (  # positions and speeds of all, and the others' actions: no more is in the paper's state
    "own.speed", "own.acceleration", "front_1.gap", "front_1.closing_speed", "front_1.acceleration", "rear_1.gap",
    "rear_1.closing_speed", "rear_1.acceleration",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TrainedRecipe:
    """So many decisions of a recipe, measured every so many updates, and what they take.

    ``per_s``: decisions per second of one core (Intel Xeon), for the estimate that is told beforehand.
    """

    recipe: str
    decisions: int
    every_updates: int
    per_s: int

    def load(self, name: str | None = None, **changes: Any) -> TrainingRecipe:
        """The recipe; under another name with ``changes``."""
        found = load_recipe(self.recipe)
        evaluation = {**found.evaluation.model_dump(), "every_updates": self.every_updates}
        if "log_every_updates" in type(found).model_fields:  # else a table has a row for every update
            changes["log_every_updates"] = self.every_updates
        return found.replace(name=name or found.name, total_steps=self.decisions, evaluation=evaluation, **changes)


PPO = TrainedRecipe("ppo", 400_000, 4, 16_000)
SAC = TrainedRecipe("sac", 60_000, 30, 3_000)
PPO_PAPER = TrainedRecipe("ppo-paper", 100_000, 1, 5_000)
SAC_PAPER = TrainedRecipe("sac-paper", 20_000, 1_000, 170)
EARLY = TrainedRecipe("ppo", 100_000, 4, 16_000)  # a fifteenth of the recipe's own number


@dataclass(frozen=True, slots=True)
class Group:
    """Trainings on one scenario in one folder, in the order in which they are done."""

    name: str
    scenario: str  # a shipped one
    trained: Mapping[str, tuple[TrainedRecipe, TrainingRecipe]]  # by the name that the recipe has there
    seeds: int

    def load_scenario(self) -> Scenario:
        """The scenario."""
        return load_scenario(self.scenario)


def _curves(name: str, scenario: str, recipes: Sequence[TrainedRecipe]) -> Group:
    return Group(name, scenario, {each.recipe: (each, each.load()) for each in recipes}, SEEDS)


def reward_variants() -> dict[str, dict[str, Any]]:
    """What differs from ``ppo-paper`` in each training of the open quantities, by its name there."""
    base = PPO_PAPER.load().reward.model_dump(exclude_defaults=True)
    changed = {"risk-0": {"risk": 0.0}, "risk-1": {"risk": 1.0}, "jerk-1e-4": {"jerk": 1e-4}}
    changed["terminal-0"] = {"terminal": 0.0}
    rewards = {f"ppo-paper-{name}": {"reward": {**base, **own}} for name, own in changed.items()}
    return {"ppo-paper": {}, **rewards, "ppo-paper-state": {"observation": STATED_STATE}}


def groups() -> tuple[Group, ...]:
    """Every group, the quickest first, so that results are there early."""
    variants = {name: (PPO_PAPER, PPO_PAPER.load(name, **own)) for name, own in reward_variants().items()}
    return (
        Group(STOPPED, "paper-random", {"ppo-stopped": (EARLY, EARLY.load("ppo-stopped"))}, 1),
        *(_curves(delay, f"paper-delay-{delay}", (PPO, SAC)) for delay in CURVES),
        *(_curves(f"{delay}-ppo-paper", f"paper-delay-{delay}", (PPO_PAPER,)) for delay in CURVES),
        Group(OPEN, "paper-random", variants, 2),
        *(_curves(f"{delay}-sac-paper", f"paper-delay-{delay}", (SAC_PAPER,)) for delay in CURVES),
    )


def group_named(name: str) -> Group:
    """The group of that name."""
    return {group.name: group for group in groups()}[name]


def training_folders(folder: Path, group: Group) -> Iterator[tuple[str, list[Path]]]:
    """Each recipe of a group, and the folders of its seeds."""
    for name in group.trained:
        yield name, [folder / FOLDER / group.name / f"{name}-seed{seed}" for seed in range(group.seeds)]


def finished(folder: Path, group: Group) -> dict[str, list[Path]]:
    """The recipes of a group all of whose seeds have been trained to the end, and their folders."""
    return {name: paths for name, paths in training_folders(folder, group) if all(is_finished(p) for p in paths)}


def seconds_left(folder: Path, wanted: Collection[str]) -> float:
    """Seconds of one core that the trainings of these groups still take, begun ones reckoned whole."""
    left = 0.0
    for group in groups():
        if group.name in wanted:
            for name, paths in training_folders(folder, group):
                trained, _ = group.trained[name]
                left += sum(trained.decisions / trained.per_s for path in paths if not is_finished(path))
    return left


def trained_names(folder: Path, wanted: Collection[str]) -> list[str]:
    """Every recipe of these groups whose seeds are all trained, as ``group/recipe``."""
    return [f"{group.name}/{name}" for group in groups() if group.name in wanted for name in finished(folder, group)]


def train_groups(folder: Path, wanted: Collection[str], tell: OnProgress | None = None) -> bool:
    """Train what is left of these groups, in their order; False when Ctrl-C stopped it."""
    # torch takes seconds to load, and nothing else here needs it
    from ethbrake_marl.studies.learning_curves import Trainings, train_all

    for group in groups():
        if group.name in wanted:
            plan = [Trainings(recipe, group.seeds) for _, recipe in group.trained.values()]
            if not train_all(group.load_scenario(), plan, folder / FOLDER / group.name, tell=tell):
                return False
    return True
