"""The commands ``scenario ...``, which list, show, check and write scenarios, and draw worlds."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SeedOption, SettingsOption, example
from ethbrake_marl.cli.pages import page_function
from ethbrake_marl.files.sheet import Sheet

if TYPE_CHECKING:
    from ethbrake_marl.cli.trial import Trial
    from ethbrake_marl.worlds.scenario import Scenario

TABLE_WORLDS, PICTURE_WORLDS = 10, 1000  # worlds that `scenario sample` draws for a table and for a picture

NameArgument = Annotated[
    str, typer.Argument(metavar="NAME|PATH", help="Name of a shipped or registered scenario, or path of a YAML file.")
]

scenario_group = typer.Typer(
    help="List, check and create scenarios, and draw worlds.",
    epilog=example("scenario show paper-random", "scenario sample paper-random --episodes 10 --output worlds.csv"),
)


@scenario_group.command("list", epilog=example("scenario list"))
def scenario_list(as_json: JsonOption = False) -> None:
    """List the shipped and registered scenarios."""
    from ethbrake_marl.worlds.catalogue import list_scenarios

    with Out(as_json=as_json) as out:
        entries = list_scenarios()
        width = max(len(entry.name) for entry in entries)
        out.result(
            [{"name": e.name, "title": e.title, "path": str(e.path), "origin": e.origin} for e in entries],
            *(f"{e.name:{width}}  {e.title}{'' if e.shipped else f'  (from {e.origin})'}" for e in entries),
        )


@scenario_group.command("show", epilog=example("scenario show paper-random"))
def scenario_show(scenario: NameArgument) -> None:
    """Print the YAML file of a scenario, with all values.

    A file that is based on another scenario is printed without its comments.
    """
    from ethbrake_marl.worlds.scenario_file import whole_text

    with Out() as out:
        out.show(whole_text(scenario), end="")


@scenario_group.command("validate", epilog=example("scenario validate my-scenario.yaml"))
def scenario_validate(path: NameArgument, as_json: JsonOption = False) -> None:
    """Check a scenario, and try it in 200 worlds.

    Simulates the first 200 worlds of the evaluation list. Shows the range of each quantity in these worlds, whom each
    learner knows, and whether there is anything to learn: the harm of full braking, of the best constant deceleration,
    and of the best known commands.
    """
    from ethbrake_marl.cli.trial import try_scenario
    from ethbrake_marl.worlds.catalogue import load_scenario

    with Out(as_json=as_json) as out:
        scenario = load_scenario(path)
        trial = try_scenario(scenario)
        out.result(_trial_content(scenario, trial), *_trial_lines(scenario, trial))


def _trial_content(scenario: Scenario, trial: Trial) -> dict[str, Any]:
    return {
        "name": scenario.name,
        "vehicles": scenario.vehicles,
        "learners": [scenario.vehicle_names[body - 1] for body in scenario.learners],
        "worlds": trial.drawn.worlds.n,
        "rejected": trial.drawn.rejected,
        "early_impacts": trial.early,
        "moving_at_horizon": trial.moving,
        "vehicle_1_late": trial.late,
        "known": trial.known,
        "harm": trial.harm,
        "refused_by": trial.refused,
        "quantities": _ranges(trial),
        "kinds": {name: dict(Counter(column.tolist())) for name, column in _kinds(trial).items()},
    }


def _trial_lines(scenario: Scenario, trial: Trial) -> Iterator[str]:
    from ethbrake_marl.episode.counts import HarmCount

    n, ranges = trial.drawn.worlds.n, _ranges(trial)
    learners = ", ".join(trial.known) or "none"
    yield f"OK  {scenario.name}: {scenario.vehicles} vehicles, learners: {learners}; tried in {n} worlds"
    for name, column in _kinds(trial).items():
        counts = ", ".join(f"{kind or 'no type'} {count}" for kind, count in sorted(Counter(column.tolist()).items()))
        yield from _fold(f"{name}: {counts}", 2)
    varying = {name: extent for name, extent in ranges.items() if extent["least"] != extent["largest"]}
    width = max(map(len, varying), default=0)
    if varying:
        yield f"{'drawn':{width}} {'least':>8} {'median':>8} {'largest':>8}"
    for name, extent in varying.items():
        yield f"{name:{width}}" + "".join(f" {value:>8.4g}" for value in extent.values())
    same = [f"{name} {extent['least']:g}" for name, extent in ranges.items() if name not in varying]
    yield from _fold(f"the same in all worlds: {'; '.join(same) or 'nothing'}", 20)
    rejected = trial.drawn.rejected
    yield (
        f"early impacts: {_share(rejected, rejected + n, 'draws')} rejected, {_share(trial.early, n)} kept"
        if rejected or trial.early
        else "early impacts: none"
    )
    if trial.late and scenario.alert_s is None:
        yield f"Vehicle 1, whose braking is the alert, has a latency above 0 in {_share(trial.late, n)}"
    yield f"at the horizon ({scenario.horizon_s:g} s) some vehicle still moves in {_share(trial.moving, n)}"
    if trial.moving:
        yield "  later impacts are not counted unless you raise horizon_s"
    for learner, shares in trial.known.items():
        knowledge = ", ".join(f"{name} in {100.0 * share:.1f} %" for name, share in shares.items())
        yield from _fold(f"{learner} knows when it can first act: {knowledge} of the worlds", 4)
    for what, harm in trial.harm.items():
        means = ", ".join(f"{HarmCount.of(name).words} {mean:.2f}" for name, mean in harm.items())
        yield from _fold(f"means, {what}: {means}", 3)
    for spec, why in trial.refused.items():
        yield from _fold(f"{spec} cannot drive here: {why}", 3)
    costs = [harm[trial.harm_count.name] for harm in trial.harm.values()]
    if len(costs) > 1 and costs[0] - min(costs) <= 0.02 * costs[0]:
        yield f"there is hardly anything to learn: nothing tried saves 2 % of full braking's {trial.harm_count.words}"


def _ranges(trial: Trial) -> dict[str, dict[str, float]]:
    import numpy as np

    from ethbrake_marl.worlds.describe import quantities_of

    return {
        name: dict(zip(("least", "median", "largest"), np.nanquantile(column, (0.0, 0.5, 1.0)).tolist(), strict=True))
        for name, column in quantities_of(trial.drawn.worlds, trial.drawn.road).items()
        if not np.isnan(column).all()
    }


def _kinds(trial: Trial) -> dict[str, Any]:
    from ethbrake_marl.worlds.describe import kinds_of

    return kinds_of(trial.drawn)


def _fold(text: str, most: int) -> list[str]:
    return textwrap.wrap(text, 80, max_lines=most, placeholder=" ...", break_on_hyphens=False)


def _share(part: int, total: int, things: str = "worlds") -> str:
    return f"{part:,} of {total:,} {things} ({100.0 * part / total:.1f} %)"


@scenario_group.command("new", epilog=example("scenario new my-scenario --based-on paper-distance"))
def scenario_new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the new scenario; its file is NAME.yaml.")],
    based_on: Annotated[
        str, typer.Option(metavar="NAME|PATH", help="Scenario from which the new scenario takes its values.")
    ] = "paper-random",
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the new scenario file.")] = Path(),
    force: ForceOption = False,
) -> None:
    """Write a new scenario file that is based on another one.

    The file is NAME.yaml. All other keys stand there as comments with their values.
    """
    from ethbrake_marl.worlds.scenario_file import new_scenario_text

    with Out(force=force) as out:
        file = output / f"{name}.yaml"
        text = new_scenario_text(name, based_on, folder=output)
        out.check(file)
        out.write(file, text)
        out.note(f"written: {file}; change the file, then run: ethbrake scenario validate {file}")


@scenario_group.command("parts", epilog=example("scenario parts"))
def scenario_parts(as_json: JsonOption = False) -> None:
    """List the names that scenarios, recipes and --set can use.

    Lists features of observations, V2X presets, objectives, terms of rewards, measures beside the usual ones, training
    algorithms and recipes.
    """
    from ethbrake_marl.episode.counts import COUNTS
    from ethbrake_marl.episode.features import FEATURES, GROUPS, WHOLE_GROUPS
    from ethbrake_marl.episode.objectives import OBJECTIVES
    from ethbrake_marl.episode.terms import BUILT_IN, TERMS
    from ethbrake_marl.evaluation.measure_registry import MEASURES
    from ethbrake_marl.evaluation.measures import DEFAULT
    from ethbrake_marl.training.recipe import ALGORITHMS, usable_recipes
    from ethbrake_marl.worlds.channel import PRESETS

    features = FEATURES.usable().items()
    usual = {measure.name for measure in DEFAULT}
    feature_names = [name if entry.of == "own" else f"front_K.{name}, rear_K.{name}" for name, entry in features]
    parts = {
        "Observation": [*WHOLE_GROUPS, "front_K", "rear_K", *GROUPS, *feature_names],
        "V2X presets": [*PRESETS],
        "Objectives": [kind.form for kind in OBJECTIVES.usable().values()],
        "Terms": [*BUILT_IN, *TERMS],
        "Counts of harm": [*COUNTS],
        "Measures": [name for name in MEASURES if name not in usual],
        "Algorithms": [*ALGORITHMS],
        "Recipes": [*usable_recipes()],
    }
    with Out(as_json=as_json) as out:
        out.result(
            parts, Sheet("", ("What", "Names"), [(what, ", ".join(names)) for what, names in parts.items()], gap=2)
        )


@scenario_group.command("schema", epilog=example("scenario schema > scenario.schema.json"))
def scenario_schema() -> None:
    """Print the JSON Schema of scenario files.

    Editors complete and check YAML with it.
    """
    from ethbrake_marl.worlds.scenario_file import scenario_json_schema

    with Out() as out:
        out.print_json(scenario_json_schema())


@scenario_group.command("sample", epilog=example("scenario sample paper-random --output worlds.png"))
def scenario_sample(
    scenario: NameArgument,
    episodes: Annotated[
        int | None,
        typer.Option(
            help="Number of worlds in the evaluation list.",
            show_default=f"{TABLE_WORLDS}, for a picture {PICTURE_WORLDS}",
        ),
    ] = None,
    seed: SeedOption = 7,
    settings: SettingsOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File for the table (.csv) or the picture (.png, .svg or .pdf).", show_default="stdout"
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw worlds, and show them as a table or picture.

    The table has a column for each quantity that is not fixed in the scenario; `eb.read_worlds` reads it. The picture
    shows the distributions of quantities, scatter plots of pairs of quantities, and three worlds. The same scenario,
    seed and number of worlds give the same worlds on every machine.
    """
    from ethbrake_marl.cli.settings import read_settings
    from ethbrake_marl.worlds.describe import fixed_columns, quantities_of

    with Out(as_json=as_json, force=force) as out:
        out.check(output, ".csv", ".png", ".svg", ".pdf", what="worlds")
        chosen = read_settings(settings).change_scenario(scenario)
        picture_file = None if output is None or output.suffix.lower() == ".csv" else output
        usual = TABLE_WORLDS if picture_file is None else PICTURE_WORLDS
        n = usual if episodes is None else episodes
        draw = chosen.draw(n, seed)
        quantities, fixed = quantities_of(draw.worlds, draw.road), fixed_columns(chosen)
        columns = {name: column.tolist() for name, column in quantities.items() if name not in fixed}
        states = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        states = [{name: None if value != value else value for name, value in row.items()} for row in states]
        cells = (("" if value is None else repr(value) for value in row.values()) for row in states)
        lines = [",".join(columns), *map(",".join, cells)]
        if picture_file is not None:
            draw_worlds = page_function("worlds", f"--output {picture_file.name}")
            with out.writing():
                draw_worlds(picture_file, chosen, n, seed=seed, force=out.force)
                out.note(f"picture: {picture_file}")
        elif output is not None:
            with out.writing():
                out.write(output, "\n".join([*lines, ""]), what="worlds")
        if output is None or out.as_json:
            out.result(states, *lines, in_file=output is not None)
