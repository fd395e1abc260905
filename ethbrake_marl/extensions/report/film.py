"""Films of episodes in real time as GIF or MP4, and strips of three moments as PNG."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ethbrake_marl.errors import InvalidInput, PhysicsError, count_of, need
from ethbrake_marl.first_edition.agents.driving import episode_engine
from ethbrake_marl.first_edition.agents.protocol import Driver, Team
from ethbrake_marl.first_edition.envs.rendering import Frame, Scene
from ethbrake_marl.first_edition.envs.trace import Trace
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario

Films = Mapping[str, Sequence[Scene]]  # scenes of each film of one world, by title

FILM_FPS = 25  # scenes per second; a divisor of 100, because a GIF stores times in hundredths of a second

MOST_PICTURES = 2_500  # largest number of pictures of all films together; they need 1.8 GB of memory

_COLOURS = 64

_ROAD = 160  # height in pixels of title, gaps and road, the upper part of a scene's picture


def film_scenes(world: Worlds, agent: Driver, *, scenario: Scenario) -> list[Scene]:
    """Simulate one episode, and return its scenes: 25 scenes per second from the alert on, and the final scene.

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
    times = np.append(np.arange(int(np.ceil(end * FILM_FPS - 1e-9))) / FILM_FPS, end)
    shown: list[Scene] = []
    for motion in trace.motions(engine):
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        mine = times[(times >= start if motion.fresh[0] else times > start) & (times <= until)]
        shown += motion.scenes(engine, 0, mine) if len(mine) else []
    return shown


def film(world: Worlds, agents: Mapping[str, Driver], ending: str, *, scenario: Scenario) -> bytes:
    """Let several agents drive the same world; return films of their episodes as the bytes of one file.

    The films play in real time, one below the other. A film that ends before the longest one shows its last scene
    until the end of the file. The keys of ``agents`` are the titles above their films. ``ending`` is the ending of the
    file name: ``.gif`` or ``.mp4`` for a film, ``.png`` for three moments of it: the alert, the hardest impact under
    any of the agents, and the end. Raises the exceptions of ``film_scenes`` and ``check_film``, and ``InvalidInput`` if
    the films have more than ``MOST_PICTURES`` pictures.
    """
    check_film(ending)
    films = {title: film_scenes(world, agent, scenario=scenario) for title, agent in agents.items()}
    pictures = len(films) * max(map(len, films.values()))
    if pictures > MOST_PICTURES:
        raise InvalidInput(
            f"film of {len(films)} agents: needs {pictures:,} pictures, but at most {MOST_PICTURES:,} are allowed; give"
            " fewer agents, or a scenario with a shorter horizon_s"
        )
    return _WRITERS[ending](films)


def check_film(ending: str) -> None:
    """Raise ``InvalidInput`` if ``film`` cannot write a file with this ``ending``.

    Raises ``MissingExtra`` for an MP4 file if the library imageio-ffmpeg is not installed.
    """
    if ending not in _WRITERS:
        raise InvalidInput(f"film with the file ending {ending!r}: the ending must be one of {', '.join(_WRITERS)}")
    if ending == ".mp4":
        need("imageio_ffmpeg")


def _stacked(films: Films) -> Iterator[Frame]:
    """Yield the pictures of a GIF or MP4 file in order: the scenes of all films at one time, one below the other."""
    for k in range(max(map(len, films.values()))):
        each = (shown[min(k, len(shown) - 1)]._replace(title=title) for title, shown in films.items())
        yield np.concatenate([scene.frame() for scene in each])


def _write_gif(films: Films) -> bytes:
    from PIL import Image

    pictures = [
        Image.fromarray(frame).quantize(_COLOURS, method=Image.Quantize.FASTOCTREE) for frame in _stacked(films)
    ]
    buffer = io.BytesIO()
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:], duration=1000 // FILM_FPS, loop=0)
    return buffer.getvalue()


def _write_mp4(films: Films) -> bytes:
    from imageio_ffmpeg import write_frames

    frames = list(_stacked(films))
    height, width, _ = frames[0].shape
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = write_frames(str(path), (width, height), fps=FILM_FPS, quality=8)
        writer.send(None)
        for frame in frames:
            writer.send(frame)
        writer.close()
        return path.read_bytes()


def _write_png(films: Films) -> bytes:
    from PIL import Image

    last = max(map(len, films.values())) - 1
    impacts = [
        (hit.closing_mps, -k) for shown in films.values() for k, scene in enumerate(shown) for hit in scene.struck
    ]
    hardest = -max(impacts, default=(0.0, 0))[1]  # number of the first scene that shows the hardest impact
    rows = []
    for title, shown in films.items():
        for scene in (shown[min(k, len(shown) - 1)] for k in sorted({0, hardest, last})):
            told = f"{title}, harm {scene.total_harm:.1f} m2/s2"
            rows.append(scene._replace(title=told).frame()[:_ROAD])
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(rows)).quantize(_COLOURS).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


_WRITERS: dict[str, Callable[[Films], bytes]] = {".gif": _write_gif, ".mp4": _write_mp4, ".png": _write_png}
