"""The fast field: motion, levels, remainders, and a small scene that moves."""

import copy
import math
import pickle

import pytest
import torch
from conftest import blobs, decibel, fit, random_codes
from hypothesis import given
from hypothesis import strategies as st

from viinter.codes import lerp
from viinter.fields import fast
from viinter.fields.fast import FastField, best_shares, principal
from viinter.fields.maps import CONTRAST, look_up, normalized
from viinter.views import draw, pixel_grid

M = 8


def make(height: int = 64, width: int = 64, views: int = 2, code_dim: int = M, **changes) -> FastField:
    torch.manual_seed(0)
    settings = {"layers": 3, "sets": 2, "motion": 6, "margin": 1.1, "texture_pixels": 2**18, "sharpness": 5.0,
                "entropy": 1e-3, "smooth": 0.0, "consistency": 1.0, "remainder": True} | changes  # fmt: skip
    return FastField(code_dim, views, height, width, **settings)


def one_set(field: FastField, k: int) -> FastField:
    """Set number k of `field` as a field of its own."""
    sets, layers = field.sets, field.layers
    one = make(sets=1, layers=layers, entropy=field.entropy)
    one.level, of_a_set = field.level, ("colours", "weights", "delta", "disparity", "shift", "bend", "phase")
    for key, value in one.state_dict().items():
        if key.startswith(of_a_set):
            value.copy_(field.state_dict()[key].unflatten(0, (sets, -1))[k])
    return one


def scramble(field: FastField) -> FastField:
    with torch.no_grad():
        for value in field.parameters():
            value.add_(0.05 * torch.randn_like(value))
    return field


def penalty(field: FastField) -> torch.Tensor:
    """Of a field that has not seen the known views, so that it compares nothing."""
    return field.penalty(torch.zeros(0), torch.zeros(0), torch.zeros(0))


def test_motion_is_linear_in_the_code_so_that_a_mix_moves_half_way():
    field = scramble(make())
    z = torch.randn(2, M)
    phi = field.basis(pixel_grid(8, 8).T[None])
    ends = field.carry(phi.expand(2, -1, -1), field.place(z))
    middle = field.carry(phi, field.place(z.mean(0, keepdim=True)))
    for end, half in zip(ends, middle, strict=True):
        assert torch.allclose(half[:, 0], end.mean(1), atol=1e-6)


def test_drift_begins_across_parallax_so_that_both_together_reach_everywhere():
    field = make()
    with torch.no_grad():
        field.shift[:, 2:] = 0  # what b and c differ by
    a, b, c = field.carry(field.basis(pixel_grid(8, 8).T[None]), field.place(torch.randn(1, M)))
    assert torch.allclose(a, b)
    assert torch.allclose((b * c).sum(2), torch.zeros(()), atol=1e-7)
    assert torch.allclose(b.norm(dim=2), c.norm(dim=2).expand(-1, -1, 64))


@given(st.integers(1, 5), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_looking_up_between_pixels_is_bilinear_and_ends_at_the_border(height, width, seed):
    random = torch.Generator().manual_seed(seed)
    views = torch.rand(3, height, width, 3, generator=random)
    which = torch.randint(3, (4,), generator=random)
    at = (torch.rand(2, 4, 2, 7, generator=random) * 1.4 - 0.2) * torch.tensor([[width], [height]])
    for sets, found in zip(at, look_up(views, which, at), strict=True):
        for image, where, colours in zip(views[which], sets, found, strict=True):
            size = torch.tensor([[width], [height]])
            grid = ((where + 0.5) / size * 2 - 1).T[None, None]
            expected = torch.nn.functional.grid_sample(
                image.movedim(-1, 0)[None], grid, padding_mode="border", align_corners=False
            )
            assert torch.allclose(colours, expected[0, :, 0].T, atol=1e-5)


def disagreement(field: FastField, views: torch.Tensor, slide: float) -> torch.Tensor:
    """That of the two `views` [2, 128, 128, 3] if all that is seen in the first is `slide` pixels to the left in the
    second."""
    codes = torch.nn.Parameter(torch.stack([torch.zeros(M), torch.eye(M)[0]]))
    field.see(views, codes)
    rows = pixel_grid(128, 128).view(128, 128, 2)[::16]
    view = torch.arange(8) // 4
    with torch.no_grad():
        field.shift.zero_()
        field.bend.zero_()
        field.disparity.zero_()
        field.shift[:, 0, 0] = slide * 2 / 128
    field(rows, codes[view])
    return field.disagreement(view, views[view, 16 * torch.arange(8)], codes)


@pytest.mark.parametrize(("progress", "texture_pixels"), [(0.0, 128**2), (0.2, 128**2), (1.0, 128**2), (1.0, 64**2)])
def test_known_views_agree_where_the_motion_is_right_and_disagree_where_it_is_not(
    progress, texture_pixels, monkeypatch
):
    """Two views of a smooth picture that slides by 8 pixels, at 32, 64, 128 and 64 of their 128 pixels."""
    monkeypatch.setattr(fast, "FEW", 1)  # textures are still empty
    field = make(128, 128, texture_pixels=texture_pixels)
    wide = torch.sin(torch.arange(136) / 20)[:, None, None].expand(-1, 128, 3).transpose(0, 1) / 2 + 0.5
    views = torch.stack([wide[:, :128], wide[:, 8:]])  # a thing at x in the first is at x - 8 in the second
    field.at(progress)
    right, still, wrong = (disagreement(field, views, slide) for slide in (8.0, 0.0, -8.0))
    assert right < 0.02 * still
    assert still < wrong
    still = disagreement(field, views, 6.0)
    still.backward()
    assert (field.shift.grad[:, 0, 0] < 0).all()  # more of it would be better


def test_normalized_views_agree_under_another_light(monkeypatch):
    """The picture slides by 8 pixels, and the second view of it has half the light, and the sun somewhere else."""
    monkeypatch.setattr(fast, "FEW", 1)
    wide = blobs(128, 136, 0, apart=4).movedim(0, -1)
    shade = 0.3 * torch.linspace(0, 1, 128)[:, None, None] ** 2
    views = torch.stack([wide[:, :128], 0.5 * wide[:, 8:] + shade])
    right, still = (disagreement(make(128, 128, normalize=True), views, slide) for slide in (8.0, 0.0))
    assert right < 0.05 * still
    right, still = (disagreement(make(128, 128), views, slide) for slide in (8.0, 0.0))
    assert right > 0.5 * still  # colours say little


@given(st.floats(0.5, 2.0), st.floats(-1.0, 1.0), st.integers(0, 2**32 - 1))
def test_normalized_colours_have_one_contrast_whatever_the_light(gain, offset, seed):
    views = torch.rand(2, 9, 12, 3, generator=torch.Generator().manual_seed(seed))
    found = normalized(views)
    assert found.square().mean().sqrt().item() == pytest.approx(CONTRAST, rel=0.2)
    assert (normalized(gain * views + offset) - found).square().mean().sqrt() < 0.1 * CONTRAST
    assert normalized(torch.full((1, 5, 5, 3), offset)).abs().max() < 0.01 * CONTRAST  # nothing to be seen


def test_between_two_views_a_colour_of_either_is_right_and_no_other():
    """Textures are 0.5 all over, and nothing moves."""
    field, codes = make(), torch.randn(2, M)
    torch.nn.init.zeros_(field.shift)
    xy = pixel_grid(64, 64).T[None]
    phi, places = field.basis(xy), field.place(codes)
    field.step.fill_(1)

    def between(*colours: float) -> torch.Tensor:
        field.see(torch.tensor(colours).view(2, 1, 1, 1).expand(2, 64, 64, 3), codes)
        field.kept.clear()
        return field.between(torch.tensor([0]), torch.tensor([1]), xy, phi, places)

    assert between(0.5, 0.5) == between(0.5, 0.9) == between(0.2, 0.5) == 0
    assert 0 < between(0.6, 0.7) < between(0.7, 0.7)
    between(0.6, 0.7).backward()
    assert (field.colours[-1].grad.sum((2, 3)) < 0).all()  # brighter would be better


@pytest.mark.parametrize("count", [2, 4, 5])
def test_only_few_known_views_have_mixes_held_to_them(count, monkeypatch):
    drawn = []
    inner = FastField.between
    monkeypatch.setattr(FastField, "between", lambda *a: drawn.append(a) or inner(*a))
    field, codes, views = make(views=count), torch.randn(count, M), torch.rand(count, 64, 64, 3)
    field.see(views, codes)
    view = torch.arange(count)
    field(pixel_grid(64, 64).expand(count, -1, -1), codes)
    assert field.penalty(view, views.flatten(1, 2), codes) > 0
    assert len(drawn) == (count <= 4)


def test_what_nothing_is_seen_of_is_not_compared():
    """A single view has no partner; with consistency=0 no view has one."""
    for field, views in ((make(), torch.rand(1, 64, 64, 3)), (make(consistency=0.0), torch.rand(2, 64, 64, 3))):
        codes = torch.randn(len(views), M)
        field.see(views, codes)
        field(pixel_grid(64, 64)[None], codes[:1])
        alone = field.held.detach()
        assert torch.equal(field.penalty(torch.zeros(1).long(), views[:1].flatten(1, 2), codes), alone)


def from_a_grid(side: int, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Views [side^2, 64, 64, 3] of one blob that moves by `step` pixels between neighbours, and where [side^2, 2]."""
    places = torch.cartesian_prod(torch.arange(side), torch.arange(side)).float() - (side - 1) / 2
    x = torch.arange(64.0) - 31.5
    column, row = (torch.exp(-((x - step * at[:, None]) ** 2) / 200) for at in places.unbind(1))
    return (row[:, :, None] * column[:, None])[..., None].expand(-1, -1, -1, 3), places


@given(n=st.integers(5, 12), dim=st.integers(1, 4), seed=st.integers(0, 2**16))
def test_principal_coordinates_are_those_of_the_directions_in_which_points_differ(n, dim, seed):
    """As many as have a tenth of the first one's variance, three at least."""
    random = torch.Generator().manual_seed(seed)
    inner = torch.linalg.qr(torch.randn(n, dim, generator=random).double()).Q
    inner = inner - inner.mean(0)
    turned = inner @ torch.linalg.qr(torch.randn(9, dim, generator=random).double()).Q.T
    places = principal(turned + torch.randn(9, generator=random))
    variances = torch.linalg.svdvals(inner).square()
    assert places.shape[1] == max(3, (variances > 0.1 * variances[0]).sum())
    assert places.square().sum(1).mean() == pytest.approx(1)
    if dim <= 3:  # all distances are kept, up to one factor
        apart, expected = torch.pdist(places), torch.pdist(inner)
        assert torch.allclose(apart / apart.norm(), expected / expected.norm(), atol=1e-6)


def test_principal_coordinates_of_points_that_are_all_alike_are_nothing():
    assert not principal(torch.full((5, 7), 0.3)).any()


def trying(side: int) -> tuple[FastField, torch.nn.Parameter, torch.Tensor, torch.Tensor]:
    """A field that begins to try motions for views `from_a_grid`; their codes, they themselves, and where they are."""
    field, codes = make(views=side**2, code_dim=32), random_codes(side**2, 32)
    views, places = from_a_grid(side, 1.0)
    field.calibrate(codes)
    field.see(views, codes)
    field.at(0.0, 0)
    field.at(1e-3, 1)
    assert field.trying
    return field, codes, views, places


@pytest.mark.parametrize("side", [3, 5])
def test_motions_that_are_tried_begin_linear_in_where_views_are_from(side):
    """Nobody says where: it is seen in the views themselves."""
    field, codes, _, places = trying(side)
    linear = torch.cat([places, torch.ones(len(places), 1)], 1)
    motion = field.trials.place(codes).detach().flatten(1)
    left = motion - linear @ torch.linalg.lstsq(linear, motion).solution
    assert left.square().mean() < 0.02 * motion.square().mean()


def test_the_motion_is_held_to_what_the_views_say_until_disparities_are_maps():
    field, codes, *_ = trying(3)
    inside = field.span @ field.span.T
    assert field.span.shape == (32, 3)
    for own in (field, field.trials):
        scramble(own)
        assert torch.allclose(own.place(codes), own.place(codes @ inside), atol=1e-6)
    for step in range(2, 23):
        was = field.trials.shift.detach().clone()
        field.at(1e-3 * step, step)
        assert torch.allclose(field.trials.shift, was @ inside, atol=1e-6)
    assert not field.trying
    for progress, step, held in ((0.03, 100, True), (0.99, 1000, True), (0.99, 1001, False)):  # maps begin at 1000
        was = scramble(field).shift.detach().clone()
        field.at(progress, step)
        assert torch.allclose(field.shift, was @ inside, atol=1e-6) == held
    assert not torch.allclose(field.place(codes), field.place(codes @ inside), atol=1e-6)


def test_where_trials_go_on_and_of_few_views_motions_stay_as_they_are():
    field, codes, views, _ = trying(3)
    new = make(views=9, code_dim=32)
    new.load_state_dict(field.state_dict())
    assert torch.equal(new.span, field.span)
    was = new.trials.shift.detach().clone()
    new.see(views, codes)
    new.at(2e-3, 2)
    assert new.trying
    assert torch.allclose(new.trials.shift, was, atol=1e-6)
    few = make(views=4, code_dim=32)
    few.see(views[:4], codes[:4])
    few.at(1e-3, 1)
    assert few.trying
    assert few.span is None


def test_norm_and_radius_of_the_codes_do_not_matter():
    field, z = scramble(make()), torch.randn(2, M)
    xy = pixel_grid(8, 8).expand(2, -1, -1)
    field.calibrate(z)
    one = field(xy, z)
    field.calibrate(1000 * z)
    assert torch.allclose(field(xy, 1000 * z), one, atol=1e-5)


@pytest.mark.parametrize(("height", "width", "levels"), [(64, 64, 2), (256, 300, 4), (32, 32, 1), (5, 7, 1), (1, 9, 1)])
def test_the_coarsest_level_has_about_32_pixels_and_the_finest_those_of_a_view(height, width, levels):
    field = make(height, width)
    assert len(field.colours) == levels
    assert field.colours[-1].shape[-2:] == (max(2, round(1.1 * height)), max(2, round(1.1 * width)))
    assert torch.isfinite(draw(field, torch.randn(M), height, width)).all()


@pytest.mark.parametrize(("texture_pixels", "share"), [(200 * 300, 1), (200 * 300 - 1, 2), (4000, 4), (1, 8)])
def test_larger_views_have_smaller_textures_down_to_the_coarsest(texture_pixels, share):
    whole, field = make(200, 300), make(200, 300, texture_pixels=texture_pixels)
    assert field.colours[-1].shape[-2:] == (round(220 / share), round(330 / share))
    assert field.colours[0].shape == whole.colours[0].shape
    assert field.rates() == [r if r == 1 else r * share for r in whole.rates()]
    assert torch.isfinite(draw(field, torch.randn(M), 200, 300)).all()


@pytest.mark.parametrize("size", [32, 64, 128, 256, 1024])
def test_levels_go_from_coarse_to_fine_and_the_finest_has_seven_tenths_of_the_budget(size):
    field = make(size, size, views=0, layers=1)
    seen = []
    for k in range(1001):
        field.at(k / 1000)
        seen.append(field.level)
    assert seen == sorted(seen)
    assert set(seen) == set(range(len(field.colours)))
    finest = seen.count(len(field.colours) - 1) / 1001
    assert finest == pytest.approx(1.0 if size == 32 else 0.7, abs=0.01)


def test_in_long_runs_coarse_levels_end_after_so_many_steps():
    field = make(256, 256, views=0, layers=1)
    first = {}
    for step in range(20_000):
        field.at(step / 20_000, step)
        first.setdefault(field.level, step)
    assert first == {0: 0, 1: 120, 2: 220, 3: 520}
    field.at(0.33, 400)  # in a short one they end by their share of the budget
    assert field.level == 3


@pytest.mark.parametrize(
    ("steps", "first"),
    [(1000, {0: 0, 1: 80, 2: 140, 3: 320}), (64, {0: 0, 1: 10, 2: 20, 3: 35}), (32, {0: 0, 1: 7, 2: 13, 3: 21})],
)
def test_in_short_budgets_coarse_levels_have_a_larger_share(steps, first):
    """In 64 steps those that they are to have at least; in 32 the shares that they may have at most. In 1000 there are
    trials before, of 20 steps."""
    field, found = make(256, 256, views=0, layers=1), {}
    for step in range(steps):
        field.at(step / steps, step)
        found.setdefault(field.level, step)
    assert found == first


def test_enough_are_so_many_steps_and_so_many_passes():
    field = make(views=0)
    assert [field.enough(steps_per_pass) for steps_per_pass in (0.1, 25, 25.5, 100)] == [1500, 1500, 1530, 6000]


def test_only_the_level_in_training_gets_a_gradient_and_whatever_moves_slows_down():
    field = make(128, 128)
    xy, z = torch.rand(2, 50, 2) * 2 - 1, torch.randn(2, M)
    for progress, level in ((0.0, 0), (0.2, 1), (0.9, 2)):
        field.zero_grad(set_to_none=True)
        field.at(progress)
        (field(xy, z).square().mean() + penalty(field)).backward()
        assert field.level == level
        assert [k for k, texture in enumerate(field.colours) if texture.grad is not None] == [level]
        assert field.rates()[2:] == [0.5**level] * 3


def test_the_groups_hold_every_parameter_once_and_match_the_rates():
    field, codes = make(), torch.nn.Parameter(torch.randn(2, M))
    field.calibrate(codes)
    groups = field.parameter_groups(codes)
    held = [id(p) for group in groups for p in group["params"]]
    assert sorted(held) == sorted(id(p) for p in [*field.parameters(), codes])
    assert len(field.rates()) == len(groups)


def test_the_penalty_is_greatest_undecided_and_nothing_once_each_pixel_has_one_layer():
    field = make(entropy=1.0, layers=4)
    xy, z = torch.rand(1, 50, 2) * 2 - 1, torch.randn(1, M)
    field.at(1.0)
    field(xy, z)
    assert penalty(field).item() == pytest.approx(1 - 1 / 4, abs=1e-6)
    with torch.no_grad():
        field.weights[-1][[1, 6]] = 10.0  # one of each set
    field(xy, z)
    assert penalty(field).item() == pytest.approx(0, abs=1e-6)


def test_textures_of_sets_lie_half_a_pixel_apart():
    """Four sets that have the same layers and do not move show the same, each at its own place."""
    field, z = scramble(make(48, 64, sets=4)), torch.randn(1, M)
    with torch.no_grad():
        for own in (field.shift, field.bend):
            own.zero_()
        for maps in (*field.colours, *field.weights, field.delta, field.disparity):
            each = maps.unflatten(0, (4, -1))
            each.copy_(each[:1].clone().expand_as(each))
    xy = 1.6 * torch.rand(1, 2, 50) - 0.8
    pixel = field.margin * 2 / torch.tensor(field.colours[-1].shape[:1:-1])
    shown = field.each_set(xy, field.basis(xy), field.place(z))[0]
    for own, apart in zip(shown, [(0.0, 0.0), (0.5, 0.5), (0.5, 0.0), (0.0, 0.5)], strict=True):
        there = xy + (torch.tensor(apart) * pixel)[:, None]
        assert torch.allclose(own, field.each_set(there, field.basis(there), field.place(z))[0][0], atol=1e-5)
    assert not torch.allclose(shown[0], shown[1], atol=1e-3)


def test_checkpoints_from_before_sets_lay_apart_draw_what_they_drew():
    field, other, z = scramble(make()), make(), torch.randn(M)
    field.phase.zero_()
    other.load_state_dict({key: value for key, value in field.state_dict().items() if "phase" not in key})
    assert torch.equal(draw(other.eval(), z, 32, 32), draw(field.eval(), z, 32, 32))


def test_error_and_penalty_together_are_the_mean_error_of_the_sets():
    field, xy, z = scramble(make(entropy=0.0)), torch.rand(1, 50, 2) * 2 - 1, torch.randn(1, M)
    target = torch.rand(1, 50, 3)
    loss = (field(xy, z) - target).square().mean() + penalty(field)
    alone = [(one_set(field, k)(xy, z) - target).square().mean() for k in range(2)]
    assert loss.item() == pytest.approx(torch.stack(alone).mean().item(), rel=1e-5)


def test_without_a_remainder_only_the_time_to_judge_the_sets_is_kept_back_from_the_budget():
    assert make(remainder=False).settle(1000.0, 2, 0.25, lambda: 0.1) == pytest.approx(2 * 0.1 / 8)


def test_sets_count_with_the_shares_that_are_best_at_the_known_views():
    field, codes, views = scramble(make(sets=3, remainder=False)), torch.randn(2, M), torch.rand(2, 64, 64, 3)
    field.finish(views, codes)
    alone = torch.stack([torch.stack([draw(one_set(field, k), z, 64, 64) for z in codes]) for k in range(3)])
    mean = torch.tensordot(field.trust, alone, 1)
    assert torch.allclose(draw(field.eval(), codes[0], 64, 64), mean[0], atol=1e-5)
    others = torch.tensordot(torch.distributions.Dirichlet(torch.ones(3)).sample((200,)), alone, 1)
    errors = [(each[:, ::8] - views[:, ::8]).square().mean() for each in (mean, *others, *alone)]
    assert errors[0] <= 1.001 * min(errors)


def test_the_shares_of_guesses_whose_errors_are_independent_are_inverse_to_their_squares():
    squares = torch.tensor([1.0, 2.0, 4.0]).double()
    assert torch.allclose(best_shares(squares.diag()), torch.tensor([4.0, 2.0, 1.0]).double() / 7, atol=1e-2)
    noise = best_shares(squares.diag() + 5)  # of what is guessed, the same for all
    assert torch.allclose(noise, torch.tensor([4.0, 2.0, 1.0]).double() / 7, atol=1e-2)
    assert torch.equal(best_shares(torch.ones(1, 1).double()), torch.ones(1).double())
    assert torch.allclose(best_shares(torch.zeros(4, 4).double()), torch.full((4,), 0.25).double())
    worse = torch.tensor([[1.0, 1.5], [1.5, 4.0]]).double()  # errs as the first does, and more
    assert best_shares(worse).tolist() == [1, 0]


@given(st.integers(2, 5), st.integers(0, 10**6))
def test_shares_are_a_mean_and_hardly_worse_than_that_of_all_or_the_best_alone(count, seed):
    random = torch.Generator().manual_seed(seed)
    errors = torch.randn(count, 20, generator=random).double() * 10 ** torch.randn(count, 1, generator=random).double()
    covariance = errors @ errors.T / 20
    shares = best_shares(covariance)
    assert shares.min() >= 0
    assert shares.sum().item() == pytest.approx(1)
    mean = covariance.diagonal().mean()
    assert shares @ covariance @ shares <= min(covariance.mean(), covariance.diagonal().min()) + 0.05 * mean


@pytest.mark.parametrize("remainder", [False, True])
def test_a_set_that_went_wrong_loses_its_voice(remainder):
    field, codes = scramble(make(views=2, remainder=remainder)), torch.randn(2, M)
    right = torch.stack([draw(one_set(field, 1).eval(), z, 64, 64) for z in codes])
    field.finish(right, codes)
    assert field.trust[1] > 0.999
    middle = codes.mean(0)
    assert torch.allclose(draw(field.eval(), middle, 64, 64), draw(one_set(field, 1), middle, 64, 64), atol=1e-3)


def test_a_set_that_is_lost_takes_the_motion_of_the_best():
    """Before disparities are maps; its layers stay, and so does a set that is hardly worse."""
    field, xy, z = scramble(make(sets=3)), torch.rand(2, 50, 2) * 2 - 1, torch.randn(2, M)
    field.at(0.0)
    rgb = torch.rand(2, 50, 3)
    for _ in range(100):
        field.loss(torch.arange(2), xy, rgb, z)
    alone = [(one_set(field, k)(xy, z) - rgb).square().mean().item() for k in range(3)]
    assert field.errors.tolist() == pytest.approx(alone, rel=1e-3)
    field.errors.copy_(torch.tensor([1.02, 1.0, 1.04]))
    for progress in (0.9, 0.0):
        was = {key: value.clone() for key, value in field.state_dict().items()}
        field.at(progress)
        changed = {key for key, value in field.state_dict().items() if not torch.equal(was[key], value)}
        assert changed == (set() if progress else {"errors", "shift", "bend"})
    for own in ("errors", "shift", "bend"):
        assert torch.equal(field.state_dict()[own], was[own][[0, 1, 1]])


@pytest.mark.parametrize("before", [("errors", "attempts", "trials"), ("attempts", "trials")])
def test_checkpoints_from_before_sets_were_judged_and_motions_tried_are_read(before):
    field = scramble(make())
    state = {key: value for key, value in field.state_dict().items() if not key.startswith(before)}
    other = make()
    other.load_state_dict(state)
    assert torch.equal(other.shift, field.shift)
    assert state.keys() - {"errors", "attempts"} <= other.state_dict().keys()
    assert len(list(other.parameters())) == len(other.colours) + len(other.weights) + 4  # an optimiser's state fits
    other.at(0.001, 1)
    assert not other.trying


@pytest.mark.parametrize(("steps", "later", "tried"), [(500, 500, 20), (500, 300, 20), (499, 499, 0), (32, 32, 0)])
def test_the_best_of_the_motions_that_are_tried_are_taken(steps, later, tried):
    """If the budget is enough for them; the first step shows whether it is, and none takes back what has begun."""
    field, xy, z, rgb = scramble(make(256, 256, layers=4)), torch.rand(2, 50, 2) * 2 - 1, torch.randn(2, M), 0.5
    begun, trials, found = field.shift.clone(), field.trials, []
    for step in range(30):
        field.at(step / (steps if step < 3 else later), step)
        field.zero_grad(set_to_none=True)
        field.loss(torch.arange(2), xy, torch.full((2, 50, 3), rgb), z).backward()
        trains = field.shift.grad is None
        assert trains == (trials.shift.grad is not None) == (field.stage() == -1) == field.trying
        if trains:
            assert torch.equal(field(xy, z), trials(xy, z))
            resumed = make(256, 256, layers=4)
            resumed.load_state_dict(field.state_dict())
            assert resumed.trying
        found.append(trains)
        trials.errors.copy_(torch.tensor([5.0, 3.0, 4.0, 2.0]))
    assert found == [False] + [True] * tried + [False] * (29 - tried)
    for own, new in ((field.shift, trials.shift), (field.bend, trials.bend)):
        assert torch.equal(own, new[[3, 1]]) == bool(tried)
    assert torch.equal(field.shift, begun) != bool(tried)


@pytest.mark.parametrize(("layers", "found"), [(1, (4, 2)), (4, (4, 2)), (16, (4, 8)), (24, (4, 12))])
def test_twice_the_layers_of_a_field_are_tried(layers, found):
    assert fast.tried(layers) == found


@pytest.mark.parametrize("tries", [True, False])
def test_sets_that_begin_with_a_wrong_motion_take_one_that_was_tried(tries, monkeypatch):
    monkeypatch.setattr(FastField, "unfold", lambda *_: None)
    if not tries:
        monkeypatch.setattr(fast, "TRIED", 0)
    wide, codes = blobs(72, 96, 0, apart=8), random_codes(5, M)
    views = torch.stack([wide[:, 4:68, 20 - 4 * k : 84 - 4 * k].permute(1, 2, 0) for k in range(5)])
    field = make(64, 64, views=5, layers=2)
    field.calibrate(codes)
    with torch.no_grad():
        field.shift[:, 0] = torch.linalg.pinv(codes * field.gain) @ torch.linspace(-0.5, 0.5, 5)
    fit(field, views, codes, steps=300)
    along = field.place(codes)[:, :, 0].diff(dim=0).mean(0)
    assert torch.allclose(along, torch.tensor(-0.125), atol=0.01) == tries, along  # 4 pixels of 64 from view to view


@pytest.mark.parametrize("seen", [True, False])
def test_no_set_of_a_scene_that_slides_goes_wrong(seen, monkeypatch):
    """One begins to slide the other way, and would not find out by itself."""
    monkeypatch.setattr(fast, "TRIED", 0)
    if not seen:
        monkeypatch.setattr(fast, "LOST", math.inf)
    wide, codes = blobs(72, 96, 0, apart=8), random_codes(5, M)
    views = torch.stack([wide[:, 4:68, 20 - 4 * k : 84 - 4 * k].permute(1, 2, 0) for k in range(5)])
    field = make(64, 64, views=5, layers=2)
    field.calibrate(codes)
    with torch.no_grad():
        slide = torch.linalg.pinv(codes * field.gain) @ torch.linspace(-0.5, 0.5, 5)
        field.shift[1, 0] = slide
        field.shift[0, 0] = -0.5 * slide
    fit(field, views, codes, steps=200)
    assert (field.trust.min() > 0.2) == seen


@pytest.mark.parametrize(("seconds", "left"), [(1, 1), (6, 1), (7, 2), (26, 2), (28, 4), (3600, 4)])
def test_a_budget_that_is_too_short_for_all_sets_has_fewer(seconds, left):
    """A step has a quarter of a view's pixels, which is drawn in a tenth of a second with all the sets: of such steps,
    which take four and a half times as long, there are to be 30 for each layer."""
    field = scramble(make(sets=4, layers=2))
    xy, z, whole = torch.rand(2, 50, 2) * 2 - 1, torch.randn(2, M), copy.deepcopy(field)
    kept_back = field.settle(seconds, 2, 0.25, lambda: 0.1 * field.sets / 4)
    assert kept_back == pytest.approx(2 * 0.1 * left / 4 * (1 + 1 / 8))
    assert (field.sets, field.layers) == (left, 2)
    assert torch.allclose(field(xy, z), torch.stack([one_set(whole, k)(xy, z) for k in range(left)]).mean(0), atol=1e-6)
    codes, views = torch.randn(2, M), torch.rand(2, 64, 64, 3)
    field.finish(views, codes)
    other = pickle.loads(pickle.dumps(make(sets=4, layers=2)))
    other.load_state_dict(field.state_dict())
    assert other.sets == left
    assert torch.equal(draw(other.eval(), codes[0], 64, 64), draw(field.eval(), codes[0], 64, 64))
    assert torch.allclose(draw(other, codes[1], 64, 64), views[1], atol=2e-3)


@pytest.mark.parametrize(
    ("seconds", "layers", "left"),
    [(2, 8, (1, 4)), (13, 8, (1, 4)), (14, 8, (1, 8)), (53, 8, (1, 8)), (55, 8, (2, 8)),
     (2, 6, (1, 4)), (2, 3, (1, 3))],
)  # fmt: skip
def test_a_budget_that_is_too_short_for_one_deep_set_has_fewer_layers(seconds, layers, left):
    field = scramble(make(sets=2, layers=layers))
    whole, optimizer = copy.deepcopy(field), torch.optim.Adam(field.parameters(), lr=0.1)
    field.settle(seconds, 2, 0.25, lambda: 0.1 * field.sets * field.layers / 2 / layers)
    assert (field.sets, field.layers) == left
    of_a_set = whole.colours[-1].unflatten(0, (2, layers))
    assert torch.equal(field.colours[-1], of_a_set[: left[0], : left[1]].flatten(0, 1))
    other = make(sets=2, layers=layers)
    other.load_state_dict(field.state_dict())
    assert (other.sets, other.layers) == left
    xy, z = torch.rand(2, 50, 2) * 2 - 1, torch.randn(2, M)
    assert torch.equal(other(xy, z), field(xy, z))
    (field(xy, z).square().mean() + penalty(field)).backward()
    optimizer.step()  # it was made before, as in a run
    assert (field.colours[-1] != other.colours[-1]).flatten(1).any(1).all()


def test_processes_that_train_together_keep_all_sets(monkeypatch):
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    field = make(sets=4, layers=8)
    field.settle(0.1, 2, 0.25, lambda: 1.0)
    assert (field.sets, field.layers) == (4, 8)


@pytest.mark.parametrize("layers", [4, 6, 8])
def test_layers_that_are_left_begin_at_disparities_as_far_apart_as_all(layers):
    each = make(sets=2, layers=layers).disparity.view(2, layers)
    assert torch.allclose(each.flatten().sort().values, torch.linspace(-1, 1, 2 * layers))
    for own in each:
        first = own[: (layers + 1) // 2]
        assert first[0] == own.min()
        assert torch.allclose(first.diff(), own.sort().values.diff()[:1] * 2)


def test_finished_known_views_are_reproduced_and_a_path_through_them_has_no_jump():
    field = scramble(make(40, 48, views=12))
    codes = torch.randn(12, M)
    views = torch.rand(12, 40, 48, 3)
    field.calibrate(codes)
    field.finish(views, codes)
    field.eval()
    for k in range(12):
        assert torch.allclose(draw(field, codes[k], 40, 48), views[k], atol=2e-3)  # kept in half precision
    frames = [draw(field, lerp(codes[0], codes[1], t / 200), 40, 48) for t in range(201)]
    steps = torch.tensor([(b - a).abs().mean() for a, b in zip(frames, frames[1:], strict=False)])  # noqa: RUF007
    assert steps.max() < 10 * steps.mean()


def test_what_is_kept_between_calls_follows_every_change_of_the_weights():
    """Optimiser steps at each level, a restored state and another precision: drawing shows the weights as they are."""
    field, z = make(128, 128, remainder=False), torch.randn(2, M)
    xy, target = torch.rand(2, 50, 2) * 2 - 1, torch.rand(2, 50, 3)
    optimizer = torch.optim.Adam(field.parameters(), lr=0.05, fused=True)

    def fresh() -> torch.Tensor:
        other = make(128, 128, remainder=False)
        other.load_state_dict(field.state_dict())
        other.level = field.level
        return other.eval()(xy, z).detach()

    for progress in (0.0, 0.2, 0.5, 1.0):
        field.at(progress)
        for _ in range(2):
            optimizer.zero_grad()
            field.train()
            ((field(xy, z) - target).square().mean() + penalty(field)).backward()
            optimizer.step()
            with torch.no_grad():
                assert torch.allclose(field.eval()(xy, z), fresh(), atol=1e-6)
    field.load_state_dict({k: v + 0.1 if v.is_floating_point() else v for k, v in field.state_dict().items()})
    with torch.no_grad():
        assert torch.allclose(field(xy, z), fresh(), atol=1e-6)
        assert field.double()(xy.double(), z.double()).dtype == torch.float64


def test_training_again_leaves_the_remainder_out():
    field = scramble(make(views=2))
    codes, views = torch.randn(2, M), torch.rand(2, 64, 64, 3)
    field.eval()
    bare = draw(field, codes[0], 64, 64)
    field.finish(views, codes)
    assert not torch.allclose(draw(field, codes[0], 64, 64), bare, atol=1e-2)
    field.at(1.0)
    assert torch.allclose(draw(field, codes[0], 64, 64), bare, atol=1e-6)


@pytest.mark.parametrize("texture_pixels", [64**2, 32**2])
def test_a_scene_that_slides_is_learned_and_its_unseen_middle_is_drawn_not_cross_faded(texture_pixels):
    """Five views of a texture that moves 4 pixels from each to the next; the views half way between were never seen."""
    wide = blobs(144, 192, 0)

    def view(t: float) -> torch.Tensor:
        moved = round(8 * t)
        wider = wide[:, 8:136, 40 - moved : 168 - moved]
        return torch.nn.functional.avg_pool2d(wider, 2).permute(1, 2, 0)

    codes, views = random_codes(5, M), torch.stack([view(k) for k in range(5)])
    field = make(64, 64, views=5, layers=2, texture_pixels=texture_pixels)
    fit(field, views, codes)
    for k in range(4):
        drawn = draw(field, lerp(codes[k], codes[k + 1], 0.5).detach(), 64, 64)
        cross_fade = (views[k] + views[k + 1]) / 2
        assert decibel(drawn, view(k + 0.5)) > decibel(cross_fade, view(k + 0.5)) + 5


def test_between_two_pictures_what_moves_by_itself_is_half_way():
    """The background slides by 6 pixels to the right, and a disc before it by 8 downwards."""
    behind, before = blobs(96, 112, 0), blobs(96, 96, 3)
    y, x = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")

    def view(t: float) -> torch.Tensor:
        right, down = round(6 * t), round(8 * t)
        disc = ((x - 32).square() + (y - 28 - down).square() < 14**2).float()
        front = before[:, 16 - down : 80 - down, 16:80]
        return (front * disc + behind[:, 16:80, 16 - right : 80 - right] * (1 - disc)).movedim(0, -1)

    codes, views = random_codes(2, M), torch.stack([view(0), view(1)])
    field = make(64, 64, views=2, layers=4)
    fit(field, views, codes)
    drawn = draw(field, codes.detach().mean(0), 64, 64)
    assert decibel(drawn, view(0.5)) > decibel(views.mean(0), view(0.5)) + 5


def test_mixed_precision_leaves_the_motion_as_it_is():
    field, z, xy = scramble(make()), torch.randn(2, M), torch.rand(2, 50, 2) * 2 - 1
    with torch.autocast("cpu", torch.bfloat16):
        mixed = field(xy, z)
    assert torch.equal(mixed, field(xy, z))


def test_float32_agrees_with_float64():
    field, z, xy = scramble(make(views=2)), torch.randn(2, M), torch.rand(2, 50, 2) * 2 - 1
    field.finish(torch.rand(2, 64, 64, 3), z)
    field.eval()
    single = field(xy, z)
    assert torch.allclose(single.double(), field.double()(xy.double(), z.double()), atol=1e-4)
