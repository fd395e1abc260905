"""``Window``: window for ``render_mode="human"``, drawn with pygame."""

from __future__ import annotations

import os
from typing import Any

from ethbrake_marl.errors import InvalidInput, need
from ethbrake_marl.first_edition.envs.rendering import HEIGHT, WIDTH, Frame


class Window:
    """Window for ``render_mode="human"``, which opens when the first frame is shown.

    If the user closes the window, it opens again at the next episode. A copy of the object opens a window of its own.
    Raises ``MissingExtra`` if pygame is not installed.
    """

    def __init__(self) -> None:
        need("pygame")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame otherwise prints a greeting
        import pygame

        self._pygame: Any = pygame
        self._screen: Any = None
        self._clock: Any = None
        self.closed_by_user = False  # ``Viewer.began`` sets it to False at the beginning of an episode

    def __reduce__(self) -> tuple[type[Window], tuple[()]]:
        return Window, ()

    def show(self, frame: Frame, fps: float) -> None:
        """Show a frame [H, W, 3] uint8 for 1 / ``fps`` seconds. Raise ``InvalidInput`` without a display."""
        if self.closed_by_user:
            return
        pygame = self._pygame
        if self._screen is None:
            try:
                pygame.display.init()
                self._screen = pygame.display.set_mode((WIDTH, HEIGHT))
            except pygame.error as error:
                raise InvalidInput(
                    f"render_mode = 'human': cannot open a window ({error}); use 'rgb_array', which needs no display"
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
