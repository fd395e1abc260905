"""The group of commands ``study``, and its command ``study falsify``, which searches for an agent's worst worlds."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SettingsOption, example
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.first_edition import evaluation, training
from ethbrake_marl.first_edition.training.commands import read_task

REMAINS = "the same command continues the work in this folder"

ROUNDING = 1e-6  # m2/s2

FolderOption = Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for all results.")]

study_group = typer.Typer(
    rich_markup_mode=None,
    add_completion=False,
    help="Compare many policies; search for an agent's worst worlds.",
    epilog=example(
        "study falsify --agent ppo --output worst.yaml", "study ablate --quick --output runs/ablation-quick"
    ),
)


@study_group.callback()
def _group() -> None:
    """Make this app a group of commands although it has only one; other extensions add theirs."""


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

    from ethbrake_marl.extensions.studies.named_worlds import NamedWorlds
    from ethbrake_marl.extensions.studies.weakness import Measure
    from ethbrake_marl.first_edition.agents.spec import parse_spec
    from ethbrake_marl.first_edition.scenario.sample import Sample

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
