"""The commands ``scenario ...``, which list, show, check and write scenarios, and draw worlds."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SeedOption, SettingsOption, example
from ethbrake_marl.cli.pages import page_function
from ethbrake_marl.files.sheet import Column, Sheet

if TYPE_CHECKING:
    from ethbrake_marl.cli.trial import Trial
    from ethbrake_marl.worlds.scenario import Scenario

TABLE_WORLDS, PICTURE_WORLDS = 10, 1000  # worlds that `scenario sample` draws for a table and for a picture
SHOWN_KINDS = 6  # vehicle types, recordings and the like that `scenario validate` names

NameArgument = Annotated[
    str, typer.Argument(metavar="NAME|PATH", help="Name of a shipped or registered scenario, or path of a YAML file.")
]

scenario_group = typer.Typer(
    help="List, check and create scenarios, and draw worlds.",
    epilog=example("scenario show paper-random", "scenario sample paper-random --episodes 10 --output worlds.csv"),
)


@scenario_group.command("list", epilog=example("scenario list"))
def scenario_list(as_json: JsonOption = False) -> None:
    """List the scenarios, and the names that files can use.

    These names stand in scenarios, recipes and --set: features of observations, V2X presets, objectives, terms of
    rewards, counts of harm, measures beside the usual ones, training algorithms and recipes.
    """
    from ethbrake_marl.worlds.catalogue import list_scenarios

    with Out(as_json=as_json) as out:
        entries, parts = list_scenarios(), _parts()
        width = max(len(entry.name) for entry in entries)
        scenarios = [{"name": e.name, "title": e.title, "path": str(e.path), "origin": e.origin} for e in entries]
        rows = [(what, ", ".join(names)) for what, names in parts.items()]
        out.result(
            {"scenarios": scenarios, "parts": parts},
            *(f"{e.name:{width}}  {e.title}{'' if e.shipped else f'  (from {e.origin})'}" for e in entries),
            "",
            Sheet("", ("Names of", "in scenarios, recipes and --set"), rows, gap=2),
        )


def _parts() -> dict[str, list[str]]:
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
    return {
        "Observation": [*WHOLE_GROUPS, "front_K", "rear_K", *GROUPS, *feature_names],
        "V2X presets": [*PRESETS],
        "Objectives": [kind.form for kind in OBJECTIVES.usable().values()],
        "Terms": [*BUILT_IN, *TERMS],
        "Counts of harm": [*COUNTS],
        "Measures": [name for name in MEASURES if name not in usual],
        "Algorithms": [*ALGORITHMS],
        "Recipes": [*usable_recipes()],
    }


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
        content = _trial_content(scenario, trial)
        learners = ", ".join(trial.known) or "none"
        title = f"OK  {scenario.name}: {scenario.vehicles} vehicles, learners: {learners}; tried in {trial.n} worlds"
        out.result(content, title, _facts(scenario, trial, content), "", _quantities(content), "", _means(trial))


def _trial_content(scenario: Scenario, trial: Trial) -> dict[str, Any]:
    import numpy as np

    from ethbrake_marl.worlds.describe import kinds_of, quantities_of

    quantities = {
        name: dict(zip(("least", "median", "largest"), np.nanquantile(column, (0.0, 0.5, 1.0)).tolist(), strict=True))
        for name, column in quantities_of(trial.drawn.worlds, trial.drawn.road).items()
        if not np.isnan(column).all()
    }
    return {
        "name": scenario.name,
        "vehicles": scenario.vehicles,
        "learners": [scenario.vehicle_names[body - 1] for body in scenario.learners],
        "worlds": trial.n,
        "rejected": trial.drawn.rejected,
        "early_impacts": trial.early,
        "moving_at_horizon": trial.moving,
        "vehicle_1_late": trial.late,
        "known": trial.known,
        "harm": trial.harm,
        "refused_by": trial.refused,
        "quantities": quantities,
        "kinds": {name: dict(Counter(column.tolist())) for name, column in kinds_of(trial.drawn).items()},
    }


def _facts(scenario: Scenario, trial: Trial, content: dict[str, Any]) -> Sheet:
    rejected = trial.drawn.rejected
    facts = {
        "Early impacts": f"{rejected} of {rejected + trial.n} draws rejected, {trial.early} of {trial.n} worlds kept",
        f"Some vehicle moves at the horizon ({scenario.horizon_s:g} s)": f"in {trial.moving} of {trial.n} worlds",
    }
    if trial.late and scenario.alert_s is None:
        facts["Vehicle 1, whose braking is the alert"] = f"has a latency in {trial.late} of {trial.n} worlds"
    for learner, shares in trial.known.items():
        known = ", ".join(f"{name} in {100.0 * share:.1f} %" for name, share in shares.items())
        facts[f"{learner} knows when it can first act"] = f"{known} of the worlds"
    for name, kinds in content["kinds"].items():
        common = Counter(kinds).most_common(SHOWN_KINDS)
        facts[name] = ", ".join(f"{kind or 'no type'} {count}" for kind, count in common)
        facts[name] += " ..." if len(kinds) > SHOWN_KINDS else ""
    for spec, why in trial.refused.items():
        facts[f"{spec} cannot drive here"] = why
    note = "Later impacts are not counted unless you raise horizon_s." if trial.moving else ""
    return Sheet("", ("Trial", "Result"), [*facts.items()], note, gap=2)


def _quantities(content: dict[str, Any]) -> Sheet:
    """A quantity that is the same in all worlds has a median only."""
    columns = [Column("Quantity", text=True), *(Column(each, digits=3) for each in ("Median", "Least", "Largest"))]
    rows = [(name, each["median"], each["least"], each["largest"]) for name, each in content["quantities"].items()]
    return Sheet("", columns, [row if row[2] != row[3] else row[:2] for row in rows], gap=2)


def _means(trial: Trial) -> Sheet | str:
    """Harm by what drives the learners, if there are any."""
    from ethbrake_marl.episode.counts import HarmCount

    costs = [harm[trial.harm_count.name] for harm in trial.harm.values()]
    if not costs:
        return "Nobody learns."
    counts = [HarmCount.of(name).words.capitalize() for name in next(iter(trial.harm.values()))]
    columns = [Column("Mean per world in m²/s²", text=True), *map(Column, counts)]
    is_easy = len(costs) > 1 and costs[0] - min(costs) <= 0.02 * costs[0]
    note = f"There is hardly anything to learn: nothing tried saves 2 % of full braking's {trial.harm_count.words}."
    return Sheet("", columns, [(what, *harm.values()) for what, harm in trial.harm.items()], note * is_easy, gap=2)


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
