"""Trainings side by side: what they are, what they cost, and the benches that print them."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from conftest import typed

from viinter import bench, image, races, runs
from viinter.config import ConfigError, UserError
from viinter.train import train


def test_an_exponent_is_the_slope_of_the_logarithms():
    assert races.exponent([1, 4, 16], [3.0, 24.0, 192.0]) == pytest.approx(1.5)
    assert races.exponent([9, 16, 25], [1.0, None, 3.0]) is None
    assert races.exponent([9, 9], [1.0, 2.0]) is None


def test_the_fast_runs_have_parts_of_the_published_time_each_with_a_schedule_of_its_own():
    budgets = {name: own[-1] for name, own in races.methods(1800).items()}
    assert list(budgets.values()) == [f"optim.training_seconds={s}" for s in ("1800", "1800", "1.8", "30", "600")]


def grid(root: Path, side: int) -> Path:
    for y in range(0, 4 * side - 3, 2):
        for x in range(0, 4 * side - 3, 2):
            ramp = torch.linspace(0, 1, 48)[None, :, None].expand(40, 48, 3)
            image.write(root / f"view_{y:02}_{x:02}.png", torch.roll(ramp, (x + y) // 2, 1))
    return root


def test_a_block_of_a_grid_has_the_files_among_its_first_known_views(tmp_path):
    found = races.block(grid(tmp_path / "grid", 3), 2, tmp_path / "block")
    assert sorted(f.name for f in found.iterdir()) == [f"view_{y:02}_{x:02}.png" for y in (0, 2, 4) for x in (0, 2, 4)]
    assert len(list(races.block(tmp_path / "grid", 3, tmp_path / "block").iterdir())) == 25  # made anew
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.png").touch()
    with pytest.raises(UserError, match=r"named \.\.\._RR_CC"):
        races.block(tmp_path / "other", 3, tmp_path / "nothing")


@pytest.fixture
def quick(monkeypatch, command_line):
    """Commands that `races` gives are typed through `command_line`; what they said on standard error."""
    said = []

    def run(command):
        assert command[:2] == [sys.executable, "-m"]
        done = command_line(*command[2:], cwd=Path.cwd())
        said.append(done.err)
        return SimpleNamespace(returncode=done.code)

    monkeypatch.setattr(races, "subprocess", SimpleNamespace(run=run))
    return said


def test_a_training_is_a_command_that_is_not_repeated_and_whose_failure_is_told(tmp_path, quick):
    common = ["scale=smoke", "scene=folder", f"scene.root={grid(tmp_path / 'views', 2)}", "logging.pictures=false"]
    found = races.train(tmp_path / "run", ["model=fast", "optim.steps=3"], common)
    assert found.metrics["steps"] == 3
    races.train(tmp_path / "run", ["model=fast", "optim.steps=3"], common)
    assert len(quick) == 1
    (tmp_path / "run" / "metrics.json").unlink()  # as if it had been killed before its end
    assert races.train(tmp_path / "run", ["model=fast", "optim.steps=3"], common).metrics["steps"] == 3
    assert len(quick) == 2
    with pytest.raises(UserError, match=r"holds a run of .* model=fast optim\.steps=3, not of .* optim\.steps=4;"):
        races.train(tmp_path / "run", ["model=fast", "optim.steps=4"], common)
    with pytest.raises(UserError, match=r"viinter\.train .* optim\.steps=x .* failed"):
        races.train(tmp_path / "other", ["model=fast", "optim.steps=x"], common)
    assert "optim.steps" in quick[-1]


@pytest.fixture
def here(monkeypatch, make_config):
    """Trainings of 8 steps in this process in place of commands; the list of what was asked of them."""
    asked = []

    def trained(folder, own, common):
        asked.append(settings := dict(o.split("=", 1) for o in [*common, *own]))
        values = {"model": settings["model"], "optim.steps": 8, "logging.pictures": False,
                  "scene.downsample": int(settings["scene.downsample"])}  # fmt: skip
        layout = "llff" if (Path(settings["scene.root"]) / "poses_bounds.npy").exists() else "planar"
        train(make_config(layout, settings["scene.root"], **values), folder)
        return runs.read([folder])[0]

    monkeypatch.setattr(races, "train", trained)
    monkeypatch.setattr(bench, "typed", lambda: [])
    return asked


@pytest.mark.parametrize("layout", ["planar", "llff"])
def test_bench_fast_tells_what_each_reached_and_what_needs_no_training(
    layout, make_config, drawn, tmp_path, here, capsys
):
    root = grid(tmp_path / "grid", 2) if layout == "planar" else drawn(layout)
    cfg = make_config(layout, root, **{"optim.training_seconds": 1800.0})
    found = bench.fast(cfg, tmp_path / "bench")
    assert [a.get("optim.lr") for a in here] == [None, "3e-4", None, None, None]
    assert [a["optim.training_seconds"] for a in here] == ["1800", "1800", "1.8", "30", "600"]
    assert list(found["novel"]) == list(races.methods(1800))
    assert all(psnr > 0 for psnr in found["novel"].values())
    assert "blend" in found["peers"]
    assert json.loads((tmp_path / "bench" / "bench.json").read_text()) == found
    out = capsys.readouterr().out
    assert "along the way" in out
    assert "1/1000" in out
    assert "Times as fast" in out
    assert {name: list(of) for name, of in found["times as fast"].items()} == {
        slow: ["fast, 1/1000 of the time", "fast, 1/60 of the time", "fast, 1/3 of the time"]
        for slow in ("paper, as published", "paper, tuned")
    }
    assert ("novel_posed" in out) == (layout == "llff")


def test_times_as_fast_compares_the_end_with_the_first_measurement_that_is_as_good():
    rows = [{"training_seconds": t, "novel_psnr": psnr} for t, psnr in ((2.0, 19.0), (5.0, 21.5), (9.0, 24.0))]
    quick = runs.Run(Path(), [], rows=rows)
    slow = {
        end: runs.Run(Path(), [], metrics={"training_seconds": 100.0, "novel": {"psnr": end}}) for end in (21.0, 25)
    }
    assert races.times_as_fast(quick, slow[21.0]) == 20
    assert races.times_as_fast(quick, slow[25]) is None


def test_bench_fast_wants_probes(make_config, drawn, tmp_path):
    with pytest.raises(ConfigError, match="expected a scene with probes; There are no probes"):
        bench.fast(make_config("pair", drawn("pair")), tmp_path)


def test_an_interrupted_race_goes_on_as_it_is_typed(tmp_path, make_config, quick, monkeypatch):
    root = grid(tmp_path / "grid", 2)
    settings = ["scene=planar", f"scene.root={root}", "scale=smoke", "threads=1", "logging.pictures=false"]
    folder, last = tmp_path / "bench", "fast_1_3_of_the_time"

    def written():
        return {run.name: (run / "metrics.json").stat().st_mtime_ns for run in folder.iterdir() if run.is_dir()}

    with monkeypatch.context() as here:
        here.setattr(bench, "typed", lambda: [s for s in settings if not s.startswith("scene.root")])
        bench.fast(make_config("planar", root, **{"optim.training_seconds": 0.3}), folder)
    assert len(quick) == 5
    before = written()
    shutil.rmtree(folder / last)
    done = typed("-m", "viinter.bench", "fast", *settings, "optim.training_seconds=0.3", "hydra.run.dir=bench",
                 cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "fast, 1/60 of the time:" in done.stdout
    after = written()
    assert {name for name in before if before[name] != after[name]} == {last}


def test_bench_scaling_measures_three_numbers_and_three_sizes(make_config, tmp_path, here, capsys):
    cfg = make_config("planar", grid(tmp_path / "grid", 5), **{"optim.training_seconds": 5.0})
    found = bench.scaling(cfg, tmp_path / "bench")
    assert list(found["number of views"]["measured"]) == [9, 16, 25]
    assert list(found["pixels of a view"]["measured"]) == [120, 480, 1920]
    assert all(m["ms"] > 0 and m["MB"] > 0 for m in found["number of views"]["measured"].values())
    assert found["a step"]["MB"] > 0
    assert "exponent" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="expected a planar scene"):
        bench.scaling(make_config("folder", tmp_path / "grid"), tmp_path / "bench")


def test_a_race_has_its_own_time_and_folder():
    assert "optim.training_seconds=1800" in bench.presets("fast", [])
    assert "optim.training_seconds=60" in bench.presets("scaling", [])
    assert not [p for p in bench.presets("fast", []) if p.startswith("model.")]
