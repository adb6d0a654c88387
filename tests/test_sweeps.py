"""The experiments at scale=smoke, as they are typed; a sweep that goes on where it stopped; the report on it."""

import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from viinter import command, comparisons, config

QUICK = ["scale=smoke", "optim.steps=3", "trainer.accelerator=cpu", "logging.progress=false", "logging.frames=2"]
BLIND = "logging.pictures=false"
TINY = ["model.width=16", "model.depth=2", "optim.batch_pixels=64"]


@pytest.fixture(scope="module")
def archive(tmp_path_factory, drawn):
    """A paths.data with some of the paper's scenes: two planar ones, one by LLFF, one pair."""
    root = tmp_path_factory.mktemp("archive")
    for name, layout in (("stanford/knights", "planar"), ("stanford/truck", "planar"), ("llff/fern", "llff"),
                         ("pairs/portrait", "pair")):  # fmt: skip
        shutil.copytree(drawn(layout), root / name)
    return root


@pytest.fixture(scope="module")
def vgg_weights(tmp_path_factory):
    """VGG16's convolutions, at random."""
    torchvision = pytest.importorskip("torchvision")
    file = tmp_path_factory.mktemp("weights") / "vgg16.pth"
    layers = torchvision.models.vgg16(weights=None).features
    torch.save({f"features.{key}": weight for key, weight in layers.state_dict().items()}, file)
    return file


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def setting(folder: Path, key: str) -> object:
    return config.flat(metrics(folder)["settings"])[key]


def sweep(command_line, cwd, *arguments):
    """Runs a sweep into `cwd/sweep`; the process and, in the order of the jobs, the folders of those that finished."""
    found = command_line("viinter.train", "-m", *QUICK, *arguments, "hydra.sweep.dir=sweep", cwd=cwd)
    done = [file.parent for file in (cwd / "sweep").glob("*/metrics.json")]
    return found, sorted(done, key=lambda folder: int(folder.name))


ABLATIONS = {
    "p_norm": ("codes.p", ["none", "inf", "2", "1.5", "1"], [], 5),
    "code_dim": ("model.code_dim", [16, 32, 64, 128, 256, 512], [], 6),
    "p_norm_equal_radius": ("codes.length", [0.11, 1, 11.3], ["codes.p=none,1", "seed=0"], 6),
}


@pytest.mark.parametrize("experiment", ABLATIONS)
def test_an_ablation_runs_every_value_on_the_lego_scene(command_line, archive, tmp_path, experiment):
    key, values, fewer, jobs = ABLATIONS[experiment]
    chosen = [f"experiment={experiment}", f"paths.data={archive}", *fewer]
    found, done = sweep(command_line, tmp_path, *chosen, *TINY, BLIND)
    assert (found.code, len(done)) == (0, jobs), found.err
    assert list(dict.fromkeys(setting(folder, key) for folder in done)) == values
    assert {metrics(folder)["scene"] for folder in done} == {"lego"}

    found = command_line("viinter.report", "sweep", cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    page = (tmp_path / "sweep" / "report" / "report.md").read_text()
    for value in values:
        assert re.search(rf"\| (p|code_dim|length)( =)? {value} \|", page)
    assert "Missing" not in page


def test_at_equal_length_codes_start_and_stay_about_as_long_whatever_p(command_line, archive, tmp_path):
    chosen = ["experiment=p_norm_equal_radius", "codes.length=0.5", "seed=0", "codes.p=none,inf,1", "optim.lr=1e-6"]
    _, done = sweep(command_line, tmp_path, f"paths.data={archive}", *chosen, *TINY, BLIND)
    assert len(done) == 3
    for folder in done:
        assert metrics(folder)["code_length"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(
    ("experiment", "swept", "there", "absent"),
    [("planar", "stanford/knights,stanford/bulldozer,stanford/truck", ["knights", "truck"], "bulldozer"),
     ("unstructured", "llff/fern,llff/orchids", ["fern"], "orchids")],
)  # fmt: skip
def test_the_papers_scenes_are_one_sweep_and_those_that_are_not_there_are_shown_with_the_reason(
    command_line, archive, tmp_path, experiment, swept, there, absent
):
    chosen = [f"experiment={experiment}", f"scene={swept}", f"paths.data={archive}", "interpolation.alpha=0", *TINY]
    found, done = sweep(command_line, tmp_path, *chosen)
    assert [metrics(folder)["scene"] for folder in done] == there
    assert found.code != 0
    arguments = [f"run={done[0]}", "finetune_steps=2", "accelerator=cpu"]
    assert command_line("viinter.evaluate", *arguments, cwd=tmp_path).code == 0

    assert command_line("viinter.report", "sweep", cwd=tmp_path).code == 0
    page = (tmp_path / "sweep" / "report" / "report.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith(f"| {absent} |")]
    assert len(rows) == 2  # known and novel
    assert all("[failed: " in row for row in rows)
    assert f"| {there[0]} |" in page
    assert "finetuned gains dB" in page
    assert ("PSNR posed" in page) == (experiment == "unstructured")


def test_the_feature_towers_are_one_sweep(command_line, archive, vgg_weights, tmp_path):
    chosen = ["experiment=features", f"paths.data={archive}", "tower=none,vgg16", f"features.weights={vgg_weights}"]
    found, done = sweep(command_line, tmp_path, *chosen, *TINY)
    assert (found.code, len(done)) == (0, 2), found.err
    assert [setting(folder, "interpolation.alpha") for folder in done] == [0, 0.05]
    assert metrics(done[0])["known"]["mse"] != metrics(done[1])["known"]["mse"]
    assert command_line("viinter.report", "sweep", cwd=tmp_path).code == 0
    page = (tmp_path / "sweep" / "report" / "report.md").read_text()
    assert re.search(r"^\| none \| 0\.0 \| .*\n\| vgg16 \| 0\.05 \|", page, re.MULTILINE)
    assert "32.36" in page


def test_pairs_are_a_sweep_over_folders_and_four_corners_need_four_views(command_line, archive, drawn, tmp_path):
    chosen = ["experiment=pairs", f"scene.root={archive / 'pairs/portrait'},{drawn('pair')}", *TINY]
    found, done = sweep(command_line, tmp_path, *chosen)
    assert (found.code, len(done)) == (0, 2), found.err
    assert command_line("viinter.report", "sweep", cwd=tmp_path).code == 0
    assert (tmp_path / "sweep" / "report" / "pairs_from_view_to_view.png").stat().st_size > 5000


def test_error_against_time_compares_two_models_at_several_budgets_with_what_needs_no_training(
    command_line, archive, tmp_path
):
    chosen = ["experiment=error_vs_time", "scene=stanford/knights", f"paths.data={archive}", "seed=0", BLIND]
    found, done = sweep(command_line, tmp_path, *chosen, "optim.training_seconds=0.2,0.4")
    assert (found.code, len(done)) == (0, 4), found.err
    assert [setting(folder, "model.name") for folder in done] == ["paper", "paper", "fast", "fast"]
    assert command_line("viinter.report", "sweep", cwd=tmp_path).code == 0
    out = tmp_path / "sweep" / "report"
    page = (out / "report.md").read_text()
    for needed in ("not reached", "| knights, 32 x 32 | blend |", "| knights, 32 x 32 | flow |", "start-up", "forward",
                   "camera poses", "model=fast optim.training_seconds=0.4"):  # fmt: skip
        assert needed in page
    for picture in ("error_against_time", "work_and_precision"):
        assert (out / f"error_vs_time_{picture}.png").stat().st_size > 5000


# Going on


def test_an_interrupted_sweep_goes_on_where_it_stopped(command_line, drawn, tmp_path):
    def interrupt(pid):
        end = time.monotonic() + 60
        while not (tmp_path / "sweep/1/error_vs_time.csv").is_file() and time.monotonic() < end:
            time.sleep(0.02)
        os.kill(pid, signal.SIGINT)

    chosen = ["scene=folder", f"scene.root={drawn('folder')}", "codes.p=1,2,inf", *TINY, BLIND]
    longer = ["optim.steps=400", "evaluation.first_seconds=0.1", "evaluation.max_share=10"]
    found = command_line(
        "viinter.train", "-m", *QUICK, *chosen, *longer, "hydra.sweep.dir=sweep", cwd=tmp_path, meanwhile=interrupt
    )
    assert found.code == 1
    before = (tmp_path / "sweep/0/metrics.json").stat().st_mtime_ns
    step = torch.load(tmp_path / "sweep/1/checkpoints/last.ckpt", weights_only=True)["global_step"]
    assert 0 < step < 400
    assert not (tmp_path / "sweep/2").exists()

    assert command_line("viinter.report", "sweep", cwd=tmp_path).code == 0
    page = (tmp_path / "sweep/report/report.md").read_text()
    assert "failed: KeyboardInterrupt" in page
    assert "not started" in page

    found = command_line("viinter.train", "resume=sweep", cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    assert (tmp_path / "sweep/0/metrics.json").stat().st_mtime_ns == before
    assert [metrics(tmp_path / "sweep" / str(k))["steps"] for k in range(3)] == [400] * 3
    steps = [int(line.split(",")[0]) for line in (tmp_path / "sweep/1/error_vs_time.csv").read_text().splitlines()[1:]]
    assert steps[0] <= step < steps[-1]  # the table goes on too
    assert {folder.name for folder in (tmp_path / "sweep").iterdir()} == {"0", "1", "2", "multirun.yaml", "report"}


def test_a_folder_that_holds_other_runs_is_refused(command_line, drawn, tmp_path):
    chosen = ["scene=folder", f"scene.root={drawn('folder')}", "codes.p=1,2", *TINY, BLIND]
    _, done = sweep(command_line, tmp_path, *chosen)
    before = [(folder / "metrics.json").read_bytes() for folder in done]
    found, _ = sweep(command_line, tmp_path, *chosen, "optim.lr=0.5")
    assert found.code != 0
    assert re.search(r"sweep/0 holds a run with optim.lr=0.001, not 0.5; give hydra.sweep.dir", found.err)
    assert [(folder / "metrics.json").read_bytes() for folder in done] == before


LISTS = {
    "planar": ["amethyst", "beans", "bracelet", "bulldozer", "bunny", "chess", "flowers", "knights", "tarot_large",
               "tarot_small", "treasure", "truck"],
    "unstructured": ["fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex", "m1", "m2", "w1"],
}  # fmt: skip


@pytest.mark.parametrize("experiment", LISTS)
def test_the_papers_tables_list_all_its_scenes(experiment):
    with initialize_config_dir(str(command.CONF), version_base="1.3"):
        command.register(config.TrainConfig, "train")
        cfg = compose("train", [f"experiment={experiment}"], return_hydra_config=True)
    names = [name.strip().rpartition("/")[2] for name in cfg.hydra.sweeper.params.scene.split(",")]
    assert names == LISTS[experiment]
    for kind in ("known", "novel"):
        assert list(comparisons.published()[f"{experiment}_{kind}"]["scenes"]) == names
