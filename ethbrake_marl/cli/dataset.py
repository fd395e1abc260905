"""The command ``ethbrake dataset``: agents in a list of worlds, step by step, as Parquet or for Minari."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ethbrake_marl.cli.late import LATE
from ethbrake_marl.cli.options import ForceOption, ScenarioOption, SetOption, UncertaintyOption, VehicleOption
from ethbrake_marl.cli.terminal import interruptible, progress_bars, say
from ethbrake_marl.defaults import LIST_SEED, DatasetFormat, HarmCount
from ethbrake_marl.errors import count_of

if TYPE_CHECKING or LATE:
    from ethbrake_marl.evaluation.dataset import DatasetSummary, check_dataset, write_dataset
    from ethbrake_marl.evaluation.inputs import check_agents, load_evaluated, make_lineup
    from ethbrake_marl.learning.recipe import read_settings
    from ethbrake_marl.shield.uncertainty import parse_uncertainty


def dataset_command(
    output: Annotated[Path, typer.Option("--output", metavar="FILE.parquet|NAME-v0", help="The dataset to write.")],
    agents: Annotated[
        str, typer.Option(metavar="A,B,...", help="Who drives, each in every world; as in `ethbrake evaluate`.")
    ] = "best_harm",
    scenario: ScenarioOption = "paper-random",
    episodes: Annotated[int, typer.Option(help="Worlds of the list.", min=1)] = 1_000,
    seed: Annotated[int, typer.Option(help="Seed of the list.", min=0)] = LIST_SEED,
    format: Annotated[
        DatasetFormat | None, typer.Option(help="Of the dataset.", show_default="as the name of --output says")
    ] = None,
    vehicle: VehicleOption = None,
    harm_count: Annotated[
        HarmCount, typer.Option(help="Harm that agents minimise, and the reward counts: first impacts only, or all.")
    ] = "first",
    uncertainty: UncertaintyOption = None,
    settings: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Record what agents see, do and are rewarded with, decision by decision.

    As one Parquet file of any agents and learners, or as a dataset of Minari of one learner. The recorded actions
    replay to the same bits.
    """
    chosen = load_evaluated(scenario, vehicle, read_settings(settings).scenario)
    kind = check_dataset(output, chosen, format, force=force)
    intervals = None if uncertainty is None else parse_uncertainty(uncertainty)
    lineup = make_lineup(agents.split(","), chosen, harm_count=harm_count, uncertainty=intervals)
    check_agents(lineup, chosen.sample(1, seed).worlds, chosen)
    with interruptible("nothing was written"), progress_bars() as bars:
        summary = write_dataset(
            output,
            lineup,
            scenario=chosen,
            episodes=episodes,
            seed=seed,
            format=kind,
            reward="harm" if harm_count == "first" else "total-harm",
            force=force,
            on_progress=lambda agent, done: bars.show(agent, done, episodes),
        )
    tell_dataset(summary)


def tell_dataset(summary: DatasetSummary) -> None:
    """Say what was written, how it is loaded, and what rounding to actions changed."""
    for agent, number in summary.episodes.items():
        change = f"harm differs from `ethbrake evaluate` by at most {summary.off_by[agent]:.2g} m2/s2 in a world"
        say(f"{agent}: {count_of(number, 'episode')}; {change}")
    for left in summary.left_out:
        say(f"left out: world {left.world} with {left.agent}: {left.reason}")
    say(f"dataset: {summary.path}, {count_of(summary.decisions, 'decision')}")
    if summary.format == "minari":
        say(
            f"load it: MINARI_DATASETS_PATH={summary.path.resolve().parent}, minari.load_dataset({summary.path.name!r})"
        )
