"""The recipe `cooperation` (vine): its policy starts at an action of -0.9 by itself, and it simulates branches.

python train/benchmark/run.py --tasks benchmark-pair --methods cooperation --output runs/benchmark
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import ethbrake_marl as eb


def cooperation(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    learning_rate: float = 1.89e-3, n_epochs: int = 4, offset: float = 0.6,
) -> dict[str, Any]:  # fmt: skip
    recipe = eb.load_recipe("cooperation").replace(
        learning_rate={"start": learning_rate, "end": 1e-5, "schedule": "cosine"},
        n_epochs=n_epochs, offset={"smallest": 0.01, "largest": offset},
    )  # fmt: skip
    result = eb.train(recipe, task, folder / "run", steps=decisions, seed=seed, measure=None)
    rows = csv.DictReader((folder / "run" / "progress.csv").read_text().splitlines())
    branches = sum(float(row["train/simulated"] or 0) for row in rows)
    return {"start": "its own", "decisions": result.steps, "simulated": result.steps + int(branches)}


def make_agent(folder: str, settings: eb.AgentSettings) -> eb.Agent | eb.Team:
    return eb.make_agent(f"policy@{Path(folder) / 'run'}", scenario=settings.needed_scenario())
