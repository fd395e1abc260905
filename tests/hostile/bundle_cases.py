"""Policy bundles and team files that were edited, swapped, cut or made up."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ethbrake_marl.policies import content_sha256, load_policy, shipped_policies
from tests.hostile.case import NASTY, Case, damaged, write

MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"
COMMAND = ("evaluate", "--episodes", "2", "--agents", "ppo@policy")
WRONG: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    10**30,
    10**400,
    1e300,
    "",
    "x" * 9000,
    [],
    {},
    [[]],
    {"a": {"b": []}},
    *NASTY,
)


def source() -> Path:
    """A bundle that is in order."""
    return shipped_policies()["ppo"] / "policy"


def changed_somewhere(rng: random.Random, content: Any, value: Any = ...) -> Any:
    """JSON with one value, anywhere in it, replaced, removed, or given another key."""
    places: list[tuple[Any, Any]] = []

    def walk(part: Any) -> None:
        for key in part if isinstance(part, dict) else range(len(part)):
            places.append((part, key))
            if isinstance(part[key], dict | list):
                walk(part[key])

    content = json.loads(json.dumps(content))
    walk(content)
    part, key = rng.choice(places)
    match rng.randrange(4) if value is ... else 0:
        case 1:
            del part[key]
        case 2 if isinstance(part, dict):
            part[rng.choice(("more", "__class__", "", *NASTY))] = part.pop(key)
        case _:
            wrong = rng.choice([each for each in WRONG if type(each) is not type(part[key]) or each != part[key]])
            part[key] = wrong if value is ... else value
    return content


def _manifest(rng: random.Random, folder: Path, *, signed: bool) -> None:
    """A value of the manifest changed, with a hash that fits or that does not."""
    content = changed_somewhere(rng, json.loads((folder / MANIFEST).read_text()))
    if signed and isinstance(content, dict):
        content["manifest_sha256"] = content_sha256(content)
    (folder / MANIFEST).write_text(json.dumps(content))


def _header(rng: random.Random, folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Another header of the weights, with hashes that fit."""
    data = (folder / WEIGHTS).read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = change(json.loads(data[8 : 8 + size]))
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    _weights(folder, struct.pack("<Q", len(text)) + text + data[8 + size :])


def _weights(folder: Path, data: bytes) -> None:
    (folder / WEIGHTS).write_bytes(data)
    content = json.loads((folder / MANIFEST).read_text())
    content["weights_sha256"] = hashlib.sha256(data).hexdigest()
    content["manifest_sha256"] = content_sha256(content)
    (folder / MANIFEST).write_text(json.dumps(content))


def _tensor(rng: random.Random, header: dict[str, Any]) -> dict[str, Any]:
    name = rng.choice([each for each in header if each != "__metadata__"])
    entry = header[name]
    match rng.randrange(6):
        case 0:
            entry["dtype"] = rng.choice(("F64", "BF16", "I8", "F8_E4M3", "OBJECT", None, 7, "x" * 5000))
        case 1:
            entry["shape"] = rng.choice(
                ([], [-1], [10**30], None, "x", [1.5], [[1]], [True], [*entry["shape"][::-1], 1])
            )
        case 2:
            entry["data_offsets"] = rng.choice(([0, 10**12], [-4, 4], [8, 0], None, [0], "x", [0, 0]))
        case 3:
            del header[name]
        case 4:
            header[rng.choice(("more", "../x", "", *NASTY))] = header.pop(name)
        case _:
            header[name] = rng.choice((None, 7, [], "x", {}))
    return header


CERTAIN: dict[str, Callable[[random.Random, Path], object]] = {
    "manifest edited": lambda r, f: _manifest(r, f, signed=False),
    "manifest is no JSON": lambda r, f: (f / MANIFEST).write_bytes(
        r.choice(
            (
                b"",
                b"{",
                b"[" * 99999,
                b"NaN",
                b"\xff",
                b"{}{}",
                b"9" * 99999,
                b'{"a": 1, "a": 1}',
                b'"' + b"x" * 99999,
                "{}".encode("utf-16"),
                b"\xef\xbb\xbf{}",
                b"null",
                b"[]",
                b'{"a": 1e999}',
                b'{"\\ud800": 1}',
            )
        )
    ),
    "header of the weights": lambda r, f: _header(r, f, lambda h: _tensor(r, h)),
    "header is no table": lambda r, f: _header(
        r, f, lambda h: r.choice((b"", b"[]", b"{", b"[" * 9999, b"7", b"\xff\xff", b'{"a": 1, "a": 2}', b" " * 99))
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
UNCERTAIN: dict[str, Callable[[random.Random, Path], object]] = {
    "manifest edited and hashed anew": lambda r, f: _manifest(r, f, signed=True),
    "damaged": lambda r, f: (p := f / r.choice((MANIFEST, WEIGHTS))).write_bytes(damaged(r, p.read_bytes())),
}


def _linked(path: Path) -> None:
    real = path.rename(path.parents[1] / path.name)
    path.symlink_to(real)


def bundles(rng: random.Random) -> Iterator[Case]:
    """Bundles: 15 of each category, 60 of those with a manifest hashed anew."""
    for certain, changes in ((True, CERTAIN), (False, UNCERTAIN)):
        for category, change in changes.items():
            for _ in range(15 if certain else 60):
                yield _case(category, rng.random(), change, certain)


def _case(category: str, seed: float, change: Callable[[random.Random, Path], object], certain: bool) -> Case:
    def build(folder: Path) -> None:
        shutil.copytree(source(), folder / "policy", copy_function=shutil.copyfile)
        change(random.Random(seed), folder / "policy")

    return Case("bundle", category, COMMAND, build, certain=certain, reader=lambda: load_policy("policy"))
