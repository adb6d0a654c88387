"""The doors as a person at the keyboard meets them: help, refusals, and a run from end to end."""

import json
import os
import re
import signal
import time
from pathlib import Path

import pytest
import torch
from conftest import REPOSITORY, typed, without_times

from viinter import config, image

SMOKE = [
    "scale=smoke", "optim.steps=4", "model.width=16", "model.depth=2", "model.code_dim=8", "optim.batch_pixels=128",
    "trainer.accelerator=cpu",
]  # fmt: skip
QUIET = [*SMOKE, "logging.pictures=false", "logging.progress=false"]


def folders(cwd: Path) -> list[Path]:
    """The run folders under `cwd`."""
    return sorted(file.parent for file in cwd.rglob("metrics.json"))


# Help


@pytest.mark.parametrize("module", ["train", "evaluate", "render", "download"])
def test_help_gives_examples_and_every_setting(command_line, module):
    found = command_line(f"viinter.{module}", "--help")
    assert found.code == 0
    assert found.err == ""
    assert f"python -m viinter.{module} " in found.out
    schema = {"train": config.TrainConfig, "evaluate": config.EvaluateConfig, "render": config.RenderConfig,
              "download": config.DownloadConfig}[module]()  # fmt: skip
    shown = re.findall(r"^ +([a-z0-9_.]+) ", found.out, re.MULTILINE)
    for key, _, meaning in config.describe(schema):
        assert key in shown
        assert meaning.split()[0] in found.out
    if module in ("train", "download"):
        assert "stanford/knights" in found.out


def test_help_of_train_knows_the_field_and_its_defaults(command_line):
    out = command_line("viinter.train", "-h").out
    for row in (r"model\.width +512", r"model\.depth +8", r"codes\.p +1 ", r"optim\.batch_pixels +8192"):
        assert re.search(row, out)


# From end to end


ASKED_FOR = """
import runpy, sys
import lightning, torchmetrics  # they import torchvision themselves where they find it
before = set(sys.modules)
sys.argv = ["viinter.train", *sys.argv[1:]]
runpy.run_module("viinter.train", run_name="__main__")
print("ASKED FOR", *sorted({name.split(".")[0] for name in set(sys.modules) - before}))
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory, drawn):
    """A smoke run typed as a person would, without alpha; its process, and the folder it was typed in."""
    cwd = tmp_path_factory.mktemp("whole")
    arguments = ["scene=planar", f"scene.root={drawn('planar')}", *SMOKE]
    return typed("-c", ASKED_FOR, *arguments, cwd=cwd), cwd


def test_one_command_trains_and_says_where_to_look(whole):
    process, cwd = whole
    assert process.returncode == 0, process.stderr
    (run_dir,) = folders(cwd)
    assert re.fullmatch(r"outputs/planar/paper/\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-\d+", str(run_dir.relative_to(cwd)))
    for words in ("9 known views of 32 x 32", "12 novel", "known views", "probes", "strip.png", run_dir.name):
        assert words in process.stdout
    assert "Warning" not in process.stdout + process.stderr


def test_without_alpha_no_package_of_the_feature_towers_is_imported(whole):
    asked_for = set(whole[0].stdout.partition("ASKED FOR")[2].split())
    assert "viinter" in asked_for
    assert not {"open_clip", "torchvision", "timm", "huggingface_hub", "safetensors", "clip"} & asked_for


def test_the_run_folder_of_a_command_holds_its_configuration_too(whole):
    (run_dir,) = folders(whole[1])
    files = {str(file.relative_to(run_dir)) for file in run_dir.rglob("*") if file.is_file()}
    events = {name for name in files if name.startswith("events.out.tfevents.")}
    assert len(events) == 1
    assert files - events == {
        ".hydra/config.yaml", ".hydra/hydra.yaml", ".hydra/overrides.yaml", "metrics.json", "error_vs_time.csv",
        "error_vs_time.png", "strip.png", "interpolation.mp4", "checkpoints/last.ckpt",
    }  # fmt: skip
    assert "- optim.steps=4" in (run_dir / ".hydra" / "overrides.yaml").read_text()
    assert {path.name for path in whole[1].iterdir()} == {"outputs"}
    assert config.plain(config.read_run(run_dir))["optim"]["steps"] == 4


def test_a_run_is_evaluated_and_drawn_from_its_folder(command_line, whole, tmp_path):
    (run_dir,) = folders(whole[1])
    found = command_line("viinter.evaluate", f"run={run_dir}", "finetune_steps=2", "accelerator=cpu", cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    assert re.search(r"finetuned +12 views", found.out)
    assert (run_dir / "evaluation.json").is_file()

    arguments = [f"run={run_dir}", "path=[0,4,8]", "frames=3", "format=exr", "size=[20,24]", "out=film"]
    found = command_line("viinter.render", *arguments, cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    shown = sorted((tmp_path / "film").glob("*.exr"))
    assert len(shown) == 7
    assert image.size(shown[0]) == (20, 24)

    arguments = [f"run={run_dir}", "corners=[0,2,6,8]", "frames=3", "side=2", "format=none", "out=sheet"]
    assert command_line("viinter.render", *arguments, cwd=tmp_path).code == 0
    assert {f.name for f in (tmp_path / "sheet").iterdir()} == {"sheet.png", "interpolation.mp4", "interpolation.gif"}
    assert {path.name for path in tmp_path.iterdir()} == {"film", "sheet"}


def test_the_same_command_twice_gives_the_same_numbers_in_two_folders(command_line, drawn, tmp_path):
    arguments = ["scene=folder", f"scene.root={drawn('folder')}", *QUIET]
    for _ in range(2):
        assert command_line("viinter.train", *arguments, cwd=tmp_path).code == 0
    once, twice = (json.loads((folder / "metrics.json").read_text()) for folder in folders(tmp_path))
    assert without_times(once) == without_times(twice)


def test_a_sweep_makes_a_folder_a_job_and_a_job_that_fails_does_not_stop_the_others(command_line, drawn, tmp_path):
    arguments = ["scene=folder", f"scene.root={drawn('folder')}", *QUIET]
    found = command_line("viinter.train", "-m", "codes.p=1,0.5,2", *arguments, cwd=tmp_path)
    assert found.code != 0
    assert "codes.p=0.5: expected none, inf or a number >= 1" in found.err
    assert "Traceback" not in found.err
    first, second = folders(tmp_path)
    assert (first.name, second.name) == ("0", "2")
    assert first.parent == second.parent
    assert re.fullmatch(r"outputs/sweep/[\d_-]{26}", str(first.parent.relative_to(tmp_path)))
    assert [config.read_run(folder).codes.p for folder in (first, second)] == ["1", "2"]
    reason = "ConfigError: codes.p=0.5: expected none, inf or a number >= 1\n"
    assert {file.parent.name: file.read_text() for file in tmp_path.rglob("failure.txt")} == {"1": reason}


def test_a_sweep_refuses_several_devices_for_a_job(command_line, drawn, tmp_path):
    sweep = ["-m", "scene=folder", f"scene.root={drawn('folder')}", "codes.p=1,2", "trainer.devices=2", *QUIET]
    found = command_line("viinter.train", *sweep, cwd=tmp_path)
    assert found.code != 0
    assert "trainer.devices=2" in found.err
    assert not folders(tmp_path)


def test_a_sweep_of_good_jobs_ends_well(command_line, drawn, tmp_path):
    arguments = ["scene=pair", f"scene.root={drawn('pair')}", *QUIET]
    found = command_line("viinter.train", "-m", "codes.p=1,2", *arguments, cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    known = [json.loads((folder / "metrics.json").read_text())["known"]["mse"] for folder in folders(tmp_path)]
    assert len(set(known)) == 2


TABLE_1 = [("p_norm", "codes.p: none,inf,2,1.5,1"), ("code_dim", "model.code_dim: 16,32,64,128,256,512")]


@pytest.mark.parametrize(("experiment", "swept"), TABLE_1)
def test_an_experiment_sweeps_the_values_of_the_papers_table_on_the_lego_scene(command_line, experiment, swept):
    chosen = ["viinter.train", f"experiment={experiment}", "--cfg"]
    assert swept in command_line(*chosen, "all", "--package", "hydra.sweeper.params").out
    assert "name: lego" in command_line(*chosen, "job").out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1])
def test_an_interrupted_run_says_how_to_go_on_and_goes_on(command_line, drawn, tmp_path, number):
    def interrupt(pid):
        end = time.monotonic() + 60
        while not list(tmp_path.rglob("error_vs_time.csv")) and time.monotonic() < end:
            time.sleep(0.05)
        os.kill(pid, number)

    arguments = ["scene=folder", f"scene.root={drawn('folder')}", *QUIET, "optim.steps=1000000"]
    found = command_line("viinter.train", *arguments, cwd=tmp_path, meanwhile=interrupt)
    assert found.code == 1
    said = re.fullmatch(r"interrupted at step (\d+); go on with: python -m viinter.train (resume=.*)\n", found.err)
    assert said, found.err
    (file,) = tmp_path.rglob("last.ckpt")
    assert (file.parents[1] / "failure.txt").read_text() == f"KeyboardInterrupt: {found.err}"
    steps = torch.load(file, weights_only=True)["global_step"]
    assert steps == int(said[1]) > 0

    found = command_line("viinter.train", said[2], f"optim.steps={steps + 3}", cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    (run_dir,) = folders(tmp_path)
    assert run_dir == file.parents[1]
    assert json.loads((run_dir / "metrics.json").read_text())["steps"] == steps + 3
    assert not (run_dir / "failure.txt").exists()


def test_the_package_can_be_called_from_anywhere_and_writes_only_where_it_is_called(whole):
    assert whole[1] != REPOSITORY
    assert not [path for path in (REPOSITORY / "outputs").iterdir() if path.name == "planar"]
