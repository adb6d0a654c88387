"""The stability reports at a size of seconds: what is run, what is told, and that each finds what is wrong."""

import itertools
import math

import pytest

from viinter import codes, stability, twin
from viinter.config import ConfigError
from viinter.guard import MOST
from viinter.module import ViewInterpolator
from viinter.stability import Axis, axes, corners, key, pairs, plan, precision, presets, stability_map, verdict

FAST = {"model": "fast", "model.layers": 4}  # as `stability.presets` has it
models = pytest.mark.parametrize("model", [{}, FAST], ids=["paper", "fast"])


@models
def test_the_plan_has_every_value_of_every_axis_and_every_pair_once(make_config, model):
    cfg = make_config(**model)
    runs, known = plan(cfg), {axis.name: axis for axis in axes(cfg)}
    assert runs["default"] == {}
    for axis in known.values():
        assert axis.default in axis.values
        assert {key({axis.name: v}) for v in axis.values if v != axis.default} <= runs.keys()
    for first, second in pairs(cfg):
        changed = ([v for v in known[name].values if v != known[name].default] for name in (first, second))
        assert {key({first: a, second: b}) for a, b in itertools.product(*changed)} <= runs.keys()
    assert len(runs) == len({tuple(changes.items()) for changes in runs.values()})
    rates = [axis.settings(v)["optim.lr"] / cfg.optim.lr for axis in (known["rate x"],) for v in axis.values]
    assert rates == pytest.approx([1, 3, 10, 30, 100])


def test_what_works_what_is_worse_and_what_fails():
    default, flat = {"ended": "finished", "mse": 1e-3}, 0.1
    for mse, expected in ((1e-4, "works"), (1.9e-3, "works"), (3e-3, "worse"), (0.09, "worse"), (0.11, "fails")):
        assert verdict({"ended": "finished", "mse": mse}, default, flat) == expected
    assert verdict({"ended": "stopped"}, default, flat) == "fails"
    assert verdict({"ended": "refused"}, default, flat) == "refused"


@pytest.fixture
def two_axes(monkeypatch):
    """An axis of rates, of which one is spoiled with NaN from step 3 on, and one of p, with a value that is refused."""
    step, asked = ViewInterpolator.training_step, []

    def training_step(self, *args):
        loss = step(self, *args)
        return loss * math.nan if self.cfg.optim.lr > 1 and self.trainer.global_step > 3 else loss

    def few(cfg):
        return [Axis("rate x", "1", ["1", "1e5"], lambda x: {"optim.lr": cfg.optim.lr * float(x)}),
                Axis("p", "1", ["1", "0.5"], lambda p: {"codes.p": p})]  # fmt: skip

    outcome = stability.outcome
    monkeypatch.setattr(ViewInterpolator, "training_step", training_step)
    monkeypatch.setattr(stability, "axes", few)
    monkeypatch.setattr(stability, "pairs", lambda cfg: [("rate x", "p")])
    monkeypatch.setattr(stability, "outcome", lambda cfg, changes: (asked.append(changes), outcome(cfg, changes))[1])
    return asked


def test_a_map_tells_what_stopped_and_what_was_refused_and_is_not_made_twice(make_config, tmp_path, two_axes):
    cfg = make_config(**{"optim.steps": 5 * (MOST + 3)})
    found = stability_map(cfg, tmp_path)
    assert {name: run["verdict"] for name, run in found["runs"].items()} == {
        "default": "works", "rate x 1e5": "fails", "p 0.5": "refused", "rate x 1e5, p 0.5": "refused"
    }  # fmt: skip
    assert "optim.lr" in found["runs"]["rate x 1e5"]["why"]
    report = (tmp_path / "report.md").read_text()
    assert "| rate x | 1 | - | 1e5 | - |" in report
    assert "| p | 1 | - | - | 0.5 |" in report
    assert "1 runs were stopped" in report
    assert len(list(tmp_path.glob("map_psnr*.png"))) == 1
    assert len(two_axes) == 4
    stability_map(cfg, tmp_path)
    assert len(two_axes) == 4
    with pytest.raises(ConfigError, match=r"other settings.*hydra\.run\.dir"):
        stability_map(make_config(seed=1), tmp_path)


@models
def test_the_precision_report_has_every_corner_and_says_where_there_is_no_compiler(
    make_config, tmp_path, monkeypatch, model
):
    monkeypatch.setattr(twin, "compiler", lambda: None)
    cfg = make_config(**model)
    cut = {name: changes for name, changes in corners(cfg).items() if "published" not in name and "4096" not in name}
    monkeypatch.setattr(stability, "corners", lambda cfg: cut)
    found = precision(cfg, tmp_path)
    assert found["field"].keys() == cut.keys()
    report = (tmp_path / "report.md").read_text()
    assert "not compared" in report
    assert all(f"| {name} |" in report for name in cut)


@pytest.mark.parametrize("drifting", [False, True])
def test_a_long_run_holds_and_a_drift_is_found(make_config, tmp_path, monkeypatch, drifting):
    if drifting:
        project = codes.CodeBook.project_
        monkeypatch.setattr(codes.CodeBook, "project_", lambda self: (project(self), self.weight.data.mul_(1.0001)))
    found = stability.long(make_config(**{"optim.steps": 60}), tmp_path)
    held = {what: value <= bound for what, (value, bound) in found["checks"].items()}
    assert held["largest relative error of a code's norm"] is not drifting
    assert held["largest relative error of the rate"]
    assert held["steps not taken"]
    assert held["seconds that the clock runs ahead of a stop-watch"]
    assert len(found["rows"]) == 60
    assert ("**not held**" in (tmp_path / "report.md").read_text()) >= drifting
    assert {"long.json", "long_over_the_run.png", "report.md", "report.html"} <= {f.name for f in tmp_path.iterdir()}


def test_the_door_knows_its_reports(command_line, tmp_path):
    said = command_line("viinter.stability", "maps", cwd=tmp_path)
    assert said.code == 1
    assert "map, precision, long" in said.err
    assert "viinter.stability long" in command_line("viinter.stability", cwd=tmp_path).out


def test_a_report_from_the_command_line(command_line, tmp_path):
    said = command_line("viinter.stability", "long", "model=fast", "optim.steps=20", cwd=tmp_path)
    assert said.code == 0, said.err
    assert (tmp_path / "outputs/stability/demo/fast/long/report.md").is_file()
    assert "model.width=64" in presets("map", [])
    assert "model.width=64" not in presets("map", ["model=fast"])
