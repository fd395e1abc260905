"""The window of ``render_mode="human"``. Importing this file imports pygame; a window opens with its first frame."""

from __future__ import annotations

import os
from typing import Any

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # importing a library says nothing

import pygame

from ethbrake_marl.envs.drawing.frame import HEIGHT, WIDTH, Frame
from ethbrake_marl.errors import InvalidInput


class Window:
    """One window that shows frame after frame; once its user closes it, it stays closed for the episode."""

    def __init__(self) -> None:
        self._screen: pygame.Surface | None = None
        self._clock: Any = None
        self._closed_by_user = False

    def open_again(self) -> None:
        """A new episode may open the window again."""
        self._closed_by_user = False

    def show(self, frame: Frame, fps: float) -> None:
        """Show a frame [H, W, 3] for 1/fps seconds. Raises ``InvalidInput`` where there is no display."""
        if self._closed_by_user:
            return
        if self._screen is None:
            self._open()
        assert self._screen is not None
        self._screen.blit(pygame.image.frombuffer(frame.tobytes(), (WIDTH, HEIGHT), "RGB"), (0, 0))
        pygame.display.flip()
        self._clock.tick(fps)
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            self._closed_by_user = True

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._screen is not None:
            pygame.display.quit()
            self._screen = self._clock = None

    def _open(self) -> None:
        try:
            pygame.display.init()
            self._screen = pygame.display.set_mode((WIDTH, HEIGHT))
        except pygame.error as error:
            raise InvalidInput(
                f"render_mode = 'human': no window can be opened here ({error}); 'rgb_array' needs no display"
            ) from None
        pygame.display.set_caption("EthBrake")
        self._clock = pygame.time.Clock()

    def __deepcopy__(self, memo: dict[int, Any]) -> Window:
        return Window()  # a copied environment opens a window of its own

    def __getstate__(self) -> dict[str, Any]:
        return {"_screen": None, "_clock": None, "_closed_by_user": False}
