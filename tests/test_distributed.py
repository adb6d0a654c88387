"""Two processes on the CPU (gloo) that train one scene together, as two GPUs would."""

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from conftest import ENVIRONMENT, checkpoint_of, same, typed, without_times

SETTINGS = [
    "scale=smoke", "model.code_dim=8", "trainer.accelerator=cpu", "threads=1", "logging.progress=false",
    "logging.pictures=false", "hydra.run.dir=run",
]  # fmt: skip
WITH_TOWER = ["interpolation.alpha=0.01", "features.extractor=tiny"]


def close(a, b):
    return {k for k in a if not torch.allclose(a[k].double(), b[k].double(), rtol=0, atol=1e-5)}


def living(group):
    """The processes of a group that have not ended."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of_group = file.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state != "Z":
                found.append(file)
    return found


def test_two_processes_train_as_one_with_the_same_batch(command_line, drawn, tmp_path):
    alone, together = tmp_path / "alone", tmp_path / "together"
    alone.mkdir()
    together.mkdir()
    arguments = [
        "scene=planar", f"scene.root={drawn('planar')}", *SETTINGS, *WITH_TOWER, "optim.steps=20", "optim.lr=1e-3",
        "optim.batch_pixels=500", "checkpoint.every_seconds=0.1",
    ]  # fmt: skip
    assert command_line("tests.distributed_train", *arguments, cwd=alone).code == 0
    found = typed("-m", "tests.distributed_train", *arguments, "trainer.devices=2", cwd=together)
    assert (found.returncode, found.stdout, found.stderr) == (0, "", "")

    assert {path.name for path in together.iterdir()} == {"run", "rank0.pt", "rank1.pt"}
    files = {path.name.partition(".out")[0] for path in (together / "run").rglob("*") if path.is_file()}
    assert files == {"config.yaml", "hydra.yaml", "overrides.yaml", "last.ckpt", "previous.ckpt", "metrics.json",
                     "error_vs_time.csv", "events"}  # fmt: skip
    ranks = [torch.load(together / f"rank{k}.pt", weights_only=True) for k in (0, 1)]
    assert same(*ranks)
    assert not close(ranks[0], checkpoint_of(alone / "run")["state_dict"])
    one, two = (json.loads((folder / "run" / "metrics.json").read_text()) for folder in (alone, together))
    assert one["steps"] == two["steps"] == 20
    for kind in ("known", "novel"):
        assert two[kind]["psnr"] == pytest.approx(one[kind]["psnr"], rel=1e-5)
        assert two[kind]["mse"] == pytest.approx(one[kind]["mse"], abs=1e-5)
    assert without_times(one).keys() == without_times(two).keys()


def test_processes_with_clocks_of_their_own_stop_together_and_go_on(drawn, tmp_path):
    command = [sys.executable, "-m", "tests.distributed_train"]
    arguments = ["scene=planar", f"scene.root={drawn('planar')}", "model=fast", *SETTINGS,
                 "optim.training_seconds=1000", "trainer.devices=2"]  # fmt: skip
    process = subprocess.Popen(
        [*command, *arguments], cwd=tmp_path, env=ENVIRONMENT, text=True, stderr=subprocess.PIPE,
        start_new_session=True,
    )  # fmt: skip
    end = time.monotonic() + 100
    while not (tmp_path / "run" / "error_vs_time.csv").exists() and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    err = process.communicate(timeout=60)[1]
    assert process.returncode == 1
    told = re.findall(r"^interrupted at step (\d+); go on with: python -m viinter\.train (resume=.*)\n", err, re.M)
    assert len(told) == err.count("interrupted") == 1, err  # the first process alone tells
    step, resume = int(told[0][0]), told[0][1]
    assert (tmp_path / "run" / "failure.txt").read_text().startswith(f"KeyboardInterrupt: interrupted at step {step};")
    assert checkpoint_of(tmp_path / "run")["global_step"] == step > 0
    end = time.monotonic() + 20
    while (left := living(process.pid)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not left

    seconds = checkpoint_of(tmp_path / "run")["callbacks"]["Budget"]["training_seconds"] + 0.3
    found = typed(*command[1:], resume, f"optim.training_seconds={seconds}", cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    assert same(*(torch.load(tmp_path / f"rank{k}.pt", weights_only=True) for k in (0, 1)))
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] > step
