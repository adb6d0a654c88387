"""A loss and its gradients as a CUDA graph, so that a GPU need not wait for Python to ask for each small kernel.

A step of the fast field is some 350 kernels. At 256x256 they keep an H100 busy for a ninth of the time that it takes to
ask for them one by one (docs/fast.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

WARM_UP = 3  # runs before capture, in which libraries set themselves up


class ReplayedLoss:
    """`loss(*inputs)`, captured once with its gradients for `weights`, and replayed on other inputs of those shapes.

    Everything but the inputs must stay where it is: the weights change in place, buffers too, and what Python decides
    is decided at capture. See "CUDA graphs" in PyTorch's documentation for what can be captured.

    Args:
        loss: of the inputs, a scalar; draws nothing at random, and does not wait for the device.
        weights: leaves that get a gradient; those that take no part get none.
        inputs: an example, on the GPU; not kept.
    """

    def __init__(self, loss: Callable[..., Tensor], weights: Sequence[Tensor], inputs: Sequence[Tensor]) -> None:
        self.weights, self.inputs = list(weights), [tensor.clone() for tensor in inputs]
        self.graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()

        def run() -> tuple[Tensor, tuple[Tensor | None, ...]]:
            found = loss(*self.inputs)
            return found.detach(), torch.autograd.grad(found, self.weights, allow_unused=True)

        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                run()
        torch.cuda.current_stream().wait_stream(stream)
        with torch.cuda.graph(self.graph, stream=stream):
            self.loss, self.gradients = run()

    def __call__(self, *inputs: Tensor) -> Tensor:
        """The loss, with gradients to the weights."""
        for own, new in zip(self.inputs, inputs, strict=True):
            own.copy_(new)
        self.graph.replay()
        return _Loss.apply(self, *self.weights)


class _Loss(torch.autograd.Function):
    """The last replay's loss, which the next one overwrites, and its gradients."""

    @staticmethod
    def forward(ctx: Any, replayed: ReplayedLoss, *weights: Tensor) -> Tensor:
        ctx.gradients = replayed.gradients
        return replayed.loss.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        there = [own for own in ctx.gradients if own is not None]
        scaled = iter(torch._foreach_mul(there, gradient))
        return None, *(None if own is None else next(scaled) for own in ctx.gradients)
