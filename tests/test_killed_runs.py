"""Training processes that are killed at random moments and go on as if nothing had been."""

import json
import random
import signal

import pytest
from conftest import checkpoint_of, same

KILLS = 10
"""For each of the two models: at random steps, views and calls, and up to 3 ms later."""

SETTINGS = [
    "scale=smoke", "model.code_dim=8", "optim.training_seconds=1.5", "optim.batch_pixels=256", "threads=1",
    "trainer.accelerator=cpu", "evaluation.first_seconds=0.02", "evaluation.factor=1.3", "logging.progress=false",
    "logging.pictures=false", "hydra.run.dir=run",
]  # fmt: skip
OFTEN, NEVER = "checkpoint.every_seconds=0.03", "checkpoint.every_seconds=1e6"


@pytest.mark.parametrize("model", ["paper", "fast"])
def test_a_run_killed_again_and_again_ends_with_the_same_bits(command_line, drawn, tmp_path, model):
    draw = random.Random(model)
    new = [f"scene.root={drawn('planar')}", "scene=planar", f"model={model}", *SETTINGS]
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    straight.mkdir()
    killed.mkdir()
    found = command_line("tests.watched_train", *new, OFTEN, cwd=straight)
    assert (found.code, found.err) == (0, "")

    hit = ""
    # the first before there is a checkpoint, the last two when all steps are done, the others wherever they fall
    for kill, letter in enumerate(("s" + "cse" * KILLS)[: KILLS - 2] + "ff"):
        count, delay = draw.randint(1, 4 if letter == "f" else 30) if kill else 1, draw.uniform(0, 0.003)
        if kill in (1, 2, 3):
            delay = 0  # one for each letter falls where it was planned, however quick the machine
        (killed / "plan").write_text(f"{letter} {count} {delay}")
        arguments = ["resume=run", OFTEN] if kill else [*new, NEVER]
        assert command_line("tests.watched_train", *arguments, cwd=killed).code == -signal.SIGKILL
        assert (killed / "run" / "checkpoints").exists() == bool(kill)
        hit += (killed / "moments").read_text()[-1]
    assert set(hit) >= set("cse"), hit

    (killed / "plan").unlink()
    found = command_line("tests.watched_train", "resume=run", OFTEN, cwd=killed)
    assert (found.code, found.err) == (0, "")
    a, b = (checkpoint_of(folder / "run") for folder in (straight, killed))
    for part in ("state_dict", "optimizer_states", "callbacks", "global_step", "config", "about"):
        assert same(a[part], b[part]), part
    table, again = ((folder / "run" / "error_vs_time.csv").read_text() for folder in (straight, killed))
    assert table == again
    assert len(table.splitlines()) > 10
    metrics, again = (json.loads((folder / "run" / "metrics.json").read_text()) for folder in (straight, killed))
    for of_the_process in ("peak_memory_mb", "seconds"):  # the seconds of its parts, by the wall's clock
        assert metrics.pop(of_the_process) != again.pop(of_the_process) is not None
    assert metrics == again
    assert metrics["training_seconds"] == 1.5
