"""The model beside its twin in float64: how far values and gradients are off, and what compiling changes.

Notation: the relative error of a vector is |ours - exact| / |exact|, Euclidean; a gradient is one vector over all
weights and codes. The twin has the same weights, codes and batch, to the last bit.
"""

from __future__ import annotations

import copy
import shutil
from contextlib import nullcontext

import torch
from torch import Tensor

from viinter.codes import project
from viinter.config import TrainConfig
from viinter.data import PixelBatch
from viinter.features import interpolation_loss
from viinter.fields.fast import FastField
from viinter.module import ViewInterpolator

VIEWS, SIDE, PIXELS = 4, 64, 512  # of the batch that is compared


def relative(ours: list[Tensor], exact: list[Tensor]) -> float:
    """The relative error of all of `ours`, as one vector, against all of `exact`."""
    apart = sum((a.detach().double() - b.detach().double()).square().sum() for a, b in zip(ours, exact, strict=True))
    return (apart / sum(b.detach().double().square().sum() for b in exact)).sqrt().item()


def model_and_batch(cfg: TrainConfig) -> tuple[ViewInterpolator, PixelBatch]:
    """A float32 model as `cfg` describes it, and random pixels of random views, the same at each call.

    The fast field starts with empty textures; they are filled, and its motion is given the size that it has after
    training, so that there is something to compare.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(cfg.seed)
        model = ViewInterpolator(cfg, VIEWS, {"height": SIDE, "width": SIDE})
        for field in model.field.modules():
            if isinstance(field, FastField):
                field.at(1.0)
                with torch.no_grad():
                    for values in (*field.colours, *field.weights, field.delta, field.bend):
                        values.add_(0.05 * torch.randn_like(values))
        batch = PixelBatch(
            torch.arange(VIEWS), torch.rand(VIEWS, PIXELS, 2) * 2 - 1, torch.rand(VIEWS, PIXELS, 3)
        )
        model.field.see(torch.rand(VIEWS, SIDE, SIDE, 3), model.codes.weight)
    return model, batch


def values_and_gradients(
    model: ViewInterpolator, batch: PixelBatch, mixed: bool = False
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """The colours, the loss of a training step, and its gradients, each as a list; `mixed`: under bfloat16 autocast."""
    with torch.autocast("cpu", torch.bfloat16) if mixed else nullcontext():
        rgb = model(batch.xy, model.codes.weight[batch.view])
        loss = model.training_step(batch, 0)
    weights = list(model.parameters())
    found = torch.autograd.grad(loss, weights, allow_unused=True)
    gradients = [torch.zeros_like(w) if g is None else g for w, g in zip(weights, found, strict=True)]
    return [rgb], [loss], gradients


def field_errors(cfg: TrainConfig) -> dict[str, dict[str, float]]:
    """Relative errors `{"float32": {"value", "loss", "gradient"}, "bf16-mixed": {...}}` against float64."""
    model, batch = model_and_batch(cfg)
    twin = copy.deepcopy(model).double()
    exact = values_and_gradients(twin, PixelBatch(batch.view, batch.xy.double(), batch.rgb.double()))
    found = {}
    for name in ("float32", "bf16-mixed"):
        ours = values_and_gradients(model, batch, name == "bf16-mixed")
        found[name] = dict(zip(("value", "loss", "gradient"), map(relative, ours, exact), strict=True))
    return found


def projection_errors(p: float, radius: float, scale: float) -> dict[str, float]:
    """Relative errors of `codes.project` in float32: of 25 codes of 128 numbers of about `scale`, and of the gradient
    of a random linear function of them."""
    random = torch.Generator().manual_seed(0)
    z, pull = (torch.randn(25, 128, generator=random) for _ in range(2))
    found = []
    for dtype in (torch.float32, torch.float64):
        codes = (z * scale).to(dtype).requires_grad_()
        projected = project(codes, p, radius)
        found.append(([projected], torch.autograd.grad((projected * pull.to(dtype)).sum(), [codes])))
    (value, gradient), (exact, exact_gradient) = found
    return {"value": relative(value, exact), "gradient": relative(list(gradient), list(exact_gradient))}


def interpolation_loss_errors(scale: float) -> dict[str, float]:
    """The same of L_inter, between features of about `scale`."""
    random = torch.Generator().manual_seed(0)
    seen, first, second = (scale * torch.randn(7 * 512, generator=random) for _ in range(3))
    found = []
    for dtype in (torch.float32, torch.float64):
        frame = seen.to(dtype).requires_grad_()
        loss = interpolation_loss(frame, first.to(dtype), second.to(dtype), 0.3)
        found.append(([loss], torch.autograd.grad(loss, [frame])))
    (value, gradient), (exact, exact_gradient) = found
    return {"value": relative(value, exact), "gradient": relative(list(gradient), list(exact_gradient))}


def compiler() -> str | None:
    """The C++ compiler that `torch.compile` needs on the CPU, or None."""
    return shutil.which("g++") or shutil.which("clang++")


def compiled_errors(cfg: TrainConfig) -> dict[str, float]:
    """Relative differences of the field through `torch.compile` from the field as it is, both float32."""
    model, batch = model_and_batch(cfg)
    plain = values_and_gradients(model, batch)
    model.field.forward = torch.compile(model.field.forward)
    compiled = values_and_gradients(model, batch)
    torch.compiler.reset()
    return dict(zip(("value", "loss", "gradient"), map(relative, compiled, plain), strict=True))
