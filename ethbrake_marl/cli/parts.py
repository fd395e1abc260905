"""The registered parts in a command's ``--help``: the names there are when it is asked."""

from __future__ import annotations

import sys
from typing import Any

from typer.core import TyperCommand

OF_THE_PACKAGE = [  # as ``part_names`` tells them: to ask for them takes the engine, and this a hundredth of that
    ("Reward terms", "harm, collision, risk, jerk, terminal, shaping"),
    ("Observation", "own, front_K, rear_K, role, obstacle, front_K.age, rear_K.age"),
    ("V2X presets", "paper, clear, nominal, congested, blocked, sensors-only"),
    ("Objectives", "total, own, social:ANGLE, maximin, mass-weighted, weighted:W1,W2,..."),
    ("Algorithms", "ppo, sac, counterfactual"),
]


def shown_parts() -> list[tuple[str, str]]:
    """``part_names``; nothing can have been registered where the physics is not even imported."""
    return part_names() if "ethbrake_marl.physics" in sys.modules else OF_THE_PACKAGE


def part_names() -> list[tuple[str, str]]:
    """Kinds of parts, each with its names; what is registered is among them."""
    from ethbrake_marl.evaluation.measures import REGISTERED
    from ethbrake_marl.harm import KINDS
    from ethbrake_marl.learning.recipe import algorithm_names
    from ethbrake_marl.rewards import TERMS
    from ethbrake_marl.scenario.features import FEATURES
    from ethbrake_marl.scenario.v2x import CHANNELS

    own = [name if entry.of == "own" else f"front_K.{name}, rear_K.{name}" for name, entry in FEATURES.items()]
    return [
        ("Reward terms", ", ".join(TERMS)),
        ("Observation", ", ".join(["own", "front_K", "rear_K", "role", "obstacle", *own])),
        ("V2X presets", ", ".join(CHANNELS)),
        ("Objectives", ", ".join(kind.form for kind in KINDS.values())),
        ("Algorithms", ", ".join(algorithm_names())),
        *([("Measures", ", ".join(REGISTERED))] if REGISTERED else []),
    ]


class CommandWithParts(TyperCommand):
    """A command whose help ends with these names."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """The epilog, and the names behind it."""
        super().format_epilog(ctx, formatter)
        with formatter.section("What recipes and scenarios may name"):
            formatter.write_dl(shown_parts())
