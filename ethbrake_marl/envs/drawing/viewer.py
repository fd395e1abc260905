"""``render()`` of every interface: modes, frames since the last call, and the window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.drawing.scene import Scene, Trace, kept_motions, moments, scene_text, scenes
from ethbrake_marl.errors import InvalidInput, check_whole_number

if TYPE_CHECKING:
    from ethbrake_marl.envs.drawing.frame import Frame

MODES = ["human", "rgb_array", "rgb_array_list", "ansi"]
BATCH_MODES = ["rgb_array", "ansi"]  # of many worlds at once
CLASS_METADATA: dict[str, Any] = {"render_modes": MODES, "render_fps": 10}  # each environment has its own fps
SMOOTH_FPS = 50  # frames per second of the window, and of ``step_frames``


class Viewer:
    """Shows the running episodes of an engine; pictures and the window are imported when they are first asked for.

    Args:
        engine: what is shown, from its next reset on.
        mode: one of ``modes``, or None: nothing is kept, and nothing can be shown.
        modes: those that the interface has.

    Raises ``InvalidInput`` for another mode, and for ``human`` where its library is missing.

    """

    def __init__(self, engine: Engine, mode: str | None, modes: Sequence[str] = MODES) -> None:
        if mode is not None and mode not in modes:
            raise InvalidInput(f"render_mode = {mode!r}: must be {', '.join(repr(known) for known in modes)}, or None")
        self.mode = mode
        self._engine = engine
        self._window = None
        if mode == "human":
            from ethbrake_marl.envs.drawing.frame import Window

            self._window = Window()
        self._trace = None if mode is None else Trace(engine, whole=mode == "rgb_array_list")
        self._shown = 0  # motions of the running episode that a list of frames has shown

    def began(self) -> None:
        """An episode has begun: the list of frames starts anew, and the window shows the way to the first decision."""
        self._shown = 0
        if self._window is not None:
            self._window.closed_by_user = False
            self.play()

    def play(self) -> None:
        """Show what the last step brought in the window, in real time; nothing in other modes."""
        if self._window is not None:
            for scene in self._last(0, SMOOTH_FPS):
                self._window.show(draw(scene), SMOOTH_FPS)

    def render(self) -> Any:
        """What the mode says, of the one world; None for ``human``, where every step shows itself."""
        if self.mode is None:
            raise InvalidInput(f"render: made with render_mode=None; give one of {', '.join(MODES)} when it is made")
        if self.mode == "human":
            self._last(0)  # says where no episode was started
            return None
        if self.mode == "rgb_array_list":
            return self._new_frames()
        return self._shown_as(self._last(0)[-1])

    def render_each(self) -> tuple[Any, ...]:
        """What the mode says of every world, in order."""
        if self.mode is None:
            raise InvalidInput(
                f"render: made with render_mode=None; give one of {', '.join(BATCH_MODES)} when it is made"
            )
        return tuple(self._shown_as(self._last(k)[-1]) for k in range(self._engine.n))

    def step_frames(self, fps: float = SMOOTH_FPS) -> list[Frame]:
        """The frames [H, W, 3] between the last decision, or the alert, and now: ``fps`` in a second of the world.

        Raises ``InvalidInput`` before the first reset, with render_mode=None, and for an ``fps`` below 1.
        """
        check_whole_number("step_frames: fps", fps, 1)
        if self.mode is None:
            raise InvalidInput("step_frames: made with render_mode=None; give 'rgb_array' when it is made")
        return [draw(scene) for scene in self._last(0, fps)]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _last(self, row: int, fps: float | None = None) -> list[Scene]:
        assert self._trace is not None
        motion = kept_motions(self._engine, self._trace)[-1]
        return scenes(self._engine, motion, row, None if fps is None else moments(motion, row, fps))

    def _new_frames(self) -> list[Frame]:
        """One frame for the beginning and each step that no list has shown yet."""
        assert self._trace is not None
        motions = kept_motions(self._engine, self._trace)
        new, self._shown = motions[self._shown :], len(motions)
        return [draw(scenes(self._engine, motion, 0)[-1]) for motion in new]

    def _shown_as(self, scene: Scene) -> Any:
        return scene_text(scene) if self.mode == "ansi" else draw(scene)


def draw(scene: Scene) -> Frame:
    """The moment as a picture; imports Pillow."""
    from ethbrake_marl.envs.drawing.frame import draw_frame

    return draw_frame(scene)


def render_metadata(engine: Engine, modes: Sequence[str] = MODES) -> dict[str, Any]:
    """``render_modes``, and the ``render_fps`` at which one frame per step plays in real time."""
    fps = 1.0 / engine.scenario.time_step_s
    return {"render_modes": list(modes), "render_fps": round(fps) if abs(fps - round(fps)) < 1e-9 else fps}
