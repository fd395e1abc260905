"""``Viewer``: the implementation of ``render()`` for each render mode."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.envs.rendering import Frame
from ethbrake_marl.envs.trace import Memory, Trace
from ethbrake_marl.envs.window import Window
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.physics.state import Floats

SMOOTH_FPS = 50  # frames per second in the window and from ``step_frames``


class Viewer:
    """Pictures of the running episodes of an engine. The window's library is imported only for mode ``human``.

    Args:
        engine: the engine to show, from its next reset on.
        mode: ``human``, ``rgb_array``, ``rgb_array_list`` or ``ansi``; None: nothing is recorded, and nothing can be
            shown.
        batch: whether the environment has many worlds, and shows each of them; then only ``rgb_array`` and ``ansi``.

    Raises ``InvalidInput`` for another mode, ``MissingExtra`` for ``human`` if pygame is missing.

    """

    METADATA: ClassVar[dict[str, Any]] = {  # defaults of a class; each environment has its own fps
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
        self._shown = 0  # number of motions of the running episode that a list of frames has already shown

    @property
    def metadata(self) -> dict[str, Any]:
        """Gymnasium's metadata: the render modes, and the frames per second.

        With one frame per step, ``render_fps`` plays in real time.
        """
        fps = 1.0 / self._engine.scenario.time_step_s
        return {"render_modes": list(self.modes), "render_fps": round(fps) if abs(fps - round(fps)) < 1e-9 else fps}

    def began(self) -> None:
        """Start a new list of frames, and show the time up to the first decision. Call it when an episode starts."""
        self._shown = 0
        if self._window is not None:
            self._window.closed_by_user = False
            self.play()

    def play(self) -> None:
        """Show the last step in the window, in real time; do nothing in other modes."""
        if self._window is not None:
            for frame in self.step_frames():
                self._window.show(frame, SMOOTH_FPS)

    def render(self) -> Any:
        """Return the picture of the present moment, in the form of the mode; for a batch, a tuple with one per world.

        ``rgb_array``: a frame [H, W, 3] uint8. ``rgb_array_list``: the list of frames since the last call. ``ansi``: a
        text. ``human``: None, because every step is shown in the window anyway.
        """
        motions = self._motions(f"render: render_mode must be one of {', '.join(self.modes)}")
        if self.mode == "human":
            return None
        if self.mode == "rgb_array_list":  # one frame for the beginning and for each step not in an earlier list
            new, self._shown = motions[self._shown :], len(motions)
            return [motion.scenes(self._engine, 0)[-1].frame() for motion in new]
        scenes = [motions[-1].scenes(self._engine, k)[-1] for k in range(self._engine.n)]
        shown = tuple(scene.text() if self.mode == "ansi" else scene.frame() for scene in scenes)
        return shown if self._batch else shown[0]

    def step_frames(self, fps: float = SMOOTH_FPS) -> list[Frame]:
        """Return the frames [H, W, 3] of the last step, or from the alert to the first decision, at ``fps`` per second.

        Raises ``InvalidInput`` before the first reset, with render_mode=None, and for an ``fps`` below 1.
        """
        check_whole_number("step_frames: fps", fps, 1)
        motion = self._motions("step_frames: render_mode must be 'rgb_array'")[-1]
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        times: Floats = np.linspace(start, until, max(round((until - start) * fps), 1) + 1)[1:]  # includes the end
        return [scene.frame() for scene in motion.scenes(self._engine, 0, times)]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _motions(self, refusal: str) -> Memory:
        if self._trace is None:
            raise InvalidInput(f"{refusal} when the environment is made; here it is None")
        return self._trace.motions(self._engine)
