"""A sweep: train every recipe in every scenario with every seed, and write one table. Read it from top to bottom.

    python train/sweep.py --scenarios paper-random --recipes ppo sac --jobs 4 --output runs/sweep
    python train/sweep.py --scenarios paper-random --recipes ppo --jobs 64 --ray 10.0.0.1:6379 --output /shared/sweep

Each training run has a folder of its own in ``--output``; ``results.csv`` has a row for each of them. After an
interruption, start the same command again: finished training runs are skipped, and unfinished ones go on from their
last checkpoint. The table does not depend on ``--jobs``, on ``--ray`` or on interruptions. Recipes such as `ppo`
minimise the honest cost, and first-impact harm with ``--set rules=paper``.

On a Ray cluster, every computer needs the same packages, and must see ``--output`` under the same path. Everybody who
can reach the ports of the cluster can run code on it with your rights, so open them to nobody else.
"""

import argparse
from contextlib import contextmanager, nullcontext
from itertools import product
from pathlib import Path

from ethbrake_marl.cli.settings import read_settings
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import write_file
from ethbrake_marl.parallel import run_each
from ethbrake_marl.training.job import Job, folder_of_many
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.training import Training

# 1. What to train. All names and settings are checked before the first training run begins.


def read_jobs(args: argparse.Namespace) -> list[Job]:
    """All training runs, ordered by seed. The name of a run's folder ends in a hash of all its settings."""
    recipes = [load_recipe(name) for name in args.recipes]
    settings = read_settings(args.set, [key for recipe in recipes for key in type(recipe).model_fields])
    scenarios = [settings.change_scenario(name) for name in args.scenarios]
    jobs = []
    for seed, scenario, recipe in product(range(args.seeds), scenarios, map(settings.change_recipe, recipes)):
        training = Training.of(recipe, scenario, seed=seed)
        name = f"{scenario.name}-{recipe.name}-seed{seed}-{training.identity[:12]}"
        jobs.append(Job(training, args.output.absolute() / name, settings.texts))
    if not jobs or len({job.folder for job in jobs}) < len(jobs):
        raise InvalidInput("a sweep needs at least one seed, and each scenario and each recipe only once")
    if args.jobs is not None and args.jobs < 1:
        raise InvalidInput(f"--jobs {args.jobs}: must be 1 or more")
    return jobs


# 2. Train, each run in a process of its own, and write the table.


def sweep(args: argparse.Namespace) -> int:
    """Do all training runs, write ``results.csv``, and return how many failed."""
    jobs = read_jobs(args)
    rows, failed = [], 0
    with folder_of_many(args.output, "results.csv"):
        with on_ray(args.ray) if args.ray else nullcontext():
            reasons = run_each(((job.attempt,) for job in jobs), args.jobs)
            for job, reason in zip(jobs, reasons, strict=True):
                failed += bool(reason)
                recipe, scenario = job.training.recipe, job.training.scenario
                about = {"run": job.folder.name, "scenario": scenario.name, "recipe": recipe.name, "seed": recipe.seed}
                rows.append({**about, "reason": reason, **({} if reason else job.result())})
                print(f"{len(rows)} of {len(jobs)}: {job.folder.name}: {reason or 'finished'}", flush=True)
        write_file(args.output / "results.csv", csv_text(rows).encode())
    return failed


@contextmanager
def on_ray(address):
    """Context manager in which joblib sends its work to a Ray cluster, or to Ray on this machine (``local``)."""
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
    parser.add_argument("--scenarios", nargs="+", required=True, metavar="NAME", help="names or paths of scenarios")
    parser.add_argument("--recipes", nargs="+", required=True, metavar="NAME", help="names or paths of recipes")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="seeds 0 to N - 1 (default: 5)")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of every run")
    parser.add_argument("--jobs", type=int, metavar="N", help="runs at the same time (default: 1)")
    parser.add_argument("--ray", metavar="ADDRESS", help="a running Ray cluster, or `local` for Ray on this machine")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="folder of all results")
    try:
        failed = sweep(parser.parse_args())
    except KeyboardInterrupt:
        parser.exit(130, "interrupted; the same command goes on\n")
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    parser.exit(1 if failed else 0)
