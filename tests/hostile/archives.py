"""Archives of arrays as numpy writes them, and as it never would."""

from __future__ import annotations

import functools
import io
import json
import random
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.limits.limits import best_harm, table_bytes
from ethbrake_marl.scenario import load_scenario

SHAPE_TEXTS = (
    "(3, 3)",
    "(0,)",
    "(-3,)",
    "(3.0,)",
    "3",
    "()",
    "(99999999999999999999,)",
    "(" * 200 + ")" * 200,
    "(3,)*9",
    "(1<<40,)",
    "[3]",
    "(3,) if 1 else 0",
    "(None,)",
    "(True,)",
    "(3,\n)",
    "('3',)",
    "(" + "1, " * 40 + ")",
)
DTYPES = (
    ">u8",
    "<i8",
    "<u4",
    "|O",
    "<U8",
    "|S8",
    "|V8",
    "<c16",
    "<M8[s]",
    "<f2",
    "<f16",
    "|b1",
    "<u8; x",
    "[('a', '<u8')]",
    "object",
    "<u999999999",
)
NUMBERS = (np.nan, np.inf, -np.inf, -1.0, -1e-300, -1e308)

Arrays = dict[str, Any]  # name -> array, or the bytes of its .npy


@functools.cache
def good_bytes() -> bytes:
    """A table of the three worlds that the command searches."""
    scenario = load_scenario("paper-random")
    return table_bytes(best_harm(scenario, scenario.sample(3, 7).worlds, budget=1, threads=1))


def good() -> Arrays:
    """Its arrays."""
    with np.load(io.BytesIO(good_bytes())) as arrays:
        return dict(arrays)


def npy(array: Any) -> bytes:
    """The bytes of a .npy, pickled where it holds objects."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asanyarray(array), allow_pickle=True)
    return buffer.getvalue()


def raw_npy(header: str | bytes, data: bytes = b"", magic: bytes = b"\x93NUMPY\x01\x00") -> bytes:
    """A .npy with a header of one's own."""
    text = header.encode("latin-1", "replace") if isinstance(header, str) else header
    size = struct.pack("<H", min(len(text), 65535)) if magic[6:7] == b"\x01" else struct.pack("<I", len(text))
    return magic + size + text + data


def packed(arrays: Arrays, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """The archive of some arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, array in arrays.items():
            archive.writestr(f"{name}.npy", array if isinstance(array, bytes) else npy(array))
    return buffer.getvalue()


def without(arrays: Arrays, lost: list[str]) -> Arrays:
    """The arrays without some."""
    return {name: array for name, array in arrays.items() if name not in lost}


class Touch:
    """What a pickle can do."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("pwned"),)


def swapped(rng: random.Random, change: Callable[[random.Random, np.ndarray], Any], *names: str) -> bytes:
    arrays = good()
    name = rng.choice(names or [each for each in arrays if each != "header"])
    arrays[name] = change(rng, arrays[name])
    return packed(arrays)


def with_header(rng: random.Random, header: Any) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return packed({**good(), "header": np.frombuffer(text, np.uint8)})


def good_header(**changes: Any) -> dict[str, Any]:
    return {**json.loads(good()["header"].tobytes()), **changes}


def poked(rng: random.Random, signature: bytes, offset: int, value: bytes) -> bytes:
    """The archive with a field of one of its records overwritten."""
    data = bytearray(good_bytes())
    places = [k for k in range(len(data)) if data.startswith(signature, k)]
    at = rng.choice(places) + offset
    data[at : at + len(value)] = value
    return bytes(data)


def bomb(size: int) -> bytes:
    """Consistent headers of a huge table whose zeros take a thousandth of their size."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    header = f"{{'descr': '<u8', 'fortran_order': False, 'shape': ({size // 8},), }}".encode().ljust(117) + b"\n"
    stream = deflate.compress(raw_npy(header)) + deflate.flush(zlib.Z_FULL_FLUSH)
    block = deflate.compress(bytes(1 << 20)) + deflate.flush(zlib.Z_FULL_FLUSH)
    stream += block * (size >> 20) + deflate.flush()
    data = bytearray(packed({**good(), "identity": stream}, zipfile.ZIP_STORED))
    for signature, method, length, name in ((b"PK\x03\x04", 8, 22, 30), (b"PK\x01\x02", 10, 24, 46)):
        at = next(
            k for k in range(len(data)) if data.startswith(signature, k) and data.startswith(b"identity", k + name)
        )
        data[at + method : at + method + 2] = struct.pack("<H", zipfile.ZIP_DEFLATED)
        data[at + length : at + length + 4] = struct.pack("<L", size + 128)
    return bytes(data)


def many_phases() -> bytes:
    """Few bytes that would become 65,535 phases of a great many worlds."""
    n = 20_000
    phases = np.zeros(n, "<u2")
    phases[0] = 65535
    one = {
        "harm": np.zeros(n),
        "phases": phases,
        "ends": np.arange(1, 65536).astype("<u2"),
        "commands": np.zeros((8, 65535, 1), np.uint8),
    }
    arrays = {"header": good()["header"], "identity": np.arange(n, dtype="<u8")}
    return packed(
        {**arrays, **{f"{count}_{name}": array for count in ("first", "total") for name, array in one.items()}}
    )


def with_member(name: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for each, array in good().items():
            archive.writestr(f"{each}.npy", npy(array))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a name that is there already is what is wanted
            archive.writestr(name, npy(np.zeros(3)))
    return buffer.getvalue()
