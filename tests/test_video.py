"""Floor 0: video.py, each film decoded again."""

import itertools
import os
import weakref
from fractions import Fraction

import av
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from viinter import video
from viinter.config import UserError


def ramp(count, height, width):
    """Smooth frames, no two alike."""
    y = torch.linspace(0, 1, height)[:, None, None]
    x = torch.linspace(0, 1, width)[None, :, None]
    for k in range(count):
        tint = torch.tensor([0.9, 0.2, 0.5]) * (k + 1) / count
        yield 0.4 * y + 0.2 * x + 0.4 * tint


def decoded(path):
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
        return stream.average_rate, stream.codec_context, [torch.from_numpy(f).float() / 255 for f in frames]


@pytest.mark.parametrize(("height", "width"), [(32, 48), (31, 47), (64, 33)])
def test_mp4_comes_back(tmp_path, height, width):
    path = tmp_path / "new" / "a.mp4"
    video.write_mp4(path, ramp(9, height, width), fps=24)
    rate, context, frames = decoded(path)
    assert rate == 24
    assert len(frames) == 9
    assert context.name == "h264"
    assert context.pix_fmt == "yuv420p"
    assert os.listdir(path.parent) == ["a.mp4"]
    for seen, frame in zip(frames, ramp(9, height, width), strict=True):
        assert seen.shape == (height + height % 2, width + width % 2, 3)
        assert (seen[:height, :width] - frame).abs().mean() < 0.02
        assert (seen[:height, :width].mean((0, 1)) - frame.mean((0, 1))).abs().max() < 0.01


@pytest.mark.parametrize("colour", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (0, 0, 0), (0.5, 0.25, 0.75)])
def test_mp4_colours_and_their_label(tmp_path, colour):
    video.write_mp4(tmp_path / "a.mp4", [torch.tensor(colour, dtype=torch.float32).expand(32, 32, 3)])
    with av.open(str(tmp_path / "a.mp4")) as film:
        frame = next(film.decode(video=0))
        assert frame.colorspace == av.video.reformatter.Colorspace.ITU709
        assert frame.color_range == av.video.reformatter.ColorRange.MPEG
        luma = frame.to_ndarray()[:32].mean()  # yuv420p: the first 32 rows are Y
    weights = (0.2126, 0.7152, 0.0722)  # BT.709, 16..235
    expected = 16 + 219 * sum(w * c for w, c in zip(weights, colour, strict=True))
    assert abs(luma - expected) < 2
    _, _, (seen,) = decoded(tmp_path / "a.mp4")
    assert (seen - torch.tensor(colour)).abs().max() < 0.03


@pytest.mark.parametrize(
    ("fps", "rate"), [(30, 30), (29.97, Fraction(2997, 100)), (0.5, Fraction(1, 2)), (12.5, 12.5)]
)
def test_mp4_fps(tmp_path, fps, rate):
    video.write_mp4(tmp_path / "a.mp4", ramp(4, 16, 16), fps=fps)
    assert decoded(tmp_path / "a.mp4")[0] == rate


def test_mp4_odd_sides_repeat_the_edge(tmp_path):
    video.write_mp4(tmp_path / "a.mp4", [torch.ones(33, 17, 3)])
    _, _, (seen,) = decoded(tmp_path / "a.mp4")
    assert seen.shape == (34, 18, 3)
    assert seen.min() > 0.97


@pytest.mark.parametrize("side", [1, 2, 3, 16])
def test_mp4_of_tiny_frames(tmp_path, side):
    video.write_mp4(tmp_path / "a.mp4", ramp(3, side, side))
    assert len(decoded(tmp_path / "a.mp4")[2]) == 3


def test_mp4_index_is_at_the_front(tmp_path):
    video.write_mp4(tmp_path / "a.mp4", ramp(3, 32, 32))
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_mp4_takes_frames_one_at_a_time(tmp_path):
    """No frame is asked for long before the one before it has been given back."""
    alive = []

    def frames():
        for frame in ramp(40, 16, 16):
            alive.append(weakref.ref(frame))
            assert sum(ref() is not None for ref in alive) <= 3
            yield frame
            del frame

    video.write_mp4(tmp_path / "a.mp4", frames())
    assert len(decoded(tmp_path / "a.mp4")[2]) == 40


@pytest.mark.parametrize("write", [video.write_mp4, video.write_gif])
def test_values_outside_are_clamped(tmp_path, write):
    path = tmp_path / "a.film"
    frame = torch.zeros(16, 16, 3)
    frame[:, :8] = 1.5
    frame[:, 8:] = -0.5
    write(path, [frame])
    (seen,) = decoded(path)[2] if write is video.write_mp4 else gif(path)[0]
    assert seen[:, 0].min() > 0.95
    assert seen[:, -1].max() < 0.05


@pytest.mark.parametrize("write", [video.write_mp4, video.write_gif])
@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ([], "no frames; expected at least one"),
        (
            [torch.zeros(4, 4, 3), torch.zeros(4, 5, 3)],
            r"frame 1 has shape \[4, 5, 3\]; expected \[4, 4, 3\]",
        ),
        ([torch.zeros(4, 4)], r"frame 0 has shape \[4, 4\]; expected \[H, W, 3\]"),
        ([torch.zeros(0, 4, 3)], r"frame 0 has shape \[0, 4, 3\]"),
        ([torch.zeros(4, 4, 3, dtype=torch.uint8)], "frame 0 is torch.uint8; expected a floating-point"),
        ([np.zeros((4, 4, 3))], "frame 0 is ndarray"),
        (
            [torch.zeros(4, 4, 3), torch.full((4, 4, 3), float("nan"))],
            "frame 1 has 48 values NaN or infinite",
        ),
    ],
)
def test_refused_frames_leave_nothing_behind(tmp_path, write, frames, said):
    with pytest.raises(video.VideoError, match=f"a.film: {said}"):
        write(tmp_path / "a.film", frames)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("write", [video.write_mp4, video.write_gif])
@pytest.mark.parametrize("fps", [0, -1, float("nan"), float("inf"), "30", True, 1e9, 1e-9])
def test_refused_fps(tmp_path, write, fps):
    with pytest.raises(video.VideoError, match="fps is"):
        write(tmp_path / "a.film", ramp(2, 4, 4), fps=fps)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("write", [video.write_mp4, video.write_gif])
def test_an_error_of_the_frames_passes_and_the_old_film_stays(tmp_path, write):
    write(tmp_path / "a.film", ramp(2, 16, 16))
    before = (tmp_path / "a.film").read_bytes()

    def failing():
        yield from ramp(3, 16, 16)
        raise RuntimeError("render failed")

    with pytest.raises(RuntimeError, match="render failed"):
        write(tmp_path / "a.film", failing())
    assert os.listdir(tmp_path) == ["a.film"]
    assert (tmp_path / "a.film").read_bytes() == before


@pytest.mark.parametrize("write", [video.write_mp4, video.write_gif])
def test_impossible_places(tmp_path, write):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "a", tmp_path / "folder"):
        with pytest.raises(UserError, match="expected a"):
            write(path, ramp(2, 16, 16))
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def gif(path):
    """(frames [H, W, 3] in [0, 1], durations in ms, loop) as Pillow sees them."""
    frames, durations = [], []
    with Image.open(path) as film:
        for k in range(film.n_frames):
            film.seek(k)
            durations.append(film.info["duration"])
            frames.append(torch.from_numpy(np.array(film.convert("RGB"))).float() / 255)
        return frames, durations, film.info.get("loop")


def test_gif_comes_back(tmp_path):
    path = tmp_path / "new" / "a.gif"
    video.write_gif(path, ramp(8, 31, 47), fps=15)
    frames, durations, loop = gif(path)
    assert len(frames) == 8
    assert loop == 0
    assert os.listdir(path.parent) == ["a.gif"]
    assert sum(durations) == 530
    assert set(durations) == {60, 70}
    for seen, frame in zip(frames, ramp(8, 31, 47), strict=True):
        assert seen.shape == frame.shape
        assert (seen - frame).abs().mean() < 0.03
        assert (seen.mean((0, 1)) - frame.mean((0, 1))).abs().max() < 0.01


def test_gif_of_few_colours_is_exact(tmp_path):
    colours = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 0, 0]], dtype=torch.float32)
    video.write_gif(tmp_path / "a.gif", [colour.expand(9, 9, 3) for colour in colours])
    for seen, colour in zip(gif(tmp_path / "a.gif")[0], colours, strict=True):
        assert torch.equal(seen, colour.expand(9, 9, 3))


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(st.integers(0, 2**31), st.integers(2, 300), st.integers(2, 6))
def test_gif_differences_cost_no_colour(tmp_path, seed, colours, count):
    """Pillow stores differences, with a transparent index of its own: it must cost no colour."""
    generator = torch.Generator().manual_seed(seed)
    palette = torch.randint(0, 256, (min(colours, 256), 3), generator=generator) / 255
    index = torch.randint(0, len(palette), (count, 24, 20), generator=generator)
    index[1:, :12] = index[0, :12]  # the upper half stands still
    index[:, 12, 0] = torch.arange(count) % 2  # no frame equals the one before
    video.write_gif(tmp_path / "a.gif", palette[index])
    seen = torch.stack(gif(tmp_path / "a.gif")[0])
    assert (seen - palette[index]).abs().mean() < (1e-6 if colours <= 128 else 0.01)


def test_gif_has_one_palette(tmp_path):
    video.write_gif(tmp_path / "a.gif", ramp(5, 20, 20))
    data = (tmp_path / "a.gif").read_bytes()

    def after_blocks(at):
        while data[at]:
            at += data[at] + 1
        return at + 1

    at, local = 13 + 3 * 2 ** ((data[10] & 7) + 1), []
    while data[at] != 0x3B:
        if data[at] == 0x21:  # an extension
            at = after_blocks(at + 2)
        else:  # an image; the flag says whether it brings its own palette
            assert data[at] == 0x2C
            local.append(bool(data[at + 9] & 0x80))
            at = after_blocks(at + 11)
    assert data[10] & 0x80
    assert local == [False] * 5


def test_gif_cannot_hold_a_picture_for_ever(tmp_path):
    with pytest.raises(video.VideoError, match="expected to write a GIF"):
        video.write_gif(tmp_path / "a.gif", [torch.zeros(4, 4, 3)] * 8, fps=0.01)
    assert os.listdir(tmp_path) == []


@settings(
    max_examples=15,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(st.integers(1, 12), st.floats(1, 50))
def test_gif_length(tmp_path, count, fps):
    video.write_gif(tmp_path / "a.gif", ramp(count, 6, 5), fps=fps)
    frames, durations, _ = gif(tmp_path / "a.gif")
    assert len(frames) == count
    assert abs(sum(durations) - 1000 * count / fps) <= 5
    assert min(durations) >= 20


def test_gif_equal_frames_last_longer(tmp_path):
    still = list(itertools.repeat(torch.full((6, 6, 3), 0.5), 5))
    video.write_gif(tmp_path / "a.gif", [*still, torch.zeros(6, 6, 3)], fps=10)
    frames, durations, _ = gif(tmp_path / "a.gif")
    assert len(frames) == 2
    assert durations == [500, 100]
