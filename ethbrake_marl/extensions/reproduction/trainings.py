"""Training runs of ``ethbrake reproduce --full``: for learning curves, an unconverged policy, and open settings.

*Open settings* are settings that the paper does not state. ``learning_curves.LearningCurves`` manages the folder of a
group.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe

STOPPED, OPEN = "stopped", "open"

CURVES = {delay: (delay, f"{delay}-ppo-paper", f"{delay}-sac-paper") for delay in ("low", "high")}  # delay -> groups

HARM_COLUMN = "eval/first_impact_harm"  # column of a training's table

_STATED_STATE = (  # the paper's state: positions and speeds of all vehicles, and actions of the others
    "own.speed", "own.acceleration", "front_1.gap", "front_1.closing_speed", "front_1.acceleration", "rear_1.gap",
    "rear_1.closing_speed", "rear_1.acceleration",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TrainedRecipe:
    """A recipe, and the length of its training run."""

    recipe: str  # name of a shipped recipe
    decisions: int  # length of the training, in decisions
    every_updates: int  # number of updates between two evaluations
    per_s: int  # decisions per second on one core (Intel Xeon), to estimate the time of the training

    def load(self, name: str, **changes: Any) -> TrainingRecipe:
        """Return the recipe as ``name``, with ``decisions``, ``every_updates`` and new values ``changes``."""
        recipe = load_recipe(self.recipe)
        evaluation = {**recipe.evaluation.model_dump(), "every_updates": self.every_updates}
        if "log_every_updates" in type(recipe).model_fields:  # otherwise the table has a row for every update
            changes["log_every_updates"] = self.every_updates
        return recipe.replace(name=name, total_steps=self.decisions, evaluation=evaluation, **changes)


PPO_PAPER = TrainedRecipe("ppo-paper", 100_000, 1, 5_000)

EARLY = TrainedRecipe("ppo", 100_000, 4, 16_000)  # a fifteenth of the decisions of recipe ``ppo``


@dataclass(frozen=True, slots=True)
class Group:
    """Group of training runs: several recipes on one scenario, stored in one folder."""

    name: str  # name of the group; also the name of its folder
    scenario: str  # name of a shipped scenario
    # name of the recipe in the group -> settings of the training, and the recipe
    trained: Mapping[str, tuple[TrainedRecipe, TrainingRecipe]]
    seeds: int  # number of seeds of each recipe; the seeds are 0, 1, ...


def groups() -> dict[str, Group]:
    """Return all groups of training runs by name, in the order in which they are trained: the quickest first."""
    base = PPO_PAPER.load("ppo-paper").reward.model_dump(exclude_defaults=True)
    changed = {
        "risk-0": {"risk": 0.0},
        "risk-1": {"risk": 1.0},
        "jerk-1e-4": {"jerk": 1e-4},
        "terminal-0": {"terminal": 0.0},
    }
    variants: dict[str, dict[str, Any]] = {
        "ppo-paper": {},
        **{f"ppo-paper-{name}": {"reward": {**base, **own}} for name, own in changed.items()},
        "ppo-paper-state": {"observation": _STATED_STATE},
    }

    def curves(suffix: str, *recipes: TrainedRecipe) -> list[Group]:
        trained = {each.recipe: (each, each.load(each.recipe)) for each in recipes}
        return [Group(f"{delay}{suffix}", f"paper-delay-{delay}", trained, 3) for delay in CURVES]

    every = [
        Group(STOPPED, "paper-random", {"ppo-stopped": (EARLY, EARLY.load("ppo-stopped"))}, 1),
        *curves("", TrainedRecipe("ppo", 400_000, 4, 16_000), TrainedRecipe("sac", 60_000, 30, 3_000)),
        *curves("-ppo-paper", PPO_PAPER),
        Group(
            OPEN, "paper-random", {name: (PPO_PAPER, PPO_PAPER.load(name, **own)) for name, own in variants.items()}, 2
        ),
        *curves("-sac-paper", TrainedRecipe("sac-paper", 20_000, 1_000, 170)),
    ]
    return {group.name: group for group in every}
