"""``docs/reference/environment.md``: ``python -m tests.docs.card`` makes it from the package, a test compares it."""

import argparse
import re
from inspect import Parameter, getdoc, signature
from pathlib import Path

import ethbrake_marl as eb
from ethbrake_marl.episode import infos
from ethbrake_marl.episode.features import FEATURES, GROUPS, Feature, known_names
from ethbrake_marl.episode.reward import REWARDS
from ethbrake_marl.episode.terms import BUILT_IN
from ethbrake_marl.faces.registration import GYMNASIUM_ID, MO_GYMNASIUM_ID, PETTINGZOO_ID
from tests.docs.site import DOCS

PAGE = DOCS / "reference" / "environment.md"
DOORS = {
    "PettingZoo": eb.EthBrakeParallelEnv,
    "Gymnasium": eb.EthBrakeEnv,
    "vector": eb.EthBrakeVectorEnv,
    "SB3": eb.make_sb3_vec_env,
}
USUAL = eb.View().features
USUAL_ROWS = tuple(feature for feature in USUAL if not feature.name.startswith("rear_1."))
TEXT = """# The environment: {gymnasium}

This page, made from the code by `python -m tests.docs.card`, says what an agent sends and receives. How to use
the environment: [environments](../environments.md).

| | |
|---|---|
| Action space | `{action}` |
| Observation space | `{observation}` for `paper-random` |
| Gymnasium | `gymnasium.make("{gymnasium}")`, `gymnasium.make_vec("{gymnasium}", num_envs=n)`; vector rewards: `{mo}` |
| PettingZoo | `eb.parallel_env()`, `eb.env()`; from PettingZoo 1.27 on `pettingzoo.make("parallel", "{pettingzoo}")` |
| Stable-Baselines3 | `eb.make_sb3_vec_env("paper-random", n_envs=n)` |

## Action

An action is one number: -1 brakes fully, 0 coasts, +1 drives fully, linear on each side of 0. It takes effect
once the vehicle's latency since the alert has elapsed, and stays in force for one time step, usually 0.1 s. With
`actions=K`, it is an index of K evenly spaced numbers.

## Observation

By default an agent observes these {count} numbers, in this order: quantities divided by *scale*, clipped to
*bounds*. **All numbers of a neighbour or obstacle that the vehicle does not know are 0**
([who knows what](../cooperation.md#who-knows-what-and-when)).

{usual}

`rear_1`, the vehicle behind, follows with the same numbers as `front_1`, the vehicle ahead. `front_2`
to `front_64` and `rear_2` to `rear_64` are vehicles farther away. `observation=[...]` or a scenario
chooses more numbers, by name or by group:

{more}

## Reward

The reward is `r = sum weight x term`. The discount of a training must be at most the reward's
`shaping_discount` ([why](../environments.md#rewards)). The default is `shaped`, with the discount 0.99:

{rewards}

{terms}

[Counts of harm](../game.md#three-counts-of-harm). Rewards are large before a policy has learned
anything (honest cost of random actions on `paper-random`: about 550 m²/s² an episode; full braking:
31), so most learners need the scale of `shaped`.

## Start and end

`reset` returns the observation at the moment when the latency of the first learner has elapsed. An
episode is *terminated* for all vehicles when every vehicle is at rest and no command would move it, and
*truncated* at the scenario's `horizon_s` (usually 8 s), or after `max_cycles` steps. [Seeds and
options](../environments.md#episodes-and-seeds).

## Infos

Resets and steps return the same keys:

{infos}

## Arguments

{arguments}

## Versions

`EthBrake-v3`: [what has changed](../../CHANGELOG.md). `EthBrake-v2`: in version 2.0 of this package;
`EthBrake-v1`: in version 1.0.
"""


def table(headings: list[str], rows: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (headings, ["---"] * len(headings), *rows))


def feature_rows(features: tuple[Feature, ...]) -> list[list[str]]:
    rows = []
    for f in features:
        meaning = f.meaning.rstrip(".").replace(", [n] s", "")
        rows.append([f"`{f.name}`", meaning, f.unit, f"{f.scale:g}", f"{f.low:g} to {f.high:g}"])
    return rows


def more_features() -> list[list[str]]:
    """Rows of all features outside the default, without those of neighbours farther away."""
    rows = feature_rows(eb.View(["role", "obstacle"]).features)
    singles = [name if name in known_names() else f"front_1.{name}" for name in FEATURES]
    flags = [name for name in singles if name.endswith("_known")]
    rows += feature_rows(eb.View([name for name in singles if name not in flags]).features)
    first, *others = feature_rows(eb.View(flags).features)
    names = ", ".join(row[0] for row in (first, *others))
    rows.append([names, "1 if this number is known, from a message or from sensors", *first[2:]])
    for name in GROUPS:
        count = len(eb.View([name]).features)
        forecast = "the braking of least forecast cost, and what follows" if name == "plan" else "the next impacts"
        meaning = f"[forecasts](../train.md#forecasts): {forecast}"
        rows.append([f"`{name}`", f"{count} {meaning}", "", "", ""])
    return rows


def info_rows() -> list[list[str]]:
    lines = re.findall(r"^(\w[\w, ]*?)  +(\S.*)$", infos.__doc__ or "", re.MULTILINE)
    return [[", ".join(f"`{n}`" for n in names.split(", ")), meaning.replace("``", "`")] for names, meaning in lines]


def argument_rows() -> list[list[str]]:
    """Each argument of an environment: default, interfaces, meaning (of the first docstring that has it)."""
    meanings: dict[str, str] = {"n_envs": "number of worlds"}
    for door in DOORS.values():
        listed = (getdoc(door) or "").replace("- ``", "").replace("``:", ":")
        for name, text in re.findall(r"^ {0,4}(\w+): (.*?)(?=^ {0,4}\w+: |^$)", listed, re.MULTILINE | re.DOTALL):
            meanings.setdefault(name, " ".join(text.split()).replace("``", "`").rstrip("."))
    rows: dict[str, list[str]] = {}
    for door, function in DOORS.items():
        for name, parameter in signature(function).parameters.items():
            value = getattr(parameter.default, "value", parameter.default)
            default = "required" if value is Parameter.empty else f"`{value!r}`"
            rows.setdefault(name, [f"`{name}`", meanings.get(name, ""), default, ""])
            rows[name][3] += f"{', ' if rows[name][3] else ''}{door}"
    return list(rows.values())


def page() -> str:
    env = eb.EthBrakeEnv()
    rewards = [
        [f"`{name}`", ", ".join(f"{weight:g} `{term}`" for term, weight in params.weights.items() if weight),
         f"`{params.harm_count.name}`"]
        for name, params in REWARDS.items()
    ]  # fmt: skip
    return TEXT.format(
        gymnasium=GYMNASIUM_ID,
        mo=MO_GYMNASIUM_ID,
        pettingzoo=PETTINGZOO_ID,
        action=env.action_space,
        observation=f"Box({env.observation_space.shape}, {env.observation_space.dtype})",
        count=len(USUAL),
        usual=table(["number", "meaning", "unit", "scale", "bounds"], feature_rows(USUAL_ROWS)),
        more=table(["number", "meaning", "unit", "scale", "bounds"], more_features()),
        rewards=table(["reward", "weights", "`harm_count`"], rewards),
        terms=table(["term", "value in a step", "unit"], [[f"`{n}`", m, u] for n, (u, m) in BUILT_IN.items()]),
        infos=table(["key", "meaning"], info_rows()),
        arguments=table(["argument", "meaning", "default", "interfaces"], argument_rows()),
    )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(), "utf-8")
    print(Path(PAGE).relative_to(DOCS.parent))
