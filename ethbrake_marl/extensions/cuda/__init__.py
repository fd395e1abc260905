"""Episodes and training on NVIDIA GPUs, with the same bits as on a processor: one GPU thread for each world."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ethbrake_marl.lazy_imports import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.cuda.worlds import Worlds as Worlds

__getattr__ = front_door(__name__, __file__)
