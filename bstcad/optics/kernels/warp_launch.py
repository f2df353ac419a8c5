"""Launch of Warp kernels on the tensors of torch.

Warp (NVIDIA, Apache 2.0) translates the Python source of a kernel to C++ and compiles it for the device: for a GPU by
NVRTC, for a CPU by Clang, both of which it contains.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR  # Warp otherwise prints lines about itself, also into JSON on stdout
wp.init()


def has_gpu() -> bool:
    """Return True if Warp finds a GPU."""
    return bool(wp.is_cuda_available())


def launch(kernel: Any, sides: Sequence[int], *arguments: Any) -> None:
    """Launch a kernel of sides[0] x sides[1] … threads on the device of the first tensor, in torch's order of work."""
    device = next(each.device for each in arguments if isinstance(each, Tensor))
    given = [wp.from_torch(each) if isinstance(each, Tensor) else each for each in arguments]
    if device.type == "cuda":
        with torch.cuda.device(device):
            stream = wp.stream_from_torch(torch.cuda.current_stream(device))
            wp.launch(kernel, dim=tuple(sides), inputs=given, stream=stream)
        return
    wp.launch(kernel, dim=tuple(sides), inputs=given, device="cpu")
