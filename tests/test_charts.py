"""Fast fields around a ring: which charts a code is drawn by, how they are trained, and a small ring that turns."""

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from conftest import WITH_TOWER, Crash, CrashAt, blobs, decibel, fit, random_codes, same, trained, without_times
from hypothesis import given
from hypothesis import strategies as st

from viinter import module
from viinter.codes import lerp
from viinter.fields.charts import STEPS, ChartedField
from viinter.fields.fast import ENOUGH, FastField
from viinter.fields.paper import PaperField
from viinter.train import train
from viinter.views import draw

M = 16


def make(views: int, size: int = 32, window: int = 3, **changes) -> ChartedField:
    torch.manual_seed(0)
    settings = {"layers": 2, "sets": 4, "motion": 6, "margin": 1.1, "texture_pixels": 2**18, "sharpness": 5.0,
                "entropy": 1e-3, "smooth": 2e-3, "consistency": 1.0, "remainder": True} | changes  # fmt: skip
    return ChartedField(M, views, size, size, window, **settings)


def calibrated(views: int, **changes) -> tuple[ChartedField, torch.Tensor]:
    field, codes = make(views, **changes), random_codes(views, M)
    field.calibrate(codes)
    return field, codes.detach()


def holding(view: int, views: int, window: int) -> set[int]:
    return {(view - k) % views for k in range(window)}


def drawn_by(weights: torch.Tensor) -> set[int]:
    return set(weights.nonzero()[:, 0].tolist())


@given(st.integers(5, M), st.integers(2, 4), st.data())
def test_a_known_view_is_drawn_by_the_charts_that_hold_it_and_half_way_by_those_that_hold_both(views, window, data):
    field, codes = calibrated(views, window=window)
    k = data.draw(st.integers(0, views - 1))
    known, half = field.weights(torch.stack([codes[k], lerp(codes[k], codes[(k + 1) % views], 0.5)]))
    assert drawn_by(known) == holding(k, views, window)
    assert known[known > 0].tolist() == pytest.approx([1 / window] * window, abs=1e-5)
    assert drawn_by(half) == holding(k, views, window) & holding((k + 1) % views, views, window)
    assert half.sum() == pytest.approx(1)


@given(st.integers(4, 20), st.floats(-0.5, 1.5), st.data())
def test_charts_fade_in_and_out(views, t, data):
    field, codes = calibrated(views)
    i, j = data.draw(st.lists(st.integers(0, views - 1), min_size=2, max_size=2, unique=True))
    here, beside = field.weights(torch.stack([lerp(codes[i], codes[j], t), lerp(codes[i], codes[j], t + 1e-4)]))
    assert (here - beside).abs().max() < 0.01
    assert here.sum() == pytest.approx(1, abs=1e-5)


def test_finished_known_views_are_reproduced_also_where_the_ring_closes():
    field, codes = calibrated(6)
    views = torch.rand(6, 32, 32, 3)
    field.finish(views, codes)
    field.eval()
    for z, view in zip(codes, views, strict=True):
        assert torch.allclose(draw(field, z, 32, 32), view, atol=2e-3)  # kept in half precision


def test_many_codes_at_once_are_drawn_as_one_by_one():
    field, codes = calibrated(6)
    field.finish(torch.rand(6, 32, 32, 3), codes)
    field.eval()
    z, xy = lerp(codes, codes.roll(-1, 0), 0.3), torch.rand(6, 50, 2) * 2 - 1
    together = field(xy, z)
    assert together.shape == (6, 50, 3)
    for k in range(6):
        assert torch.allclose(together[k], field(xy[k, None], z[k, None])[0], atol=1e-6)


def test_a_step_trains_one_chart_on_its_own_views_and_leaves_the_codes():
    """Each view has a colour of its own, so that the loss says which views were looked at."""
    field, codes = make(5, consistency=0.0, smooth=0.0, entropy=0.0), random_codes(5, M)
    field.calibrate(codes)
    colours = torch.arange(5.0)[:, None, None, None].expand(5, 32, 32, 3)
    field.see(colours, codes)
    view = torch.arange(32) % 3
    xy = torch.stack(torch.meshgrid(torch.arange(32), torch.arange(32), indexing="xy"), -1) / 16 - 1
    for step in range(10):
        field.at(0.0, step)
        field.zero_grad()
        loss = field.loss(view, xy, colours[view, 0], codes)
        loss.backward()
        # textures are empty at first: every pixel is drawn as 0.5
        held, count = torch.tensor([(step + k) % 5 for k in range(3)]), torch.bincount((view + step // 5) % 3)
        assert loss.item() == pytest.approx(((held - 0.5) ** 2 * count).sum().item() / 32, rel=1e-5)
        assert [chart.disparity.grad is not None for chart in field.charts] == [k == step % 5 for k in range(5)]
    groups = field.parameter_groups(codes)
    assert len(groups) == len(field.rates())
    assert groups[-1]["params"] == [codes]
    assert groups[-1]["share"] == 0
    assert sorted(map(id, field.parameters())) == sorted(id(p) for group in groups[:-1] for p in group["params"])


@pytest.mark.parametrize(("texture_pixels", "side"), [(4 * 64**2, 64), (4 * 64**2 - 4, 32)])
def test_the_textures_of_charts_are_smaller_from_a_quarter_of_the_pixels_on(texture_pixels, side):
    field = make(4, 64, texture_pixels=texture_pixels, margin=1.0)
    assert field.charts[0].colours[-1].shape[-2:] == (side, side)


def test_enough_is_counted_for_each_chart():
    field = make(8)
    assert field.enough(0.1) == 8 * STEPS
    assert field.enough(1000.0) == ENOUGH[1] * 3 * 1000
    assert field.settle(100.0, 8, 1.0, lambda: 0.1) == pytest.approx(8 * 0.1 * 17 / 8)


@pytest.mark.parametrize(
    ("layout", "window", "views", "kind"),
    [("studio", None, 9, 3), ("studio", 4, 9, 4), ("studio", 9, 9, None), ("studio", None, 3, None),
     ("planar", None, 9, None), ("folder", 2, 9, 2)],
)  # fmt: skip
def test_a_ring_has_charts_and_any_scene_that_asks_for_them(make_config, layout, window, views, kind):
    field = module.make_field(make_config(layout, model="fast", **{"model.window": window}), views, 16, 16)
    if kind is None:
        assert isinstance(field, FastField)
        assert len(field.places) == views
    else:
        assert isinstance(field, ChartedField)
        assert field.window == kind
        assert len(field.charts) == views
    assert isinstance(module.make_field(make_config(layout), views, 16, 16), PaperField)


@pytest.mark.parametrize(
    ("layout", "views", "settings", "shape"),
    [("planar", 9, {}, (4, 4)), ("llff", 9, {}, (2, 8)), ("folder", 5, {}, (2, 8)), ("folder", 4, {}, (4, 4)),
     ("pair", 2, {}, (4, 4)), ("folder", 9, {"model.window": 3}, (1, 4)), ("studio", 9, {}, (1, 4)),
     ("llff", 9, {"model.layers": 3}, (2, 3)), ("llff", 9, {"model.sets": 3}, (3, 8)),
     ("planar", 9, {"model.layers": 8, "model.sets": 1}, (1, 8))],
)  # fmt: skip
def test_photographs_by_hand_have_fewer_and_deeper_sets(make_config, layout, views, settings, shape):
    field = module.make_field(make_config(layout, model="fast", **settings), views, 16, 16)
    one = field.charts[0] if isinstance(field, ChartedField) else field
    assert (one.sets, one.layers) == shape


def test_a_ring_that_was_stopped_goes_on_as_if_nothing_had_been(make_config, tmp_path):
    """At step 11 of 9 charts: in the second round."""
    cfg = make_config("studio", model="fast", **{"optim.steps": 30, "checkpoint.every_seconds": 1e-9})
    with pytest.raises(Crash):
        train(cfg, tmp_path / "stopped", more_callbacks=[CrashAt(11)])
    found, straight = train(cfg, tmp_path / "stopped", resume=True), train(cfg, tmp_path / "straight")
    assert without_times(found) == without_times(straight)
    assert same(trained(tmp_path / "stopped"), trained(tmp_path / "straight"))
    assert found["known"]["psnr"] > 40
    assert isinstance(module.load(tmp_path / "stopped").field, ChartedField)


def test_the_interpolation_step_draws_mixes_that_no_chart_holds(make_config, fake_tower, tmp_path):
    found = train(make_config("studio", model="fast", **{**WITH_TOWER, "optim.steps": 12}), tmp_path / "run")
    alone = train(make_config("studio", model="fast", **{"optim.steps": 12}), tmp_path / "alone")
    assert found["known"]["psnr"] > 40
    assert found["novel"] != alone["novel"]


def pillar(k: float, n: int, size: int) -> torch.Tensor:
    """View [size, size, 3] number k of n around a pillar with a picture around it; half of it is seen in each."""
    around = blobs(64, 128, 0).repeat(1, 1, 2)[..., :192]
    turn = (torch.asin(torch.linspace(-0.999, 0.999, size)) / (2 * math.pi) + k / n) % 1
    x, y = torch.meshgrid(turn * 128 * 2 / 191 - 1, torch.linspace(-1, 1, size), indexing="xy")
    return F.grid_sample(around[None], torch.stack([x, y], -1)[None], align_corners=True)[0].movedim(0, -1)


@pytest.fixture(scope="module")
def ring():
    """A field that has learned 12 views of the pillar, 64 x 64; the views, and their codes."""
    codes, views = random_codes(12, M), torch.stack([pillar(k, 12, 64) for k in range(12)])
    field = make(12, 64)
    fit(field, views, codes, steps=60 * 12)
    return field, views, codes.detach()


def test_a_ring_that_turns_is_learned_and_its_unseen_views_are_drawn_not_cross_faded(ring):
    field, views, codes = ring
    gain = []
    for k in range(12):
        following, true = (k + 1) % 12, pillar(k + 0.5, 12, 64)
        drawn = draw(field, lerp(codes[k], codes[following], 0.5), 64, 64)
        gain.append(decibel(drawn, true) - decibel((views[k] + views[following]) / 2, true))
    assert min(gain) > 0.5
    assert sum(gain) / 12 > 2


def test_of_charts_that_overlap_one_whose_motion_is_wrong_counts_little(ring):
    field, views, codes = copy.deepcopy(ring[0]), *ring[1:]
    z, true = lerp(codes[3], codes[4], 0.5), pillar(3.5, 12, 64)
    right, wrong = field.charts[2], field.charts[3]  # both hold views 3 and 4
    with torch.no_grad():
        wrong.shift.neg_()
    field.finish(views, codes)
    drawn, alone, other = (decibel(draw(each, z, 64, 64), true) for each in (field, right, wrong))
    mean = decibel((draw(right, z, 64, 64) + draw(wrong, z, 64, 64)) / 2, true)
    assert other < alone - 3
    assert drawn > mean + 1
    assert torch.allclose(draw(field, codes[4], 64, 64), views[4], atol=2e-3)


def test_how_far_known_views_are_from_those_beside_them_is_kept():
    """Of one colour each, motion does not matter; a row has two ends."""
    field, codes = calibrated(4, consistency=0.0)
    levels = torch.tensor([0.1, 0.2, 0.5, 0.9])
    field.finish(levels[:, None, None, None].expand(4, 32, 32, 3), codes)
    first = field.charts[0].remainder[:, 3].float()  # views 0, 1 and 2
    expected = torch.tensor([0.01, (0.01 + 0.09) / 2, 0.09]).sqrt()
    assert torch.allclose(first, expected[:, None, None].expand_as(first), atol=1e-3)
