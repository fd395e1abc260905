"""The tables that docs/environment.md shows, made from the code; a test compares the two.

``.venv/bin/python docs/studies/environment_tables.py`` prints them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from ethbrake_marl import ethbrake_v0
from ethbrake_marl.observations import Feature, ObservationSpec, choose_observation
from ethbrake_marl.rewards import REWARDS, TERMS, RewardParams, Term
from ethbrake_marl.scenario import load_scenario, state_features


def feature_table(features: Sequence[Feature], first: int = 0) -> str:
    """Markdown table of features from number ``first`` on, one line each, in the order of the vector."""
    rows = [
        (str(k), f"`{f.name}`", f.unit, f"{f.scale:g}", f"{f.low:g}", f"{f.high:g}", f.meaning)
        for k, f in enumerate(features[first:], first)
    ]
    return _markdown(("#", "feature", "unit", "scale", "low", "high", "meaning"), rows)


def reward_table(rewards: Mapping[str, RewardParams]) -> str:
    """Markdown table of the named rewards: one line for each setting, one column for each reward."""
    settings = {name: params.model_dump() for name, params in rewards.items()}
    rows = [
        (f"`{field}`", *(_plain(params[field]) for params in settings.values()))
        for field in RewardParams.model_fields
        if field != "terms"
    ]
    return _markdown(("setting", *(f"`{name}`" for name in settings)), rows)


def term_table(terms: Iterable[Term]) -> str:
    """Markdown table of reward terms."""
    return _markdown(("term", "unit", "meaning"), [(f"`{t.name}`", t.unit, t.meaning) for t in terms])


def fact_table() -> str:
    """Markdown table of what PettingZoo's pages say of an environment, here with its default arguments."""
    env = ethbrake_v0.parallel_env()
    agent = env.possible_agents[0]
    spaces = {"Action": env.action_space(agent), "Observation": env.observation_space(agent), "State": env.state_space}
    rows = [
        ("Import", "`from ethbrake_marl import ethbrake_v0`"),
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
    return _markdown(("fact", "value"), rows)


def environment_tables() -> dict[str, str]:
    """Every table of docs/environment.md by its marker."""
    return {
        "facts": fact_table(),
        "observation": feature_table(ObservationSpec().features),
        "obstacle": feature_table(ObservationSpec(role=True, obstacle=True).features, ObservationSpec().size),
        "contact": feature_table(ObservationSpec(contact=True).features, ObservationSpec().size),
        "contact_far": feature_table(choose_observation(["contact_far"], 0.1).features),
        "state": feature_table(state_features(load_scenario("paper-random"))),
        "terms": term_table(TERMS.values()),
        "rewards": reward_table(REWARDS),
    }


def _plain(value: float | str | None) -> str:
    if value is None:
        return "the scenario's"
    return value if isinstance(value, str) else f"{value:g}"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    for name, table in environment_tables().items():
        print(f"<!-- {name} -->\n{table}\n<!-- end -->\n")
