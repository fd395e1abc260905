"""Hostile text files, and folders that were edited, exchanged, truncated or invented.

Scenarios, recipes, named worlds and tables of states are changed in the same ways: invalid YAML, wrong
YAML, exchanged values, and the changes of their own keys that ``hostile.yaml`` lists. Policy bundles and run folders
have their own changes.
"""

import atexit
import hashlib
import json
import os
import random
import re
import shutil
import signal
import string
import struct
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import yaml

import ethbrake_marl as eb
from ethbrake_marl.evaluation.varying import states_of
from ethbrake_marl.extensions.studies.named_worlds import NamedWorld, NamedWorlds
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.policies.manifest import content_sha256
from ethbrake_marl.policies.shipped import shipped_policies
from ethbrake_marl.scenario.tables import read_worlds
from ethbrake_marl.training.checkpoint import NUMBERS
from ethbrake_marl.training.session import train
from tests.learning.tiny import LINKS, link_out, newest
from tests.programmes.cage import NASTY, Case, damaged, write

# ---------------------------------------------------------------- text

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
NOT_FINITE = (
    ".nan", ".NaN", ".NAN", ".inf", "-.inf", "+.INF", ".Inf", "nan", "NaN", "inf", "-Infinity", "Infinity", "1e999",
    "-1e400",
)  # fmt: skip
NOT_NUMBERS = (
    '"7"', "seven", "1_000", "0b101", "1:30", "12:30:45", "2026-11-20", "\u0663", "\uff17", "\u2167", "1,5", "+-3",
    "0x", "0o9", "1e", "e5", "--1", "7 m", "true", "null", "~", "[]", "{}", "[[7]]", "{a: {b: {c: 1}}}", "!!float 7",
    "*x", "&x 7", "0xfffffffffffffffff", "9" * 30, "-" + "9" * 5000, "9" * 40000,
)  # fmt: skip
TAGS = (
    "!!python/object/apply:os.system ['touch pwned']", "!!python/name:os.system", "!!python/module:os",
    "!!python/tuple [1]", "!!python/object/new:subprocess.Popen [['touch', 'pwned']]", "!!binary aGk=", "!!set {a, b}",
    "!!omap [a: 1]", "!!timestamp 2026-11-20", "!local thing", "!<tag:yaml.org,2002:str> x", "!!int 7", "! x",
    "!!null ''",
)  # fmt: skip
SPECS = (
    "best_harm:99999999999", "best_harm:1e99", "best_harm:0", "best_harm:0.5", "best_harm:-1", "best_harm:x",
    "best_harm:\u00b2", "best_harm:\u0663",
    "best_harm:" + "9" * 5000, "constant:.inf", "constant:1e400", "constant:nan", "constant:" + "9" * 3000,
    "constant:-7", "e_v2x_bm:eval", "coast:1", "__import__('os').system('touch pwned')", "ppo@/dev/zero", "ppo",
    "hybrid@shipped", "team@.", "learner:1", "Learner", "replay", "a" * 5000, "constant:3;touch pwned",
    "$(touch pwned)", "../../etc/passwd", "ladder", "coast:x", "",
)  # fmt: skip
ESCAPES = (
    "\\e[2J", "\\x1b]0;x\\x07", "\\u202e", "\\u2028", "\\0", "\\r\\nOK", "\\x9b", "\\ud800", "\\uFEFF", "\\a\\b\\v\\f",
    "\\U000e0041",
)  # fmt: skip
BROKEN = (
    "a: b: c", "[", "}", "- x\ny", "'", '"', "a: [1, 2", "\t- a", "@x", "`x`", "a: |x\n", "%", "&", "*", "? ",
    "a:\n b:\nc\n", ": :", "key: 'it's'",
)  # fmt: skip
ELSE = (
    "", "\n\n", "# nothing\n", "---\n", "7", "text", "[1, 2]", "- a\n- b", "null", "\ufeff", "...", '""',
    "<html></html>", '{"cells": []}', "[section]\nkey=1\n", "PK\x03\x04", "\x7fELF", "#!/bin/sh\ntouch pwned\n",
    "import os\n", "GIF89a",
)  # fmt: skip
NEEDED = (
    "name", "gaps_m", "speeds_mps", "braking", "driving", "mass_t", "latency_s", "algorithm", "total", "gamma",
    "n_envs",
)  # fmt: skip
WRONG: tuple[Any, ...] = (
    None, True, -1, 0, 1.5, 10**30, 10**400, 1e300, "", "x" * 9000, [], {}, [[]], {"a": {"b": []}}, *NASTY,
)  # fmt: skip

Change = Callable[[random.Random, str], "str | bytes"]


def lines_of(text: str) -> list[str]:
    """Return the parts of a text, one per key at the top level."""
    return re.split(r"\n(?! )", text.removesuffix("\n"))


def joined(parts: list[str]) -> str:
    return "\n".join(parts) + "\n"


def with_value(rng: random.Random, text: str, value: str, *, numeric: bool = False) -> str:
    """Return the text with another value for one of its keys."""
    parts = lines_of(text)
    k = rng.choice([k for k, p in enumerate(parts) if not numeric or p.split(": ", 1)[-1][0] in string.digits])
    parts[k] = f"{parts[k].split(':')[0]}: {value}"
    return joined(parts)


def with_line(rng: random.Random, text: str, line: str) -> str:
    """Return the text with one more line."""
    parts = lines_of(text)
    parts.insert(rng.randrange(len(parts) + 1), line)
    return joined(parts)


def without(rng: random.Random, text: str) -> str:
    """Return the text without one of its required keys."""
    parts = lines_of(text)
    del parts[rng.choice([k for k, part in enumerate(parts) if part.startswith(NEEDED)])]
    return joined(parts)


def misspelt(rng: random.Random, text: str) -> str:
    """Return the text with one changed letter in one key."""
    parts = lines_of(text)
    k = rng.randrange(len(parts))
    at = rng.randrange(len(parts[k].partition(":")[0]))
    parts[k] = parts[k][:at] + rng.choice("QXZ9") + parts[k][at + 1 :]
    return joined(parts)


def spliced(rng: random.Random, text: str) -> str:
    """Return parts of the text in another order."""
    i, j, k = sorted(rng.randrange(len(text)) for _ in range(3))
    a, b, c, d = text[:i], text[i:j], text[j:k], text[k:]
    return rng.choice((a + c + b + d, a + d, a + b + b + c + d, b + a + c + d))


def quoted(rng: random.Random) -> str:
    """Return a double-quoted scalar with escapes for characters that YAML forbids."""
    return f'"{rng.choice(ESCAPES)}{rng.randrange(99)}"'


def changed_somewhere(rng: random.Random, content: Any) -> Any:
    """Return the JSON content with one value replaced or removed, or with one key renamed."""
    places: list[tuple[Any, Any]] = []

    def walk(part: Any) -> None:
        for key in part if isinstance(part, dict) else range(len(part)):
            places.append((part, key))
            if isinstance(part[key], dict | list):
                walk(part[key])

    content = json.loads(json.dumps(content))
    walk(content)
    part, key = rng.choice(places)
    what = rng.randrange(4)
    if what == 1:
        del part[key]
    elif what == 2 and isinstance(part, dict):
        part[rng.choice(("more", "__class__", "", *NASTY))] = part.pop(key)
    else:
        part[key] = rng.choice([each for each in WRONG if type(each) is not type(part[key]) or each != part[key]])
    return content


def one_of(*texts: str, at: Callable[..., str] = with_line, **how: bool) -> Change:
    """Return a change that adds one of these texts as a line, or as a value."""
    return lambda r, t: at(r, t, r.choice(texts), **how)


def number(*texts: str) -> Change:
    return one_of(*texts, at=with_value, numeric=True)


def times(text: str, *counts: int) -> tuple[str, ...]:
    return tuple(text * count for count in counts)


# Changes that must be refused in every kind of file.
OF_EVERY_FILE: dict[str, Change] = {
    "unknown key": lambda r, t: with_line(r, t, f"{''.join(r.choices(string.ascii_lowercase, k=9))}_q: 1"),
    "misspelt key": misspelt,
    "key twice": lambda r, t: with_line(r, t, r.choice(lines_of(t))),
    "tag": one_of(*TAGS, at=with_value),
    "tag on the document": lambda r, t: f"{r.choice(TAGS).split(' ')[0]}\n{t}",
    "billion laughs": lambda r, t: (
        "a: &a [x, x]\n" + "".join(f"b{k}: &b{k} [*a, *a]\n" for k in range(r.randrange(3, 40))) + t
    ),
    "merge key": one_of("<<: {vehicles: 4}", "<<: [{a: 1}]", "<<:"),
    "directive": lambda r, t: r.choice(("%YAML 1.1\n---\n", "%TAG ! tag:x,1:\n---\n", "%YAML 9.9\n---\n")) + t,
    "second document": lambda r, t: t + r.choice(("---\n", "...\n---\n", "---\n---\n")) + t,
    "deep, in brackets": one_of(*("[" * n + "]" * n for n in (20, 500, 5000, 30000)), at=with_value),
    "deep, open": one_of(*times("[", 20, 999, 9000), *times("{a: ", 20, 9000), *times("[{a: ", 999), at=with_value),
    "deep, by indents": lambda r, t: t + "".join(f"{' ' * k}k:\n" for k in range(r.choice((20, 100, 300)))),
    "deep, by dashes": one_of(*(f"x: \n {dashes}1" for dashes in times("- ", 20, 999, 20000))),
    "wide mapping": lambda r, t: with_value(r, t, f"{{{', '.join(f'k{k}: 1' for k in range(r.choice((99, 4000))))}}}"),
    "many keys": lambda r, t: t + "".join(f"k{k}: 1\n" for k in range(r.choice((99, 4000)))),
    "key that is no text": one_of("? [a, b]\n: 1", "1: 2", "true: 1", "~: 1", "{a: 1}: 2", "1.5: x"),
    "long key": one_of(*(f"{key}: 1" for key in times("a", 129, 900, 1023))),
    "long quoted key": one_of(*(f'? "{key}"\n: 1' for key in times("b", 2000, 60000))),
    "nasty key": one_of(*(f"k{each}: 1" for each in NASTY)),
    "nasty quoted key": lambda r, t: with_line(r, t, f"{quoted(r)}: 1"),
    "look-alike key": one_of("n\u0430me: x", "\uff4eame: x", "name\u200b: x", "tit\u0142e: x", "na\u0301me: y"),
    "UTF-16 or UTF-32": lambda r, t: t.encode(r.choice(("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-be"))),
    "not text": lambda r, t: (
        t.encode()[: (at := r.randrange(len(t)))]
        + r.choice((b"\xff", b"\xc3", b"\xed\xa0\x80", b"\xf5\x80", b"\xc0\xaf", b"\xe2\x80"))
        + t.encode()[at:]
    ),
    "NUL": one_of("\0", "title: a\0b", "\0: 1", "a: \0"),
    "control character": one_of(*(f"title2: {each}" for each in ("\7", "\x1b[2J", "\b", "\x7f", "\1"))),
    "broken syntax": one_of(*BROKEN),
    "something else": lambda r, t: r.choice(ELSE),
    "too large": lambda r, t: t + "#" + "x" * (10 << 20),
}
# Changes that must be refused in files with numbers at their top level.
WITH_NUMBERS: dict[str, Change] = {
    "missing key": without,
    "not finite": number(*NOT_FINITE),
    "not a number": number(*NOT_NUMBERS),
    "out of range": number("-1", "-1e300", "-0.5", "-1e-9"),
    "null": number("null", "~", ""),
    "anchor": number(*(f"&a{k} 7" for k in range(9))),
    "alias": number(*(f"*a{k}" for k in range(9))),
    "wide list": number(*(f"[{', '.join(['7'] * n)}]" for n in (99, 5000, 15000))),
    "long value": number(*(f'"{text}"' for each in ("x", "x y ", "\u00e9", "'") for text in times(each, 300, 9000))),
    "nasty quoted value": lambda r, t: with_value(r, t, quoted(r), numeric=True),
    "nasty name": lambda r, t: t.replace("name: mine", f"name: {quoted(r)}"),
    "other name": lambda r, t: t.replace(
        "name: mine", f"name: {r.choice(('', 'Mine', '../mine', 'a' * 65, 'mine ine', '-x', '7' * 3000 + '_'))}"
    ),
}
# Changes after which a file may be valid.
UNCERTAIN: dict[str, Change] = {
    "any value": lambda r, t: json.dumps(changed_somewhere(r, yaml.safe_load(t)), ensure_ascii=False),
    "spliced": spliced,
    "a value of another key": lambda r, t: with_value(
        r, t, r.choice(lines_of(t)).split(": ", 1)[-1].replace("\n", " ")
    ),
    "nasty text": lambda r, t: t.replace("title: ", f"title: {quoted(r)} # "),
    "damaged": lambda r, t: damaged(r, t.encode()),
}
SEARCHING = ("best_harm", "best_harm:1000000", "e_v2x_bm")
SLOW: dict[str, Change] = {
    "other spelling of a number": number("+7", "0x7", "0o7", ".7", "7.", "7e0", "007", "-0", "7.0"),
    "role": lambda r, t: t.replace("vehicle_3: full_brake", f"vehicle_3: {json.dumps(r.choice(SPECS))}"),
    "long lines of vehicles": lambda r, t: t.replace(
        "vehicles: 3", f"vehicles: {r.choice((1, 0, -3, 64, 65, 10**9, 2**62))}"
    ),
    "slow to draw": lambda r, t: (
        t.replace("early_impacts: keep", "early_impacts: reject")
        .replace("[5, 10]", f"[{r.choice(('0', '1e-9', '1e-300'))}, {r.choice(('1e-8', '0.001', '0.3'))}]")
        .replace("0.8]", f"{r.choice((0.8, 3, 7.9))}]")
    ),
    "slow to search": lambda r, t: (
        t.replace("horizon_s: 8", f"horizon_s: {r.choice((8, 3600))}")
        .replace("time_step_s: 0.1", f"time_step_s: {r.choice((0.1, 0.0001))}")
        .replace("vehicle_3: full_brake", f"vehicle_3: {r.choice(SEARCHING)}")
    ),
}


class Text(NamedTuple):
    """A kind of text file: a valid example, the command and the function that read it, and the number of cases.

    The output of some commands exists already, so a valid file is refused before any training.
    """

    text: str
    command: tuple[str, ...]
    reader: Callable[[str], object]
    each: int = 4  # number of cases per category
    certain: dict[str, Change] = OF_EVERY_FILE
    uncertain: dict[str, Change] = UNCERTAIN
    file: str = "mine.yaml"


@cache
def worlds_text() -> str:
    """Return a valid file of two named worlds, with harms that no agent exceeds."""
    scenario = eb.load_scenario("paper-random")
    states = states_of(scenario.sample(2, 7).worlds, scenario)
    worlds = [NamedWorld(name=f"world-{k}", score=1e6, harm=1e6, state=state) for k, state in enumerate(states)]
    return NamedWorlds.of(
        scenario, scenario="paper-random", settings=["restitution=0.1"], agent="full_brake", measure="harm",
        harm_count="first", found_by="ethbrake study falsify --measure harm", worlds=worlds,
    ).text  # fmt: skip


HEADER = "gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps"
ROW = "7,7,20,18,20"
STATES = f"{HEADER}\n{ROW}\n{ROW}\n{ROW}\n"
# Categories that are checked only when the worlds are simulated.
LATER = ("scenario of worlds", "settings of worlds", "agent of worlds", "measure")


def texts() -> dict[str, Text]:
    """Return all kinds of text files."""
    both, own = {**OF_EVERY_FILE, **WITH_NUMBERS}, {**UNCERTAIN, **SLOW}
    train = ("train", "--recipe", "mine.yaml", "--output", "taken")
    states = ("read-states", "mine.csv")
    again = ("study", "falsify", "--again", "mine.yaml")
    paper = eb.load_scenario("paper-random")
    return {
        "scenario": Text(SCENARIO, ("scenario", "validate", "mine.yaml"), eb.load_scenario, 25, both, own),
        "recipe": Text(RECIPE, train, eb.load_recipe, 28, both, UNCERTAIN),
        "worlds": Text(worlds_text(), again, lambda path: NamedWorlds.read(path).worlds_of(paper, "x")),
        "CSV": Text(
            STATES, states, partial(read_worlds, paper), 10, CSV, {"damaged": UNCERTAIN["damaged"]}, "mine.csv"
        ),
    }


def text_cases(kind: str, rng: random.Random) -> Iterator[Case]:
    """Yield the cases of one kind of file: all common changes, and the listed changes of its own keys."""
    text = texts()[kind]
    for certain, changes in ((True, text.certain), (False, text.uncertain)):
        for category, change in changes.items():
            for _ in range(2 if category == "too large" else text.each * (1 if certain else 2)):
                yield _case(text, category, partial(change, random.Random(rng.random()), text.text), certain)
    listed_here = yaml.safe_load(Path(__file__).with_name("hostile.yaml").read_text("utf-8"))
    for category, listed in listed_here.get(kind, {}).items():
        for new in listed["to"]:
            yield _case(text, category, partial(_exchanged, text.text, listed, new), True)


def _exchanged(text: str, listed: dict[str, Any], new: str) -> str:
    """Return the text with a listed part replaced."""
    if "of" in listed:
        assert listed["of"] in text, listed["of"]
        return text.replace(listed["of"], new, 1)
    at = text.index(listed["line"])
    return text[:at] + listed["line"] + new + text[text.index("\n", at) :]


def _case(text: Text, category: str, content: Callable[[], str | bytes], certain: bool) -> Case:
    def build(folder: Path) -> None:
        write(folder / text.file, content())
        write(folder / "taken", "precious")

    reader = None if category in LATER else partial(text.reader, text.file)
    return Case(category, text.command, build, certain=certain, reader=reader)


# ---------------------------------------------------------------- tables of initial states


def with_field(*texts: str, line: int | None = None) -> Change:
    """Return a change that replaces one field of the table."""

    def change(rng: random.Random, text: str) -> str:
        rows = [row.split(",") for row in text.splitlines()]
        rows[rng.randrange(1, 4) if line is None else line][rng.randrange(5)] = rng.choice(texts)
        return joined([",".join(row) for row in rows])

    return change


def whole(*contents: str | bytes) -> Change:
    return lambda r, t: r.choice(contents)


NAMES = [each.replace("\r\n", " ") for each in NASTY]
CSV: dict[str, Change] = {
    "not finite": with_field(*NOT_FINITE),
    "not a number": with_field(*(each for each in NOT_NUMBERS if "," not in each)),
    "out of range": with_field("-1", "1e300", "-1e-9", "201", "1e999", "99999999"),
    "empty field": with_field("", " ", '""', "\t", "\xa0"),
    "nasty field": with_field(*NAMES),
    "formula": with_field("=1+1", "=cmd|'/c calc'!A1", "@SUM(1)", "+7-", "-7+1", "=HYPERLINK(1)"),
    "long field": with_field(*(text + "z" for text in times("9", 3000, 200_000, 2_000_000))),
    "nasty column": with_field(*NAMES, line=0),
    "unknown column": with_field("gap_3_m", "speed_0_mps", "x" * 5000, "GAP_1_M", "gap_1_km", "", "__class__", line=0),
    "column twice": lambda r, t: t.replace("gap_2_m", "gap_1_m"),
    "many columns": whole(*(",".join(["gap_1_m"] * n) + "\n1\n" for n in (20, 5000, 100_000))),
    "columns short or over": with_field("7,7", "7,7,7,7", "7\n7"),
    "other separator": lambda r, t: t.replace(",", r.choice((";", "\t", "|", " ", "\x1f"))),
    "no rows": whole("", HEADER, HEADER + "\n", "\n\n\n", "\n" * 100_000, HEADER + "\n\n\n", ",,,,\n", "\ufeff"),
    "quotes": with_field('"7', '7"7', '"7"7"', '"' * 999, '"7\n7\n7'),
    "UTF-16 or UTF-32": OF_EVERY_FILE["UTF-16 or UTF-32"],
    "not text": lambda r, t: t.encode() + r.choice((b"\xff\xfe", b"\xc3(", b"\xed\xa0\x80", b"\x80")),
    "NUL": with_field("\0", "7\0", "\0\0\0"),
    "too large": lambda r, t: b"7" * ((64 << 20) + 1),
    "something else": whole(
        b"PK\x03\x04" * 9, b"\x7fELF", b"<html>", b"{}", b"%PDF-1.7", b"SQLite format 3\0", b"\x1f\x8b\x08"
    ),
}


# ---------------------------------------------------------------- folders

Spoil = Callable[[random.Random, Path], object]
NO_JSON = (
    b"", b"{", b"[" * 99999, b"NaN", b"\xff\xfe", b"{}{}", b"9" * 99999, b'{"a": 1, "a": 2}', b"null", b"[]", b"7",
    b'"x"', b'{"a": 1e999}', b'{"format": "\x1b[2J"}', b'{"status": "\\u202e"}', b" " * 99999, b'"' + b"x" * 99999,
    "{}".encode("utf-16"), b"\xef\xbb\xbf{}", b'{"\\ud800": 1}',
)  # fmt: skip


def edited(rng: random.Random, path: Path) -> None:
    """Change one value in a JSON file."""
    path.write_text(json.dumps(changed_somewhere(rng, json.loads(path.read_text()))))


def no_json(rng: random.Random, path: Path) -> None:
    path.write_bytes(rng.choice(NO_JSON))


def plain_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def damaged_file(rng: random.Random, folder: Path) -> None:
    path = rng.choice([path for path in plain_files(folder) if path.stat().st_size])
    path.write_bytes(damaged(rng, path.read_bytes()))


# ---------------------------------------------------------------- bundles

MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"
EVALUATE = ("evaluate", "--episodes", "2", "--agents", "ppo@policy")


def _signed(folder: Path, **changes: str) -> None:
    """Change a manifest, and compute its hash again."""
    content = json.loads((folder / MANIFEST).read_text())
    if isinstance(content, dict):
        content |= changes
        content["manifest_sha256"] = content_sha256(content)
    (folder / MANIFEST).write_text(json.dumps(content))


def _header(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the header of the weights, with correct hashes."""
    data = (folder / WEIGHTS).read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = change(json.loads(data[8 : 8 + size]))
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    _weights(folder, struct.pack("<Q", len(text)) + text + data[8 + size :])


def _weights(folder: Path, data: bytes) -> None:
    (folder / WEIGHTS).write_bytes(data)
    _signed(folder, weights_sha256=hashlib.sha256(data).hexdigest())


# Changes of a tensor in the header, by its name.
Entries = dict[str, Any]
TENSORS: tuple[Callable[[random.Random, Entries, str], object], ...] = (
    lambda r, h, name: h[name].update(dtype=r.choice(("F64", "BF16", "I8", "F8_E4M3", "OBJECT", None, 7, "x" * 5000))),
    lambda r, h, name: h[name].update(
        shape=r.choice(([], [-1], [10**30], None, "x", [1.5], [[1]], [True], [*h[name]["shape"][::-1], 1]))
    ),
    lambda r, h, name: h[name].update(data_offsets=r.choice(([0, 10**12], [-4, 4], [8, 0], None, [0], "x", [0, 0]))),
    lambda r, h, name: h.pop(name),
    lambda r, h, name: h.update({r.choice(("more", "../x", "", *NASTY)): h.pop(name)}),
    lambda r, h, name: h.update({name: r.choice((None, 7, [], "x", {}))}),
)


def _tensor(rng: random.Random, header: Entries) -> Entries:
    rng.choice(TENSORS)(rng, header, rng.choice([each for each in header if each != "__metadata__"]))
    return header


def _linked(path: Path) -> None:
    path.symlink_to(path.rename(path.parents[1] / path.name))


BUNDLES: dict[str, Spoil] = {
    "manifest edited": lambda r, f: edited(r, f / MANIFEST),
    "manifest is no JSON": lambda r, f: no_json(r, f / MANIFEST),
    "header of the weights": lambda r, f: _header(f, lambda h: _tensor(r, h)),
    "header is no table": lambda r, f: _header(
        f, lambda h: r.choice((b"", b"[]", b"{", b"[" * 9999, b"7", b"\xff\xff", b'{"a": 1, "a": 2}', b" " * 99))
    ),
    "length of the header": lambda r, f: _weights(
        f, struct.pack("<Q", r.choice((0, 1, 2**63, 2**64 - 1, 10**9))) + (f / WEIGHTS).read_bytes()[8:]
    ),
    "weights not finite": lambda r, f: _weights(
        f, (f / WEIGHTS).read_bytes()[:-4] + struct.pack("<f", r.choice((float("nan"), float("inf"), float("-inf"))))
    ),
    "weights cut or longer": lambda r, f: _weights(
        f,
        r.choice(
            (
                (f / WEIGHTS).read_bytes()[: -r.randrange(1, 999)],
                (f / WEIGHTS).read_bytes() + bytes(r.randrange(1, 99)),
                b"",
                b"\x80\x04N.",
            )
        ),
    ),
    "weights of another hash": lambda r, f: (f / WEIGHTS).write_bytes((f / WEIGHTS).read_bytes()[:-1] + b"\x99"),
    "a file missing": lambda r, f: (f / r.choice((MANIFEST, WEIGHTS))).unlink(),
    "a file more": lambda r, f: write(
        f / r.choice(("policy.pkl", "__init__.py", "x" * 200, ".hidden", "evil\x1b[2J.py", "\u202eyp.x", "a\nb")),
        b"raise SystemExit",
    ),
    "a link for a file": lambda r, f: _linked(f / r.choice((MANIFEST, WEIGHTS))),
    "a link for the folder": lambda r, f: (f.rename(f.with_name("real")), f.symlink_to("real")),
    "no folder": lambda r, f: (
        shutil.rmtree(f),
        r.choice((lambda: f.write_bytes(b"x"), lambda: f.mkdir(), lambda: None))(),
    ),
}


def bundle_cases(rng: random.Random) -> Iterator[Case]:
    """Yield bundles: 15 cases of each category, and 60 of categories that may be valid."""
    uncertain: dict[str, Spoil] = {
        "manifest edited and hashed anew": lambda r, f: (edited(r, f / MANIFEST), _signed(f)),
        "damaged": damaged_file,
    }
    for certain, changes in ((True, BUNDLES), (False, uncertain)):
        for category, change in changes.items():
            for _ in range(15 if certain else 60):
                build = partial(_changed, bundle, change, rng.random())
                yield Case(category, EVALUATE, build, certain=certain, reader=partial(load_policy, "policy"))


def bundle(folder: Path) -> Path:
    """Copy a valid bundle that may be changed."""
    shutil.copytree(shipped_policies()["ppo"] / "policy", folder / "policy", copy_function=shutil.copyfile)
    (folder / "policy").chmod(0o755)
    return folder / "policy"


def _changed(begin: Callable[[Path], Path], change: Spoil, seed: float, folder: Path) -> None:
    """Apply ``change`` to the result of ``begin``."""
    change(random.Random(seed), begin(folder))


# ---------------------------------------------------------------- run folders

RUN = "run"
SMALL: dict[str, Any] = {
    "n_envs": 4,
    "batch_size": 16,
    "network": {"policy": [4], "value": [4]},
    "evaluation": {"every_updates": 2, "worlds": 2, "seed": 7},
}
SETTINGS = {
    "ppo": {**SMALL, "n_steps": 8, "n_epochs": 1, "total_steps": 256, "checkpoint_every_updates": 2},
    "sac": {
        **SMALL,
        "buffer_size": 64,
        "learning_starts": 8,
        "total_steps": 64,
        "checkpoint_every_updates": 4,
        "log_every_updates": 2,
    },
}


@cache
def stopped(algorithm: str) -> Path:
    """Return the folder of an interrupted training with checkpoints, which can be resumed for a few updates."""
    folder = Path(tempfile.mkdtemp(prefix="hostile-runs-")) / RUN
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    seen = []

    def measure(policy: object) -> dict[str, float]:
        seen.append(policy)
        if len(seen) == 4:
            signal.raise_signal(signal.SIGINT)
        return {"first_impact_harm": 1.0, "total_harm": 1.0}

    recipe = eb.load_recipe(algorithm).replace(**SETTINGS[algorithm])
    train(recipe, eb.load_scenario("paper-random"), folder, measure=lambda training: measure)
    assert json.loads((folder / "run.json").read_text())["status"] == "interrupted"
    return folder


def _text_of_table(rng: random.Random, path: Path) -> None:
    path.write_bytes(
        rng.choice(
            (
                b"\xff\xfe\x00",
                b"steps\n" + b"x" * 200_000,
                b"a,b\n1,2\n",
                b"steps,steps\n1,1\n",
                b"steps\n1,2,3\n",
                b"\0",
                b'"steps\n1',
                b"steps,\x1b[2J\n1,2\n",
                b"",
            )
        )
    )


def _link(name: str, rng: random.Random, run: Path) -> None:
    link_out(name, run)


def _pipe(rng: random.Random, run: Path) -> None:
    path = rng.choice(plain_files(run))
    path.unlink()
    os.mkfifo(path)


def _swapped(rng: random.Random, run: Path) -> None:
    """Exchange the contents of two files of the run."""
    one, other = rng.sample(plain_files(run), 2)
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)


def _lost(rng: random.Random, run: Path) -> None:
    path = rng.choice(sorted(run.rglob("*")))
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _more(rng: random.Random, run: Path) -> None:
    name = rng.choice(
        (
            "checkpoints/step_x",
            "checkpoints/step_999999999999",
            "policy/evil.py",
            "run.lock",
            "\x1b[2J",
            "checkpoints/step_\u202e",
            "tensorboard/events.x",
            "team.json.bak",
        )
    )
    if rng.random() < 0.5 and not (run / name).exists():
        write(run / name / NUMBERS, rng.choice(("{}", "", "[" * 9999)))
    else:
        write(run / name, "x")


# Category -> (algorithms, cases per algorithm, whether it must be refused, change).
CHANGES: dict[str, tuple[tuple[str, ...], int, bool, Spoil]] = {
    "config.json edited": (("ppo",), 60, False, lambda r, f: edited(r, f / "config.json")),
    "config.json is no JSON": (("ppo",), 17, True, lambda r, f: no_json(r, f / "config.json")),
    "run.json edited": (("ppo",), 40, False, lambda r, f: edited(r, f / "run.json")),
    "run.json is no JSON": (("ppo",), 17, True, lambda r, f: no_json(r, f / "run.json")),
    "team.json edited": (("ppo",), 10, False, lambda r, f: edited(r, f / "team.json")),
    "something lost": (("ppo", "sac"), 40, False, _lost),
    "something damaged": (("ppo", "sac"), 60, False, damaged_file),
    "something more": (("ppo",), 24, False, _more),
    "files exchanged": (("ppo", "sac"), 25, False, _swapped),
    "a pipe for a file": (("ppo", "sac"), 25, False, _pipe),
    **{f"{name}: link outside": (("ppo",), 1, certain, partial(_link, name)) for name, (_, certain) in LINKS.items()},
    "progress.csv damaged": (("ppo",), 10, False, lambda r, f: _text_of_table(r, f / "progress.csv")),
    "checkpoint: numbers edited": (("ppo", "sac"), 40, False, lambda r, f: edited(r, newest(f) / NUMBERS)),
    "checkpoint: numbers are no JSON": (("ppo",), 17, False, lambda r, f: no_json(r, newest(f) / NUMBERS)),
    "checkpoint: files damaged": (("ppo", "sac"), 70, False, lambda r, f: damaged_file(r, newest(f))),
    "checkpoint: of another training": (
        ("ppo",),
        1,
        True,
        lambda r, f: (
            shutil.rmtree(newest(f)),
            shutil.copytree(newest(stopped("sac")), f / "checkpoints" / "step_999999999999"),
        ),
    ),
}


def run_cases(kind: str, rng: random.Random) -> Iterator[Case]:
    """Yield interrupted trainings, resumed after a change in a ``checkpoint``, or elsewhere in the ``run``."""
    for category, (algorithms, count, certain, change) in CHANGES.items():
        if category.startswith("checkpoint: ") == (kind == "checkpoint"):
            for algorithm in [each for each in algorithms for _ in range(count)]:
                build = partial(_changed, partial(_run, algorithm), change, rng.random())
                name = category.removeprefix("checkpoint: ")
                yield Case(name, ("train", "--resume", RUN), build, certain=certain, may_change=(RUN,))


def _run(algorithm: str, folder: Path) -> Path:
    return shutil.copytree(stopped(algorithm), folder / RUN)
