"""The published field: a SIREN over pixel coordinates and code, with a LayerNorm after each sine.

Notation: `V` codes at once, `P` pixels under each, `M` the length of a code, `h` the width, `omega` the sine frequency.
Layer k computes `LayerNorm(sin(omega (W x + b)))`; the first sees `[xy, z]` together, the last is linear to rgb.

Supplement, Training Details, gives eight layers of 512 (256 for volumetric scenes) in the SIREN of Sitzmann et al.
2020, whose initialisation is used. The LayerNorm is only in the authors' published code. That code makes a ninth layer
too and never uses it; here it is left out.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from viinter.fields.field import Field


class SineLayer(nn.Module):
    """`sin(omega (W x + b))`, then a LayerNorm if asked; [..., inputs] -> [..., outputs].

    `W` is uniform in +-1/inputs for the first layer and +-sqrt(6/inputs)/omega for the others (SIREN, Section 3.2),
    `b` uniform in +-1/sqrt(inputs) (PyTorch's default). The sine is taken in float32 or better in every precision.
    """

    def __init__(self, inputs: int, outputs: int, omega: float, layer_norm: bool, first: bool = False) -> None:
        super().__init__()
        self.omega = omega
        self.linear = nn.Linear(inputs, outputs)
        bound = 1 / inputs if first else math.sqrt(6 / inputs) / omega
        nn.init.uniform_(self.linear.weight, -bound, bound)
        self.norm = nn.LayerNorm(outputs) if layer_norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        # omega scales the small weight matrix instead of the large activation
        return self.activate(F.linear(x, self.omega * self.linear.weight, self.omega * self.linear.bias))

    def activate(self, argument: Tensor) -> Tensor:
        """The sine of `argument` and the norm."""
        sine = torch.sin(argument.to(torch.promote_types(argument.dtype, torch.float32)))
        return self.norm(sine.to(self.linear.weight.dtype))


class PaperField(Field):
    """The field F(xy | z) -> rgb of the paper, Section 3.1 and 3.2, with the supplement's sizes."""

    def __init__(
        self,
        code_dim: int,
        width: int = 512,
        depth: int = 8,
        first_omega: float = 30.0,
        hidden_omega: float = 30.0,
        layer_norm: bool = True,
    ) -> None:
        super().__init__()
        self.first = SineLayer(2 + code_dim, width, first_omega, layer_norm, first=True)
        self.hidden = nn.ModuleList(SineLayer(width, width, hidden_omega, layer_norm) for _ in range(depth - 1))
        self.rgb = nn.Linear(width, 3)
        bound = math.sqrt(6 / width) / hidden_omega
        nn.init.uniform_(self.rgb.weight, -bound, bound)

    def forward(self, xy: Tensor, z: Tensor) -> Tensor:
        """Colours [V, P, 3] of the pixels `xy` [V, P, 2] in [-1, 1) under the codes `z` [V, M]; not clamped.

        The first layer's product is split into its share of xy and its share of z, which is the same for all pixels
        under a code and is worked out once. Both shares are float32 in every precision (bfloat16 has 8 bits: two
        pixels of a wide image would be one).
        """
        layer = self.first.linear
        with torch.autocast(xy.device.type, enabled=False):
            dtype = torch.promote_types(layer.weight.dtype, torch.float32)
            weight = self.first.omega * layer.weight.to(dtype)
            code_share = F.linear(z.to(dtype), weight[:, 2:], self.first.omega * layer.bias.to(dtype))
            x = self.first.activate(F.linear(xy.to(dtype), weight[:, :2]) + code_share[:, None, :])
        for sine in self.hidden:
            x = sine(x)
        return self.rgb(x)

    def stage(self) -> int:
        return 0
