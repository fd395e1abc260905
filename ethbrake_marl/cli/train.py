"""The commands that train and that go on with a training: ``run`` and ``train``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.command import app, command, new_group
from ethbrake_marl.cli.evaluate import show_run
from ethbrake_marl.cli.out import Out
from ethbrake_marl.defaults import EPISODES, LIST_SEED
from ethbrake_marl.errors import Progress, check_one_learner

if TYPE_CHECKING:
    from ethbrake_marl.learning.train import TrainResult

KEPT = (
    "if the training had begun, the run's folder keeps the last good policy, and ethbrake train resume FOLDER goes on"
)
SeedOption = Annotated[int | None, typer.Option(help="Seed of the training alone.", show_default="the recipe's")]
StopWhenLostOption = Annotated[
    bool, typer.Option("--stop-when-lost", help="Stop, resumable, when harm comes back and stays.")
]
NameOption = Annotated[
    str | None, typer.Option(help="Folder of the run inside runs/.", show_default="SCENARIO-RECIPE-seedSEED")
]
OutputOption = Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder of the run, instead of --name.")]


@command(app, "run", "run --steps 200000 --seed 1", kept=KEPT, json=True, force=True)
def run_command(
    out: Out,
    scenario: str = "paper-random",
    steps: int | None = None,
    seed: SeedOption = None,
    episodes: Annotated[int, typer.Option(help="Worlds of the evaluation list.")] = EPISODES,
    list_seed: Annotated[int, typer.Option(help="Seed of the evaluation list.")] = LIST_SEED,
    recipe: str = "quick",
    settings: list[str] | None = None,
    vehicle: str | None = None,
    name: NameOption = None,
    output: OutputOption = None,
    stop_when_lost: StopWhenLostOption = False,
) -> None:
    """Train a policy, shield it, compare with the baselines, report.

    Writes the run's folder: the policy, results as CSV and JSON, every world, three figures, and report.html. After
    one of the three tests (paper-random, -brake-only, -obstacle) the policy also drives the other two.
    Ctrl-C ends the training early, and what it has is evaluated; a second Ctrl-C stops at once.
    """
    from ethbrake_marl.evaluation.inputs import load_driven
    from ethbrake_marl.evaluation.results import PER_WORLD, results_to_json
    from ethbrake_marl.learning.recipe import load_recipe, read_settings

    # torch takes seconds to load, here and in the other commands that learn
    from ethbrake_marl.studies.experiment import run_experiment, run_folder

    plan = load_recipe(recipe)
    given = read_settings(settings, [plan])
    chosen, plan = load_driven(scenario, vehicle, given.scenario), given.change(plan, out.note)
    folder = run_folder(chosen, plan, seed=seed, name=name, output=output)
    result = run_experiment(
        chosen,
        folder,
        recipe=plan,
        steps=steps,
        seed=seed,
        episodes=episodes,
        list_seed=list_seed,
        stop_when_lost=stop_when_lost,
        force=out.force,
        settings=given.texts,
        on_progress=out.show_progress,
    )
    told = results_to_json(result.rows, per_world=result.directory / PER_WORLD)
    show_run(out, result.rows, result.beside, told)
    out.note(f"report: {result.report}")
    _end(out, result.status, result.steps, folder)


train = new_group(
    "train",
    "Train a policy, go on with a training, or draw learning curves.",
    "train --scenario paper-random-early --steps 200000 --name early",
    "train resume runs/early",
)


@command(train, "start", "train --recipe sac --name sac", kept=KEPT, json=True, force=True, parts=True)
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
    stop_when_lost: StopWhenLostOption = False,
) -> None:
    """Train a policy, or the policies of several learners, into a run's folder.

    Afterwards: `ethbrake evaluate --agents full_brake,ppo@FOLDER,ppo@FOLDER+episode`; of several: `team@FOLDER`.
    Ctrl-C ends the training after the update in progress and keeps the policy; `ethbrake train resume FOLDER` goes on.
    """
    from ethbrake_marl.evaluation.inputs import load_runnable
    from ethbrake_marl.learning.recipe import check_scheme, load_recipe, read_settings, who_drives_what
    from ethbrake_marl.learning.train import train
    from ethbrake_marl.learning.training import resolve
    from ethbrake_marl.studies.experiment import run_folder

    plan = load_recipe(recipe)
    given = read_settings(settings, [plan])
    chosen, plan = load_runnable(scenario, given.scenario), given.change(plan, out.note)
    if scheme is not None:
        plan = plan.replace(scheme=check_scheme(scheme))
    training = resolve(plan, chosen)
    begun = [f"scheme {training.scheme}: {who_drives_what(training.drivers)}"]

    def tell(progress: Progress) -> None:
        if begun:  # all input is known to be good
            out.note(begun.pop())
        out.show_progress(progress)

    result = train(
        plan,
        chosen,
        run_folder(chosen, plan, seed=seed, name=name, output=output),
        steps=steps,
        seed=seed,
        force=out.force,
        stop_when_lost=stop_when_lost,
        on_progress=tell,
        settings=given.texts,
    )
    _tell(out, result)


@command(train, "resume", "train resume runs/paper-random-ppo-seed0", kept=KEPT, json=True)
def resume_command(
    out: Out,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the run.")],
    other_versions: Annotated[
        bool,
        typer.Option(
            "--other-versions", help="Go on although other versions or plug-ins trained it; numbers may differ."
        ),
    ] = False,
    stop_when_lost: StopWhenLostOption = False,
) -> None:
    """Go on with a training that was stopped or killed.

    The policy is the one that the training would have come to without the stop, bit for bit.
    """
    from ethbrake_marl.learning.train import resume

    _tell(
        out,
        resume(folder, stop_when_lost=stop_when_lost, on_progress=out.show_progress, other_versions=other_versions),
    )


@command(train, "curves", "train curves --scenario paper-delay-low --output runs/low-delay", kept=KEPT, json=True)
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
) -> None:
    """Train several seeds of several recipes, and draw their learning curves in one figure.

    The same command goes on after an interruption: finished trainings are kept, begun ones go on.
    """
    from ethbrake_marl.evaluation.inputs import load_runnable
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.studies.learning_curves import FIGURE, parse_trainings, train_all, write_curves

    plan = parse_trainings(recipes)
    given = read_settings(settings, [trainings.recipe for trainings in plan])
    chosen = load_runnable(scenario, given.scenario)
    plan = [replace(trainings, recipe=given.change(trainings.recipe, out.note)) for trainings in plan]
    names = [chosen.vehicle_names[i] for i in chosen.learners]
    check_one_learner(chosen.name, names, "learning curves need exactly one")
    if not train_all(chosen, plan, output, steps=steps, jobs=jobs, tell=out.show_progress, settings=given.texts):
        out.interrupted(f"interrupted; the same command goes on with what is in {output}")
    out.result(write_curves(chosen, plan, output))
    out.note(f"figure: {output / FIGURE}")


def _tell(out: Out, result: TrainResult) -> None:
    """What a training came to."""
    last = result.evaluations[-1] if result.evaluations else None
    content = {"directory": str(result.directory), "status": result.status, "steps": result.steps}
    best = next(iter(result.policies.values())).manifest.steps
    team = {"scheme": result.training.scheme, "drivers": dict(result.training.drivers)}
    out.result({**content, **team, "evaluation": last, "policy_steps": best, "alarms": list(result.alarms)})
    _end(out, result.status, result.steps, result.directory)


def _end(out: Out, status: str, steps: int, folder: Path) -> None:
    """Say what a training left; an interrupted one ends with that status."""
    if status == "interrupted":
        left = f"go on with: ethbrake train resume {folder} (its policy is there)"
        out.interrupted(f"interrupted after {steps:,} training steps; {left}")
    out.note(f"{status} after {steps:,} training steps: {folder}")
