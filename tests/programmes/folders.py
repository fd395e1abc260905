"""Hostile folders: policy bundles and run folders that were edited, swapped, cut or made up."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import random
import shutil
import signal
import struct
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from ethbrake_marl.learning.runs import train
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.policies import content_sha256, load_policy, shipped_policies
from ethbrake_marl.scenario import load_scenario
from tests.programmes.cage import NASTY, OUTSIDE, PRECIOUS, Case, damaged, write
from tests.programmes.texts import changed_somewhere

Change = Callable[[random.Random, Path], object]
NO_JSON = (
    b"", b"{", b"[" * 99999, b"NaN", b"\xff\xfe", b"{}{}", b"9" * 99999, b'{"a": 1, "a": 2}', b"null", b"[]", b"7",
    b'"x"', b'{"a": 1e999}', b'{"format": "\x1b[2J"}', b'{"status": "\\u202e"}', b" " * 99999, b'"' + b"x" * 99999,
    "{}".encode("utf-16"), b"\xef\xbb\xbf{}", b'{"\\ud800": 1}',
)  # fmt: skip


def edited(rng: random.Random, path: Path) -> None:
    """A value somewhere in a JSON file changed."""
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


def _hashed_anew(rng: random.Random, folder: Path) -> None:
    edited(rng, folder / MANIFEST)
    content = json.loads((folder / MANIFEST).read_text())
    if isinstance(content, dict):
        content["manifest_sha256"] = content_sha256(content)
    (folder / MANIFEST).write_text(json.dumps(content))


def _header(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
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


def _linked(path: Path) -> None:
    path.symlink_to(path.rename(path.parents[1] / path.name))


BUNDLES: dict[str, Change] = {
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
    """Bundles: 15 of each category, 60 of those that may be in order."""
    uncertain: dict[str, Change] = {"manifest edited and hashed anew": _hashed_anew, "damaged": damaged_file}
    for certain, changes in ((True, BUNDLES), (False, uncertain)):
        for category, change in changes.items():
            for _ in range(15 if certain else 60):
                build = partial(_changed_bundle, change, rng.random())
                yield Case(category, EVALUATE, build, certain=certain, reader=partial(load_policy, "policy"))


def bundle(folder: Path) -> None:
    """A bundle that is in order, and may be changed."""
    shutil.copytree(shipped_policies()["ppo"] / "policy", folder / "policy", copy_function=shutil.copyfile)
    (folder / "policy").chmod(0o755)


def _changed_bundle(change: Change, seed: float, folder: Path) -> None:
    bundle(folder)
    change(random.Random(seed), folder / "policy")


# ---------------------------------------------------------------- run folders

RUN = "run"
SMALL: dict[str, Any] = {
    "n_envs": 4,
    "batch_size": 16,
    "network": {"policy": [4], "value": [4]},
    "evaluation": {"every_updates": 2, "worlds": 2, "seed": 7},
}
PPO = {**SMALL, "n_steps": 8, "n_epochs": 1, "total_steps": 256, "checkpoint_every_updates": 2}
SAC = {
    **SMALL,
    "buffer_size": 64,
    "learning_starts": 8,
    "total_steps": 64,
    "checkpoint_every_updates": 4,
    "log_every_updates": 2,
}


@cache
def stopped(algorithm: str) -> Path:
    """A training that was interrupted, with its checkpoints; it goes on for a few updates."""
    folder = Path(tempfile.mkdtemp(prefix="hostile-runs-")) / RUN
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    seen = []

    def measure(policy: object) -> dict[str, float]:
        seen.append(policy)
        if len(seen) == 4:
            signal.raise_signal(signal.SIGINT)
        return {"first_impact_harm": 1.0, "total_harm": 1.0}

    settings = PPO if algorithm == "ppo" else SAC
    recipe = load_recipe(algorithm).replace(**settings)
    train(recipe, load_scenario("paper-random"), folder, measure=lambda training: measure)
    assert json.loads((folder / "run.json").read_text())["status"] == "interrupted"
    return folder


def newest(run: Path) -> Path:
    """The newest checkpoint."""
    return max(run.glob("checkpoints/step_*"))


def listed_anew(checkpoint: Path) -> None:
    """Let the listing agree with what is there."""
    path = checkpoint / "checkpoint.json"
    listing = json.loads(path.read_text())
    files = [file for file in checkpoint.rglob("*") if file.is_file() and file != path]
    listing["files"] = {
        file.relative_to(checkpoint).as_posix(): {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        for file in files
    }
    path.write_text(json.dumps(listing))


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
    path = rng.choice(plain_files(run))
    path.unlink()
    os.mkfifo(path)


def _exchanged(rng: random.Random, run: Path) -> None:
    """Two files of the run in each other's place."""
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
        write(run / name / "checkpoint.json", rng.choice(("{}", "", "[" * 9999)))
    else:
        write(run / name, "x")


# Category -> (algorithms, cases of each, whether it must be refused, the change).
CHANGES: dict[str, tuple[tuple[str, ...], int, bool, Change]] = {
    "config.json edited": (("ppo",), 60, False, lambda r, f: edited(r, f / "config.json")),
    "config.json is no JSON": (("ppo",), 17, True, lambda r, f: no_json(r, f / "config.json")),
    "run.json edited": (("ppo",), 40, False, lambda r, f: edited(r, f / "run.json")),
    "run.json is no JSON": (("ppo",), 17, True, lambda r, f: no_json(r, f / "run.json")),
    "team.json edited": (("ppo",), 10, False, lambda r, f: edited(r, f / "team.json")),
    "something lost": (("ppo", "sac"), 40, False, _lost),
    "something damaged": (("ppo", "sac"), 60, False, damaged_file),
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
    "checkpoint: state.json edited": (("ppo", "sac"), 90, False, _of_checkpoint("state.json", edited)),
    "checkpoint: state.json is no JSON": (("ppo",), 17, False, _of_checkpoint("state.json", no_json)),
    "checkpoint: arrays changed": (("ppo", "sac"), 60, False, _of_checkpoint("arrays.safetensors", _arrays)),
    "checkpoint: replay changed": (("sac",), 20, False, _of_checkpoint("x", _npy)),
    "checkpoint: table changed": (("ppo",), 15, False, _of_checkpoint("progress.csv", _text_of_table)),
    "checkpoint: listing edited": (("ppo", "sac"), 40, False, lambda r, f: edited(r, newest(f) / "checkpoint.json")),
    "checkpoint: listing is no JSON": (("ppo",), 17, False, lambda r, f: no_json(r, newest(f) / "checkpoint.json")),
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
    """Interrupted trainings that are resumed: a ``checkpoint`` changed, or anything else of the ``run``."""
    for category, (algorithms, count, certain, change) in CHANGES.items():
        if category.startswith("checkpoint: ") == (kind == "checkpoint"):
            for algorithm in [each for each in algorithms for _ in range(count)]:
                build = partial(_changed_run, algorithm, change, rng.random())
                name = category.removeprefix("checkpoint: ")
                yield Case(name, ("train", "resume", RUN), build, certain=certain, may_change=(RUN,))


def _changed_run(algorithm: str, change: Change, seed: float, folder: Path) -> None:
    shutil.copytree(stopped(algorithm), folder / RUN)
    change(random.Random(seed), folder / RUN)
