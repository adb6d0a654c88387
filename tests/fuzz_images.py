"""Files of pictures, mutated under the guidance of atheris: a picture or an ImageError must come out, nothing else.

For an hour: `python -m tests.fuzz_images FOLDER -max_total_time=3600`. FOLDER keeps what reached new code; an input
that breaks something lies in the current folder afterwards, as `crash-*`. Other options are libFuzzer's.
"""

import contextlib
import sys
import tempfile
from pathlib import Path

import atheris
import torch

with atheris.instrument_imports(include=["viinter.image"]):
    from viinter import image

image.MAX_PIXELS = 2**16  # or the changed header of a small picture would ask for gigabytes

SEEDS = [("a.png", 8), ("b.png", 16), ("c.jpg", 8), ("d.tif", 8), ("e.tif", 32), ("f.exr", 16), ("g.exr", 32)]


def try_bytes(data: bytes) -> None:
    file.write_bytes(data)
    with contextlib.suppress(image.ImageError):
        shape = image.size(file)
        assert image.read(file).shape == (*shape, 3)


if __name__ == "__main__":
    seeds = Path(sys.argv[1])
    for name, bits in SEEDS:
        image.write(seeds / name, torch.rand(5, 4, 3, generator=torch.Generator().manual_seed(0)), bits)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture"
        # the libraries that decode are not watched: to the guide all formats look alike
        atheris.Setup([*sys.argv, "-keep_seed=1", "-max_len=4096"], try_bytes)
        atheris.Fuzz()
