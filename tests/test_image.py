"""Floor 0: image.py, against files made by Pillow and by OpenImageIO itself."""

import contextlib
import gc
import os
import struct

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from viinter import image
from viinter.config import UserError

WHITE, BLACK, GREEN = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
RNG = np.random.default_rng(0)
PICTURE = RNG.integers(0, 256, (20, 30, 3), dtype=np.uint8)

quick = settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)


def raw(path, pixels, kind, names=None, tags=None, **fields):
    """Write through OpenImageIO directly, so that files `write` never makes can be read."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    if names:
        spec.channelnames = names
    for key, value in (tags or {}).items():
        spec.attribute(key, value)
    for key, value in fields.items():
        setattr(spec, key, value)
    out = oiio.ImageOutput.create(str(path))
    written = out.open(str(path), spec) and out.write_image(pixels) and out.close()
    assert written, out.geterror()
    return path


def sides(least=1, most=9):
    return st.tuples(st.integers(least, most), st.integers(least, most), st.just(3))


def floats(low, high, shapes=None):
    shapes = sides() if shapes is None else shapes
    return hnp.arrays(np.float32, shapes, elements=st.floats(low, high, width=32))


# ---- write, then read


@quick
@given(hnp.arrays(np.uint8, sides()), st.sampled_from(["a.png", "a.tif", "a.TIFF"]))
def test_eight_bits_come_back_exactly(tmp_path, stored, name):
    values = torch.from_numpy(stored).float() / 255
    image.write(tmp_path / name, values)
    assert torch.equal(image.read(tmp_path / name), values)


@quick
@given(hnp.arrays(np.uint16, sides()), st.sampled_from(["a.png", "a.tif"]))
def test_sixteen_bits_come_back_exactly(tmp_path, stored, name):
    values = torch.from_numpy(stored.astype(np.float32)) / 65535
    image.write(tmp_path / name, values, bits=16)
    assert torch.equal(image.read(tmp_path / name), values)


@quick
@given(floats(-(2.0**100), 2.0**100), st.sampled_from(["a.exr", "a.tif"]))
def test_floats_come_back_exactly_outside_0_to_1_too(tmp_path, stored, name):
    image.write(tmp_path / name, torch.from_numpy(stored), bits=32)
    assert torch.equal(image.read(tmp_path / name), torch.from_numpy(stored))


@quick
@given(floats(-65504, 65504))
def test_half_exr_rounds_as_half(tmp_path, stored):
    image.write(tmp_path / "a.exr", torch.from_numpy(stored), bits=16)
    assert torch.equal(image.read(tmp_path / "a.exr"), torch.from_numpy(stored).half().float())


@quick
@given(floats(-1, 2), st.sampled_from([8, 16]))
def test_integers_are_clamped_and_rounded_to_the_nearest(tmp_path, stored, bits):
    image.write(tmp_path / "a.png", torch.from_numpy(stored), bits=bits)
    error = (image.read(tmp_path / "a.png") - torch.from_numpy(stored).clamp(0, 1)).abs().max()
    assert error <= 0.5 / (2**bits - 1) + 1e-7


@quick
@given(floats(0, 1, st.just((1, 1, 3))), sides(1, 40))
def test_jpeg_keeps_a_flat_colour(tmp_path, colour, shape):
    values = torch.from_numpy(colour).expand(shape)
    image.write(tmp_path / "a.jpg", values)
    assert (image.read(tmp_path / "a.jpg") - values).abs().max() < 0.02


def test_jpeg_keeps_colour_edges(tmp_path):
    """4:4:4: one red column among green ones stays red. At 4:2:0 its colour would be halved."""
    values = torch.zeros(16, 16, 3)
    values[..., 1] = 1
    values[:, 7] = torch.tensor([1.0, 0, 0])
    image.write(tmp_path / "a.jpg", values)
    assert (image.read(tmp_path / "a.jpg") - values).abs().max() < 0.1


def test_write_takes_any_float_tensor_and_makes_folders(tmp_path):
    values = torch.rand(3, 5, 4, dtype=torch.float64).permute(1, 2, 0).requires_grad_()
    path = tmp_path / "new" / "deep" / "a.exr"
    image.write(str(path), values, bits=32)
    assert torch.equal(image.read(path), values.detach().float())
    assert os.listdir(path.parent) == ["a.exr"]


def test_write_replaces_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    image.write(path, torch.zeros(2, 2, 3))
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk gone")))
    with pytest.raises(UserError, match=r"a\.png.*disk gone"):
        image.write(path, torch.ones(2, 2, 3))
    assert os.listdir(tmp_path) == ["a.png"]
    assert image.read(path).max() == 0


@pytest.mark.parametrize(
    ("name", "bits", "said"),
    [
        ("a.jpg", 16, r"bits is 16; expected one of \[8\]"),
        ("a.png", 32, r"bits is 32; expected one of \[8, 16\]"),
        ("a.exr", 8, r"bits is 8; expected one of \[16, 32\]"),
        ("a.tif", 12, r"bits is 12; expected one of \[8, 16, 32\]"),
        ("a.gif", 8, r"ending is '.gif'; expected one of .png"),
        ("a", 8, r"ending is ''; expected"),
    ],
)
def test_write_refuses_formats(tmp_path, name, bits, said):
    with pytest.raises(image.ImageError, match=said):
        image.write(tmp_path / name, torch.zeros(2, 2, 3), bits)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (torch.zeros(2, 2), r"shape \[2, 2\]; expected \[H, W, 3\]"),
        (torch.zeros(2, 2, 4), r"shape \[2, 2, 4\]"),
        (torch.zeros(0, 2, 3), r"shape \[0, 2, 3\].*not empty"),
        (torch.zeros(2, 2, 3, dtype=torch.uint8), r"image is torch.uint8; expected a floating-point"),
        (np.zeros((2, 2, 3)), r"image is ndarray"),
        (torch.full((2, 2, 3), 1e300, dtype=torch.float64), r"12 values"),
    ],
)
def test_write_refuses_images(tmp_path, values, said):
    with pytest.raises(image.ImageError, match=said):
        image.write(tmp_path / "a.tif", values, 32)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e5])
def test_write_refuses_values_that_half_cannot_hold(tmp_path, value):
    values = torch.zeros(4, 5, 3)
    values[2, 3, 1] = value
    with pytest.raises(image.ImageError, match=r"1 values are .* at row 2, column 3, channel 1; .*65504"):
        image.write(tmp_path / "a.exr", values, bits=16)


def test_write_to_impossible_places(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "a.png").mkdir()
    for path in (tmp_path / "file" / "a.png", tmp_path / "a.png"):
        with pytest.raises(UserError, match=r"a\.png.*expected a place that can be written"):
            image.write(path, torch.zeros(2, 2, 3))
    assert sorted(os.listdir(tmp_path)) == ["a.png", "file"]
    with pytest.raises(image.ImageError, match="expected to write jpeg"):  # JPEG's sides end at 65535
        image.write(tmp_path / "a.jpg", torch.zeros(1, 65536, 3))
    assert sorted(os.listdir(tmp_path)) == ["a.png", "file"]


# ---- read


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.ppm", "a.tga", "a.webp", "a.jp2"])
def test_formats_give_the_stored_pixels(tmp_path, name):
    options = {"lossless": True} if name == "a.webp" else {}
    Image.fromarray(PICTURE).save(tmp_path / name, **options)
    assert torch.equal(image.read(tmp_path / name), torch.from_numpy(PICTURE).float() / 255)
    assert image.size(tmp_path / name) == (20, 30)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"optimize": True}])
def test_jpeg_as_pillow_sees_it(tmp_path, options):
    path = tmp_path / "a.jpg"
    Image.fromarray(PICTURE).save(path, quality=90, subsampling=0, **options)
    seen = torch.from_numpy(np.asarray(Image.open(path)).copy()).float() / 255
    assert (image.read(path) - seen).abs().max() <= 2.01 / 255


def test_grey_palette_one_bit_and_one_frame_gif(tmp_path):
    grey = Image.fromarray(PICTURE[..., 0])
    files = {
        "grey.png": grey,
        "grey.tif": grey,
        "grey.pgm": grey,
        "one.png": grey.convert("1"),
        "one.tif": grey.convert("1"),
        "palette.png": Image.fromarray(PICTURE).quantize(16),
        "palette.gif": Image.fromarray(PICTURE).quantize(16),
        "palette.bmp": Image.fromarray(PICTURE).quantize(16),
    }
    for name, picture in files.items():
        picture.save(tmp_path / name)
        expected = torch.from_numpy(np.array(picture.convert("RGB"))).float() / 255
        assert torch.equal(image.read(tmp_path / name), expected), name


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp", "a.tga", "a.bmp", "a.jp2"])
@pytest.mark.parametrize("background", [WHITE, BLACK, GREEN])
def test_half_transparent_red_straight(tmp_path, name, background):
    options = {"lossless": True, "exact": True} if name == "a.webp" else {}
    Image.new("RGBA", (4, 4), (255, 0, 0, 128)).save(tmp_path / name, **options)
    a = 128 / 255
    expected = a * torch.tensor([1.0, 0, 0]) + (1 - a) * torch.tensor(background)
    assert (image.read(tmp_path / name, background) - expected).abs().max() < 1e-6


@pytest.mark.parametrize("background", [WHITE, BLACK, GREEN])
def test_half_transparent_red_associated(tmp_path, background):
    red = np.tile(np.float32([0.5, 0, 0, 0.5]), (4, 4, 1))
    expected = torch.tensor([0.5, 0, 0]) + 0.5 * torch.tensor(background)
    for name in ("a.exr", "a.tif"):  # OpenImageIO tags TIFF as associated unless told otherwise
        raw(tmp_path / name, red, oiio.FLOAT)
        assert torch.equal(image.read(tmp_path / name, background), expected.expand(4, 4, 3)), name


def test_transparent_greys_palettes_and_clear_colour(tmp_path):
    Image.fromarray(np.full((2, 2, 2), (200, 51), np.uint8)).save(tmp_path / "la.png")
    expected = torch.full((2, 2, 3), (0.2 * 200 / 255) + 0.8 * 1)
    assert (image.read(tmp_path / "la.png") - expected).abs().max() < 1e-6
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 0, 255])
    picture.putpixel((1, 0), 1)
    for name in ("p.png", "p.gif"):  # the second colour is transparent: blue must not show through
        picture.save(tmp_path / name, transparency=1)
        assert image.read(tmp_path / name, GREEN).tolist() == [[[1, 0, 0], [0, 1, 0]]], name


@pytest.mark.parametrize("name", ["a.bmp", "a.tga"])
def test_padding_is_no_alpha(tmp_path, name):
    """32 bits a pixel, the fourth byte unused: a BMP without masks, a Targa without alpha bits."""
    size, pixels = 4 * 4 * 4, bytes([10, 20, 200, 0] * 16)
    bmp = b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54 + size, 0, 0, 54, 40, 4, 4, 1, 32, 0, size, 0, 0, 0, 0)
    tga = struct.pack("<BBBHHBHHHHBB", 0, 0, 2, 0, 0, 0, 0, 0, 4, 4, 32, 0x20)
    (tmp_path / name).write_bytes((bmp if name == "a.bmp" else tga) + pixels)
    assert torch.equal(image.read(tmp_path / name), (torch.tensor([200.0, 20, 10]) / 255).expand(4, 4, 3))


def test_opaque_alpha_changes_nothing(tmp_path):
    Image.fromarray(np.dstack([PICTURE, np.full((20, 30), 255, np.uint8)])).save(tmp_path / "a.png")
    assert torch.equal(image.read(tmp_path / "a.png"), torch.from_numpy(PICTURE).float() / 255)


@pytest.mark.parametrize("background", [(1, 1), (0, 0, float("nan")), (1, 1, 1, 1)])
def test_bad_background(tmp_path, background):
    with pytest.raises(image.ImageError, match=r"background is .*expected three finite numbers"):
        image.read(tmp_path / "a.png", background)


@pytest.mark.parametrize("name", ["a.jpg", "a.tif"])
def test_cmyk_is_converted(tmp_path, name):
    planes = [Image.new("L", (8, 8), value) for value in (0, 128, 0, 64)]
    Image.merge("CMYK", planes).save(tmp_path / name)
    expected = torch.tensor([191, 95, 191]) / 255
    assert (image.read(tmp_path / name) - expected).abs().max() < 2 / 255


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied(tmp_path, name, orientation):
    corner = np.zeros((16, 32, 3), np.uint8)
    corner[:8, :8] = 255  # top left, as stored
    corner[8:, :8] = (255, 0, 0)  # below it
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(corner).save(tmp_path / name, exif=exif, quality=95, subsampling=0)
    seen = image.read(tmp_path / name)
    # EXIF says where the stored row 0 and column 0 are seen.
    turned = {
        1: corner,
        2: corner[:, ::-1],
        3: corner[::-1, ::-1],
        4: corner[::-1],
        5: corner.swapaxes(0, 1),
        6: corner[::-1].swapaxes(0, 1),
        7: corner[::-1, ::-1].swapaxes(0, 1),
        8: corner[:, ::-1].swapaxes(0, 1),
    }[orientation]
    assert image.size(tmp_path / name) == tuple(seen.shape[:2]) == turned.shape[:2]
    assert (seen - torch.from_numpy(turned.copy()).float() / 255).abs().max() < 0.1


def test_orientation_out_of_range_is_upright(tmp_path):
    raw(tmp_path / "a.exr", np.zeros((2, 3, 3), np.float32), oiio.FLOAT, tags={"Orientation": 77})
    assert image.size(tmp_path / "a.exr") == tuple(image.read(tmp_path / "a.exr").shape[:2]) == (2, 3)


def test_exr_channels_are_picked_by_name(tmp_path):
    stored = RNG.random((5, 6, 8)).astype(np.float32)
    stored[..., 6] = 1
    names = ("diffuse.B", "diffuse.G", "diffuse.R", "B", "G", "R", "A", "Z")
    raw(tmp_path / "layers.exr", stored, oiio.FLOAT, names)
    assert torch.equal(image.read(tmp_path / "layers.exr"), torch.from_numpy(stored[..., [5, 4, 3]].copy()))
    raw(tmp_path / "grey.exr", stored[..., :2].copy(), oiio.HALF, ("Y", "Z"))
    grey = torch.from_numpy(stored[..., :1].copy()).half().float()
    assert torch.equal(image.read(tmp_path / "grey.exr"), grey.expand(-1, -1, 3))


@pytest.mark.parametrize(
    "names", [("diffuse.R", "diffuse.G", "diffuse.B"), ("Y", "RY", "BY"), ("U", "V", "Z")]
)
def test_exr_without_colour(tmp_path, names):
    raw(tmp_path / "a.exr", np.zeros((2, 2, 3), np.float32), oiio.FLOAT, names)
    for door in (image.read, image.size):
        with pytest.raises(image.ImageError, match=r"a\.exr: the channels are .*; expected R, G, B or Y"):
            door(tmp_path / "a.exr")


def test_exr_windows_must_agree(tmp_path):
    raw(tmp_path / "a.exr", np.zeros((2, 2, 3), np.float32), oiio.FLOAT, x=1, full_width=9, full_height=9)
    with pytest.raises(
        image.ImageError, match=r"data window x 1\.\.3, y 0\.\.2 is not the display window x 0\.\.9"
    ):
        image.read(tmp_path / "a.exr")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["a.exr", "a.tif"])
def test_non_finite_pixels(tmp_path, name, bad):
    stored = np.zeros((6, 7, 3), np.float32)
    stored[2, 5, 1:] = stored[4, 0, 0] = bad
    raw(tmp_path / name, stored, oiio.FLOAT)
    with pytest.raises(image.ImageError, match="2 pixels are NaN or infinite, the first at row 2, column 5"):
        image.read(tmp_path / name)
    assert image.size(tmp_path / name) == (6, 7)


def test_wide_integers(tmp_path):
    Image.fromarray(PICTURE[..., 0].astype(np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(image.ImageError, match="pixels of type int; expected uint8, uint16 or floats"):
        image.read(tmp_path / "a.tif")


@pytest.mark.parametrize("name", ["a.gif", "a.tif", "a.webp"])
def test_several_images_in_one_file(tmp_path, name):
    more = [Image.fromarray(255 - PICTURE)]
    Image.fromarray(PICTURE).save(tmp_path / name, save_all=True, append_images=more)
    for door in (image.read, image.size):
        with pytest.raises(image.ImageError, match=r"holds several images .*; expected one"):
            door(tmp_path / name)


def test_animated_png_gives_its_default_picture(tmp_path):
    more = [Image.fromarray(255 - PICTURE)]
    Image.fromarray(PICTURE).save(tmp_path / "a.png", save_all=True, append_images=more)
    assert torch.equal(image.read(tmp_path / "a.png"), torch.from_numpy(PICTURE).float() / 255)


def test_bytes_count_not_the_ending(tmp_path):
    for name, kind in (("jpeg.png", "JPEG"), ("png.jpg", "PNG"), ("png.xyz", "PNG"), ("png", "PNG")):
        Image.fromarray(PICTURE).save(tmp_path / name, format=kind)
        assert image.read(tmp_path / name).shape == (20, 30, 3)
    for name in ("ü 日.png", "q?a=1#.png", "%d.png", "nul.PNG"):
        image.write(tmp_path / name, torch.ones(2, 2, 3))
        assert image.read(tmp_path / name).min() == 1


@pytest.mark.parametrize(
    "name", ["a.png", "a.jpg", "a.tif", "a.exr", "a.tga", "a.webp", "a.null", "a.txt", "a.term"]
)
def test_not_an_image(tmp_path, name):
    (tmp_path / name).write_text("hello world\n" * 20)
    for door in (image.read, image.size):
        with pytest.raises(image.ImageError, match=rf"{name}: .+; expected "):
            door(tmp_path / name)


def test_missing_empty_folder_link_pipe_and_impossible_names(tmp_path):
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "empty.png").touch()
    (tmp_path / "link.png").symlink_to(tmp_path / "nowhere.png")
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    os.mkfifo(tmp_path / "pipe.png")
    found = {
        "folder.png": "a folder",
        "empty.png": "an empty file",
        "link.png": "a dangling link",
        "loop.png": "a dangling link",
        "missing.png": "no such file",
        "pipe.png": "not a regular file",
        "zero\0.png": "no such file",
        os.fsdecode(b"\xff.png"): "utf-8",
    }
    for name, said in found.items():
        for door in (image.read, image.size):
            with pytest.raises(image.ImageError, match=f"{said}.*; expected an image file"):
                door(tmp_path / name)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_unreadable(tmp_path):
    image.write(tmp_path / "a.png", torch.zeros(2, 2, 3))
    (tmp_path / "a.png").chmod(0)
    with pytest.raises(image.ImageError, match="Permission denied"):
        image.read(tmp_path / "a.png")


@pytest.mark.parametrize(
    "name", ["a.png", "a.jpg", "progressive.jpg", "a.tif", "a.exr", "a.bmp", "a.webp", "a.gif", "a.ppm"]
)
def test_a_truncated_file_never_gives_part_of_an_image(tmp_path, name):
    path = tmp_path / name
    big = RNG.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    if name in ("a.png", "a.tif", "a.exr"):
        image.write(path, torch.from_numpy(big).float() / 255, bits=16)
    else:
        Image.fromarray(big).save(path, progressive=name.startswith("progressive"))
    whole, data = image.read(path), path.read_bytes()
    for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9):
        path.write_bytes(data[: int(len(data) * share)])
        with pytest.raises(image.ImageError, match=rf"{name}: .+; expected "):
            image.read(path)
    for cut in range(1, 40, 3):  # the last bytes may hold no pixels
        path.write_bytes(data[:-cut])
        with contextlib.suppress(image.ImageError):
            assert torch.equal(image.read(path), whole), cut


def test_damaged_png(tmp_path):
    Image.fromarray(PICTURE).save(tmp_path / "a.png")
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 0x55
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(image.ImageError, match="PNG read error"):
        image.read(tmp_path / "a.png")


def test_too_many_pixels_are_refused_from_the_header(tmp_path, monkeypatch):
    image.write(tmp_path / "a.exr", torch.zeros(10, 11, 3), bits=32)
    monkeypatch.setattr(image, "MAX_PIXELS", 109)
    for door in (image.read, image.size):
        with pytest.raises(image.ImageError, match="10 x 11 pixels; expected at most 109"):
            door(tmp_path / "a.exr")


def test_a_reason_that_quotes_bytes_is_shown(tmp_path):
    """OpenEXR's message holds the name of an attribute's type as it is in the file, here no UTF-8."""
    image.write(tmp_path / "a.exr", torch.rand(5, 4, 3), 16)
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data.replace(b"lineOrder\0lineOrder", b"lineOrder\0li\xeeeOrder"))
    with pytest.raises(image.ImageError, match=r"Invalid type 'li\\xeeeOrder'; expected"):
        image.read(tmp_path / "a.exr")


@quick
@given(
    st.binary(max_size=60),
    st.sampled_from(["a.png", "a.jpg", "a.tif", "a.exr", "a.bmp", "a.tga", "a.gif", "a"]),
)
def test_any_bytes_are_an_image_or_an_image_error(tmp_path, data, name):
    (tmp_path / name).write_bytes(data)
    try:
        said = None
        assert image.read(tmp_path / name).shape[2] == 3
    except image.ImageError as error:
        said = str(error)
    assert said is None or (name in said and "; expected " in said and "\n" not in said)


def test_nothing_is_left_for_openimageio_to_print(tmp_path, capfd):
    """Errors that nobody fetched are printed to stderr when a file or the process ends."""
    Image.fromarray(PICTURE).save(tmp_path / "a.webp")
    Image.fromarray(PICTURE).save(tmp_path / "a.jpg")
    (tmp_path / "t.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:900])
    (tmp_path / "t.png").write_text("no")
    for name, bits in (("w.png", 16), ("w.jpg", 8), ("w.tif", 32), ("w.exr", 16)):
        image.write(tmp_path / name, torch.rand(5, 4, 3), bits)
    for name in os.listdir(tmp_path):
        for door in (image.read, image.size):
            with contextlib.suppress(image.ImageError):
                door(tmp_path / name)
    gc.collect()
    assert oiio.geterror() == ""
    assert "".join(capfd.readouterr()) == ""


# ---- downsample


@quick
@given(st.integers(1, 7), sides(1, 6), st.tuples(st.integers(0, 6), st.integers(0, 6)), st.integers(0, 2**31))
def test_downsample_is_the_mean_of_blocks(factor, blocks, rest, seed):
    rows, columns, _ = blocks
    shape = (rows * factor + rest[0] % factor, columns * factor + rest[1] % factor, 3)
    values = torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    whole = values[: rows * factor, : columns * factor].double()
    mean = whole.reshape(rows, factor, columns, factor, 3).mean((1, 3))
    small = image.downsample(values, factor)
    assert small.dtype == torch.float32
    assert small.shape == (rows, columns, 3)
    assert (small - mean).abs().max() < 1e-6


def test_downsample_leaves_the_remainder_out():
    values = torch.zeros(5, 7, 3)
    values[4], values[:, 6] = 1, 1
    assert torch.equal(image.downsample(values, 2), torch.zeros(2, 3, 3))


def test_downsample_takes_views_and_keeps_factor_one():
    values = torch.rand(3, 6, 8).permute(1, 2, 0)
    assert image.downsample(values, 1) is values
    expected = values.reshape(3, 2, 4, 2, 3).mean((1, 3))
    assert (image.downsample(values.requires_grad_(), 2) - expected).abs().max() < 1e-6


@pytest.mark.parametrize("factor", [0, -1, 5, 2.0, True])
def test_downsample_refuses_factors(factor):
    with pytest.raises(
        image.ImageError, match=r"factor is .*; expected a whole number from 1 to 4, .* 4 x 9"
    ):
        image.downsample(torch.zeros(4, 9, 3), factor)


def test_extensions():
    assert {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"} <= set(image.EXTENSIONS)
    assert all(ending == ending.lower() and ending.startswith(".") for ending in image.EXTENSIONS)
