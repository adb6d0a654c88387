"""Scenes: which views are known, where the probes lie, what is refused; and every file of conf/scene.

Real sets (knights, chess, fern, ...) are beside the checkout in ../shared/data; where they are absent, as for a user,
those tests skip. All else is drawn on the spot: views of a few pixels, whose grey value tells which file they are.
"""

import functools
import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import MissingConfigException
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from omegaconf import DictConfig, OmegaConf

from viinter import image, scenes
from viinter.config import Holdout, Layout, OutOfRange, SceneConfig, UserError
from viinter.scenes import SceneError, load, nearest_mix, posed_mix, position

REPOSITORY = Path(__file__).resolve().parents[1]
REAL = REPOSITORY.parent / "shared" / "data"


def real(name: str) -> str:
    if not (REAL / name).is_dir():
        pytest.skip(f"no real data: {REAL / name}")
    return str(REAL / name)


def config(root: object, layout: Layout = Layout.folder, **settings: object) -> SceneConfig:
    return SceneConfig(name="test", layout=layout, root=str(root), **settings)


def grey(value: float, height: int = 4, width: int = 6) -> torch.Tensor:
    return torch.full((height, width, 3), float(value))


def draw(folder: Path, names: list[str], height: int = 4, width: int = 6) -> Path:
    """Writes one 8-bit grey image for each name; image k has the value k / 255."""
    for k, name in enumerate(names):
        image.write(folder / name, grey(k / 255, height, width))
    return folder


def numbers(views: torch.Tensor) -> list[int]:
    """Which file each view was, as drawn by `draw`."""
    return (views[..., 0, 0, 0] * 255).round().int().tolist()


def grid(folder: Path, rows: range, columns: range, name: str = "view_{:02d}_{:02d}.png", skip: tuple = ()) -> Path:
    return draw(folder, [name.format(r, c) for r in rows for c in columns if (r, c) not in skip])


def check_scene(scene: scenes.Scene) -> None:
    """What holds for every scene."""
    assert scene.views.dtype == torch.float32
    assert scene.views.shape == (scene.n, scene.height, scene.width, 3)
    assert scene.views.min() >= 0
    assert scene.views.max() <= 1
    assert len(scene.names) == scene.n == len(set(scene.names))
    assert all(0 <= i < scene.n for i in scene.endpoints)
    assert list(scene.probes) == list(scene.left_out)
    assert next(iter(scene.probes)) == "novel"
    targets = [probe.name for kind, probes in scene.probes.items() for probe in probes if kind != "novel_posed"]
    assert len(targets) == len(set(targets))
    assert not set(targets) & set(scene.names)
    posed = [probe.name for probe in scene.probes.get("novel_posed", [])]
    assert posed in ([], [probe.name for probe in scene.probes["novel"]])
    for kind, probes in scene.probes.items():
        for probe in probes:
            assert probe.target.shape == scene.views.shape[1:]
            assert probe.target.min() >= 0
            assert probe.target.max() <= 1
            assert math.isclose(sum(weight for _, weight in probe.mix), 1)
            assert all(0 <= i < scene.n for i, _ in probe.mix)
            assert kind == "novel_posed" or all(0 <= weight <= 1 for _, weight in probe.mix)
            assert len({i for i, _ in probe.mix}) == len(probe.mix)


# Planar


def test_knights_is_the_whole_grid_of_the_archive():
    scene = load(config(real("stanford/knights"), Layout.planar))
    check_scene(scene)
    assert scene.views.shape == (25, 256, 256, 3)
    assert [position(name) for name in scene.names] == [(r, c) for r in range(0, 17, 4) for c in range(0, 17, 4)]
    assert {kind: len(probes) for kind, probes in scene.probes.items()} == {
        "novel": 40,
        "novel_cells": 16,
        "novel_quarters": 80,
    }
    assert scene.left_out == {"novel": 0, "novel_cells": 0, "novel_quarters": 0}
    assert scene.endpoints == (0, 24)
    # The mix of rows and columns is the probe's row and column: that is what "stand for it" means on a grid.
    places = torch.tensor([position(name) for name in scene.names], dtype=torch.float64)
    for probes in scene.probes.values():
        for probe in probes:
            mixed = sum(weight * places[i] for i, weight in probe.mix)
            assert tuple(mixed.tolist()) == position(probe.name)
    # And of the views: half-way between neighbours, the mean is nearer than a stranger.
    probe = scene.probes["novel"][0]
    mean = sum(weight * scene.views[i] for i, weight in probe.mix)
    assert (mean - probe.target).square().mean() < (scene.views[24] - probe.target).square().mean()


def test_chess_has_even_rows_and_columns_only():
    root = real("stanford/chess")
    plan = scenes.planar(config(root, Layout.planar), Path(root))  # without reading 65 images
    assert len(plan.known) == 25
    assert [len(probes) for probes in plan.held.values()] == [40, 16, 0]
    assert plan.left_out == {"novel": 0, "novel_cells": 0, "novel_quarters": 80}


def test_the_mixes_of_a_small_grid(tmp_path):
    scene = load(config(grid(tmp_path, range(5), range(5)), Layout.planar))
    check_scene(scene)
    assert numbers(scene.views) == [0, 4, 20, 24]
    assert [(position(p.name), p.mix) for p in scene.probes["novel"]] == [
        ((0, 2), ((0, 0.5), (1, 0.5))),
        ((2, 0), ((0, 0.5), (2, 0.5))),
        ((2, 4), ((1, 0.5), (3, 0.5))),
        ((4, 2), ((2, 0.5), (3, 0.5))),
    ]
    assert [(position(p.name), p.mix) for p in scene.probes["novel_cells"]] == [
        ((2, 2), ((0, 0.25), (1, 0.25), (2, 0.25), (3, 0.25)))
    ]
    quarters = {position(p.name): p.mix for p in scene.probes["novel_quarters"]}
    assert len(quarters) == 8
    assert quarters[0, 1] == ((0, 0.75), (1, 0.25))
    assert quarters[0, 3] == ((0, 0.25), (1, 0.75))
    assert quarters[3, 4] == ((1, 0.25), (3, 0.75))
    assert numbers(torch.stack([p.target for p in scene.probes["novel_cells"]])) == [12]


def test_known_rows_and_columns_are_multiples_of_four_of_the_files_own_numbers(tmp_path):
    scene = load(config(grid(tmp_path, range(1, 10), range(3, 14)), Layout.planar))
    assert [position(name) for name in scene.names] == [(r, c) for r in (4, 8) for c in (4, 8, 12)]
    one_row = load(config(grid(tmp_path / "row", range(1), range(9)), Layout.planar))
    assert [len(probes) for probes in one_row.probes.values()] == [2, 0, 4]


def test_missing_probes_are_left_out_and_counted(tmp_path):
    scene = load(config(grid(tmp_path, range(5), range(5), skip=((0, 2), (2, 2), (1, 0))), Layout.planar))
    check_scene(scene)
    assert scene.left_out == {"novel": 1, "novel_cells": 1, "novel_quarters": 1}


def test_a_grid_with_holes_names_them(tmp_path):
    grid(tmp_path, range(5), range(9), skip=((0, 4), (4, 8)))
    with pytest.raises(SceneError, match=r"\(0, 4\), \(4, 8\); expected, of rows 0 to 4 and columns 0 to 8"):
        load(config(tmp_path, Layout.planar))
    assert load(config(tmp_path, Layout.planar, holdout=Holdout.none)).n == 30


def test_two_files_at_one_place_are_named(tmp_path):
    draw(grid(tmp_path, range(5), range(5)), ["other_04_00.png"])
    with pytest.raises(SceneError, match=r"other_04_00.png and view_04_00.png are both row 4, column 0"):
        load(config(tmp_path, Layout.planar))


def test_files_without_row_and_column(tmp_path):
    draw(grid(tmp_path, range(5), range(5)), ["thumbnail.png"])
    assert (
        "Passed over, with no row and column in the name: thumbnail.png." in load(config(tmp_path, Layout.planar)).notes
    )
    with pytest.raises(SceneError, match=r"of any of 2 images, such as a.png; expected names like view_00_04.png"):
        load(config(draw(tmp_path / "loose", ["a.png", "b.png"]), Layout.planar))


@pytest.mark.parametrize(("rows", "message"), [(range(1, 4), "no known view"), (range(1), r"1 known view\(s\)")])
def test_a_grid_too_small_to_interpolate(tmp_path, rows, message):
    with pytest.raises(SceneError, match=message):
        load(config(grid(tmp_path, rows, range(4)), Layout.planar))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("out_00_16_-381.909271_1103.376221.jpg", (0, 16)),
        ("out_00_00_-381.909271_-776.700012_.png", (0, 0)),
        ("out_08_04_12_34_.png", (8, 4)),
        ("view_14_02.JPG", (14, 2)),
        ("my_scene_2022_08_12.exr", (8, 12)),
        ("a.b_100_004.tiff", (100, 4)),
        ("04_08.png", (4, 8)),
        ("out_04_08_1e-05_.5.png", (4, 8)),
        ("view_4_8.png", None),
        ("view_04.png", None),
        ("view_04_08_.png", None),
        ("view_04_08_1.0.png", None),
        ("view_04_08_left.png", None),
        ("view-04-08.png", None),
    ],
)
def test_position(name, place):
    assert position(name) == place


@given(
    prefix=st.sampled_from(["out", "view", "my_scene", "17x17", "a b.c", "x_00"]),
    r=st.integers(0, 120),
    c=st.integers(0, 120),
    y=st.floats(-2000, 2000),
    x=st.floats(-2000, 2000),
    style=st.sampled_from(
        ["{p}_{r:02d}_{c:02d}", "{p}_{r:02d}_{c:02d}_{y:f}_{x:f}", "{p}_{r:02d}_{c:02d}_{y:f}_{x:f}_"]
    ),
    ending=st.sampled_from(image.EXTENSIONS),
)
def test_position_comes_back_from_every_style_of_name(prefix, r, c, y, x, style, ending):
    assert position(style.format(p=prefix, r=r, c=c, y=y, x=x) + ending) == (r, c)


@pytest.mark.parametrize("name", ["out_{:02d}_{:02d}_-381.909271_{:f}.png", "out_{:02d}_{:02d}_-1.5_{:f}_.jpg"])
def test_both_styles_of_the_archive_load(tmp_path, name):
    draw(tmp_path, [name.format(r, c, 1.25 * c) for r in (0, 2, 4) for c in (0, 2, 4)])
    scene = load(config(tmp_path, Layout.planar))
    assert [position(n) for n in scene.names] == [(0, 0), (0, 4), (4, 0), (4, 4)]
    assert [len(probes) for probes in scene.probes.values()] == [4, 1, 0]


# LLFF


def test_fern_probes_lie_between_the_nearest_cameras():
    scene = load(config(real("llff/fern"), Layout.llff, images="images_8"))
    check_scene(scene)
    assert scene.views.shape == (18, 378, 504, 3)
    assert [probe.name for probe in scene.probes["novel"]] == ["image004.png", "image012.png"]
    centres = np.load(real("llff/fern") + "/poses_bounds.npy")[:, [3, 8, 13]]
    for probe, held in zip(scene.probes["novel"], (4, 12), strict=True):
        distance = {name: np.linalg.norm(centres[int(name[5:8])] - centres[held]) for name in scene.names}
        (i, _), (j, t) = probe.mix
        assert [scene.names[i], scene.names[j]] == sorted(distance, key=distance.get)[:2]
        a, b = (centres[int(scene.names[k][5:8])] for k in (i, j))
        on_segment = np.linspace(0, 1, 10001)[:, None] * (b - a) + a
        nearest = np.linalg.norm(on_segment - centres[held], axis=1).argmin() / 10000
        assert t == pytest.approx(nearest, abs=1e-4)


def test_fern_probes_are_placed_by_all_cameras_too():
    """To first order image motion is linear in translation and rotation: both come to the probe's own."""
    scene = load(config(real("llff/fern"), Layout.llff, images="images_8"))
    poses = np.load(real("llff/fern") + "/poses_bounds.npy")[:, :15].reshape(-1, 3, 5)[:, :, :4]
    known = poses[[int(name[5:8]) for name in scene.names]]
    assert [probe.name for probe in scene.probes["novel_posed"]] == [probe.name for probe in scene.probes["novel"]]
    for probe, segment in zip(scene.probes["novel_posed"], scene.probes["novel"], strict=True):
        assert probe.target is segment.target
        off = {}
        for kind, mix in (("novel", segment.mix), ("novel_posed", probe.mix)):
            weights = np.zeros(scene.n)
            weights[[view for view, _ in mix]] = [weight for _, weight in mix]
            off[kind] = np.abs(np.tensordot(weights, known, 1) - poses[int(probe.name[5:8])]).max(0)
        assert max(abs(weight) for _, weight in probe.mix) < 1
        assert off["novel_posed"] == pytest.approx([0, 0, 0, 0], abs=2e-3)
        assert off["novel"][3] > 0.3
        assert off["novel"][:3].max() > 0.009


def cameras(centres: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Cameras [n, 3, 4] at `centres` [n, 3], turned by the rotation vectors `turns` [n, 3]."""
    return np.concatenate([rotations(turns), centres[:, :, None]], 2)


def rotations(turns: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] about the rotation vectors [..., 3]."""
    x, y, z = np.moveaxis(turns, -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack([np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], -2)
    return torch.linalg.matrix_exp(torch.from_numpy(skew)).numpy()


@given(st.integers(0, 2**32 - 1), st.integers(2, 30))
def test_posed_mixes(seed, n):
    """Small motions cancel out wherever enough cameras allow it; unit, origin and axes of the world do not matter."""
    random = np.random.default_rng(seed)
    target, *known = cameras(random.normal(size=(n + 1, 3)), 0.01 * random.normal(size=(n + 1, 3)))
    known = np.array(known)
    mix = posed_mix(target, known)
    assert [view for view, _ in mix] == list(range(n))
    weights = np.array([weight for _, weight in mix])
    assert weights.sum() == pytest.approx(1, abs=1e-9)
    if n >= 14:  # twice as many as there are conditions: never nearly degenerate
        assert np.tensordot(weights, known, 1) == pytest.approx(target, abs=0.02)
    turn, scale = rotations(random.normal(size=3)), 7.3
    move = np.concatenate([turn, random.normal(size=(3, 1))], 1)

    def moved(camera: np.ndarray) -> np.ndarray:
        return np.concatenate([turn @ camera[:, :3], scale * turn @ camera[:, 3:] + move[:, 3:]], 1)

    again = posed_mix(moved(target), np.array([moved(camera) for camera in known]))
    assert [weight for _, weight in again] == pytest.approx(weights.tolist(), abs=1e-6)


@given(
    arrays(np.float64, (9, 3, 3), elements=st.floats(-1, 1)),
    arrays(np.float64, (9, 3), elements=st.floats(-1e29, 1e29)),
)
def test_any_cameras_have_a_posed_mix(axes, centres):
    target, *known = np.concatenate([axes, centres[:, :, None]], 2)
    weights = np.array([weight for _, weight in posed_mix(target, np.array(known))])
    assert weights.sum() == pytest.approx(1, abs=1e-6)


def test_posed_mix_in_the_middle_and_at_one_place():
    ends = cameras(np.array([[0.0, 0, 0], [2, 0, 0]]), np.array([[0, 0.1, 0], [0, -0.1, 0]]))
    (middle,) = cameras(np.array([[1.0, 0, 0]]), np.zeros((1, 3)))
    assert posed_mix(middle, ends) == ((0, pytest.approx(0.5)), (1, pytest.approx(0.5)))
    assert posed_mix(middle, np.stack([middle] * 4)) == tuple((k, pytest.approx(0.25)) for k in range(4))


def test_horns_falls_back_to_images_8():
    scene = load(config(real("llff/horns"), Layout.llff, downsample=8))
    check_scene(scene)
    assert scene.n == 54
    assert len(scene.probes["novel"]) == 8
    assert "The images are those of images_8." in scene.notes
    # Some nearest cameras are not neighbours in file order: the rows were walked to and fro.
    assert any(abs(i - j) > 1 for probe in scene.probes["novel"] for (i, _), (j, _) in [probe.mix])


def capture(folder: Path, count: int, poses: object = None, images: str = "images_4") -> Path:
    draw(folder / images, [f"im{k:03d}.png" for k in range(count)])
    if poses is not None:
        np.save(folder / "poses_bounds.npy", poses)
    return folder


def line_of_poses(count: int) -> np.ndarray:
    """Cameras at x = k^2: not evenly spaced, so that weights differ from 1/2."""
    poses = np.zeros((count, 17))
    poses[:, 3] = np.arange(count) ** 2
    return poses


def test_llff_weights_on_a_line(tmp_path):
    scene = load(config(capture(tmp_path, 14, line_of_poses(14)), Layout.llff))
    check_scene(scene)
    assert numbers(scene.views) == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11, 13]
    first, second = scene.probes["novel"]
    assert numbers(torch.stack([first.target, second.target])) == [4, 12]
    assert first.mix == ((3, pytest.approx(9 / 16)), (4, pytest.approx(7 / 16)))  # 16 between 9 and 25
    assert second.mix == ((10, pytest.approx(25 / 48)), (11, pytest.approx(23 / 48)))  # 144 between 121 and 169


def test_llff_without_poses_takes_neighbours_in_file_order(tmp_path):
    scene = load(config(capture(tmp_path, 14), Layout.llff))
    assert [probe.mix for probe in scene.probes["novel"]] == [((3, 0.5), (4, 0.5)), ((10, 0.5), (11, 0.5))]


@pytest.mark.parametrize(("count", "held"), [(4, []), (5, []), (6, [4]), (13, [4]), (14, [4, 12])])
def test_the_last_image_is_never_held_out(tmp_path, count, held):
    scene = load(config(capture(tmp_path, count), Layout.llff))
    assert [int(probe.name[2:5]) for probe in scene.probes["novel"]] == held
    assert scene.n == count - len(held)


def test_holdout_none_takes_the_first_views_and_reads_no_poses(tmp_path):
    capture(tmp_path, 14)
    (tmp_path / "poses_bounds.npy").write_bytes(b"no poses at all")
    scene = load(config(tmp_path, Layout.llff, holdout=Holdout.none, max_views=9))
    check_scene(scene)
    assert numbers(scene.views) == list(range(9))
    assert scene.probes == {"novel": []}
    assert "Poses were not read: scene.holdout=none." in scene.notes
    assert "Known are the first 9 of 14 images (scene.max_views)." in scene.notes
    with pytest.raises(SceneError, match=r"poses_bounds\.npy"):
        load(config(tmp_path, Layout.llff))


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.zeros((13, 17)), "13 rows for 14 images"),
        (np.zeros((15, 17)), "15 rows for 14 images"),
        (np.zeros((14, 15)), r"float64 of shape \[14, 15\]; expected numbers of shape \[14, 17\]"),
        (np.zeros(14), r"shape \[14\]"),
        (np.full((14, 17), "x"), "<U1 of shape"),
        (
            np.where(np.arange(17) == 8, np.nan, np.zeros((14, 17))),
            r"image 0 has .* \[0.0, 0.0, 0.0, nan\], .* below 1e\+30",
        ),
        (
            np.where(np.arange(17) == 6, 1e4, np.zeros((14, 17))),
            r"image 0 has .* \[0.0, 10000.0, 0.0, 0.0\], .* length 1",
        ),
        (np.array([{}] * 14), "allow_pickle"),
    ],
)
def test_poses_that_do_not_fit(tmp_path, poses, message):
    with pytest.raises(SceneError, match=message) as caught:
        load(config(capture(tmp_path, 14, poses), Layout.llff))
    assert "poses_bounds.npy" in str(caught.value)


def test_truncated_poses(tmp_path):
    file = capture(tmp_path, 14, line_of_poses(14)) / "poses_bounds.npy"
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(SceneError, match=r"poses_bounds.npy: .*; expected a NumPy array"):
        load(config(tmp_path, Layout.llff))


def test_which_folder_of_images(tmp_path):
    for count, images in ((3, "images"), (4, "images_8"), (5, "images_4"), (6, "images_2")):
        capture(tmp_path, count, images=images)
        expected = 5 if images == "images_2" else count
        assert load(config(tmp_path, Layout.llff)).n == expected
    assert load(config(tmp_path, Layout.llff, images="images_2", holdout=Holdout.none)).n == 6
    with pytest.raises(SceneError, match=r"no folder images_3; there is images, images_2, images_4, images_8"):
        load(config(tmp_path, Layout.llff, images="images_3"))
    (tmp_path / "bare" / "pictures").mkdir(parents=True)
    with pytest.raises(
        SceneError, match=r"no folder images_4 or images_8 or images; there is pictures. .*scene.images"
    ):
        load(config(tmp_path / "bare", Layout.llff))


@given(
    known=arrays(np.float64, st.tuples(st.integers(2, 8), st.just(3)), elements=st.floats(-100, 100, width=16)),
    target=arrays(np.float64, 3, elements=st.floats(-100, 100, width=16)),
)
def test_nearest_mix_is_the_nearest_point_of_the_segment(known, target):
    (i, weight), (j, t) = nearest_mix(target, known)
    assert i != j
    assert weight == 1 - t
    assert 0 <= t <= 1
    distance = np.linalg.norm(known - target, axis=1)
    others = np.delete(distance, [i, j])
    assert distance[i] <= distance[j] <= others.min(initial=math.inf)
    here = np.linalg.norm(known[i] + t * (known[j] - known[i]) - target)
    along = np.linspace(0, 1, 101)[:, None] * (known[j] - known[i]) + known[i]
    assert here <= np.linalg.norm(along - target, axis=1).min() + 1e-9 * (1 + here)


def test_nearest_mix_clamps_and_survives_cameras_at_one_place():
    known = np.array([[0.0, 0, 0], [1, 0, 0]])
    assert nearest_mix(np.array([-3.0, 0, 0]), known) == ((0, 1.0), (1, 0.0))
    assert nearest_mix(np.array([0.25, 9, 0]), known) == ((0, 0.75), (1, 0.25))
    assert nearest_mix(np.array([5.0, 0, 0]), np.zeros((3, 3))) == ((0, 0.5), (1, 0.5))


# Studio


def test_head_is_cropped_to_its_masks():
    scene = load(config(real("studio/head"), Layout.studio))
    check_scene(scene)
    assert scene.n == 26
    assert [probe.name for probe in scene.probes["novel"]] == [f"DSC_00{k}.png" for k in (11, 19, 27, 35)]
    assert (scene.width, scene.height) < (500, 500)
    masks = torch.stack([image.read(f)[..., 0] for f in sorted((REAL / "studio/head/masks").iterdir())]) > 0.5
    ys, xs = masks.any(0).any(1).nonzero(), masks.any(0).any(0).nonzero()
    y0, y1, x0, x1 = ys.min(), ys.max() + 1, xs.min(), xs.max() + 1
    assert torch.equal(scene.views[0], image.read(REAL / "studio/head/images/DSC_0007.png")[y0:y1, x0:x1])
    assert f"Cropped to the masks' box, [{x0},{y0},{x1},{y1}] of 500 x 500 pixels." in scene.notes


def studio_set(folder: Path, boxes: list[tuple[int, int, int, int] | None], value: float = 1.0) -> Path:
    """Images of 12 x 9 pixels whose masks are bright in a box each; None draws a black mask."""
    draw(folder / "images", [f"{k:02d}.png" for k in range(len(boxes))], 9, 12)
    for k, box in enumerate(boxes):
        mask = grey(0, 9, 12)
        if box:
            mask[box[1] : box[3], box[0] : box[2]] = value
        image.write(folder / "masks" / f"{k:02d}.png", mask)
    return folder


@pytest.mark.parametrize("value", [1.0, 1 / 255])
@pytest.mark.parametrize(
    ("factor", "size"), [(1, (5, 5)), (2, (3, 3)), (4, (2, 2))]
)  # box [3,2,8,7] -> at half [1,1,4,4], at a quarter [0,0,2,2]
def test_the_crop_is_the_union_of_the_masks(tmp_path, value, factor, size):
    boxes = [(4, 3, 5, 5), (3, 4, 6, 6), None, (7, 2, 8, 7)]
    scene = load(config(studio_set(tmp_path, boxes, value), Layout.studio, downsample=factor))
    check_scene(scene)
    assert (scene.height, scene.width) == size


def test_a_given_crop_takes_the_place_of_masks(tmp_path):
    studio_set(tmp_path, [None] * 3)
    scene = load(config(tmp_path, Layout.studio, crop=[1, 0, 5, 9]))
    assert (scene.height, scene.width) == (9, 4)
    with pytest.raises(SceneError, match="masks: all masks are black"):
        load(config(tmp_path, Layout.studio))


def test_masks_that_do_not_fit(tmp_path):
    studio_set(tmp_path, [(0, 0, 2, 2)] * 3)
    image.write(tmp_path / "images" / "03.png", grey(0, 9, 12))
    with pytest.raises(SceneError, match=r"no mask of the same name for 03.png"):
        load(config(tmp_path, Layout.studio))
    image.write(tmp_path / "masks" / "03.png", grey(0, 8, 12))
    with pytest.raises(SceneError, match=r"masks: 00.png is 12 x 9 pixels, 03.png is 12 x 8"):
        load(config(tmp_path, Layout.studio))
    draw(tmp_path / "masks", [f"{k:02d}.png" for k in range(4)], 5, 5)
    with pytest.raises(SceneError, match=r"masks are 5 x 5 pixels; expected the images' 12 x 9"):
        load(config(tmp_path, Layout.studio))


def test_studio_goes_by_file_order_and_is_no_ring(tmp_path):
    scene = load(config(capture(tmp_path, 13, images="images"), Layout.studio))
    assert [(probe.name, probe.mix) for probe in scene.probes["novel"]] == [("im004.png", ((3, 0.5), (4, 0.5)))]
    with pytest.raises(SceneError, match="no folder images; there is x"):
        load(config(draw(tmp_path / "bare" / "x", ["a.png"]).parent, Layout.studio))


# Pair and folder


def test_portrait_is_a_pair():
    scene = load(config(real("pairs/portrait"), Layout.pair, downsample=4))
    check_scene(scene)
    assert scene.names == ["one.png", "two.png"]
    assert scene.probes == {"novel": []}
    assert scene.endpoints == (0, 1)


def test_a_pair_is_two(tmp_path):
    with pytest.raises(SceneError, match=r"1 image \(a.png\); scene=pair expects exactly 2"):
        load(config(draw(tmp_path, ["a.png"]), Layout.pair))
    with pytest.raises(SceneError, match=r"3 images \(a.png, b.png, c.png\); scene=pair expects exactly 2"):
        load(config(draw(tmp_path, ["a.png", "b.png", "c.png"]), Layout.pair))


def test_a_folder_is_read_in_numeric_order(tmp_path):
    draw(tmp_path, [f"Frame{k}.png" for k in range(1, 12)])  # image k has the value k - 1
    draw(tmp_path / "inner", ["frame0.png"])
    (tmp_path / ".frame0.png").write_text("a hidden file")
    (tmp_path / "notes.txt").write_text("no image")
    scene = load(config(tmp_path))
    check_scene(scene)
    assert numbers(scene.views) == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10]
    assert [(probe.name, probe.mix) for probe in scene.probes["novel"]] == [("Frame5.png", ((3, 0.5), (4, 0.5)))]


@pytest.mark.parametrize(("count", "held"), [(2, 0), (8, 0), (9, 1), (14, 2)])
def test_a_small_folder_has_no_probes(tmp_path, count, held):
    scene = load(config(draw(tmp_path, [f"{k}.png" for k in range(count)])))
    check_scene(scene)
    assert (scene.n, len(scene.probes["novel"])) == (count - held, held)
    assert any("no probes" in note for note in scene.notes) == (held == 0)


def test_a_folder_with_one_image_stops(tmp_path):
    with pytest.raises(UserError, match=r"1 image \(a.png\); expected at least 2"):
        load(config(draw(tmp_path, ["a.png"])))


# What every layout shares


@pytest.mark.parametrize("layout", list(Layout))
def test_a_missing_folder_says_what_there_is_and_how_to_get_it(tmp_path, layout):
    (tmp_path / "stanford" / "chess").mkdir(parents=True)
    cfg = config(tmp_path / "stanford" / "knights", layout, url=["http://example.org/x.zip"])
    with pytest.raises(SceneError) as caught:
        load(cfg)
    message = str(caught.value)
    assert f"scene.root={tmp_path}/stanford/knights: no such folder" in message
    assert f"There is {tmp_path}/stanford with chess." in message
    assert "paths.data=DIR" in message
    assert ("viinter.download scene=" in message) == (layout in (Layout.planar, Layout.llff))
    cfg.url = None
    with pytest.raises(SceneError) as caught:
        load(cfg)
    assert "viinter.download" not in str(caught.value)


def test_a_root_that_is_relative_a_file_or_far_from_anything(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draw(tmp_path / "scene", ["a.png", "b.png"])
    assert load(config("scene")).n == 2
    with pytest.raises(
        SceneError, match=rf"no such folder; expected the folder {tmp_path}/a/b/c. There is {tmp_path} "
    ):
        load(config("a/b/c"))
    with pytest.raises(SceneError, match=r"a.png: a file; expected the folder"):
        load(config("scene/a.png"))


@pytest.mark.parametrize("layout", list(Layout))
def test_an_empty_folder(tmp_path, layout):
    for name in ("images", "images_4"):
        (tmp_path / name).mkdir()
    with pytest.raises(SceneError, match=r"no images; there is .*Expected files ending in .png"):
        load(config(tmp_path, layout))


def test_views_of_different_sizes_are_named(tmp_path):
    draw(tmp_path, ["a.png", "b.png"])
    draw(tmp_path, ["c.png"], 5, 6)
    with pytest.raises(SceneError, match=r"a.png is 6 x 4 pixels, c.png is 6 x 5; expected views of one size"):
        load(config(tmp_path))


@pytest.mark.parametrize("damage", [lambda b: b"", lambda b: b"text", lambda b: b[: len(b) * 3 // 4]])
def test_an_unreadable_file_is_named(tmp_path, damage):
    draw(tmp_path, ["a.png", "b.png"], 64, 64)
    image.write(tmp_path / "b.png", torch.rand(64, 64, 3))
    (tmp_path / "b.png").write_bytes(damage((tmp_path / "b.png").read_bytes()))
    with pytest.raises(UserError, match=r"b.png"):
        load(config(tmp_path))


def test_only_known_views_and_probes_are_opened(tmp_path):
    grid(tmp_path, range(5), range(5))
    (tmp_path / "view_01_01.png").write_bytes(b"neither known nor probe")
    assert load(config(tmp_path, Layout.planar)).n == 4


def test_downsample_then_crop(tmp_path):
    picture = torch.linspace(0, 1, 8 * 12 * 3).reshape(8, 12, 3)
    for name in ("a.exr", "b.exr"):
        image.write(tmp_path / name, picture, bits=32)
    scene = load(config(tmp_path, downsample=2, crop=[1, 0, 5, 3]))
    assert scene.views.shape == (2, 3, 4, 3)
    blocks = picture.reshape(4, 2, 6, 2, 3).mean((1, 3))[0:3, 1:5]
    assert torch.allclose(scene.views[0], blocks, atol=1e-6)


@pytest.mark.parametrize("factor", range(2, 17))
def test_white_stays_white_when_shrunk(tmp_path, factor):
    for name in ("a.png", "b.png"):
        image.write(tmp_path / name, grey(1, 16, 16))
    views = load(config(tmp_path, downsample=factor)).views  # out_of_range=refuse
    assert views.max() <= 1
    assert views.min() > 1 - 1e-5


@pytest.mark.parametrize("crop", [[0, 0, 4, 2], [0, 0, 3, 3], [2, 0, 2, 2], [-1, 0, 2, 2], [0, 0, 2]])
def test_a_crop_outside_the_view(tmp_path, crop):
    draw(tmp_path, ["a.png", "b.png"])  # 6 x 4, so 3 x 2 after downsampling
    with pytest.raises(SceneError, match=r"scene.crop=.*\[0,0,3,2\]"):
        load(config(tmp_path, downsample=2, crop=crop))


@pytest.mark.parametrize("factor", [0, 5])
def test_a_factor_larger_than_the_view(tmp_path, factor):
    with pytest.raises(SceneError, match=rf"scene.downsample={factor}: expected 1 to 4; views are 6 x 4"):
        load(config(draw(tmp_path, ["a.png", "b.png"]), downsample=factor))


@pytest.mark.parametrize(
    ("downsample", "most", "size"),
    [(1, 24, (4, 6)), (1, 23, (2, 3)), (2, 24, (2, 3)), (1, 5, (1, 2)), (1, 1, (1, 1)), (1, None, (4, 6))],
)
def test_most_pixels_are_kept_to_by_a_whole_factor(tmp_path, downsample, most, size):
    scene = load(config(draw(tmp_path, ["a.png", "b.png"]), downsample=downsample, max_pixels=most))
    assert (scene.height, scene.width) == size


def test_only_in_a_studio_a_demonstration_passes_the_views_between_its_endpoints():
    assert scenes.tour(Layout.studio, (1, 4)) == [1, 2, 3, 4]
    assert scenes.tour(Layout.studio, (4, 2)) == [4, 3, 2]
    assert scenes.tour(Layout.planar, (1, 4)) == [1, 4]


@pytest.mark.parametrize("endpoints", [[0, 3], [-1, 1], [1, 1], [1]])
def test_endpoints_are_known_views(tmp_path, endpoints):
    draw(tmp_path, ["a.png", "b.png", "c.png"])
    with pytest.raises(SceneError, match=r"scene.endpoints=.*known views of 0 to 2"):
        load(config(tmp_path, endpoints=endpoints))
    assert load(config(tmp_path, endpoints=[2, 1])).endpoints == (2, 1)
    assert load(config(tmp_path)).endpoints == (0, 2)


def test_transparent_pixels_show_the_background(tmp_path):
    draw(tmp_path, ["a.png"])
    out = oiio.ImageOutput.create("png")
    out.open(str(tmp_path / "b.png"), oiio.ImageSpec(6, 4, 4, oiio.UINT8))
    out.write_image(np.zeros((4, 6, 4), np.uint8))
    out.close()
    assert load(config(tmp_path)).views[1].min() == 1
    assert load(config(tmp_path, background=[0.0, 0.5, 1.0])).views[1, 0, 0].tolist() == [0, 0.5, 1]


def bright(folder: Path) -> Path:
    """Nine float images, the fifth a probe: known views from -0.5 to 4, the probe at 8."""
    for k, value in enumerate([-0.5, 0.5, 1, 2, 8, 4, 0, 0, 0]):
        image.write(folder / f"{k}.exr", grey(value), bits=32)
    return folder


def test_values_outside_are_refused(tmp_path):
    with pytest.raises(SceneError) as caught:
        load(config(bright(tmp_path)))
    message = str(caught.value)
    assert f"{tmp_path}/0.exr: values from -0.5 to -0.5; expected [0, 1] (4 of 9 images leave it)" in message
    assert "scene.out_of_range=clamp" in message
    assert "scene.out_of_range=scale" in message


def test_values_outside_are_clamped(tmp_path):
    scene = load(config(bright(tmp_path), out_of_range=OutOfRange.clamp))
    check_scene(scene)
    assert scene.white == 1
    assert scene.views[:, 0, 0, 0].tolist() == [0, 0.5, 1, 1, 1, 0, 0, 0]
    assert scene.notes[-2:] == [
        "Values below 0 were clamped in 1 of 9 images.",
        "Values above 1 were clamped in 3 of 9 images.",
    ]


def test_the_scene_is_scaled_by_the_largest_value_of_its_known_views(tmp_path):
    scene = load(config(bright(tmp_path), out_of_range=OutOfRange.scale))
    check_scene(scene)
    assert scene.white == 4
    assert scene.views[:, 0, 0, 0].tolist() == [0, 0.125, 0.25, 0.5, 1, 0, 0, 0]
    assert scene.probes["novel"][0].target.max() == 1
    assert scene.notes[-3:] == [
        "All images were divided by 4, the largest value of the known views.",
        "Values below 0 were clamped in 1 of 9 images.",
        "Values above 4 were clamped in 1 of 9 images.",
    ]


@pytest.mark.parametrize("choice", list(OutOfRange))
def test_values_inside_are_left_alone(tmp_path, choice):
    for name in ("a.exr", "b.exr"):
        image.write(tmp_path / name, grey(0.75), bits=32)
    scene = load(config(tmp_path, out_of_range=choice))
    assert scene.white == 1
    assert (scene.views == 0.75).all()


# conf/scene

CONF = REPOSITORY / "conf"
CHOICES = sorted(str(file.relative_to(CONF / "scene").with_suffix("")) for file in (CONF / "scene").rglob("*.yaml"))
PLANAR = ["amethyst", "beans", "bracelet", "bulldozer", "bunny", "chess", "flowers", "knights"]
PLANAR += ["tarot_large", "tarot_small", "treasure", "truck", "lego"]
ENDPOINTS = {
    "fern": [0, 4],
    "flower": [7, 13],
    "fortress": [0, 5],
    "horns": [0, 7],
    "leaves": [9, 14],
    "orchids": [0, 3],
    "room": [10, 15],
    "trex": [7, 14],
}


@functools.cache
def composed(choice: str) -> DictConfig:
    """The scene file `choice` held against the schema, which refuses unknown keys and wrong types."""
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        cfg = compose(overrides=[f"+scene={choice}", "+paths.data=/scenes"])
    assert set(cfg) == {"scene", "paths"}  # a scene file sets nothing else
    # The program registers the resolver `repository`; here a folder stands for it.
    cfg.scene.root = OmegaConf.to_container(cfg.scene)["root"].replace("${repository:}", "/repository")
    schema = OmegaConf.create({"scene": OmegaConf.structured(SceneConfig), "paths": None})
    return OmegaConf.merge(schema, cfg).scene


def test_the_scenes_of_the_paper_are_all_there():
    expected = {"demo", "planar", "llff", "studio", "pair", "folder", "studio/m1", "studio/m2", "studio/w1"}
    expected |= {f"stanford/{name}" for name in PLANAR} | {f"llff/{name}" for name in ENDPOINTS}
    assert set(CHOICES) == expected


@pytest.mark.parametrize("choice", CHOICES)
def test_a_scene_file_holds_what_the_paper_gives(choice):
    scene = composed(choice)
    group, _, name = choice.rpartition("/")
    assert scene.name == name
    layout = {"stanford": "planar", "demo": "planar"}.get(group or name, group or name)
    assert scene.layout is Layout[layout]
    folder = {"": "???", "stanford": f"/scenes/stanford/{'knights' if name == 'lego' else name}"}
    root = "/repository/data/demo/images" if name == "demo" else folder.get(group, f"/scenes/{choice}")
    assert ("???" if OmegaConf.is_missing(scene, "root") else scene.root) == root
    alpha = {"planar": 0.0, "llff": 0.05, "studio": 0.1, "pair": 0.0, "folder": 0.0}[layout]
    assert scene.published.alpha == (0.01 if name == "fortress" else alpha)
    assert scene.published.width == (256 if layout == "studio" else 512)
    assert scene.published.steps == (300_000 if layout == "planar" else 200_000)
    assert scene.endpoints == ENDPOINTS.get(name)
    assert scene.images == ("images_4" if group == "llff" else None)
    assert len(scene.url or []) == (2 if group in ("stanford", "llff") else 0)
    assert scene.holdout is Holdout.standard


def test_the_addresses_of_the_archives():
    folders = {composed(f"stanford/{name}").url[0].split("/")[-2].removesuffix("_lf") for name in PLANAR}
    assert folders == {"amethyst", "jelly_beans", "bracelet", "bulldozer", "bunny", "chess", "gum_nuts"} | {
        "lego",
        "tarot_coarse",
        "tarot_fine",
        "treasure",
        "truck",
    }
    assert composed("stanford/lego").url == composed("stanford/knights").url
    fern = composed("llff/fern")
    assert fern.url[1] == "gdrive:16VnMcF1KJYxN9QId6TClMsZRahHNMW5g"
    assert fern.archive_root == "nerf_llff_data/fern"


def test_an_unknown_scene_lists_what_there_is():
    with pytest.raises(MissingConfigException, match=r"nonesuch(.|\n)*folder(.|\n)*pair"):
        composed("nonesuch")


@pytest.mark.parametrize("choice", ["stanford/lego", "llff/fern"])
def test_a_scene_file_loads_its_scene(choice):
    scene = OmegaConf.to_object(composed(choice))
    scene.root = real(scene.root.removeprefix("/scenes/"))
    scene.downsample = 8
    loaded = load(scene)
    check_scene(loaded)
    assert loaded.endpoints == tuple(scene.endpoints or (0, 24))
