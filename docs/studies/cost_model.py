"""What a cluster is asked for: processor seconds per million decisions and worlds, and bytes per row.

    python docs/studies/cost_model.py [--worlds 400]

Processor time, not time by the clock: it is the same beside other programs. Compiling, loading and measuring on the way
are left out; the first update, which warms up, does not count.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import yaml

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.results import write_per_world
from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.scenario import load_scenario

SCENARIO = "paper-random"
UPDATES = {"ppo": 5, "counterfactual": 4, "quick": 4}  # of which the first does not count
AGENTS = {"full_brake": 200, "e_v2x_bm": 50, "ppo@shipped": 50, "universal@shipped": 10, "ppo@shipped+step": 1}
LARGER = 2  # a list of so many times the worlds is timed too: the difference is the cost of a world


def per_decision(recipe_name: str, updates: int, folder: Path) -> float:
    """Processor seconds of a decision, its share of the learning included."""
    recipe = load_recipe(recipe_name)
    once = recipe.n_envs * recipe.rounds
    told: dict[int, float] = {}

    def note(progress: object) -> None:
        told.setdefault(progress.done, time.process_time())  # type: ignore[attr-defined]

    steps = updates * once
    train(recipe, SCENARIO, folder / recipe_name, steps=steps, measure=None, on_progress=note)
    first = min(done for done in told if done > 0)
    return (told[steps] - told[first]) / (steps - first)


def per_world(name: str, worlds: int) -> float:
    """Processor seconds of a world that an agent drives."""
    scenario = load_scenario(SCENARIO)
    spent = []
    for n in (20, worlds, LARGER * worlds):
        sample = scenario.sample(n, 7)
        started = time.process_time()
        evaluate(sample, {name: make_agent(name, scenario=scenario)}, scenario=scenario, aftermath=False)
        spent.append(time.process_time() - started)
    return (spent[2] - spent[1]) / ((LARGER - 1) * worlds)


def sizes(folder: Path) -> dict[str, float]:
    """Bytes of a row, by what it stands in."""
    scenario = load_scenario(SCENARIO)
    found = {}
    driven = evaluate(scenario.sample(1000, 7), {"full_brake": make_agent("full_brake")}, scenario=scenario)
    write_per_world(folder / "worlds.csv", driven)
    found["world of evaluate --per-world csv"] = (folder / "worlds.csv").stat().st_size / 1000
    settings = {"total_steps": 1, "evaluation.worlds": 100}
    grid = {"scenario": SCENARIO, "recipe": "ppo", "seed": {"count": 2}}
    (folder / "sweep.yaml").write_text(yaml.safe_dump({"set": settings, "grid": grid}))
    out = folder / "sweep"
    assert run_command(["study", "sweep", str(folder / "sweep.yaml"), "--output", str(out), "--jobs", "1"]) == 0
    rows = (out / "results.csv").read_bytes().splitlines(keepends=True)
    found["job in a sweep's table (CSV)"] = len(rows[1])
    found["job in a sweep's journal"] = (out / "journal.jsonl").stat().st_size / 2
    run = next((out / "runs").iterdir())
    found["folder of a finished training of ppo"] = sum(f.stat().st_size for f in run.rglob("*") if f.is_file())
    found["files in it"] = sum(f.is_file() for f in run.rglob("*"))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=400)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as name:
        for recipe, updates in UPDATES.items():
            print(
                f"{recipe}: {1e6 * per_decision(recipe, updates, Path(name)):.1f} s per million decisions", flush=True
            )
        for agent, times in AGENTS.items():
            each = per_world(agent, times * options.worlds)
            print(f"{agent}: {1e6 * each:.0f} s per million worlds", flush=True)
        for what, size in sizes(Path(name)).items():
            print(f"{what}: {size:,.0f}{'' if 'files' in what else ' bytes'}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
