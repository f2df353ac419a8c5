"""Fused or plain: the one place where it is decided."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

ENABLED = True  # tests of the plain forms turn all kernels off
# The sequences that the kernel of forward.py traces from the source to the screen: (is it a net, does it reflect) each.
WHOLE = [(True, True)], [(False, False), (True, False)]


def fused(*tensors: Tensor) -> bool:
    """Do the fused kernels take these tensors: on the CPU, of one dtype, float32 or float64?"""
    first = tensors[0]
    return ENABLED and all(
        t.device.type == "cpu" and t.dtype == first.dtype and t.dtype in (torch.float32, torch.float64) for t in tensors
    )


def fused_whole(interfaces: Sequence[Any]) -> bool:
    """Does one kernel (forward.py) trace rays across all of these Interfaces: a mirror, or a front and a net?"""
    kinds = [(interface.surface.is_net, interface.law.reverses) for interface in interfaces]
    return kinds in WHOLE and fused(interfaces[-1].surface.heights)
