"""Read, shrink and write still images, through OpenImageIO.

Notation. An image is a float32 tensor `[H, W, 3]` on the CPU, row 0 at the top, channels red, green,
blue. Integer files are mapped to [0, 1] by their largest value (255 or 65535); float files keep their
stored values. Numbers are taken as stored: ICC profiles, gamma tags and EXR's convention of linear light
change nothing. `a` is the alpha of a pixel in [0, 1]; a colour is *straight* where it is not yet multiplied
by `a` (PNG), *associated* where it is (EXR). `name` is a path as `str`, the way messages show it.
"""

import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch

from viinter.config import UserError
from viinter.files import whole

MAX_PIXELS = 2**28
"""The most pixels that `read` and `size` accept: 16384 x 16384, 3 GiB as floats. Seen in the header."""

EXTENSIONS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".webp", ".bmp", ".ppm", ".pgm")
"""Endings, lower case, of the files that count as images where a folder is listed."""

# OpenImageIO knows more formats. These are the ones whose alpha was checked; and among the others are "null",
# which makes up pixels for any file called *.null, and formats that find a picture in any bytes.
_FORMATS = ("bmp", "gif", "hdr", "jpeg", "jpeg2000", "openexr", "png", "pnm", "targa", "tiff", "webp")

# ending -> (format, {bits: pixel type})
_PNG = ("png", {8: oiio.UINT8, 16: oiio.UINT16})
_JPEG = ("jpeg", {8: oiio.UINT8})
_TIFF = ("tiff", {8: oiio.UINT8, 16: oiio.UINT16, 32: oiio.FLOAT})
_EXR = ("openexr", {16: oiio.HALF, 32: oiio.FLOAT})
_WRITTEN = {".png": _PNG, ".jpg": _JPEG, ".jpeg": _JPEG, ".tif": _TIFF, ".tiff": _TIFF, ".exr": _EXR}

_ATTRIBUTES = {
    "png": {},
    "jpeg": {"Compression": "jpeg:95", "jpeg:subsampling": "4:4:4"},
    # Without this OpenImageIO 3.2 fails on an empty Exif directory, after the pixels, and close() says True.
    "tiff": {"Compression": "zip", "tiff:write_exif": 0},
    "openexr": {"Compression": "zip"},
}


class ImageError(UserError):
    """A file that cannot be read, or an image that cannot be written or shrunk.

    The message names the file, what was found, and what was expected.
    """


def read(path: str | os.PathLike, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> torch.Tensor:
    """Read one still image.

    path: PNG, JPEG, TIFF or EXR; also BMP, WebP, PNM, Targa, JPEG 2000, Radiance HDR and one-frame GIF. The
        format is found from the bytes where the ending is wrong.
    background: red, green, blue put behind transparent pixels: colour * a + background * (1 - a).

    Returns float32 `[H, W, 3]`, upright (the EXIF orientation is applied). Integer files give [0, 1]. Float
    files give what is stored, **outside [0, 1] too**; what to do with that is the caller's choice. Grey is
    repeated three times; channels other than R, G, B (or Y) and A are passed over. CMYK is converted without
    its profile, (1 - c)(1 - k). An animated PNG gives its default picture, as in viewers without animation.

    Raises ImageError: no such file, not a regular file, not readable, empty, not an image, truncated; more
    than MAX_PIXELS pixels; several images in one file (animation, pages, layers); neither grey nor RGB;
    integers of 32 bits or signed; an EXR whose pixels do not fill its display window; NaN or infinite pixels.
    JPEG holds no checksum: damage in its middle that leaves it decodable is not seen.
    """
    back = np.asarray(background, dtype=np.float32)
    if back.shape != (3,) or not np.isfinite(back).all():
        raise ImageError(f"{path}: background is {background!r}; expected three finite numbers")
    name, file = _open(path)
    try:
        spec = file.spec()
        picked = _channels(name, spec)
        first, last = min(picked), max(picked) + 1
        # Integers are read as stored: OpenImageIO's own floats are n * (1 / 255), off in the last place.
        whole = spec.format.basetype in (oiio.UINT8, oiio.UINT16)
        pixels = file.read_image(0, 0, first, last, spec.format.basetype if whole else oiio.FLOAT)
        # A truncated JPEG comes back as pixels, grey from where it ends, and an error: both are asked.
        if pixels is None or file.has_error:
            raise ImageError(f"{name}: {_reason(file)}; expected a whole image")
        kind, straight = file.format_name(), _is_straight(file.format_name(), spec)
        _refuse_more(name, file)
    finally:
        file.close()

    if list(picked) != list(range(first, last)):  # fancy indexing would copy, and leave a transposed layout
        pixels = pixels[..., [c - first for c in picked]]
    if whole:
        pixels = np.divide(pixels, np.iinfo(pixels.dtype).max, dtype=np.float32)
    wrong = ~np.isfinite(pixels).all(axis=-1)
    if wrong.any():
        y, x = np.argwhere(wrong)[0]
        raise ImageError(
            f"{name}: {wrong.sum()} pixels are NaN or infinite, the first at row {y}, column {x} as stored; "
            f"expected finite numbers"
        )
    if len(picked) in (2, 4):
        colour, a = pixels[..., :-1], pixels[..., -1:]
        # The fourth byte of 32-bit BMP and Targa is often padding, which OpenImageIO takes for alpha 0.
        if kind in ("bmp", "targa") and not a.any():
            a = np.ones_like(a)
        pixels = (colour * a if straight else colour) + (1 - a) * back
    if pixels.shape[2] == 1:
        pixels = pixels.repeat(3, axis=2)
    if _orientation(spec) != 1:
        turned = oiio.ImageBuf(np.ascontiguousarray(pixels))
        turned.specmod().attribute("Orientation", _orientation(spec))
        pixels = oiio.ImageBufAlgo.reorient(turned).get_pixels(oiio.FLOAT)
    return torch.from_numpy(np.ascontiguousarray(pixels))


def size(path: str | os.PathLike) -> tuple[int, int]:
    """(height, width) of the image that `read` would return, from the file's header.

    Raises ImageError as `read` does, for all that shows without the pixels: not truncation, not NaN.
    """
    name, file = _open(path)
    try:
        spec = file.spec()
        _channels(name, spec)
        _refuse_more(name, file)
    finally:
        file.close()
    return (spec.width, spec.height) if _orientation(spec) >= 5 else (spec.height, spec.width)


def downsample(image: torch.Tensor, factor: int) -> torch.Tensor:
    """Shrink by a whole number: each pixel of the result is the mean of a block of `factor` x `factor`.

    image: `[H, W, 3]`, floating point, finite.
    factor: at least 1, at most min(H, W); 1 gives the image itself.

    Returns float32 `[H // factor, W // factor, 3]` on the image's device. The H % factor rows at the bottom
    and the W % factor columns at the right are left out: every block is whole, no pixel weighs double.

    Raises ImageError: factor out of its range or no int, or not such an image.
    """
    _check_image("downsample", image)
    height, width, _ = image.shape
    if isinstance(factor, bool) or not isinstance(factor, int) or not 1 <= factor <= min(height, width):
        raise ImageError(
            f"downsample: factor is {factor!r}; expected a whole number from 1 to {min(height, width)}, "
            f"the shorter side of {height} x {width}"
        )
    if factor == 1:
        return image
    rows, columns = height // factor, width // factor
    blocks = image[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, 3)
    # means of means round past the largest value now and then: white stays white
    return blocks.mean((1, 3), dtype=torch.float32).clamp(image.min(), image.max())


def write(path: str | os.PathLike, image: torch.Tensor, bits: int = 8) -> None:
    """Write one image; the ending of `path` chooses the format, and its folder is created.

    image: `[H, W, 3]`, floating point, finite.
    bits: PNG 8 or 16; JPEG 8 (quality 95, full colour resolution); TIFF 8, 16 or 32 (float); EXR 16 (half) or
        32 (float). Integers are clamped to [0, 1] and rounded to the nearest; floats are written untouched.

    The file is written under a temporary name beside `path` and renamed, so `path` is never half an image.

    Raises ImageError: an unknown ending, bits that the format has not, not such an image, NaN or infinite
    values, values too large for half floats, a size that the format has not; UserError: a place that cannot be
    written.
    """
    name, target = os.fspath(path), Path(path)
    ending = target.suffix.lower()
    if ending not in _WRITTEN:
        raise ImageError(f"{name}: the ending is {ending!r}; expected one of {', '.join(_WRITTEN)}")
    format_name, kinds = _WRITTEN[ending]
    if bits not in kinds:
        raise ImageError(f"{name}: bits is {bits!r}; expected one of {list(kinds)} for {format_name}")
    kind = kinds[bits]
    _check_image(name, image)

    pixels = image.detach().to("cpu", torch.float32).contiguous().numpy()
    if kind == oiio.HALF:
        with np.errstate(over="ignore"):  # to infinity, which is refused below
            pixels = pixels.astype(np.float16)
    wrong = ~np.isfinite(pixels)
    if wrong.any():
        y, x, channel = np.argwhere(wrong)[0]
        limit = " up to 65504, the largest half float" if kind == oiio.HALF else ""
        raise ImageError(
            f"{name}: {wrong.sum()} values are NaN or too large, the first {image[y, x, channel].item()} "
            f"at row {y}, column {x}, channel {channel}; expected finite values{limit}"
        )
    if kind in (oiio.UINT8, oiio.UINT16):
        pixels = np.rint(np.clip(pixels, 0, 1) * (2**bits - 1)).astype(f"uint{bits}")

    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, kind)
    for key, value in _ATTRIBUTES[format_name].items():
        spec.attribute(key, value)
    with whole(target) as part:
        out = oiio.ImageOutput.create(format_name)
        written = out.open(str(part), spec) and out.write_image(pixels) and out.close()
        if not written or out.has_error:
            raise ImageError(f"{name}: {_reason(out)}; expected to write {format_name}")


def _open(path: str | os.PathLike) -> tuple[str, oiio.ImageInput]:
    """The file, open, its header read and checked for its kind and its size."""
    name = os.fsdecode(path)
    wanted = "expected an image file"
    try:
        name.encode()  # OpenImageIO takes UTF-8 names alone
        if not os.path.exists(name):
            found = "a dangling link" if os.path.islink(name) else "no such file"
            raise ImageError(f"{name}: {found}; {wanted}")
        if not stat.S_ISREG(os.stat(name).st_mode):  # opening a pipe would wait for ever
            found = "a folder" if os.path.isdir(name) else "not a regular file"
            raise ImageError(f"{name}: {found}; {wanted}")
        with open(name, "rb") as probe:
            if not probe.read(1):
                raise ImageError(f"{name}: an empty file; {wanted}")
    except ImageError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte, or not UTF-8
        raise ImageError(f"{name!r}: {error}; {wanted} that can be opened") from error

    # Else straight colours come multiplied by alpha, and in 8 bits rounded once more.
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(name, hints)
    if file is None:
        reason = _reason(oiio)
        raise ImageError(f"{name}: {reason}; {wanted}, whole, in one of {', '.join(_FORMATS)}")
    try:
        spec, kind = file.spec(), file.format_name()
        if kind not in _FORMATS:
            raise ImageError(f"{name}: opens as {kind!r}; expected one of {', '.join(_FORMATS)}")
        if spec.deep or spec.depth != 1:
            raise ImageError(f"{name}: deep or volume data; expected a flat image")
        if spec.width * spec.height > MAX_PIXELS:
            raise ImageError(f"{name}: {spec.height} x {spec.width} pixels; expected at most {MAX_PIXELS}")
        if spec.format.basetype not in (oiio.UINT8, oiio.UINT16, oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
            raise ImageError(f"{name}: pixels of type {spec.format}; expected uint8, uint16 or floats")
        if kind == "openexr" and spec.roi != spec.roi_full:
            raise ImageError(
                f"{name}: the data window {_window(spec.roi)} is not the display window "
                f"{_window(spec.roi_full)}; expected pixels that fill the picture"
            )
    except ImageError:
        file.close()
        raise
    return name, file


def _channels(name: str, spec: oiio.ImageSpec) -> list[int]:
    """Where R, G, B or Y, and A if there is one, stand among the channels: 1 to 4 indices, colour first."""
    found = [channel.lower() for channel in spec.channelnames]
    # Y beside RY and BY is luminance and chroma, no grey image.
    grey = ["y"] if "y" in found and not {"ry", "by"} & set(found) else None
    colour = ["r", "g", "b"] if {"r", "g", "b"} <= set(found) else grey
    if colour is None:
        names = ", ".join(spec.channelnames)
        raise ImageError(f"{name}: the channels are {names}; expected R, G, B or Y, with or without A")
    return [found.index(channel) for channel in (*colour, "a") if channel in found]


def _is_straight(format_name: str, spec: oiio.ImageSpec) -> bool:
    """Whether colours are not multiplied by alpha, the file having been opened with that asked for.

    EXR is always associated. TIFF says which, and OpenImageIO passes that on. The others are straight, though
    for BMP, GIF and JPEG 2000 OpenImageIO sets no attribute that says so.
    """
    return format_name not in ("openexr", "tiff") or bool(spec.get_int_attribute("oiio:UnassociatedAlpha"))


def _orientation(spec: oiio.ImageSpec) -> int:
    """EXIF orientation, 1 to 8; 1 is upright, as is any other number. From 5 on, height and width swap."""
    value = spec.get_int_attribute("Orientation", 1)
    return value if 1 <= value <= 8 else 1


def _refuse_more(name: str, file: oiio.ImageInput) -> None:
    """Refuse a second image in the file. Asked last: afterwards the file may stand elsewhere, or in error."""
    if file.seek_subimage(1, 0):
        raise ImageError(f"{name}: holds several images (animation, pages, layers or parts); expected one")


def _reason(library: Any) -> str:
    """What OpenImageIO, or a file of it, gives as its last error."""
    try:
        message = library.geterror()
    except UnicodeDecodeError as error:  # it may quote the file's own bytes
        message = error.object.decode(errors="backslashreplace")
    return " / ".join(message.split("\n")) or "OpenImageIO gives no reason"


def _window(roi: oiio.ROI) -> str:
    return f"x {roi.xbegin}..{roi.xend}, y {roi.ybegin}..{roi.yend}"


def _check_image(name: str, image: torch.Tensor) -> None:
    if not isinstance(image, torch.Tensor) or not image.is_floating_point():
        kind = image.dtype if isinstance(image, torch.Tensor) else type(image).__name__
        raise ImageError(f"{name}: the image is {kind}; expected a floating-point torch.Tensor [H, W, 3]")
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ImageError(f"{name}: the image has shape {list(image.shape)}; expected [H, W, 3], not empty")
