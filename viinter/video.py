"""Write films: H.264 in MP4 through PyAV, looping GIF through Pillow.

Notation. A frame is a floating-point tensor `[H, W, 3]`, red, green, blue, nominally in [0, 1]; values
outside are clamped, as a field may overshoot a little. `fps` is frames a second. All frames of a film have
one size. `name` is a path as `str`, the way messages show it.
"""

import itertools
import os
from collections.abc import Iterable, Iterator
from fractions import Fraction

import av
import numpy as np
import torch
from av.video.reformatter import ColorRange, Colorspace
from PIL import Image

from viinter.config import UserError
from viinter.files import whole

_PALETTE_PIXELS = 2**19
"""About how many pixels, taken evenly from all frames, the palette of a GIF is made from."""


class VideoError(UserError):
    """A film that cannot be written. The message names the file, what was found, and what was expected."""


def write_mp4(path: str | os.PathLike, frames: Iterable[torch.Tensor], fps: float = 30) -> None:
    """Write H.264 (yuv420p, BT.709, crf 16), which every browser and player shows.

    frames: `[H, W, 3]` each, at least one. They are taken one at a time: memory does not grow with their
        number.
    fps: 0.01 to 1000; kept as a fraction with a denominator up to 1001.

    An odd height or width becomes even by repeating the last row or column, since yuv420p halves both. The
    index stands at the front of the file (faststart). The file is written under a temporary name and renamed.

    Raises VideoError: no frames, frames of different sizes, not such frames, NaN, fps out of range; UserError: a
    place that cannot be written. What `frames` itself raises passes through; `path` is then left as it was.
    """
    name = os.fspath(path)
    rate = Fraction(_check_fps(name, fps, 1000)).limit_denominator(1001)
    with whole(name) as part:
        pictures = _pictures(name, frames)
        first = next(pictures)
        height, width, _ = first.shape
        try:
            with av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as film:
                stream = film.add_stream("libx264", rate=rate, options={"crf": "16"})
                stream.height, stream.width = height + height % 2, width + width % 2
                stream.pix_fmt = "yuv420p"
                # Said in the file, or players guess from the size and colours shift.
                context = stream.codec_context
                context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
                context.color_primaries = context.color_trc = 1  # BT.709
                for picture in itertools.chain([first], pictures):
                    picture = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                    frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(
                        format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                    )
                    film.mux(stream.encode(frame))
                film.mux(stream.encode())
        except av.error.FFmpegError as error:
            raise VideoError(f"{name}: {error}; expected to write {width} x {height} H.264") from error


def write_gif(path: str | os.PathLike, frames: Iterable[torch.Tensor], fps: float = 15) -> None:
    """Write a GIF that loops for ever, all frames in one palette of 256 colours made from all of them.

    frames: `[H, W, 3]` each, at least one. All are held in memory, at a byte a value.
    fps: 0.01 to 50: GIF counts time in 1/100 s, and browsers slow down what is shorter than 2/100 s.
        The frames' times are rounded so that the film's length stays right. Equal frames in a row are stored
        as one that lasts longer.

    The file is written under a temporary name and renamed. Raises VideoError as `write_mp4` does.
    """
    name = os.fspath(path)
    _check_fps(name, fps, 50)
    with whole(name) as part:
        pictures = list(_pictures(name, frames))
        # A stride that is odd, so as not to fall on the same columns of every row.
        stride = max(1, sum(picture[..., 0].size for picture in pictures) // _PALETTE_PIXELS) | 1
        sample = np.concatenate([picture.reshape(-1, 3)[::stride] for picture in pictures])
        palette = Image.fromarray(sample[None]).quantize(256, method=Image.Quantize.MEDIANCUT)
        images = [Image.fromarray(picture).quantize(palette=palette) for picture in pictures]
        ticks = [round(100 * k / fps) for k in range(len(images) + 1)]
        milliseconds = [10 * (after - before) for before, after in itertools.pairwise(ticks)]
        try:
            images[0].save(
                part,
                format="GIF",
                save_all=True,
                append_images=images[1:],
                palette=bytes(palette.getpalette()),  # said once more, or Pillow writes it with every frame
                duration=milliseconds,
                loop=0,
            )
        except (OSError, OverflowError) as error:  # overflow: one picture for longer than 655 s
            raise VideoError(f"{name}: {error}; expected to write a GIF") from error


def _check_fps(name: str, fps: float, most: float) -> float:
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0.01 <= fps <= most:
        raise VideoError(f"{name}: fps is {fps!r}; expected a number from 0.01 to {most}")
    return fps


def _pictures(name: str, frames: Iterable[torch.Tensor]) -> Iterator[np.ndarray]:
    """The frames as uint8 `[H, W, 3]`, one at a time, each checked; at least one, or VideoError."""
    shape = None
    for k, frame in enumerate(frames):
        if not isinstance(frame, torch.Tensor) or not frame.is_floating_point():
            kind = frame.dtype if isinstance(frame, torch.Tensor) else type(frame).__name__
            raise VideoError(f"{name}: frame {k} is {kind}; expected a floating-point torch.Tensor [H, W, 3]")
        if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            found = list(frame.shape)
            raise VideoError(f"{name}: frame {k} has shape {found}; expected [H, W, 3], not empty")
        shape = list(frame.shape) if shape is None else shape
        if list(frame.shape) != shape:
            found = list(frame.shape)
            raise VideoError(f"{name}: frame {k} has shape {found}; expected {shape}, as frame 0")
        if wrong := (~frame.isfinite()).sum().item():
            raise VideoError(f"{name}: frame {k} has {wrong} values NaN or infinite; expected finite values")
        yield (frame.detach().float().clamp(0, 1) * 255).round().to("cpu", torch.uint8).contiguous().numpy()
    if shape is None:
        raise VideoError(f"{name}: no frames; expected at least one")
