"""The command ``train``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SettingsOption, StepsOption
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Column, Sheet

if TYPE_CHECKING:
    from ethbrake_marl.progress import Progress
    from ethbrake_marl.training.recipe import TrainingRecipe
    from ethbrake_marl.training.train import TrainResult

AFTER_STOPPED_TRAINING = (
    "if the training had begun, the last good policy is in the run's folder; ethbrake train --resume FOLDER continues"
    " an unfinished training"
)

TrainingScenarioOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|PATH",
        help="Name of a shipped or registered scenario, or path of a YAML file.",
        show_default="the recipe's, or paper-random",
    ),
]

TrainingSeedOption = Annotated[
    int | None, typer.Option(help="Seed of the training run.", show_default="as in the recipe")
]

OutputOption = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="Folder to write the run to.", show_default="runs/SCENARIO-RECIPE-seedSEED"),
]


def train_command(
    scenario: TrainingScenarioOption = None,
    recipe: Annotated[
        str | None,
        typer.Option(metavar="NAME|PATH", help="Name of a shipped recipe, or path of a YAML file.", show_default="ppo"),
    ] = None,
    settings: SettingsOption = None,
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    output: OutputOption = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Continue the training run in this folder.")
    ] = None,
    other_versions: Annotated[
        bool,
        typer.Option(
            "--other-versions",
            help="With --resume: continue even if the run used other package versions; numbers may differ.",
        ),
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy, or the policies of several learners.

    The recipe says what learners minimise: by default the honest cost; with --set harm_count=first, first-impact harm.
    Writes the folder of the training run. At the end the command prints the harm of the trained agent and of full
    braking, the agent's name, and a command that evaluates the agent. Ctrl-C ends the training after the current update
    and saves the policy. `ethbrake train --resume FOLDER` continues the training; the final policy is then the same,
    bit for bit, as without the interruption.
    """
    with Out(as_json=as_json, force=force, remains=AFTER_STOPPED_TRAINING) as out:
        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.training.recipe import load_recipe
        from ethbrake_marl.training.training import Training, check_new_run

        if resume is not None:
            options = {
                "--scenario": scenario, "--recipe": recipe, "--set": settings, "--steps": steps, "--seed": seed,
                "--output": output, "--force": force or None,
            }  # fmt: skip
            for option in (name for name, value in options.items() if value is not None):
                raise InvalidInput(
                    f"{option}: cannot be combined with --resume, which uses the settings in the run's folder; leave"
                    " one of the two options out"
                )
            from ethbrake_marl.training.train import resume as go_on

            show_trained(out, go_on(resume, on_progress=out.show_progress, other_versions=other_versions))
            return
        if other_versions:
            raise InvalidInput("--other-versions: has no effect on a new run; use it only with --resume FOLDER")
        plan = load_recipe(recipe or "ppo")
        changes = read_settings(settings, [*type(plan).model_fields])
        chosen = changes.change_scenario(scenario or plan.scenario or "paper-random")
        plan = change_recipe(plan, changes.recipe)
        begun = [Training.of(plan, chosen).who_drives()]
        folder = output or run_folder(chosen.name, plan.name, plan.scheme, plan.seed if seed is None else seed)
        check_new_run(folder.expanduser(), force=force)
        from ethbrake_marl.training.train import train  # torch takes seconds to load

        def tell(progress: Progress) -> None:
            if begun:  # at the first progress report all input has been checked
                out.note(begun.pop())
            out.show_progress(progress)

        result = train(
            plan, chosen, folder, steps=steps, seed=seed, force=force, on_progress=tell,
            settings=changes.texts,
        )  # fmt: skip
        show_trained(out, result, scenario)


def run_folder(scenario: str, recipe: str, scheme: str | None, seed: int) -> Path:
    plan = recipe if scheme is None else f"{recipe}-{scheme}"
    return Path("runs") / f"{scenario}-{plan}-seed{seed}"


def change_recipe(plan: TrainingRecipe, overrides: Any) -> TrainingRecipe:
    from ethbrake_marl.files.overrides import Override

    return plan.replace(**Override.put(plan.model_dump(mode="json"), overrides)) if overrides else plan


def show_trained(out: Out, result: TrainResult, scenario: str | None = None) -> None:
    """``scenario``: name or path of the scenario in the printed command; None: the name in the run's folder."""
    from ethbrake_marl.cli.settings import read_settings
    from ethbrake_marl.episode.counts import HONEST, IMPACT_COUNTS
    from ethbrake_marl.files.plain import read_object
    from ethbrake_marl.files.python_file import loaded_files
    from ethbrake_marl.training.fixed_list import OBJECTIVE_METRIC, full_braking

    training, plan = result.training, result.training.recipe
    columns = [
        Column("Agent", "agent", text=True),
        Column("First-impact harm", "first_impact_harm"),
        Column("Total harm", "total_harm"),
        Column("Collisions", "collision_rate", digits=1, scale=100.0, unit=" %"),
    ]
    count, measured = plan.reward.harm_count, {"full_brake": full_braking(training)}
    for shown in dict.fromkeys([HONEST, count]):
        if shown not in IMPACT_COUNTS and shown.column in measured["full_brake"]:
            columns.append(Column(shown.words.capitalize(), shown.column))
    measured[result.agent] = dict(result.metrics or {})
    if OBJECTIVE_METRIC in measured["full_brake"]:
        columns.append(Column("Objective", OBJECTIVE_METRIC))
    rows = [(agent, *(metrics.get(column.name) for column in columns[1:])) for agent, metrics in measured.items()]
    note = (
        f"Means per world; harm in m²/s². The means are over the {plan.evaluation.worlds:,} worlds of seed"
        f" {plan.evaluation.seed} with which the training selected its policy."
    )
    table = Sheet("", columns, rows, note)
    settings = read_object(result.directory / "config.json").get("settings", ())
    options = [setting for setting in settings if read_settings([setting], [*type(plan).model_fields]).scenario]
    options += [f"harm_count={count.name}"] * (count != HONEST)
    words = [word for file in loaded_files() for word in ("--load", file)]
    words += ["--scenario", scenario or training.scenario.name, "--agents", f"full_brake,{result.agent}"]
    command = shlex.join(
        ["ethbrake", "evaluate", *words, *(word for setting in options for word in ("--set", setting))]
    )
    out.result(
        {
            "directory": str(result.directory),
            "status": result.status,
            "steps": result.steps,
            "scheme": training.scheme,
            "drivers": dict(training.drivers),
            "evaluation": dict(result.evaluations[-1]) if result.evaluations else None,
            "agent": result.agent,
            "fixed_list": {"worlds": plan.evaluation.worlds, "seed": plan.evaluation.seed, "results": table.json()},
            "next_command": command,
        },
        table,
        f"\nThe agent is {result.agent}. Evaluate it on other worlds:\n  {command}",
        in_file=True,
    )
    tell_end(out, result.status, result.steps, result.directory)


def tell_end(out: Out, status: str, steps: int, directory: Path) -> None:
    """Exits with status 130 if the training was interrupted."""
    if status == "interrupted":
        hint = f"the policy so far is saved; continue with: ethbrake train --resume {shlex.quote(str(directory))}"
        out.interrupted(f"interrupted after {steps:,} training steps; {hint}")
    out.note(f"{status} after {steps:,} training steps: {directory}")
