"""Run folders from elsewhere: configuration, status, team, checkpoints and their listings changed, lost or swapped."""

from __future__ import annotations

import json
import os
import random
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import safetensors.numpy

from tests.hostile.bundle_cases import changed_somewhere
from tests.hostile.case import OUTSIDE, PRECIOUS, Case, damaged, write
from tests.hostile.stopped_runs import RUN, listed_anew, newest, stopped

RESUME = ("train", "resume", RUN)

Change = Callable[[random.Random, Path], object]


def _json(rng: random.Random, path: Path) -> None:
    path.write_text(json.dumps(changed_somewhere(rng, json.loads(path.read_text()))))


def _no_json(rng: random.Random, path: Path) -> None:
    path.write_bytes(
        rng.choice(
            (
                b"",
                b"{",
                b"[" * 99999,
                b"NaN",
                b"\xff\xfe",
                b"{}{}",
                b"9" * 99999,
                b'{"a": 1, "a": 2}',
                b"null",
                b"[]",
                b"7",
                b'"x"',
                b"{}",
                b'{"a": 1e999}',
                b'{"format": "\x1b[2J"}',
                b'{"status": "\\u202e"}',
                b" " * 99999,
            )
        )
    )


def _of_checkpoint(name: str, change: Change) -> Change:
    """Change a file of the newest checkpoint, and list it anew."""

    def changed(rng: random.Random, run: Path) -> None:
        change(rng, newest(run) / name)
        listed_anew(newest(run))

    return changed


def _arrays(rng: random.Random, path: Path) -> None:
    """Arrays of other names, types, shapes and values."""
    arrays = dict(safetensors.numpy.load(path.read_bytes()))
    name = rng.choice(sorted(arrays))
    array = arrays[name]
    match rng.randrange(8):
        case 0:
            del arrays[name]
        case 1:
            arrays[
                rng.choice(
                    (
                        "more",
                        "policy.x",
                        "environment.engine.script.1.act",
                        "environment.engine.script.1.__class__",
                        "optimizer.policy.99.step",
                        "\x1b[2J",
                    )
                )
            ] = array
        case 2:
            arrays[name] = array.astype(rng.choice((np.float64, np.int32, np.uint8, np.float16, np.bool_)))
        case 3:
            arrays[name] = array.reshape(1, *array.shape)
        case 4:
            arrays[name] = array[..., :0] if array.ndim else np.zeros(3, array.dtype)
        case 5:
            arrays[name] = np.resize(array, (7, 7))
        case 6:
            arrays[name] = np.frombuffer(rng.randbytes(array.nbytes), array.dtype).reshape(array.shape)
        case _:
            wrong = rng.choice((np.nan, np.inf, -1e300)) if array.dtype.kind == "f" else rng.choice((0, 255))
            with np.errstate(over="ignore"):
                arrays[name] = np.full_like(array, wrong)
    path.write_bytes(safetensors.numpy.save(arrays))


def _npy(rng: random.Random, path: Path) -> None:
    path = rng.choice(sorted(path.parent.glob("replay-*.npy")))
    array = np.load(path)
    match rng.randrange(5):
        case 0:
            path.unlink()
        case 1:
            np.save(path, np.array([{"a": 1}], object), allow_pickle=True)
        case 2:
            np.save(path, array[: len(array) // 2])
        case 3:
            np.save(path, array.astype(np.float64))
        case _:
            text = b"[" * 9000
            path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)


def _listing(rng: random.Random, run: Path) -> None:
    _json(rng, newest(run) / "checkpoint.json")


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


def _outside(path: Path) -> Path:
    """What no run may touch."""
    return path.parents[1] / OUTSIDE


def _link(name: str, target: str) -> Change:
    """A link out of the run in the place of something in it."""

    def change(rng: random.Random, run: Path) -> None:
        path = run / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.symlink_to(_outside(run) / target)

    return change


def _pipe(rng: random.Random, run: Path) -> None:
    files = sorted(path for path in run.rglob("*") if path.is_file())
    path = rng.choice(files)
    path.unlink()
    os.mkfifo(path)


def _exchanged(rng: random.Random, run: Path) -> None:
    """Two files of the run in each other's place."""
    files = sorted(path for path in run.rglob("*") if path.is_file())
    one, other = rng.sample(files, 2)
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)


def _lost(rng: random.Random, run: Path) -> None:
    path = rng.choice(sorted(run.rglob("*")))
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _damaged_file(rng: random.Random, run: Path) -> None:
    files = sorted(path for path in run.rglob("*") if path.is_file() and path.stat().st_size)
    path = rng.choice(files)
    path.write_bytes(damaged(rng, path.read_bytes()))


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
        write(run / name / "checkpoint.json", rng.choice(("{}", "", "[" * 9999)))
    else:
        write(run / name, "x")


# Category -> (algorithms, cases of each, whether it must be refused, the change).
CHANGES: dict[str, tuple[tuple[str, ...], int, bool, Change]] = {
    "config.json edited": (("ppo",), 60, False, lambda r, f: _json(r, f / "config.json")),
    "config.json is no JSON": (("ppo",), 17, True, lambda r, f: _no_json(r, f / "config.json")),
    "run.json edited": (("ppo",), 40, False, lambda r, f: _json(r, f / "run.json")),
    "run.json is no JSON": (("ppo",), 17, True, lambda r, f: _no_json(r, f / "run.json")),
    "team.json edited": (("ppo",), 10, False, lambda r, f: _json(r, f / "team.json")),
    "something lost": (("ppo", "sac"), 40, False, _lost),
    "something damaged": (("ppo", "sac"), 60, False, _damaged_file),
    "something more": (("ppo",), 24, False, _more),
    "files exchanged": (("ppo", "sac"), 25, False, _exchanged),
    "a pipe for a file": (("ppo", "sac"), 25, False, _pipe),
    "checkpoints: link outside": (("ppo",), 1, True, _link("checkpoints", "")),
    "tensorboard: link outside": (("ppo",), 1, True, _link("tensorboard", "")),
    "run.lock: link outside": (("ppo",), 1, True, _link("run.lock", PRECIOUS)),
    "progress.csv: link outside": (("ppo",), 1, False, _link("progress.csv", PRECIOUS)),
    "config.json: link outside": (("ppo",), 1, True, _link("config.json", PRECIOUS)),
    "team.json: link outside": (("ppo",), 1, False, _link("team.json", PRECIOUS)),
    "policy: link outside": (("ppo",), 1, False, _link("policy", "")),
    "events: link outside": (("ppo",), 1, False, _link("tensorboard/events.out.tfevents.1.x", PRECIOUS)),
    "progress.csv damaged": (("ppo",), 10, False, lambda r, f: _text_of_table(r, f / "progress.csv")),
    "checkpoint: state.json edited": (("ppo", "sac"), 90, False, _of_checkpoint("state.json", _json)),
    "checkpoint: state.json is no JSON": (("ppo",), 17, False, _of_checkpoint("state.json", _no_json)),
    "checkpoint: arrays changed": (("ppo", "sac"), 60, False, _of_checkpoint("arrays.safetensors", _arrays)),
    "checkpoint: replay changed": (("sac",), 20, False, _of_checkpoint("x", _npy)),
    "checkpoint: table changed": (("ppo",), 15, False, _of_checkpoint("progress.csv", _text_of_table)),
    "checkpoint: listing edited": (("ppo", "sac"), 40, False, _listing),
    "checkpoint: listing is no JSON": (("ppo",), 17, False, lambda r, f: _no_json(r, newest(f) / "checkpoint.json")),
    "checkpoint: files damaged": (
        ("ppo", "sac"),
        70,
        False,
        lambda r, f: (p := r.choice(sorted(x for x in newest(f).rglob("*") if x.is_file()))).write_bytes(
            damaged(r, p.read_bytes() or b"x")
        ),
    ),
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


def runs(rng: random.Random) -> Iterator[Case]:
    """Interrupted trainings that are resumed, changed anywhere but in a checkpoint whose listing agrees."""
    return _cases(rng, "run")


def checkpoints(rng: random.Random) -> Iterator[Case]:
    """Interrupted trainings that are resumed, their newest checkpoint changed."""
    return _cases(rng, "checkpoint")


def _cases(rng: random.Random, kind: str) -> Iterator[Case]:
    for category, (algorithms, count, certain, change) in CHANGES.items():
        if category.startswith("checkpoint: ") == (kind == "checkpoint"):
            for algorithm in algorithms:
                for _ in range(count):
                    yield _case(kind, category, algorithm, rng.random(), change, certain)


def _case(kind: str, category: str, algorithm: str, seed: float, change: Change, certain: bool) -> Case:
    def build(folder: Path) -> None:
        shutil.copytree(stopped(algorithm), folder / RUN)
        change(random.Random(seed), folder / RUN)

    return Case(kind, category.removeprefix("checkpoint: "), RESUME, build, certain=certain, may_change=(RUN,))
