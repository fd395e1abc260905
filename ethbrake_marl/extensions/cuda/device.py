"""Run kernels on a GPU, through NVIDIA's driver, or on a processor, one world after the other."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cuda.kernels import ThreadMemory, play_each
from ethbrake_marl.extensions.cuda.machine_code import ptx_of

OLDEST = (7, 0)  # compute capability that torch supports, and with it this package
THREADS_PER_BLOCK = 128  # threads that a GPU starts together


class Kernel(NamedTuple):
    """The function ``kernels.play_world`` for n worlds, one thread for each: its GPU form and its processor form."""

    size: tuple[int, ...]  # bodies, learners, features, neighbours in view
    mine: ThreadMemory  # memory of one thread, arrays

    @property
    def name(self) -> str:
        """Name of the stored machine code. It contains everything that decides the code, except the sources."""
        return "-".join(["play", *map(str, self.size)])

    def thread(self) -> Callable[..., None]:
        from ethbrake_marl.extensions.cuda.threads import play_thread  # numba.cuda is slow to import

        return play_thread(ThreadMemory(*(array.shape for array in self.mine)))

    def launch(self, device: torch.device, n: int, *arguments: Any) -> None:
        """Run n threads. ``arguments``: tensors on this device, numbers, and tuples of both."""
        if device.type == "cuda":
            _driver(device.index or 0).launch(self, n, arguments)
        else:
            play_each(self.mine, *as_arrays((*arguments, n)))  # type: ignore[no-untyped-call]


def device_named(name: str) -> torch.device:
    """Torch device for a name such as ``cpu``, ``cuda`` or ``cuda:1``.

    Raises ``InvalidInput`` if the device cannot run the kernels.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise InvalidInput(f"device = {name!r}: must be 'cuda', or 'cpu', where the same code runs slowly")
    if device.type == "cuda":
        _check_gpu(device.index or 0)
        return torch.device("cuda", device.index or 0)
    return torch.device("cpu")  # without a number, as tensors have it


class TooLittleMemory(InvalidInput):
    """The device has less memory than the request needs."""


@contextmanager
def enough_memory(what: str) -> Iterator[None]:
    """Context manager: too little memory raises ``TooLittleMemory``, whose message begins with ``what``.

    If such managers are nested, the message is that of the outermost one.
    """
    try:
        yield
    except (TooLittleMemory, MemoryError, RuntimeError) as error:
        of_torch = isinstance(error, RuntimeError) and not isinstance(error, torch.OutOfMemoryError)
        if of_torch and "can't allocate memory" not in str(error):  # which torch says of a processor
            raise
        raise TooLittleMemory(f"{what}: need more memory than the device has; choose smaller numbers") from None


def _check_gpu(index: int) -> None:
    """Raise ``InvalidInput`` with advice if torch cannot use GPU number ``index``, or the GPU is too old."""
    if torch.version.cuda is None:
        raise InvalidInput(
            f"device = 'cuda': the installed torch {torch.__version__} is not built for NVIDIA's GPUs; install a build"
            " that is (on Linux: pip install --force-reinstall torch), or use device 'cpu'"
        )
    if not torch.cuda.is_available():
        raise InvalidInput(
            "device = 'cuda': torch finds no NVIDIA GPU whose driver it can use (nvidia-smi lists GPUs and driver); use"
            " device 'cpu'"
        )
    count = torch.cuda.device_count()
    if not index < count:
        raise InvalidInput(
            f"device = 'cuda:{index}': the only devices are {', '.join(f'cuda:{k}' for k in range(count))}"
        )
    if torch.cuda.get_device_capability(index) < OLDEST:
        name, has = torch.cuda.get_device_name(index), torch.cuda.get_device_capability(index)
        raise InvalidInput(
            f"device = 'cuda:{index}': {name} has compute capability {has[0]}.{has[1]}; needs at least"
            f" {OLDEST[0]}.{OLDEST[1]} (Volta, 2017); use device 'cpu'"
        )


def as_arrays(arguments: Any) -> Any:
    return _map_tensors(arguments, Tensor.numpy)


def empty_arrays(arguments: Any) -> Any:
    """Arguments of a kernel, with empty arrays on the processor instead of tensors, to compile the kernel."""
    return _map_tensors(arguments, lambda tensor: torch.empty((0,) * tensor.dim(), dtype=tensor.dtype).numpy())


def _map_tensors(argument: Any, array_of: Callable[[Tensor], Any]) -> Any:
    """The argument with ``array_of`` applied to each tensor; tuples are mapped part by part."""
    if isinstance(argument, Tensor):
        return array_of(argument)
    if isinstance(argument, tuple):
        parts = [_map_tensors(part, array_of) for part in argument]
        return type(argument)(*parts) if hasattr(argument, "_fields") else tuple(parts)
    return argument


def cells_of(argument: Any) -> Iterator[Any]:
    """Arguments of a kernel as the C values that code compiled by numba expects.

    An array becomes two unused pointers, its number of entries, the size of an entry in bytes, its address, shape and
    strides in bytes. A tuple becomes its parts.
    """
    if isinstance(argument, tuple):
        for part in argument:
            yield from cells_of(part)
    elif isinstance(argument, Tensor):
        assert argument.is_contiguous()
        size = argument.element_size()
        shape, strides = argument.shape, [size * step for step in argument.stride()]
        for number in (0, 0, argument.numel(), size, argument.data_ptr(), *shape, *strides):
            yield ctypes.c_int64(number)
    elif isinstance(argument, bool):
        yield ctypes.c_int8(argument)
    elif isinstance(argument, float):
        yield ctypes.c_double(argument)
    else:
        yield ctypes.c_int64(argument)


class _Driver:
    """NVIDIA's driver of one GPU, in the context and on the stream of torch."""

    def __init__(self, index: int) -> None:
        self.index = index
        torch.zeros(1, device=f"cuda:{index}")  # torch makes the context
        self.cuda = ctypes.CDLL("nvcuda.dll" if hasattr(ctypes, "windll") else "libcuda.so.1")
        self.functions: dict[str, ctypes.c_void_p] = {}

    def launch(self, kernel: Kernel, n: int, arguments: tuple[Any, ...]) -> None:
        if not n:
            return
        with torch.cuda.device(self.index):
            if kernel.name not in self.functions:
                self.functions[kernel.name] = self.load(kernel, arguments)
            cells = [*cells_of((*arguments, n))]
            places = (ctypes.c_void_p * len(cells))(*(ctypes.addressof(cell) for cell in cells))
            stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
            function, blocks = self.functions[kernel.name], -(-n // THREADS_PER_BLOCK)
            self.check("cuLaunchKernel", function, blocks, 1, 1, THREADS_PER_BLOCK, 1, 1, 0, stream, places, None)

    def load(self, kernel: Kernel, arguments: tuple[Any, ...]) -> ctypes.c_void_p:
        capability = torch.cuda.get_device_capability(self.index)
        code = ptx_of(kernel.name, kernel.thread, (*empty_arrays(arguments), 0), capability)
        module, function = ctypes.c_void_p(), ctypes.c_void_p()
        self.check("cuModuleLoadData", ctypes.byref(module), code.encode() + b"\0")
        self.check("cuModuleGetFunction", ctypes.byref(function), module, b"kernel")
        return function

    def check(self, call: str, *arguments: Any) -> None:
        """Call a function of the driver. Raises ``InvalidInput`` with the driver's reason if the call fails."""
        code = getattr(self.cuda, call)(*arguments)
        if code:
            text = ctypes.c_char_p()
            self.cuda.cuGetErrorString(code, ctypes.byref(text))
            reason = "unknown error" if text.value is None else text.value.decode()
            raise InvalidInput(
                f"device = 'cuda:{self.index}': the driver's {call} fails: {reason} (error {code}); with too little"
                " memory use fewer worlds, with a driver older than 550 a newer one, or use device 'cpu'"
            )


@cache
def _driver(index: int) -> _Driver:
    return _Driver(index)
