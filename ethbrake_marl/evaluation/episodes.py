"""Whole episodes, exact at every moment; films of them, and passports that name one so that it can be played again."""

from __future__ import annotations

import copy
import hashlib
import io
import math
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote

import numpy as np

from ethbrake_marl.agents.protocol import Agent, Driver, Team, team_of
from ethbrake_marl.agents.registry import parse_spec
from ethbrake_marl.agents.rollout import Episodes, drive, episode_engine, play
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.drawing.scene import Scene, Trace, animate_films, kept_motions, scenes
from ethbrake_marl.errors import InvalidInput, PhysicsError, UnknownName, count_of, need, plain_text
from ethbrake_marl.evaluation.inputs import (
    choose_worlds,
    content_sha256,
    load_runnable,
    make_lineup,
    policy_sha256,
    scenario_sha256,
    worlds_sha256,
)
from ethbrake_marl.evaluation.measures import Tape
from ethbrake_marl.evaluation.rollout import controlled_vehicle
from ethbrake_marl.files.yaml import Override
from ethbrake_marl.harm import Ledger
from ethbrake_marl.physics import Floats, ImpactRows, Worlds, advance
from ethbrake_marl.physics.kernel import first_decision_s, segment_pieces, with_post_ahead
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.shield.uncertainty import Uncertainty

if TYPE_CHECKING:
    from ethbrake_marl.envs.drawing.frame import Frame


_SAME = 1e-9  # m, m/s: a piece that goes on like the one before it is part of it
_SHORT_S = 1e-4  # pieces of a cascade of tiny bounces may be shorter; they are not told apart


@dataclass(frozen=True, slots=True)
class EpisodeMotion:
    """One world from the alert to the end of its episode, driven by one agent."""

    world: Worlds  # n = 1, at the alert
    pieces: Floats  # [k, 1 + N + 2 N] time (s), place of Vehicle 1 (m), gaps, speeds, accelerations where each begins
    end_s: float
    impacts: ImpactRows  # in order of time; world is 0
    stepped_in_s: Floats  # beginnings of the decisions in which a shield replaced what was proposed
    ledger: Ledger  # n = 1
    final: Worlds  # n = 1, as the episode left it
    at_rest: bool  # the line came to rest; else the horizon cut the episode off

    @property
    def harm(self) -> tuple[float, float]:
        """Harm of the line, by first impacts and in total (m2/s2)."""
        first, total = (float(self.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        return first, total


def follow_episodes(worlds: Worlds, agent: Driver, scenario: Scenario) -> list[EpisodeMotion]:
    """Let an agent drive the scenario's learners through every world, as ``evaluate`` does, and keep every motion.

    Args:
        worlds: at the alert.
        agent: drives each learner, or, as a team, its vehicles; it is left as it is.
        scenario: of the worlds; its scripts drive the other vehicles.

    Raises ``PhysicsError`` naming the worlds that could not be advanced.

    """
    team = team_of(agent, scenario.learners)
    engine = episode_engine(worlds, team, scenario)
    follower = _Follower(worlds, team, engine)
    episodes = play(engine, worlds, [follower])
    return follower.motions(episodes)


class _Follower(Tape):
    """Keeps the steps, and in which decisions a shield stepped in."""

    def __init__(self, worlds: Worlds, team: Team, engine: Engine) -> None:
        super().__init__(worlds)
        self._drivers = list(team.drivers.values())
        self._first_s = first_decision_s(worlds, list(team.drivers))
        self._stepped_in: list[list[float]] = [[] for _ in range(worlds.n)]
        self._engine, self._ruling = engine, engine.ruling

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        super().see(before, command_mps2, until_s)
        ruling = self._engine.ruling
        if ruling is not None and ruling is not self._ruling:  # a step is shown in parts
            for k in np.flatnonzero(ruling.stepped_in & ruling.asked).tolist():
                self._stepped_in[k].append(float(before.time_s[k]))
            self._ruling = ruling

    def motions(self, episodes: Episodes) -> list[EpisodeMotion]:
        """What was seen, world by world."""
        n, N = self.worlds.n, self.worlds.N
        impacts, pieces = self.impacts(), self._pieces()
        ends = np.searchsorted(impacts.world, np.arange(n + 1))
        found = []
        for k in range(n):
            mine = slice(*ends[k : k + 2])
            rows = ImpactRows(*(getattr(impacts, f.name)[mine] for f in fields(ImpactRows)))
            ledger = Ledger(*(getattr(episodes.ledger, f.name)[[k]] for f in fields(Ledger)))
            final, taken_over = episodes.final.take([k]), list(self._stepped_in[k])
            if any(isinstance(d, HybridAgent) and not d.chosen_policy[k] for d in self._drivers):
                taken_over.append(float(self._first_s[k]))
            found.append(
                EpisodeMotion(
                    self.worlds.take([k]),
                    join_pieces(pieces[k], N),
                    float(final.time_s[0]),
                    replace(rows, world=np.zeros_like(rows.world)),
                    np.array(sorted(taken_over)),
                    ledger,
                    final,
                    bool(episodes.at_rest[k]),
                )
            )
        return found

    def _pieces(self) -> list[Floats]:
        """The pieces of each world's motion, one after the other; one piece where it ends at once."""
        parts: list[list[Floats]] = [[] for _ in range(self.worlds.n)]
        way_m = np.zeros(self.worlds.n)
        for before, command, until_s in self.steps:
            some = np.flatnonzero(until_s > before.time_s)
            seen = segment_pieces(before.take(some), command[some], until_s[some])
            for k, pieces in zip(some.tolist(), seen, strict=True):
                way = float(state_at(pieces[-1], float(until_s[k]), self.worlds.N)[0])
                pieces[:, 1] += way_m[k]
                parts[k].append(pieces)
                way_m[k] += way
        w = self.worlds
        standing = np.concatenate(
            [w.time_s[:, np.newaxis], np.zeros((w.n, 1)), w.gaps_m, w.speeds_mps, 0.0 * w.speeds_mps], axis=1
        )
        return [np.concatenate(each) if each else standing[[k]] for k, each in enumerate(parts)]


def join_pieces(pieces: Floats, vehicles: int) -> Floats:
    """The pieces without those that go on like the one before; of many within ``_SHORT_S`` the last one stays."""
    last_of_many = np.append(np.diff(np.floor(pieces[:, 0] / _SHORT_S)) > 0.0, True)
    last_of_many[0] = True
    kept: list[Floats] = []
    for row in pieces[last_of_many]:
        if not kept or not (np.abs(state_at(kept[-1], row[0], vehicles) - row[1:]) <= _SAME).all():
            kept.append(row)
    return np.array(kept)


def state_at(piece: Floats, time_s: float, vehicles: int) -> Floats:
    """Place of Vehicle 1, gaps, speeds and accelerations [3 N] at a time of a piece [1 + 3 N]."""
    t, N = time_s - piece[0], vehicles
    speeds, accelerations = piece[1 + N : 1 + 2 * N], piece[1 + 2 * N :]
    way = (speeds + 0.5 * accelerations * t) * t
    gaps = piece[2 : 1 + N] + way[:-1] - way[1:]
    return np.concatenate([[piece[1] + way[0]], gaps, speeds + accelerations * t, accelerations])


# One episode at fine time resolution: what a figure or a viewer draws.
#
# Between decisions the motion follows from the state and the command alone, so the episode is first run as in an
# evaluation, and then sampled inside its steps: every sample is advanced straight from the beginning of its step.

SAMPLE_S = 0.02


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """One world from the alert to its end, at k times; row 0 is the alert.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> world = scenario.sample(1, seed=7).worlds
    >>> record = eb.record_episode(world, eb.make_agent("full_brake"), scenario=scenario)
    >>> record.positions_m.shape, record.impacts.time_s.round(2), record.at_rest
    ((196, 3), array([2.17, 3.3 ]), True)

    """

    agent: str  # its name
    scenario: Scenario  # of the world
    vehicle: int  # index (0 = front) of the vehicle that the agent drove
    initial: Worlds  # n = 1, at the alert
    time_s: Floats  # [k] since Vehicle 1 began to brake, ascending
    gaps_m: Floats  # [k, P]
    speeds_mps: Floats  # [k, N]
    positions_m: Floats  # [k, N] front bumpers along the road; a vehicle's length is not counted
    command_mps2: Floats  # [k, N] signed acceleration asked for from then on; 0 before the latency has elapsed
    impacts: ImpactRows  # in order of time; world is 0
    ledger: Ledger  # n = 1
    at_rest: bool  # the line came to rest; else the horizon cut the episode off

    def __repr__(self) -> str:
        first, total = (float(self.ledger.world_harm(harm_count)[0]) for harm_count in HARM_COUNTS)
        return (
            f"EpisodeRecord({self.agent!r:.60} on {self.scenario.name!r}, {len(self.time_s)} samples to"
            f" {self.time_s[-1]:g} s, {count_of(len(self.impacts.time_s), 'impact')}, harm {first:.2f} first-impact,"
            f" {total:.2f} total)"
        )


def record_episode(
    world: Worlds, agent: Agent, *, scenario: Scenario, vehicle: int | str | None = None, sample_s: float = SAMPLE_S
) -> EpisodeRecord:
    """Record one world from the alert on, exactly as ``evaluate`` runs it.

    Args:
        world: at the alert, n = 1.
        agent: drives one vehicle; it is left as it is.
        scenario: of the world; its scripts drive the other vehicles.
        vehicle: the one that is driven, by name (``vehicle_2``) or index (0 = front); None: the scenario's only
            learner.
        sample_s: samples lie at most so far apart (s), and at every decision.

    Raises ``InvalidInput`` for more than one world or ``sample_s`` not above 0.

    """
    if world.n != 1:
        raise InvalidInput(
            f"record_episode: {count_of(world.n, 'world')} given; exactly 1 is needed, for instance worlds.take([0])"
        )
    if not (sample_s > 0.0 and math.isfinite(sample_s)):
        raise InvalidInput(f"record_episode: sample_s = {sample_s}; must be finite and above 0")
    driven = controlled_vehicle(scenario, vehicle)
    tape = Tape(world)
    episodes = drive(world, copy.deepcopy(agent), scenario, driven, watched_by=[tape])
    samples = list(_samples(tape.steps, sample_s))
    time, gaps, speeds, positions, command = (np.concatenate(column) for column in zip(*samples, strict=True))
    return EpisodeRecord(
        agent.name, scenario, driven, world, time, gaps, speeds, positions, command, tape.impacts(), episodes.ledger,
        bool(episodes.at_rest[0]),
    )  # fmt: skip


def _samples(segments: Sequence[tuple[Worlds, Floats, Floats]], sample_s: float) -> Iterator[tuple[Floats, ...]]:
    """Rows of (time, gaps, speeds, positions, command from then on), segment by segment, the last with its end.

    Worlds know gaps and speeds only. An obstacle ahead of Vehicle 1, the world's own or one that is out of reach, makes
    its position one more gap.
    """
    front = 0.0  # position of Vehicle 1 at the start of the segment
    for number, (before, command, until_s) in enumerate(segments):
        start, end = float(before.time_s[0]), float(until_s[0])
        count = max(math.ceil((end - start) / sample_s - 1e-9), 1) if end > start else 0
        times = np.linspace(start, end, count + 1)
        post = with_post_ahead(before, np.array([end - start]))
        copies = post.take(np.zeros(count + 1, np.int64))
        moved, _ = advance(copies, command, until_s=times)
        position, gaps, speeds = front + (post.obstacle_gap_m - moved.obstacle_gap_m), moved.gaps_m, moved.speeds_mps
        in_force = np.where(before.vehicles.latency_s <= times[:, np.newaxis], command, 0.0)
        rows = slice(None) if number == len(segments) - 1 else slice(count)
        columns = (times, gaps, speeds, line_positions(position, gaps), in_force)
        yield tuple(column[rows] for column in columns)
        front = float(position[-1])


def line_positions(front: Floats, gaps: Floats) -> Floats:
    """Positions [k, N] from those of Vehicle 1 [k] and the gaps [k, P]."""
    return np.concatenate([front[:, np.newaxis], front[:, np.newaxis] - np.cumsum(gaps, axis=1)], axis=1)


# An episode as a film, in real time: the environment's own pictures as a GIF or MP4, or a moving drawing as SVG.

Films = Mapping[str, Sequence[Scene]]  # of one world, by title

FILM_FPS = 25
MOST_FILMS = 12  # one below the other
MOST_PICTURES = 2_500  # of all films together: 1.8 GB in memory
_COLOURS = 64


def film_scenes(world: Worlds, agent: Driver, *, scenario: Scenario, fps: float = FILM_FPS) -> list[Scene]:
    """What one world shows from the alert to the end of its episode, ``fps`` moments per second, then its end.

    Args:
        world: at the alert, n = 1.
        agent: drives the learner, or, as a team, its vehicles; it is left as it is.
        scenario: of the world; its scripts drive the other vehicles.
        fps: moments per second of the world.

    Raises ``InvalidInput`` for more than one world, ``PhysicsError`` for one that could not be advanced.

    """
    if world.n != 1:
        raise InvalidInput(f"film_scenes: {count_of(world.n, 'world')} given; exactly 1 is needed: worlds.take([0])")
    engine = episode_engine(world, team_of(agent, scenario.learners), scenario)
    trace = Trace(engine, whole=True, alert=world)
    while not engine.ended.all():
        engine.step({})
    if engine.roster.failed:
        raise PhysicsError(engine.roster.failed)
    end = float(engine.worlds.time_s[0])
    times = np.append(np.arange(int(np.ceil(end * fps - 1e-9))) / fps, end)
    shown: list[Scene] = []
    for motion in kept_motions(engine, trace):
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        mine = times[(times >= start if motion.fresh[0] else times > start) & (times <= until)]
        shown += scenes(engine, motion, 0, mine) if len(mine) else []
    return shown


def film_bytes(films: Films, ending: str, *, fps: int = FILM_FPS) -> bytes:
    """Films of one world, titled and one below the other, in real time: an endless GIF or SVG, or an MP4.

    A film that ends before the others shows its end. Raises ``InvalidInput`` without films, for more than
    ``MOST_FILMS`` or ``MOST_PICTURES``, for an ``ending`` that is
    none of ``.gif``, ``.mp4`` and ``.svg``, for an ``fps`` whose frames do not last whole hundredths of a second, as a
    GIF needs, and for an MP4 where the library that writes it is missing.
    """
    check_ending(ending)
    if not films or not all(films.values()):
        raise InvalidInput("film_bytes: no films given")
    if not fps > 0 or 100 % fps:
        raise InvalidInput(f"film_bytes: fps = {fps}: must divide 100, for instance 10, 20, 25 or 50")
    check_number_of_films(len(films))
    pictures = len(films) * max(map(len, films.values()))
    if pictures > MOST_PICTURES:
        raise InvalidInput(
            f"film of {len(films)} agents for {pictures // len(films) / fps:g} s: needs {pictures:,} pictures,"
            f" and at most {MOST_PICTURES:,} are kept; give fewer agents, or a scenario with a shorter horizon_s"
        )
    return _WRITERS[ending](films, fps)


def check_number_of_films(films: int) -> None:
    """Refuse more than ``MOST_FILMS`` with ``InvalidInput``."""
    if films > MOST_FILMS:
        raise InvalidInput(f"film: {films} agents, one below the other; at most {MOST_FILMS} are shown")


def check_ending(ending: str) -> None:
    """Refuse, before any work, a film that cannot be written; raises as ``film_bytes``."""
    if ending not in _WRITERS:
        raise InvalidInput(f"a film that ends in {ending!r}: films are written as {', '.join(_WRITERS)}")
    if ending == ".mp4":
        need("imageio_ffmpeg")


def _stacked(films: Films) -> Iterator[Frame]:
    """The frames of all films, one below the other."""
    from ethbrake_marl.envs.drawing.frame import draw_frame

    for k in range(max(map(len, films.values()))):
        each = (shown[min(k, len(shown) - 1)]._replace(title=title) for title, shown in films.items())
        yield np.concatenate([draw_frame(scene) for scene in each])


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


def _write_svg(films: Films, fps: int) -> bytes:
    return animate_films(films, fps=fps).encode()


_WRITERS = {".gif": _write_gif, ".mp4": _write_mp4, ".svg": _write_svg}


# Passports: one short string that names an episode, so that it can be played again and compared to the bit.
#
# ``EB1:SCENARIO:HASH:SEED.WORLD:COUNT:VERSIONS:WORLD-HASH:EPISODE-HASH:POLICY-HASH:AGENT:CHECK``, of letters, digits
# and ``:.,-_@+/=%``, which no shell touches. Hashes are the beginnings of those in results files; the last part tells a
# typo from a difference.

MOST_CHARACTERS = 160
LEFT_OUT = "..."  # in the place of what would make a passport too long
_MARK, _KIND = "EB", "1"
_NAME = 30  # characters of a scenario's name
_NONE = "-"
_SCENARIO, _WORLD, _EPISODE, _POLICY, _CHECK = 10, 6, 10, 8, 6  # hexadecimal digits of each hash
_PACKAGES = ("ethbrake-marl", "numba", "numpy")  # and Python, second
_SHAPE = re.compile(
    r"EB1:(?P<scenario>[\w.-]+):(?P<scenario_sha>[0-9a-f]{10}):(?P<seed>\d{1,20}|-)\.(?P<number>\d{1,18})"
    r":(?P<count>[ft])(?P<vehicles>[\d.]+|-):(?P<versions>[\w.,+-]+):(?P<world_sha>[0-9a-f]{6})"
    r":(?P<episode_sha>[0-9a-f]{10}):(?P<policy_sha>[0-9a-f]{8}|-):(?P<agent>[\w%:.,@+/=-]+)"
)


@dataclass(frozen=True, slots=True)
class Passport:
    """What names an episode."""

    scenario: str  # its name
    scenario_sha: str
    seed: int | None  # of the list; None: the world came from a file
    number: int  # of the world in its list
    harm_count: HarmCount  # that agents minimised
    vehicles: tuple[int, ...]  # driven, from 0
    versions: tuple[str, ...]  # of the package, Python, numba and numpy
    world_sha: str
    episode_sha: str  # of the ledger and of what the episode left
    policy_sha: str | None
    agent: str  # as it is written; LEFT_OUT stands for what did not fit

    def __str__(self) -> str:
        name = self.scenario if len(self.scenario) <= _NAME else self.scenario[:_NAME] + LEFT_OUT
        for agent in _shorter(self.agent):
            text = replace(self, agent=agent)._written(name)
            if len(text) <= MOST_CHARACTERS:
                return text
        return replace(self, agent=LEFT_OUT)._written(name[:20] + LEFT_OUT)

    def _written(self, scenario: str) -> str:
        parts = (
            _MARK + _KIND,
            scenario,
            self.scenario_sha,
            f"{_NONE if self.seed is None else self.seed}.{self.number}",
            self.harm_count[0] + (".".join(str(i + 1) for i in self.vehicles) or _NONE),
            ",".join(self.versions),
            self.world_sha,
            self.episode_sha,
            self.policy_sha or _NONE,
            quote(self.agent, safe="@+:,./=-_", errors="replace").replace("~", "%7E"),
        )
        text = ":".join(parts)
        return f"{text}:{_check(text)}"

    def differences(self, other: Passport) -> list[str]:
        """What another passport of the same world and agent says differently, in words; nothing if it is the same."""
        found = []
        if self.scenario_sha != other.scenario_sha:
            found.append(
                f"the scenario: its values have the hash {other.scenario_sha}, in the passport {self.scenario_sha}; it"
                " was edited since, or other settings (--set) were given"
            )
        found += [
            f"{name}: {now} here, {then} in the passport"
            for name, then, now in zip(
                ("ethbrake-marl", "Python", "numba", "numpy"), self.versions, other.versions, strict=True
            )
            if then != now
        ]
        if self.world_sha != other.world_sha:
            found.append(f"the world at the alert: {other.world_sha} here, {self.world_sha} in the passport")
        if self.policy_sha != other.policy_sha:
            found.append(f"the policy: {other.policy_sha or 'none'} here, {self.policy_sha or 'none'} in the passport")
        if self.episode_sha != other.episode_sha:
            found.append(f"the episode: {other.episode_sha} here, {self.episode_sha} in the passport")
        return found

    def is_same_episode(self, other: Passport) -> bool:
        """Whether world and episode are the same to the bit."""
        return (self.world_sha, self.episode_sha) == (other.world_sha, other.episode_sha)


def issue_passport(
    motion: EpisodeMotion,
    scenario: Scenario,
    agent: str,
    *,
    seed: int | None,
    number: int,
    harm_count: HarmCount = "first",
    policies: Mapping[int, str] | None = None,
) -> Passport:
    """The passport of an episode that was driven.

    Args:
        motion: the episode.
        scenario: as it was driven, with its learners.
        agent: as it is written.
        seed: of the list of worlds; None: they came from a file.
        number: of the world in its list.
        harm_count: that agents minimise.
        policies: SHA-256 of the policy that drives a vehicle, by vehicle, where one does.

    """
    shas = list((policies or {}).values())
    joined = shas[0] if len(shas) == 1 else hashlib.sha256("".join(shas).encode()).hexdigest()
    return Passport(
        scenario=scenario.name,
        scenario_sha=scenario_sha256(scenario)[:_SCENARIO],
        seed=seed,
        number=number,
        harm_count=harm_count,
        vehicles=scenario.learners,
        versions=_versions(),
        world_sha=worlds_sha256(motion.world, np.array([number], np.int64))[:_WORLD],
        episode_sha=content_sha256(motion.ledger, motion.final, motion.impacts)[:_EPISODE],
        policy_sha=joined[:_POLICY] if shas else None,
        agent=agent,
    )


def parse_passport(text: str) -> Passport:
    """The passport that a text is; raises ``InvalidInput`` that tells a typo from another kind of text."""
    given = text.strip()
    shown = plain_text(given[:40])
    if not given.startswith(_MARK) or ":" not in given:
        raise InvalidInput(
            f"{shown!r}: is no passport; one begins with {_MARK}{_KIND}: and stands under each episode of a report"
        )
    if not given.startswith(f"{_MARK}{_KIND}:"):
        raise InvalidInput(
            f"{shown!r}: a passport of another kind; this version reads those that begin with {_MARK}{_KIND}:"
        )
    body, _, check = given.rpartition(":")
    found = _SHAPE.fullmatch(body)
    if check != _check(body) or found is None or len(given) > 2 * MOST_CHARACTERS:
        raise InvalidInput(
            f"{shown!r}...: a typo, or a part is missing: the check at the end does not fit; copy it whole"
        )
    part = found.groupdict()
    versions = tuple(part["versions"].split(","))
    if len(versions) != len(_PACKAGES) + 1:
        raise InvalidInput(f"{shown!r}...: names {count_of(len(versions), 'version')}; {len(_PACKAGES) + 1} are needed")
    return Passport(
        scenario=part["scenario"],
        scenario_sha=part["scenario_sha"],
        seed=None if part["seed"] == _NONE else int(part["seed"]),
        number=int(part["number"]),
        harm_count="first" if part["count"] == "f" else "total",
        vehicles=_vehicles(part["vehicles"], shown),
        versions=versions,
        world_sha=part["world_sha"],
        episode_sha=part["episode_sha"],
        policy_sha=None if part["policy_sha"] == _NONE else part["policy_sha"],
        agent=unquote(part["agent"], errors="strict"),
    )


def _vehicles(text: str, shown: str) -> tuple[int, ...]:
    if text == _NONE:
        return ()
    if not re.fullmatch(r"[1-9]\d?(\.[1-9]\d?)*", text):
        raise InvalidInput(f"{shown!r}...: vehicles {text!r}: must be numbers from 1, with dots between them")
    return tuple(int(each) - 1 for each in text.split("."))


def _shorter(agent: str) -> Sequence[str]:
    """How an agent may be written where there is little room: as it is, without its path, not at all."""
    before, at, _ = agent.partition("@")
    around = "" if not at else "".join(f"+{each}" for each in _around(agent))
    return (agent, *([f"{before}@{LEFT_OUT}{around}"] if at else []), LEFT_OUT)


def _around(agent: str) -> tuple[str, ...]:
    try:
        return parse_spec(agent).around
    except InvalidInput:  # the name of an agent that was made in Python
        return ()


@cache
def _versions() -> tuple[str, ...]:
    own, *others = (version(name) for name in _PACKAGES)
    return (own, platform.python_version(), *others)


def _check(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_CHECK]


# An episode that a passport names, played again: what must be given for it, and what differs.


@dataclass(frozen=True, slots=True)
class Given:
    """What a passport does not hold."""

    scenario: str | None = None  # a name or path; None: the shipped one of the passport's name
    settings: tuple[Override, ...] = ()  # of the scenario
    agent: str | None = None  # as it is written; None: as in the passport
    initial_states: Path | None = None  # the file that the world came from
    uncertainty: Uncertainty | None = None  # that ``+robust`` was certified against


@dataclass(frozen=True, slots=True)
class Replay:
    """An episode that was played again."""

    passport: Passport  # as the episode went now
    scenario: Scenario
    worlds: Worlds  # n = 1, at the alert
    agent: Driver
    motion: EpisodeMotion
    differences: tuple[str, ...]  # in words; none: everything is the same
    same: bool  # the world and the episode are, to the bit

    @property
    def title(self) -> str:
        """What it is, for a page or a film."""
        return f"{self.passport.agent}: world {self.passport.number} of {self.scenario.name}"


def replay(passport: Passport, given: Given) -> Replay:
    """Play the episode of a passport again, and compare it to the bit.

    Raises ``InvalidInput`` that says what is missing: the scenario's file, the agent or its policy, the worlds.
    """
    scenario = _scenario(passport, given)
    spelling = _spelling(passport, given.agent)
    world = _world(passport, scenario, given.initial_states)
    try:
        lineup = make_lineup([spelling], scenario, harm_count=passport.harm_count, uncertainty=given.uncertainty)
    except InvalidInput as error:
        hint = "" if given.agent else "; a policy or agent that lies elsewhere here is given by --agent"
        raise InvalidInput(f"passport: agent {spelling!r}: {error}{hint}") from None
    (agent,) = lineup.values()
    (motion,) = follow_episodes(world, agent, scenario)
    drivers = team_of(agent, scenario.learners).drivers
    policies = {i: sha for i, driver in drivers.items() if (sha := policy_sha256(driver)) is not None}
    now = issue_passport(
        motion, scenario, spelling, seed=passport.seed, number=passport.number, harm_count=passport.harm_count,
        policies=policies,
    )  # fmt: skip
    found = tuple(passport.differences(now))
    return Replay(now, scenario, world, agent, motion, found, passport.is_same_episode(now))


def _scenario(passport: Passport, given: Given) -> Scenario:
    try:
        scenario = load_runnable(given.scenario or passport.scenario, given.settings)
    except UnknownName:
        if given.scenario is not None:
            raise
        raise InvalidInput(
            f"passport: scenario {passport.scenario!r} does not ship; give its file: --scenario FILE.yaml"
        ) from None
    if scenario.learners == passport.vehicles:
        return scenario
    if not all(0 <= i < scenario.vehicles for i in passport.vehicles):
        most = max(passport.vehicles) + 1
        raise InvalidInput(
            f"passport: drives Vehicle {most}, but {scenario.name!r} has {count_of(scenario.vehicles, 'vehicle')}"
        )
    return scenario.with_learners(passport.vehicles)


def _spelling(passport: Passport, agent: str | None) -> str:
    """The agent, from the passport alone where that may say it: no passport names code to run."""
    if agent is not None:
        return agent
    if LEFT_OUT in passport.agent:
        raise InvalidInput(
            f"passport: the agent, {passport.agent}, did not fit into it; give it whole: --agent AGENT, for instance"
            " ppo@runs/my-run"
        )
    if parse_spec(passport.agent).file is not None:
        raise InvalidInput(
            f"passport: the agent, {passport.agent!r}, is code in a file, which is run only where you name it: --agent"
            f" {passport.agent}"
        )
    return passport.agent


def _world(passport: Passport, scenario: Scenario, initial_states: Path | None) -> Worlds:
    if passport.seed is not None:
        if initial_states is not None:
            raise InvalidInput("passport: its world is of a list that is drawn; leave --initial-states out")
        return scenario.sample(1, passport.seed, first=passport.number).worlds
    if initial_states is None:
        raise InvalidInput("passport: its world came from a file; give it: --initial-states FILE.csv")
    worlds = choose_worlds(scenario, initial_states=initial_states)[0].worlds
    if not passport.number < worlds.n:
        raise InvalidInput(
            f"{initial_states}: has {count_of(worlds.n, 'world')}; the passport is of number {passport.number}, from 0"
        )
    return worlds.take(np.array([passport.number]))
