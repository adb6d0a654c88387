"""What several tests share: scenes drawn on the spot, quick settings, real sets where they are, quick command lines."""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from viinter import config, features, image
from viinter.config import TrainConfig
from viinter.fields.field import Field
from viinter.views import pixel_grid

REPOSITORY = Path(__file__).resolve().parents[1]
REAL = REPOSITORY.parent / "shared" / "data"

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY), "COLUMNS": "120"}
"""of commands that tests type"""

torch.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a suite that a shell started with & would ignore it


def pattern(right: float, down: float = 0.0, side: int = 32) -> torch.Tensor:
    """A smooth picture [side, side, 3] in [0.1, 0.9], moved by a share of its width to the right and down."""
    y, x = torch.meshgrid(torch.arange(side) / side, torch.arange(side) / side, indexing="ij")
    phase = 2 * math.pi * torch.stack([x - right, y - down, x + y - right - down], -1)
    return 0.5 + 0.4 * torch.sin(phase + torch.tensor([0.0, 1.0, 2.0]))


def draw_planar(root: Path, last: int = 8, step: int = 2, side: int = 32) -> Path:
    """A grid: rows and columns 0, `step`, ..., `last`; 9 known views and 12 + 4 probes as it stands."""
    for r in range(0, last + 1, step):
        for c in range(0, last + 1, step):
            image.write(root / f"view_{r:02d}_{c:02d}.png", pattern(c / 160, r / 160, side))
    return root


def draw_folder(root: Path, count: int = 4, side: int = 32) -> Path:
    """Loose images in a row; from 9 on, every 8th is a probe."""
    for k in range(count):
        image.write(root / f"{k}.png", pattern(k / 40, 0, side))
    return root


def draw_studio(root: Path, count: int = 10, side: int = 32) -> Path:
    """Images with masks, all bright in the same 20 x 24 pixels."""
    mask = torch.zeros(side, side, 3)
    mask[6:26, 4:28] = 1
    for k in range(count):
        image.write(root / "images" / f"{k:03d}.png", pattern(k / 80, 0, side))
        image.write(root / "masks" / f"{k:03d}.png", mask)
    return root


def draw_llff(root: Path, count: int = 10, side: int = 32) -> Path:
    """Images of cameras in a row, with their poses."""
    poses = np.zeros((count, 17))
    for k in range(count):
        image.write(root / "images_4" / f"{k:03d}.png", pattern(k / 80, 0, side))
        poses[k, :15].reshape(3, 5)[0, 3] = k
    np.save(root / "poses_bounds.npy", poses)
    return root


DRAWN = {
    "planar": draw_planar,
    "folder": draw_folder,
    "pair": lambda root: draw_folder(root, 2),
    "studio": draw_studio,
    "llff": draw_llff,
}


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """`drawn(layout)`: the folder of a small scene of that layout, drawn once; not to be written to."""
    made: dict[str, Path] = {}

    def scene(layout: str) -> Path:
        if layout not in made:
            made[layout] = DRAWN[layout](tmp_path_factory.mktemp(layout))
        return made[layout]

    return scene


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """`shared_data(name)`: the folder of a real set beside the checkout; the test skips where it is absent."""

    def real(name: str) -> Path:
        if not (REAL / name).is_dir():
            pytest.skip(f"no real data: {REAL / name}")
        return REAL / name

    return real


SMALL = {
    "model.code_dim": 8, "model.width": 16, "model.depth": 2, "optim.steps": 6, "optim.batch_pixels": 256,
    "optim.lr": 1e-3, "optim.pixels_from": "all_views", "evaluation.first_seconds": 1e6, "logging.progress": False,
    "logging.pictures": False, "logging.frames": 3, "trainer.accelerator": "cpu",
}  # fmt: skip


def settings(layout: str, root: str | Path, values: dict[str, Any]) -> TrainConfig:
    """A TrainConfig as the command line makes it, tiny unless `values` ("optim.lr": 1e-2, ...) say otherwise."""
    name = values.pop("model", "paper")
    cfg = OmegaConf.structured(TrainConfig(model=config.MODELS[name](name=name)))
    scene = {"scene.name": "test", "scene.layout": layout, "scene.root": str(root)}
    small = {key: value for key, value in SMALL.items() if not key.startswith("model.") or key[6:] in cfg.model}
    for key, value in {**scene, **small, **values}.items():
        OmegaConf.update(cfg, key, value)
    return config.typed(cfg, TrainConfig)


@pytest.fixture
def make_config(drawn: Callable[[str], Path]) -> Callable[..., TrainConfig]:
    """`make_config(layout="planar", root=None, **{"optim.lr": 1e-2})`: settings of a run of a second at most."""

    def make(layout: str = "planar", root: str | Path | None = None, **values: Any) -> TrainConfig:
        return settings(layout, root or drawn(layout), values)

    return make


def keep_config(cfg: TrainConfig, run_dir: Path) -> None:
    """Puts the settings where the command line does, so that a run made by `train` can be evaluated."""
    file = run_dir / ".hydra" / "config.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.create(config.plain(cfg)), file)


def checkpoint_of(run_dir: Path) -> dict[str, Any]:
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)


class Crash(RuntimeError):
    pass


class CrashAt(L.Callback):
    """Ends the process, as far as training can tell, after so many steps."""

    def __init__(self, step, error=Crash):
        self.step, self.error = step, error

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            raise self.error


def same(a, b):
    """Equal to the last bit, through dicts and lists."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


def trained(run_dir):
    """What training has made: weights, codes, and the optimiser's moments and step counts."""
    found = checkpoint_of(run_dir)
    return {"weights": found["state_dict"], "optimiser": found["optimizer_states"]}


def without_times(found):
    """Metrics but for what a second run cannot repeat."""
    return {k: v for k, v in found.items() if "seconds" not in k and "memory" not in k}


SERVER = """
import json, os, signal, sys, warnings
if "coverage" in sys.modules:
    sys.modules["coverage"].Coverage.current().stop()  # it begins in each child, by its own patch of fork
warnings.simplefilter("ignore")
import av, hydra, lightning.pytorch.loggers, matplotlib, OpenImageIO, PIL.Image, rich.progress, rich.table
import torch.utils.tensorboard, torchmetrics.functional.image
from matplotlib import pyplot
matplotlib.use("Agg")
torch.set_num_threads(1)
assert not [name for name in sys.modules if name.split(".")[0] == "viinter"]
warnings.resetwarnings()
for line in sys.stdin:
    asked = json.loads(line)
    child = os.fork()
    if not child:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        os.chdir(asked["cwd"])
        for number, file in enumerate((os.devnull, asked["out"], asked["err"])):
            os.dup2(os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.argv = ["-m", *asked["arguments"]]
        import runpy, threading, traceback
        status = 0
        try:
            runpy.run_module(asked["module"], run_name="__main__", alter_sys=True)
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
            if isinstance(ended.code, str):
                print(ended.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    print(json.dumps(child), flush=True)
    _, status = os.waitpid(child, 0)
    print(json.dumps(os.waitstatus_to_exitcode(status)), flush=True)
"""


@contextlib.contextmanager
def commands(folder: Path) -> Iterator[Callable[..., SimpleNamespace]]:
    """What the fixture `command_line` gives; commands run in `folder` unless they say otherwise."""
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER], cwd=folder, env=ENVIRONMENT, text=True, stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip

    def run(
        module: str, *arguments: str, cwd: Path | None = None, meanwhile: Callable[[int], None] = lambda pid: None
    ) -> SimpleNamespace:
        out, err = folder / "out", folder / "err"
        asked = {"module": module, "arguments": list(arguments), "cwd": str(cwd or folder)}
        begin = time.perf_counter()
        server.stdin.write(json.dumps({**asked, "out": str(out), "err": str(err)}) + "\n")
        server.stdin.flush()
        meanwhile(json.loads(server.stdout.readline()))
        code = json.loads(server.stdout.readline())
        return SimpleNamespace(code=code, out=out.read_text(), err=err.read_text(), seconds=time.perf_counter() - begin)

    yield run
    with contextlib.suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGKILL)  # the server, and a command that a failed test has left
    server.communicate()


@pytest.fixture(scope="session")
def command_line(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., SimpleNamespace]]:
    """`command_line("viinter.train", "scene=demo", ..., cwd=DIR)`: code, out, err and seconds of that command.

    `meanwhile` is called with its process number while it runs.

    Importing PyTorch and Lightning takes seconds. One process does so once and forks for each command, which then
    imports viinter and reads its arguments as `python -m` would. What must be a process of its own uses `typed`.
    """
    with commands(tmp_path_factory.mktemp("command_line")) as run:
        yield run


def typed(*arguments: str, cwd: Path, timeout: float = 200) -> subprocess.CompletedProcess:
    """`python ARGUMENTS` as a process of its own, as a person types it."""
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=timeout,
        check=False,
    )  # fmt: skip


@pytest.fixture
def fake_tower(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Puts a tiny tower with fixed weights into `features.TOWERS` as "fake"; `calls` counts what it has seen."""
    seen = SimpleNamespace(calls=0)

    class Tiny(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.tower_weight = torch.nn.Parameter(torch.randn(8, 147, generator=torch.Generator().manual_seed(1)))

        def forward(self, patches: torch.Tensor) -> torch.Tensor:
            seen.calls += 1
            return torch.nn.functional.avg_pool2d(patches, 32).flatten(1) @ self.tower_weight.T

    def build(cfg: config.FeaturesConfig) -> features.FeatureTower:
        return features.FeatureTower("fake", Tiny(), cfg.patches, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))

    monkeypatch.setitem(features.TOWERS, "fake", build)
    return seen


WITH_TOWER = {"interpolation.alpha": 0.1, "features.extractor": "fake", "features.patches": "cover"}


def fit(field: Field, views: torch.Tensor, codes: torch.nn.Parameter, steps: int = 400) -> None:
    """Trains on rows of the square `views` [n, H, H, 3], as `viinter.train` does, and finishes."""
    size = views.shape[1]
    field.calibrate(codes)
    field.see(views, codes)
    groups = field.parameter_groups(codes)
    optimizer = torch.optim.Adam([{"params": g["params"], "lr": 0.02 * g["share"]} for g in groups], betas=(0.9, 0.99))
    first = [g["lr"] for g in optimizer.param_groups]
    rows = pixel_grid(size, size).view(size, size, 2)
    random = torch.Generator().manual_seed(0)
    for step in range(steps):
        field.at(step / steps, step)
        for group, lr, rate in zip(optimizer.param_groups, first, field.rates(), strict=True):
            group["lr"] = lr * rate * (0.05 + 0.95 * (1 + math.cos(math.pi * step / steps)) / 2)
        seen = torch.randint(len(views), (size,), generator=random)
        rgb = views[seen, torch.arange(size)]
        loss = field.loss(seen, rows, rgb, codes)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    field.finish(views, codes.detach())
    field.eval()


def random_codes(count: int, code_dim: int) -> torch.nn.Parameter:
    codes = torch.randn(count, code_dim, generator=torch.Generator().manual_seed(1))
    return torch.nn.Parameter(codes / codes.abs().sum(-1, keepdim=True))


def blobs(height: int, width: int, seed: int, apart: int = 16) -> torch.Tensor:
    """A smooth random picture [3, H, W], `apart` pixels from blob to blob."""
    coarse = torch.rand(1, 3, height // apart, width // apart, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic")[0].clamp(0, 1)


def decibel(image: torch.Tensor, target: torch.Tensor) -> float:
    return -10 * (image.clamp(0, 1) - target).square().mean().log10().item()
