"""Episodes and training on NVIDIA's GPUs, with the bits of a processor: one world in each thread."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.cuda.worlds import Worlds as Worlds

__getattr__ = front_door(__name__, __file__)
