"""A second device for machines that have none: tensors that lie on the CPU and say that they lie on a GPU.

Within `SecondDevice` whatever is made for "cuda" is marked, marks spread from operands to results, and a marked tensor
answers `.device` with cuda:0, so that code takes the way it takes on a GPU.  What CUDA refuses is written down in
`mixed`, with the line of bstcad that asked for it, and goes on; the rules are PyTorch's:

- an operation takes tensors of one device; a CPU tensor of no dimensions counts as a number;
- a GPU tensor may be indexed by CPU tensors, not the other way round; assigned to it may be whatever can be copied;
- `copy_`, `to`, `cpu`, `item` and their like go between devices; `numpy` does not.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

import bstcad

SECOND = torch.device("cuda", 0)
PACKAGE = str(Path(bstcad.__file__).parent)
CROSSING = {"copy_", "set_", "__deepcopy__"}  # operations that take tensors of two devices
TO_HOST = {"numpy", "__array__", "__dlpack__", "data_ptr"}  # names that only a CPU tensor has
GLUED = {"cat", "stack", "concat", "hstack", "vstack"}  # a tensor of no dimensions is no number to them


def on_second(t: Any) -> bool:
    """Is it a marked tensor?"""
    return isinstance(t, Tensor) and t.__dict__.get("_on_second", False)


class SecondDevice(TorchFunctionMode):
    """While it lasts, and in the thread that entered it, "cuda" is there."""

    def __init__(self) -> None:
        super().__init__()
        self.mixed: dict[str, str] = {}  # line of bstcad: what it did
        self.marked = 0  # tensors: a test that marks none tests nothing
        self._there = mock.patch("torch.cuda.is_available", lambda: True)

    def __enter__(self) -> SecondDevice:
        self._there.start()
        return super().__enter__()

    def __exit__(self, *error: object) -> None:
        self._there.stop()
        super().__exit__(*error)

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        owner = getattr(func, "__self__", None)
        if name == "__get__" and owner is Tensor.device:
            return SECOND if on_second(args[0]) else func(*args)
        if name == "__get__" and owner is Tensor.is_cuda:
            return on_second(args[0])
        if name in ("to", "cuda", "cpu"):
            return self._moved(func, name, args, kwargs)
        wanted = None if name in ("device", "Generator") else kwargs.get("device")
        if wanted is not None:
            kwargs["device"] = "cpu"
        tensors = [*_tensors(args), *_tensors(kwargs.values())]
        marked = [t for t in tensors if on_second(t)]
        if marked:
            self._judge(func, name, args, tensors)
        found = func(*args, **kwargs)
        if name == "grad" and func.__module__ == "torch.autograd":  # each gradient lies where its input does
            inputs = args[1] if len(args) > 1 else kwargs["inputs"]
            for g, p in zip(found, [inputs] if isinstance(inputs, Tensor) else inputs, strict=True):
                if on_second(p) and g is not None:
                    self._mark(g)
        elif _is_second(wanted) if wanted is not None else marked and _decides(name, args):
            for t in _tensors([found]):
                self._mark(t)
        return found

    def _moved(self, func: Any, name: str, args: tuple, kwargs: dict) -> Tensor:
        """`to` and its like, which may cross."""
        t, rest = args[0], list(args[1:])
        second = {"cuda": True, "cpu": False}.get(name, on_second(t))
        for k, way in enumerate(rest):
            if isinstance(way, Tensor):
                second = on_second(way)
            elif isinstance(way, str | torch.device):
                second, rest[k] = _is_second(way), "cpu"
        if kwargs.get("device") is not None:
            second, kwargs["device"] = _is_second(kwargs["device"]), "cpu"
        found = Tensor.cpu(t) if name == "cuda" else func(t, *rest, **kwargs)
        if second == on_second(t) and found is t:
            return t
        found = found.clone() if found is t else found
        if second:
            self._mark(found)
        return found

    def _judge(self, func: Any, name: str, args: tuple, tensors: list[Tensor]) -> None:
        """Would CUDA refuse it?  Some of the tensors are marked."""
        if name in TO_HOST:
            self._note(f"{name} of a tensor on the GPU")
        elif name in ("__getitem__", "__setitem__", "index_put_"):
            if not on_second(args[0]) and any(on_second(t) for t in _tensors(args[1:2])):
                self._note("a CPU tensor indexed by one on the GPU")
            elif name != "__getitem__" and on_second(args[0]) and _host(args[2]) and list(_tensors(args[1:2])):
                self._note("a CPU tensor assigned to places of one on the GPU")
        elif name not in CROSSING and any(_host(t, 0 if name in GLUED else 1) for t in tensors):
            self._note(f"{name} of tensors on the CPU and the GPU")

    def _mark(self, t: Tensor) -> None:
        t.__dict__["_on_second"] = True
        self.marked += 1

    def _note(self, what: str) -> None:
        frame = sys._getframe()
        while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
            frame = frame.f_back
        where = f"{frame.f_code.co_filename.removeprefix(PACKAGE)}:{frame.f_lineno}" if frame else "outside bstcad"
        self.mixed.setdefault(where, what)


def _tensors(values: Any) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors(value)
        elif isinstance(value, dict):
            yield from _tensors(value.values())


def _host(t: Any, least: int = 1) -> bool:
    """A CPU tensor of so many dimensions at least?"""
    return isinstance(t, Tensor) and not on_second(t) and Tensor.dim(t) >= least


def _is_second(device: Any) -> bool:
    return str(device).startswith("cuda")


def _decides(name: str, args: tuple) -> bool:
    """Does a result of marked operands lie on the GPU?  That of indexing lies where what is indexed does."""
    return on_second(args[0]) if name == "__getitem__" else True
