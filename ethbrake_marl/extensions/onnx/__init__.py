"""Policies as ONNX models, for other programs."""

from typing import TYPE_CHECKING

from ethbrake_marl.lazy_imports import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.onnx.model import to_onnx as to_onnx

else:
    __getattr__ = front_door(__name__, __file__)
