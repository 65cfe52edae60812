"""Numbers in memory that several processes see: a policy's weights, and a gradient on its way back."""

from __future__ import annotations

import mmap
import os
from typing import TYPE_CHECKING, Final

import torch

from embomatrix.host.anonymous_memory import nameless_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

_ALIGNED: Final = 64
"""Bytes: a tensor begins where the widest vector instructions want it."""


class SharedTensors:
    """Tensors of the shapes and types of ``like``, in one piece of memory without a name, whose file is ``fd``.

    Without ``fd`` the memory is new and 0.
    """

    def __init__(self, like: Sequence[Tensor], fd: int | None = None) -> None:
        sizes = [each.numel() * each.element_size() for each in like]
        begins = [0]
        for size in sizes:
            begins.append(begins[-1] + -(-size // _ALIGNED) * _ALIGNED)
        self.fd = nameless_file("embomatrix-trainer", begins[-1]) if fd is None else fd
        memory = mmap.mmap(self.fd, begins[-1])
        self.tensors = tuple(
            torch.frombuffer(memory, dtype=each.dtype, count=each.numel(), offset=begin).view(each.shape)
            for each, begin in zip(like, begins, strict=False)
        )

    def close(self) -> None:
        """Let go of the file; the memory lives as long as a tensor does that lies in it."""
        os.close(self.fd)
