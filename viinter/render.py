"""`python -m viinter.render run=DIR`: films and frames of the views between the known ones.

Notation: `M` the length of a code; a path is a row of codes [F, M], one for each frame.
"""

from __future__ import annotations

import json
import math
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from viinter import codes, command, image, video
from viinter.config import ConfigError, Easing, FrameFormat, RenderConfig
from viinter.files import write_json
from viinter.module import asked, load, run_device
from viinter.scenes import tour
from viinter.views import draw

UNFINISHED = "unfinished.json"  # in the output folder until all is drawn: what is being drawn there

ABOUT = """
Draws the views between known views of a finished run. No images are needed, only the run folder.

  python -m viinter.render run=RUN_DIR                               between the scene's two endpoints
  python -m viinter.render run=RUN_DIR path=[0,4,24] easing=smooth loop=true
  python -m viinter.render run=RUN_DIR corners=[0,4,20,24]           mixes of four views: a sheet and a film
  python -m viinter.render run=RUN_DIR size=[1024,1024] format=exr   any size: the field is continuous
  python -m viinter.render ... out=DIR                               goes on with one that was interrupted
"""


def render(cfg: RenderConfig) -> dict[str, Any]:
    """Draws a path through known views, or the mixes of four, and writes frames, `interpolation.mp4` and `.gif`.

    Frames that an interrupted drawing of the same left in `cfg.out` are taken as they are.

    Returns:
        `out` (folder), `frames`, `height`, `width`.

    Raises:
        UserError: no run folder, views that it does not have, sizes or counts that cannot be drawn.
        KeyboardInterrupt: after Ctrl-C; its message says how to go on.
    """
    console = Console()
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    model = load(cfg.run, run_device(cfg.accelerator))
    about, book = model.about, model.codes.weight.detach()
    size = [about["height"], about["width"]] if cfg.size is None else cfg.size
    if len(size) != 2 or min(size) < 1:
        raise ConfigError(f"size={size}: expected [height,width], both above 0")
    if cfg.frames < 1 or cfg.side < 2 or cfg.fps <= 0 or cfg.chunk_pixels < 1:
        raise ConfigError(f"frames={cfg.frames} side={cfg.side} fps={cfg.fps} chunk_pixels={cfg.chunk_pixels}: "
                          "expected at least 1, 2, above 0, 1")  # fmt: skip
    if cfg.path is not None and cfg.corners is not None:
        raise ConfigError(f"path={cfg.path} and corners={cfg.corners}: expected one of the two")
    way = tour(model.cfg.scene.layout, about["endpoints"])
    views = next(v for v in (cfg.corners, cfg.path, way) if v is not None)
    unknown = [v for v in views if not 0 <= v < len(book)]
    if unknown:
        raise ConfigError(f"view {unknown[0]} is not one of the {len(book)} known views, 0 to {len(book) - 1}")
    if cfg.corners is not None and len(cfg.corners) != 4:
        raise ConfigError(f"corners={cfg.corners}: expected four known views")
    if len(views) < 2:
        raise ConfigError(f"path={cfg.path}: expected two or more known views")

    out = Path(cfg.out) if cfg.out else Path(cfg.run) / "render" / f"{datetime.now():%Y-%m-%d_%H-%M-%S-%f}"
    out.mkdir(parents=True, exist_ok=True)
    smooth = cfg.easing is Easing.smooth
    film = circle(book[views], cfg.frames) if cfg.corners else codes.path(book, views, cfg.frames, smooth, cfg.loop)
    note = out / UNFINISHED
    drawing = asked(cfg, ["out", "side", "fps", "accelerator", "threads", "chunk_pixels"])  # what makes the frames
    files = [out / f"frame_{k:05d}.{cfg.format.value}" for k in range(len(film))]
    if not note.is_file() or json.loads(note.read_text()) != drawing:
        for file in files:  # another drawing's, which must not be taken for this one's
            file.unlink(missing_ok=True)
        write_json(note, drawing)
    white = about["white"] if cfg.format is FrameFormat.exr else 1.0
    shown = []
    try:
        for file, z in zip(files, track(film, "drawing", console=console), strict=True):
            if file.is_file():
                frame = image.read(file) / white
            else:
                frame = draw(model.field, z, *size, cfg.chunk_pixels).cpu()
                if cfg.format is FrameFormat.exr:
                    image.write(file, frame * white, bits=32)
                elif cfg.format is FrameFormat.png:
                    image.write(file, frame.clamp(0, 1))
            shown.append(frame.clamp(0, 1).mul(255).round().to(torch.uint8))
    except KeyboardInterrupt:
        left = f"interrupted after {len(shown)} of {len(film)} frames; the same command with out={out} goes on"
        raise KeyboardInterrupt(left if cfg.format is not FrameFormat.none else "") from None
    video.write_mp4(out / "interpolation.mp4", (f / 255 for f in shown), fps=cfg.fps)
    video.write_gif(out / "interpolation.gif", (f / 255 for f in shown), fps=min(cfg.fps, 25))
    if cfg.corners:
        rows = [torch.cat([draw(model.field, z, *size, cfg.chunk_pixels) for z in row], 1)
                for row in square(book[views], cfg.side)]  # fmt: skip
        image.write(out / "sheet.png", torch.cat(rows).clamp(0, 1).cpu())
    note.unlink()
    console.print(f"{len(film)} frames of {size[0]} x {size[1]}: {out}", highlight=False, soft_wrap=True)
    return {"out": str(out), "frames": len(film), "height": size[0], "width": size[1]}


def bilinear(corners: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Codes [..., M] at `u` (right) and `v` (down) in [0, 1] between four codes [4, M]: interpolated interpolations."""
    u, v = u[..., None], v[..., None]
    return codes.lerp(codes.lerp(corners[0], corners[1], u), codes.lerp(corners[2], corners[3], u), v)


def square(corners: Tensor, side: int) -> Tensor:
    """Codes [side, side, M] of a regular grid between four codes [4, M]."""
    t = torch.linspace(0, 1, side, device=corners.device, dtype=corners.dtype)
    v, u = torch.meshgrid(t, t, indexing="ij")
    return bilinear(corners, u, v)


def circle(corners: Tensor, frames: int) -> Tensor:
    """Codes [frames, M] once round the circle that fits into the square of four codes [4, M]; it closes."""
    angle = 2 * math.pi * torch.arange(frames, device=corners.device, dtype=corners.dtype) / frames
    return bilinear(corners, 0.5 + 0.5 * angle.cos(), 0.5 + 0.5 * angle.sin())


if __name__ == "__main__":
    command.main(RenderConfig, "render", lambda cfg, _: render(cfg), ABOUT)
