"""`ethbrake watch picture ...`."""

from __future__ import annotations

import re

import pytest

from tests.fixtures.pictures import EMPTY

PNG = b"\x89PNG\r\n\x1a\n"


def test_criticality__writes_a_png_and_says_where(ethbrake, tmp_path):
    out = tmp_path / "map.png"
    options = ("--scenario", "paper-distance", "--agent", "constant:5", "--cells", "5", "--output", out)
    answer = ethbrake("watch", "picture", "criticality", *options)
    assert (answer.status, answer.out) == (0, "")
    assert f"picture: {out}" in answer.err
    assert out.read_bytes().startswith(PNG)


def test_deceleration__writes_a_png_of_that_world(ethbrake, tmp_path):
    for world in (0, 5):
        out = tmp_path / f"curve-{world}.png"
        options = ("--scenario", "paper-random", "--world", str(world), "--output", out)
        answer = ethbrake("watch", "picture", "deceleration", *options)
        assert (answer.status, answer.out) == (0, "")
        assert out.read_bytes().startswith(PNG)
    assert (tmp_path / "curve-0.png").read_bytes() != (tmp_path / "curve-5.png").read_bytes()


@pytest.mark.parametrize(
    ("ending", "magic"),
    [
        (".svg", b"<?xml"),
        pytest.param(".pdf", b"%PDF", marks=pytest.mark.slow),
        pytest.param(".PNG", PNG, marks=pytest.mark.slow),
    ],
)
def test_picture__is_written_as_its_name_ends_and_the_same_bytes_again(ethbrake, tmp_path, ending, magic):
    written = []
    for name in ("one", "other"):
        out = tmp_path / f"{name}{ending}"
        assert ethbrake("watch", "picture", "deceleration", "--output", out).status == 0
        written.append(out.read_bytes())
    assert written[0].startswith(magic)
    assert written[0] == written[1]
    assert not re.search(rb"20\d\d-\d\d|CreationDate|dc:date|Matplotlib v", written[0])


@pytest.mark.parametrize("picture", ["criticality", "deceleration", "shield"])
@pytest.mark.parametrize("name", ["map.jpg", "map", "map.png.eps"])
def test_picture__another_ending_is_refused_at_once(ethbrake, tmp_path, picture, name):
    answer = ethbrake("watch", "picture", picture, "--output", tmp_path / name)
    assert answer.status == 2
    assert "pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf" in answer.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("picture", ["criticality", "deceleration", "shield"])
def test_picture__overwrites_only_by_force(ethbrake, tmp_path, picture):
    out = tmp_path / "map.png"
    out.write_bytes(b"mine")
    more = {"criticality": ("--cells", "2"), "deceleration": (), "shield": ("--episodes", "3")}[picture]
    answer = ethbrake("watch", "picture", picture, *more, "--output", out)
    assert (answer.status, out.read_bytes()) == (2, b"mine")
    assert "--force" in answer.err
    assert ethbrake("watch", "picture", picture, *more, "--output", out, "--force").status == 0
    assert out.read_bytes() == EMPTY


def test_criticality__a_scenario_with_random_speeds_is_refused(ethbrake, tmp_path):
    answer = ethbrake("watch", "picture", "criticality", "--scenario", "paper-random", "--output", tmp_path / "map.png")
    assert answer.status == 2
    assert "speed_1_mps is random" in answer.err


@pytest.mark.usefixtures("undrawn")
def test_criticality__takes_a_range_of_both_gaps(ethbrake, tmp_path):
    arguments = (
        "watch",
        "picture",
        "criticality",
        "--agent",
        "coast",
        "--cells",
        "2",
        "--output",
        tmp_path / "map.png",
    )
    assert ethbrake(*arguments, "--gaps", "8", "9").status == 0
    answer = ethbrake(*arguments, "--gaps", "9", "8", "--force")
    assert answer.status == 2
    assert "0 <= low < high" in answer.err
