"""Learning curves of several learners at equal processor time: five algorithms, four levels, several seeds.

    python docs/studies/team_curves.py runs/teams --seconds 60 --jobs 16    # runs the missing trainings
    python docs/studies/team_curves.py runs/teams --draw                    # draws figure and table, writes numbers

Needs the extras `train` and `marl`. ``--seconds`` are the processor seconds of learning of each training, in one
thread. First a short training of each algorithm on each level measures how many decisions fit into this time. Imports,
compiling and evaluations do not count. All algorithms have the same observations and minimise first-impact harm. Every
job writes one file, and the same command runs the missing jobs.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.util
import json
import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from itertools import product
from os import devnull
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import ethbrake_marl as eb
from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.style import (
    GREY,
    TITLES,
    band,
    finish,
    in_our_style,
    new_panels,
    series_style,
    write_picture,
)
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.files.store import write_file
from ethbrake_marl.names import team_of

ALGORITHMS = {  # name -> label, and estimated decisions per processor second for the first short training
    "ippo": ("IPPO (`train/ippo.py`)", 16_000),
    "mappo": ("MAPPO (`train/mappo.py`)", 8_000),
    "benchmarl": ("BenchMARL's MAPPO", 13_000),
    "ppo": ("shared PPO (recipe `cooperation-ppo`)", 27_000),
    "cooperation": ("ours (recipe `cooperation`)", 33_000),
}
LEVELS = ("cooperation-3-pair", "cooperation-3-congested", "cooperation-4-all", "cooperation-4-congested")
SEEN = ["own", "front_1", "rear_1", "role", "obstacle"]
WORLDS, SEED, BUDGET = 2000, 2059, 5000  # number and seed of the evaluated worlds; candidates per world of the search
POINTS = 11  # evaluations of a training, in addition to one before the first update
SHORT = 8  # the first short training takes this fraction of the time: 1 / SHORT
DOCS = Path(__file__).resolve().parents[1]
NUMBERS = DOCS / "studies" / "team_curves.json"
PICTURE = DOCS / "figures" / "team-curves.png"
COUNTS = {"first": "first_impact_harm", "total": "total_harm"}
HEAD = ["scenario", "who drives the learners", "decisions", "processor time", "first-impact harm", "total harm"]
Results = dict[str, Any]  # content of a folder of results, from ``gather``


def level_of(name: str) -> eb.Scenario:
    """Scenario of a level, with the same observation for all algorithms."""
    return eb.load_scenario(name).replace(observation=SEEN)


def load_team(folder: Path | str, scenario: eb.Scenario) -> eb.Team:
    return team_of(eb.make_agent(f"team@{folder}", scenario=scenario), scenario)


def interquartile_mean(values: np.ndarray, resamples: int = 10_000) -> Estimate:
    """Mean without the lowest and the highest quarter, with a bootstrap interval over the seeds."""
    from scipy.stats import bootstrap, trim_mean

    def middle(*drawn: np.ndarray, axis: int) -> np.ndarray:
        return trim_mean(drawn[0], 0.25, axis=axis)

    again = bootstrap([values], middle, n_resamples=resamples, method="percentile", rng=0, vectorized=True)
    ends = again.confidence_interval
    return Estimate(float(middle(values, axis=0)), (float(ends.low), float(ends.high)))


# 1. A training with evaluations


class Clock:
    """Evaluates a team at about equal intervals of a training, and records the processor time of learning."""

    def __init__(self, scenario: eb.Scenario, steps: int, worlds: int) -> None:
        self.scenario, self.steps, self.worlds = scenario, steps, scenario.sample(worlds, SEED)
        self.points: list[list[float]] = []  # decisions, processor seconds, first-impact harm, total harm
        self.begun = 0.0

    def look(self, decisions: int, make_team: Callable[[], eb.Team]) -> None:
        """Evaluate the team if an evaluation is due. The first call comes before the first decision."""
        spent = time.process_time() - self.begun if self.points else 0.0
        if decisions >= len(self.points) * self.steps / POINTS:
            last = eb.play_to_end(eb.open_game(self.scenario)[1], self.worlds, make_team())
            harms = [last.harm(count).mean() for count in COUNTS]
            self.points.append([decisions, spent, *map(float, harms)])
        self.begun = time.process_time() - spent


@cache
def script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"train_{name}", DOCS.parent / "train" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its data classes look up annotations here
    spec.loader.exec_module(module)
    return module


def run_script(name: str, clock: Clock, seed: int, folder: Path) -> None:
    """Train with ``train/NAME.py``. A subclass of its ``Copies`` calls the clock before every rollout."""
    module, scenario = script(name), clock.scenario
    settings = module.Settings(scenario=scenario, steps=clock.steps, seed=seed, harm_count="first")
    decisions = settings.copies * settings.rollout * len(scenario.learners)

    class Watched(module.Copies):  # type: ignore[misc, name-defined]
        updates = 0

        def collect(self, actors: Mapping[str, Any], *more: Any) -> Any:
            clock.look(self.updates * decisions, lambda: self.team(actors))
            self.updates += 1
            return super().collect(actors, *more)

        def team(self, actors: Mapping[str, Any]) -> eb.Team:
            with TemporaryDirectory() as place:
                module.save_team(Path(place), actors, self.envs[0], seed=seed, steps=self.updates * decisions)
                return load_team(place, scenario)

    plain, module.Copies = module.Copies, Watched
    try:
        module.train(settings, folder)
    finally:
        module.Copies = plain
    clock.look(-(-clock.steps // decisions) * decisions, lambda: load_team(folder, scenario))


def recipe_of(name: str) -> eb.TrainingRecipe:
    """Recipe, which minimises first-impact harm here."""
    recipe = eb.load_recipe(name)
    return recipe.replace(reward={**recipe.reward.model_dump(mode="json"), "harm_count": "first"})


def run_benchmarl(clock: Clock, seed: int, folder: Path) -> None:
    """Train BenchMARL's MAPPO with the hyperparameters of the recipe `cooperation-ppo`.

    A callback applies the recipe's schedule of the learning rate, because BenchMARL has no schedule.
    """
    from benchmarl.experiment import Callback
    from torch.random import fork_rng

    module, scenario = script("benchmarl_mappo"), clock.scenario
    recipe = recipe_of("cooperation-ppo").replace(scheme="centralised", total_steps=clock.steps, seed=seed)
    decisions = recipe.n_envs * recipe.rounds * len(scenario.learners)

    def team() -> eb.Team:
        agent = eb.LearnedAgent(module.policy_of(experiment, recipe, scenario))
        return eb.Team("team", dict.fromkeys(scenario.learners, agent))

    class Watch(Callback):  # type: ignore[misc]
        def on_batch_collected(self, batch: Any) -> None:
            done = self.experiment.n_iters_performed * decisions
            clock.look(done, team)
            for optimisers in self.experiment.optimizers.values():
                for optimiser in optimisers.values():
                    optimiser.param_groups[0]["lr"] = recipe.learning_rate.at(1.0 - done / clock.steps)

    with fork_rng():
        experiment = module.make_experiment(recipe, scenario, str(folder), "mappo")
        watch = Watch()
        watch.experiment = experiment
        experiment.callbacks.append(watch)
        clock.look(0, team)
        experiment.run()
        clock.look(-(-clock.steps // decisions) * decisions, team)


def run_recipe(name: str, clock: Clock, seed: int, folder: Path) -> None:
    """Train with one of our recipes; all learners share one policy."""
    recipe = recipe_of(name)
    often = max(clock.steps // (recipe.n_envs * recipe.rounds) // 100, 1)
    measured = {**recipe.evaluation.model_dump(), "every_updates": often}
    recipe = recipe.replace(observation=SEEN, total_steps=clock.steps, seed=seed, scheme="shared", evaluation=measured)
    places = clock.scenario.vehicle_names

    def look(policies: Mapping[str, eb.Policy]) -> dict[str, float]:
        agents = {1 + places.index(each): eb.LearnedAgent(policy) for each, policy in policies.items()}
        steps = next(iter(policies.values())).manifest.steps
        clock.look(steps, lambda: eb.Team("team", agents))
        return dict(zip(("first_impact_harm", "total_harm"), clock.points[-1][2:], strict=True))

    eb.train(recipe, clock.scenario, folder, measure=lambda training: look, on_progress=None)


def learn(algorithm: str, level: str, steps: int, seed: int, worlds: int = WORLDS) -> list[list[float]]:
    """Train for ``steps`` decisions, and return the points of the learning curve.

    A point: decisions, processor seconds, first-impact harm, total harm.
    """
    clock = Clock(level_of(level), steps, worlds)
    with TemporaryDirectory() as scratch, open(devnull, "w") as nowhere:
        folder = Path(scratch) / "run"
        with redirect_stdout(nowhere), redirect_stderr(nowhere):
            if algorithm in ("ippo", "mappo"):
                run_script(algorithm, clock, seed, folder)
            elif algorithm == "benchmarl":
                folder.mkdir()
                run_benchmarl(clock, seed, folder)
            else:
                run_recipe({"ppo": "cooperation-ppo"}.get(algorithm, algorithm), clock, seed, folder)
    return clock.points


# 2. Jobs; each job writes one file


@cache
def warm(algorithm: str) -> None:
    """Import and compile everything that an algorithm needs, in this process."""
    learn(algorithm, LEVELS[-1], 1, 0, worlds=2)


def write(file: Path, content: Results) -> str:
    write_file(file, json.dumps(content).encode() + b"\n")
    return file.name


def measure_speed(file: Path, algorithm: str, level: str, seconds: float) -> str:
    warm(algorithm)
    steps = max(round(ALGORITHMS[algorithm][1] * seconds / SHORT), 1)
    done, spent, *_ = learn(algorithm, level, steps, 99, worlds=2)[-1]
    return write(file, {"algorithm": algorithm, "level": level, "decisions_per_s": done / spent, "measured_s": spent})


def train(file: Path, algorithm: str, level: str, steps: int, seed: int) -> str:
    warm(algorithm)
    points = learn(algorithm, level, steps, seed)
    return write(file, {"algorithm": algorithm, "level": level, "seed": seed, "points": points})


def refer(file: Path, level: str) -> str:
    """Write the harm of full braking, of E-V2X-BM and of the joint optimum of a search, on the list of a level."""
    scenario, game = eb.open_game(level_of(level))
    worlds = scenario.sample(WORLDS, SEED)
    table = search_list(game, worlds, budget=BUDGET, threads=1, chunks=file.with_suffix(".search"))
    harms = {"joint optimum": [float(table.harm[count].mean()) for count in COUNTS]}
    result = eb.evaluate(worlds, "full_brake,e_v2x_bm", scenario=scenario)
    for name in ("full_brake", "e_v2x_bm"):
        harms[name] = [float(result[name][column].mean()) for column in COUNTS.values()]
    return write(file, {"level": level, "harms": harms})


def finish_jobs(jobs: Mapping[Future[str], str]) -> int:
    """Wait for jobs, print their ends, and return the number of failed jobs."""
    failed, begun = 0, time.monotonic()
    for number, job in enumerate(as_completed(jobs), 1):
        error, spent = job.exception(), time.monotonic() - begun
        failed += error is not None
        print(f"{number} of {len(jobs)}, {spent:.0f} s: {jobs[job]}{' FAILED' * (error is not None)}", flush=True)
        if error is not None:
            print("".join(traceback.format_exception(error)), file=sys.stderr, flush=True)
    return failed


def work(folder: Path, given: argparse.Namespace) -> int:
    """Run the jobs whose files are missing in ``folder``, and return the number of failed jobs."""
    folder.mkdir(parents=True, exist_ok=True)
    check(folder, given)
    pairs = list(product(given.levels, given.algorithms))
    speeds = {pair: folder / f"speed.{pair[1]}.{pair[0]}.json" for pair in pairs}
    with ProcessPoolExecutor(given.jobs, multiprocessing.get_context("spawn")) as pool:
        first: dict[Future[str], str] = {}
        references = {level: folder / f"references.{level}.json" for level in given.levels}
        later = {pool.submit(refer, file, level): file.name for level, file in references.items() if not file.exists()}
        for (level, algorithm), file in speeds.items():
            if not file.exists():
                first[pool.submit(measure_speed, file, algorithm, level, given.seconds)] = file.name
        failed = finish_jobs(first)
        for seed, (level, algorithm) in product(given.seeds, pairs):
            file = folder / f"curve.{algorithm}.{level}.{seed}.json"
            if speeds[level, algorithm].exists() and not file.exists():
                rate = json.loads(speeds[level, algorithm].read_bytes())["decisions_per_s"]
                steps = max(round(rate * given.seconds), 1)
                later[pool.submit(train, file, algorithm, level, steps, seed)] = file.name
        return failed + finish_jobs(later)


def check(folder: Path, given: argparse.Namespace) -> None:
    """Exit with a message if an algorithm cannot run or ``folder`` has another study. Compiles the kernels."""
    study = {"seconds": given.seconds, "worlds": WORLDS, "seed": SEED, "budget": BUDGET, "seen": SEEN}
    file = folder / "study.json"
    if file.exists() and {name: json.loads(file.read_bytes()).get(name) for name in study} != study:
        raise SystemExit(f"{folder}: has a study with other settings ({file.name}); give another folder")
    for algorithm in given.algorithms:
        begun = time.monotonic()
        try:
            warm(algorithm)
        except Exception as error:
            raise SystemExit(f"{algorithm} does not run on this machine: {type(error).__name__}: {error}") from error
        print(f"{algorithm} runs; {time.monotonic() - begun:.0f} s to import and compile", flush=True)
    if not file.exists():
        today = datetime.datetime.now(datetime.UTC).date().isoformat()
        write(file, {**study, "machine": this_machine(), "date": today})


# 3. Figure, numbers and table


def gather(folder: Path) -> Results:
    """Read a folder of results: settings of the study, speeds, references by level, learning curves."""
    found: Results = json.loads((folder / "study.json").read_bytes())
    found["speeds"] = [json.loads(file.read_bytes()) for file in sorted(folder.glob("speed.*.json"))]
    every = [json.loads(file.read_bytes()) for file in sorted(folder.glob("references.*.json"))]
    found["references"] = {each["level"]: each["harms"] for each in every}
    found["curves"] = [json.loads(file.read_bytes()) for file in sorted(folder.glob("curve.*.json"))]
    return found


def text_of(found: Results) -> str:
    for curve in found["curves"]:
        curve["points"] = [[int(d), round(s, 2), *(round(h, 4) for h in harms)] for d, s, *harms in curve["points"]]
    whole = {key: json.dumps(value) for key, value in found.items() if key not in ("curves", "speeds")}
    for key in ("speeds", "curves"):
        whole[key] = "[\n  " + ",\n  ".join(json.dumps(each) for each in found[key]) + "\n ]"
    return "{\n " + ",\n ".join(f"{json.dumps(key)}: {value}" for key, value in whole.items()) + "\n}\n"


def curves_of(found: Results, level: str, algorithm: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Learning curves of all seeds, [seeds, points, 4].

    The last axis: decisions, processor seconds, first-impact harm, total harm.
    """
    own = [each["points"] for each in found["curves"] if (each["level"], each["algorithm"]) == (level, algorithm)]
    return np.array(own, np.float64)


def levels_of(found: Results) -> list[str]:
    return [level for level in LEVELS if any(curve["level"] == level for curve in found["curves"])]


def table(found: Results) -> list[list[str]]:
    """Rows of the table: each algorithm at the end of its time, and the references."""
    rows = []
    for level in levels_of(found):
        harms = found["references"].get(level, {})
        for name, label in (("full_brake", "full braking"), ("e_v2x_bm", "E-V2X-BM (coupled)")):
            if name in harms:
                rows.append([f"`{level}`", label, "–", "–", *(f"{harm:.2f}" for harm in harms[name])])
        for algorithm, (label, _) in ALGORITHMS.items():
            curves = curves_of(found, level, algorithm)
            if len(curves):
                decisions, spent = curves[:, -1, :2].mean(axis=0)
                reached = [interquartile_mean(last).in_words() for last in curves[:, -1, 2:].T]
                rows.append([f"`{level}`", label, f"{decisions:,.0f}", f"{spent:.0f} s", *reached])
        if harms:
            least = [f"{harm:.2f}" for harm in harms["joint optimum"]]
            rows.append([f"`{level}`", "joint optimum (search)", "–", "–", *least])
    return rows


@in_our_style
def draw(found: Results) -> Figure:
    """Draw first-impact harm over processor seconds, with a panel per level and bands of 95 % intervals."""
    levels = levels_of(found)
    figure, panels = new_panels((9.4, 3.3 * -(-len(levels) // 2) + 0.6), -(-len(levels) // 2), min(len(levels), 2))
    for axes, level in zip(panels, levels, strict=False):
        for number, (algorithm, (label, _)) in enumerate(ALGORITHMS.items()):
            curves = curves_of(found, level, algorithm)
            if len(curves):
                style, spent = series_style(number + 1), curves[:, :, 1].mean(axis=0)
                middles = [interquartile_mean(harm, resamples=2000) for harm in curves[:, :, 2].T]
                axes.plot(spent, [each.value for each in middles], label=label.replace("`", ""), **style)
                low, high = np.transpose([each.interval or (each.value, each.value) for each in middles])
                band(axes, spent, low, high, style)
        lines = {"e_v2x_bm": ("E-V2X-BM (coupled)", ":"), "joint optimum": ("joint optimum (search)", "--")}
        for name, (label, dashes) in lines.items():
            if level in found["references"]:
                harm = found["references"][level][name][0]
                axes.axhline(harm, label=label, color=GREY, linestyle=dashes, linewidth=1.1)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set(title=level, xlabel="Processor time of learning (s)", ylabel=TITLES["first"])
    seeds = len({curve["seed"] for curve in found["curves"]})
    caption = (
        f"Interquartile means over {count_of(seeds, 'seed')} with 95 % intervals; {found['worlds']:,} worlds of the"
        f" list of seed {found['seed']}, which no training uses; deterministic teams, trained for first-impact harm."
    )
    return finish(figure, caption, panels[0], columns=4)


def main() -> int:
    """1 if a job failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of results; with --draw also a file of numbers")
    parser.add_argument("--seconds", type=float, default=60.0, help="processor seconds of each training")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel processes, with one thread each")
    parser.add_argument("--algorithms", nargs="+", choices=[*ALGORITHMS], default=[*ALGORITHMS])
    parser.add_argument("--levels", nargs="+", choices=LEVELS, default=[*LEVELS])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--draw", action="store_true", help="draw figure and table of existing results; no training")
    parser.add_argument("--numbers", type=Path, default=NUMBERS, help="where --draw writes the numbers")
    parser.add_argument("--picture", type=Path, default=PICTURE, help="where --draw writes the figure")
    given = parser.parse_args()
    if not given.draw:
        return 1 if work(given.results, given) else 0
    found = json.loads(given.results.read_bytes()) if given.results.is_file() else gather(given.results)
    write_file(given.numbers, text_of(found).encode())
    write_picture(given.picture, draw(found), force=True)
    rows: Sequence[Sequence[str]] = [HEAD, ["---"] * len(HEAD), *table(found)]
    print("\n".join(f"| {' | '.join(row)} |" for row in rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
