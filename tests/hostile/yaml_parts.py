"""A scenario and a recipe that are in order, and the ways in which their text is changed."""

from __future__ import annotations

import random
import string
from collections.abc import Callable

SCENARIO = """name: mine
title: A line of three
description: What a stranger sends.
vehicles: 3
time_step_s: 0.1
horizon_s: 8
gaps_m: {uniform: [5, 10]}
speeds_mps: {uniform: [18, 22]}
braking_capacity_mps2: [6, 7, 6]
driving_capacity_mps2: [6, 7, 6]
mass_t: [4.5, 5.5, 5.9]
latency_s: [0, 0.5, 0.8]
speed_limit_mps: 40
restitution: 0.1
early_impacts: keep
roles:
  vehicle_1: full_brake
  vehicle_2: learner
  vehicle_3: full_brake
"""
RECIPE = """name: mine
title: Two updates
algorithm: ppo
total_steps: 256
n_envs: 16
n_steps: 8
batch_size: 64
n_epochs: 1
learning_rate: {start: 3.0e-4, end: 3.0e-5}
gamma: 0.99
gae_lambda: 0.95
clip_range: 0.2
ent_coef: 0.0
vf_coef: 0.5
max_grad_norm: 0.5
network: {policy: [8], value: [8]}
reward: {harm: 1.0}
seed: 3
evaluation: {every_updates: 1, worlds: 10, seed: 7}
checkpoint_every_updates: 100
"""
SAC = RECIPE.replace("algorithm: ppo", "algorithm: sac").replace("n_steps: 8\n", "").replace("n_epochs: 1\n", "")

NOT_FINITE = (
    ".nan",
    ".NaN",
    ".NAN",
    ".inf",
    "-.inf",
    "+.INF",
    ".Inf",
    "nan",
    "NaN",
    "inf",
    "-Infinity",
    "Infinity",
    "1e999",
    "-1e400",
)
NOT_NUMBERS = (
    '"7"',
    "seven",
    "1_000",
    "0b101",
    "1:30",
    "12:30:45",
    "2026-11-20",
    "\u0663",
    "\uff17",
    "\u2167",
    "1,5",
    "+-3",
    "0x",
    "0o9",
    "1e",
    "e5",
    "--1",
    "7 m",
    "true",
    "null",
    "~",
    "[]",
    "{}",
    "[[7]]",
    "{a: {b: {c: 1}}}",
    "!!float 7",
    "*x",
    "&x 7",
    "0xfffffffffffffffff",
    "9" * 30,
    "-" + "9" * 5000,
    "9" * 40000,
)
TAGS = (
    "!!python/object/apply:os.system ['touch pwned']",
    "!!python/name:os.system",
    "!!python/module:os",
    "!!python/tuple [1]",
    "!!python/object/new:subprocess.Popen [['touch', 'pwned']]",
    "!!binary aGk=",
    "!!set {a, b}",
    "!!omap [a: 1]",
    "!!timestamp 2026-11-20",
    "!local thing",
    "!<tag:yaml.org,2002:str> x",
    "!!int 7",
    "! x",
    "!!null ''",
)
SPECS = (
    "planner:99999999999",
    "best_harm:99999999999",
    "planner:1e99",
    "planner:" + "9" * 4000,
    "planner:999999999ms",
    "planner:0",
    "planner:0.5",
    "planner:-1",
    "planner:\u0663",
    "best_harm:0",
    "best_harm:x",
    "best_harm:\u00b2",
    "best_harm:" + "9" * 5000,
    "constant:.inf",
    "constant:1e400",
    "constant:nan",
    "constant:" + "9" * 3000,
    "constant:-7",
    "e_v2x_bm:eval",
    "coast:1",
    "__import__('os').system('touch pwned')",
    "ppo@/dev/zero",
    "ppo@shipped",
    "hybrid@shipped",
    "team@.",
    "learner:1",
    "Learner",
    "replay",
    "a" * 5000,
    "constant:3;touch pwned",
    "$(touch pwned)",
    "../../etc/passwd",
    "ladder",
    "gentlest_front:x",
    "",
)

Change = Callable[[random.Random, str], str]


def lines_of(text: str) -> list[str]:
    """The lines that give a key at the top level, with those that belong to it."""
    parts: list[str] = []
    for line in text.splitlines():
        if line.startswith(" "):
            parts[-1] += "\n" + line
        else:
            parts.append(line)
    return parts


def with_value(rng: random.Random, text: str, value: str, *, numeric: bool = False) -> str:
    """The text with another value under one of its keys."""
    parts = lines_of(text)
    good = [k for k, part in enumerate(parts) if not numeric or part.split(": ", 1)[-1][0] in string.digits]
    k = rng.choice(good)
    parts[k] = f"{parts[k].split(':')[0]}: {value}"
    return "\n".join(parts) + "\n"


def with_line(rng: random.Random, text: str, line: str) -> str:
    """The text with one more line."""
    parts = lines_of(text)
    parts.insert(rng.randrange(len(parts) + 1), line)
    return "\n".join(parts) + "\n"


def replaced(text: str, old: str, new: str) -> str:
    """The text with the first ``old``, which is there, replaced."""
    if old not in text:
        raise ValueError(f"{old!r} is not in the text")
    return text.replace(old, new, 1)


def without(rng: random.Random, text: str) -> str:
    """The text without one of the keys that are needed."""
    needed = (
        "name",
        "gaps_m",
        "speeds_mps",
        "braking",
        "driving",
        "mass_t",
        "latency_s",
        "algorithm",
        "total",
        "gamma",
        "n_envs",
    )
    parts = lines_of(text)
    del parts[rng.choice([k for k, part in enumerate(parts) if part.startswith(needed)])]
    return "\n".join(parts) + "\n"


def misspelt(rng: random.Random, text: str) -> str:
    """The text with one letter of one key changed."""
    parts = lines_of(text)
    k = rng.randrange(len(parts))
    key, colon, rest = parts[k].partition(":")
    at = rng.randrange(len(key))
    parts[k] = key[:at] + rng.choice("QXZ9") + key[at + 1 :] + colon + rest
    return "\n".join(parts) + "\n"


def spliced(rng: random.Random, text: str) -> str:
    """Pieces of the text in another order."""
    cuts = sorted(rng.randrange(len(text)) for _ in range(3))
    a, b, c, d = text[: cuts[0]], text[cuts[0] : cuts[1]], text[cuts[1] : cuts[2]], text[cuts[2] :]
    return rng.choice((a + c + b + d, a + d, a + b + b + c + d, b + a + c + d))


def long(rng: random.Random) -> str:
    """Text that is long, as one word or as many."""
    return rng.choice(("x", "x y ", "\u00e9", "\U0001f697", "'", "\\")) * rng.choice((300, 5_000, 9_000))


def quoted(rng: random.Random) -> str:
    """A double-quoted scalar whose escapes make what YAML forbids in the open."""
    bad = rng.choice(
        (
            "\\e[2J",
            "\\x1b]0;x\\x07",
            "\\u202e",
            "\\u2028",
            "\\0",
            "\\r\\nOK",
            "\\x9b",
            "\\ud800",
            "\\uFEFF",
            "\\a\\b\\v\\f",
            "\\U000e0041",
        )
    )
    return f'"{bad}{rng.randrange(99)}"'
