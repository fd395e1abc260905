"""The commands that train, and compare trainings: ``run``, ``train``, ``study`` and ``reproduce``."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.text import Text

from ethbrake_marl import evaluation, learning, scenario as scenarios
from ethbrake_marl.cli.command import Out, app, whole_number
from ethbrake_marl.defaults import DEFAULT
from ethbrake_marl.errors import InvalidInput, Progress, check_one_learner, need
from ethbrake_marl.files.sheet import Column, Sheet

KEPT = (
    "if the training had begun, the run's folder keeps the last good policy, and ethbrake train resume FOLDER goes on"
)
SeedOption = Annotated[int | None, typer.Option(help="Seed of the training alone.", show_default="the recipe's")]
NameOption = Annotated[
    str | None, typer.Option(help="Folder of the run inside runs/.", show_default="SCENARIO-RECIPE-seedSEED")
]
OutputOption = Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder of the run, instead of --name.")]


RUNS = Path("runs")


def run_folder(
    scenario: scenarios.Scenario,
    recipe: learning.TrainingRecipe,
    *,
    seed: int | None = None,
    name: str | None = None,
    output: Path | None = None,
) -> Path:
    """Folder of a run: ``output``, or ``runs/<name>``, by default ``runs/<scenario>-<recipe>-seed<seed>``.

    The default has the scheme behind the recipe where the recipe names one. Raises ``InvalidInput`` when both are
    given, or for a name that is not a plain folder name.
    """
    if output is not None:
        if name is not None:
            raise InvalidInput(f"name {name!r} and output {str(output)!r}: give one of the two")
        return output
    if name is not None and not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}", name):
        raise InvalidInput(
            f"run name {name!r:.60}: must be up to 128 letters, digits, . _ -, not beginning with . or -"
        )
    plan = recipe.name if recipe.scheme is None else f"{recipe.name}-{recipe.scheme}"
    return RUNS / (name or f"{scenario.name}-{plan}-seed{recipe.seed if seed is None else seed}")


@app.add("run", "run --steps 200000 --seed 1", kept=KEPT, json=True, force=True)
def run_command(
    out: Out,
    scenario: str = "paper-random",
    steps: int | None = None,
    seed: SeedOption = None,
    episodes: Annotated[int, typer.Option(help="Worlds of the evaluation list.")] = DEFAULT.EPISODES,
    list_seed: Annotated[int, typer.Option(help="Seed of the evaluation list.")] = DEFAULT.LIST_SEED,
    recipe: str = "quick",
    settings: list[str] | None = None,
    vehicle: str | None = None,
    name: NameOption = None,
    output: OutputOption = None,
) -> None:
    """Train a policy, shield it, compare with the baselines, report.

    Writes the run's folder: the policy, results as CSV and JSON, every world, three figures, and report.html. After
    one of the three tests (paper-random, -brake-only, -obstacle) the policy also drives the other two.
    Ctrl-C ends the training early, and what it has is evaluated; a second Ctrl-C stops at once.
    """
    # torch takes seconds to load, here and in the other commands that learn
    from ethbrake_marl.studies.experiment import run_experiment

    plan = learning.load_recipe(recipe)
    given = learning.read_settings(settings, [plan])
    chosen = evaluation.load_runnable(scenario, given.scenario, vehicle=vehicle, drives="one")
    plan = given.change(plan, out.note)
    folder = run_folder(chosen, plan, seed=seed, name=name, output=output)
    result = run_experiment(
        chosen,
        folder,
        recipe=plan,
        steps=steps,
        seed=seed,
        episodes=episodes,
        list_seed=list_seed,
        force=out.force,
        settings=given.texts,
        on_progress=out.show_progress,
    )
    trained = result.trained
    count = "total" if plan.reward.harm_count == "total" else "first-impact"
    told = (
        f"Trained by recipe {plan.name}, seed {plan.seed if seed is None else seed}: {trained.steps:,} decisions in"
        f" {trained.wall_s:.0f} s ({trained.status}). hybrid is the trained policy behind its shield. All minimise"
        f" {count} harm.\n"
    )
    out.result(result.results, Text(told), result.rows.brief(result.beside), *result.rows.tables()[1:])
    out.note(f"report, with every measure and the paper's rows: {result.report}")
    _end(out, result.trained)


train = app.group(
    "train",
    "Train a policy, go on with a training, or draw learning curves.",
    "train --scenario paper-random-early --steps 200000 --name early",
    "train resume runs/early",
)


@train.add("start", "train --recipe sac --name sac", kept=KEPT, json=True, force=True, parts=True)
def start_command(
    out: Out,
    scenario: str = "paper-random",
    recipe: str = "ppo",
    scheme: Annotated[
        str | None,
        typer.Option(
            metavar="single|shared|independent|centralised",
            help="How several learners are trained together.",
            show_default="the recipe's; else single, or shared for several learners",
        ),
    ] = None,
    settings: list[str] | None = None,
    steps: int | None = None,
    seed: SeedOption = None,
    name: NameOption = None,
    output: OutputOption = None,
) -> None:
    """Train a policy, or those of several learners.

    They are kept in a run's folder. Afterwards: `ethbrake evaluate --agents full_brake,ppo@FOLDER,ppo@FOLDER+episode`;
    of several: `team@FOLDER`. Ctrl-C ends the training after the update in progress and keeps the policy; `ethbrake
    train resume FOLDER` goes on.
    """
    plan = learning.load_recipe(recipe)
    given = learning.read_settings(settings, [plan])
    chosen, plan = evaluation.load_runnable(scenario, given.scenario), given.change(plan, out.note)
    if scheme is not None:
        plan = plan.replace(scheme=scheme)
    begun = [learning.Training.of(plan, chosen).who_drives()]

    def tell(progress: Progress) -> None:
        if begun:  # all input is known to be good
            out.note(begun.pop())
        out.show_progress(progress)

    result = learning.train(
        plan,
        chosen,
        run_folder(chosen, plan, seed=seed, name=name, output=output),
        steps=steps,
        seed=seed,
        force=out.force,
        on_progress=tell,
        settings=given.texts,
    )
    _tell(out, result)


@train.add("resume", "train resume runs/paper-random-ppo-seed0", kept=KEPT, json=True)
def resume_command(
    out: Out,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the run.")],
    other_versions: Annotated[
        bool, typer.Option("--other-versions", help="Go on although other versions trained it; numbers may differ.")
    ] = False,
) -> None:
    """Go on with a training that was stopped or killed.

    The policy is the one that the training would have come to without the stop, bit for bit.
    """
    ended = learning.resume(folder, on_progress=out.show_progress, other_versions=other_versions)
    _tell(out, ended)


@train.add("curves", "train curves --scenario paper-delay-low --output runs/low-delay", kept=KEPT, json=True)
def curves_command(
    out: Out,
    output: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Folder of all trainings, of the figure and the table.")
    ],
    scenario: str = "paper-random",
    recipes: Annotated[
        str, typer.Option(metavar="RECIPE:SEEDS,...", help="Recipes, each with its number of seeds (0, 1, ...).")
    ] = "ppo:5,sac:3",
    settings: list[str] | None = None,
    steps: int | None = None,
    jobs: int = 1,
    against: Annotated[
        Literal["steps", "cpu"], typer.Option(help="Draw over training steps, or over processor seconds of learning.")
    ] = "steps",
) -> None:
    """Train several seeds of recipes, and draw the curves.

    One figure shows all learning curves. The same command goes on after an interruption: finished trainings are kept,
    begun ones go on.
    """
    from ethbrake_marl.studies.learning_curves import LearningCurves

    plan = LearningCurves.parse(recipes)
    given = learning.read_settings(settings, [recipe for recipe, _ in plan])
    chosen = evaluation.load_runnable(scenario, given.scenario)
    changed = [(given.change(recipe, out.note), seeds) for recipe, seeds in plan]
    names = [chosen.vehicle_names[i] for i in chosen.learners]
    check_one_learner(chosen.name, names, "learning curves need exactly one")
    curves = LearningCurves(chosen, changed, output, against)
    if not curves.train(steps=steps, jobs=jobs, tell=out.show_progress, settings=given.texts):
        out.interrupted(f"interrupted; the same command goes on with what is in {output}")
    out.result(curves.write())
    out.note(f"figure: {output / 'learning_curves.png'}")


def _tell(out: Out, result: learning.TrainResult) -> None:
    """What a training came to."""
    out.result({
        "directory": str(result.directory),
        "status": result.status,
        "start": result.training.begins,
        "steps": result.steps,
        "scheme": result.training.scheme,
        "drivers": dict(result.training.drivers),
        "evaluation": result.evaluations[-1] if result.evaluations else None,
        "policy_steps": next(iter(result.policies.values())).manifest.steps,
    })  # fmt: skip
    _end(out, result)


def _end(out: Out, result: learning.TrainResult) -> None:
    """Say what a training left; an interrupted one ends with that status."""
    if result.status == "interrupted":
        left = f"go on with: ethbrake train resume {result.directory} (its policy is there)"
        out.interrupted(f"interrupted after {result.steps:,} training steps; {left}")
    out.note(f"{result.status} after {result.steps:,} training steps: {result.directory}")


# The commands of many trainings or evaluations: ``study`` and ``reproduce``.

KEPT_IN_FOLDER = "the same command goes on with what is in the folder"
PAPER_EPISODES, MOST_WORKERS = 10_000, 4096

FolderOption = Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of everything.")]
RetriesOption = Annotated[
    int, typer.Option(help="Further attempts at a job whose process was lost.", callback=whole_number(0, 100))
]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Print what would be done and what it takes; do nothing.")
]
ClusterOption = Annotated[
    str, typer.Option(metavar="local|ADDRESS", help="A Ray of this machine alone, or a cluster that runs.")
]
CostOption = Annotated[bool, typer.Option("--cost", help="Say what is left to do and what it takes; stop.")]

study_group = app.group(
    "study",
    "Train and compare many: a grid, settings, cooperation, lines.",
    "study sweep sweep.yaml --output runs/sweep",
    "study ablate --quick --output runs/ablation-quick",
)


def _schema_option(module: str, plan: str) -> Any:
    """The option ``--schema`` of a command that reads files of one kind: print their JSON Schema and exit."""

    def show_schema(asked: bool) -> None:
        if asked:
            Out().print_json(getattr(import_module(module), plan).json_schema())
            raise typer.Exit

    told = "Print the JSON Schema of the file, and exit."
    return Annotated[bool, typer.Option("--schema", is_eager=True, callback=show_schema, help=told)]


@study_group.add("sweep", "study sweep sweep.yaml --output runs/sweep",
    kept=KEPT_IN_FOLDER, json=True,
)  # fmt: skip
def sweep_command(
    out: Out,
    file: Annotated[Path, typer.Argument(metavar="SWEEP.yaml", help="A grid or a list of jobs.")],
    output: FolderOption,
    jobs: Annotated[
        int | None,
        typer.Option(
            help="Jobs at once, a process with one thread each.",
            show_default="one for each core",
            callback=whole_number(1, MOST_WORKERS),
        ),
    ] = None,
    ray: ClusterOption = "local",
    retries: RetriesOption = 2,
    dry_run: DryRunOption = False,
    schema: _schema_option("ethbrake_marl.studies.sweep", "SweepPlan") = False,  # type: ignore[valid-type]  # made here
) -> None:
    """Train every job of a file, and write one table.

    It shows what they reached. The same command goes on after an interruption: finished jobs are kept, begun ones go
    on. Exit status 1 where jobs failed: failures.csv says why.
    """
    from ethbrake_marl.studies.sweep import SweepPlan

    plan = SweepPlan.read(file)
    plan.folder(output).check()
    if dry_run:
        states = plan.states(output)
        lines = ([f"{job['state']:8}", job["job"], *map("=".join, job["set"].items())] for job in states)
        out.result(states, *map("  ".join, lines))
        return
    need("ray")
    result = plan.run(output, jobs=jobs, ray=ray, retries=retries, tell=out.show_progress)
    counts = {"jobs": result.jobs, "finished": result.finished, "failed": result.failed}
    out.result({**counts, "interrupted": result.interrupted, "table": str(result.table)})
    told = f"{result.finished:,} of {result.jobs:,} jobs finished; table: {result.table}"
    if result.failed:
        told += f"; {result.failed:,} failed: {output / 'failures.csv'}"
    _end_study(out, told, interrupted=result.interrupted, failed=result.failed > 0)


@study_group.add("tune", "study tune tuning.yaml --output runs/tuning --trials 30 --export best.yaml",
    kept=KEPT_IN_FOLDER, needs=("optuna",), json=True, force=True,
)  # fmt: skip
def tune_command(
    out: Out,
    file: Annotated[Path, typer.Argument(metavar="TUNING.yaml", help="A training and the ranges of its settings.")],
    output: FolderOption,
    trials: Annotated[
        int, typer.Option(help="Trials that the folder shall have altogether.", callback=whole_number(1, 10_000))
    ] = 30,
    jobs: Annotated[
        int,
        typer.Option(
            help="Trials at once, a process each; more than one change what is tried.",
            callback=whole_number(1, MOST_WORKERS),
        ),
    ] = 1,
    ray: ClusterOption = "local",
    retries: RetriesOption = 2,
    export: Annotated[
        Path | None, typer.Option(metavar="NAME.yaml", help="Write the best trial as a recipe of this name.")
    ] = None,
    dry_run: DryRunOption = False,
    schema: _schema_option("ethbrake_marl.studies.tuning", "TuningPlan") = False,  # type: ignore[valid-type]  # made here
) -> None:
    """Search the settings of a recipe for the least harm.

    Harm on a list of worlds of its own. The same command goes on after an interruption: trials that ended are kept,
    those that were begun go on. Exit status 1 where no trial came to its end.
    """
    from ethbrake_marl.studies.tuning import TuningPlan

    plan = TuningPlan.read(file)
    plan.folder(output).check()
    if export is not None:  # raise now what would be raised at the end
        if export.is_file():  # what this tuning wrote before is replaced: the same command goes on
            out.force = out.force or export.read_bytes().startswith(plan.export_head(export).encode())
        if export.suffix != ".yaml":
            raise InvalidInput(f"export {export}: must end in .yaml, as recipes do")
        plan.best_recipe({}, export, "")
        out.check(export)
    if dry_run:
        own = plan.own_values()
        space = {key: dimension.model_dump(mode="json") for key, dimension in plan.file.search.items()}
        now = {key: "not in the space" if own is None else f"the recipe has {own[key]}" for key in space}
        out.result(
            {"search": space, "own_values": own, "trials": trials},
            *(f"{key}  {dimension}  ({now[key]})" for key, dimension in plan.file.search.items()),
        )
        return
    need("ray")
    result = plan.run(output, trials, jobs=jobs, ray=ray, retries=retries, tell=out.show_progress)
    counted = ", ".join(f"{number:,} {state}" for state, number in sorted(result.counts.items()))
    told, best, shown, lines = f"trials: {counted or 'none'}; table: {result.table}", result.best, None, []
    export = None if best is None or result.interrupted else export  # what goes on exports at its end
    if best is not None:
        shown = {"trial": best.number, "harm": best.harm, "values": best.values}
        lines = [f"best: trial {best.number}, {best.harm:.4f}", *(f"  {k} = {v}" for k, v in best.values.items())]
        if export is not None:
            source = f"trial {best.number}, {best.harm!r} on the list of seed {plan.file.measure.seed}"
            out.write(export, plan.best_recipe(best.values, export, f"ethbrake study tune: {source}"))
            told += f"; recipe: {export}"
    found = {
        "best": shown,
        "trials": result.counts,
        "interrupted": result.interrupted,
        "table": str(result.table),
        "exported": None if export is None else str(export),
    }
    out.result(found, *lines)
    _end_study(out, told, interrupted=result.interrupted, failed=best is None)


def _end_study(out: Out, told: str, *, interrupted: bool, failed: bool) -> None:
    """Say what a sweep or a tuning came to, and end with its status."""
    if interrupted:
        out.interrupted(f"interrupted; {told}; {KEPT_IN_FOLDER}")
    out.note(told)
    if failed:
        raise typer.Exit(1)


@study_group.add("ablate", "study ablate --quick --output runs/ablation-quick", kept=KEPT_IN_FOLDER, json=True)
def ablate_command(
    out: Out,
    output: FolderOption,
    levels: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Scenarios in this order.", show_default="the shipped ladder")
    ] = None,
    recipes: Annotated[str, typer.Option(metavar="A,B,...", help="Training recipes.")] = "cooperation",
    scheme: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="How several learners are trained.", show_default="the recipe's; else shared"
        ),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(help="Trainings of each, seeds 0, 1, ...", show_default="5", callback=whole_number(1))
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            help="Decisions per training, for each of its learners.", show_default="400000", callback=whole_number(1)
        ),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Common worlds to measure on.", show_default="4000", callback=whole_number(1))
    ] = None,
    list_seed: Annotated[int, typer.Option(help="Seed of the common worlds.")] = DEFAULT.LIST_SEED,
    search_episodes: Annotated[
        int | None,
        typer.Option(help="Worlds of the joint optimum, the first ones.", show_default="600", callback=whole_number(1)),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option(
            help="Candidates per world and count of that search.", show_default="20000", callback=whole_number(1)
        ),
    ] = None,
    shield: Annotated[
        str | None,
        typer.Option(metavar="step", help="Also drive behind this shield, one for all learners.", show_default="none"),
    ] = None,
    settings: list[str] | None = None,
    quick: Annotated[bool, typer.Option("--quick", help="A first look: few seeds, worlds and decisions.")] = False,
    jobs: int = 1,
    cost: CostOption = False,
) -> None:
    """Train levels of cooperation, compare them on common worlds.

    Says first what it will take. The same command goes on after an interruption: finished trainings are kept, begun
    ones go on. Writes ablation.html, ablation.md, ablation.csv, ablation.json and three figures.
    """
    from ethbrake_marl.studies.ablation import plan_ablation
    from ethbrake_marl.studies.speed import this_machine

    plan = plan_ablation(
        levels, recipes, scheme, settings, quick=quick, tell=out.note, seeds=seeds, steps_per_learner=steps,
        episodes=episodes, list_seed=list_seed, search_episodes=search_episodes, budget=budget, shield=shield,
        folder=output,
    )  # fmt: skip
    if not cost:
        plan.study_folder().check()
    out.note(plan.cost())
    if cost:
        return
    written = plan.run(jobs, str(this_machine()), out.show_progress)
    if written is None:
        out.interrupted(f"interrupted; {KEPT_IN_FOLDER}")
    found, (page, text, *figures) = written
    alarms = [Text(line, "bold red") for line in found["undertrained"]]
    out.result(found, text.read_text("utf-8"), *alarms, end="")
    drawn = f"; figures: {', '.join(map(str, figures))}" if figures else ""
    out.note(f"page: {page}; tables: {text}{drawn}")


@app.add("reproduce", "reproduce random-table harm-distance --quick --output runs/paper",
    kept=KEPT_IN_FOLDER, json=True, force=True,
)  # fmt: skip
def reproduce_command(
    out: Out,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[ITEM ...]", help="What to make.", show_default="everything")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Train nothing: shipped policies (the default).")] = False,
    full: Annotated[bool, typer.Option("--full", help="Train learning curves and a policy stopped early.")] = False,
    output: FolderOption = Path("runs/reproduction"),
    episodes: Annotated[
        int,
        typer.Option(
            help="The most worlds of any list; the paper has 10,000.", callback=whole_number(2, PAPER_EPISODES)
        ),
    ] = PAPER_EPISODES,
    docs: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="Write the results as Markdown, too, figures beside it.")
    ] = None,
    cost: CostOption = False,
    listed: Annotated[bool, typer.Option("--list", help="List the items; stop.")] = False,
) -> None:
    """Make the paper's figures and tables again.

    Says what agrees, what differs and what cannot agree. Writes one page (index.html), and for each item its figures,
    its data and its result. Says first what it will take. The same command goes on after an interruption.
    """
    from ethbrake_marl.studies.reproduction import Reproduction
    from ethbrake_marl.studies.speed import this_machine

    if quick and full:
        raise InvalidInput("--quick and --full: give one of the two")
    chosen = Reproduction.choose(names or ())
    if listed:
        rows = [(item.name, ", ".join(item.labels), item.title) for item in chosen]
        known = {"Item": "name", "Label in the paper": "labels", "What": "title"}
        sheet = Sheet("", [Column(heading, key, text=True) for heading, key in known.items()], rows)
        out.result(sheet.json(), sheet)
        return
    if full:
        need("torch")
    asked = Reproduction("full" if full else "quick", output, episodes, out.show_progress, str(this_machine()), docs)
    out.note(asked.cost(chosen))
    if cost:
        return
    results, finished = asked.make(chosen, force=out.force)
    verdicts = [(result.name, result.verdict.outcome, result.verdict.because) for result in results]
    out.result([result.in_words() for result in results], Sheet("", ("Item", "Verdict", "Because"), verdicts))
    out.note(f"page: {output / 'index.html'}")
    if not finished:
        out.interrupted(f"interrupted: items are made of the trainings that were finished; {KEPT_IN_FOLDER}")
