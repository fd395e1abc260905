"""Hostile YAML, and files that are not what they should be."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from ethbrake_marl.errors import AlreadyExists, CorruptBundle
from ethbrake_marl.files.plain import open_plain, read_plain
from ethbrake_marl.files.store import check_target, write_output
from ethbrake_marl.files.yaml import DEPTH_LIMIT, SIZE_LIMIT, parse_yaml, read_yaml
from tests.refused import refused

# Grows to 3^8 entries where aliases are followed.
LAUGHS = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def parse(text: str | bytes) -> object:
    """The content of a file that says this."""
    return parse_yaml(text, "bad.yaml").content


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: &x 2\n", ", line 2, column 4: anchor &x is not"),
        ("a: *x\n", ", line 1, column 4: alias *x is not"),
        ("a: !!int 3\n", ", line 1, column 4: tag"),
        ("a: ! 3\n", ", line 1, column 4: tag ! is not"),
        ("a: !!python/object/apply:os.system [ls]\n", ", line 1, column 4: tag"),
        ("<<: {a: 1}\n", ", line 1, column 1: merge key << is not"),
        ("a: 1\nb: 2\na: 3\n", ", line 3, column 1: key 'a' occurs"),
        ("1: a\n", ", line 1, column 1: key '1' must be"),
        ("? [a, b]\n: 1\n", ", line 1, column 3: a key must be text,"),
        ("a: 1\n---\nb: 2\n", ", line 2, column 1: a second document"),
        ("%TAG ! tag:x,2000:\n---\na: 1\n", ", line 1, column 1: YAML directives are"),
        ("a: [1, 2\nb: 3\n", ", line 2, column 2: not valid YAML:"),
        ("a:\n\t- 1\n", ", line 2, column 1: not valid YAML:"),
        ("a: \x07\n", ", line 1, column 4: not valid YAML:"),
        ("a: 99999999999999999999\n", ", line 1, column 4: integer"),
        ("[" * (DEPTH_LIMIT + 1) + "1" + "]" * (DEPTH_LIMIT + 1), ", line 1, column 17: mappings and lists"),
        ("a: " + "x" * (SIZE_LIMIT - 2), ": is larger than 64 KiB, the limit for"),
        (LAUGHS, ", line 1, column 4: anchor &a is not"),
        ("a: " * 20_000, ", line 1, column 5: not valid YAML:"),
        ("key: " + "'" * 1001, ", line 1, column 1007: not valid YAML:"),
        ("\ud800", ", line 1, column 1: byte 0xed is not"),
        (b"a: 1\nb: \xff\n", ", line 2, column 4: byte 0xff is not"),
    ],
    ids=lambda value: ascii(value)[:40],
)
def test_yaml__is_refused_with_its_place(text: str | bytes, message: str) -> None:
    with refused(f"bad.yaml{message}"):
        parse(text)


PATHS: dict[str, Callable[[], object]] = {
    "gone.yaml: the file does not exist": lambda: read_yaml("gone.yaml"),
    "a\\x00b: cannot be read (embedded null": lambda: read_plain(Path("a\0b"), 8),
    "xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx": lambda: read_plain(Path("x" * 5000), 8),
    "/dev/zero: is a device, a pipe or a": lambda: read_plain(Path("/dev/zero"), 8),
    "/dev/null: is a device or a pipe, not a": lambda: write_output("/dev/null", b"new", force=True),
    "missing/out.csv: the folder missing": lambda: write_output("missing/out.csv", b"new", force=True),
    "a\\x00b: cannot be written (embedded": lambda: check_target("a\0b"),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", PATHS)
def test_path__is_refused(message: str) -> None:
    with refused(message):
        PATHS[message]()


@pytest.mark.parametrize("read", [lambda: read_plain(Path("a"), 7), lambda: open_plain("a", 7).__enter__()])
def test_file__that_is_larger_than_its_limit_is_not_read(read: Callable[[], object], empty_folder: Path) -> None:
    Path("a").write_bytes(b"12345678")
    with refused("is larger than 0 KiB, the limit for this kind of file"):
        read()
    with open("huge.yaml", "wb") as stream:
        stream.truncate(10**7)  # sparse
    with refused("huge.yaml: is larger than 64 KiB, the limit for this kind of file"):
        read_yaml("huge.yaml")


def test_folder_pipe_and_broken_link__are_not_read(empty_folder: Path) -> None:
    Path("folder").mkdir()
    with refused("folder: is a folder; must be a plain file"):
        read_yaml("folder")
    os.mkfifo("pipe")
    with refused("pipe: is a device, a pipe or a socket; must be a plain file"):
        read_plain(Path("pipe"), 8)
    Path("loop").symlink_to("loop")
    with refused("loop: cannot be read (Too many levels of symbolic links)"):
        read_plain(Path("loop"), 8)
    Path("dangling").symlink_to("nowhere")
    with refused("dangling: the file does not exist"):
        read_plain(Path("dangling"), 8)
    Path("file").touch()
    with refused("file/below: cannot be read (Not a directory)"):
        read_plain(Path("file/below"), 8)


def test_link__is_not_followed_where_it_must_not_be(empty_folder: Path) -> None:
    Path("a").write_bytes(b"12345678")
    Path("link").symlink_to("a")
    with refused("link: is a symbolic link; give the path of the file to which it points", CorruptBundle):
        read_plain(Path("link"), 8, refusal=CorruptBundle, follow_links=False)


def test_output__replaces_no_file_unasked_and_nothing_else_even_if_asked(empty_folder: Path) -> None:
    Path("out.csv").write_text("mine")
    with refused("out.csv: already exists; give another name, or pass force=True", AlreadyExists):
        write_output("out.csv", b"new")
    for link, target in (("link", "out.csv"), ("dangling", "nowhere")):
        Path(link).symlink_to(target)
        with refused(f"{link}: is a symbolic link; give the path of the file to which it"):
            write_output(link, b"new", force=True)
    os.mkfifo("pipe")
    with refused("pipe: is a device or a pipe, not a plain file; give another name"):
        write_output("pipe", b"new", force=True)
    Path("folder").mkdir()
    with refused("folder: is a folder; give the path of a file"):
        write_output("folder", b"new", force=True)
    assert Path("out.csv").read_text() == "mine" and not Path("nowhere").exists()
