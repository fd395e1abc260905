"""The group of commands ``study``, and its command ``study falsify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, ScenarioOption, SettingsOption, example
from ethbrake_marl.files.sheet import Sheet, csv_text

study_group = typer.Typer(
    rich_markup_mode=None,
    add_completion=False,
    help="Compare many policies; search for an agent's worst worlds.",
    epilog=example("study falsify --agent ppo --output worst.csv", "study ablate --quick --output runs/ablation-quick"),
)


@study_group.callback()
def _group() -> None:
    """Make ``study`` a group of commands although this app has only one; other extensions add theirs."""


@study_group.command("falsify", epilog=example("study falsify --agent ppo --against e_v2x_bm --output worst.csv"))
def falsify_command(
    agent: Annotated[
        str, typer.Option(help="Agent whose worst worlds the command finds; any agent of `ethbrake evaluate`.")
    ] = "universal",
    measure: Annotated[
        str, typer.Option(metavar="harm|regret|bound", help="How bad a world is; the search maximises it.")
    ] = "regret",
    against: Annotated[
        str | None,
        typer.Option(
            metavar="AGENT", help="Agent with which --measure regret compares --agent.", show_default="best_harm"
        ),
    ] = None,
    scenario: ScenarioOption = "paper-random",
    budget: Annotated[int, typer.Option(help="Number of worlds to try.", min=1)] = 4000,
    seed: Annotated[int, typer.Option(help="Seed of the search.", min=0)] = 0,
    keep: Annotated[int, typer.Option(help="Largest number of worlds in the result.", min=1)] = 20,
    settings: SettingsOption = None,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="File for the worst worlds, as eb.read_worlds reads it.")
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Search a scenario for the worlds in which an agent does worst.

    --measure says how a world is scored; the worst worlds have the largest scores. With harm, the score is the agent's
    harm. With regret, it is the agent's harm minus the harm of --against (by default the best known commands). With
    bound, it is the agent's harm minus the bound of its shield, so a score above 0 means that the bound is broken.
    """
    with Out(as_json=as_json, force=force) as out:
        import numpy as np

        from ethbrake_marl.cli.settings import read_settings
        from ethbrake_marl.evaluation.provenance import about_scenario, versions
        from ethbrake_marl.extensions.studies.machine import this_machine
        from ethbrake_marl.extensions.studies.weakness import WeaknessMeasure, states_of

        out.check(output, ".csv", what="worlds")
        chosen = read_settings(settings, of_command=("harm_count",))
        count = chosen.command.get("harm_count", "first")
        weakness = WeaknessMeasure.of(measure, agent, against, chosen.change_scenario(scenario), count)
        worlds, measured, scores = weakness.falsify(
            budget, seed, most=keep, on_round=lambda world_count: out.progress(agent, world_count, budget)
        )
        states, good = states_of(worlds, weakness.scenario), scores[np.isfinite(scores)]
        columns = {name: values.tolist() for name, values in measured._asdict().items() if values is not None}
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        share = float((good > 0.0).mean())
        if output is not None and rows:
            out.write(output, csv_text(states), what="the worlds")
        elif output is not None:
            out.note(f"no world has a score above 0, so {output} was not written")
        content = {
            "agent": agent,
            "measure": measure,
            "against": against,
            "harm_count": count,
            "scenario": weakness.scenario.name,
            "settings": list(chosen.texts),
            **about_scenario(weakness.scenario, seed),
            "tried": budget,
            "counted": len(good),
            "share_above_zero": share,
            "median": float(np.median(good)),
            "worst": float(good.max()),
            "worlds": [{**row, "state": state} for row, state in zip(rows, states, strict=True)],
            "machine": this_machine(),
            "versions": versions(),
        }
        sheet_rows = [
            (f"{row['score']:.4g}", f"{row['harm']:.2f}", ", ".join(f"{key} {state[key]:.4g}" for key in state))
            for row, state in zip(rows, states, strict=True)
        ]
        left_out = f" ({budget - len(good):,} of them rejected by the scenario)" if len(good) < budget else ""
        out.result(
            content,
            *([Sheet("", (measure.capitalize(), "Harm", "State"), sheet_rows, gap=2)] if rows else []),
            f"{weakness.scenario.name}: {budget:,} worlds tried{left_out}; {measure} in m2/s2, {count} count: worst"
            f" {content['worst']:.4g}, median {content['median']:.4g}; above 0 in {100 * share:.1f} % of the worlds."
            " The search prefers bad worlds, so these numbers are no estimates for random worlds.",
        )
