"""Films of episodes in real time: pictures of the environment as GIF or MP4, or an animated drawing as SVG."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ethbrake_marl.agents.driving import episode_engine
from ethbrake_marl.agents.protocol import Driver, Team
from ethbrake_marl.envs.rendering import Frame, Scene
from ethbrake_marl.envs.trace import Trace
from ethbrake_marl.errors import InvalidInput, PhysicsError, count_of, need
from ethbrake_marl.extensions.report.moving_drawing import animate_films
from ethbrake_marl.physics.state import Worlds
from ethbrake_marl.scenario.schema import Scenario

Films = Mapping[str, Sequence[Scene]]  # scenes of each film of one world, by title

FILM_FPS = 25

MOST_FILMS = 12  # largest number of films in one file, one below the other

MOST_PICTURES = 2_500  # largest number of pictures of all films together; they need 1.8 GB of memory

_COLOURS = 64


def film_scenes(world: Worlds, agent: Driver, *, scenario: Scenario, fps: float = FILM_FPS) -> list[Scene]:
    """Simulate one episode, and return its scenes: ``fps`` scenes per second from the alert on, and the final scene.

    Raises ``InvalidInput`` if there is not exactly one world, and ``PhysicsError`` if it cannot be simulated.

    ``agent`` controls the learner of the scenario, or is a team of agents for several learners; it is not changed. The
    scenario's scripts control the other vehicles.
    """
    if world.n != 1:
        raise InvalidInput(
            f"film_scenes: world has {count_of(world.n, 'world')}; give exactly one, for instance worlds.take([0])"
        )
    engine = episode_engine(world, Team.of(agent, scenario.learners), scenario)
    trace = Trace(engine, whole=True, alert=world)
    while not engine.ended.all():
        engine.step({})
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
    end = float(engine.worlds.time_s[0])
    times = np.append(np.arange(int(np.ceil(end * fps - 1e-9))) / fps, end)
    shown: list[Scene] = []
    for motion in trace.motions(engine):
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        mine = times[(times >= start if motion.fresh[0] else times > start) & (times <= until)]
        shown += motion.scenes(engine, 0, mine) if len(mine) else []
    return shown


def film(world: Worlds, agents: Mapping[str, Driver], ending: str, *, scenario: Scenario) -> bytes:
    """Let several agents drive the same world; return a film of their episodes as the bytes of a file.

    The keys of ``agents`` are the titles above their films. Raises the exceptions of ``film_scenes`` and
    ``film_bytes``.
    """
    check_film(ending, len(agents))
    films = {title: film_scenes(world, agent, scenario=scenario) for title, agent in agents.items()}
    return film_bytes(films, ending)


def film_bytes(films: Films, ending: str, *, fps: int = FILM_FPS) -> bytes:
    """Return the bytes of a GIF, MP4 or SVG file that shows films of one world in real time, one below the other.

    A film that ends before the longest film shows its last scene until the end of the file. GIF and SVG files repeat
    endlessly. The keys of ``films`` are titles. ``ending`` is the ending of the file name: ``.gif``, ``.mp4`` or
    ``.svg``. ``fps`` is the number of scenes per second. Raises ``InvalidInput`` if there are no films, more than
    ``MOST_FILMS`` films or more than ``MOST_PICTURES`` pictures, if ``ending`` is unknown, or if 100 is not a multiple
    of ``fps`` (a GIF stores times in hundredths of a second). Raises ``MissingExtra`` for an MP4 file if the library
    imageio-ffmpeg is not installed.
    """
    check_film(ending, len(films))
    if not films or not all(films.values()):
        raise InvalidInput("film_bytes: there are no scenes; give at least one film with at least one scene")
    if not fps > 0 or 100 % fps:
        raise InvalidInput(f"film_bytes: fps = {fps}: 100 must be a multiple of fps; give 10, 20, 25 or 50")
    pictures = len(films) * max(map(len, films.values()))
    if pictures > MOST_PICTURES:
        raise InvalidInput(
            f"film of {len(films)} agents for {pictures // len(films) / fps:g} s: the film needs {pictures:,} pictures,"
            f" but at most {MOST_PICTURES:,} are allowed; give fewer agents, or a scenario with a shorter horizon_s"
        )
    return _WRITERS[ending](films, fps)


def check_film(ending: str, films: int = 1) -> None:
    """Raise ``InvalidInput`` if ``film_bytes`` cannot write a file with this ``ending``, or this number of ``films``.

    Raises ``MissingExtra`` for an MP4 file if the library imageio-ffmpeg is not installed.
    """
    if ending not in _WRITERS:
        raise InvalidInput(f"film with the file ending {ending!r}: the ending must be one of {', '.join(_WRITERS)}")
    if ending == ".mp4":
        need("imageio_ffmpeg")
    if films > MOST_FILMS:
        raise InvalidInput(f"film: {films} agents are too many; give at most {MOST_FILMS} agents")


def _stacked(films: Films) -> Iterator[Frame]:
    """Yield the pictures of a GIF or MP4 file in order: the scenes of all films at one time, one below the other."""
    for k in range(max(map(len, films.values()))):
        each = (shown[min(k, len(shown) - 1)]._replace(title=title) for title, shown in films.items())
        yield np.concatenate([scene.frame() for scene in each])


def _write_gif(films: Films, fps: int) -> bytes:
    from PIL import Image

    pictures = [
        Image.fromarray(frame).quantize(_COLOURS, method=Image.Quantize.FASTOCTREE) for frame in _stacked(films)
    ]
    buffer = io.BytesIO()
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:], duration=1000 // fps, loop=0)
    return buffer.getvalue()


def _write_mp4(films: Films, fps: int) -> bytes:
    from imageio_ffmpeg import write_frames

    frames = list(_stacked(films))
    height, width, _ = frames[0].shape
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = write_frames(str(path), (width, height), fps=fps, quality=8)
        writer.send(None)
        for frame in frames:
            writer.send(frame)
        writer.close()
        return path.read_bytes()


_WRITERS: dict[str, Callable[[Films, int], bytes]] = {
    ".gif": _write_gif,
    ".mp4": _write_mp4,
    ".svg": lambda films, fps: animate_films(films, fps=fps).encode(),
}
