"""Hostile archives of arrays: tables of best known harm, as numpy writes them and as attackers might."""

import io
import json
import random
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.tables import BestHarmTable, table_bytes
from ethbrake_marl.scenario.catalogue import load_scenario
from tests.programmes.cage import NASTY, Case, damaged, write

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


@cache
def good_bytes() -> bytes:
    """Return a valid table of the three worlds that the command searches."""
    scenario = load_scenario("paper-random")
    return table_bytes(best_harm(scenario, scenario.sample(3, 7).worlds, budget=1, threads=1))


def good() -> Arrays:
    """Return the arrays of the valid table."""
    with np.load(io.BytesIO(good_bytes())) as arrays:
        return dict(arrays)


def npy(array: Any) -> bytes:
    """Return the bytes of a .npy file; objects are pickled."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asanyarray(array), allow_pickle=True)
    return buffer.getvalue()


def raw_npy(header: str | bytes, data: bytes = b"", magic: bytes = b"\x93NUMPY\x01\x00") -> bytes:
    """Return a .npy file with this header."""
    text = header.encode("latin-1", "replace") if isinstance(header, str) else header
    size = struct.pack("<H", min(len(text), 65535)) if magic[6:7] == b"\x01" else struct.pack("<I", len(text))
    return magic + size + text + data


def packed(arrays: Arrays, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return an archive of these arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, array in arrays.items():
            archive.writestr(f"{name}.npy", array if isinstance(array, bytes) else npy(array))
    return buffer.getvalue()


def without(arrays: Arrays, lost: list[str]) -> Arrays:
    """Return the arrays without these."""
    return {name: array for name, array in arrays.items() if name not in lost}


class Touch:
    """Pickle that creates a file when it is loaded."""

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
    """Return the archive with one field of one of its records overwritten."""
    data = bytearray(good_bytes())
    places = [k for k in range(len(data)) if data.startswith(signature, k)]
    at = rng.choice(places) + offset
    data[at : at + len(value)] = value
    return bytes(data)


def bomb(size: int) -> bytes:
    """Return an archive of a huge table of zeros, with consistent headers, compressed to a thousandth of its size."""
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
    """Return a small archive that expands to 65,535 phases of many worlds."""
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
    buffer = io.BytesIO(packed(good(), zipfile.ZIP_STORED))
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "a") as archive:
        warnings.simplefilter("ignore")  # a name that is there already is what is wanted
        archive.writestr(name, npy(np.zeros(3)))
    return buffer.getvalue()


# Numbers that are read in order, and do not fit the worlds that are searched.
ONLY_A_PROBLEM_KNOWS = ("commands that cannot be", "phases out of order", "another world")
COMMAND = ("read-table", "t.npz")

CERTAIN: dict[str, Callable[[random.Random], bytes]] = {
    "wrong shape": lambda r: swapped(
        r,
        lambda r, a: r.choice(
            (
                a[:-1],
                a.reshape(1, *a.shape),
                np.concatenate([a, a]),
                a[:0],
                a.reshape(-1)[0],
                np.zeros((3, 3)),
                np.zeros((0, 7)),
            )
        ),
    ),
    "empty": lambda r: packed(
        {
            **good(),
            "identity": np.zeros(0, "<u8"),
            **{
                f"{c}_{k}": good()[f"{c}_{k}"][..., :0, :] if k == "commands" else good()[f"{c}_{k}"][:0]
                for c in ("first", "total")
                for k in ("harm", "phases", "ends", "commands")
            },
        }
    ),
    "missing array": lambda r: packed(without(good(), r.sample(sorted(good()), r.choice((1, 2, 10))))),
    "extra array": lambda r: packed(
        {
            **good(),
            r.choice(
                ("more", "first", "x" * 3000, "../../evil", "/proc/x", r.choice(NASTY), "first_harm.npy", "")
            ): np.zeros(3),
        }
    ),
    "other type": lambda r: swapped(
        r, lambda r, a: a.astype(r.choice((">u8", "<f4", "<i8", "<c16", "<U4", "S4", "?", "<f2", ">f8")))
    ),
    "objects": lambda r: swapped(r, lambda r, a: np.array([Touch()] * len(a), object)),
    "fortran order": lambda r: swapped(
        r,
        lambda r, a: npy(np.asfortranarray(a)) if a.ndim > 1 else npy(a).replace(b"False", b"True "),
        "first_commands",
        "total_commands",
        "identity",
    ),
    "structured": lambda r: swapped(r, lambda r, a: np.zeros(3, [("a", "<u8"), ("b", "<f8")])),
    "shape in the header": lambda r: swapped(
        r,
        lambda r, a: raw_npy(
            f"{{'descr': '<u8', 'fortran_order': False, 'shape': {r.choice(SHAPE_TEXTS)}, }}\n", bytes(24)
        ),
        "identity",
    ),
    "type in the header": lambda r: swapped(
        r,
        lambda r, a: raw_npy(
            f"{{'descr': '{r.choice(DTYPES)}', 'fortran_order': False, 'shape': (3,), }}\n", bytes(24)
        ),
        "identity",
    ),
    "deep header": lambda r: swapped(
        r,
        lambda r, a: raw_npy(
            r.choice(("[", "(", "{1:", "-", "not ", "~", "lambda:")) * r.choice((99, 3000, 9000, 60000))
        ),
    ),
    "code in the header": lambda r: swapped(
        r,
        lambda r, a: raw_npy(
            r.choice(
                (
                    "__import__('os').system('touch pwned')",
                    "{'descr': __import__('os').system('touch pwned')}",
                    "{**{'descr': '<u8'}, 'fortran_order': False, 'shape': (3,)}",
                    "open('pwned','w')",
                    "exit()",
                )
            )
        ),
    ),
    "header of another version": lambda r: swapped(
        r,
        lambda r, a: raw_npy(
            "{'descr': '<u8', 'fortran_order': False, 'shape': (3,), }\n",
            bytes(24),
            b"\x93NUMPY" + bytes([r.choice((0, 2, 3, 4, 255)), r.randrange(3)]),
        ),
    ),
    "no .npy": lambda r: swapped(
        r,
        lambda r, a: r.choice(
            (
                b"",
                b"\x93",
                b"\x93NUMPY\x01\x00",
                b"hello",
                b"\x80\x04\x95",
                r.randbytes(200),
                b"\x93NUMPY\x01\x00\xff\xff{",
            )
        ),
    ),
    "numbers that cannot be": lambda r: swapped(
        r,
        lambda r, a: np.where(np.arange(len(a)) == r.randrange(len(a)), r.choice(NUMBERS), a),
        "first_harm",
        "total_harm",
    ),
    "commands that cannot be": lambda r: swapped(
        r,
        lambda r, a: (
            np.frombuffer(np.full((a.shape[1], 1), r.choice((np.nan, np.inf, 1e300, -99.0))).tobytes(), np.uint8)
            .reshape(-1, 1, 8)
            .transpose(2, 0, 1)
            .copy()
        ),
        "first_commands",
        "total_commands",
    ),
    "phases out of order": lambda r: swapped(
        r,
        lambda r, a: (
            a[::-1] if len(set(a.tolist())) > 1 and r.random() < 0.4 else a * 0 + r.choice((0, 1, 3, 65535))
        ).astype("<u2"),
        "first_ends",
        "total_ends",
    ),
    "phases that do not add up": lambda r: swapped(
        r, lambda r, a: (a + r.choice((1, 7, 60000))).astype("<u2"), "first_phases", "total_phases"
    ),
    "another world": lambda r: packed({**good(), "identity": good()["identity"] + np.uint64(r.randrange(1, 9999))}),
    "header is no JSON": lambda r: with_header(
        r,
        r.choice(
            (
                b"",
                b"{",
                b"\xff",
                b"[" * 99999,
                b"nan",
                b'{"format": NaN}',
                b'{"format": 1, "format": 1}',
                b"9" * 99999,
                b'{"format": 1e999}',
                b"{} {}",
                b"\xef\xbb\xbf{}",
                "{}".encode("utf-16"),
            )
        ),
    ),
    "header says something else": lambda r: with_header(
        r,
        r.choice(
            (
                [],
                7,
                None,
                {},
                good_header(format=2),
                good_header(format="1"),
                good_header(format=True),
                good_header(format=1.0),
                good_header(scenario=7),
                good_header(vehicles="x"),
                good_header(lowered_by=[1]),
                good_header(lowered_by={"a": 1}),
                good_header(after=[]),
                good_header(budget="x"),
                good_header(episodes=[]),
                good_header(list_seed={}),
            )
        ),
    ),
    "duplicate name": lambda r: with_member(r.choice(("identity.npy", "header.npy", "first_harm.npy"))),
    "path in a name": lambda r: with_member(
        r.choice(
            (
                "../pwned.npy",
                "/proc/pwned.npy",
                "a/../../pwned.npy",
                "C:\\x.npy",
                "identity.npy/",
                "\x1b[2J.npy",
                "identity",
                "é" * 900,
            )
        )
    ),
    "encrypted": lambda r: poked(r, b"PK\x01\x02", 8, struct.pack("<H", r.choice((1, 9, 0x41, 0x2001, 0x20)))),
    "odd compression": lambda r: poked(
        r, b"PK\x01\x02", 10, struct.pack("<H", r.choice((1, 6, 9, 12, 14, 93, 95, 97, 99, 65535)))
    ),
    "packed by bzip2 or lzma": lambda r: packed(good(), r.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))),
    "sizes that lie": lambda r: poked(
        r,
        b"PK\x01\x02",
        *r.choice(
            (
                (20, bytes(4)),
                (20, b"\x09\0\0\0"),
                *((24, struct.pack("<L", n)) for n in (0, 1, 2**31, 2**32 - 1, 2**32 - 2, 150)),
            )
        ),
    ),
    "checksum that lies": lambda r: poked(r, b"PK\x01\x02", 16, struct.pack("<L", zlib.crc32(r.randbytes(4)))),
    "places that lie": lambda r: poked(r, b"PK\x01\x02", 42, struct.pack("<L", r.choice((1, 7, 2**31, 2**32 - 1)))),
    "directory that lies": lambda r: poked(
        r, b"PK\x05\x06", r.choice((4, 6, 8, 10, 12, 16, 20)), struct.pack("<H", r.choice((1, 2, 60000, 65535)))
    ),
    "zip64": lambda r: (
        good_bytes()[:-22]
        + b"PK\x06\x06"
        + struct.pack("<Q2H2L4Q", 44, 45, 45, 0, 0, 9**9, 9**9, 9**9, 0)
        + b"PK\x06\x07"
        + struct.pack("<LQL", 0, len(good_bytes()) - 22, 1)
        + good_bytes()[-22:]
    ),
    "comment": lambda r: good_bytes()[:-2] + struct.pack("<H", n := r.choice((1, 99, 65535))) + b"x" * n,
    "something before or behind": lambda r: r.choice(
        (b"#!/bin/sh\n" + good_bytes(), good_bytes() + b"x", good_bytes() * 2, b"MZ" + good_bytes())
    ),
    "many members": lambda r: packed({**good(), **{f"a{k}": b"" for k in range(r.choice((60, 3000)))}}),
    "bomb": lambda r: bomb(2 << 30),
    "many phases": lambda r: many_phases(),
    "not an archive": lambda r: r.choice(
        (
            b"",
            b"PK",
            b"PK\x05\x06" + bytes(18),
            b"\x93NUMPY\x01\x00",
            npy(np.zeros(3)),
            b"\x80\x04N.",
            b"{}",
            r.randbytes(5000),
            b"PK\x03\x04" + bytes(500),
            b"\x1f\x8b\x08" + bytes(99),
        )
    ),
    "cut off": lambda r: good_bytes()[: r.randrange(len(good_bytes()))],
}


def table_cases(rng: random.Random) -> Iterator[Case]:
    """Yield tables: 9 of each category (fewer if all cases of a category are equal), and 80 damaged tables."""
    for category, make in {**CERTAIN, "damaged": lambda r: damaged(r, good_bytes())}.items():
        reader = None if category in ONLY_A_PROBLEM_KNOWS else partial(BestHarmTable.load, Path("t.npz"))
        for _ in range({"bomb": 1, "many phases": 1, "empty": 1, "damaged": 80}.get(category, 9)):
            build = partial(_build, make, rng.random())
            yield Case(category, COMMAND, build, certain=category != "damaged", reader=reader)


def _build(make: Callable[[random.Random], bytes], seed: float, folder: Path) -> None:
    write(folder / "t.npz", make(random.Random(seed)))
