"""Films of single episodes, and the command that writes them."""

import io
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image, ImageSequence

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.rendering import viewer
from ethbrake_marl.extensions.rendering.film import WRITERS, film_scenes, films_of
from ethbrake_marl.extensions.rendering.picture import FLASH, PANEL_TOP, vector_picture, vehicle_colour
from ethbrake_marl.extensions.rendering.scene import Scene
from tests.fixtures.commands import Command, Refuse
from tests.programmes.figures import frames, unequal_share

DOCS = Path(__file__).resolve().parents[3] / "docs"
# Vehicle 2, 6 m/s faster, strikes Vehicle 1 after 0.95 s: harm 36. The horizon is 1.3 s.
CRASH = eb.load_scenario("paper-random").replace(
    name="crash", gaps_m=[5.7, 100.0], speeds_mps=[10.0, 16.0, 16.0], horizon_s=1.3, restitution=0.0,
    roles={"vehicle_1": "coast", "vehicle_2": "learner"},
)  # fmt: skip


def scenes_of(scenario: eb.Scenario, agent: str, world: int = 0) -> list:
    loaded, game = eb.open_game(scenario)
    (team,) = teams_of(agent, loaded).values()
    return film_scenes(loaded.sample(1, 7, first=world), team, game)


def test_scenes__are_evenly_spaced_and_those_of_the_world_by_hand() -> None:
    scenes = scenes_of(CRASH, "coast")
    assert [round(scene.time_s, 9) for scene in scenes] == [*(k / 25 for k in range(33)), 1.3]
    assert [scene.ended for scene in scenes].index(True) == 33
    struck = [round(scene.time_s, 9) for scene in scenes if scene.impacts]
    assert (struck[0], struck[-1]) == (0.96, 1.24)  # shown for 0.3 s
    assert scenes[-1].line[5].sum() == pytest.approx(36.0) and scenes[23].line[5].sum() == 0.0
    assert scenes[10].fronts_m[0] == pytest.approx(4.0) and scenes[10].line[2, 1] == pytest.approx(5.7 - 0.4 * 6.0)


@pytest.mark.parametrize("ending", [".gif", ".mp4"])
def test_film__plays_in_real_time_and_ends_with_the_longest(ending: str, tmp_path: Path) -> None:
    scenario, game = eb.open_game(CRASH)
    teams = {name: teams_of(agent, scenario)[agent] for name, agent in (("a", "coast"), ("b", "full_brake"))}
    path = tmp_path / "film"
    path.write_bytes(WRITERS[ending](films_of(scenario.sample(1, 7), teams, game)))
    if ending == ".mp4":
        library = pytest.importorskip("imageio_ffmpeg", reason="needs the extra: pip install 'ethbrake-marl[render]'")
        assert library.count_frames_and_secs(str(path)) == (34, pytest.approx(34 / 25, abs=0.02))
        return
    shown = Image.open(io.BytesIO(path.read_bytes()))
    assert (shown.n_frames, shown.size) == (34, (800, 608))
    assert [frame.info["duration"] for frame in ImageSequence.Iterator(shown)] == [*33 * [40], 2000]


@pytest.mark.slow
def test_watch__makes_the_film_of_the_readme(ethbrake: Command, empty_folder: Path) -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")  # of which `plan` is
    file = DOCS / "figures" / "emergency.gif"
    answer = ethbrake("watch", "--agents", "full_brake,plan", "--output", "now.gif")
    assert (answer.status, answer.out, answer.err) == (0, "", "film: now.gif\n")
    now, then = map(frames, (Path("now.gif"), file))
    # Pillow 11.3 draws 0.1 % of the points otherwise than Pillow 13; with another agent 3 % are others.
    assert unequal_share(now, then) < 5e-3 and file.stat().st_size < 1e6


def test_readme_film__shows_every_impact() -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")
    for agent, speeds in (("full_brake", ["2.4", "5.3"]), ("plan", ["3.5"])):
        shown = [str(impact) for scene in scenes_of("paper-random", agent) for impact in scene.impacts]
        assert [text.split(" at ")[1] for text in dict.fromkeys(shown)] == [f"{speed} m/s" for speed in speeds]
        assert all(shown.count(text) >= 7 for text in shown)  # 0.3 s each


def svg_of(scene: Scene) -> ElementTree.Element:
    return ElementTree.fromstring(f"<svg>{vector_picture(scene)}</svg>")


def test_watch__writes_svg_with_the_three_moments_of_the_png(ethbrake: Command, empty_folder: Path) -> None:
    for name in ("three.svg", "three.png"):
        answer = ethbrake("watch", "--agents", "full_brake", "--output", name)
        assert (answer.status, answer.err) == (0, f"pictures: {name}\n")
    drawn = ElementTree.parse("three.svg").getroot()
    assert (1, int(drawn.get("height")), int(drawn.get("width")), 4) == np.shape(frames(Path("three.png")))
    texts = [element.text for element in drawn.iter() if element.tag.endswith("}text")]
    clocks = [text for text in texts if "after the alert" in text]
    assert [clock.split(" s")[0] for clock in clocks] == ["0.00", "3.32", "3.90"]
    assert "impact of Vehicles 2 and 3 at 5.3 m/s" in texts


def test_vehicle__of_12_tonnes_is_drawn_as_a_truck() -> None:
    def boxes(mass_t: float) -> int:
        scene = scenes_of(CRASH.replace(mass_t=[4.5, mass_t, 4.5]), "coast")[0]
        blue = vehicle_colour(2)
        return sum(each.get("fill") == blue and float(each.get("y")) < PANEL_TOP for each in svg_of(scene).iter("rect"))

    assert (boxes(11.9), boxes(12.0)) == (1, 2)  # a cab and a trailer


def test_labels__of_impacts_and_gaps_do_not_touch() -> None:
    close = CRASH.replace(gaps_m=[4.0, 4.0], speeds_mps=[28.0, 34.0, 40.0])
    scene = next(scene for scene in scenes_of(close, "coast") if len(scene.impacts) == 2)
    drawn = svg_of(scene)
    (box,) = (each for each in drawn.iter("rect") if each.get("fill") == FLASH)
    bottom = float(box.get("y")) + float(box.get("height"))
    gaps = [
        float(each.get("y"))
        for each in drawn.iter("text")
        if each.text.endswith(" m") and each.get("font-size") == "14"
    ]
    assert len(set(gaps)) == 2  # one above the other
    assert bottom < min(gaps) - 10  # height of a digit


def test_watch__without_a_file_opens_a_window_or_writes_one(
    ethbrake: Command, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pygame = pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    shown: list[tuple[int, ...]] = []
    monkeypatch.setattr(viewer.Screen, "show", lambda screen, frame, fps: shown.append(frame.shape) or len(shown) < 5)
    answer = ethbrake("watch", "--agents", "coast")
    assert (answer.status, answer.err, [*empty_folder.iterdir()]) == (0, "", [])
    assert shown == 5 * [(304, 800, 3)]  # then the user closes the window
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nothing")
    answer = ethbrake("watch", "--agents", "coast")
    assert answer.status == 0 and answer.err.startswith("cannot open a window (") and "film: watch.gif" in answer.err
    assert Path("watch.gif").stat().st_size > 1e5


def test_watch__offscreen_is_no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """SDL draws offscreen without any display, unless the user asks for it."""
    pygame = pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    monkeypatch.setattr(pygame.display, "init", lambda: None)
    with pytest.raises(InvalidInput, match=r"cannot open a window \(there is no display\)"):
        viewer.Screen(np.zeros((304, 800, 3), np.uint8))


def test_watch__prints_the_alert_every_impact_and_the_end(ethbrake: Command, empty_folder: Path) -> None:
    answer = ethbrake("watch", "--agents", "full_brake,coast", "--output", "-")
    times = [line.split("  ")[1] for line in answer.out.splitlines() if line.startswith("full_brake: world 0")]
    assert times == [f"{time} s after the alert" for time in ("0.00", "2.20", "3.32")] + [
        "3.90 s after the alert (ended)"
    ]
    assert "impact of Vehicles 2 and 3 at 5.3 m/s, 3.30 s" in answer.out and "coast: world 0" in answer.out
    assert [*empty_folder.iterdir()] == []


def test_watch__is_refused(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse("watch --agents nobody --output x.txt", "film with the file ending '.txt': the ending must be one of")
    refuse("watch --agents nobody --output x.gif", "unknown agent 'nobody'")
    refuse("watch --scenario level-0-sensors --output x.gif", "has no learner that the agents could drive")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refuse("watch --agents coast --output x.mp4", "needs the package imageio_ffmpeg, which is not installed")
    Path("film.gif").write_text("precious")
    told = "film.gif: already exists; give another name, or pass force=True (--force) to overwrite the file"
    refuse("watch --agents full_brake --output film.gif", told)
