"""The commands that train: ``run`` and ``train``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl import evaluation, scenario as scenarios, training
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
from ethbrake_marl.progress import Progress

REMAINS = (
    "if the training had begun, the run's folder keeps the last good policy; ethbrake train --resume FOLDER goes on"
    " with a training that has not finished"
)

RUNS = Path("runs")

QUICKEST = ("quick", "ppo")  # what `ethbrake run` trains: the first whose algorithm is installed

QUICKEST_TEAM = ("cooperation", "cooperation-ppo")  # likewise with several learners

TrainingSeedOption = Annotated[int | None, typer.Option(help="Seed of the training.", show_default="the recipe's")]

OutputOption = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="Folder of the run.", show_default="runs/SCENARIO-RECIPE-seedSEED")
]


def run_folder(scenario: scenarios.Scenario, recipe: training.TrainingRecipe, seed: int | None) -> Path:
    """Return the default folder of a run: ``runs/SCENARIO-RECIPE-seedSEED``.

    If the recipe names a scheme for several learners, it follows the recipe's name. ``seed`` None: the recipe's seed.
    """
    plan = recipe.name if recipe.scheme is None else f"{recipe.name}-{recipe.scheme}"
    return RUNS / f"{scenario.name}-{plan}-seed{recipe.seed if seed is None else seed}"


def run_command(
    scenario: ScenarioOption = "paper-random",
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    episodes: Annotated[int, typer.Option(help="Worlds of the evaluation list.")] = 10_000,
    list_seed: Annotated[int, typer.Option(help="Seed of the evaluation list.")] = 7,
    recipe: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="A shipped recipe, or a path to a YAML file.",
            show_default=f"{QUICKEST[0]}, of several learners {QUICKEST_TEAM[0]}; where no extension gives its"
            f" algorithm, {QUICKEST[1]} or {QUICKEST_TEAM[1]}",
        ),
    ] = None,
    settings: SettingsOption = None,
    output: OutputOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train one learner or a team, shield it, compare, and report.

    Writes the run's folder: policies, results as CSV and JSON, a row for every world, three figures and report.html.
    If the scenario is one of the three tests (paper-random, -brake-only, -obstacle), the other two are evaluated too.
    For a team, the report also shows who bears what, and what each learner and the messages add; this takes further
    trainings. Ctrl-C ends the training early and evaluates the policy so far; a second Ctrl-C stops at once.
    """
    with Out(as_json=as_json, force=force, remains=REMAINS) as out:
        # torch takes seconds to load, here and in the other commands that learn
        from ethbrake_marl.training.experiment import run_experiment
        from ethbrake_marl.training.progress import objective_in_words

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
        headline = (
            f"Trained by recipe {plan.name}, seed {plan.seed if seed is None else seed}: {trained.steps:,} decisions in"
            f" {trained.wall_s:.0f} s ({trained.status}). hybrid is the trained {what} behind its shield. All minimise"
            f" {count} harm{f', but what is trained minimises {own}' if own else ''}.\n"
        )
        out.result(result.results, Text(headline), *result.tables)
        for note in result.notes:
            out.note(note)
        if result.interrupted:
            out.interrupted(f"interrupted: {result.interrupted}; the report is without it: {trained.directory}")
        _end(out, trained)


def quickest(*, several: bool = False) -> str:
    """Return the name of the recipe that `ethbrake run` trains by default; ``several``: with several learners."""
    usable = training.TrainingRecipe.usable()
    return next(name for name in (QUICKEST_TEAM if several else QUICKEST) if name in usable)


def train_command(
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH",
            help="A shipped or registered scenario, or a path to a YAML file.",
            show_default="paper-random",
        ),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(metavar="NAME|PATH", help="A shipped recipe, or a path to a YAML file.", show_default="ppo"),
    ] = None,
    settings: SettingsOption = None,
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    output: OutputOption = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Go on with the training of this run's folder instead.")
    ] = None,
    other_versions: Annotated[
        bool,
        typer.Option(
            "--other-versions", help="With --resume: go on although other versions trained it; numbers may differ."
        ),
    ] = False,
    schema: schema_option("ethbrake_marl.training", "TrainingRecipe", "recipe") = False,  # type: ignore[valid-type]  # built by a function
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy, or the policies of several learners.

    Writes a run's folder, and ends with the harm of the trained agent beside full braking, the agent's name and the
    command that evaluates it. Ctrl-C ends the training after the current update and keeps the policy;
    `ethbrake train --resume FOLDER` continues: the final policy is the same, bit for bit, as without the stop.
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
                raise InvalidInput(f"{option}: --resume goes on with what the folder says; leave one of the two out")
            _show(out, training.resume(resume, on_progress=out.show_progress, other_versions=other_versions))
            return
        if other_versions:
            raise InvalidInput("--other-versions: a new training has the versions of now; give it with --resume FOLDER")
        plan = training.load_recipe(recipe or "ppo")
        changes = training.read_settings(settings, [plan])
        chosen = evaluation.load_runnable(scenario or "paper-random", changes.scenario)
        plan = changes.change(plan, out.note)
        begun = [training.Training.of(plan, chosen).who_drives()]

        def tell(progress: Progress) -> None:
            if begun:  # all input has been checked by now
                out.note(begun.pop())
            out.show_progress(progress)

        folder = output or run_folder(chosen, plan, seed)
        result = training.train(
            plan, chosen, folder, steps=steps, seed=seed, force=force, on_progress=tell, settings=changes.texts
        )
        _show(out, result, scenario)


def _show(out: Out, result: training.TrainResult, scenario: str | None = None) -> None:
    """Print the result of a training on stdout, beside full braking, and how it ended on stderr.

    ``scenario``: name or path from the command line; None: the name of the training's scenario.
    """
    from ethbrake_marl.training.fixed_list import measure_full_braking
    from ethbrake_marl.training.progress import objective_in_words

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
        f"Means per world; harm in m²/s². These are the {plan.evaluation.worlds:,} worlds of seed"
        f" {plan.evaluation.seed}, on which the training chose its policy."
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
    """Print how the training of ``result`` ended and where it is; if it was interrupted, exit with status 130."""
    if result.status == "interrupted":
        left = f"go on with: ethbrake train --resume {result.directory} (its policy is there)"
        out.interrupted(f"interrupted after {result.steps:,} training steps; {left}")
    out.note(f"{result.status} after {result.steps:,} training steps: {result.directory}")
