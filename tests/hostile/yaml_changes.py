"""Categories of text that is no scenario and no recipe, and of text that may be one."""

from __future__ import annotations

import random
import string

from tests.hostile.case import NASTY
from tests.hostile.yaml_parts import (
    NOT_FINITE,
    NOT_NUMBERS,
    SPECS,
    TAGS,
    Change,
    lines_of,
    long,
    misspelt,
    quoted,
    spliced,
    with_line,
    with_value,
    without,
)

NOBODY = ("vehicle_4", "vehicle_0", "vehicle_-1", "vehicle_", "Vehicle_1", "v" * 3000, "vehicle_99999999999999999999")
CHANNELS = ("x", "7", "{preset: x}", "{latency_s: 1}", "[]", "{a: {b: 1}}", "null", "{preset: [1]}")
OBJECTIVES = ("x", "7", "[]", "[total]", "{a: 1}", "null", "[total, total, total, total]", "[1, 2, 3]")
SEARCHING = ("planner", "best_harm", "planner:1000000", "best_harm:1000000", "planner:60000ms", "e_v2x_bm")

# What is refused for certain, whatever the values of the random choices.
CERTAIN: dict[str, Change] = {
    "unknown key": lambda r, t: with_line(r, t, f"{''.join(r.choices(string.ascii_lowercase, k=9))}_q: 1"),
    "misspelt key": misspelt,
    "missing key": without,
    "key twice": lambda r, t: with_line(r, t, r.choice(lines_of(t))),
    "not finite": lambda r, t: with_value(r, t, r.choice(NOT_FINITE), numeric=True),
    "not a number": lambda r, t: with_value(r, t, r.choice(NOT_NUMBERS), numeric=True),
    "out of range": lambda r, t: with_value(r, t, r.choice(("-1", "-1e300", "-0.5", "-1e-9")), numeric=True),
    "null": lambda r, t: with_value(r, t, r.choice(("null", "~", "")), numeric=True),
    "tag": lambda r, t: with_value(r, t, r.choice(TAGS)),
    "tag on the document": lambda r, t: f"{r.choice(TAGS).split(' ')[0]}\n{t}",
    "anchor": lambda r, t: with_value(r, t, f"&a{r.randrange(9)} 7", numeric=True),
    "alias": lambda r, t: with_value(r, t, f"*a{r.randrange(9)}", numeric=True),
    "billion laughs": lambda r, t: (
        "a: &a [x, x]\n" + "".join(f"b{k}: &b{k} [*a, *a]\n" for k in range(r.randrange(3, 40))) + t
    ),
    "merge key": lambda r, t: with_line(r, t, r.choice(("<<: {vehicles: 4}", "<<: [{a: 1}]", "<<:"))),
    "directive": lambda r, t: r.choice(("%YAML 1.1\n---\n", "%TAG ! tag:x,1:\n---\n", "%YAML 9.9\n---\n")) + t,
    "second document": lambda r, t: t + r.choice(("---\n", "...\n---\n", "---\n---\n")) + t,
    "deep, in brackets": lambda r, t: with_value(r, t, "[" * (n := r.choice((20, 500, 5000, 30000))) + "]" * n),
    "deep, open": lambda r, t: with_value(r, t, r.choice(("[", "{a: ", "[{a: ")) * r.choice((20, 999, 9000))),
    "deep, by indents": lambda r, t: t + "".join(f"{' ' * k}k:\n" for k in range(r.choice((20, 100, 300)))),
    "deep, by dashes": lambda r, t: with_line(r, t, "x: \n " + "- " * r.choice((20, 999, 20000)) + "1"),
    "wide list": lambda r, t: with_value(r, t, f"[{', '.join(['7'] * r.choice((99, 5000, 15000)))}]", numeric=True),
    "wide mapping": lambda r, t: with_value(
        r, t, "{" + ", ".join(f"k{k}: 1" for k in range(r.choice((99, 4000)))) + "}"
    ),
    "many keys": lambda r, t: t + "".join(f"k{k}: 1\n" for k in range(r.choice((99, 4000)))),
    "key that is no text": lambda r, t: with_line(
        r, t, r.choice(("? [a, b]\n: 1", "1: 2", "true: 1", "~: 1", "{a: 1}: 2", "1.5: x"))
    ),
    "long key": lambda r, t: with_line(r, t, f"{r.choice('abc') * r.choice((129, 900, 1023))}: 1"),
    "long quoted key": lambda r, t: with_line(r, t, f'? "{r.choice("abc") * r.choice((2000, 60000))}"\n: 1'),
    "long value": lambda r, t: with_value(r, t, f'"{long(r).translate({34: None, 92: None})}"', numeric=True),
    "nasty key": lambda r, t: with_line(r, t, f"k{r.choice(NASTY)}: 1"),
    "nasty quoted key": lambda r, t: with_line(r, t, f"{quoted(r)}: 1"),
    "nasty quoted value": lambda r, t: with_value(r, t, quoted(r), numeric=True),
    "nasty name": lambda r, t: t.replace("name: mine", f"name: {quoted(r)}"),
    "look-alike key": lambda r, t: with_line(
        r, t, r.choice(("n\u0430me: x", "\uff4eame: x", "name\u200b: x", "tit\u0142e: x", "na\u0301me: y"))
    ),
    "other name": lambda r, t: t.replace(
        "name: mine", f"name: {r.choice(('', 'Mine', '../mine', 'a' * 65, 'mine ine', '-x', '7' * 3000 + '_'))}"
    ),
    "UTF-16 or UTF-32": lambda r, t: t,  # see _encoded
    "not text": lambda r, t: t,
    "NUL": lambda r, t: with_line(r, t, r.choice(("\0", "title: a\0b", "\0: 1", "a: \0"))),
    "control character": lambda r, t: with_line(
        r, t, f"title2: {r.choice((chr(7), chr(27) + '[2J', chr(8), chr(127), chr(1)))}"
    ),
    "broken syntax": lambda r, t: with_line(
        r,
        t,
        r.choice(
            (
                "a: b: c",
                "[",
                "}",
                "- x\ny",
                "'",
                '"',
                "a: [1, 2",
                "\t- a",
                "@x",
                "`x`",
                "a: |x\n",
                "%",
                "&",
                "*",
                "? ",
                "a:\n b:\nc\n",
                ": :",
                "key: 'it's'",
            )
        ),
    ),
    "too large": lambda r, t: t + "#" + "x" * r.choice((1 << 16, 1 << 20, 10 << 20)),
    "no mapping": lambda r, t: r.choice(
        ("", "\n\n", "# nothing\n", "---\n", "7", "text", "[1, 2]", "- a\n- b", "null", "\ufeff", "...", '""')
    ),
    "a dump of something else": lambda r, t: r.choice(
        (
            "<html></html>",
            '{"cells": []}',
            "[section]\nkey=1\n",
            "PK\x03\x04",
            "\x7fELF",
            "#!/bin/sh\ntouch pwned\n",
            "import os\n",
            "GIF89a",
        )
    ),
}

# What may be in order too.
UNCERTAIN: dict[str, Change] = {
    "spliced": spliced,
    "a value of another key": lambda r, t: with_value(
        r, t, r.choice(lines_of(t)).split(": ", 1)[-1].replace("\n", " ")
    ),
    "other spelling of a number": lambda r, t: with_value(
        r, t, r.choice(("+7", "0x7", "0o7", ".7", "7.", "7e0", "007", "-0", "7.0")), numeric=True
    ),
    "nasty text": lambda r, t: t.replace("title: ", f"title: {quoted(r)} # "),
}


def encoded(rng: random.Random, category: str, text: str) -> bytes | str:
    if category == "UTF-16 or UTF-32":
        return text.encode(rng.choice(("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-be")))
    if category == "not text":
        data = text.encode()
        at = rng.randrange(len(data))
        return (
            data[:at]
            + rng.choice((b"\xff", b"\xc3", b"\xed\xa0\x80", b"\xf5\x80", b"\xc0\xaf", b"\xe2\x80"))
            + data[at:]
        )
    return text


SCENARIO_ONLY: dict[str, tuple[bool, Change]] = {
    "role": (
        False,
        lambda r, t: t.replace(
            "vehicle_3: full_brake",
            f"vehicle_3: '{r.choice(SPECS)}'".replace("('", '("').replace("')", '")')
            if r.random() < 0.5
            else f'vehicle_3: "{r.choice(SPECS)}"',
        ),
    ),
    "role of nobody": (True, lambda r, t: t + f"  {r.choice(NOBODY)}: coast\n"),
    "distribution": (
        True,
        lambda r, t: t.replace(
            "{uniform: [5, 10]}",
            r.choice(
                (
                    "{uniform: [10, 5]}",
                    "{uniform: []}",
                    "{uniform: [1, 2, 3]}",
                    "{normal: {mean: 0}}",
                    "{choice: []}",
                    "{loguniform: [0, 1]}",
                    "{uniform: [5, .inf]}",
                    "{poisson: 3}",
                    "{uniform: [5, 9], choice: [1]}",
                    "{uniform: {low: 1}}",
                    "{choice: [[1]]}",
                    "{normal: {mean: 7, sd: -1e-320, low: 5, high: 9}}",
                    "{normal: {mean: 1e308, sd: 1, low: 5, high: 9}}",
                    "{choice: [7], weights: [1e999]}",
                )
            ),
        ),
    ),
    "lists of other lengths": (
        True,
        lambda r, t: t.replace("[4.5, 5.5, 5.9]", str([5.0] * r.choice((0, 1, 2, 4, 64, 3000)))),
    ),
    "channel": (False, lambda r, t: t + f"v2x: {r.choice(CHANNELS)}\n"),
    "objective": (False, lambda r, t: t + f"objective: {r.choice(OBJECTIVES)}\n"),
    "long lines of vehicles": (
        False,
        lambda r, t: t.replace("vehicles: 3", f"vehicles: {r.choice((1, 0, -3, 64, 65, 10**9, 2**62))}"),
    ),
    "slow to draw": (
        False,
        lambda r, t: (
            t.replace("early_impacts: keep", "early_impacts: reject")
            .replace("[5, 10]", f"[{r.choice(('0', '1e-9', '1e-300'))}, {r.choice(('1e-8', '0.001', '0.3'))}]")
            .replace("0.8]", f"{r.choice((0.8, 3, 7.9))}]")
        ),
    ),
    "slow to search": (
        False,
        lambda r, t: (
            t.replace("horizon_s: 8", f"horizon_s: {r.choice((8, 3600))}")
            .replace("time_step_s: 0.1", f"time_step_s: {r.choice((0.1, 0.0001))}")
            .replace("vehicle_3: full_brake", f"vehicle_3: {r.choice(SEARCHING)}")
        ),
    ),
}
