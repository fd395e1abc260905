"""The render modes of environments: ``rgb_array``, ``ansi`` and ``human``."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, check_whole_number, need
from ethbrake_marl.extensions.rendering.scene import Motion, Scene
from ethbrake_marl.motion.layout import Floats

SMOOTH_FPS = 50  # frames per second in the window, and default of `step_frames`
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")  # variables, one of which names a display of Linux


class Viewer:
    """Viewer of the mode ``rgb_array``: the present moment as a picture. The other viewers extend it."""

    def __init__(self, environment: Any) -> None:
        self.environment = environment
        self.many = hasattr(environment, "num_envs")
        self.motions: list[Motion] = []  # of each world, since its last decision

    def began(self, state: State) -> None:
        if len(self.motions) != state.n:
            self.motions = [Motion(self.environment.game, state, row) for row in range(state.n)]
        self.stepped(state)

    def stepped(self, state: State) -> None:
        for row, motion in enumerate(self.motions):
            if state.steps[row] == 0:
                self.motions[row] = Motion(self.environment.game, state, row)
            elif state.time_s[row] > motion.until_s:
                motion.step(state)

    def motion(self, row: int) -> Motion:
        if not self.motions:
            raise InvalidInput("render: no episode has started; call reset first")
        return self.motions[row]

    def render(self) -> Any:
        motions = map(self.motion, range(len(self.motions) or 1))
        views = [self.show(motion.scene(motion.until_s)) for motion in motions]
        return views if self.many else views[0]

    def show(self, scene: Scene) -> Any:
        from ethbrake_marl.extensions.rendering.picture import picture

        return picture(scene)

    def step_frames(self, fps: int = SMOOTH_FPS) -> list[Any]:
        """Pictures of the last time step of the first world, ``fps`` per simulated second; each [304, 800, 3] uint8."""
        check_whole_number("step_frames: fps", fps, 1)
        motion = self.motion(0)
        count = max(round((motion.until_s - motion.start_s) * fps), 1)
        times: Floats = np.linspace(motion.start_s, motion.until_s, count + 1)[1:]
        return [Viewer.show(self, motion.scene(float(time_s))) for time_s in times]

    def close(self) -> None:
        """Do nothing: there is no window."""


class Words(Viewer):
    """Viewer of the mode ``ansi``: the present moment as plain text."""

    def show(self, scene: Scene) -> Any:
        return scene.text()


def import_pygame(many: bool = False) -> Any:
    """Import pygame of the package pygame-ce. Raises ``MissingExtra`` without it.

    Raises ``InvalidInput`` for ``many`` worlds, which have no window, for an old pygame-ce, and for the package pygame.
    """
    if many:
        raise InvalidInput("render_mode = 'human': must be 'rgb_array' or 'ansi' for many worlds")
    need("pygame")
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the package pygame uses what Python will remove
        import pygame
    if not hasattr(getattr(pygame, "Window", None), "get_surface"):
        raise InvalidInput(
            f"render_mode = 'human': the module pygame {pygame.version.ver} has no Window: the package pygame has none,"
            " the package pygame-ce has one; uninstall both, then install pygame-ce; or use gymnasium.make, which opens"
            " a window with either"
        )
    return pygame


def check_window(many: bool = False) -> None:
    """Raise ``InvalidInput`` or ``MissingExtra`` if there can be no window. The display is not started."""
    import_pygame(many)
    if sys.platform == "linux" and not os.environ.keys() & DISPLAYS:
        raise InvalidInput(f"there is no display: none of the variables {', '.join(DISPLAYS)} is set")


def start_display() -> Any:
    """Start the display, and return the module pygame.

    Raises the errors of ``import_pygame``, and ``InvalidInput`` without a display.
    """
    pygame = import_pygame()
    with _refusing(pygame):
        pygame.display.init()
        if pygame.display.get_driver() == "offscreen" and "SDL_VIDEODRIVER" not in os.environ:
            raise pygame.error("there is no display")  # SDL's last resort draws where nobody sees it
    return pygame


@contextmanager
def _refusing(pygame: Any) -> Iterator[None]:
    try:
        yield
    except pygame.error as error:
        raise InvalidInput(
            f"cannot open a window ({error}); render_mode = 'rgb_array' and film files need no display"
        ) from None


class Window(Viewer):
    """Viewer of the mode ``human``: a window that shows every step in real time. The user may close it."""

    check = staticmethod(check_window)

    def __init__(self, environment: Any) -> None:
        super().__init__(environment)
        if self.many:
            self.check(many=True)
        self.window: Any = None
        self.closed = False

    def began(self, state: State) -> None:
        super().began(state)
        self.closed = False
        self._play()

    def stepped(self, state: State) -> None:
        super().stepped(state)
        self._play()

    def render(self) -> None:
        """Do nothing: the window shows every step by itself."""

    def _play(self) -> None:
        """Show the last time step in real time. Open the window first; stop if the user closes it."""
        for frame in [] if self.closed else self.step_frames():
            if self.window is None:
                self.window = Screen(frame)
            if not self.window.show(frame, SMOOTH_FPS):
                self.closed = True
                self.close()
                return

    def close(self) -> None:
        if self.window is not None:
            self.window.close()
            self.window = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "window": None}


class Screen:
    """A window of the size of a picture, [H, W, 3].

    Raises the errors of ``start_display``.
    """

    def __init__(self, frame: Any) -> None:
        self.pygame = start_display()
        self.clock = self.pygame.time.Clock()
        with _refusing(self.pygame):
            self.window = self.pygame.Window("EthBrake", frame.shape[1::-1])

    def show(self, frame: Any, fps: int) -> bool:
        """Show a picture for the time of one frame. Return whether the window is still open."""
        pygame = self.pygame
        picture = pygame.image.frombuffer(frame.tobytes(), frame.shape[1::-1], "RGB")
        self.window.get_surface().blit(picture, (0, 0))
        self.window.flip()
        self.clock.tick(fps)
        is_open = True
        for event in pygame.event.get(pygame.WINDOWCLOSE):
            if event.window is self.window:
                is_open = False
            else:  # another environment's
                pygame.event.post(event)
        pygame.event.pump()
        return is_open

    def close(self) -> None:
        self.window.destroy()
