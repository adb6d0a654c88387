"""Sweeps whose jobs are processes of their own, through submitit."""

import json
import re

import pytest

pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason='pip install "viinter[cluster]"')


def test_a_sweep_through_submitit_is_whole_though_one_job_fails(command_line, drawn, tmp_path):
    arguments = ["scene=folder", f"scene.root={drawn('folder')}", "scale=smoke", "trainer.accelerator=cpu",
                 "logging.progress=false", "logging.pictures=false", "hydra.sweep.dir=sweep"]  # fmt: skip
    launcher = ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=4"]
    found = command_line("viinter.train", "-m", *launcher, "codes.p=1,0.5", *arguments, cwd=tmp_path)
    assert found.code == 1
    assert "ConfigError: codes.p=0.5: expected none, inf or a number >= 1" in found.err
    assert "Traceback" not in found.err
    sweep = tmp_path / "sweep"
    assert json.loads((sweep / "0" / "metrics.json").read_text())["steps"] == 30
    assert not (sweep / "0" / "failure.txt").exists()
    assert (sweep / "1" / "failure.txt").read_text().startswith("ConfigError: codes.p=0.5: expected")

    found = command_line("viinter.report", "sweep", cwd=tmp_path)
    assert (found.code, found.err) == (0, "")
    text = (sweep / "report" / "report.md").read_text()
    assert "Missing and failed: 1 of 2." in text
    assert "failed: ConfigError: codes.p=0.5" in text


def test_the_slurm_preset_asks_for_one_device_and_puts_stopped_jobs_back(command_line, tmp_path):
    asked = ["hydra/launcher=submitit_slurm", "hydra.launcher.partition=gpu", "experiment=p_norm"]
    out = command_line("viinter.train", *asked, "--cfg", "all", "--package", "hydra.launcher", cwd=tmp_path).out
    for row in ("SlurmLauncher", "partition: gpu", "tasks_per_node: 1", "gpus_per_node: 1", "max_num_timeout: 20"):
        assert re.search(row, out)


def test_sbatch_accepts_every_key_of_the_preset(tmp_path, monkeypatch):
    """submitit writes the batch file that it would hand to SLURM."""
    import submitit
    from omegaconf import OmegaConf
    from submitit.slurm import slurm

    from viinter.command import CONF

    preset = OmegaConf.to_container(OmegaConf.load(CONF / "hydra" / "launcher" / "submitit_slurm.yaml"))
    ours = {k: v for k, v in preset.items() if k not in ("_target_", "submitit_folder", "name", "max_num_timeout")}
    monkeypatch.setattr(slurm.SlurmExecutor, "affinity", classmethod(lambda cls: 1))
    executor = submitit.AutoExecutor(folder=tmp_path, cluster="slurm", slurm_max_num_timeout=preset["max_num_timeout"])
    shared = ("timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes")
    executor.update_parameters(name="train", **{k if k in shared else f"slurm_{k}": v for k, v in ours.items()})
    text = executor._executor._make_submission_file_text("python -c 1", "7")
    for row in ("--signal=USR2@300", "--time=1440", "--gpus-per-node=1", "--mem=32GB", "--open-mode=append"):
        assert row in text
