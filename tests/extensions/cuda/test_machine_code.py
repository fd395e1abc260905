"""What a GPU runs: the threads in numba's simulator, and the machine code, wherever numba-cuda can make it."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch

from ethbrake_marl import kernel_cache
from ethbrake_marl.errors import CacheFault, InvalidInput, MissingExtra
from ethbrake_marl.extensions.cuda import device, machine_code
from ethbrake_marl.extensions.cuda.machine_code import PTX_VERSION, compile_kernel, ptx_of
from ethbrake_marl.extensions.cuda.worlds import Worlds
from ethbrake_marl.motion import compiling
from tests.extensions.cuda.test_worlds import SIX
from tests.refused import refused

ROOT = Path(__file__).parents[3]
needs_compiler = pytest.mark.skipif(find_spec("numba_cuda") is None, reason="needs numba-cuda: the extra cuda")
KINDS = {"u64": ctypes.c_int64, "f64": ctypes.c_double, "u8": ctypes.c_int8}


@pytest.mark.slow
def test_threads_of_the_simulator__have_the_same_bits() -> None:
    on = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "ignore", "-m", "tests.extensions.cuda.simulated", "1"]
    done = subprocess.run(command, env=os.environ | on, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()] == [*SIX.values()]


def test_parameters__of_an_array_a_tuple_and_numbers() -> None:
    array = torch.zeros(2, 3, dtype=torch.float32)
    cells = [*device.cells_of(((array, True), 2.5, 7))]
    numbers = [0, 0, 6, 4, array.data_ptr(), 2, 3, 12, 4, 1, 2.5, 7]
    assert [cell.value for cell in cells] == numbers
    assert [type(cell) for cell in cells[-3:]] == [ctypes.c_int8, ctypes.c_double, ctypes.c_int64]


@pytest.mark.skipif(find_spec("numba_cuda") is not None, reason="numba-cuda is installed")
def test_without_the_compiler__the_extra_is_named() -> None:
    with refused("ethbrake-marl[cuda]", MissingExtra):
        compile_kernel(lambda: None, (), (9, 0))


def test_code_that_has_been_made__needs_no_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(machine_code, "compile_kernel", lambda kernel, *_: kernel)
    assert ptx_of("play", lambda: "as before", (), (9, 0)) == "as before"
    for capability in ((9, 0), (12, 1)):  # a newer GPU runs it
        assert ptx_of("play", pytest.fail, (), capability) == "as before"


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name, capability", [("paper-random", (9, 0)), ("cooperation-4-five", (7, 5))])
def test_machine_code__rounds_every_operation_as_a_processor_does(name: str, capability: tuple[int, int]) -> None:
    worlds = Worlds(name, 2, 4, "cpu")
    given = device.empty_arrays(worlds.arguments(torch.zeros(2, len(worlds.game.settings.learners)), 0))
    code = compile_kernel(worlds.kernel.thread(), (*given, 0), capability)
    operations = set(re.findall(r"\b((?:fma|mul|add|sub|div|sqrt|rsqrt|rcp|ex2|lg2|sin|cos)\.[a-z.]*f\d\d)\b", code))
    allowed = {f"{name}.rn.{kind}" for name in ("mul", "add", "sub", "div", "sqrt") for kind in ("f32", "f64")}
    assert operations <= allowed and {"mul.rn.f64", "add.rn.f64", "div.rn.f64", "sqrt.rn.f64"} <= operations
    assert not re.search(r"\b(call|ftz)\b|\.approx", code) and f".version {PTX_VERSION}\n" in code
    entry = re.search(r"\.entry kernel\((.*?)\)", code, re.DOTALL)
    assert entry is not None
    kinds = [KINDS[kind] for kind in re.findall(r"\.param \.(\w+) ", entry[1])]
    cells = device.cells_of((*worlds.arguments(torch.zeros(2, len(worlds.game.settings.learners)), 0), worlds.n))
    assert kinds == [type(cell) for cell in cells]


@pytest.mark.parametrize(
    "build, there, count, capability, reason",
    [
        (None, False, 0, (0, 0), "is not built for NVIDIA's GPUs"),
        ("13.0", False, 0, (0, 0), "torch finds no NVIDIA GPU"),
        ("13.0", True, 1, (9, 0), "device = 'cuda:3': the only devices are cuda:0"),
        ("13.0", True, 4, (6, 1), "has compute capability 6.1; needs at least 7.0"),
    ],
)
def test_a_device_that_cannot__says_why(
    monkeypatch: pytest.MonkeyPatch, build: str | None, there: bool, count: int, capability: Any, reason: str
) -> None:
    monkeypatch.setattr(torch.version, "cuda", build)
    for name, value in (("is_available", there), ("device_count", count), ("get_device_capability", capability)):
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "GTX 1080")
    with refused(reason, InvalidInput):
        device.device_named("cuda:3")


def test_code__is_made_anew_when_the_threads_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copied = shutil.copytree(Path(machine_code.__file__).parent, tmp_path / "cuda")
    monkeypatch.setattr(machine_code, "__file__", str(copied / "machine_code.py"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(machine_code, "compile_kernel", lambda kernel, *_: kernel)
    assert ptx_of("play", lambda: "old", (), (9, 0)) == "old"
    assert ptx_of("play", lambda: "new", (), (9, 0)) == "old"
    with (copied / "threads.py").open("a") as file:
        file.write("# changed\n")
    for known in (compiling.stamp_of, compiling._source):
        known.cache_clear()
    assert ptx_of("play", lambda: "new", (), (9, 0)) == "new"


@pytest.mark.parametrize("content", [b"", b"as before", b"\xff" * 100, None])
def test_code__that_is_damaged_is_made_anew(content: bytes | None, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "_warned", [])
    monkeypatch.setattr(machine_code, "compile_kernel", lambda kernel, *_: kernel)
    ptx_of("play", lambda: "compile_kernel", (), (9, 0))
    [file] = (tmp_path / "ethbrake_marl").iterdir()
    file.unlink()
    file.mkdir() if content is None else file.write_bytes(content)
    with pytest.warns(CacheFault, match=rf"^{tmp_path}/ethbrake_marl: play-90-\w+\.compiled is damaged"):
        assert ptx_of("play", lambda: "anew", (), (9, 0)) == "anew"
    assert ptx_of("play", pytest.fail, (), (9, 0)) == "anew"
