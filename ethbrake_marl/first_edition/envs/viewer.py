"""``Viewer``: the object that draws pictures for the method ``render`` of all environments."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.rendering import Frame
from ethbrake_marl.first_edition.envs.trace import Memory, Trace
from ethbrake_marl.first_edition.envs.window import Window
from ethbrake_marl.first_edition.physics.state import Floats

SMOOTH_FPS = 50  # frames per second in the window, and default of ``step_frames``


class Viewer:
    """Object that draws pictures of the running episodes of an engine.

    Args:
        engine: the engine whose worlds are shown, from the engine's next reset on.
        mode: render mode: ``human``, ``rgb_array``, ``rgb_array_list`` or ``ansi``; None: no pictures.
        batch: whether the environment has many worlds, all of which are shown; only the modes ``rgb_array`` and
            ``ansi`` are then allowed.

    Raises ``InvalidInput`` for a mode that is not allowed. Raises ``MissingExtra`` for the mode ``human`` if pygame is
    not installed.

    """

    METADATA: ClassVar[dict[str, Any]] = {  # for classes; each environment object has its own ``render_fps``
        "render_modes": ["human", "rgb_array", "rgb_array_list", "ansi"],
        "render_fps": 10,
    }

    def __init__(self, engine: Engine, mode: str | None, *, batch: bool = False) -> None:
        self.modes: list[str] = ["rgb_array", "ansi"] if batch else self.METADATA["render_modes"]
        if mode is not None and mode not in self.modes:
            known = ", ".join(map(repr, self.modes))
            raise InvalidInput(f"render_mode = {mode!r}: must be one of {known}, or None")
        self.mode = mode
        self._engine, self._batch = engine, batch
        self._window = Window() if mode == "human" else None
        self._trace = None if mode is None else Trace(engine, whole=mode == "rgb_array_list")
        self._shown = 0  # number of motions of the running episode that earlier lists of frames contain

    @property
    def metadata(self) -> dict[str, Any]:
        """Gymnasium's metadata: ``render_modes``, and ``render_fps`` (one frame per time step of the scenario)."""
        fps = 1.0 / self._engine.scenario.time_step_s
        return {"render_modes": list(self.modes), "render_fps": round(fps) if abs(fps - round(fps)) < 1e-9 else fps}

    def began(self) -> None:
        """Show the motion up to the first decision, and empty the list of frames; call this at each episode's start."""
        self._shown = 0
        if self._window is not None:
            self._window.closed_by_user = False
            self.play()

    def play(self) -> None:
        """In the mode ``human``, show the last step in the window in real time; in other modes, do nothing."""
        if self._window is not None:
            for frame in self.step_frames():
                self._window.show(frame, SMOOTH_FPS)

    def render(self) -> Any:
        """Return a picture of the present moment, or a tuple with one picture per world if ``batch`` is true.

        The type of a picture is as in ``OneWorld.render``.
        """
        motions = self._motions(f"render: the environment needs a render_mode: {', '.join(self.modes)}")
        if self.mode == "human":
            return None
        if self.mode == "rgb_array_list":  # frames of all motions that no earlier list contains
            new, self._shown = motions[self._shown :], len(motions)
            return [motion.scenes(self._engine, 0)[-1].frame() for motion in new]
        scenes = [motions[-1].scenes(self._engine, k)[-1] for k in range(self._engine.n)]
        shown = tuple(scene.text() if self.mode == "ansi" else scene.frame() for scene in scenes)
        return shown if self._batch else shown[0]

    def step_frames(self, fps: float = SMOOTH_FPS) -> list[Frame]:
        """Return frames [H, W, 3] of the last step or, after a reset, of the motion up to the first decision.

        Raises ``InvalidInput`` before the first reset, if the viewer has no render mode, and unless ``fps`` (frames per
        second) is a whole number of at least 1.
        """
        check_whole_number("step_frames: fps", fps, 1)
        motion = self._motions("step_frames: the environment needs the render_mode 'rgb_array'")[-1]
        start, until = float(motion.start.time_s[0]), float(motion.until_s[0])
        times: Floats = np.linspace(start, until, max(round((until - start) * fps), 1) + 1)[1:]  # includes the end
        return [scene.frame() for scene in motion.scenes(self._engine, 0, times)]

    def close(self) -> None:
        """Close the window of the render mode ``human``, if it is open."""
        if self._window is not None:
            self._window.close()

    def _motions(self, refusal: str) -> Memory:
        if self._trace is None:
            raise InvalidInput(f"{refusal}; pass render_mode when you create the environment")
        return self._trace.motions(self._engine)
