"""The commands ``study sweep`` and ``study tune`` for many training runs, and ``study falsify`` for many worlds."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ethbrake_marl import evaluation, training
from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SettingsOption, example, schema_option
from ethbrake_marl.cli.evaluate import read_task
from ethbrake_marl.errors import InvalidInput, count_of, need
from ethbrake_marl.files.sheet import Sheet

REMAINS = "the same command continues the work in this folder"

ROUNDING = 1e-6  # m2/s2

MOST_WORKERS = 4096

FolderOption = Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")]

RetriesOption = Annotated[
    int, typer.Option(help="Number of further attempts if the process of a training run dies.", min=0, max=100)
]

DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Print the planned training runs, and start none.")]

ClusterOption = Annotated[
    str,
    typer.Option(metavar="local|ADDRESS", help="local: start Ray on this machine; ADDRESS: use a running Ray cluster."),
]

study_group = typer.Typer(
    rich_markup_mode=None,
    add_completion=False,
    help="Compare many policies; search for an agent's worst worlds.",
    epilog=example("study sweep sweep.yaml --output runs/sweep", "study ablate --quick --output runs/ablation-quick"),
)


@study_group.command("sweep", epilog=example("study sweep sweep.yaml --output runs/sweep"))
def sweep_command(
    file: Annotated[
        Path, typer.Argument(metavar="SWEEP.yaml", help="File with the list or grid of jobs (training runs).")
    ],
    output: FolderOption,
    jobs: Annotated[
        int | None,
        typer.Option(
            help="Number of jobs that run at once, each in one process with one thread.",
            show_default="one for each core",
            min=1,
            max=MOST_WORKERS,
        ),
    ] = None,
    ray: ClusterOption = "local",
    retries: RetriesOption = 2,
    dry_run: DryRunOption = False,
    schema: schema_option("ethbrake_marl.extensions.studies.sweep", "SweepPlan", "sweep") = False,  # type: ignore[valid-type]  # made here
    as_json: JsonOption = False,
) -> None:
    """Do the training runs in a file, and write a table of results.

    After an interruption, the same command continues: finished jobs are not trained again, and unfinished jobs continue
    from their last checkpoint. If a job failed, the exit status is 1, and failures.csv says why.
    """
    with Out(as_json=as_json, remains=REMAINS) as out:
        from ethbrake_marl.extensions.studies.sweep import SweepPlan

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
        summary = f"{result.finished:,} of {result.jobs:,} jobs finished; table: {result.table}"
        if result.failed:
            summary += f"; {result.failed:,} failed, for the reasons in {output / 'failures.csv'}"
        _end_study(out, summary, interrupted=result.interrupted, failed=result.failed > 0)


@study_group.command(
    "tune", epilog=example("study tune tuning.yaml --output runs/tuning --trials 30 --export best.yaml")
)
def tune_command(
    file: Annotated[
        Path,
        typer.Argument(metavar="TUNING.yaml", help="File that describes a training run and the settings to search."),
    ],
    output: FolderOption,
    trials: Annotated[
        int,
        typer.Option(help="Total number of trials in the folder, trials of earlier runs included.", min=1, max=10_000),
    ] = 30,
    jobs: Annotated[
        int,
        typer.Option(
            help="Number of trials that run at once, one process each. This number changes which values are tried.",
            min=1,
            max=MOST_WORKERS,
        ),
    ] = 1,
    ray: ClusterOption = "local",
    retries: RetriesOption = 2,
    export: Annotated[
        Path | None,
        typer.Option(metavar="NAME.yaml", help="File to write: a recipe with the settings of the best trial."),
    ] = None,
    dry_run: DryRunOption = False,
    schema: schema_option("ethbrake_marl.extensions.studies.tuning", "TuningPlan", "tuning") = False,  # type: ignore[valid-type]  # made here
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Search for the best settings of a training recipe.

    A trial is one training run. The harm of a trial is measured on the list of worlds that FILE describes. After an
    interruption, the same command continues: finished trials are not trained again, and unfinished trials continue. The
    exit status is 1 if no trial has finished.
    """
    with Out(as_json=as_json, force=force, remains=REMAINS) as out:
        need("optuna")
        from ethbrake_marl.extensions.studies.tuning import TuningPlan

        plan = TuningPlan.read(file)
        plan.folder(output).check()
        if export is not None:  # raise now what would be raised at the end
            if export.suffix != ".yaml":
                raise InvalidInput(f"--export {export}: the file name of a recipe must end in .yaml")
            plan.best_recipe({}, export, "")
            out.force = out.force or plan.has_exported(output, export)  # the same command may continue
            out.check(export)
        if dry_run:
            own = plan.own_values()
            space = {key: dimension.model_dump(mode="json") for key, dimension in plan.file.search.items()}
            now = {
                key: "the ranges exclude the recipe's own values" if own is None else f"the recipe has {own[key]}"
                for key in space
            }
            started, steps, example = len(plan.proposals(output)), plan.recipe.total_steps, plan.example()
            out.result(
                {
                    **{"search": space, "own_values": own, "trials": trials, "begun": started, "total_steps": steps},
                    **{"scenario": plan.file.scenario, "recipe": plan.file.recipe, "example": example},
                },
                f"{count_of(trials, 'trial')} ({started:,} of them begun): recipe {plan.file.recipe} in scenario"
                f" {plan.file.scenario}; {steps:,} decisions per trial that is not pruned",
                *(f"{key}  {dimension}  ({now[key]})" for key, dimension in plan.file.search.items()),
                f"{'the first trial' if own else 'example of a trial'}: {example}",
            )
            return
        need("ray")
        result = plan.run(output, trials, jobs=jobs, ray=ray, retries=retries, tell=out.show_progress)
        counted = ", ".join(f"{number:,} {state}" for state, number in sorted(result.counts.items()))
        summary, best, shown, lines = f"trials: {counted or 'none'}; table: {result.table}", result.best, None, []
        export = None if best is None or result.interrupted else export  # an interrupted tuning exports at its end
        if best is not None:
            measure = training.RunDirectory.chosen_by([best.figures], plan.recipe.reward.harm_count)
            shown = {"trial": best.number, "measure": measure, "harm": best.harm, "values": best.values}
            unit = "" if measure == training.RunDirectory.OBJECTIVE else " m²/s²"  # objectives have different units
            lines = [f"best: trial {best.number}, {measure} {best.harm:.4f}{unit}"]
            lines += [f"  {key} = {value}" for key, value in best.values.items()]
            if export is not None:
                source = f"trial {best.number}, {best.harm!r} on the list of seed {plan.file.measure.seed}"
                out.write(export, plan.best_recipe(best.values, export, f"ethbrake study tune: {source}"))
                summary += f"; recipe: {export}"
        best_row = {
            "best": shown,
            "trials": result.counts,
            "interrupted": result.interrupted,
            "table": str(result.table),
            "exported": None if export is None else str(export),
        }
        out.result(best_row, *lines)
        _end_study(out, summary, interrupted=result.interrupted, failed=best is None)


def _end_study(out: Out, summary: str, *, interrupted: bool, failed: bool) -> None:
    """Print ``summary``, and exit with status 130 if the study was interrupted, 1 if it failed, else 0."""
    if interrupted:
        out.interrupted(f"interrupted; {summary}; {REMAINS}")
    out.note(summary)
    if failed:
        raise typer.Exit(1)


@study_group.command("falsify", epilog=example("study falsify --agent ppo --against e_v2x_bm --output worst.yaml"))
def falsify_command(
    agent: Annotated[
        str | None,
        typer.Option(
            help="Agent whose worst worlds the command finds; any agent of `ethbrake evaluate`.",
            show_default="universal",
        ),
    ] = None,
    measure: Annotated[
        str | None,
        typer.Option(
            metavar="harm|regret|difference|bound",
            help="Measure of how bad a world is; the search maximises it.",
            show_default="regret",
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            metavar="AGENT",
            help="Second agent, with which --agent is compared if --measure is regret or difference.",
            show_default="best_harm",
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|PATH", help="Scenario in which the command searches for worlds.", show_default="paper-random"
        ),
    ] = None,
    budget: Annotated[int | None, typer.Option(help="Number of worlds to try.", min=1, show_default="4000")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the search.", min=0, show_default="0")] = None,
    keep: Annotated[
        int | None, typer.Option(help="Largest number of worlds in the result.", min=1, max=1000, show_default="20")
    ] = None,
    settings: SettingsOption = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="File for the worst worlds; --again reads such a file.")
    ] = None,
    again: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.yaml",
            help="Do not search; evaluate again in the worlds of FILE.yaml, which an earlier search wrote (--output).",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Search a scenario for the worlds in which an agent does worst.

    --measure selects how a world is scored; the worst worlds have the largest scores. With harm, the score is the
    agent's harm. With regret, the score is the agent's harm minus the harm of --against (by default the best known
    commands). With difference, the score is the absolute difference between the harms of the agent and of --against.
    With bound, the score is the agent's harm minus the bound of its shield, so a score above 0 means that the bound is
    broken. With --again FILE, the agent that FILE names (or --agent) drives the worlds of FILE again. If the new score
    of at least one world is larger than its score in FILE, the exit status is 1.
    """
    with Out(as_json=as_json, force=force) as out:
        import numpy as np

        from ethbrake_marl.extensions.studies.machine import this_machine
        from ethbrake_marl.extensions.studies.named_worlds import NamedWorlds
        from ethbrake_marl.extensions.studies.weakness import Measure

        if again is not None:
            asked = {
                "--measure": measure, "--against": against, "--scenario": scenario, "--budget": budget, "--seed": seed,
                "--keep": keep, "--set": settings, "--output": output, "--force": force or None,
            }  # fmt: skip
            for option in (name for name, value in asked.items() if value is not None):
                raise InvalidInput(
                    f"{option} cannot be combined with --again, which takes the settings from its file; leave"
                    f" {option} out (only --agent may be given)"
                )
            _drive_again(out, again, agent)
            return
        agent, measure, scenario = agent or "universal", measure or "regret", scenario or "paper-random"
        budget, seed, keep = 4000 if budget is None else budget, seed or 0, keep or 20
        out.check(output, ".yaml", ".yml", what="worlds")
        task = read_task(scenario, settings)
        chosen = task.scenario
        measured_by = Measure.of(measure, agent, against, chosen, task.harm_count)
        evaluation.check_agents(measured_by.agents, chosen.replace(early_impacts="keep").sample(1, seed).worlds, chosen)
        worst = measured_by.falsify(
            budget, seed, most=keep, on_round=lambda done, total: out.progress(agent, done, total)
        )
        worlds, good = worst.worlds, worst.scores[np.isfinite(worst.scores)]
        content: dict[str, Any] = {
            "tried": budget,
            "counted": len(good),
            "share_above_zero": worst.share_above,
            "first_above_zero": worst.first_above,
            "median": float(np.median(good)),
            "worst": float(good.max()),
            "machine": asdict(this_machine()),
            "worlds": [world.model_dump(exclude_none=True) for world in worlds],
        }
        first, shown = worst.first_above, []
        left_out = f" ({budget - len(good):,} of them rejected by the scenario)" if len(good) < budget else ""
        summary = (
            f"{chosen.name}: {budget:,} worlds tried{left_out}; {measure} in m2/s2, {task.harm_count} count: worst"
            f" {content['worst']:.4g}, median {content['median']:.4g}; above 0 in {100 * worst.share_above:.1f} % of"
            f" the worlds, {f'first in world {first:,}' if first else 'so in no world'}."
            " The search prefers bad worlds, so these numbers are no estimates for random worlds."
        )
        if worlds:
            named = NamedWorlds.of(
                measured_by.scenario,
                scenario=scenario,
                settings=[each.text for each in training.read_settings(settings, of_agents=("harm_count",)).scenario],
                agent=agent,
                measure=measure,
                against=against,
                harm_count=task.harm_count,
                found_by=_spelled(
                    agent=agent, measure=measure, against=against, scenario=scenario, budget=budget, seed=seed,
                    keep=keep, set=tuple(settings or ()),
                ),
                worlds=worlds,
            )  # fmt: skip
            content |= named.model_dump(exclude_none=True)
            beside = {"harm": [], "bound": ["Bound"]}.get(measure, ["Harm of --against"])
            columns = ("World", measure.capitalize(), "Harm", *beside, "State")
            rows = []
            for world in worlds:
                reference = [] if world.reference is None else [f"{world.reference:.2f}"]
                state = ", ".join(f"{name} {value:.4g}" for name, value in world.state.items())
                rows.append((world.name, f"{world.score:.4g}", f"{world.harm:.2f}", *reference, state))
            shown.append(Sheet("", columns, rows, gap=2))
            if output is not None:
                out.write(output, named.text, what="the worlds")
        elif output is not None:
            out.note(f"no world has a score above 0, so {output} was not written")
        out.result({**content, "versions": evaluation.result_versions()}, *shown, summary)


def _spelled(**options: Any) -> str:
    """Return the command line ``ethbrake study falsify`` with these options.

    Options with the value None are omitted. An option whose value is a tuple is repeated for each element.
    """
    words = ["ethbrake", "study", "falsify"]
    for option, value in options.items():
        if value is not None:
            for each in value if isinstance(value, tuple) else (value,):
                words += [f"--{option}", str(each)]
    return shlex.join(words)


def _drive_again(out: Out, file: Path, agent: str | None) -> None:
    """Let an agent drive the worlds in a file of ``study falsify``, and compare the scores with those in the file.

    If ``agent`` is None, the agent that the file names drives. The exit status is 1 if the new score of at least one
    world is larger than its score in the file, or if the agent cannot drive at least one world.
    """
    import numpy as np

    from ethbrake_marl.agents.spec import parse_spec
    from ethbrake_marl.extensions.studies.named_worlds import NamedWorlds
    from ethbrake_marl.extensions.studies.weakness import Measure
    from ethbrake_marl.scenario.sample import Sample

    named = NamedWorlds.read(file)
    for spec in (*([named.agent] if agent is None else []), *([named.against] if named.against else [])):
        if (code := parse_spec(spec).file) is not None:
            raise InvalidInput(
                f"{file}: the file names the agent {spec!r}, whose code is in {code[0]}; for safety, this"
                " command does not run code that only a file names; give the agent with --agent, or change the key"
                " 'against' in the file"
            )
    chosen = evaluation.load_runnable(named.scenario, training.read_settings(named.settings).scenario, drives="some")
    measured_by = Measure.of(named.measure, agent or named.agent, named.against, chosen, named.harm_count)
    worlds = named.worlds_of(chosen, str(file))
    measured = measured_by(Sample(worlds, np.arange(worlds.n, dtype=np.int64), 0))
    rows = [
        {
            "name": world.name,
            "before": world.score,
            "now": float(now) if np.isfinite(now) else None,
            "worse": not np.isfinite(now) or bool(now > world.score + ROUNDING),
        }
        for world, now in zip(named.worlds, measured.score, strict=True)
    ]
    shown = [
        (
            *(row["name"], f"{row['before']:.4f}"),
            "could not be driven" if row["now"] is None else f"{row['now']:.4f}",
            "worse" if row["worse"] else "",
        )
        for row in rows
    ]
    sheet = Sheet("", ("World", f"{named.measure.capitalize()} before", "Now", ""), shown, gap=2)
    out.result({"agent": agent or named.agent, "measure": named.measure, "worlds": rows}, sheet)
    worse = sum(bool(row["worse"]) for row in rows)
    out.note(f"{file}: {agent or named.agent} is worse in {worse} of {count_of(len(rows), 'world')}")
    if worse:
        raise typer.Exit(1)
