"""The published network, against values worked out from the paper's description and not from the code under test."""

import math

import pytest
import torch

from viinter.fields.paper import PaperField


def by_hand(field: PaperField, xy: torch.Tensor, z: torch.Tensor, layer_norm: bool) -> torch.Tensor:
    """The network written down again: concatenate, then eight times sine and norm, then a linear layer."""
    state = field.state_dict()
    x = torch.cat([xy, z[:, None, :].expand(*xy.shape[:2], -1)], -1)
    names = ["first", *(f"hidden.{k}" for k in range(len(field.hidden)))]
    for name in names:
        x = torch.sin(30 * (x @ state[f"{name}.linear.weight"].T + state[f"{name}.linear.bias"]))
        if layer_norm:
            centred = x - x.mean(-1, keepdim=True)
            x = centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt()
            x = x * state[f"{name}.norm.weight"] + state[f"{name}.norm.bias"]
    return x @ state["rgb.weight"].T + state["rgb.bias"]


def sample(dtype: torch.dtype, m: int = 128) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(3)
    xy = torch.rand(2, 50, 2, generator=random, dtype=torch.float64) * 2 - 1
    z = torch.randn(2, m, generator=random, dtype=torch.float64)
    return xy.to(dtype), (z / z.abs().sum(-1, keepdim=True)).to(dtype)


def test_the_published_network_has_the_number_of_parameters_that_the_supplement_implies():
    # first layer 130 -> 512, seven more 512 -> 512, a LayerNorm (512 + 512) after each of the eight, 512 -> 3
    expected = (130 * 512 + 512) + 7 * (512 * 512 + 512) + 8 * 2 * 512 + (512 * 3 + 3)
    assert sum(p.numel() for p in PaperField(128).parameters()) == expected == 1_915_395
    volumetric = sum(p.numel() for p in PaperField(128, width=256).parameters())
    assert volumetric == (130 * 256 + 256) + 7 * (256 * 256 + 256) + 8 * 2 * 256 + (256 * 3 + 3)


def test_initial_weights_are_uniform_in_sirens_bounds():
    torch.manual_seed(0)
    field = PaperField(128)
    bounds = {
        "first.linear.weight": 1 / 130,
        "first.linear.bias": 1 / math.sqrt(130),
        "hidden.0.linear.weight": math.sqrt(6 / 512) / 30,
        "hidden.6.linear.weight": math.sqrt(6 / 512) / 30,
        "hidden.3.linear.bias": 1 / math.sqrt(512),
        "rgb.weight": math.sqrt(6 / 512) / 30,
    }
    state = field.state_dict()
    for name, bound in bounds.items():
        values = state[name]
        assert values.abs().max() <= bound
        assert values.abs().max() > 0.97 * bound
        # a uniform variable in +-b has standard deviation b / sqrt(3); 6 standard errors of that estimate
        assert values.std().item() == pytest.approx(bound / math.sqrt(3), rel=6 * 0.45 / math.sqrt(values.numel()))
        assert abs(values.mean().item()) < 6 * bound / math.sqrt(3 * values.numel())


@pytest.mark.parametrize("layer_norm", [True, False])
def test_the_output_is_that_of_the_network_written_down_again(layer_norm):
    field = PaperField(128, width=64, layer_norm=layer_norm).double()
    with torch.no_grad():  # a norm that is not the identity
        for name, value in field.named_parameters():
            if "norm" in name:
                value.add_(0.3 * torch.randn_like(value))
    xy, z = sample(torch.float64)
    assert torch.allclose(field(xy, z), by_hand(field, xy, z, layer_norm), atol=1e-10)


def test_float32_agrees_with_float64_in_value_and_in_the_gradient_of_a_training_step():
    torch.manual_seed(1)
    single = PaperField(128)
    double = PaperField(128).double()
    double.load_state_dict(single.state_dict())
    gradients = []
    for field, dtype in ((single, torch.float32), (double, torch.float64)):
        xy, z = sample(dtype)
        z.requires_grad_()
        rgb = field(xy, z)
        loss = (rgb - 0.5).square().mean()
        gradients.append((rgb, *torch.autograd.grad(loss, [z, *field.parameters()])))
    for ours, exact in zip(*gradients, strict=True):
        assert (ours.double() - exact).norm() <= 2e-4 * exact.norm()


def test_a_golden_value_of_a_field_with_stated_weights():
    # every weight and bias 0.01, no norm, M = 2, width 2, depth 2, worked out with a pocket calculator:
    # x1 = sin(30 * (0.01 * (0.5 - 0.25 + 0.2 + 0.3) + 0.01)) = sin(0.525), x2 = sin(30 * (0.01 * 2 sin(0.525) + 0.01))
    field = PaperField(2, width=2, depth=2, layer_norm=False)
    with torch.no_grad():
        for value in field.parameters():
            value.fill_(0.01)
    rgb = field(torch.tensor([[[0.5, -0.25]]]), torch.tensor([[0.2, 0.3]]))
    x2 = math.sin(0.6 * math.sin(0.525) + 0.3)
    assert rgb.flatten().tolist() == pytest.approx([0.02 * x2 + 0.01] * 3, abs=1e-7)
    assert x2 == pytest.approx(0.5652, abs=1e-4)


@pytest.mark.parametrize("case", ["autocast", "weights"])
def test_bfloat16_tells_neighbouring_pixels_of_a_wide_image_apart(case):
    torch.manual_seed(0)
    field = PaperField(8, width=64, depth=2)
    x = -1 + 2 * torch.arange(4096) / 4096
    xy = torch.stack([x, torch.zeros(4096)], -1)[None]
    z = torch.zeros(1, 8)
    seen = []
    field.first.register_forward_hook(lambda *_: None)
    original = field.first.activate
    field.first.activate = lambda argument: seen.append(argument) or original(argument)
    if case == "autocast":
        with torch.autocast("cpu", torch.bfloat16):
            field(xy, z)
    else:
        field.bfloat16()(xy, z)
    argument = seen[0]
    assert argument.dtype == torch.float32
    assert (argument[0, 1:] != argument[0, :-1]).any(-1).all()


def test_one_pixel_gets_the_same_colour_alone_and_among_others():
    field = PaperField(16, width=32, depth=3)
    xy, z = sample(torch.float32, 16)
    assert torch.allclose(field(xy[:, 7:8], z), field(xy, z)[:, 7:8], atol=1e-5)
