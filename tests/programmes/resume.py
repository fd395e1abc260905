"""Resuming: training processes are killed (-9) at random moments, and must lose nothing."""

import hashlib
import multiprocessing
import random
import tempfile
import time
from functools import partial
from multiprocessing.context import ForkProcess
from pathlib import Path

import ethbrake_marl as eb
from ethbrake_marl.training.checkpoint import newest as newest_checkpoint
from ethbrake_marl.training.train import resume, train
from tests.programmes import Cases, Given, Told

SOON_S = 300.0

PPO = eb.load_recipe("ppo").replace(
    total_steps=60 * 512,
    n_envs=32,
    n_steps=16,
    batch_size=128,
    network={"policy": [64, 64], "value": [64, 64]},
    evaluation={"every_updates": 10, "worlds": 50, "seed": 1007},
    checkpoint_every_updates=4,
)
SAC = eb.load_recipe("sac").replace(
    total_steps=500 * 16,
    n_envs=16,
    batch_size=64,
    buffer_size=5000,
    learning_starts=500,
    network={"policy": [64, 64], "value": [64, 64]},
    evaluation={"every_updates": 100, "worlds": 50, "seed": 1007},
    checkpoint_every_updates=25,
    log_every_updates=20,
)
RECIPES: dict[str, eb.TrainingRecipe] = {
    "ppo": PPO,
    "sac": SAC,
    "independent": PPO.replace(scheme="independent", n_envs=16),
    "writing": SAC.replace(checkpoint_every_updates=5, total_steps=4000 * 16, evaluation=PPO.evaluation.model_dump()),
}

FORK = multiprocessing.get_context("fork")  # a new Python process needs seconds; tests/learning kills some of these


def work(what: str, run: Path) -> None:
    """Train from the beginning with the recipe ``what``, or resume the run if it exists."""
    if run.exists():
        resume(run)
    else:
        level = "cooperation-3-pair" if what == "independent" else "paper-random"
        train(RECIPES[what], eb.load_scenario(level), run)


def start(what: str, run: Path) -> ForkProcess:
    """Start a process that runs ``work``."""
    process = FORK.Process(target=work, args=(what, run))
    process.start()
    return process


def digest(run: Path) -> str:
    """Return a hash of the weights of a finished run: its best and its last policies."""
    weights = [file.read_bytes() for file in sorted(run.glob("policy*/**/weights.safetensors"))]
    return hashlib.sha256(b"".join(weights)).hexdigest()


def finish(what: str, run: Path) -> str:
    """Train or resume to the end without kills, and return the hash of the weights."""
    process = start(what, run)
    process.join()
    assert process.exitcode == 0, f"{run}: the process failed"
    return digest(run)


def random_kills(what: str, kills: int, folder: Path, rng: random.Random) -> Told:
    """Kill ``kills`` trainings at random moments, resume them, and count those that end with the same weights.

    The moments are uniform in the progress of the training, plus a random fraction of a second. Every fourth training
    is killed twice.
    """
    expected = finish(what, folder / "whole")
    rows = table_rows(folder / "whole")
    same = 0
    for k in range(kills):
        run, at = folder / f"{what}-{k}", []
        for row in sorted(rng.randrange(rows) for _ in range(2 if k % 4 == 3 else 1)):
            process = start(what, run)
            while process.is_alive() and table_rows(run) < row:
                time.sleep(0.005)
            time.sleep(rng.uniform(0.0, 0.3))
            process.kill()
            process.join()
            at.append(f"row {table_rows(run)} ({newest(run)})")
            if not run.exists() or '"finished"' in (run / "run.json").read_text():
                break
        finished = run.exists() and '"finished"' in (run / "run.json").read_text()
        good = (digest(run) if finished else finish(what, run)) == expected
        same += good
        print(f"  {what} {k}: killed at {', '.join(at)}: {'same' if good else 'OTHER WEIGHTS'}", flush=True)
    return Told(same == kills, f"{same} of {kills} killed trainings end with the same weights")


def table_rows(run: Path) -> int:
    """Return the number of rows in the progress table."""
    table = run / "progress.csv"
    return table.read_text().count("\n") - 1 if table.is_file() else 0


def newest(run: Path) -> str:
    """Return the name of the newest checkpoint of a run."""
    return max((path.name for path in run.glob("checkpoints/step_*")), default="the beginning")


def torn_writes(kills: int, folder: Path, rng: random.Random) -> Told:
    """Kill ``kills`` trainings while they write a checkpoint, and count those that leave a usable checkpoint."""
    run, usable, hit = folder / "torn", 0, 0
    while hit < kills:
        process = start("writing", run)
        first, deadline = newest(run), time.monotonic() + SOON_S
        while newest(run) == first or not list(run.glob("checkpoints/.ethbrake-*.partial")):
            soon = process.is_alive() and time.monotonic() <= deadline
            assert soon, f"{run}: the training ended before it was killed {kills} times"
            time.sleep(rng.uniform(0.0, 0.002))
        time.sleep(rng.uniform(0.0, 0.02))
        process.kill()
        process.join()
        if not list(run.glob("checkpoints/.ethbrake-*.partial")):
            continue  # the write was finished
        hit += 1
        state, damaged = newest_checkpoint(run / "checkpoints")
        usable += state is not None
        where = "none" if state is None else state["steps"]
        print(f"  kill {hit} while writing: usable checkpoint at step {where}, {len(damaged)} damaged", flush=True)
    return Told(usable == kills, f"{usable} of {kills} kills while writing leave a usable checkpoint")


OPTIONS = {
    "--kills": {"type": int, "default": 20},
    "--torn": {"type": int, "default": 40},
    "--seed": {"type": int, "default": 0},
}


def cases(given: Given) -> Cases:
    with tempfile.TemporaryDirectory() as scratch:
        for what in ("ppo", "sac", "independent"):
            (Path(scratch) / what).mkdir()
            rng = random.Random(f"{given.seed} {what}")
            yield f"resume, {what}", partial(random_kills, what, given.kills, Path(scratch) / what, rng)
        rng = random.Random(f"{given.seed} torn")
        yield "checkpoints", partial(torn_writes, given.torn, Path(scratch), rng)
