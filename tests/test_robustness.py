"""What cannot be used, each with the command that meets it and the message that it gives: `docs/robustness.md`.

`python tests/test_robustness.py` writes that page anew.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from conftest import (
    REPOSITORY,
    checkpoint_of,
    commands,
    draw_folder,
    draw_llff,
    draw_planar,
    draw_studio,
    keep_config,
    same,
    settings,
    without_times,
)
from PIL import Image

from viinter import image
from viinter.train import train

PAGE = REPOSITORY / "docs" / "robustness.md"
FEW = ["scale=smoke", "trainer.accelerator=cpu"]
PICTURE = Image.fromarray(np.arange(32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3))


class Row(NamedTuple):
    """`make(DIR)` prepares the folder DIR, in which `command` is typed; `words` must be in what it says."""

    what: str
    make: Callable[[Path], object]
    command: str
    words: tuple[str, ...]


def nothing(here: Path) -> None:
    pass


def cut(file: Path) -> None:
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])


def beside(name: str, put: Callable[[Path], object]) -> Callable[[Path], object]:
    """A folder of four good images, and `put(DIR/scene/NAME)`."""
    return lambda here: put(draw_folder(here / "scene") / name)


def saved(**how: object) -> Callable[[Path], None]:
    return lambda file: PICTURE.save(file, **how)


def bomb(file: Path) -> None:
    """A PNG of 100 bytes that says it is 20000 x 20000."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(99))))


def floats(value: float) -> Callable[[Path], None]:
    def put(file: Path) -> None:
        pixels = torch.full((32, 32, 3), 0.5)
        image.write(file, pixels, bits=32)
        ready = image.oiio.ImageBuf(str(file))
        ready.setpixel(3, 2, 0, [value] * 3)
        ready.write(str(file))

    return put


def poses(array: np.ndarray) -> Callable[[Path], None]:
    return lambda here: np.save(draw_llff(here / "scene") / "poses_bounds.npy", array, allow_pickle=True)


def with_nan() -> np.ndarray:
    array = np.zeros((10, 17))
    array[2, 3] = np.nan
    return array


class Dangerous:
    def __reduce__(self) -> tuple:
        return os.system, ("touch executed",)


def masks(here: Path) -> None:
    draw_studio(here / "scene")
    for file in (here / "scene" / "masks").iterdir():
        image.write(file, torch.zeros(32, 32, 3))


def finished(here: Path) -> Path:
    """A run of six steps in DIR/run with the checkpoints of steps 5 and 6; its scene is DIR/scene."""
    small = {"checkpoint.every_seconds": 1e-9}
    cfg = settings("folder", draw_folder(here / "scene"), small)
    before = Path.cwd()
    os.chdir(here)
    try:
        cfg.scene.root = "scene"
        train(cfg, Path("run"))
        keep_config(cfg, Path("run"))
    finally:
        os.chdir(before)
    return here / "run" / "checkpoints" / "last.ckpt"


TRAIN = "viinter.train scene=folder scene.root=scene"
GOOD = beside("0.png", lambda file: None)
IMAGES = [
    Row("a truncated PNG", lambda d: cut(draw_folder(d / "scene") / "1.png"), TRAIN, ("scene/1.png", "whole image")),
    Row("a truncated JPEG", beside("9.jpg", lambda f: (saved()(f), cut(f))), TRAIN, ("scene/9.jpg", "Premature end")),
    Row("an empty file", beside("9.png", Path.touch), TRAIN, ("scene/9.png", "an empty file")),
    Row("text that is called an image", beside("9.png", lambda f: f.write_text("hello\n" * 99)), TRAIN,
        ("scene/9.png", "in one of bmp")),
    Row("an animation", beside("9.webp", saved(save_all=True, append_images=[PICTURE.rotate(90)])), TRAIN,
        ("scene/9.webp", "several images", "expected one")),
    Row("a TIFF of several pages", beside("9.tif", saved(save_all=True, append_images=[PICTURE])), TRAIN,
        ("scene/9.tif", "several images")),
    Row("a header of 20000 x 20000 pixels in 100 bytes", beside("9.png", bomb), TRAIN,
        ("scene/9.png", "1144 MB image from a 57 byte file")),
    Row("views of several sizes", beside("9.png", lambda f: image.write(f, torch.zeros(30, 32, 3))), TRAIN,
        ("9.png is 32 x 30", "one size")),
    Row("a dangling link", beside("9.png", lambda f: f.symlink_to("nowhere.png")), TRAIN,
        ("scene/9.png", "a dangling link")),
    Row("a pipe", beside("9.png", os.mkfifo), TRAIN, ("scene/9.png", "not a regular file")),
    Row("a file that cannot be read", beside("9.png", lambda f: f.symlink_to("/proc/self/mem")), TRAIN,
        ("scene/9.png", "Input/output error")),
    Row("NaN among the pixels", beside("9.exr", floats(float("nan"))), TRAIN,
        ("scene/9.exr", "1 pixels are NaN", "row 2, column 3")),
    Row("floats above 1", beside("9.exr", floats(3)), TRAIN, ("scene/9.exr", "0.5 to 3", "out_of_range=scale")),
    Row("32-bit integers", beside("9.tif", lambda f: Image.new("I", (32, 32)).save(f)), TRAIN,
        ("scene/9.tif", "expected uint8")),
]  # fmt: skip
SCENES = [
    Row("a folder that is not there", nothing, TRAIN, ("scene.root=scene", "no such folder")),
    Row("a file in place of a folder", lambda d: (d / "scene").touch(), TRAIN, ("scene.root=scene", "a file")),
    Row("a name longer than names may be", nothing, f"viinter.train scene=folder scene.root={'x' * 300}",
        ("scene.root=xxx", "no such folder")),
    Row("a folder without images", lambda d: (d / "scene").mkdir(), TRAIN, ("scene: no images", ".png")),
    Row("a folder with one image", lambda d: draw_folder(d / "scene", 1), TRAIN, ("1 image (0.png)", "at least 2")),
    Row("a pair of four", GOOD, "viinter.train scene=pair scene.root=scene", ("4 images", "exactly 2")),
    Row("an archive that was not fetched", nothing, "viinter.train scene=stanford/knights",
        ("viinter.download scene=stanford/knights",)),
    Row("a grid with a hole", lambda d: (draw_planar(d / "scene") / "view_04_04.png").unlink(),
        "viinter.train scene=planar scene.root=scene", ("(4, 4)", "rows 0 to 8")),
    Row("two files at one place of a grid", lambda d: image.write(
        draw_planar(d / "scene") / "other_04_04.png", torch.zeros(32, 32, 3)),
        "viinter.train scene=planar scene.root=scene", ("other_04_04.png and view_04_04.png",)),
    Row("images without a place in a grid", GOOD, "viinter.train scene=planar scene.root=scene",
        ("no row and column in the name",)),
    Row("too few poses", poses(np.zeros((9, 17))), "viinter.train scene=llff scene.root=scene scene.images=images_4",
        ("poses_bounds.npy", "9 rows for 10 images")),
    Row("poses with NaN", poses(with_nan()), "viinter.train scene=llff scene.root=scene scene.images=images_4",
        ("poses_bounds.npy", "camera of image 2", "nan", "below 1e+30")),
    Row("poses that are a pickle (never run)", poses(np.array([Dangerous()] * 10, dtype=object)),
        "viinter.train scene=llff scene.root=scene scene.images=images_4", ("poses_bounds.npy", "allow_pickle")),
    Row("an image without its mask", lambda d: (draw_studio(d / "scene") / "masks" / "003.png").unlink(),
        "viinter.train scene=studio scene.root=scene", ("scene/masks", "003.png")),
    Row("masks that are all black", masks, "viinter.train scene=studio scene.root=scene", ("all masks are black",)),
]  # fmt: skip


def setting(what: str, change: str, *words: str, make: Callable[[Path], object] = GOOD) -> Row:
    return Row(what, make, f"{TRAIN} {change}", words)


SETTINGS = [
    setting("a misspelt key", "optim.lrr=1", "there is no optim.lrr", "lr", "batch_pixels"),
    setting("a misspelt group", "optin.lr=1", "there is no optin", "optim"),
    setting("a wrong type", "optim.steps=many", "optim.steps", "many", "Integer"),
    setting("a wrong type where a list belongs", "scene.crop=3", "scene.crop", "3"),
    setting("a choice that is none", "scene.holdout=some", "scene.holdout", "some", "standard", "none"),
    setting("half a list", "'scene.crop=[1,2'", "scene.crop=[1,2"),
    setting("a model that is none", "model=papier", "papier", "paper", "fast"),
    Row("a scene that is none", nothing, "viinter.train scene=stanford/legos", ("stanford/legos", "stanford/lego,")),
    Row("a required setting left out", nothing, "viinter.train scene=folder", ("scene.root=VALUE",)),
    setting("a rate of zero", "optim.lr=0", "optim.lr=0", "above 0"),
    setting("a rate that is no number", "optim.lr=nan", "optim.lr=nan", "above 0"),
    setting("a negative budget", "optim.steps=-1", "optim.steps=-1", "above 0"),
    setting("a budget without end", "optim.training_seconds=inf", "optim.training_seconds=inf", "above 0"),
    setting("p below 1", "codes.p=0.5", "codes.p=0.5", "none, inf or a number >= 1"),
    setting("a share above 1", "optim.lr_decay=2", "optim.lr_decay=2", "at most 1"),
    setting("a colour out of range", "scene.background=[0,0,7]", "scene.background", "7.0", "three numbers in [0,1]"),
    setting("a crop outside the image", "scene.crop=[0,0,99,9]", "scene.crop=[0, 0, 99, 9]", "[0,0,32,32]"),
    setting("an image reduced to nothing", "scene.downsample=33", "scene.downsample=33", "1 to 32"),
    setting("a view that is not there", "scene.endpoints=[0,9]", "scene.endpoints=[0, 9]", "0 to 3"),
    setting("an accelerator that is none", "trainer.accelerator=abacus", "abacus", "cpu"),
    setting("a precision that is none", "trainer.precision=12", "trainer.", "12", "bf16-mixed"),
    setting("a model and a precision that do not go together", "model=fast trainer.precision=bf16-true",
            "trainer.precision=bf16-true", "model=fast"),
    setting("the interpolation loss without weights", "interpolation.alpha=0.1", "features.weights=null",
            "interpolation.alpha", "path of a file"),
    setting("weights that are not there", "interpolation.alpha=0.1 features.weights=clip.pt", "clip.pt", "no file"),
    setting("weights that hold code (never run)", "interpolation.alpha=0.1 features.weights=clip.pt",
            "cannot use clip.pt",
            make=lambda d: (draw_folder(d / "scene"), torch.save({"a": Dangerous()}, d / "clip.pt"))),
    setting("a tower that is none", "interpolation.alpha=0.1 features.extractor=eyes", "features.extractor=eyes",
            "clip, vgg16"),
    Row("several devices for a job of a sweep", GOOD, f"{TRAIN} trainer.devices=2".replace(" ", " -m codes.p=1,2 ", 1),
        ("trainer.devices=2", "a job of a sweep takes one device")),
]  # fmt: skip
RUNS = [
    Row("no run folder", nothing, "viinter.train resume=run", ("run is no run folder", ".hydra/config.yaml")),
    Row("a truncated checkpoint", lambda d: cut(finished(d)), "viinter.train resume=run",
        ("run/checkpoints/last.ckpt", "truncated or damaged", "of step 5, is whole", "mv run/checkpoints/previous")),
    Row("another program's checkpoint", lambda d: torch.save({"weights": torch.zeros(3)}, finished(d)),
        "viinter.render run=run", ("run/checkpoints/last.ckpt", "another program's", "of step 5, is whole")),
    Row("a checkpoint with code in it (never run)", lambda d: torch.save({"a": Dangerous()}, finished(d)),
        "viinter.evaluate run=run", ("run/checkpoints/last.ckpt", "something other than plain values")),
    Row("another model than the checkpoint's", finished, "viinter.train resume=run model.width=20",
        ("model.width=20", "expected 16")),
    Row("images that have changed", lambda d: (finished(d), image.write(d / "scene" / "7.png", torch.zeros(32, 32, 3))),
        "viinter.evaluate run=run", ("scene no longer holds the known views",)),
    Row("a folder that holds a run", finished, f"{TRAIN} hydra.run.dir=run", ("run holds a run already", "resume=")),
    Row("an output folder that cannot be made", lambda d: (draw_folder(d / "scene"), (d / "file").touch()),
        f"{TRAIN} hydra.run.dir=file/run", ("file", "expected a place that can be written")),
    Row("a view that the run has not", finished, "viinter.render run=run path=[0,9]", ("view 9", "0 to 3")),
    Row("a size of nothing", finished, "viinter.render run=run size=[0,9]", ("size=[0, 9]", "both above 0")),
    Row("a path and corners", finished, "viinter.render run=run path=[0,1] corners=[0,1,2,3]", ("one of the two",)),
    Row("a misspelt key of another command", finished, "viinter.evaluate run=run finetun_steps=3",
        ("there is no finetun_steps", "finetune_steps")),
    Row("no run to draw", nothing, "viinter.render", ("run=VALUE",)),
    Row("a download that is none", nothing, "viinter.download scene=stanford/legos", ("stanford/lego,",)),
]  # fmt: skip
TABLES = {"Images": IMAGES, "Scenes": SCENES, "Settings": SETTINGS, "Runs": RUNS}
ROWS = {row.what: row for rows in TABLES.values() for row in rows}


def message(row: Row, here: Path, command_line: Callable) -> str:
    """What `row.command` says when typed in `here`, with `here` shown as DIR; asserts how it ends."""
    row.make(here)
    before = {file: file.stat().st_mtime_ns for file in here.rglob("*") if file.is_file()}
    module, *arguments = [word.strip("'") for word in row.command.split(" ")]
    few = FEW if module == "viinter.train" and "resume=run" not in arguments else []
    sweep = arguments[:1] if arguments[:1] == ["-m"] else []
    # what the row is about comes last and wins
    found = command_line(module, *sweep, *few, *arguments[len(sweep) :], cwd=here)
    assert found.code not in (0, None), found.out
    assert "Traceback" not in found.err + found.out
    said = found.err.replace(f"{here}/", "").replace(str(here), "DIR").strip()
    assert len(said.splitlines()) < 15
    for word in row.words:
        assert word in said, said
    assert not (here / "executed").exists()
    # nothing is half written: only a run's settings and its reason are new
    after = {file: file.stat().st_mtime_ns for file in here.rglob("*") if file.is_file()}
    assert before.items() <= after.items()
    new = after.keys() - before.keys()
    assert {file.parent.name if file.parent.name == ".hydra" else file.name for file in new} <= {
        ".hydra", "failure.txt", "multirun.yaml",
    }  # fmt: skip
    for note in (file for file in new if file.name == "failure.txt"):
        assert note.read_text().strip().partition(": ")[2] in found.err
    # Lightning keeps its names in a set
    return re.sub(r"(?<=names are: )[^.]*", lambda names: ", ".join(sorted(names[0].split(", "))), said)


def line(row: Row, said: str) -> str:
    shown = re.sub(r"x{50,}", "xxx...", said.replace("\n", "<br>").replace("|", "\\|"))
    shown = re.sub(r"((?:Accepted|There) (?:there|are): [^<]{60})[^<]+", r"\1 ...", shown)  # such lists grow
    shown = shown if len(shown) < 320 else shown[:320] + " ..."
    command = re.sub(r"x{50,}", "xxx...", row.command)
    return f"| {row.what} | `{command}` | {shown} |"


def page(lines: dict[str, list[str]]) -> str:
    parts = [PAGE_HEAD]
    for title, rows in lines.items():
        parts += [f"\n## {title}\n", "| what | typed, after `python -m` | answer |", "|---|---|---|", *rows]
    return "\n".join(parts) + "\n"


PAGE_HEAD = """# What cannot be used, and what is said of it

Every row is typed by a test (`tests/test_robustness.py`, which also writes this page): the command ends with an exit
code that is not zero, without a traceback, and leaves nothing half written; what was there before is as it was. A run
folder that was begun keeps its settings and, in `failure.txt`, the reason. The folder where a command is typed is left
out of the messages. Further down: what is accepted though it looks odd, and what happens when the machine fails."""


PAGE_TAIL = """
## Accepted

| what | what is made of it |
|---|---|
| a wrong ending, such as a JPEG called `.png` | the bytes count, not the name |
| CMYK, palettes, 1 bit, grey, 16 bits, transparency, in one folder | all become RGB; transparent pixels show \
`scene.background` |
| an animated PNG | its default picture |
| blanks, non-ASCII letters and 200 letters in file and folder names | nothing special |

## When the machine fails

| what | what happens |
|---|---|
| SIGKILL, a crash, a power cut | `resume=RUN_DIR` goes on from the last checkpoint, or from the start, \
and ends with the same bits (`tests/test_killed_runs.py`) |
| Ctrl-C, SIGTERM, SIGHUP, SIGUSR1, SIGUSR2 | the step is finished and saved; the message says how to go on \
(`tests/test_checkpoints.py`) |
| a full disk | the run ends with a message that names the file; the last checkpoint is whole; with room made, \
`resume=` goes on |
| a file system that is read-only | the run ends with a message that names the folder |
| two runs, or two sweeps, begun in the same second | their folders differ in the microseconds |
| memory runs out while a view is drawn | half as many pixels at a time, until it fits or one row is too much |
"""


@pytest.mark.parametrize("what", ROWS)
def test_what_cannot_be_used_is_refused_as_the_page_says(command_line, tmp_path, what):
    shown = line(ROWS[what], message(ROWS[what], tmp_path, command_line))
    assert shown in PAGE.read_text().splitlines(), "python tests/test_robustness.py writes the page anew"


def test_the_page_has_these_rows_alone():
    text = PAGE.read_text()
    assert text.startswith(PAGE_HEAD)
    assert text.endswith(PAGE_TAIL)
    shown = re.findall(r"^\| (.*?) \| `viinter\.", text, re.MULTILINE)
    assert shown == list(ROWS)


def test_odd_images_are_accepted(command_line, tmp_path):
    root = tmp_path / "über 日本" / ("x" * 200)
    draw_folder(root, 2)
    PICTURE.save(root / "2.png", format="JPEG")
    Image.merge("CMYK", [PICTURE.convert("L")] * 4).save(root / "3.tif")
    PICTURE.convert("P").save(root / "4.png")
    PICTURE.convert("1").save(root / "5.png")
    PICTURE.convert("L").save(root / "6.png")
    Image.fromarray(np.zeros((32, 32), np.uint16)).save(root / "7.png")
    PICTURE.convert("RGBA").save(root / ("y" * 200 + ".png"))
    PICTURE.save(root / "zoë.png", save_all=True, append_images=[PICTURE.rotate(90)])
    arguments = ["scene=folder", f"scene.root={root}", "scene.holdout=none", "optim.steps=1", "logging.progress=false"]
    found = command_line("viinter.train", *FEW, *arguments, "hydra.run.dir=run", cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    assert len(json.loads((tmp_path / "run" / "metrics.json").read_text())["known"]["per_view"]) == 10


# When the machine fails


@contextlib.contextmanager
def mounted(here: Path, options: str) -> Iterator[Path]:
    """A small file system of its own; skips where mounting is not allowed."""
    here.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "none", here], capture_output=True, check=False)
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.decode().strip()}")
    try:
        yield here
    finally:
        subprocess.run(["umount", "-l", here], check=True)


LONG = [*FEW, "scene=folder", "scene.root=scene", "hydra.run.dir=disk/run", "optim.steps=1000000",
        "checkpoint.every_seconds=0.05", "evaluation.first_seconds=1e6", "logging.progress=false",
        "logging.pictures=false"]  # fmt: skip


@pytest.mark.parametrize("how", ["a small disk", "a limit on files"])
def test_a_full_disk_loses_no_finished_checkpoint_and_leaves_a_message(command_line, tmp_path, how):
    draw_folder(tmp_path / "scene")
    with mounted(tmp_path / "disk", "size=4m") if how == "a small disk" else contextlib.nullcontext():
        run_dir = tmp_path / "disk" / "run"

        def fill(pid: int) -> None:
            end = time.monotonic() + 60
            while not (run_dir / "checkpoints" / "previous.ckpt").exists() and time.monotonic() < end:
                time.sleep(0.01)
            if how == "a small disk":
                with contextlib.suppress(OSError), (tmp_path / "disk" / "filler").open("wb") as filler:
                    while True:
                        filler.write(bytes(10_000))
                        filler.flush()
            else:
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (20_000, 20_000))

        found = command_line("viinter.train", *LONG, cwd=tmp_path, meanwhile=fill)
        assert found.code == 1
        said = re.search(r"disk/run.*(No space left on device|File too large).* go on with: .*(resume=\S+)", found.err)
        assert said, found.err
        assert "Traceback" not in found.err
        (tmp_path / "disk" / "filler").unlink(missing_ok=True)
        steps = checkpoint_of(run_dir)["global_step"]
        assert {file.name for file in (run_dir / "checkpoints").iterdir()} == {"last.ckpt", "previous.ckpt"}
        again = command_line("viinter.train", said[2], f"optim.steps={steps + 3}", cwd=tmp_path)
        assert (again.code, again.err) == (0, "")
        assert json.loads((run_dir / "metrics.json").read_text())["steps"] == steps + 3


def test_a_disk_that_is_full_from_the_start_is_named(command_line, tmp_path):
    draw_folder(tmp_path / "scene")
    with mounted(tmp_path / "disk", "size=16k") as disk:
        with contextlib.suppress(OSError), (disk / "filler").open("wb", buffering=0) as filler:
            while True:
                filler.write(bytes(4096))
        found = command_line("viinter.train", *LONG, cwd=tmp_path)
        assert found.code == 1
        assert f"the run folder below {tmp_path}: No space left on device; expected a place" in found.err
        assert "Traceback" not in found.err


def test_a_read_only_output_folder_is_named(command_line, tmp_path):
    draw_folder(tmp_path / "scene")
    with mounted(tmp_path / "disk", "ro"):
        found = command_line("viinter.train", *LONG, cwd=tmp_path)
        assert found.code == 1
        assert re.search(r"disk/run.*: Read-only file system; expected a place that can be written", found.err)
        assert "Traceback" not in found.err
        assert not list((tmp_path / "disk").iterdir())


def test_two_runs_begun_at_once_have_a_whole_folder_each(command_line, tmp_path):
    draw_folder(tmp_path / "scene")
    arguments = [*FEW, "scene=folder", "scene.root=scene", "logging.progress=false", "logging.pictures=false"]
    found = command_line("tests.two_trains", *arguments, cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    folders = sorted((tmp_path / "outputs" / "folder" / "paper").iterdir())
    assert len(folders) == 2
    files = [{file.name.partition(".out")[0] for file in folder.rglob("*") if file.is_file()} for folder in folders]
    assert files[0] == files[1] >= {"config.yaml", "last.ckpt", "metrics.json", "error_vs_time.csv", "events"}
    assert same(*[checkpoint_of(folder)["state_dict"] for folder in folders])
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in folders]
    assert without_times(metrics[0]) == without_times(metrics[1])
    assert metrics[0]["steps"] == 30


def write_page() -> None:
    lines: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as folder, commands(Path(folder)) as command_line:
        for title, rows in TABLES.items():
            for row in rows:
                here = Path(tempfile.mkdtemp(dir=folder))
                lines.setdefault(title, []).append(line(row, message(row, here, command_line)))
    PAGE.write_text(page(lines) + PAGE_TAIL)


if __name__ == "__main__":
    sys.exit(write_page())
