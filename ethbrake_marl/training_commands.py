"""The commands that train and that go on with a training: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.command_options import (
    ForceOption,
    JsonOption,
    NameOption,
    OutputOption,
    RecipeOption,
    ScenarioOption,
    StepsOption,
    TrainingSeedOption,
)
from ethbrake_marl.learning.recipe import load_recipe
from ethbrake_marl.lineup import load_runnable
from ethbrake_marl.terminal import INTERRUPTED, Bars, interruptible, progress_bars, say, write_json

if TYPE_CHECKING:
    from ethbrake_marl.learning.callback import Progress
    from ethbrake_marl.learning.train import TrainResult

KEPT = "if the training had begun, the run's folder keeps the last good policy, and ethbrake resume FOLDER goes on"


def train_command(
    scenario: ScenarioOption = "paper-random",
    recipe: RecipeOption = "ppo",
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    name: NameOption = None,
    output: OutputOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy into a run's folder.

    Afterwards: `ethbrake evaluate --agents full_brake,ppo@FOLDER,hybrid@FOLDER`.
    Ctrl-C ends the training after the update in progress and keeps the policy; `ethbrake resume FOLDER` goes on.
    """
    with interruptible(KEPT):
        # Here and in other commands that learn: torch takes seconds to load, and no other command needs it.
        from ethbrake_marl.experiment import run_folder, train_measured

        chosen, plan = load_runnable(scenario), load_recipe(recipe)
        folder = run_folder(chosen, plan, seed=seed, name=name, output=output)
        with progress_bars() as bars:
            result = train_measured(
                chosen,
                folder,
                recipe=plan,
                steps=steps,
                seed=seed,
                force=force,
                on_progress=lambda p: show_progress(bars, p),
            )
    _show_result(result, as_json)


def resume_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the run.")],
    other_versions: Annotated[
        bool, typer.Option("--other-versions", help="Go on although other versions trained it; the numbers may differ.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Go on with a training that was stopped or killed.

    The policy is the one that the training would have come to without the stop, bit for bit.
    """
    with interruptible(KEPT):
        from ethbrake_marl.experiment import resume_measured

        with progress_bars() as bars:
            result = resume_measured(
                folder, on_progress=lambda p: show_progress(bars, p), other_versions=other_versions
            )
    _show_result(result, as_json)


def show_progress(bars: Bars, progress: Progress) -> None:
    """How far a training is, and what it has to say."""
    bars.show("training", progress.steps, progress.total_steps, progress.metrics, progress.note)


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
        best = result.policy.manifest.steps
        write_json({**content, "evaluation": last, "policy_steps": best, "alarms": list(result.alarms)})
    end_of_training(result.status, result.steps, result.directory)
