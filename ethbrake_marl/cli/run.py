"""The command ``run``."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, ScenarioOption, SettingsOption, StepsOption
from ethbrake_marl.cli.train import REMAINS, OutputOption, TrainingSeedOption, run_folder, tell_end
from ethbrake_marl.first_edition import evaluation, training

QUICKEST = ("quick", "ppo")  # trains the first of these recipes whose algorithm is installed
QUICKEST_TEAM = ("cooperation", "cooperation-ppo")  # the same for scenarios with several learners


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
            output or run_folder(chosen.name, plan.name, plan.scheme, plan.seed if seed is None else seed),
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
        tell_end(out, trained.status, trained.steps, trained.directory)


def quickest(*, several: bool = False) -> str:
    """Return the name of the default recipe of `ethbrake run`, for one learner or for ``several`` learners."""
    usable = training.TrainingRecipe.usable()
    return next(name for name in (QUICKEST_TEAM if several else QUICKEST) if name in usable)
