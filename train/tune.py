"""Search for settings of a recipe or method that lead to little harm, with Optuna. Read it from top to bottom.

    python train/tune.py --scenario paper-random --recipe ppo --search n_epochs=1..4 gamma=0.99/1.0 --output runs/tuning
    python train/tune.py --scenario benchmark-pair --recipe train/benchmark/sb3.py:ppo --search n_epochs=5/10 --output t

A trial is one training run, and its harm is the harm of its saved policy in the worlds of the recipe's evaluation, as
the reward counts it: the honest cost, or first-impact harm with ``--set harm_count=first``. A method of the benchmark,
``FILE.py:FUNCTION``, gets the settings as keywords and 200,000 decisions; its harm is the honest cost in list 8.
``--jobs`` trials are proposed together, then trained at the same time. After an interruption, start the same command
again: it keeps the trials in ``optuna.log``, and has the same result. A larger number of ``--trials`` adds trials.
"""

import argparse
import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import optuna
import yaml
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from ethbrake_marl.cli.settings import read_settings
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.evaluation.benchmark import evaluate_task
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.parallel import run_each
from ethbrake_marl.training.job import Job, folder_of_many
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.scenario import Scenario

HARM = "harm.json"  # file of a method's trial
DECISIONS, TRIAL_SEED, LIST_SEED = 200_000, 1000, 8


def read_search(text: str) -> tuple[str, BaseDistribution]:
    """Read choices ``KEY=A/B/C``, or a range ``KEY=LOW..HIGH`` (with ``:log`` at its end, a logarithmic one)."""
    key, _, values = text.partition("=")
    if "/" in values:
        return key, CategoricalDistribution(values.split("/"))
    try:
        low, high = values.removesuffix(":log").split("..")
        if low.isdigit() and high.isdigit():
            return key, IntDistribution(int(low), int(high), log=values.endswith(":log"))
        return key, FloatDistribution(float(low), float(high), log=values.endswith(":log"))
    except ValueError as error:
        raise InvalidInput(f"--search {text}: must be KEY=A/B, KEY=LOW..HIGH or KEY=LOW..HIGH:log ({error})") from None


class MethodJob(NamedTuple):
    """Trial of a method of the benchmark, with the functions of ``Job``."""

    task: Scenario
    method: str
    values: dict[str, Any]
    folder: Path

    @property
    def identity(self) -> Any:
        return [self.task.content(), self.method]

    def attempt(self) -> str:
        path, function = self.method.rsplit(":", 1)
        file = self.folder / HARM
        try:
            if not self.folder.exists():
                with new_folder(self.folder) as partial:
                    load_from_file(path, function)(self.task, TRIAL_SEED, DECISIONS, partial, **self.values)
            if not file.exists():
                result = evaluate_task(self.task, {"trial": f"{path}:make_agent:{self.folder}"}, seed=LIST_SEED)
                write_file(file, json.dumps({"harm": result["trial"]["honest_cost"].mean()}).encode())
        except (EthBrakeError, ArithmeticError, ValueError) as error:
            return str(error)
        return ""

    def result(self) -> dict[str, Any]:
        return read_object(self.folder / HARM)


def identity_of(job: Job | MethodJob) -> Any:
    return job.identity if isinstance(job, MethodJob) else job.training.identity


def jobs_of_method(args: argparse.Namespace) -> Callable[..., MethodJob]:
    scenario, (path, function) = read_settings(args.set).change_scenario(args.scenario), args.recipe.rsplit(":", 1)
    known = inspect.signature(load_from_file(path, function)).parameters

    def job(values: dict[str, object], folder: str = "") -> MethodJob:
        if unknown := values.keys() - known:
            raise InvalidInput(f"{args.recipe}: has no setting {min(unknown)!r}; has {', '.join(known)}")
        plain = {key: yaml.safe_load(value) if isinstance(value, str) else value for key, value in values.items()}
        return MethodJob(scenario, args.recipe, plain, args.output.absolute() / folder)

    return job


def jobs_of_recipe(args: argparse.Namespace) -> Callable[..., Job]:
    loaded = load_recipe(args.recipe)
    keys = [*type(loaded).model_fields]
    settings = read_settings(args.set, keys)
    scenario, recipe = settings.change_scenario(args.scenario), settings.change_recipe(loaded)

    def job(values: dict[str, object], folder: str = "") -> Job:
        own = read_settings([f"recipe.{key}={value}" for key, value in values.items()], keys)
        training, path = Training.of(own.change_recipe(recipe), scenario), args.output.absolute() / folder
        return Job(training, path, (*args.set, *own.texts))

    return job


def tune(args: argparse.Namespace) -> None:
    """Train until ``--trials`` trials have ended, and write ``trials.csv``."""
    space = dict(map(read_search, args.search))
    if min(args.jobs, args.trials) < 1 or len(space) < len(args.search):
        raise InvalidInput("--jobs and --trials must be 1 or more, and --search must name each key only once")
    job: Callable[..., Job | MethodJob] = (jobs_of_method if ".py:" in args.recipe else jobs_of_recipe)(args)

    for key, each in space.items():  # raises now what a trial would raise
        for value in each.choices if isinstance(each, CategoricalDistribution) else (each.low, each.high):
            job({key: value})
    question = {"training": identity_of(job({})), "search": args.search, "jobs": args.jobs}
    with folder_of_many(args.output, "trials.csv"):
        log = args.output / "optuna.log"
        try:
            storage = JournalStorage(JournalFileBackend(str(log)))
            study = optuna.create_study(storage=storage, study_name="tuning", load_if_exists=True)
        except (ValueError, KeyError) as error:
            raise InvalidInput(f"{log}: is damaged ({error}); delete it, and finished trials are kept") from None
        if study.user_attrs.get("question", question) != question:
            raise InvalidInput(f"{log}: is of a tuning with other settings; give another folder (--output)")
        study.set_user_attr("question", question)
        while (ended := sum(each.state.is_finished() for each in study.trials)) < args.trials:
            while (number := len(study.trials)) < min(args.trials, (ended // args.jobs + 1) * args.jobs):
                study.sampler = optuna.samplers.TPESampler(seed=number, constant_liar=True)
                study.ask(space)
            asked = [each for each in study.trials if not each.state.is_finished()]
            jobs = [job(each.params, f"trial-{each.number}") for each in asked]
            reasons = run_each(((each.attempt,) for each in jobs), args.jobs)
            for trial, each, reason in zip(asked, jobs, reasons, strict=True):
                harm = None if reason else each.result()["harm"]
                study.tell(trial.number, harm, optuna.trial.TrialState.FAIL if reason else None)
                print(f"trial {trial.number}: {reason or harm}: {trial.params}", flush=True)
        rows = [{"trial": each.number, "harm": each.value, **each.params} for each in study.trials]
        write_file(args.output / "trials.csv", csv_text(rows).encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", required=True, help="name or path of a scenario")
    parser.add_argument("--recipe", required=True, help="name or path of a recipe, or FILE.py:FUNCTION")
    parser.add_argument("--search", nargs="+", required=True, metavar="KEY=VALUES", help="choices and ranges to search")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of every trial")
    parser.add_argument("--trials", type=int, default=30, help="number of trials in all (default: 30)")
    parser.add_argument("--jobs", type=int, default=1, help="number of trials at the same time (default: 1)")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="folder of all results")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        tune(parser.parse_args())
    except KeyboardInterrupt:
        parser.exit(130, "interrupted; the same command goes on\n")
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
