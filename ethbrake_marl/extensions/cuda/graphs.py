"""``Graphed``: a function of tensors that a GPU repeats as one CUDA graph, instead of operation by operation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

WARM_UP = 3  # calls before the graph is recorded, in which torch and the driver load what they need


class Graphed:
    """A function of tensors that a GPU repeats as one CUDA graph. The arguments have the same shapes in every call.

    The function must not wait for the device. On a GPU the next call overwrites the result. On a processor the function
    is called as it is.
    """

    def __init__(self, function: Callable[..., Any], device: torch.device) -> None:
        self.function, self.device, self.calls = function, device, 0

    def __call__(self, *tensors: Tensor) -> Any:
        if self.device.type != "cuda":
            return self.function(*tensors)
        self.calls += 1
        with torch.cuda.device(self.device):
            if self.calls <= WARM_UP:
                return self._beside(*tensors)
            if self.calls == WARM_UP + 1:
                self._record(*tensors)
            for buffer, tensor in zip(self.inputs, tensors, strict=True):
                buffer.copy_(tensor)
            self.graph.replay()
        return self.result

    def _beside(self, *tensors: Tensor) -> Any:
        """Result of the function on a second CUDA stream, as CUDA requires before a graph is recorded."""
        main, beside = torch.cuda.current_stream(), new_stream()
        beside.wait_stream(main)
        with torch.cuda.stream(beside):
            result = self.function(*tensors)
        main.wait_stream(beside)
        return result

    def _record(self, *tensors: Tensor) -> None:
        self.inputs = [tensor.clone() for tensor in tensors]
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph, stream=new_stream()):
            self.result = self.function(*self.inputs)


def new_stream() -> torch.cuda.Stream:
    return torch.cuda.Stream()  # type: ignore[no-untyped-call]
