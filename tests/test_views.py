"""Drawing and measuring, with a field that is known in closed form."""

import pytest
import torch

from viinter.config import Layout, UserError
from viinter.scenes import Probe, Scene
from viinter.views import draw, measure, pixel_grid


class Ramp(torch.nn.Module):
    """rgb = (x, y, z_0), so that every pixel tells where and under which code it was drawn."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[int] = []

    def forward(self, xy: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        self.calls.append(xy.shape[1])
        return torch.cat([xy, z[:, None, :1].expand(-1, xy.shape[1], -1)], -1)


def test_pixel_j_of_w_sits_at_minus_one_plus_two_j_over_w_x_first():
    grid = pixel_grid(2, 4)
    assert grid[:4].tolist() == [[-1, -1], [-0.5, -1], [0, -1], [0.5, -1]]
    assert grid[4].tolist() == [-1, 0]


def test_a_view_is_the_same_in_chunks_and_no_chunk_is_larger_than_asked():
    field, z = Ramp(), torch.tensor([0.3, 0.0])
    whole = draw(field, z, 20, 12, 1000)
    field.calls.clear()
    parts = draw(field, z, 20, 12, 30)
    assert torch.equal(whole, parts)
    assert whole.shape == (20, 12, 3)
    assert max(field.calls) <= 30
    assert torch.allclose(whole[3, 5], torch.tensor([-1 + 10 / 12, -1 + 6 / 20, 0.3]), atol=1e-6)


def test_measure_draws_known_views_from_their_codes_and_probes_from_their_mixes():
    field = Ramp()
    codes = torch.tensor([[0.2], [0.8]])
    base = draw(field, torch.tensor([0.0]), 16, 16).clamp(0, 1)

    def view(value: float) -> torch.Tensor:
        image = base.clone()
        image[..., 2] = value
        return image

    probes = {"novel": [Probe(view(0.35), ((0, 0.75), (1, 0.25)), "between.png")]}
    scene = Scene(
        name="ramp", layout=Layout.folder, views=torch.stack([view(0.2), view(0.8)]), names=["a.png", "b.png"],
        probes=probes, left_out={"novel": 0}, white=1.0, endpoints=(0, 1), notes=[],
    )  # fmt: skip
    seen = []
    found = measure(field, codes, scene, seen=lambda kind, k, *_: seen.append((kind, k)))
    assert list(found["known"]["per_view"]) == ["a.png", "b.png"]
    assert found["known"]["mse"] < 1e-12
    assert found["novel"]["mse"] < 1e-12
    assert seen == [("known", 0), ("known", 1), ("novel", 0)]
    some = measure(field, codes, scene, every=2)
    assert list(some["known"]["per_view"]) == ["b.png"]
    assert some["novel"] == found["novel"]
    assert len(measure(field, codes, scene, every=100)["known"]["per_view"]) == 1
    probes["novel"][0].target += 0.1
    assert measure(field, codes, scene, ["novel"])["novel"]["mse"] > 1e-3


class Hungry(torch.nn.Module):
    """Asks for more memory than there is for more than `most` pixels at a time."""

    def __init__(self, most):
        super().__init__()
        self.most, self.drawn = most, []

    def forward(self, xy, z):
        if xy.shape[1] > self.most:
            torch.empty(2**60, dtype=torch.uint8)
        self.drawn.append(xy.shape[1])
        return torch.cat([xy, xy[..., :1]], -1)


def test_if_memory_runs_out_half_as_many_rows_are_drawn_at_a_time():
    plain, hungry = Hungry(10**6), Hungry(70)
    expected = draw(plain, torch.zeros(3), 33, 20)
    assert torch.equal(draw(hungry, torch.zeros(3), 33, 20, chunk_pixels=300), expected)
    assert hungry.drawn == [60] * 11
    with pytest.raises(UserError, match="out of memory: one row of 20 pixels"):
        draw(Hungry(19), torch.zeros(3), 33, 20)


def test_other_errors_of_a_field_pass_through():
    def broken(xy, z):
        raise RuntimeError("shapes do not fit")

    with pytest.raises(RuntimeError, match="shapes do not fit"):
        draw(broken, torch.zeros(3), 4, 4)
