"""Renders the demo light field: `out_RR_CC_<y>_<x>.png` for the even rows and columns of the 17x17 grid.

Interrupt it at will: images already there are kept and skipped.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import scene
from tqdm import tqdm

EVEN = [(row, col) for row in range(0, scene.GRID, 2) for col in range(0, scene.GRID, 2)]


def render(still_life, row, col, size, spp, seed=0):
    """One view as a linear RGB bitmap of `size` x `size` pixels, `spp` samples a pixel."""
    sensor = mi.load_dict(scene.sensor(row, col, size, spp))
    seed = (seed * scene.GRID + row) * scene.GRID + col  # each view its own noise
    return mi.Bitmap(mi.render(still_life, sensor=sensor, spp=spp, seed=seed))


def file_name(row, col):
    """Stanford's name of a view: row, column, then the camera's y and x in scene units."""
    x, y = scene.position(row, col)
    return f"out_{row:02d}_{col:02d}_{y:.6f}_{x:.6f}.png"


def view(name):
    """`RR_CC` as `(row, col)`; raises ArgumentTypeError for a place that the grid lacks."""
    parts = name.split("_")
    if len(parts) != 2 or not all(p.isdigit() and int(p) < scene.GRID for p in parts):
        raise argparse.ArgumentTypeError(f"{name!r} is not RR_CC with both from 00 to {scene.GRID - 1}")
    return int(parts[0]), int(parts[1])


def main():
    """Reads the command line and renders what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "images", help="folder (%(default)s)"
    )
    parser.add_argument("--spp", type=int, default=121, help="samples a pixel (%(default)s)")
    parser.add_argument("--size", type=int, default=256, help="width and height in pixels (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="another value gives other noise (%(default)s)")
    parser.add_argument("--views", type=view, nargs="+", metavar="RR_CC", help="these only (the 81)")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    missing = [v for v in args.views or EVEN if not (args.out / file_name(*v)).exists()]
    still_life = scene.still_life()
    for row, col in tqdm(missing, unit="view"):
        image = render(still_life, row, col, args.size, args.spp, args.seed)
        image = image.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
        part = args.out / "part.png"  # renamed when whole: an interrupted one is not taken for done
        image.write(str(part), quality=9)
        part.rename(args.out / file_name(row, col))


if __name__ == "__main__":
    main()
