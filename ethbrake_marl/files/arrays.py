"""Read arrays from untrusted files: names, types, shapes and sizes are checked before any array is unpacked.

The formats are ``.npz`` (a zip archive of ``.npy`` files) and safetensors. No content of a file is evaluated or
unpickled. The header of a ``.npy`` file is a Python expression; it is accepted only if it matches a pattern of the form
that numpy writes.
"""

from __future__ import annotations

import io
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.files.plain import parse_strict_json

HEADER_LIMIT_BYTES = 1 << 20  # largest header of a safetensors file

_NPY_HEADER_LIMIT_BYTES = 4096

_DIRECTORY_LIMIT_BYTES = 1 << 16  # largest directory of a zip archive

_MEMBERS_LIMIT = 64

_NPY = re.compile(
    rb"\{'descr': '([<|][a-z][0-9]{1,2})', 'fortran_order': False, 'shape': \(([0-9, ]{0,200})\), \} *\n", re.ASCII
)

_SHAPE = re.compile(r"|[0-9]{1,18},|[0-9]{1,18}(, [0-9]{1,18}){1,7}", re.ASCII)

_HARMLESS_FLAGS = 0x808  # accepted flags of a zip member: the sizes follow the data, the name is in UTF-8


class ArrayHeader(NamedTuple):
    """Type (in the notation of the file format) and shape of an array, as declared in its file."""

    dtype: str  # such as ``<f8`` (.npy) or ``F32`` (safetensors)
    shape: tuple[int, ...]


class ArrayRow(NamedTuple):
    """Required name, type and shape of an array.

    A letter in ``shape`` stands for any length; a letter that occurs several times stands for the same length.
    """

    name: str
    dtype: str  # in the notation of ``ArrayHeader``
    shape: tuple[int | str, ...]  # such as ``("n", 3)``


def check_arrays(found: Mapping[str, ArrayHeader], wanted: Sequence[ArrayRow], word: str = "array") -> dict[str, int]:
    """Check that arrays have the required names, types and shapes; return the length for each letter in the shapes.

    The result is ``{"n": 5}`` if a required shape is ``("n", 3)`` and the array is [5, 3]. Raises ``ValueError`` naming
    the first array that is missing, not required, or of a wrong type or shape. ``word`` is the noun for an array in
    the message, such as ``tensor``.
    """
    names = {row.name for row in wanted}
    for name in sorted(names - found.keys()):
        raise ValueError(f"the file does not contain the {word} {name!r}")
    for name in sorted(found.keys() - names):
        raise ValueError(
            f"{word} {name!r} must not be in this file; the file must have only {', '.join(sorted(names))}"
        )
    lengths: dict[str, int] = {}
    for row in wanted:
        header = found[row.name]
        if len(header.shape) == len(row.shape):
            for length, letter in zip(header.shape, row.shape, strict=True):
                if isinstance(letter, str):
                    lengths.setdefault(letter, length)
        right = [lengths.get(each, each) if isinstance(each, str) else each for each in row.shape]
        if header.dtype != row.dtype or list(header.shape) != right:
            raise ValueError(
                f"{word} {row.name!r} has type {header.dtype} and shape {list(header.shape)}; must have type"
                f" {row.dtype} and shape [{', '.join(map(str, right))}]"
            )
    return lengths


def safetensors_headers(data: bytes) -> dict[str, ArrayHeader]:
    """Return type and shape of the arrays, by name, from the header of a safetensors file.

    Raises ``ValueError`` for an invalid file.
    """
    length = int.from_bytes(data[:8], "little")
    if not 2 <= length <= min(len(data) - 8, HEADER_LIMIT_BYTES):
        raise ValueError(
            f"not a safetensors file: a header of {length} bytes is not possible in a file of {len(data)} bytes"
        )
    table = parse_strict_json(data[8 : 8 + length])
    if not isinstance(table, dict) or not all(isinstance(entry, dict) for entry in table.values()):
        raise ValueError("not a safetensors file: its header is not a JSON object of tensors")
    return {name: ArrayHeader(str(entry.get("dtype")), _lengths(entry.get("shape"))) for name, entry in table.items()}


def _lengths(shape: object) -> tuple[int, ...]:
    """Convert a shape from JSON to a tuple; an invalid length becomes -1, which no required length equals."""
    return tuple(each if type(each) is int else -1 for each in (shape if isinstance(shape, list) else [None]))


class ArrayArchive:
    """An ``.npz`` archive in memory, whose headers have been read and checked.

    An archive must be of the kind that ``numpy.savez`` and ``numpy.savez_compressed`` write: a single file without
    comment and encryption, whose arrays are stored or deflated and have different names. Raises ``ValueError`` for any
    other data, and if the unpacked arrays together would be larger than ``limit_bytes``.
    """

    def __init__(self, data: bytes, limit_bytes: int) -> None:
        _check_directory(data)
        with _damage():
            self._zip = zipfile.ZipFile(io.BytesIO(data))
            self._members = self._zip.infolist()
        self._starts: dict[str, int] = {}  # byte at which the numbers of each array start
        self.headers: dict[str, ArrayHeader] = {}
        size = sum(member.file_size for member in self._members)
        if size > limit_bytes:
            raise ValueError(f"the arrays would have {size:,} bytes when unpacked; at most {limit_bytes:,} are allowed")
        for member in self._members:
            self._read_header(member)

    def unpack(self, wanted: Sequence[ArrayRow]) -> dict[str, NDArray[Any]]:
        """Return the arrays by name, read-only; raises the errors of ``check_arrays``."""
        check_arrays(self.headers, wanted)
        arrays = {}
        for member in self._members:
            name = _name(member)
            with _damage(), self._zip.open(member) as stream:
                data = stream.read(member.file_size)
                stream.read(1)  # reading to the end compares the checksum
            header = self.headers[name]
            arrays[name] = np.frombuffer(data, header.dtype, offset=self._starts[name]).reshape(header.shape)
        return arrays

    def _read_header(self, member: zipfile.ZipInfo) -> None:
        name = _name(member)
        if name in self.headers:
            raise ValueError(f"the file contains the array {name!r} twice")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(
                f"array {name!r} has zip compression method {member.compress_type}; only stored or deflated is accepted"
            )
        if member.flag_bits & ~_HARMLESS_FLAGS:
            raise ValueError(f"array {name!r} has a zip flag that is not accepted, for instance of encryption")
        with _damage(), self._zip.open(member) as stream:
            beginning = stream.read(10 + _NPY_HEADER_LIMIT_BYTES)
        header, start = _npy_header(name, beginning)
        size = start + math.prod(header.shape) * np.dtype(header.dtype).itemsize
        if member.file_size != size:
            raise ValueError(
                f"array {name!r} has {member.file_size:,} bytes, but {header.dtype} {list(header.shape)} needs"
                f" {size:,} bytes"
            )
        self.headers[name], self._starts[name] = header, start


def _name(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(".npy")


def _npy_header(name: str, beginning: bytes) -> tuple[ArrayHeader, int]:
    """Return type and shape of an array in a ``.npy`` file, and the byte at which its numbers start.

    ``beginning`` are the first bytes of the file, with the whole header.
    """
    length = int.from_bytes(beginning[8:10], "little")
    match = _NPY.fullmatch(beginning[10 : 10 + length])
    if beginning[:8] != b"\x93NUMPY\x01\x00" or length > _NPY_HEADER_LIMIT_BYTES or match is None:
        raise ValueError(f"array {name!r}: must be a .npy file of format 1.0 with numbers in C order")
    dtype, shape = match[1].decode(), match[2].decode()
    if dtype[1:] not in ("b1", "f4", "f8", "i4", "i8", "u1", "u2", "u4", "u8"):
        raise ValueError(f"array {name!r}: has type {dtype}; must be a boolean, integer or floating-point type")
    if _SHAPE.fullmatch(shape) is None:
        raise ValueError(f"array {name!r}: has the shape ({shape:.60}); must have whole numbers separated by commas")
    return ArrayHeader(dtype, tuple(int(each) for each in shape.split(",") if each.strip())), 10 + length


def _check_directory(data: bytes) -> None:
    """Raise ``ValueError`` unless ``data`` ends with a small zip directory, as a plain ``.npz`` archive does.

    Check this before the archive is opened, because a zip reader creates an object for every entry.
    """
    if len(data) < 22 or data[-22:-18] != b"PK\x05\x06":
        raise ValueError("not a plain .npz archive")
    disk, first_disk, here, members, size, start, comment = struct.unpack("<4H2LH", data[-18:])
    if disk or first_disk or comment or here != members or data[-42:-38] == b"PK\x06\x07":
        raise ValueError(
            "not a plain .npz archive: must be one zip file without a comment and without the zip64 extension"
        )
    if members > _MEMBERS_LIMIT or size > _DIRECTORY_LIMIT_BYTES or start + size != len(data) - 22:
        raise ValueError(
            f"not a plain .npz archive: its zip directory has {members} entries and {size:,} bytes; must have at most"
            f" {_MEMBERS_LIMIT} entries and {_DIRECTORY_LIMIT_BYTES:,} bytes, and be at the end of the file"
        )


@contextmanager
def _damage() -> Iterator[None]:
    """Context manager: convert an error of the zip reader inside the block to ``ValueError``."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, RuntimeError, OverflowError) as error:
        raise ValueError(f"the archive is damaged ({error})") from None
