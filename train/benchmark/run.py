"""Train methods on tasks with several seeds, and evaluate them: a row for each. Read it from top to bottom.

    python train/benchmark/run.py --tasks benchmark-pair --methods sb3-ppo cem=mine.py:train --output runs/benchmark
    python train/benchmark/run.py --tasks paper-random --methods ppo sac --list-seed 8 --output runs/sweep

A method is a name of `METHODS`, a recipe (its name or file), or `NAME=FILE.py:FUNCTION`. Such a function
`train(task, seed, decisions, folder)` trains with that many decisions of all learners together, and saves what it has
learned in `folder`; `make_agent(folder, settings)` of the same file makes the agent or team of it. `train` may return a
mapping: `simulated`, all decisions that it has simulated, those of branches and searches included, and `start`, `the
task's` for a method that takes `START` of the tasks. Before its first training in a task every method trains once with
one decision, in another folder, so that compiling is no part of the measured processor time `cpu_s`.

`--held-out FOLDER` evaluates on a second list, too, whose seed follows from the method's committed trials and rows, the
files `trials/METHOD.csv` and `METHOD.csv` of the folder; so it exists only when both have ended.

Each training has a folder in `OUTPUT/runs`, and each evaluated one a file in `OUTPUT/rows`. After an interruption,
start the same command again: finished trainings are skipped, and an unfinished one of a recipe goes on from its last
checkpoint. `OUTPUT/rows.csv` has all rows, and for each task a row of full braking.

On a Ray cluster, every computer needs the same packages, and must see `--output` under the same path. Everybody who
can reach the ports of the cluster can run code on it with your rights, so open them to nobody else.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from hashlib import sha256
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import ethbrake_marl as eb
from ethbrake_marl.cli.settings import read_settings
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.evaluation.benchmark import BENCHMARK, EPISODES, benchmark_rows, evaluate_task
from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.parallel import run_each
from ethbrake_marl.training.job import Job as RecipeJob, folder_of_many
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.catalogue import group_of_scenarios

HERE = Path(__file__).resolve().parent
DECISIONS = 200_000  # of all learners together
METHODS = {
    "sb3-ppo": f"{HERE}/sb3.py:ppo",
    "sb3-sac": f"{HERE}/sb3.py:sac",
    "ippo": f"{HERE}/marl.py:ippo",
    "mappo": f"{HERE}/marl.py:mappo",
    "iql": f"{HERE}/marl.py:iql",
    "clone": f"{HERE}/clone.py:clone",
    "cooperation": f"{HERE}/vine.py:cooperation",
    "recurrent-ppo": f"{HERE.parent}/recurrent.py:train",
}
WARM: set[tuple[str, str]] = set()  # tasks and methods for which this process has compiled everything
OF_A_TRAINING = ("decisions", "simulated", "start", "cpu_s")  # columns that rules leave empty
ABOUT = "training.json"  # file in the folder of a training by a Python file: decisions, scenario, processor time


# 1. A training and its evaluation.


class Job(NamedTuple):
    task: eb.Scenario
    label: str  # name of the method in tables
    method: str  # recipe, or FILE.py:FUNCTION
    seed: int
    decisions: int
    output: Path
    episodes: int = EPISODES
    list_seed: int = SEED
    recipe: Training | None = None  # for a method that is a recipe
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        method = re.sub("[^a-z0-9_]+", "-", self.label.lower().removesuffix(".yaml"))
        return f"{self.task.name}-{method}-seed{self.seed}"

    @property
    def folder(self) -> Path:
        return self.output / "runs" / self.name

    @property
    def agent(self) -> str:
        """Name of the trained agent, for `--agents`."""
        if self.recipe is not None:
            return f"team@{self.folder}"
        return f"{self.method.rpartition(':')[0]}:make_agent:{self.folder}"

    def finish(self) -> dict[str, Any]:
        """Train and evaluate, unless that is done; return the row, or one with the `reason` of a failure."""
        file = self.output / "rows" / f"{self.name}.csv"
        try:
            if not self.folder.exists():
                self.warm_up()
            about = self.train()
            if not file.exists():
                braking, own = self.evaluate(about)
                write_file(braking_file(self.output, self.task.name), csv_text([braking]).encode())
                write_file(file, csv_text([own]).encode())
            (row,) = csv.DictReader(file.read_text().splitlines())
            for name, value in {
                "episodes": self.episodes,
                "list_seed": self.list_seed,
                "version": eb.__version__,
            }.items():
                if row.get(name) != f"{value}":
                    raise InvalidInput(f"{file}: {name} = {row.get(name)}, not {value}; delete it to evaluate again")
        except Exception as error:  # the other trainings go on
            reason = str(error) if isinstance(error, EthBrakeError) else f"{type(error).__name__}: {error}"
            return {"task": self.task.name, "method": self.label, "seed": self.seed, "reason": reason}
        return row

    def warm_up(self) -> None:
        """Train once as briefly as possible, so that compiling is no part of the training's processor time."""
        if (self.task.name, self.method) not in WARM:
            WARM.add((self.task.name, self.method))
            recipe = self.recipe and Training.of(self.recipe.recipe.replace(total_steps=1), self.task)
            with TemporaryDirectory() as scratch:
                self._replace(decisions=1, recipe=recipe, output=Path(scratch)).train()

    def train(self) -> dict[str, Any]:
        """Train unless that is done; return the number of decisions and the processor time, in s."""
        if self.recipe is not None:
            training = RecipeJob(self.recipe, self.folder, self.settings)
            if not training.finish():
                raise KeyboardInterrupt
            last = read_object(RunFolder(self.folder).status)["evaluations"][-1]
            return {"decisions": last["steps"], "cpu_s": round(last["cpu_s"], 1)}
        path, function = self.method.rsplit(":", 1)
        code = sha256(Path(path).read_bytes()).hexdigest()
        about = {"decisions": self.decisions, "scenario": self.task.content(), "method": function, "sha256": code}
        if not self.folder.exists():
            train = load_from_file(path, function)
            with new_folder(self.folder) as partial:
                start = time.process_time()
                told = train(self.task, self.seed, self.decisions, partial) or {}
                spent = {"cpu_s": round(time.process_time() - start, 1)}
                (partial / ABOUT).write_text(json.dumps({**about, **spent, "told": told}))
        done = read_object(self.folder / ABOUT)
        if {key: done.get(key) for key in about} != json.loads(json.dumps(about)):
            right = "delete it, or use another folder"
            raise InvalidInput(f"{self.folder}: has a training with other settings or another file; {right}")
        row = {"decisions": self.decisions, "cpu_s": done["cpu_s"], "start": "none", **done["told"]}
        return {"simulated": row["decisions"], **row}

    def evaluate(self, about: dict[str, Any]) -> list[dict[str, Any]]:
        """Rows of full braking and of the method."""
        agents = {"full_brake": "full_brake", self.label: self.agent}
        result = evaluate_task(self.task, agents, episodes=self.episodes, seed=self.list_seed)
        about = {"method": self.label, "seed": self.seed, **about, "list_seed": self.list_seed}
        braking, own = benchmark_rows({self.task.name: eb.summarise(result)}, **about)
        return [braking | {"method": "full_brake"} | dict.fromkeys(("seed", *OF_A_TRAINING), ""), own]

    def hold_out(self, folder: Path) -> None:
        """Evaluate on the method's held-out list, unless that is done."""
        file = self.output / "held-out" / f"{self.name}.csv"
        if not file.exists():
            file.parent.mkdir(exist_ok=True)
            held_out = self._replace(list_seed=held_out_seed(folder, self.label))
            write_file(file, csv_text(held_out.evaluate(dict.fromkeys(OF_A_TRAINING, ""))).encode())


def held_out_seed(folder: Path, method: str) -> int:
    """Seed of a method's held-out list: from the SHA-256 of its trials and of its costs on the first list."""
    trials, rows = folder / "trials" / f"{method}.csv", folder / f"{method}.csv"
    digest = sha256(trials.read_text().encode() if trials.exists() else b"")
    for row in csv.DictReader(rows.read_text().splitlines()):
        digest.update("".join(row.get(key) or "" for key in ("task", "agent", "seed", "honest_cost")).encode())
    return int.from_bytes(digest.digest()[:4])


def braking_file(output: Path, task: str) -> Path:
    return output / "rows" / f"{task}-full_brake.csv"


# 2. What to train. All names and settings are checked before the first training begins.


def read_jobs(args: argparse.Namespace) -> list[Job]:
    """All jobs, in the order seed, task, method."""
    if args.jobs is not None and args.jobs < 1:
        raise InvalidInput(f"--jobs {args.jobs}: must be 1 or more")
    if args.decisions is not None and args.decisions < 1:
        raise InvalidInput(f"--decisions {args.decisions}: must be 1 or more")
    methods = {}
    for text in args.methods:
        name, _, file = text.rpartition("=")
        methods[name or Path(file).name] = METHODS.get(file, file)
    recipes = {name: eb.load_recipe(method) for name, method in methods.items() if ".py:" not in method}
    for path, function in (method.rsplit(":", 1) for name, method in methods.items() if name not in recipes):
        load_from_file(path, function)
        load_from_file(path, "make_agent")
    settings = read_settings(args.set, [key for recipe in recipes.values() for key in type(recipe).model_fields])
    tasks = [settings.change_scenario(name) for name in args.tasks or group_of_scenarios(BENCHMARK)]
    for name, recipe in recipes.items():
        recipes[name] = settings.change_recipe(recipe.replace(total_steps=args.decisions or recipe.total_steps))
    jobs = []
    for seed, task, name in product(range(args.first_seed, args.first_seed + args.seeds), tasks, methods):
        recipe = Training.of(recipes[name], task, seed=seed) if name in recipes else None
        options = args.output.absolute(), args.episodes, args.list_seed, recipe, settings.texts
        jobs.append(Job(task, name, methods[name], seed, args.decisions or DECISIONS, *options))
    if not jobs or len({job.folder for job in jobs}) < args.seeds * len(tasks) * len(args.methods):
        raise InvalidInput("a run needs at least one seed, and each task and each name of a method's file only once")
    return jobs


# 3. Train, each job in a process of its own, and write the table.


def run(args: argparse.Namespace) -> int:
    """Do all jobs, write `rows.csv`, and return how many failed."""
    jobs, rows = read_jobs(args), []
    with folder_of_many(args.output, "rows.csv"):
        (args.output / "rows").mkdir(exist_ok=True)
        with on_ray(args.ray) if args.ray else nullcontext():
            for job, row in zip(jobs, run_each(((job.finish,) for job in jobs), args.jobs), strict=True):
                rows.append(row)
                result = row.get("reason") or f"honest cost {float(row['honest_cost']):.2f}"
                print(f"{len(rows)} of {len(jobs)}: {job.name}: {result}", flush=True)
        for job in jobs if args.held_out else ():
            job.hold_out(args.held_out)
        for task in dict.fromkeys(job.task.name for job in jobs):
            file = braking_file(args.output, task)
            rows += csv.DictReader(file.read_text().splitlines()) if file.exists() else []
        write_file(args.output / "rows.csv", csv_text(rows).encode())
    return sum("reason" in row for row in rows)


@contextmanager
def on_ray(address: str) -> Iterator[None]:
    """Context manager in which joblib sends its work to a Ray cluster, or to Ray on this machine (`local`)."""
    import ray
    from joblib import parallel_config
    from ray.util.joblib import register_ray

    ray.init(address=address, runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}})
    register_ray()
    with parallel_config(backend="ray"):
        yield
    ray.shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", metavar="NAME", help="names or paths of scenarios (default: benchmark)")
    parser.add_argument("--methods", nargs="+", required=True, metavar="NAME", help=f"{', '.join(METHODS)}, ...")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="number of seeds (default: 5)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="N", help="the first of them (default: 0)")
    parser.add_argument("--decisions", type=int, help="of all learners together (default: 200,000, or as in a recipe)")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of all tasks and recipes")
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"evaluated worlds (default: {EPISODES})")
    parser.add_argument("--list-seed", type=int, default=SEED, help=f"seed of these worlds (default: {SEED})")
    parser.add_argument("--held-out", type=Path, metavar="FOLDER", help="committed rows; also use the second list")
    parser.add_argument("--jobs", type=int, metavar="N", help="trainings at the same time (default: 1)")
    parser.add_argument("--ray", metavar="ADDRESS", help="a running Ray cluster, or `local` for Ray on this machine")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="folder of all results")
    try:
        failed = run(parser.parse_args())
    except KeyboardInterrupt:
        parser.exit(130, "interrupted; the same command goes on\n")
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    parser.exit(1 if failed else 0)
