"""The kinds of hostile cases, the cases of each, and what must have happened once before one of them is judged."""

from __future__ import annotations

import functools
import gc
import io
import itertools
import random
import shutil
from collections import defaultdict
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import torch
import typer.main

from ethbrake_marl.cli.app import run_command
from tests.hostile.archives import good_bytes
from tests.hostile.bundle_cases import bundles
from tests.hostile.case import Case, Generator, write
from tests.hostile.command_cases import commands
from tests.hostile.csv_cases import HEADER, ROW, tables_of_states
from tests.hostile.place_cases import places
from tests.hostile.plan_cases import SWEEP, named_worlds, sweeps, worlds_text
from tests.hostile.run_cases import checkpoints, runs
from tests.hostile.stopped_runs import stopped
from tests.hostile.table_cases import COMMAND, best_harm_tables
from tests.hostile.tuning_cases import TUNING, tunings
from tests.hostile.yaml_cases import recipes, scenarios
from tests.hostile.yaml_parts import RECIPE, SCENARIO

KINDS: dict[str, Generator] = {
    "scenario": scenarios,
    "recipe": recipes,
    "sweep": sweeps,
    "worlds": named_worlds,
    "tuning": tunings,
    "CSV": tables_of_states,
    "table": best_harm_tables,
    "place": places,
    "bundle": bundles,
    "run": runs,
    "checkpoint": checkpoints,
    "command": commands,
}


def cases_of(kind: str, generator: Generator, seed: int, sample: int | None) -> list[Case]:
    """The cases of a kind, or ``sample`` of them: as many categories as there are, in turn."""
    every = list(generator(random.Random(f"{seed} {kind}")))
    if sample is None or sample >= len(every):
        return every
    grouped: dict[str, list[Case]] = defaultdict(list)
    for case in every:
        grouped[case.category].append(case)
    for group in grouped.values():
        random.Random(f"{seed} {kind} sample").shuffle(group)
    in_turn = (case for row in itertools.zip_longest(*grouped.values()) for case in row if case is not None)
    return list(itertools.islice(in_turn, sample))


def warm_up(folder: Path) -> None:
    """Import what commands import late and compile the kernels, so that only what a case does itself is seen."""
    torch.set_num_threads(1)
    typer.main.get_command = functools.cache(typer.main.get_command)  # built anew for every command line otherwise
    write(folder / "mine.yaml", SCENARIO)
    write(folder / "bad" / "mine.yaml", RECIPE)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        for name in ("mine.yaml", "bad/mine.yaml"):
            run_command(["scenario", "validate", str(folder / name)])
            run_command(["train", "--recipe", str(folder / name), "--output", str(folder / "mine.yaml")])
        run_command(["nonsense"])
        for algorithm in ("ppo", "sac"):
            shutil.copytree(stopped(algorithm), folder / algorithm)
            run_command(["train", "resume", str(folder / algorithm)])
        for late in (
            ["study", "generalise", "--runs", "x", "--vehicles", "3"],
            ["study", "ablate", "--levels", "x", "--output", "x"],
        ):
            run_command(late)
        run_command(["train", "curves", "--scenario", "x", "--output", "x"])
        run_command(["agent", "export", "x", "--onnx", "x"])
        run_command(["watch", "picture", "criticality", "--output", str(folder / "mine.yaml")])
        run_command(["shield", "--agents", "x"])
        few = ["evaluate", "--agents", "coast,full_brake", "--episodes", "3"]
        run_command([*few, "--per-world", str(folder / "worlds-out.csv")])
        write(folder / "sweep.yaml", SWEEP)
        run_command(["study", "sweep", str(folder / "sweep.yaml"), "--output", str(folder / "mine.yaml")])
        write(folder / "tuning.yaml", TUNING)
        run_command(["study", "tune", str(folder / "tuning.yaml"), "--output", str(folder / "mine.yaml")])
        write(folder / "worlds.yaml", worlds_text())
        run_command(["search", "falsify", "--again", str(folder / "worlds.yaml")])
        write(folder / "t.npz", good_bytes())
        write(folder / "bad" / "t.npz", b"")
        write(folder / "worlds.csv", f"{HEADER}\n{ROW}\n")
        for place in (".", "bad"):
            run_command([*COMMAND[:-2], str(folder / place / "t.npz"), "--json"])
            run_command(["evaluate", "--agents", "ppo@shipped", "--initial-states", str(folder / place / "worlds.csv")])
    gc.collect()
    gc.freeze()  # so that children share these pages
