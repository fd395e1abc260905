"""The commands ``run`` and ``train``, which train policies."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl.cli.command import (
    ForceOption,
    JsonOption,
    Out,
    ScenarioOption,
    SettingsOption,
    StepsOption,
    schema_option,
)
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.first_edition import evaluation, scenario as scenarios, training
from ethbrake_marl.progress import Progress

REMAINS = (
    "if the training had begun, the last good policy is in the run's folder; ethbrake train --resume FOLDER continues"
    " an unfinished training"
)

RUNS = Path("runs")

QUICKEST = ("quick", "ppo")  # `ethbrake run` trains the first of these recipes whose algorithm is installed

QUICKEST_TEAM = ("cooperation", "cooperation-ppo")  # the same for scenarios with several learners

TrainingSeedOption = Annotated[
    int | None, typer.Option(help="Seed of the training run.", show_default="as in the recipe")
]

OutputOption = Annotated[
    Path | None,
    typer.Option(metavar="FOLDER", help="Folder to write the run to.", show_default="runs/SCENARIO-RECIPE-seedSEED"),
]


def run_folder(scenario: scenarios.Scenario, recipe: training.TrainingRecipe, seed: int | None) -> Path:
    """Return the default folder of a run: ``runs/SCENARIO-RECIPE-seedSEED``.

    If the recipe has a scheme for several learners, the name is ``runs/SCENARIO-RECIPE-SCHEME-seedSEED``. Without
    ``seed``, the name has the recipe's seed.
    """
    plan = recipe.name if recipe.scheme is None else f"{recipe.name}-{recipe.scheme}"
    return RUNS / f"{scenario.name}-{plan}-seed{recipe.seed if seed is None else seed}"


def run_command(
    scenario: ScenarioOption = "paper-random",
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    episodes: Annotated[int, typer.Option(help="Number of worlds in the evaluation list.")] = 10_000,
    list_seed: Annotated[int, typer.Option(help="Seed of the evaluation list.")] = 7,
    recipe: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="Name of a shipped recipe, or path of a YAML file.",
            show_default=f"{QUICKEST[0]}, or {QUICKEST_TEAM[0]} for several learners; {QUICKEST[1]} or"
            f" {QUICKEST_TEAM[1]} if their algorithm is not installed",
        ),
    ] = None,
    settings: SettingsOption = None,
    output: OutputOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy, shield it, compare it, and write a report.

    Trains a single learner or a team. Writes a run's folder with policies, results as CSV and JSON, results per world,
    three figures and report.html. If the scenario is one of the three tests (paper-random, paper-random-brake-only,
    paper-random-obstacle), the policy is also evaluated on the other two. For a team, the report also shows the harm
    that each vehicle bears. For a team, the command also trains each learner alone and a team without messages, to show
    the effect of each learner and of the messages. Ctrl-C ends the training early and evaluates the policy trained so
    far; a second Ctrl-C stops at once.
    """
    with Out(as_json=as_json, force=force, remains=REMAINS) as out:
        # torch takes seconds to load, here and in the other commands that learn
        from ethbrake_marl.first_edition.training.experiment import HYBRID, SHIELDED_TEAM, run_experiment
        from ethbrake_marl.first_edition.training.progress import objective_in_words

        plan = training.load_recipe(recipe or quickest())
        changes = training.read_settings(settings, [plan])
        chosen = evaluation.load_runnable(scenario, changes.scenario, drives="some")
        if recipe is None and len(chosen.learners) > 1:
            plan = training.load_recipe(quickest(several=True))
            changes = training.read_settings(settings, [plan])
        plan = changes.change(plan, out.note)
        result = run_experiment(
            chosen,
            output or run_folder(chosen, plan, seed),
            recipe=plan,
            steps=steps,
            seed=seed,
            episodes=episodes,
            list_seed=list_seed,
            force=out.force,
            settings=changes.texts,
            on_progress=out.show_progress,
        )
        trained = result.trained
        own = objective_in_words(trained.training)
        count = "total" if plan.reward.harm_count == "total" else "first-impact"
        what = "policy" if len(chosen.learners) == 1 else f"team (scheme {trained.training.scheme})"
        shielded = HYBRID if len(chosen.learners) == 1 else SHIELDED_TEAM
        headline = (
            f"Trained by recipe {plan.name}, seed {plan.seed if seed is None else seed}: {trained.steps:,} decisions in"
            f" {trained.wall_s:.0f} s ({trained.status}). {shielded}: the trained {what} with a shield. All agents"
            f" minimise {count} harm{f', except that the trained {what} minimises {own}' if own else ''}.\n"
        )
        out.result(result.results, Text(headline), *result.tables)
        for note in result.notes:
            out.note(note)
        _end(out, trained)


def quickest(*, several: bool = False) -> str:
    """Return the name of the default recipe of `ethbrake run`, for one learner or for ``several`` learners."""
    usable = training.TrainingRecipe.usable()
    return next(name for name in (QUICKEST_TEAM if several else QUICKEST) if name in usable)


def train_command(
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="Name of a shipped or registered scenario, or path of a YAML file.",
            show_default="paper-random",
        ),
    ] = None,
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
    schema: schema_option("ethbrake_marl.first_edition.training", "TrainingRecipe", "recipe") = False,  # type: ignore[valid-type]  # built by a function
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy, or the policies of several learners.

    Writes the folder of the training run. At the end the command prints the harm of the trained agent and of full
    braking, the agent's name, and a command that evaluates the agent. Ctrl-C ends the training after the current update
    and saves the policy. `ethbrake train --resume FOLDER` continues the training; the final policy is then the same,
    bit for bit, as without the interruption.
    """
    with Out(as_json=as_json, force=force, remains=REMAINS) as out:
        if resume is not None:
            asked = {
                "--scenario": scenario,
                "--recipe": recipe,
                "--set": settings,
                "--steps": steps,
                "--output": output,
            }
            for option in (
                name for name, value in {**asked, "--seed": seed, "--force": force or None}.items() if value is not None
            ):
                raise InvalidInput(
                    f"{option}: cannot be combined with --resume, which uses the settings in the run's folder; leave"
                    " one of the two options out"
                )
            _show(out, training.resume(resume, on_progress=out.show_progress, other_versions=other_versions))
            return
        if other_versions:
            raise InvalidInput("--other-versions: has no effect on a new run; use it only with --resume FOLDER")
        plan = training.load_recipe(recipe or "ppo")
        changes = training.read_settings(settings, [plan])
        chosen = evaluation.load_runnable(scenario or "paper-random", changes.scenario)
        plan = changes.change(plan, out.note)
        begun = [training.Training.of(plan, chosen).who_drives()]

        def tell(progress: Progress) -> None:
            if begun:  # at the first progress report all input has been checked
                out.note(begun.pop())
            out.show_progress(progress)

        folder = output or run_folder(chosen, plan, seed)
        result = training.train(
            plan, chosen, folder, steps=steps, seed=seed, force=force, on_progress=tell, settings=changes.texts
        )
        _show(out, result, scenario)


def _show(out: Out, result: training.TrainResult, scenario: str | None = None) -> None:
    """Print the harm of the trained agent and of full braking on stdout, and how the training ended on stderr.

    Also prints the command that evaluates the agent in ``scenario`` (name or path); None: the scenario of the training.
    """
    from ethbrake_marl.first_edition.training.fixed_list import measure_full_braking
    from ethbrake_marl.first_edition.training.progress import objective_in_words

    plan, run = result.training.recipe, training.RunDirectory(result.directory)
    columns = [
        Column("Agent", "agent", text=True),
        Column("First-impact harm", "first_impact_harm"),
        Column("Total harm", "total_harm"),
        Column("Collisions", "collision_rate", digits=1, scale=100.0, unit=" %"),
    ]
    if objective := objective_in_words(result.training):
        columns.append(Column(objective[0].upper() + objective[1:], "objective"))
    measured = {"full_brake": measure_full_braking(result.training), result.agent: result.metrics or {}}
    rows = [(agent, *(metrics.get(each.name) for each in columns[1:])) for agent, metrics in measured.items()]
    note = (
        f"Means per world; harm in m²/s². The means are over the {plan.evaluation.worlds:,} worlds of seed"
        f" {plan.evaluation.seed} with which the training selected its policy."
    )
    table = Sheet("", columns, rows, note)
    settings = [
        each for each in run.read_config().get("settings", ()) if training.read_settings([each], [plan]).scenario
    ]
    settings += ["harm_count=total"] if plan.reward.harm_count == "total" else []
    words = ["--scenario", scenario or result.training.scenario.name, "--agents", f"full_brake,{result.agent}"]
    command = shlex.join(["ethbrake", "evaluate", *words, *(word for each in settings for word in ("--set", each))])
    out.result(
        {
            "directory": str(result.directory),
            "status": result.status,
            "start": result.training.begins,
            "steps": result.steps,
            "scheme": result.training.scheme,
            "drivers": dict(result.training.drivers),
            "evaluation": result.evaluations[-1] if result.evaluations else None,
            "policy_steps": result.trained.steps,
            "agent": result.agent,
            "fixed_list": {"worlds": plan.evaluation.worlds, "seed": plan.evaluation.seed, "results": table.json()},
            "next_command": command,
        },
        table,
        f"\nThe agent is {result.agent}. Evaluate it on other worlds:\n  {command}",
    )
    _end(out, result)


def _end(out: Out, result: training.TrainResult) -> None:
    """Print how the training ended, and the folder of the run; if it was interrupted, exit with status 130."""
    if result.status == "interrupted":
        left = f"the policy so far is saved; continue with: ethbrake train --resume {result.directory}"
        out.interrupted(f"interrupted after {result.steps:,} training steps; {left}")
    out.note(f"{result.status} after {result.steps:,} training steps: {result.directory}")
