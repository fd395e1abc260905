"""The motion of an engine's worlds, kept while they run, so that any moment of it can be shown exactly.

Between decisions the motion follows from the state and the command alone: each moment is advanced from the beginning
of its step. A ``Trace`` looks on at the engine; without one nothing is kept and nothing costs time.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.rendering import (
    AHEAD_M,
    BEHIND_M,
    BODY_M,
    FLASH_S,
    HEIGHT,
    LATE_S,
    LEAST_WIDTH_M,
    WIDTH,
    Frame,
    Scene,
    Struck,
    View,
    follow,
)
from ethbrake_marl.errors import InvalidInput, check_whole_number, need
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.left_out import ImpactRows
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds


@dataclass(frozen=True, slots=True)
class Motion:
    """One step of every world, or the way from its alert to its first decision."""

    start: Worlds  # [n]
    command_mps2: Floats  # [n, N] where ``fresh``: what is in force when it ends
    until_s: Floats  # [n] NaN: it ends where the engine is
    fresh: Bools  # [n] from the alert on
    front_m: Floats  # [n] place of Vehicle 1 at the start, from that at the alert
    harm: Floats  # [n, 2] at the start, by first impacts and in total (m2/s2)
    left_m: Floats  # [n] the view of the episode
    right_m: Floats  # [n]
    struck: Floats  # [k, 4] impacts shortly before the start: world, pair, time, closing speed
    stepped_in: Bools | None  # [n] by a shield; None: there is none
    parts: tuple[tuple[Worlds, Floats, Floats], ...] = ()  # once it is closed: ``Engine.segments``

    def closed(self, engine: Engine) -> Motion:
        """The motion that has led to where the engine is."""
        worlds = engine.worlds
        command = np.where(self.fresh[:, np.newaxis], worlds.command_mps2, self.command_mps2)
        parts = tuple(engine.segments(self.start, command))
        return replace(self, command_mps2=command, until_s=worlds.time_s, parts=parts)

    def scenes(self, engine: Engine, row: int, times_s: Floats | None = None) -> list[Scene]:
        """What world ``row`` shows at these times of a closed motion [k], or at its end alone."""
        times = self.until_s[[row]] if times_s is None else times_s
        alert_view = View(float(self.left_m[row]), float(self.right_m[row]))
        obstacle = self.start.obstacle_gap_m[row] + self.front_m[row]
        front_m, harm = self.front_m[row], self.harm[row]
        struck = [Struck(int(m[1]), float(m[3]), float(m[2])) for m in self.struck if m[0] == row]
        shown: list[Scene] = []
        for part in self.parts:
            world, command, until = part[0].take([row]), part[1][[row]], part[2][[row]]
            now = times if part is self.parts[-1] else times[times <= until]
            times = times[len(now) :]
            post = world.with_post_ahead(until - world.time_s).take(np.zeros(len(now) + 1, np.int64))
            moved, _ = advance(post, command, until_s=np.append(now, until))
            impacts = _rows(world, command, until)
            first = (front_m + (post.obstacle_gap_m - moved.obstacle_gap_m))[:, np.newaxis]
            fronts = np.concatenate([first, first - np.cumsum(moved.gaps_m + BODY_M, axis=1)], axis=1)
            told = zip(impacts.pair.tolist(), impacts.closing_speed_mps.tolist(), impacts.time_s.tolist(), strict=True)
            struck += [Struck(*each) for each in told]
            by_then = impacts.time_s <= np.append(now, until)[:, np.newaxis]
            each_harm = impacts.closing_speed_mps * impacts.closing_speed_mps
            counted = [(by_then * (each_harm * impacts.first)).sum(axis=1), (by_then * each_harm).sum(axis=1)]
            latency, done = world.vehicles.latency_s[0], harm + np.stack(counted, axis=1)
            shown += [
                Scene(
                    title=engine.scenario.name,
                    time_s=float(time),
                    view=follow(alert_view, fronts[k]),
                    front_m=fronts[k],
                    gaps_m=moved.gaps_m[k],
                    speeds_mps=moved.speeds_mps[k],
                    command_mps2=moved.command_mps2[k],
                    braking_mps2=world.vehicles.braking_capacity_mps2[0],
                    driving_mps2=world.vehicles.driving_capacity_mps2[0],
                    latency_s=latency,
                    hit=moved.pair_hit[k],
                    struck=tuple(s for s in struck if time - FLASH_S < s.time_s <= time),
                    first_harm=float(done[k, 0]),
                    total_harm=float(done[k, 1]),
                    obstacle_m=float(obstacle),
                    learners=engine.learners or tuple(engine.deciders),
                    shield=None if self.stepped_in is None or self.fresh[row] else bool(self.stepped_in[row]),
                    ended=bool(engine.ended[row])
                    and time == float(engine.packed.state[row, engine.packed.column.time]),
                )
                for k, time in enumerate(now)
            ]
            front_m, harm = fronts[-1][0], done[-1]
        return shown


Memory = tuple[Motion, ...]  # the motions that are kept, the running one last


class Trace:
    """Follows the motion of an engine's worlds (an ``engine.Watcher``).

    Args:
        engine: to be followed from its next reset on.
        whole: keep every step since the episode began (one world); else the last one only.
        alert: the worlds with which the engine, still at its first decision, began: followed from there at once.

    """

    def __init__(self, engine: Engine, *, whole: bool = False, alert: Worlds | None = None) -> None:
        self._whole = whole
        engine.watch(self, () if alert is None else self.begun((), alert, np.arange(alert.n)))

    def begun(self, memory: Memory, alert: Worlds, rows: Ints) -> Memory:
        """Forget the worlds in these rows; they begin at their alert."""
        v, n = alert.vehicles, alert.n
        # The view holds each line from the alert to rest, if all brake fully as soon as they can; a vehicle behind that
        # stops later is taken to push the ones ahead so far.
        behind = np.concatenate([np.zeros((n, 1)), np.cumsum(alert.gaps_m, axis=1)], axis=1)
        reaction = alert.speeds_mps * np.minimum(v.latency_s, LATE_S)
        rising = (
            alert.speeds_mps * v.braking_capacity_mps2 / (2.0 * v.brake_rate_mps3)
        )  # at most, while brakes build up
        way = reaction + rising + alert.speeds_mps**2 / (2.0 * v.braking_capacity_mps2)
        left = -behind[:, -1] - alert.N * BODY_M - BEHIND_M
        right = np.minimum((way - behind).max(axis=1), alert.obstacle_gap_m) + AHEAD_M
        new = Motion(
            alert, np.zeros(alert.speeds_mps.shape), np.full(n, np.nan), np.ones(n, np.bool_), np.zeros(n),
            np.zeros((n, 2)), left, np.maximum(right, left + LEAST_WIDTH_M), np.zeros((0, 4)), None,
        )  # fmt: skip
        if not memory or n == memory[-1].start.n:
            return (new,)
        last = memory[-1]
        columns: dict[str, Any] = {}
        for name in ("command_mps2", "until_s", "fresh", "front_m", "harm", "left_m", "right_m"):
            columns[name] = getattr(last, name).copy()
            columns[name][rows] = getattr(new, name)
        struck = last.struck[~np.isin(last.struck[:, 0], rows)]
        return (replace(last, start=last.start.assign(rows, alert), struck=struck, **columns),)

    def stepped(self, memory: Memory, before: Engine, after: Engine) -> Memory:
        """Close the motion that led to this step, and begin the step's own."""
        last = memory[-1].closed(before)
        front_m, met = last.front_m, [last.struck]
        for start, command, until_s in last.parts:
            post = start.with_post_ahead(until_s - start.time_s)
            moved, _ = advance(post, command, until_s=until_s)
            front_m = front_m + (post.obstacle_gap_m - moved.obstacle_gap_m)
            rows = _rows(start, command, until_s)
            columns = (rows.world, rows.pair, rows.time_s, rows.closing_speed_mps)
            met.append(np.stack(columns, axis=1).astype(np.float64))
        struck, ledger, n = np.concatenate(met), before.ledger, before.n
        new = replace(
            last,
            start=before.worlds,
            command_mps2=after.wanted_mps2.copy(),
            until_s=np.full(n, np.nan),
            fresh=np.zeros(n, np.bool_),
            front_m=front_m,
            harm=np.stack([ledger.world_harm("first"), ledger.world_harm("total")], axis=1),
            struck=struck[struck[:, 2] > last.until_s[struck[:, 0].astype(np.int64)] - FLASH_S],
            stepped_in=None if after.ruling is None else after.ruling.stepped_in,
        )
        return (*memory[:-1], last, new) if self._whole else (new,)

    def motions(self, engine: Engine) -> Memory:
        """The motions that are kept, all ended. Raises ``InvalidInput`` before the first reset."""
        memory: Memory = engine.memory(self)
        if not memory:
            raise InvalidInput("render: no episode was started; call reset first")
        return (*memory[:-1], memory[-1].closed(engine))


def _rows(worlds: Worlds, command: Floats, until_s: Floats) -> ImpactRows:
    rows = advance(worlds, command, until_s=until_s, record=True)[1].rows
    assert rows is not None  # they were asked for
    return rows


# ``render()`` of every interface: modes, frames since the last call, and the window.


class Window:
    """The window of ``render_mode="human"``; it opens with its first frame, and stays closed once its user closes it.

    A copy is a window of its own. Raises ``MissingExtra`` where its library is missing.
    """

    def __init__(self) -> None:
        need("pygame")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # importing a library says nothing
        import pygame

        self._pygame: Any = pygame
        self._screen: Any = None
        self._clock: Any = None
        self.closed_by_user = False  # until an episode begins

    def __reduce__(self) -> tuple[type[Window], tuple[()]]:
        return Window, ()

    def show(self, frame: Frame, fps: float) -> None:
        """Show a frame [H, W, 3] for 1/fps seconds. Raises ``InvalidInput`` where there is no display."""
        if self.closed_by_user:
            return
        pygame = self._pygame
        if self._screen is None:
            try:
                pygame.display.init()
                self._screen = pygame.display.set_mode((WIDTH, HEIGHT))
            except pygame.error as error:
                raise InvalidInput(
                    f"render_mode = 'human': no window can be opened here ({error}); 'rgb_array' needs no display"
                ) from None
            pygame.display.set_caption("EthBrake")
            self._clock = pygame.time.Clock()
        self._screen.blit(pygame.image.frombuffer(frame.tobytes(), (WIDTH, HEIGHT), "RGB"), (0, 0))
        pygame.display.flip()
        self._clock.tick(fps)
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            self.closed_by_user = True

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = self._clock = None


SMOOTH_FPS = 50  # frames per second of the window, and of ``step_frames``


class Viewer:
    """Shows the running episodes of an engine; the window is imported when it is first asked for.

    Args:
        engine: what is shown, from its next reset on.
        mode: one of the interface's modes, or None: nothing is kept, and nothing can be shown.
        batch: the interface has many worlds at once, and shows each.

    Raises ``InvalidInput`` for another mode, and for ``human`` where its library is missing.

    """

    METADATA: ClassVar[dict[str, Any]] = {  # of a class; each environment has its own fps
        "render_modes": ["human", "rgb_array", "rgb_array_list", "ansi"],
        "render_fps": 10,
    }

    def __init__(self, engine: Engine, mode: str | None, *, batch: bool = False) -> None:
        self.modes: list[str] = ["rgb_array", "ansi"] if batch else self.METADATA["render_modes"]
        if mode is not None and mode not in self.modes:
            known = ", ".join(map(repr, self.modes))
            raise InvalidInput(f"render_mode = {mode!r}: must be {known}, or None")
        self.mode = mode
        self._engine, self._batch = engine, batch
        self._window = Window() if mode == "human" else None
        self._trace = None if mode is None else Trace(engine, whole=mode == "rgb_array_list")
        self._shown = 0  # motions of the running episode that a list of frames has shown

    @property
    def metadata(self) -> dict[str, Any]:
        """``render_modes``, and the ``render_fps`` at which one frame per step plays in real time."""
        fps = 1.0 / self._engine.scenario.time_step_s
        return {"render_modes": list(self.modes), "render_fps": round(fps) if abs(fps - round(fps)) < 1e-9 else fps}

    def began(self) -> None:
        """An episode has begun: the list of frames starts anew, and the window shows the way to the first decision."""
        self._shown = 0
        if self._window is not None:
            self._window.closed_by_user = False
            self.play()

    def play(self) -> None:
        """Show what the last step brought in the window, in real time; nothing in other modes."""
        if self._window is not None:
            for frame in self.step_frames():
                self._window.show(frame, SMOOTH_FPS)

    def render(self) -> Any:
        """What the mode says of the world, or of each of a batch; None for ``human``, where every step shows itself."""
        motions = self._motions(f"render: made with render_mode=None; give one of {', '.join(self.modes)}")
        if self.mode == "human":
            return None
        if self.mode == "rgb_array_list":  # one frame for the beginning and each step that no list has shown yet
            new, self._shown = motions[self._shown :], len(motions)
            return [motion.scenes(self._engine, 0)[-1].frame() for motion in new]
        scenes = [motions[-1].scenes(self._engine, k)[-1] for k in range(self._engine.n)]
        shown = tuple(scene.text() if self.mode == "ansi" else scene.frame() for scene in scenes)
        return shown if self._batch else shown[0]

    def step_frames(self, fps: float = SMOOTH_FPS) -> list[Frame]:
        """The frames [H, W, 3] between the last decision, or the alert, and now: ``fps`` in a second of the world.

        Raises ``InvalidInput`` before the first reset, with render_mode=None, and for an ``fps`` below 1.
        """
        check_whole_number("step_frames: fps", fps, 1)
        motion = self._motions("step_frames: made with render_mode=None; give 'rgb_array'")[-1]
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        times: Floats = np.linspace(start, until, max(round((until - start) * fps), 1) + 1)[1:]  # the last is its end
        return [scene.frame() for scene in motion.scenes(self._engine, 0, times)]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _motions(self, refusal: str) -> Memory:
        if self._trace is None:
            raise InvalidInput(f"{refusal} when it is made")
        return self._trace.motions(self._engine)
