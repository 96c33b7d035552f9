"""Compiles every kernel of a fit on CUDA for a GPU that need not be there, with the types that a fit gives them; run as a program.

The interpreter, in which tests try kernels without a GPU, takes what the compiler refuses. So launches are replaced by compilations here.
"""

from __future__ import annotations

import sys
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from fieldfuse.config import load_settings
from fieldfuse.render.triton_renderer import TritonRenderer
from fieldfuse.training import engine, triton_engine

TYPES = {torch.float32: "*fp32", torch.int32: "*i32", torch.int64: "*i64", torch.uint8: "*u8"}
CAPABILITY = 80
PARTS = ("HAS_SHELL", "TRAIN", "SOME", "KNOWN")  # where one of these is not wanted, a kernel is a part of what it is with it
done: set[tuple[Any, ...]] = set()


def compiled(self: Any, *args: Any, grid: Any, warmup: bool, num_warps: int = 4, **constants: Any) -> None:
    """In place of a launch."""
    names = [name for name in self.arg_names if name not in constants]
    kinds = [TYPES[a.dtype] if isinstance(a, torch.Tensor) else "fp32" if isinstance(a, float) else "i32" for a in args]
    shaping = {name: value for name, value in constants.items() if name != "SLOTS"}  # a number among others in what is compiled
    key = (self.fn.__name__, tuple(kinds), tuple(shaping.items()))
    if key not in done and all(constants.get(name, True) for name in PARTS):
        done.add(key)
        signature = dict(zip(names, kinds, strict=True)) | dict.fromkeys(constants, "constexpr")
        source = ASTSource(fn=self, signature=signature, constexprs=constants)
        triton.compile(source, target=GPUTarget("cuda", CAPABILITY, 32), options={"num_warps": num_warps})


if __name__ == "__main__":
    triton.runtime.jit.JITFunction.run = compiled
    triton_engine.ROWS["cpu"] = triton_engine.ROWS["cuda"]
    engine.make_renderer = TritonRenderer  # type: ignore[assignment]
    settings = load_settings(pairs=["field.channels=16", "field.hidden=64"])
    engine.use_every_kernel(triton_engine.TritonEngine, settings, torch.device("cpu"), 32)
    sys.stdout.write(" ".join(sorted({key[0] for key in done})) + f"\n{len(done)}\n")
