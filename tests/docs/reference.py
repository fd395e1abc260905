"""``docs/reference``, made from the package: ``python -m tests.docs.reference`` writes it, a test compares it.

The beginning of each page is written by hand, up to the line ``MADE``.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ethbrake_marl import ethbrake_v1
from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.agents.registry import agent_entries
from ethbrake_marl.cli.app import Installed, whole_command
from ethbrake_marl.evaluation.measure_sets import measures
from ethbrake_marl.game.features import Feature
from ethbrake_marl.game.full_state import state_features
from ethbrake_marl.game.measures import BUILT_IN
from ethbrake_marl.game.objectives import OBJECTIVES
from ethbrake_marl.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.game.rewards import REWARDS, RewardParams
from ethbrake_marl.policies.shipped import load_shipped, shipped_policies
from ethbrake_marl.scenario.catalogue import list_scenarios, load_scenario
from ethbrake_marl.scenario.channel import CHANNELS, V2X
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.schema import Scenario, scenario_json_schema
from ethbrake_marl.training.recipe import TrainingRecipe
from tests.docs import api
from tests.docs.markdown import link_pages, table, wrap, wrap_page

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "docs" / "reference"
CARDS = ROOT / "ethbrake_marl" / "_policies"
MADE = "<!-- Made by `python -m tests.docs.reference` from here on; the text above is written by hand. -->"
ON_EVERY_COMMAND = ("--help",)


def sections(**parts: str) -> str:
    """Headings and what stands below each."""
    return "\n".join(f"## {title.replace('_', ' ')}\n\n{text}" for title, text in parts.items())


# The command line.


def command_line() -> str:
    """Every command: what its help page says, in the order of ``ethbrake --help``."""
    whole = whole_command()
    return "\n".join(_commands(whole, whole.context_class(whole, info_name="ethbrake", **whole.context_settings), 2))


def _commands(group: Any, context: Any, level: int) -> Iterator[str]:
    for name in group.list_commands(context):
        command = group.commands[name]
        command = command.command() if isinstance(command, Installed) else command
        inside = command.context_class(command, info_name=name, parent=context)
        path = inside.command_path.removeprefix("ethbrake ")
        yield f"{'#' * level} {path}\n"
        yield "\n\n".join(map(wrap, command.help.split("\n\n"))) + "\n"
        if hasattr(command, "commands"):
            yield from _commands(command, inside, level + 1)
            continue
        usage = command.get_usage(inside).removeprefix("Usage: ")
        examples = re.findall(r"Example: (.*)", command.epilog or "")
        yield "\n".join([f"`{usage}`\n", "```console", *(f"$ {each}" for each in examples), "```\n"])
        records = [each.get_help_record(inside) for each in command.params if each.opts[0] not in ON_EVERY_COMMAND]
        if records:
            yield table(("option", "meaning", "default"), (_option(*record) for record in records))


def _option(written: str, about: str) -> tuple[str, str, str]:
    text, _, extra = about.partition("  [")
    default = re.search(r"default: (.*?)(?:; required)?\]$", extra)
    told = "required" if "required" in extra else re.sub(r"^\((.*?)\)", r"\1", default[1]) if default else ""
    return " ".join(f"`{word}`" for word in written.split()), text, told


# Scenarios and recipes.


def scenario_keys() -> str:
    """Every key of a scenario, and of a type of vehicle."""
    schema = scenario_json_schema()
    kind = schema["$defs"]["VehicleType"]["properties"]
    return sections(
        Keys=table(
            ("key", "meaning", "range", "default"),
            [
                (f"`{key}`", field.description, _range(schema["properties"][key], schema, key), _default(key, field))
                for key, field in Scenario.model_fields.items()
            ],
        ),
        Keys_of_a_type=table(
            ("key", "meaning", "range"),
            [(f"`{key}`", each["description"], _range(each, schema, key)) for key, each in kind.items()],
        ),
    )


def _default(key: str, field: Any) -> str:
    other = {**QUANTITY.alternatives, **{new: usual for usual, new in QUANTITY.alternatives.items()}}
    if field.is_required() or key in QUANTITY.needed:
        return "required"
    if key in ("gaps_m", "time_gaps_s", "speeds_mps", "line_speed_mps"):
        return f"this or `{other[key]}`"
    value = field.get_default(call_default_factory=True, validated_data={})
    if isinstance(value, dict):
        value = ", ".join(f"{name}: {each}" for name, each in value.items())
    value = value.preset if isinstance(value, V2X) else f"{value:g}" if isinstance(value, float) else value
    return "" if value in (None, "") else f"`{value}`"


def _range(schema: Mapping[str, Any], whole: Mapping[str, Any], key: str = "") -> str:
    """What a key may be: of a quantity its interval, else what its JSON schema says."""
    if key in QUANTITY.declared:
        interval = QUANTITY.declared[key].interval.removeprefix("finite and in ").partition(" (")[0]
        return interval + (", below `horizon_s`" if key == "latency_s" else "")
    for one in (schema, *schema.get("anyOf", ())):
        if "$ref" in one:
            one = whole["$defs"][one["$ref"].rpartition("/")[2]]
            one = one["anyOf"][1] if "anyOf" in one else one
        if "enum" in one:
            return ", ".join(f"`{each}`" for each in one["enum"])
        if "properties" in one:
            names = ", ".join(f"`{name}`" for name in one["properties"])
            return f"a mapping of {names}" if len(one["properties"]) <= 4 else "a mapping"
        if one.get("type") in ("number", "integer"):
            return _interval(one)
        if one.get("type") in _KINDS:
            return _KINDS[one["type"]]
    return ""


def _interval(schema: Mapping[str, Any]) -> str:
    """``at least 1``, ``2 to 64``, ``above 0, to 1``."""
    told = {name: f"{value:,.10g}" for name, value in schema.items() if "imum" in name.lower()}
    low = told.get("minimum") or (f"above {told['exclusiveMinimum']}" if "exclusiveMinimum" in told else "")
    high = told.get("maximum") or (f"below {told['exclusiveMaximum']}" if "exclusiveMaximum" in told else "")
    if low and high:
        return f"{low}{'' if 'minimum' in told else ','} to {high}"
    return f"at least {low}" if "minimum" in told else low or high or "a number"


_KINDS = {"string": "text", "array": "a list", "object": "a mapping", "boolean": "`true`, `false`"}


def recipe_keys() -> str:
    """Keys that every recipe has, then those of each algorithm, then those inside others."""
    schema = TrainingRecipe.json_schema()
    parts = {name.removesuffix("Recipe").lower(): each for name, each in schema["$defs"].items() if "Recipe" in name}
    common = list(TrainingRecipe.model_fields)
    own = {f"`{name}`": [key for key in part["properties"] if key not in common] for name, part in parts.items()}
    parts = {"All_algorithms": parts["ppo"], **{f"`{name}`": part for name, part in parts.items()}}
    tables = {}
    for title, keys in {"All_algorithms": common, **own}.items():
        rows = []
        for key in keys:
            each = parts[title]["properties"][key]
            default = f"`{each['default']}`" if each.get("default") else ""
            default = "required" if key in parts[title]["required"] else default
            rows.append((f"`{key}`", each.get("description", ""), _range(each, schema), default))
        tables[title] = table(("key", "meaning", "range", "default"), rows)
    inside: dict[str, list[str]] = {}  # key of a mapping inside a recipe -> its meanings, by algorithm
    for part in parts.values():
        for outer, each in part["properties"].items():
            for key, inner in _inside(each, schema).items():
                told = inside.setdefault(f"`{outer}.{key}`", [])
                told += [inner["description"]] if inner.get("description", "") not in ("", *told) else []
    rows = [(key, "; or ".join(texts)) for key, texts in inside.items() if texts]
    return sections(**tables, Inside_others=table(("key", "meaning"), rows))


def _inside(value: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    """Properties of the mapping that a key holds; none where it holds another kind of value, or a reward."""
    name = str(value.get("$ref", "")).rpartition("/")[2]
    return {} if name == "RewardParams" else schema["$defs"].get(name, {}).get("properties", {})


# What an environment shows.


def feature_table(features: Sequence[Feature], first: int = 0) -> str:
    """Features from number ``first`` on, one line each, in the order of the vector."""
    rows = [
        (k, f"`{f.name}`", f.unit, f"{f.scale:g}", f"{f.low:g}", f"{f.high:g}", f.meaning)
        for k, f in enumerate(features[first:], first)
    ]
    return table(("#", "feature", "unit", "scale", "low", "high", "meaning"), rows)


def fact_table() -> str:
    """What PettingZoo's pages say of an environment, here with its default arguments."""
    env = ethbrake_v1.parallel_env()
    agent = env.possible_agents[0]
    spaces = {"Action": env.action_space(agent), "Observation": env.observation_space(agent), "State": env.state_space}
    rows = [
        ("Import", "`from ethbrake_marl import ethbrake_v1`"),
        ("Actions", "continuous"),
        ("Parallel API", "yes"),
        ("Manual control", "no"),
        ("Agents", f"{len(env.possible_agents)} by default, 2 to 64 by scenario"),
        ("Agent names", ", ".join(f"`{name}`" for name in env.possible_agents)),
    ]
    for name, space in spaces.items():
        rows += [
            (f"{name} shape", f"({space.shape[0]},)"),
            (f"{name} values", f"[{space.low.min():g}, {space.high.max():g}]"),
        ]
    return table(("fact", "value"), rows)


def features() -> str:
    """Spaces, every feature by group, and the state."""
    usual = ObservationSpec()
    return sections(
        Spaces_by_default=fact_table(),
        Observed_by_default=feature_table(usual.features),
        Place_and_obstacle=feature_table(ObservationSpec(role=True, obstacle=True).features, usual.size),
        Contact=feature_table(ObservationSpec(contact=True).features, usual.size),
        Contact_far=feature_table(choose_observation(["contact_far"], 0.1).features),
        State=feature_table(state_features(load_scenario("paper-random"))),
    )


def rewards() -> str:
    """Terms, the named rewards, and objectives."""
    settings = {name: params.model_dump() for name, params in REWARDS.items()}
    told = dict.fromkeys(BUILT_IN, "weight of the term")
    arguments = (inspect.getdoc(RewardParams) or "").partition("Args:\n")[2].partition("\n\n")[0].replace("``", "`")
    told |= dict(re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)\.$", arguments, re.MULTILINE))
    rows = [
        (f"`{field}`", told[field], *(_plain(params[field]) for params in settings.values()))
        for field in RewardParams.model_fields
        if field != "terms"
    ]
    return sections(
        Terms=table(("term", "unit", "meaning"), [(f"`{t.name}`", t.unit, t.meaning) for t in BUILT_IN.values()]),
        Named_rewards=table(("setting", "meaning", *(f"`{name}`" for name in settings)), rows),
        Objectives=table(("objective", "counts"), [(f"`{kind.form}`", kind.about) for kind in OBJECTIVES.values()]),
    )


def _plain(value: float | str | None) -> str:
    if value is None:
        return "the scenario's"
    return value if isinstance(value, str) else f"{value:g}"


# Who drives, where, and what is measured.


def channels() -> str:
    """Presets and keys of ``v2x``."""
    rows = []
    for name, channel in CHANNELS.items():
        p, r = channel.loss_begins, channel.loss_ends
        sent = channel.timing == "messages" and channel.hears != "none"
        losses = (f"{p:g}", f"{r:g}", f"{100 * p / (p + r):.1f} %", f"{1 / r:.1f} periods") if sent else ("–",) * 4
        rows.append((f"`{name}`", channel.hears, channel.senses, *losses, f"{channel.lost:g}"))
    schema = scenario_json_schema()
    keys = schema["$defs"]["V2X"]["anyOf"][1]["properties"]
    return sections(
        Presets=table(("preset", "`hears`", "`senses`", "p", "r", "messages lost", "mean burst", "`lost`"), rows),
        Keys_of_v2x=table(
            ("key", "meaning", "range"),
            [(f"`{key}`", each["description"], _range(each, schema)) for key, each in keys.items()],
        ),
    )


def agents() -> str:
    """Every agent, and what can be put around one."""
    tables = {}
    for title, knows in (("Agents", "knows"), ("Around_an_agent", "also knows")):
        entries = [each for each in agent_entries() if each.form.startswith("+") == (title != "Agents")]
        rows = [(f"`{each.form}`", each.about, _knows(each.knows)) for each in entries]
        tables[title] = table(("written", "drives by", knows), rows)
    return sections(**tables)


def _knows(sources: Source | Sequence[Source]) -> str:
    return sources.value if isinstance(sources, Source) else " + ".join(sources)


def measure_table() -> str:
    """Every column of a results table."""
    return table(
        ("in JSON", "in tables", "meaning"), [(f"`{each.name}`", each.heading, each.about) for each in measures()]
    )


def scenarios() -> str:
    """Shipped scenarios by folder."""
    folders: dict[str, list[Sequence[str]]] = {}
    for entry in list_scenarios():
        scenario = load_scenario(entry.name)
        learners = [name.removeprefix("vehicle_") for name, role in scenario.roles.items() if role == "learner"]
        objective = scenario.objective if isinstance(scenario.objective, str) else ", ".join(scenario.objective)
        changed = scenario.v2x.model_dump(exclude_none=True, exclude={"preset"})
        channel = ", ".join([f"`{scenario.v2x.preset}`", *(f"{key}: {value}" for key, value in changed.items())])
        row = (f"`{entry.name}`", entry.title, ", ".join(learners) or "none", channel, objective)
        folders.setdefault(entry.path.parent.name, []).append(row)
    header = ("scenario", "what", "learners", "channel", "objective")
    return sections(**{name.capitalize(): table(header, rows) for name, rows in folders.items()})


def policies() -> str:
    """Shipped policies; each name leads to its card."""
    rows = []
    for name in shipped_policies():
        told = load_shipped(name).manifest
        reward = RewardParams(**told.reward)
        counts = f"{'first-impact' if reward.harm_count == 'first' else 'total'} harm"
        scenario = f"`{told.scenario['name']}`"
        why = re.search(r"^Not `universal`: (.*?)\n\n", (CARDS / name / "card.md").read_text("utf-8"), re.DOTALL | re.M)
        aim = counts if reward.harm else "the paper's reward"
        rows.append((f"[`{name}`](#{name})", scenario, aim, told.algorithm, link_pages(why[1], "../") if why else ""))
    return table(("policy", "trained on", "for", "by", "why not `universal`"), rows)


def cards() -> str:
    """The card of every shipped policy, its headings one level lower."""
    return "\n".join(_card(path) for path in sorted(CARDS.glob("*/card.md")))


def _card(path: Path) -> str:
    def lead(found: re.Match[str]) -> str:
        target = (path.parent / found[1]).resolve()
        if target.name == "card.md":
            return f"](#{target.parent.name})"
        return f"]({os.path.relpath(target, REFERENCE)}{found[2] or ''})"

    text = re.sub(r"\]\((?!https?:|#)([^)\s#]+)(#[^)\s]*)?\)", lead, path.read_text("utf-8"))
    return re.sub(r"(?m)^#(?=#* )", "##", wrap_page(link_pages(text, "../")))


PAGES: dict[str, Callable[[], str]] = {  # page below docs/reference -> what stands below its beginning
    "cli": command_line,
    "api": api.index,
    **{f"api/{name}": partial(api.page, name) for name in (*api.GROUPS, "extensions")},
    "scenario-keys": scenario_keys,
    "recipe-keys": recipe_keys,
    "features": features,
    "rewards": rewards,
    "channels": channels,
    "agents": agents,
    "measures": measure_table,
    "scenarios": scenarios,
    "policies": lambda: f"{policies()}\n{cards()}",
}


def whole_page(name: str) -> str:
    """The page with its beginning, as it must be committed."""
    beginning = (REFERENCE / f"{name}.md").read_text("utf-8").partition(MADE)[0].rstrip()
    return f"{beginning}\n\n{MADE}\n\n{PAGES[name]().rstrip()}\n"


if __name__ == "__main__":
    for each in PAGES:
        (REFERENCE / f"{each}.md").write_text(whole_page(each), "utf-8")
