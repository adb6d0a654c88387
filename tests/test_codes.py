"""The mathematics of codes: norms, projection, mixes, paths."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from viinter.codes import CodeBook, along, ease, lerp, mix, p_norm, path, project, radius_of_length

orders = st.one_of(st.just(math.inf), st.just(1.0), st.floats(1, 100))
scales = st.floats(-30, 30).map(lambda e: 10.0**e)
lengths = st.integers(1, 300)


def normal(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@given(orders, lengths, scales, st.floats(1e-3, 1e3), st.integers(0, 1000))
def test_a_projected_code_has_the_radius_as_its_norm_at_every_order_length_and_scale(p, m, scale, radius, seed):
    z = project(scale * normal(seed, 4, m), p, radius)
    norm = torch.linalg.vector_norm(z.double(), ord=p, dim=-1)
    assert torch.allclose(norm, torch.full_like(norm, radius), rtol=3e-6, atol=0)


@given(orders, lengths, st.integers(0, 1000))
def test_the_norm_agrees_with_float64(p, m, seed):
    z = normal(seed, 3, m)
    assert torch.allclose(p_norm(z, p)[:, 0].double(), torch.linalg.vector_norm(z.double(), ord=p, dim=-1), rtol=3e-6)


@given(orders, lengths, st.integers(0, 1000))
def test_projection_keeps_the_direction_and_does_nothing_the_second_time(p, m, seed):
    z = normal(seed, 3, m)
    once = project(z, p, 2.0)
    assert torch.allclose(once / once.abs().amax(-1, keepdim=True), z / z.abs().amax(-1, keepdim=True), atol=1e-6)
    assert torch.allclose(project(once, p, 2.0), once, rtol=1e-6)


def test_the_infinity_norm_is_the_largest_absolute_entry_whatever_its_sign():
    assert p_norm(torch.tensor([[1.0, -3.0, 2.0]]), math.inf).item() == 3


def test_no_order_means_no_projection():
    z = normal(0, 2, 5)
    assert project(z, None) is z


def test_a_code_of_zeros_stays_finite_in_project_and_is_drawn_anew_by_the_code_book():
    assert project(torch.zeros(1, 4), 2.0).eq(0).all()
    book = CodeBook(3, 8, 1.0, 1.0)
    with torch.no_grad():
        book.weight[1] = 0
    book.project_()
    assert torch.allclose(book.norms(), torch.ones(3), atol=1e-6)
    assert book.redrawn.item() == 1


def test_a_large_order_neither_overflows_nor_underflows():
    z = project(torch.tensor([[1e30, 1e-30, -1e30]]), 50.0)
    assert torch.isfinite(z).all()
    assert z[0, 0] == pytest.approx(2 ** (-1 / 50))


@given(st.floats(-2, 3), st.integers(0, 1000))
def test_lerp_is_affine_and_goes_on_beyond_the_ends(t, seed):
    a, b = normal(seed, 2, 7).double()
    assert torch.allclose(lerp(a, b, t), a + t * (b - a), atol=1e-12)
    assert torch.equal(lerp(a, b, 0.0), a)
    assert torch.equal(lerp(a, b, 1.0), b)


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 1000))
def test_a_mix_of_four_is_an_interpolation_of_interpolations(u, v, seed):
    codes = normal(seed, 4, 6).double()
    nested = lerp(lerp(codes[0], codes[1], u), lerp(codes[2], codes[3], u), v)
    weights = [(0, (1 - u) * (1 - v)), (1, u * (1 - v)), (2, (1 - u) * v), (3, u * v)]
    assert torch.allclose(mix(codes, weights), nested, atol=1e-12)


@given(st.integers(2, 5), st.integers(1, 6), st.booleans())
def test_a_path_passes_its_views_at_the_stated_frames(stops, frames, smooth):
    codes = normal(1, 5, 3)
    views = list(range(stops))
    line, ring = path(codes, views, frames, smooth), path(codes, views, frames, smooth, loop=True)
    assert len(line) == (stops - 1) * frames + 1
    assert len(ring) == stops * frames
    for k, view in enumerate(views):
        assert torch.allclose(line[k * frames], codes[view], atol=1e-6)
        assert torch.allclose(ring[k * frames], codes[view], atol=1e-6)


@given(st.integers(2, 5), st.integers(1, 6))
def test_codes_along_views_are_those_of_a_path_if_they_meet_them(stops, frames):
    codes, views = normal(1, 5, 3), list(range(stops))
    assert torch.allclose(along(codes, views, (stops - 1) * frames + 1), path(codes, views, frames), atol=1e-5)


@given(st.integers(2, 5), st.integers(2, 50))
def test_codes_along_views_go_from_the_first_to_the_last_in_steps_of_one_length(stops, count):
    codes = torch.arange(5.0)[:, None]  # one line, so that corners cannot shorten a step
    found = along(codes, list(range(stops)), count)[:, 0]
    assert found[[0, -1]].tolist() == [0, stops - 1]
    assert torch.allclose(found.diff(), torch.tensor((stops - 1) / (count - 1)), atol=1e-5)


def test_easing_starts_and_ends_at_rest():
    t = torch.tensor([0.0, 1e-3, 0.5, 1 - 1e-3, 1.0], dtype=torch.float64)
    eased = ease(t)
    assert eased[[0, 2, 4]].tolist() == [0, 0.5, 1]
    assert eased[1] < 1e-5
    assert 1 - eased[3] < 1e-5


@pytest.mark.parametrize("p", [1.0, 1.5, 2.0, 20.0, math.inf])
@pytest.mark.parametrize("m", [16, 128, 512])
def test_codes_on_the_sphere_of_a_length_are_about_that_long(p, m):
    torch.manual_seed(1)
    book = CodeBook(50, m, p, radius=7.0, length=0.3)
    book.project_()
    assert book.radius == radius_of_length(0.3, p, m)
    assert torch.allclose(book.norms(), torch.full((50,), book.radius))
    assert book.weight.detach().norm(dim=1).mean() == pytest.approx(0.3, rel=0.05)


def test_the_published_radius_gives_each_p_another_length():
    lengths = {p: 1 / radius_of_length(1.0, p, 128) for p in (1.0, 1.5, 2.0, math.inf)}
    assert lengths == pytest.approx({1.0: 0.11, 1.5: 0.49, 2.0: 1.0, math.inf: 4.0}, rel=0.05)


def test_free_codes_start_at_the_length_and_are_not_held_there():
    book = CodeBook(200, 128, None, radius=1.0, length=2.5)
    before = book.weight.detach().clone()
    assert before.norm(dim=1).mean() == pytest.approx(2.5, rel=0.05)
    assert before.norm(dim=1).std() > 0
    book.project_()
    assert torch.equal(book.weight, before)
