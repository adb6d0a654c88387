"""From a folder of image files to a `Scene`: the known views to train on, and the probes to measure against.

Notation. `n` known views; a *known index* counts among them, 0 to n - 1, in the order of `Scene.names`. A
*file index* counts all images of the folder in their order, known or not. A view is `[H, W, 3]`, float32 in
[0, 1]. A *mix* is `((known index, weight), ...)` whose weights sum to 1: the known views, and their shares,
that stand for a probe. `r, c` are a planar grid's row and column as the file's name gives them.

Which views are known (DESIGN's Protocol; supplement, "Dataset Details"), with `scene.holdout=standard`:

planar   rows and columns that are multiples of 4: 25 of the Stanford archive's 17x17. Probes: "novel",
         the axis midpoints; "novel_cells", the cell centres; "novel_quarters", the axis quarter points.
llff     all but every 8th image. As "novel" its mix lies on the segment between the two known cameras nearest to
         it; as "novel_posed" it is all cameras, weighted so that their poses come to its own.
studio   all but every 8th image in file order; its mix is the half of both neighbours. Masks give the crop.
folder   as studio without masks, but only from 9 images on; fewer are all known.
pair     both.

With `scene.holdout=none` the first `scene.max_views` images are known and there are no probes (the published
code takes the first 30 images). Poses place the LLFF probes and do nothing else: training never sees them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from viinter import image
from viinter.config import Holdout, Layout, OutOfRange, SceneConfig, UserError

Mix = tuple[tuple[int, float], ...]
Place = tuple[int, int]  # (r, c)

STEP = 4  # rows and columns from one known view of a planar grid to the next (Protocol)
EVERY, FIRST = 8, 4  # in file order every 8th image is held out, beginning with index 4 (Protocol)
FARTHEST = 1e30  # of a camera's centre along any axis: its square is still finite
UNIT = 1.01  # of an entry of a camera's axes, which have the length 1
POSE_ERROR = 1e-3  # of the distance between cameras, and radians: weights need not reproduce a pose more closely
FEWEST = 9  # images that a folder must hold before any is held out
ARCHIVES = {Layout.planar: "stanford", Layout.llff: "llff"}  # groups of conf/scene that have a public address


class SceneError(UserError):
    """A scene that cannot be loaded: a folder, a file or a setting of `scene.*`; the message names it."""


@dataclass
class Probe:
    """A held-out view and the known views that stand for it.

    target: `[H, W, 3]`, float32 in [0, 1].
    mix: `((known index, weight), ...)`, weights that sum to 1, in [0, 1] but for those of "novel_posed".
    name: the target's file name.
    """

    target: Tensor
    mix: Mix
    name: str


@dataclass
class Scene:
    """The views of one static scene.

    views: `[n, H, W, 3]`, float32 in [0, 1], the known views; names: their file names, in the same order.
    probes: by kind. "novel" is always there, perhaps empty; planar scenes with probes add "novel_cells" and
        "novel_quarters", LLFF scenes with poses "novel_posed". left_out: for the same kinds, how many probes have no
        target file.
    white: the value that is 1.0 in `views`, not 1 only where `scene.out_of_range=scale` divided the images.
    endpoints: two known indices, for demonstrations.
    notes: plain sentences on where things came from and what was dropped.
    """

    name: str
    layout: Layout
    views: Tensor
    names: list[str]
    probes: dict[str, list[Probe]]
    left_out: dict[str, int]
    white: float
    endpoints: tuple[int, int]
    notes: list[str]

    @property
    def n(self) -> int:
        return self.views.shape[0]

    @property
    def height(self) -> int:
        return self.views.shape[1]

    @property
    def width(self) -> int:
        return self.views.shape[2]

    @property
    def tour(self) -> list[int]:
        return tour(self.layout, self.endpoints)


@dataclass
class Plan:
    """What a layout decides from names (and poses) alone, before any pixel is read.

    known: files of the known views; held: for each kind of probe, its files with their mixes; left_out,
    notes: as in `Scene`; masks: for each known view, then each probe, the mask whose box is the crop, or
    nothing at all.
    """

    known: list[Path]
    held: dict[str, list[tuple[Path, Mix]]] = field(default_factory=lambda: {"novel": []})
    left_out: dict[str, int] = field(default_factory=lambda: {"novel": 0})
    notes: list[str] = field(default_factory=list)
    masks: list[Path] = field(default_factory=list)

    @property
    def files(self) -> list[Path]:
        """All the files to read, each once: known views, then probes by kind."""
        return list(dict.fromkeys(self.known + [file for probes in self.held.values() for file, _ in probes]))


def tour(layout: Layout, endpoints: Sequence[int]) -> list[int]:
    """The known views that a demonstration passes on its way between two `endpoints`, these included: in a studio
    scene, where one side is not seen from the other, those between in file order; elsewhere no others."""
    first, last = endpoints
    step = 1 if last > first else -1
    return [*range(first, last, step), last] if layout is Layout.studio else [first, last]


def load(cfg: SceneConfig) -> Scene:
    """Loads the scene that `cfg` describes: list -> known and probes -> sizes -> read -> range -> `Scene`.

    Only the files that are known views or probes are opened. They are reduced by `_factor`, then
    cropped to `cfg.crop` (else to the masks' box, if there are masks). What is asked of the values
    (`cfg.out_of_range`) is asked of the views so obtained.

    Raises SceneError: a folder that is missing or empty, too few images, a grid with holes or doubles, poses
    that do not fit the images, missing or empty masks, views of different sizes, an unreadable file, values
    outside [0, 1] with `refuse`, or a `scene.*` setting that does not fit the images.
    """
    root = _root(cfg)
    plan = LAYOUTS[cfg.layout](cfg, root)
    if len(plan.known) < 2:
        raise SceneError(
            f"{root}: {len(plan.known)} known view(s), with scene.holdout={cfg.holdout.value} and "
            f"scene.max_views={cfg.max_views}; expected at least 2, to interpolate between"
        )
    endpoints = _endpoints(cfg, len(plan.known))
    files, notes = plan.files, list(plan.notes)
    # OpenImageIO lets go of Python's lock while it decodes. More threads would hold more full images at once.
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        size = _common_size(files, _map(pool, image.size, files))
        factor = _factor(cfg, size)
        crop = _crop(cfg, factor, plan, size, pool, notes)
        background = tuple(cfg.background)

        def view(file: Path) -> Tensor:
            x0, y0, x1, y1 = crop
            pixels = image.read(file, background)
            return image.downsample(pixels, factor)[y0:y1, x0:x1].contiguous()

        views = _map(pool, view, files)

    n = len(plan.known)
    white = _into_range(views, files, n, cfg.out_of_range, notes)
    of = dict(zip(files, views, strict=True))
    probes = {kind: [Probe(of[file], mix, file.name) for file, mix in held] for kind, held in plan.held.items()}
    known = torch.stack(views[:n])
    names = [file.name for file in plan.known]
    return Scene(cfg.name, cfg.layout, known, names, probes, dict(plan.left_out), white, endpoints, notes)


# Layouts: (settings, the scene's folder, which exists) -> Plan


def planar(cfg: SceneConfig, root: Path) -> Plan:
    """A grid of views whose file names end in row and column (see `position`), all of it or a part of it.

    Known: rows and columns that are multiples of 4 in the files' own numbering, row by row; each must be
    there. Probes, by (row, column): axis midpoints (1/2, 1/2); cell centres (four times 1/4); quarter points
    (3/4, 1/4). A probe without a file is left out and counted.
    """
    grid: dict[Place, Path] = {}
    unnumbered = []
    for file in _images(root):
        at = position(file.name)
        if at is None:
            unnumbered.append(file)
        elif at in grid:
            raise SceneError(
                f"{root}: {grid[at].name} and {file.name} are both row {at[0]}, column {at[1]}; expected one"
            )
        else:
            grid[at] = file
    if not grid:
        raise SceneError(
            f"{root}: no row and column in the name of any of {len(unnumbered)} images, such as "
            f"{unnumbered[0].name}; expected names like view_00_04.png or out_00_04_-381.9_776.7.png "
            f"(scene=folder takes any names)"
        )
    notes = []
    if unnumbered:
        notes.append(f"Passed over, with no row and column in the name: {_some(f.name for f in unnumbered)}.")
    if cfg.holdout is Holdout.none:
        return _first(cfg, [grid[at] for at in sorted(grid)], notes)

    rows, columns = (_multiples(min(line), max(line)) for line in zip(*grid, strict=True))
    known = [(r, c) for r in rows for c in columns]
    holes = [at for at in known if at not in grid]
    if holes or not known:
        what = f"no view at (row, column) {_some(holes)}" if holes else "no known view"
        raise SceneError(
            f"{root}: {what}; expected, of rows {_span(grid, 0)} and columns {_span(grid, 1)}, every view whose "
            f"row and column are multiples of {STEP} (scene.holdout=none takes any views)"
        )
    notes.append(f"Known are rows {_some(rows)} and columns {_some(columns)} of the grid.")
    plan = Plan([grid[at] for at in known], {}, {}, notes)
    index = {at: i for i, at in enumerate(known)}
    for kind, mixes in _between(rows, columns).items():
        there = sorted(at for at in mixes if at in grid)
        plan.held[kind] = [(grid[at], tuple((index[corner], weight) for corner, weight in mixes[at])) for at in there]
        plan.left_out[kind] = len(mixes) - len(there)
    return plan


def llff(cfg: SceneConfig, root: Path) -> Plan:
    """Photographs in `root/<cfg.images>` (null: images_4, else images_8, else images), by file name.

    Every 8th image from index 4 on, but the last, is a probe; its mix is `nearest_mix`, and once more
    `posed_mix`, of the cameras in `root/poses_bounds.npy`, or, without that file, the half of both neighbours.
    Nothing else reads the poses.
    """
    folders = [cfg.images] if cfg.images else ["images_4", "images_8", "images"]
    found = [root / name for name in folders if (root / name).is_dir()]
    if not found:
        raise SceneError(
            f"{root}: no folder {' or '.join(folders)}; there is {_content(root)}. "
            f"Choose the folder of the images with scene.images=NAME"
        )
    files, notes = _images(found[0]), [f"The images are those of {found[0].name}."]
    if cfg.holdout is Holdout.none:
        notes.append("Poses were not read: scene.holdout=none.")
        return _first(cfg, files, notes)
    poses = root / "poses_bounds.npy"
    if not poses.is_file():
        notes.append("There is no poses_bounds.npy: probes lie half-way between neighbours in file order.")
        return _every_eighth(files, notes)
    cameras = _cameras(poses, len(files))
    notes.append("Camera poses in poses_bounds.npy place the probes between known views.")
    centres = cameras[:, :, 3]
    return _every_eighth(files, notes, {
        "novel": lambda target, known: nearest_mix(centres[target], centres[known]),
        "novel_posed": lambda target, known: posed_mix(cameras[target], cameras[known]),
    })  # fmt: skip


def studio(cfg: SceneConfig, root: Path) -> Plan:
    """Photographs in `root/images`, by file name; masks of the same stems in `root/masks`, if it exists.

    Probes as in LLFF without poses: file order is all that is known, and it is not taken for a ring. The crop
    is the one box that holds every mask's box, so that all views keep one size; behind the subject nothing is
    changed.
    """
    if not (root / "images").is_dir():
        raise SceneError(f"{root}: no folder images; there is {_content(root)}")
    files, notes = _images(root / "images"), []
    standard = cfg.holdout is Holdout.standard
    plan = _every_eighth(files, notes) if standard else _first(cfg, files, notes)
    masks_of = root / "masks"
    if masks_of.is_dir() and cfg.crop is None:
        masks = {file.stem: file for file in _images(masks_of)}
        bare = [file.name for file in plan.files if file.stem not in masks]
        if bare:
            raise SceneError(
                f"{masks_of}: no mask of the same name for {_some(bare)}; expected one for each image, or no "
                f"folder masks, or scene.crop=[x0,y0,x1,y1] in their place"
            )
        plan.masks = [masks[file.stem] for file in plan.files]
    return plan


def pair(cfg: SceneConfig, root: Path) -> Plan:
    """Any two images, by file name; both are known."""
    files = sorted(_images(root), key=_natural)
    if len(files) != 2:
        names = _some(f.name for f in files)
        raise SceneError(f"{root}: {_count(files)} ({names}); scene=pair expects exactly 2")
    return Plan(files, notes=["There are no probes: both images are known."])


def folder(cfg: SceneConfig, root: Path) -> Plan:
    """Any images of one size, by file name with numbers in their numeric order (2 before 10).

    From 9 images on, every 8th from index 4 on, but the last, is a probe that lies half-way between its
    neighbours; of fewer, none can be spared and all are known.
    """
    files, notes = sorted(_images(root), key=_natural), []
    if len(files) < 2:
        raise SceneError(f"{root}: {_count(files)} ({files[0].name}); expected at least 2")
    if cfg.holdout is Holdout.none:
        return _first(cfg, files, notes)
    if len(files) < FEWEST:
        notes.append(f"There are no probes: of fewer than {FEWEST} images none is held out.")
        return Plan(files, notes=notes)
    return _every_eighth(files, notes)


LAYOUTS: dict[Layout, Callable[[SceneConfig, Path], Plan]] = {
    Layout.planar: planar,
    Layout.llff: llff,
    Layout.studio: studio,
    Layout.pair: pair,
    Layout.folder: folder,
}


# What the layouts are made of

_FLOAT = r"[+-]?[0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?"
_POSITION = re.compile(rf"(?:.*_)?([0-9]{{2,}})_([0-9]{{2,}})(?:_{_FLOAT}_{_FLOAT}_?)?")


def position(name: str) -> Place | None:
    """(row, column) from a file name, or None.

    Names are `<prefix>_RR_CC.png`, `<prefix>_RR_CC_<y>_<x>.png` or `<prefix>_RR_CC_<y>_<x>_.png`. RR and CC have
    two or more digits; y and x, the camera's place, are not used. Any prefix, or none, and any ending. Numbers
    are counted from the end, so that a prefix may hold some too.
    """
    found = _POSITION.fullmatch(Path(name).stem)
    return (int(found[1]), int(found[2])) if found else None


def nearest_mix(target: np.ndarray, known: np.ndarray) -> Mix:
    """The point nearest to `target` on the segment between the two nearest of `known`, as a mix of those two.

    target [3], known [n, 3]: camera centres in any one unit, n >= 2. Returns ((i, 1 - t), (j, t)) with i the
    nearest, t in [0, 1]: the projection on the segment, clamped; 1/2 for two cameras at one place.
    """
    i, j = np.argsort(np.linalg.norm(known - target, axis=1), kind="stable")[:2]
    along = known[j] - known[i]
    length = along @ along
    t = float(np.clip((target - known[i]) @ along / length, 0.0, 1.0)) if length > 0 else 0.5
    return (int(i), 1.0 - t), (int(j), t)


def posed_mix(target: np.ndarray, known: np.ndarray) -> Mix:
    """All of `known`, weighted so that the small motions from `target` to each of them cancel out.

    A probe rarely stands between two known cameras, and never looks quite where they do. But for small motions a
    picture changes linearly with its camera's translation and rotation (Longuet-Higgins and Prazdny 1980), so that
    a field with codes in proportion to the cameras draws the probe at that combination of codes which is its pose's of
    the known poses. Of many such combinations this is the one with the smallest squares.

    target [3, 4], known [n, 3, 4]: three axes in columns, then the centre; the world's unit and axes do not matter.
    The weights sum to 1 and may be negative.
    """
    apart = known[:, :, 3] - target[:, 3]
    apart = apart / (np.linalg.norm(apart, axis=1).mean() or 1.0)
    turned = target[:, :3].T @ known[:, :, :3]
    turned = (turned - turned.transpose(0, 2, 1)) / 2  # the axis of rotation, by the sine of its angle
    motion = np.hstack([apart, turned[:, [0, 0, 1], [1, 2, 2]]])
    weights = np.linalg.solve(motion @ motion.T + POSE_ERROR**2 * np.eye(len(known)), np.ones(len(known)))
    return tuple(enumerate((weights / weights.sum()).tolist()))


def _between(rows: range, columns: range) -> dict[str, dict[Place, list[tuple[Place, float]]]]:
    """For each kind of planar probe, its places, and for each the known places, with weights, around it."""
    axes = [((r, c), (r, c + STEP)) for r in rows for c in columns[:-1]]
    axes += [((r, c), (r + STEP, c)) for r in rows[:-1] for c in columns]
    kinds = {"novel": {}, "novel_cells": {}, "novel_quarters": {}}
    for a, b in axes:
        for kind, t in (("novel", 0.5), ("novel_quarters", 0.25), ("novel_quarters", 0.75)):
            at = (round((1 - t) * a[0] + t * b[0]), round((1 - t) * a[1] + t * b[1]))
            kinds[kind][at] = [(a, 1 - t), (b, t)]
    for r in rows[:-1]:
        for c in columns[:-1]:
            corners = [(r, c), (r, c + STEP), (r + STEP, c), (r + STEP, c + STEP)]
            kinds["novel_cells"][r + STEP // 2, c + STEP // 2] = [(corner, 0.25) for corner in corners]
    return kinds


def _every_eighth(
    files: list[Path], notes: list[str], mixes: dict[str, Callable[[int, list[int]], Mix]] | None = None
) -> Plan:
    """Holds out the file indices 4, 12, 20, ..., each with a file on both sides, so never the last.

    mixes: for each kind of probe, from a held-out file index and the known file indices to its mix; None: "novel", the
    half of both neighbours. notes: becomes the plan's, one sentence longer.
    """
    held = range(FIRST, len(files) - 1, EVERY)
    known = [i for i in range(len(files)) if i not in held]

    def half(target: int, known: list[int]) -> Mix:
        return (known.index(target - 1), 0.5), (known.index(target + 1), 0.5)

    notes.append(f"Held out are {len(held)} of {len(files)} images, every {EVERY}th from index {FIRST} on.")
    probes = {kind: [(files[i], mix(i, known)) for i in held] for kind, mix in (mixes or {"novel": half}).items()}
    return Plan([files[i] for i in known], probes, dict.fromkeys(probes, 0), notes)


def _first(cfg: SceneConfig, files: list[Path], notes: list[str]) -> Plan:
    """The first `cfg.max_views` files are known, as in the published code, and there are no probes."""
    if len(files) > cfg.max_views:
        notes.append(f"Known are the first {cfg.max_views} of {len(files)} images (scene.max_views).")
    notes.append("There are no probes: scene.holdout=none.")
    return Plan(files[: cfg.max_views], notes=notes)


def _cameras(file: Path, count: int) -> np.ndarray:
    """Cameras [count, 3, 4] from LLFF's poses, a row [17] for each image: three axes in columns, then the centre.

    A row is a 3x5 matrix, whose 5th column is the image's size and focal length, then the nearest and the farthest
    depth.
    """
    remedy = "put the right file there, or remove it: probes then lie between their neighbours in file order"
    try:
        with open(file, "rb") as stream:
            poses = np.lib.format.read_array(stream, allow_pickle=False)
    except Exception as error:  # NumPy's header is parsed as Python's literals are, and fails in as many ways
        raise SceneError(f"{file}: {error}; expected a NumPy array of numbers: {remedy}") from error
    if poses.ndim != 2 or poses.shape[1] != 17 or poses.dtype.kind not in "fiu":
        found = f"{poses.dtype} of shape {list(poses.shape)}"
        raise SceneError(f"{file}: {found}; expected numbers of shape [{count}, 17]: {remedy}")
    if len(poses) != count:
        raise SceneError(f"{file}: {len(poses)} rows for {count} images; expected a row for each: {remedy}")
    cameras = poses[:, :15].reshape(-1, 3, 5)[:, :, :4].astype(np.float64)
    wrong = np.flatnonzero(~(np.abs(cameras) < [UNIT, UNIT, UNIT, FARTHEST]).all(axis=(1, 2)))
    if len(wrong):
        raise SceneError(
            f"{file}: the camera of image {wrong[0]} has axes and centre {cameras[wrong[0]].tolist()}; "
            f"expected axes of length 1 and a centre below {FARTHEST:g}: {remedy}"
        )
    return cameras


def _multiples(low: int, high: int) -> range:
    """The multiples of STEP from `low` to `high`, both included."""
    return range(-(-low // STEP) * STEP, high + 1, STEP)


def _natural(file: Path) -> tuple:
    """A sort key: digits by their number, the rest without case; the name itself where these are equal."""
    parts = re.split(r"([0-9]+)", file.name.casefold())
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], file.name


# Folders and files


def _root(cfg: SceneConfig) -> Path:
    """The scene's folder, absolute; SceneError says how to get it if it is not there."""
    root = Path(os.path.expanduser(cfg.root)).absolute()
    if os.path.isdir(root):
        return root
    above = next(parent for parent in root.parents if os.path.isdir(parent))
    what = "a file" if os.path.exists(root) else "no such folder"
    fetch = ""
    if cfg.url and cfg.layout in ARCHIVES:
        fetch = f"Fetch it: python -m viinter.download scene={ARCHIVES[cfg.layout]}/{cfg.name}. "
    raise SceneError(
        f"scene.root={cfg.root}: {what}; expected the folder {root}. There is {above} with {_content(above)}. "
        f"{fetch}If you have it, say where: scene.root=DIR, or paths.data=DIR for the folder of all scenes"
    )


def _images(directory: Path) -> list[Path]:
    """The image files directly in `directory`, by name; at least one. Hidden files are not looked at."""
    try:
        files = sorted(directory.iterdir(), key=lambda file: file.name)
    except OSError as error:
        raise SceneError(f"{directory}: {error.strerror}; expected a folder that can be read") from error
    found = [f for f in files if f.suffix.lower() in image.EXTENSIONS and f.name[0] != "." and not f.is_dir()]
    if not found:
        raise SceneError(
            f"{directory}: no images; there is {_content(directory)}. "
            f"Expected files ending in {', '.join(image.EXTENSIONS)}"
        )
    return found


def _map(pool: ThreadPoolExecutor, function: Callable, files: list[Path]) -> list:
    """`function` of each file, in order; the first file that cannot be read ends it, as a SceneError."""
    try:
        return list(pool.map(function, files))
    except image.ImageError as error:  # its message names the file
        raise SceneError(str(error)) from error


def _common_size(files: list[Path], sizes: list[tuple[int, int]]) -> tuple[int, int]:
    """The (height, width) that all files share."""
    for file, size in zip(files, sizes, strict=True):
        if size != sizes[0]:
            raise SceneError(
                f"{file.parent}: {files[0].name} is {sizes[0][1]} x {sizes[0][0]} pixels, {file.name} is "
                f"{size[1]} x {size[0]}; expected views of one size"
            )
    return sizes[0]


def _factor(cfg: SceneConfig, size: tuple[int, int]) -> int:
    """The whole factor by which views of `size` are reduced: `cfg.downsample`, more to keep to `cfg.max_pixels`."""
    factor = cfg.downsample
    if not 1 <= factor <= min(size):
        pixels = f"{size[1]} x {size[0]} pixels"
        raise SceneError(f"scene.downsample={factor}: expected 1 to {min(size)}; views are {pixels}")
    while cfg.max_pixels and (size[0] // factor) * (size[1] // factor) > cfg.max_pixels and factor < min(size):
        factor += 1
    return factor


def _crop(
    cfg: SceneConfig, factor: int, plan: Plan, size: tuple[int, int], pool: ThreadPoolExecutor, notes: list[str]
) -> tuple[int, int, int, int]:
    """(x0, y0, x1, y1), the part to keep of views that are reduced by `factor`; `size` is theirs before that."""
    height, width = size[0] // factor, size[1] // factor
    if cfg.crop is not None:
        x0, y0, x1, y1 = cfg.crop if len(cfg.crop) == 4 else (0, 0, 0, 0)
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            raise SceneError(
                f"scene.crop={list(cfg.crop)}: expected [x0,y0,x1,y1], x0 < x1, y0 < y1, within "
                f"[0,0,{width},{height}]; that is a view's size after scene.downsample={factor}"
            )
        return x0, y0, x1, y1
    if not plan.masks:
        return 0, 0, width, height

    where = plan.masks[0].parent
    found = _common_size(plan.masks, _map(pool, image.size, plan.masks))
    if found != size:
        raise SceneError(
            f"{where}: masks are {found[1]} x {found[0]} pixels; expected the images' {size[1]} x {size[0]}"
        )
    boxes = [box for box in _map(pool, _mask_box, plan.masks) if box]
    if not boxes:
        raise SceneError(f"{where}: all masks are black; expected the subject in white")
    x0, y0 = min(box[0] for box in boxes), min(box[1] for box in boxes)
    x1, y1 = max(box[2] for box in boxes), max(box[3] for box in boxes)
    # Outwards to whole pixels of the reduced image, which lacks the remainder at right and bottom.
    x0, y0 = min(x0 // factor, width - 1), min(y0 // factor, height - 1)
    x1, y1 = min(-(-x1 // factor), width), min(-(-y1 // factor), height)
    notes.append(f"Cropped to the masks' box, [{x0},{y0},{x1},{y1}] of {width} x {height} pixels.")
    return x0, y0, x1, y1


def _mask_box(file: Path) -> tuple[int, int, int, int] | None:
    """(x0, y0, x1, y1) of a mask's bright part in its pixels, x1 and y1 excluded; None if all of it is black.

    Bright is above half its largest value: masks come as 0 and 1 of 255 too.
    """
    mask = image.read(file, (0.0, 0.0, 0.0)).amax(-1)
    bright = mask > mask.max() / 2
    ys, xs = (bright.any(dim).nonzero().flatten().tolist() for dim in (1, 0))
    return (xs[0], ys[0], xs[-1] + 1, ys[-1] + 1) if xs else None


def _into_range(views: list[Tensor], files: list[Path], n: int, choice: OutOfRange, notes: list[str]) -> float:
    """Brings `views`, the first `n` of them known, into [0, 1] in place as `choice` says; returns `white`."""
    spans = [tuple(end.item() for end in torch.aminmax(view)) for view in views]
    out = [i for i, (low, high) in enumerate(spans) if low < 0 or high > 1]
    if not out:
        return 1.0
    if choice is OutOfRange.refuse:
        low, high = spans[out[0]]
        raise SceneError(
            f"{files[out[0]]}: values from {low:g} to {high:g}; expected [0, 1] ({len(out)} of {len(files)} "
            f"images leave it). scene.out_of_range=clamp cuts values off, scene.out_of_range=scale divides the "
            f"scene by its largest"
        )
    white = 1.0
    if choice is OutOfRange.scale:
        white = max(1.0, *(high for _, high in spans[:n]))
        if white > 1:
            notes.append(f"All images were divided by {white:g}, the largest value of the known views.")
        for view in views:
            view /= white
    below, above = sum(low < 0 for low, _ in spans), sum(high > white for _, high in spans)
    for side, count in (("below 0", below), (f"above {white:g}", above)):
        if count:
            notes.append(f"Values {side} were clamped in {count} of {len(views)} images.")
    for view in views:
        view.clamp_(0, 1)
    return white


def _endpoints(cfg: SceneConfig, n: int) -> tuple[int, int]:
    if cfg.endpoints is None:
        return 0, n - 1
    ends = tuple(cfg.endpoints)
    if len(ends) != 2 or ends[0] == ends[1] or not all(0 <= i < n for i in ends):
        raise SceneError(f"scene.endpoints={list(ends)}: expected two different known views of 0 to {n - 1}")
    return ends


# Words


def _count(files: list) -> str:
    return f"{len(files)} image{'' if len(files) == 1 else 's'}"


def _some(items: object, most: int = 10) -> str:
    """The first items, and how many more."""
    items = list(items)
    shown = ", ".join(map(str, items[:most]))
    return f"{shown} and {len(items) - most} more" if len(items) > most else shown


def _content(directory: Path) -> str:
    """What a folder holds, for an error message."""
    try:
        return _some(sorted(f.name for f in directory.iterdir() if f.name[0] != ".")) or "nothing"
    except OSError:
        return "nothing that can be read"


def _span(grid: dict[Place, Path], axis: int) -> str:
    numbers = [at[axis] for at in grid]
    return f"{min(numbers)} to {max(numbers)}"
