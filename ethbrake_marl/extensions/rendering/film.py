"""Films of episodes in real time, as GIF, MP4 or in a window; and single moments of them, as PNG, SVG or text."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ethbrake_marl.agents.team import Team, play
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, need
from ethbrake_marl.extensions.rendering.picture import HEIGHT, WIDTH, Frame, picture, vector_picture
from ethbrake_marl.extensions.rendering.scene import Motion, Scene
from ethbrake_marl.extensions.rendering.viewer import Screen
from ethbrake_marl.motion.layout import TOTAL

LAST_S = 2  # time for which the last scene stays (s)
FPS = 25  # scenes per second; a divisor of 100, because a GIF stores times in hundredths of a second
GIF_COLOURS = 64
OPENSCENARIO = ".xosc"
NEEDS = {".mp4": "imageio_ffmpeg", OPENSCENARIO: "jinja2"}  # file ending -> package
ROAD = 160  # height (pixels) of title, gaps and road, the upper part of a picture


def film_scenes(world: State, team: Team, game: Game) -> list[Scene]:
    """Scenes of one world that a team drives: 25 per second from the alert on, and the end."""
    motion, scenes = Motion(game, world, 0), list[Scene]()
    for _, state in play(game, world, team):
        motion.step(state)
        first = math.ceil(motion.start_s * FPS - 1e-9) if scenes else 0
        times = [k / FPS for k in range(first, math.ceil(motion.until_s * FPS - 1e-9))]
        scenes += map(motion.scene, [*times, motion.until_s] if motion.ended else times)
    return scenes


def films_of(world: State, teams: Mapping[str, Team], game: Game) -> Films:
    """Films of teams that drive the same world. ``teams``: title -> team."""
    return {title: film_scenes(world, team, game) for title, team in teams.items()}


def check_film(ending: str) -> None:
    """Raise ``InvalidInput`` for an unknown ending; ``MissingExtra`` for one whose package is not installed."""
    endings = (*WRITERS, OPENSCENARIO)
    if ending not in endings:
        raise InvalidInput(f"film with the file ending {ending!r}: the ending must be one of {', '.join(endings)}")
    if ending in NEEDS:
        need(NEEDS[ending])


Films = Mapping[str, Sequence[Scene]]  # title -> scenes, of one world


def stack_films(films: Films) -> Iterator[Frame]:
    """Pictures of all films, one below the other. A film that ends early shows its last scene."""
    for k in range(max(map(len, films.values()))):
        frame_scenes = (scenes[min(k, len(scenes) - 1)]._replace(title=title) for title, scenes in films.items())
        yield np.concatenate([picture(scene) for scene in frame_scenes])


def write_gif(films: Films) -> bytes:
    from PIL import Image

    first_frame, *later_frames = (
        Image.fromarray(frame).quantize(GIF_COLOURS, method=Image.Quantize.FASTOCTREE) for frame in stack_films(films)
    )
    buffer = io.BytesIO()
    times_ms = [*len(later_frames) * [1000 // FPS], 1000 * LAST_S]
    first_frame.save(buffer, "GIF", save_all=True, append_images=later_frames, duration=times_ms, loop=0)
    return buffer.getvalue()


def show_in_window(films: Films) -> None:
    """Play films in a window until their end or until the user closes it. Raises the errors of ``Screen``."""
    drawn = stack_films(films)
    frames = [next(drawn)]
    screen = Screen(frames[0])
    frames += drawn
    for frame in frames + FPS * LAST_S * frames[-1:]:
        if not screen.show(frame, FPS):
            break
    screen.close()


def films_in_words(films: Films) -> str:
    """Text of films: the first scene, the first scene after every impact, and the end."""
    texts = []
    for title, scenes in films.items():
        before = [(), *(scene.impacts for scene in scenes)]
        for scene, earlier in zip(scenes, before, strict=False):
            if scene in (scenes[0], scenes[-1]) or {*scene.impacts} - {*earlier}:
                texts.append(scene._replace(title=title).text())
    return "\n".join(texts)


def write_mp4(films: Films) -> bytes:
    """Content of an MP4 file with the films, one below the other."""
    from imageio_ffmpeg import write_frames

    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = write_frames(str(path), (WIDTH, HEIGHT * len(films)), fps=FPS, quality=8)
        next(writer)
        for frame in stack_films(films):
            writer.send(frame)
        writer.close()
        return path.read_bytes()


def moments(films: Films) -> Iterator[Scene]:
    """For each film: the alert, the hardest impact under any team, and the end."""
    numbered = [(k, scene) for scenes in films.values() for k, scene in enumerate(scenes)]
    impacts = [(impact.closing_mps, -k) for k, scene in numbered for impact in scene.impacts]
    hardest = -max(impacts, default=(0.0, 0))[1]  # number of the first scene that shows the hardest impact
    last = max(map(len, films.values())) - 1
    for title, scenes in films.items():
        for scene in (scenes[min(k, len(scenes) - 1)] for k in sorted({0, hardest, last})):
            yield scene._replace(title=f"{title}, harm {scene.line[TOTAL, :-1].sum():.1f} m2/s2")


def write_png(films: Films) -> bytes:
    """PNG file with the ``moments`` of films."""
    from PIL import Image

    rows = [picture(scene)[:ROAD] for scene in moments(films)]
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(rows)).quantize(GIF_COLOURS).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def write_svg(films: Films) -> bytes:
    """SVG file with the ``moments`` of films."""
    rows = [
        f'<svg y="{k * ROAD}" width="{WIDTH}" height="{ROAD}">\n{vector_picture(scene)}\n</svg>'
        for k, scene in enumerate(moments(films))
    ]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{len(rows) * ROAD}"'
        f' viewBox="0 0 {WIDTH} {len(rows) * ROAD}" font-family="Arial, Helvetica, sans-serif">'
    )
    return "\n".join([head, *rows, "</svg>\n"]).encode()


WRITERS: dict[str, Callable[[Films], bytes]] = {
    ".gif": write_gif,
    ".mp4": write_mp4,
    ".png": write_png,
    ".svg": write_svg,
}
