"""The commands that train and that go on with a training: parse, call, print."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import (
    ForceOption,
    JobsOption,
    JsonOption,
    NameOption,
    OutputOption,
    RecipeOption,
    ScenarioOption,
    SchemeOption,
    SetOption,
    StepsOption,
    StopWhenLostOption,
    TrainingSeedOption,
)
from ethbrake_marl.cli.terminal import INTERRUPTED, interruptible, progress_bars, say, write_json
from ethbrake_marl.errors import Progress, check_one_learner

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation.inputs import load_runnable
    from ethbrake_marl.evaluation.results import check_target, write_output
    from ethbrake_marl.learning.recipe import check_scheme, load_recipe, read_settings, who_drives_what
    from ethbrake_marl.policies.shipped import load_named_policy, onnx_model

if TYPE_CHECKING:
    from ethbrake_marl.learning.train import TrainResult


KEPT = "if the training had begun, the run's folder keeps the last good policy, and ethbrake resume FOLDER goes on"


def train_command(
    scenario: ScenarioOption = "paper-random",
    recipe: RecipeOption = "ppo",
    scheme: SchemeOption = None,
    settings: SetOption = None,
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    name: NameOption = None,
    output: OutputOption = None,
    stop_when_lost: StopWhenLostOption = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy, or the policies of several learners, into a run's folder.

    Afterwards: `ethbrake evaluate --agents full_brake,ppo@FOLDER,ppo@FOLDER+episode`; of several: `team@FOLDER`.
    Ctrl-C ends the training after the update in progress and keeps the policy; `ethbrake resume FOLDER` goes on.
    """
    with interruptible(KEPT):
        # Here and in other commands that learn: torch takes seconds to load, and no other command needs it.
        from ethbrake_marl.learning.train import train
        from ethbrake_marl.learning.training import resolve
        from ethbrake_marl.studies.experiment import run_folder

        plan = load_recipe(recipe)
        given = read_settings(settings, [plan])
        chosen, plan = load_runnable(scenario, given.scenario), given.change(plan, say)
        if scheme is not None:
            plan = plan.replace(scheme=check_scheme(scheme))
        training = resolve(plan, chosen)
        folder = run_folder(chosen, plan, seed=seed, name=name, output=output)
        begun = [
            f"scheme {training.scheme}: {who_drives_what(training.drivers)}"
        ]  # said once all input is known to be good
        with progress_bars() as bars:

            def tell(progress: Progress) -> None:
                if begun:
                    bars.tell(begun.pop())
                bars.show_progress(progress)

            result = train(
                plan,
                chosen,
                folder,
                steps=steps,
                seed=seed,
                force=force,
                stop_when_lost=stop_when_lost,
                on_progress=tell,
                settings=given.texts,
            )
    _show_result(result, as_json)


def resume_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the run.")],
    other_versions: Annotated[
        bool,
        typer.Option(
            "--other-versions", help="Go on although other versions or plug-ins trained it; numbers may differ."
        ),
    ] = False,
    stop_when_lost: StopWhenLostOption = False,
    as_json: JsonOption = False,
) -> None:
    """Go on with a training that was stopped or killed.

    The policy is the one that the training would have come to without the stop, bit for bit.
    """
    with interruptible(KEPT):
        from ethbrake_marl.learning.train import resume

        with progress_bars() as bars:
            result = resume(
                folder,
                stop_when_lost=stop_when_lost,
                on_progress=bars.show_progress,
                other_versions=other_versions,
            )
    _show_result(result, as_json)


def learning_curves_command(
    output: Annotated[
        Path, typer.Option("--output", metavar="FOLDER", help="Folder of all trainings, of the figure and the table.")
    ],
    scenario: ScenarioOption = "paper-random",
    recipes: Annotated[
        str, typer.Option(metavar="RECIPE:SEEDS,...", help="Recipes, each with its number of seeds (0, 1, ...).")
    ] = "ppo:5,sac:3",
    settings: SetOption = None,
    steps: StepsOption = None,
    jobs: JobsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Train several seeds of several recipes, and draw their learning curves in one figure.

    The same command goes on after an interruption: finished trainings are kept, begun ones go on.
    """
    with interruptible(KEPT):
        from ethbrake_marl.studies.learning_curves import FIGURE, parse_trainings, train_all, write_curves

        plan = parse_trainings(recipes)
        given = read_settings(settings, [trainings.recipe for trainings in plan])
        chosen = load_runnable(scenario, given.scenario)
        plan = [replace(trainings, recipe=given.change(trainings.recipe, say)) for trainings in plan]
        check_one_learner(
            chosen.name, [chosen.vehicle_names[i] for i in chosen.learners], "learning curves need exactly one"
        )
        with progress_bars() as bars:
            finished = train_all(
                chosen,
                plan,
                output,
                steps=steps,
                jobs=jobs,
                tell=bars.show_progress,
                settings=given.texts,
            )
        if not finished:
            say(f"interrupted; the same command goes on with what is in {output}")
            raise typer.Exit(INTERRUPTED)
        summary = write_curves(chosen, plan, output)
    if as_json:
        write_json(summary)
    say(f"figure: {output / FIGURE}")


def end_of_training(status: str, steps: int, folder: Path) -> None:
    """Say what a training left; an interrupted one ends with that status."""
    if status == "interrupted":
        say(f"interrupted after {steps:,} training steps; go on with: ethbrake resume {folder} (its policy is there)")
        raise typer.Exit(INTERRUPTED)
    say(f"{status} after {steps:,} training steps: {folder}")


def _show_result(result: TrainResult, as_json: bool) -> None:
    if as_json:
        last = result.evaluations[-1] if result.evaluations else None
        content = {"directory": str(result.directory), "status": result.status, "steps": result.steps}
        best = next(iter(result.policies.values())).manifest.steps
        team = {"scheme": result.training.scheme, "drivers": dict(result.training.drivers)}
        write_json({**content, **team, "evaluation": last, "policy_steps": best, "alarms": list(result.alarms)})
    end_of_training(result.status, result.steps, result.directory)


def export_command(
    policy: Annotated[str, typer.Argument(metavar="FOLDER", help="A run, a policy bundle, or shipped/NAME.")],
    onnx: Annotated[Path, typer.Option("--onnx", metavar="FILE", help="The ONNX model to write.")],
    force: ForceOption = False,
) -> None:
    """Write a policy as an ONNX model: observation in, acceleration out.

    Needs the package onnx, which the extra `export` brings.
    """
    check_target(onnx, force=force)
    write_output(onnx, onnx_model(load_named_policy(policy)), force=force)
    say(f"written: {onnx}")
