"""``ethbrake watch``, ``search falsify``, ``shield`` and ``reproduce``: files that they write, and what they run."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.evaluation.episodes import Passport, follow_episodes
from ethbrake_marl.evaluation.inputs import NamedWorlds
from ethbrake_marl.scenario import Scenario, load_scenario, new_scenario_text
from tests.cli.conftest import Command, check_refused, told_json
from tests.failing_worlds import plant
from tests.fixtures.pictures import EMPTY
from tests.pages.hostile import HOSTILE, UNSEEN

PNG = b"\x89PNG\r\n\x1a\n"
EVIL = """from pathlib import Path
import ethbrake_marl as eb
Path("ran").touch()
def make():
    return eb.make_agent("coast")
"""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# Passports


def passport_of(spec: str, scenario_name: str | Path = "paper-random", *, seed: int | None = 7, world: int = 3) -> str:
    scenario = load_scenario(scenario_name)
    worlds = scenario.sample(1, 7, first=world).worlds
    (motion,) = follow_episodes(worlds, make_agent(spec, scenario=scenario), scenario)
    return str(Passport.of(motion, scenario, spec, seed=seed, number=world))


def test_replay__is_the_same_episode_bit_for_bit(ethbrake: Command) -> None:
    for spec in ("full_brake", "constant:4.5"):
        told = ethbrake("watch", "replay", passport_of(spec)).out
        assert "The same episode, bit for bit." in told and "Differs" not in told


def test_replay__writes_a_page_and_a_film(ethbrake: Command) -> None:
    text, page, film = passport_of("full_brake"), Path("again.html"), Path("again.gif")
    assert ethbrake("watch", "replay", text, "--output", page).status == 0
    assert text in page.read_text() and "bit for bit" in page.read_text()
    assert ethbrake("watch", "replay", text, "--output", film).status == 0
    assert film.read_bytes().startswith(b"GIF89a")
    check_refused(ethbrake("watch", "replay", text, "--output", page), "--force")
    check_refused(ethbrake("watch", "replay", text, "--output", "again.txt"), "films are written as")


def test_replay__says_that_the_scenario_was_edited_and_what_is_missing(ethbrake: Command) -> None:
    path = Path("elsewhere/mine.yaml").absolute()  # a file beside the caller would be found
    path.parent.mkdir()
    path.write_text(new_scenario_text("mine"))
    text = passport_of("full_brake", path)
    for words, told in (
        ([text], "--scenario FILE.yaml"),
        ([passport_of("full_brake", seed=None)], "--initial-states FILE.csv"),
        ([passport_of("full_brake"), "--initial-states", __file__], "leave --initial-states out"),
    ):
        check_refused(ethbrake("watch", "replay", *words), told)
    assert ethbrake("watch", "replay", text, "--scenario", path).status == 0
    path.write_text(path.read_text().replace("restitution: 0.1", "restitution: 0.2"))
    answer = ethbrake("watch", "replay", text, "--scenario", path, "--json")
    told = json.loads(answer.out)
    assert (answer.status, told["same"]) == (1, False)
    assert any(each.startswith("the scenario") for each in told["differences"])
    assert ethbrake("watch", "replay", text, "--scenario", path, "--set", "restitution=0.1").status == 0


def test_replay_and_again__run_no_code_that_only_a_file_names(ethbrake: Command) -> None:
    Path("mine.py").write_text(EVIL)
    text = passport_of("mine.py:make")
    Path("ran").unlink()
    check_refused(ethbrake("watch", "replay", text), "--agent mine.py:make")
    found = ("search", "falsify", "--agent", "coast", "--against", "full_brake", "--budget", "64")
    assert ethbrake(*found, "--output", "worst.yaml").status == 0
    whole = Path("worst.yaml").read_text()
    for line in ("agent: coast\n", "against: full_brake\n"):
        Path("worst.yaml").write_text(whole.replace(line, f'{line.partition(" ")[0]} "mine.py:make"\n'))
        check_refused(ethbrake("search", "falsify", "--again", "worst.yaml"), "is code")
    assert not Path("ran").exists()
    assert ethbrake("watch", "replay", text, "--agent", "mine.py:make").status == 0


EXAMPLE = Passport(
    "paper-random", "0" * 10, 7, 3, "first", (1,), ("0.1.0", "3.11.7", "0.68.1", "2.4.6"), "0" * 6, "0" * 10, None,
    "coast",
)  # fmt: skip


@pytest.mark.parametrize(
    "text", [pytest.param(text, marks=pytest.mark.slow if k % 6 else ()) for k, text in enumerate(HOSTILE)]
)
def test_replay__of_anything_else_is_refused_in_one_line(ethbrake: Command, text: str) -> None:
    passport = str(EXAMPLE)
    given = (text, "EB1:" + text, passport.replace("paper-random", text), f"{passport[:-6]}{text}")
    for each in (*given, str(replace(EXAMPLE, agent=text))):
        answer = ethbrake("watch", "replay", "--", each)
        check_refused(answer)
        assert not set(answer.err[:-1]) & UNSEEN
    assert list(Path().iterdir()) == []


@pytest.mark.usefixtures("undrawn")
def test_report__its_passports_can_be_replayed(ethbrake: Command) -> None:
    answer = ethbrake("evaluate", "--agents", "full_brake,constant:3+step", "--episodes", "12", "--report", "r.html")
    assert answer.status == 0, answer.err
    text = Path("r.html").read_text()
    passports = [each.partition('"')[0] for each in text.split('"passport":"')[1:]]
    assert len(passports) == len(set(passports)) == 24 and "minus episode mode" in text
    assert "First-impact harm, which the shield bounds" in text
    for passport in (passports[0], passports[-1]):
        assert "bit for bit" in ethbrake("watch", "replay", passport).out


# Worlds in which an agent is worst


def test_falsify__as_many_worlds_as_it_keeps_read_back(ethbrake: Command) -> None:
    words = ("--agent", "full_brake", "--measure", "harm", "--scenario", "stress-wide", "--keep", "200")
    words += ("--budget", "512", "--at-random", "--output", "many.yaml", "--json")
    told, kept = told_json(ethbrake("search", "falsify", *words)), NamedWorlds.read(Path("many.yaml")).worlds
    assert told["worlds"] == [world.model_dump(exclude_none=True) for world in kept] and len(kept) == 200
    assert Path("many.yaml").stat().st_size > 64 << 10


# Pictures


@pytest.mark.parametrize(
    "words",
    [
        ("criticality", "--scenario", "paper-distance", "--agent", "constant:5", "--cells", "3", "--gaps", "8", "9"),
        pytest.param(("shield-modes", "--agents", "full_brake", "--episodes", "6"), marks=pytest.mark.slow),
        ("shield-modes", "--scenario", "cooperation-3-pair", "--agents", "full_brake", "--episodes", "6"),
        ("shield", "--scenario", "cooperation-3-pair", "--agents", "full_brake", "--episodes", "6"),
    ],
)
def test_picture__is_drawn_and_said_where(ethbrake: Command, words: tuple[str, ...]) -> None:
    answer = ethbrake("watch", "picture", *words, "--output", "x.png")
    assert (answer.status, answer.out) == (0, "") and "picture: x.png" in answer.err
    assert Path("x.png").read_bytes().startswith(PNG)


@pytest.mark.usefixtures("undrawn")
def test_picture__of_robustness_tells_its_figures(ethbrake: Command) -> None:
    words = ("--uncertainty", "gaps_m.pair_1=1", "--episodes", "2", "--output", "x.png", "--json")
    told = told_json(ethbrake("watch", "picture", "robustness", *words))
    assert len(told) == 5 * 3 * 2 and {row["mode"] for row in told} == {"step", "robust"}


@pytest.mark.parametrize(
    ("ending", "magic"),
    [
        (".svg", b"<?xml"),
        pytest.param(".pdf", b"%PDF", marks=pytest.mark.slow),
        pytest.param(".PNG", PNG, marks=pytest.mark.slow),
    ],
)
def test_picture__is_written_as_its_name_ends_and_the_same_bytes_again(ethbrake, ending: str, magic: bytes) -> None:
    for world, name in (("0", "one"), ("0", "same"), ("5", "other")):
        words = ("--world", world, "--output", f"{name}{ending}")
        assert ethbrake("watch", "picture", "deceleration", *words).status == 0
    one, same, other = (Path(f"{name}{ending}").read_bytes() for name in ("one", "same", "other"))
    assert one.startswith(magic) and one == same != other
    assert not re.search(rb"20\d\d-\d\d|CreationDate|dc:date|Matplotlib v", one)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "words",
    [
        ("criticality", "--cells", "2"),
        ("deceleration",),
        pytest.param(("shield", "--episodes", "3"), marks=pytest.mark.slow),
        pytest.param(("robustness", "--episodes", "2", "--uncertainty", "gaps_m=1"), marks=pytest.mark.slow),
    ],
)
def test_picture__overwrites_only_by_force(ethbrake: Command, words: tuple[str, ...]) -> None:
    out = Path("map.png")
    out.write_bytes(b"mine")
    check_refused(ethbrake("watch", "picture", *words, "--output", out), "--force")
    assert out.read_bytes() == b"mine"
    assert ethbrake("watch", "picture", *words, "--output", out, "--force").status == 0 and out.read_bytes() == EMPTY


# Data sets


@pytest.mark.parametrize(
    ("packages", "words", "file", "told"),
    [
        (["pyarrow"], ["--agents", "full_brake,coast"], "a.parquet", "dataset: a.parquet, .* decisions"),
        (["minari", "h5py"], ["--agents", "full_brake"], "brakes-v0",
         r"load it: MINARI_DATASETS_PATH=(.*), minari.load_dataset\('brakes-v0'\)"),
    ],
)  # fmt: skip
def test_dataset__is_written_and_told(ethbrake: Command, packages: list[str], words: Any, file: str, told: str) -> None:
    for package in packages:
        pytest.importorskip(package)
    answer = ethbrake("watch", "dataset", *words, "--episodes", "3", "--output", file)
    lines = answer.err.splitlines()
    assert (answer.status, answer.out) == (0, "") and [path.name for path in Path().iterdir()] == [file]
    assert "full_brake: 3 episodes; harm differs from `ethbrake evaluate` by at most 0 m2/s2 in a world" in lines
    found = re.fullmatch(told, lines[-1])
    assert found is not None and list(found.groups()) in ([], [str(Path().absolute())])


@pytest.mark.parametrize(
    ("package", "extra", "line"),
    [
        ("pyarrow", "data", "watch dataset --episodes 2 --output a.parquet"),
        ("minari", "data", "watch dataset --episodes 2 --output brakes-v0"),
        ("pyarrow", "data", "evaluate --agents coast --episodes 2 --per-world worlds.parquet"),
        ("imageio_ffmpeg", "render", "watch record --agents coast --output film.mp4"),
        ("onnx", "export", "agent export shipped/ppo --onnx policy.onnx"),
    ],
)
def test_file__of_an_extra_that_is_missing_says_the_line_that_installs_it(
    ethbrake: Command, package: str, extra: str, line: str, monkeypatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    missing = f"needs the package {package}, which is not installed: {sys.executable} -m pip install"
    check_refused(ethbrake(*line.split()), f"{missing} 'ethbrake-marl[{extra}]'\n")
    assert list(Path().iterdir()) == []


# Shields


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "words",
    [
        ("shield", "--agents", "full_brake"),
        ("watch", "picture", "shield-modes", "--agents", "coast", "--output", "x.png"),
        ("watch", "picture", "shield", "--agents", "coast,full_brake", "--output", "x.png"),
        pytest.param(("watch", "picture", "robustness", "--output", "x.png"), marks=pytest.mark.slow),
    ],
    ids=lambda words: " ".join(words[:3]),
)
def test_shield__names_the_worlds_that_it_leaves_out(ethbrake: Command, monkeypatch, words: tuple[str, ...]) -> None:
    sample = Scenario.sample

    def planted(self, n, seed, **options):
        drawn = sample(self, n, seed, **options)
        return replace(drawn, worlds=plant(drawn.worlds, [2] if n == 4 else []))

    monkeypatch.setattr(Scenario, "sample", planted)
    answer = ethbrake(*words, "--episodes", "4")
    assert answer.status == 0 and "LEFT OUT for every agent: 1 of 4 worlds" in answer.err
    assert "world 2 of seed 7 (a contact was missed" in answer.err


def test_shield__of_several_learners_tells_its_policies_and_can_be_compared(ethbrake: Command) -> None:
    words = ("--scenario", "cooperation-3-pair", "--agents", "full_brake,policy@shipped", "--episodes", "12", "--json")
    answer = ethbrake("shield", *words)
    rows = told_json(answer)
    assert [row["mode"] for row in rows] == ["none", "step", "step-alert", "step-cap"] * 2
    assert rows[1]["harm"] <= rows[1]["bound"] and rows[1]["against_episode"] is None
    assert {row["above_bound"] for row in rows if row["mode"] != "none"} == {0}
    assert set(rows[5]["policy_sha256"]) == {"vehicle_2", "vehicle_3"} and rows[0]["policy_sha256"] == {}
    Path("shield.json").write_text(answer.out)
    compared = ethbrake("compare", "shield.json", "shield.json")
    assert compared.status == 0 and "step-cap" in compared.out


# The paper again


def test_reproduce__says_what_it_takes_makes_one_item_and_keeps_it(ethbrake: Command) -> None:
    words = ("reproduce", "accelerations", "--episodes", "20", "--output", "out")
    answer = ethbrake(*words, "--json")
    assert "to do: 1 item," in answer.err and "page: out/index.html" in answer.err
    (result,) = told_json(answer)
    assert result["name"] == "accelerations" and result["verdict"]["outcome"] in ("agrees", "differs")
    file = Path("out/accelerations/result.json")
    made = file.stat().st_mtime_ns
    assert ethbrake(*words).status == 0 and file.stat().st_mtime_ns == made
