"""The commands ``scenario`` and ``agent``, which list, show, check and write scenarios and agents."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from ethbrake_marl.cli.command import ForceOption, JsonOption, Out, SeedOption, SettingsOption, example
from ethbrake_marl.cli.pages import page_of
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.first_edition import evaluation, scenario as scenarios, training

TRIED_WORLDS = 200  # number of worlds in which `scenario validate` tries a scenario

MOST_RANGES = 8  # largest number of ranges that `scenario validate` shows separately for vehicles

SCREEN = 24  # number of lines on a terminal screen

TABLE_WORLDS, PICTURE_WORLDS = 10, 1000  # default numbers of worlds of `scenario sample` for a table and a picture

NameArgument = Annotated[
    str, typer.Argument(metavar="NAME|PATH", help="Name of a shipped or registered scenario, or path of a YAML file.")
]

scenario_group = typer.Typer(
    help="List, check and create scenarios, and draw worlds.",
    epilog=example("scenario show paper-random", "scenario sample paper-random --episodes 10 --output worlds.csv"),
)


@scenario_group.command("list", epilog=example("scenario list"))
def scenario_list(as_json: JsonOption = False) -> None:
    """List the shipped and registered scenarios.

    Shows the name and title of each scenario, and the folder of a registered scenario.
    """
    with Out(as_json=as_json) as out:
        entries = scenarios.list_scenarios()
        width = max(len(entry.name) for entry in entries)
        out.result(
            [{"name": e.name, "title": e.title, "path": str(e.path), "origin": e.origin} for e in entries],
            *(f"{e.name:{width}}  {e.title}{'' if e.shipped else f'  (from {e.origin})'}" for e in entries),
        )


@scenario_group.command("show", epilog=example("scenario show paper-random"))
def scenario_show(scenario: NameArgument) -> None:
    """Print the YAML file of a scenario."""
    from ethbrake_marl.files.yaml import SIZE_LIMIT

    with Out() as out:
        scenarios.load_scenario(scenario)
        path = scenarios.scenario_path(scenario)
        out.show(read_plain(path, SIZE_LIMIT).decode("utf-8"), end="")


@scenario_group.command("validate", epilog=example("scenario validate my-scenario.yaml"))
def scenario_validate(path: NameArgument, as_json: JsonOption = False) -> None:
    """Check a scenario, and try it in 200 worlds.

    Draws the first 200 worlds of the evaluation list and simulates them. Learners brake fully, all other vehicles
    follow their scripts. Shows the range of each quantity in these worlds, and possible mistakes in the scenario.
    """
    with Out(as_json=as_json) as out:
        scenario = evaluation.load_runnable(path)
        sample = scenario.sample(TRIED_WORLDS, evaluation.LIST_SEED)
        n, names = sample.worlds.n, [scenario.vehicle_names[i] for i in scenario.learners]
        ranges, fixed, quantities = _drawn_lines(scenario, sample)
        trial = evaluation.try_scenario(scenario, sample.worlds)
        content = {
            "name": scenario.name, "vehicles": scenario.vehicles, "learners": names, "worlds": n, **trial,
            "rejected": sample.rejected, "quantities": quantities,
            "kinds": {kind: dict(Counter(drawn.tolist())) for kind, drawn in sample.kinds.items()},
        }  # fmt: skip
        odd, beyond, late = (trial[each] for each in ("not_state_free", "commands_out_of_range", "vehicle_1_late"))
        head, *notes = (
            f"{'NOT OK' if beyond else 'OK'}  {scenario.name}: {scenario.vehicles} vehicles, learners:"
            f" {', '.join(names) or 'none'}; tried in {n} worlds",
            sample.count_kinds().removeprefix("; "),
            f"early impacts: {_share(sample.rejected, sample.rejected + n, 'draws')} rejected,"
            f" {_share(trial['early_impacts'], n)} kept",
            f"at the horizon ({scenario.horizon_s:g} s) some vehicle still moves in"
            f" {_share(trial['moving_at_horizon'], n)}"
            + ("; later impacts are not counted unless you raise horizon_s" if trial["moving_at_horizon"] else ""),
            f"Vehicle 1, whose braking is the alert, has a latency above 0 in {_share(late, n)}"
            if late and scenario.alert_s is None
            else "",
            "; ".join(
                f"the command of {each} exceeds its capacity in {_share(len(rows), n)}" for each, rows in beyond.items()
            ),
            f"scripts that depend on the state: {', '.join(f'{each} ({script})' for each, script in odd.items())};"
            f" not accepted by: {', '.join(trial['refused_by']) or 'none'}"
            if odd
            else "",
        )
        above, below = _folded(head, 2) + ranges, [line for note in notes for line in _folded(note, 3)]
        out.result(content, *above, *_folded(fixed, max(SCREEN - len(above) - len(below), 1)), *below)
        if beyond:
            (vehicle, rows), *_ = beyond.items()
            raise InvalidInput(
                f"scenario {scenario.name!r}: roles.{vehicle} = {scenario.roles[vehicle]}: the command exceeds the"
                f" vehicle's capacity in {_share(len(rows), n)}; {next(iter(rows.values()))}"
            )


def _drawn_lines(scenario: scenarios.Scenario, sample: scenarios.Sample) -> tuple[list[str], str, dict[str, Any]]:
    """Return the ranges of varying quantities as lines, the fixed quantities as text, and all quantities for JSON.

    An example for JSON is ``{"gap_1_m": {"least": 5.0, "median": 7.0, "largest": 9.0}}``.
    """
    import numpy as np

    worlds, varying = sample.worlds, evaluation.drawn_alike(sample.worlds, scenario)
    ranges = {f"{key} of {who}" if who else key: each for key, drawn in varying.items() for who, each in drawn.items()}
    if len(ranges) > MOST_RANGES:
        ranges = {key: scenarios.QUANTITY.declared[key].of(worlds) for key in varying}
    width = max(map(len, ranges), default=0)
    lines = [f"{'drawn':{width}} {'least':>8} {'median':>8} {'largest':>8}"] if ranges else []
    lines += [
        f"{name:{width}}" + "".join(f" {each:>8.4g}" for each in np.nanquantile(drawn, (0.0, 0.5, 1.0)))
        for name, drawn in ranges.items()
    ]
    others = {
        key: ["drawn" if np.ptp(each) else f"{each[0]:g}" for each in rule.of(worlds).T]
        for key, rule in scenarios.QUANTITY.of(worlds).items()
        if key not in ranges and not np.ptp(rule.of(worlds), axis=0).all()
    }
    texts = (f"{key} {each[0] if len(set(each)) == 1 else ', '.join(each)}" for key, each in others.items())
    columns = {
        name: dict(zip(("least", "median", "largest"), np.nanquantile(drawn, (0.0, 0.5, 1.0)).tolist(), strict=True))
        for name, drawn in scenarios.QUANTITY.columns(worlds).items()
    }
    return lines, f"fixed: {'; '.join(texts)}" if others else "", columns


def _folded(text: str, most: int, width: int = 80) -> list[str]:
    """Return the text as at most ``most`` lines of ``width`` characters; the rest is replaced by ``...``."""
    return textwrap.wrap(text, width, max_lines=most, placeholder=" ...", break_on_hyphens=False)


def _share(part: int, whole: int, things: str = "worlds") -> str:
    return f"{part:,} of {whole:,} {things} ({100.0 * part / whole:.1f} %)"


@scenario_group.command("explain", epilog=example("scenario explain paper-random"))
def scenario_explain(scenario: NameArgument, as_json: JsonOption = False) -> None:
    """Describe a scenario in plain sentences.

    The sentences describe the line of vehicles, the distribution of each quantity, what each vehicle knows and when,
    and whose harm counts.
    """
    with Out(as_json=as_json) as out:
        chosen = evaluation.load_runnable(scenario)
        sentences = [each for each in _sentences(chosen) if each]
        out.result(
            {"name": chosen.name, "sentences": sentences},
            *(line for each in sentences for line in _folded(each, 4, 100)),
        )


def _sentences(scenario: scenarios.Scenario) -> Iterator[str]:
    """Yield sentences that describe the scenario; some may be empty."""
    from ethbrake_marl.first_edition.agents.making import find_entry
    from ethbrake_marl.first_edition.game.objectives import OBJECTIVES

    yield f"{scenario.name}: {scenario.title or 'no title'}. {scenario.description}".rstrip()
    learners = ", ".join(scenario.vehicle_names[i] for i in scenario.learners) or "nobody"
    yield (
        f"{scenario.vehicles} vehicles in line, vehicle_1 in front, {_obstacle_in_words(scenario)}. Learners:"
        f" {learners}."
    )
    for script in dict.fromkeys(scenario.scripts.values()):
        who = ", ".join(name for name, role in scenario.roles.items() if role == script)
        yield f"Script {script} ({find_entry(script).about}): {who}."
    if scenario.mixture is not None:
        members = ", ".join(f"{each.scenario['name']} ({each.weight:g})" for each in scenario.mixture)
        yield (
            f"Each world is drawn from one of these scenarios (weights in brackets): {members}. The following ranges"
            " cover all of them."
        )
    if scenario.table is not None:
        rows, columns = len(scenario.table.rows or ()), ", ".join(scenario.table.columns)
        yield f"Each world takes one of the {rows:,} rows of a table with the columns {columns}."
        if scenario.recordings is not None:
            recordings = {*scenarios.recording_of(scenario.recordings.rows).tolist()}
            yield (
                f"The rows come from {len(recordings):,} recordings; confidence intervals treat worlds of one recording"
                " as dependent."
            )
    for name, kind in (scenario.vehicle_types or {}).items():
        own = {scenarios.QUANTITY.declared[key].label: getattr(kind, key) for key in scenarios.QUANTITY.of_a_type}
        text = "; ".join(f"{label} {_in_words(each)}" for label, each in own.items() if each is not None)
        text += f"; V2X {flow_text(kind.v2x)}" if kind.v2x is not None else ""
        text = text.removeprefix("; ") or "quantities as declared for all types"
        yield f"Vehicle type {name}, weight {kind.weight:g}, load {_in_words(kind.load)}: {text}."
    yield (
        f"Possible vehicle types, front to rear: {flow_text(scenario.types or 'any')}."
        if scenario.vehicle_types
        else ""
    )
    for key, rule in scenarios.QUANTITY.declared.items():
        text = _declared_in_words(scenario, key)
        yield f"{rule.label[0].upper()}{rule.label[1:]}: {text}; {rule.meaning}." if text else ""
    common = scenario.model_fields_set if scenario.members else type(scenario).model_fields  # same for all members
    yield _news_in_words(scenario) if "v2x" in common else "The V2X channel differs between these scenarios."
    early = "is kept" if scenario.early_impacts == "keep" else f"is rejected and drawn again{_refused(scenario)}"
    yield (
        f"Vehicles decide every {scenario.time_step_s:g} s; an episode is truncated after {scenario.horizon_s:g} s."
        + (f" A world with an impact before a learner can act {early}." if "early_impacts" in common else "")
    )
    objectives = dict.fromkeys([scenario.objective] if isinstance(scenario.objective, str) else scenario.objective)
    aims = ", ".join(f"{each} ({OBJECTIVES[each.partition(':')[0]].about})" for each in objectives)
    yield f"Objective: {aims}; a shield always bounds the harm of the whole line."


def _refused(scenario: scenarios.Scenario, sample: scenarios.Sample | None = None) -> str:
    """Return the number of draws rejected for an impact before any learner can act: ``: 3 of 203 draws (1.5 %)``.

    The rejected draws of ``sample`` are counted; None: draw 200 worlds. The text is empty for a scenario without a
    table. If there is a table, rejections change how often each of its rows occurs in the worlds.
    """
    if all(each.table is None for each in scenario.members or (scenario,)):
        return ""
    sample = scenario.sample(TRIED_WORLDS, evaluation.LIST_SEED) if sample is None else sample
    return f": {_share(sample.rejected, sample.rejected + sample.worlds.n, 'draws')}"


def _obstacle_in_words(scenario: scenarios.Scenario) -> str:
    there = [each.has_obstacle for each in scenario.members or (scenario,)]
    return f"{'an' if any(there) else 'no'} obstacle ahead{'' if len(set(there)) == 1 else ' in some worlds'}"


def _declared_in_words(scenario: scenarios.Scenario, key: str) -> str:
    """Return a description of how the quantity ``key`` is drawn; empty if the scenario does not declare it."""
    if scenario.members:
        is_common = key in scenarios.QUANTITY.usual or (
            key == "friction" and all(each.declares(key) for each in scenario.members)
        )
        ends = [end for each in (scenario.bounds(key) if is_common else ()) for end in each]
        return " to ".join(dict.fromkeys(f"{end(ends):.4g}" for end in (min, max))) if ends else ""
    value = getattr(scenario, key)
    if value is None or (key in scenarios.QUANTITY.otherwise and key not in scenario.model_fields_set):
        return ""
    if isinstance(value, tuple):
        return ", ".join(map(_in_words, value))
    per = scenarios.QUANTITY.declared[key].per
    return _in_words(value) + ("" if isinstance(value, float) or per == "world" else f", drawn for each {per}")


def _in_words(quantity: Any) -> str:
    """Return a description of a number or distribution: ``5 to 9 (uniform)``."""
    if isinstance(quantity, float):
        return f"{quantity:g}"
    (kind, shape), *more = quantity.model_dump(exclude_none=True).items()
    inner, ends = (shape, quantity.support) if isinstance(shape, dict) else (dict(more), shape)
    details = [f"{name} {flow_text(each)}" for name, each in inner.items() if name not in ("low", "high")]
    values = (" or " if kind == "choice" else " to ").join(f"{each:g}" for each in ends)
    return f"{values} ({', '.join([kind.replace('_', ' '), *details])})"


def _news_in_words(scenario: scenarios.Scenario) -> str:
    """Return a sentence about what each vehicle knows, and when, through the scenario's V2X channel."""
    channel, about = scenario.v2x.channel._asdict(), type(scenario.v2x).model_fields
    usual = scenarios.CHANNELS["paper"]._asdict()
    other = {key: value for key, value in channel.items() if key in about and value != usual[key]}
    text = "; ".join(f"{key} {flow_text(value)} ({about[key].description})" for key, value in other.items())
    text += f"; {flow_text(scenario.v2x.vehicles)}" if scenario.v2x.vehicles else ""
    return f"V2X preset {scenario.v2x.preset}: {text or 'each vehicle knows the whole line from its own latency on'}."


@scenario_group.command("new", epilog=example("scenario new my-scenario --based-on paper-distance"))
def scenario_new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the new scenario; its file is NAME.yaml.")],
    based_on: Annotated[
        str, typer.Option(metavar="NAME|PATH", help="Scenario from which the new scenario takes its values.")
    ] = "paper-random",
    output: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the new scenario file.")] = Path(),
    force: ForceOption = False,
) -> None:
    """Write a new scenario file, NAME.yaml, with comments.

    The file contains every key of a scenario. If the scenario has a table, its rows are written to NAME.csv in the same
    folder.
    """
    with Out(force=force) as out:
        file, rows = output / f"{name}.yaml", output / f"{name}.csv"
        text = scenarios.new_scenario_text(name, based_on, rows_file=rows.name)
        table = scenarios.load_scenario(based_on).table
        out.check(file)
        if table is not None:
            out.write(rows, scenarios.rows_text(table), what="rows")
        out.write(file, text)
        out.note(f"written: {file}; change the file, then run: ethbrake scenario validate {file}")


@scenario_group.command("parts", epilog=example("scenario parts"))
def scenario_parts(as_json: JsonOption = False) -> None:
    """List the names that scenarios and recipes can use.

    Lists features of observations, V2X presets, objectives, training algorithms, recipes, and measures. A reward is a
    weighted sum of measures.
    """
    from ethbrake_marl.first_edition.game.features import FEATURES
    from ethbrake_marl.first_edition.game.measures import MEASURES
    from ethbrake_marl.first_edition.game.objectives import OBJECTIVES

    features = FEATURES.usable().items()
    own = [name if entry.of == "own" else f"front_K.{name}, rear_K.{name}" for name, entry in features]
    parts = {
        "Observation": ["own", "front_K", "rear_K", "role", "obstacle", *own],
        "V2X presets": [*scenarios.CHANNELS],
        "Objectives": [kind.form for kind in OBJECTIVES.usable().values()],
        "Algorithms": [*training.algorithm_names()],
        "Recipes": [*training.TrainingRecipe.usable()],
        "Measures": [*MEASURES],
    }
    with Out(as_json=as_json) as out:
        out.result(
            parts, Sheet("", ("What", "Names"), [(what, ", ".join(names)) for what, names in parts.items()], gap=2)
        )


@scenario_group.command("schema", epilog=example("scenario schema > scenario.schema.json"))
def scenario_schema() -> None:
    """Print the JSON Schema of scenario files.

    Editors use this schema to complete and check YAML files.
    """
    with Out() as out:
        out.print_json(scenarios.scenario_json_schema())


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

    The table has a column for each quantity that is not fixed in the scenario; `eb.read_worlds` reads such a table. The
    picture shows the distributions of quantities, scatter plots of pairs of quantities, and three worlds. The same
    scenario, seed and number of worlds give the same worlds on every machine.
    """
    with Out(as_json=as_json, force=force) as out:
        out.check(output, ".csv", ".png", ".svg", ".pdf", what="worlds")
        chosen = evaluation.load_runnable(scenario, training.read_settings(settings).scenario)
        pictured = None if output is None or output.suffix.lower() == ".csv" else output
        usual = TABLE_WORLDS if pictured is None else PICTURE_WORLDS
        sample = chosen.sample(usual if episodes is None else episodes, seed)
        states = evaluation.states_of(sample.worlds, chosen)
        lines = [
            ",".join(states[0]),
            *(",".join("" if each is None else repr(each) for each in state.values()) for state in states),
        ]
        if pictured is not None:
            page_of("worlds", f"--output {pictured.name}")(pictured, chosen, sample, seed=seed, force=out.force)
            out.note(f"picture: {pictured}")
        elif output is not None:
            out.write(output, "\n".join([*lines, ""]), what="worlds")
        if output is None or out.as_json:
            out.result(states, *lines)
        if chosen.early_impacts == "reject" and (refused := _refused(chosen, sample)):
            out.note(f"rejected and drawn again because of an impact before a learner can act{refused}")


agent_group = typer.Typer(
    help="List the agents, or export a policy.",
    epilog=example("agent list", "agent export runs/early --onnx early.onnx"),
)


@agent_group.command("list", epilog=example("agent list"))
def agent_list(as_json: JsonOption = False) -> None:
    """List all agents, what they do and what they know.

    In the list, a name that begins with + is appended to the name of an agent, as in full_brake+step. The name +search
    comes before a shield, as in full_brake+search+step.
    """
    with Out(as_json=as_json) as out:
        from ethbrake_marl.first_edition.agents.protocol import Knowledge
        from ethbrake_marl.first_edition.agents.registry import agent_entries, agents_refused

        content, rows = [], []
        for entry in agent_entries():
            knows, added = Knowledge.of(entry), "also " if entry.form.startswith("+") else ""
            content.append(
                {"agent": entry.form, "about": entry.about, "knows": list(knows), "omniscient": knows.sees_through}
            )
            rows.append((entry.form, entry.about, f"{added}{knows.text}{' †' if knows.sees_through else ''}"))
        for reason in agents_refused():
            out.note(f"left out: {reason}")
        out.result(
            content,
            Sheet("", ("Agent", "Method", "Knows"), rows, gap=2),
            "† omniscient: the agent reads values that no message carried. With :estimated after its name, an agent"
            " uses only what its vehicle has received.",
            "ladder stands for all agents from coast to best_harm. See docs/evaluate.md and docs/shield.md.",
        )


@agent_group.command("export", epilog=example("agent export runs/early --onnx early.onnx"))
def agent_export(
    policy: Annotated[
        str, typer.Argument(metavar="NAME|PATH", help="Name of a shipped policy, or folder of a run or policy bundle.")
    ],
    onnx: Annotated[Path, typer.Option(metavar="FILE", help="File for the ONNX model.")],
    force: ForceOption = False,
) -> None:
    """Write a policy as an ONNX model.

    The input of the model is an observation, the output an acceleration. The command needs the package onnx, which the
    extra `export` installs.
    """
    with Out(force=force) as out:
        from ethbrake_marl.first_edition.policies.shipped import load_named_policy

        out.check(onnx)
        out.write(onnx, load_named_policy(policy).to_onnx(), what="written")
