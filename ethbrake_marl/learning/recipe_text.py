"""Meanings of the keys of a recipe, and the text of a new one: every key with its value and a comment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ethbrake_marl.files.json_schema import schema_lines
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.scenario.catalogue import check_file_name

MEANINGS = {
    "name": "equal to the file's name without .yaml",
    "title": "one line for lists",
    "description": "what it is for",
    "source": "where the values come from",
    "algorithm": "a registered name: ppo, sac, counterfactual",
    "scheme": "how several learners train together: single, shared, independent, centralised",
    "total_steps": "decisions of all learners",
    "n_envs": "worlds that are advanced together",
    "learning_rate": "of the optimiser, from its start to its end",
    "gamma": "discount of one time step; equal to reward.shaping_discount",
    "reward": "weights and constants of the reward's terms (docs/learning.md)",
    "observation": "groups and features that learners observe, [own, front_1, rear_1]; left out: the scenario's",
    "horizon_is_end": "true: nothing is expected beyond the horizon",
    "seed": "of worlds, networks and exploration",
    "evaluation": "the fixed list on which the policy is measured while it learns, and how often",
    "checkpoint_every_updates": "updates between two checkpoints",
    "batch_size": "decisions in one step of the optimiser",
    "network": "hidden layers of actor and critic, and their activation",
    "ent_coef": "weight of the policy's entropy; sac: auto, or a number",
    "n_steps": "decisions of each world between two updates",
    "n_epochs": "how often an update goes through what was collected",
    "gae_lambda": "memory of the advantages, from 0 (one step) to 1 (all)",
    "clip_range": "how far the probability of an action may move in one update",
    "vf_coef": "weight of the critic's loss",
    "max_grad_norm": "longest gradient",
    "target_kl": "an update stops beyond this divergence",
    "turns": "rounds in which independent learners learn one after the other",
    "steps_per_update": "decisions of each world between two updates",
    "gradient_steps": "steps of the optimiser in one update",
    "buffer_size": "decisions that the replay memory holds",
    "learning_starts": "decisions before the first update",
    "tau": "share by which the target critic follows in one update",
    "initial_ent_coef": "where an automatic ent_coef starts",
    "target_entropy": "what an automatic ent_coef keeps; without it -1 per action",
    "target_update_interval": "updates between two of the target critic",
    "start": "a policy to go on from, ppo@shipped; left out: random weights",
    "counterfactuals": "how many of the decisions of a round are tried in two ways",
    "offset": "how far an action is moved to see what comes of it; the logarithm of what is drawn is uniform",
    "holds": "for how many steps it is moved, one of these",
    "gradient_limit": "a larger gradient, at a jump, counts as this one; return per unit of action",
    "trust_radius": "farthest that one update asks an action to move",
    "anchor": "how much an action that makes no difference holds to where it is",
    "averaging": "share of itself that the average of the weights, which drives, keeps in each gradient step",
    "focus": "share of what is tried that a scout chooses; left out: 0, all decisions alike",
    "modes": "several networks and a gate between them; left out: one network",
    "log_every_updates": "updates between two rows of the progress table",
}


def new_recipe_text(name: str, based_on: str = "ppo") -> str:
    """Text of a commented YAML file for a new recipe ``name`` with the values of ``based_on``, all keys written out.

    A key that ``based_on`` leaves out stands in a comment. Save it as ``<name>.yaml``. Raises ``InvalidInput`` for a
    name that cannot be one, and what ``load_recipe`` raises for ``based_on``.
    """
    check_file_name("recipe", name)
    base = load_recipe(based_on)
    words = {
        "title": "One line for lists",
        "description": "What this recipe is for.",
        "source": f"Values of {base.name}, to be changed.",
    }
    head = f"# Recipe {name}, started from {base.name}. Train with it: ethbrake train --recipe {name}.yaml\n"
    return recipe_text(base.replace(name=name, **words), head)


def recipe_text(recipe: TrainingRecipe, head: str) -> str:
    """Text of a commented YAML file of ``recipe`` below ``head``, all keys written out.

    A key that it leaves out stands in a comment.
    """
    values = recipe.model_dump(mode="json")
    lines = (_entry(key, values.get(key)) for key in type(recipe).model_fields)
    return head + schema_lines("recipe") + "".join(lines)


def _entry(key: str, value: Any) -> str:
    """A key with its comment above; a mapping has each of its keys on a line of its own."""
    comment = f"\n# {MEANINGS[key]}\n" if key in MEANINGS else "\n"
    if value is None:
        return f"{comment}# {key}:\n"
    if isinstance(value, Mapping):
        inside = "".join(f"  {name}: {flow_text(entry)}\n" for name, entry in value.items() if entry is not None)
        return f"{comment}{key}:\n{inside}"
    return f"{comment}{key}: {flow_text(value)}\n"
