"""How kernels are compiled: strictly, without the lock, and never from stale machine code."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

import ethbrake_marl
from ethbrake_marl.physics.compiling import compiled as compile_kernel

needs_compiler = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="compilation is switched off")


@needs_compiler
def test_compiled__is_strict_and_releases_the_lock():
    kernel = compile_kernel(lambda x: x + 1.0)
    options = kernel.targetoptions
    assert options["fastmath"] is False and options["nogil"] is True and options["error_model"] == "numpy"
    assert options["nopython"] is True and "parallel" not in options


@needs_compiler
@pytest.mark.parametrize(
    ("way", "more"),
    [
        ({}, {"forceinline": True}),
        ({"apart": True}, {"forceinline": False}),
        ({"within": True}, {"inline": "always"}),
        ({"bare": True}, {"forceinline": True, "_nrt": False}),
        ({"apart": True, "bare": True}, {"forceinline": False, "_nrt": False}),
    ],
)
def test_compiled__has_these_options(way, more):
    options = {"nopython": True, "boundscheck": None, "fastmath": False, "nogil": True, "error_model": "numpy", **more}
    assert compile_kernel(**way)(lambda x: x).targetoptions == options


@needs_compiler
def test_compiled_bare__leaves_the_counts_of_references_alone():
    @compile_kernel(bare=True)
    def first(values):
        return values[1:][0]

    values = np.arange(3.0)
    before = sys.getrefcount(values)
    assert [first(values) for _ in range(5)] == [1.0] * 5
    assert sys.getrefcount(values) == before
    with pytest.raises(NumbaError, match="NRT required"):
        compile_kernel(bare=True)(lambda n: np.zeros(n))(3)  # it can make no array: told at once


@needs_compiler
def test_compiled__divides_by_zero_as_ieee_does():
    assert compile_kernel(lambda x: 1.0 / x)(0.0) == float("inf")


def test_compiled_bare__gives_no_array_back():
    bare = []
    for source in sorted(Path(ethbrake_marl.__file__).parent.rglob("*.py")):
        text = source.read_text("utf-8")
        for node in ast.walk(ast.parse(text)) if "bare=True" in text else ():
            if any("bare=True" in ast.unparse(each) for each in getattr(node, "decorator_list", ())):
                bare.append(f"{source.name}: {node.name}")
                words = set(re.findall(r"\w+", ast.unparse(node.returns)))
                assert words <= {"None", "bool", "int", "float", "tuple"}, bare[-1]
    assert len(bare) > 30
