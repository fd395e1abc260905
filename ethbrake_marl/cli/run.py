"""The command ``run``."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.text import Text

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SettingsOption, StepsOption
from ethbrake_marl.cli.pages import PAGES
from ethbrake_marl.cli.train import (
    AFTER_STOPPED_TRAINING,
    OutputOption,
    TrainingScenarioOption,
    TrainingSeedOption,
    change_recipe,
    run_folder,
    tell_end,
)

QUICKEST = ("quick", "ppo")  # trains the first of these recipes whose algorithm is installed
QUICKEST_TEAM = ("cooperation", "cooperation-ppo")  # the same for scenarios with several learners


def experiment_command(
    scenario: TrainingScenarioOption = None,
    steps: StepsOption = None,
    seed: TrainingSeedOption = None,
    episodes: Annotated[int, typer.Option(help="Number of worlds in the evaluation list.", min=1)] = 10_000,
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

    Trains a single learner or a team. Writes a run's folder with policies, results, results per world, three figures
    and report.html. Without --scenario the recipe's own scenario is used: quick trains on the three tests together
    (mixture-three-tests). The policy is compared in the scenario, or in the first one of a recipe's mixture; if it is
    one of the three tests (paper-random, paper-random-brake-only, paper-random-obstacle), also in the other two. For a
    team, the report also shows the harm that each vehicle bears, and what each learner adds. All agents minimise the
    honest cost; with --set harm_count=first, first-impact harm, for which pushing is free. Ctrl-C ends the training
    early and evaluates the policy trained so far; a second Ctrl-C stops at once.
    """
    with Out(as_json=as_json, force=force, remains=AFTER_STOPPED_TRAINING) as out:
        from ethbrake_marl.agent_names import require_learner
        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.training.recipe import load_recipe
        from ethbrake_marl.training.training import check_new_run

        plan = load_recipe(recipe or quickest())
        changes = read_settings(settings, [*type(plan).model_fields])
        train_on = changes.change_scenario(scenario or plan.scenario or "paper-random")
        chosen = train_on.members[0] if scenario is None and train_on.members else train_on
        require_learner(chosen)
        if recipe is None and len(chosen.learners) > 1:
            plan = load_recipe(quickest(several=True))
            changes = read_settings(settings, [*type(plan).model_fields])
        plan = change_recipe(plan, changes.recipe)
        folder = output or run_folder(chosen.name, plan.name, plan.scheme, plan.seed if seed is None else seed)
        check_new_run(folder.expanduser(), force=force)
        from ethbrake_marl.training.experiment import (  # torch takes seconds to load
            HYBRID,
            POLICY,
            SHIELDED,
            run_experiment,
        )

        experiment, tables, where = run_experiment(
            plan,
            chosen,
            folder,
            train_on=train_on,
            steps=steps,
            seed=seed,
            episodes=episodes,
            list_seed=list_seed,
            force=force,
            settings=changes.texts,
            report=PAGES["run"]() if "run" in PAGES else None,
            on_progress=out.show_progress,
            on_unwritten=out.unwritten.append,
        )
        trained = experiment.trained
        objective = trained.training.objective
        single, harm = experiment.learned == POLICY, plan.reward.harm_count.words
        headline = (
            f"Trained on {trained.training.scenario.name} by recipe {plan.name}, seed {trained.training.recipe.seed}:"
            f" {trained.steps:,} decisions in {trained.wall_s:.0f} s ({trained.status})."
            f" {HYBRID if single else SHIELDED}: the"
            f" {experiment.learned}{'' if single else f' (scheme {trained.training.scheme})'} with a shield. All agents"
            f" minimise {harm}{f', except that the {experiment.learned} minimises {objective}' if objective else ''}.\n"
        )
        out.result(experiment.compared.table.to_json(), Text(headline), *tables, in_file=True)
        out.note(where)
        tell_end(out, trained.status, trained.steps, trained.directory)


def quickest(*, several: bool = False) -> str:
    from ethbrake_marl.training.recipe import usable_recipes

    return next(name for name in (QUICKEST_TEAM if several else QUICKEST) if name in usable_recipes())
