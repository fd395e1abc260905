"""Hostile YAML, and files that are not what they should be."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from ethbrake_marl.errors import AlreadyExists, CorruptBundle, InvalidInput
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.files.plain import open_plain, parse_strict_json, read_object, read_plain
from ethbrake_marl.files.store import check_target, write_output
from ethbrake_marl.files.yaml import DEPTH_LIMIT, YAML_SIZE_LIMIT, parse_yaml, read_yaml
from tests.refused import refused

# Grows to 3^8 entries where aliases are followed.
LAUGHS = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
YAML: dict[str, str | bytes] = {
    ", line 2, column 4: anchor &x is not": "a: 1\nb: &x 2\n",
    ", line 1, column 4: alias *x is not": "a: *x\n",
    ", line 1, column 4: tag tag:yaml.org,2002:int": "a: !!int 3\n",
    ", line 1, column 4: tag ! is not": "a: ! 3\n",
    ", line 1, column 4: tag tag:yaml.org,2002:python": "a: !!python/object/apply:os.system [ls]\n",
    ", line 3, column 1: key 'a' occurs twice; the first is on line 1": "a: 1\nb: 2\na: 3\n",
    ", line 1, column 1: a key must be text; if": "1: a\n",
    ", line 2, column 1: not valid YAML: but found another document": "a: 1\n---\nb: 2\n",
    ", line 2, column 2: not valid YAML:": "a: [1, 2\nb: 3\n",
    ", line 2, column 1: not valid YAML:": "a:\n\t- 1\n",
    ", line 2: not valid YAML: character #x0007": "b: 1\na: \x07\n",
    ", line 1, column 4: integer 99999999999999999999 does": "a: 99999999999999999999\n",
    ": not valid YAML: Exceeds the limit": "a: " + "9" * 5000,
    ", line 1, column 17: mappings and lists": "[" * (DEPTH_LIMIT + 1) + "1" + "]" * (DEPTH_LIMIT + 1),
    ": is larger than 64 KiB, the limit for": "a: " + "x" * (YAML_SIZE_LIMIT - 2),
    ", line 1, column 4: anchor &a is not": LAUGHS,
    ", line 1, column 5: not valid YAML:": "a: " * 20_000,
    ", line 1, column 1007: not valid YAML:": "key: " + "'" * 1001,
    ", line 1: byte 0xed is not": "\ud800",
    ", line 2: byte 0xff is not": b"a: 1\nb: \xff\n",
}


@pytest.mark.parametrize("message", YAML, ids=ascii)
def test_yaml__is_refused_with_its_place(message: str) -> None:
    with refused(f"bad.yaml{message}"):
        parse_yaml(YAML[message], "bad.yaml")


SETTINGS = {
    "--set 'gamma': must be KEY=VALUE or KEY.KEY=VALUE": ["gamma"],
    "--set 'a..b=1': must be KEY=VALUE": ["a..b=1"],
    "--set a.b: this setting is given twice": ["a.b=1", "a.b=2"],
    "--set a, line 1, column 4: not valid YAML": ["a=[1,"],
    "--set gaps_m.2: '2' must be an index from 0 to 1": ["gaps_m.2=1"],
    "--set seed.x: 'x' cannot be set inside 3, which is neither a mapping nor a list": ["seed.x=1"],
}


@pytest.mark.parametrize("message", SETTINGS)
def test_setting__is_refused(message: str) -> None:
    with refused(message):
        Override.put({"gaps_m": [1, 2], "seed": 3}, Override.parse(SETTINGS[message]))


PATHS: dict[str, Callable[[], object]] = {
    "gone.yaml: the file does not exist": lambda: read_yaml("gone.yaml"),
    "a\\x00b: cannot be read (": lambda: read_plain(Path("a\0b"), 8),
    "cannot be read (File name too long)": lambda: read_plain(Path("x" * 5000), 8),
    "/dev/zero: is a device, a pipe or a": lambda: read_plain(Path("/dev/zero"), 8),
    "a: is larger than 0 KiB, the limit for": lambda: read_plain(Path("a"), 7),
    "a: is larger than 0": lambda: open_plain("a", 7).__enter__(),
    "huge.yaml: is larger than 64 KiB": lambda: read_yaml("huge.yaml"),
    "folder: is a folder; must be a plain": lambda: read_yaml("folder"),
    "pipe: is a device, a pipe or a socket": lambda: read_plain(Path("pipe"), 8),
    "loop: cannot be read (Too many levels": lambda: read_plain(Path("loop"), 8),
    "dangling: the file does not exist": lambda: read_plain(Path("dangling"), 8),
    "a/below: cannot be read (Not a dir": lambda: read_plain(Path("a/below"), 8),
    "a: is damaged: Extra data": lambda: read_object(Path("a")),
    "list: is damaged: the content is not a": lambda: read_object(Path("list")),
    "a: already exists; give another name, or pass force=True": lambda: write_output("a", b"new"),
    "link: is a symbolic link; give the path": lambda: write_output("link", b"new", force=True),
    "dangling: is a symbolic link; give the": lambda: write_output("dangling", b"new", force=True),
    "pipe: is a device or a pipe, not a plain": lambda: write_output("pipe", b"new", force=True),
    "/dev/null: is a device or a pipe, not a": lambda: write_output("/dev/null", b"new", force=True),
    "folder: is a folder; give the path of a": lambda: write_output("folder", b"new", force=True),
    "missing/out.csv: the folder missing": lambda: write_output("missing/out.csv", b"new", force=True),
    "a\\x00b: cannot be written (": lambda: check_target("a\0b"),
}


@pytest.mark.parametrize("message", PATHS)
def test_path__is_refused(message: str, empty_folder: Path) -> None:
    Path("a").write_bytes(b"12345678 9")
    Path("list").write_bytes(b"[]")
    with Path("huge.yaml").open("wb") as stream:
        stream.truncate(10**7)  # sparse
    Path("folder").mkdir()
    os.mkfifo("pipe")
    for link, target in (("loop", "loop"), ("dangling", "nowhere"), ("link", "a")):
        Path(link).symlink_to(target)
    with refused(message, AlreadyExists if "already exists" in message else InvalidInput):
        PATHS[message]()
    assert Path("a").read_bytes() == b"12345678 9" and not Path("nowhere").exists()


def test_link__is_not_followed_where_it_must_not_be(empty_folder: Path) -> None:
    Path("a").write_bytes(b"12345678")
    Path("link").symlink_to("a")
    with refused("link: is a symbolic link; give the path of the file to which it points", CorruptBundle):
        read_plain(Path("link"), 8, refusal=CorruptBundle, follow_links=False)


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', "[NaN]", "[1e999]", "[" * 100_000, "[1", "\xff"])
def test_json__is_strict(text: str) -> None:
    with pytest.raises(ValueError, match=r"twice|not a JSON number|too large|nested|Expecting|decode"):
        parse_strict_json(text.encode("latin-1"))
