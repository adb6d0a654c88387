"""Error against run time over several runs, and where the time of a run goes."""

import math
import time

import numpy as np
import pytest
from conftest import WITH_TOWER

from viinter import evidence, plots
from viinter.runs import Run
from viinter.step_times import StepTimes
from viinter.train import train


def run_with(points, *overrides, psnr=None, seconds=None):
    """A run measured at (training seconds, novel MSE); its budget is the last of them."""
    rows = [{"training_seconds": s, "novel_mse": e, "novel_psnr": -10 * math.log10(e), "known_mse": None}
            for s, e in points]  # fmt: skip
    budget = points[-1][0] if points else None
    metrics = {"novel": {"psnr": psnr or rows[-1]["novel_psnr"], "ssim": 0.5}, "training_seconds": seconds or budget,
               "hardware": "h", "versions": {"torch": "1", "lightning": "2"}, "threads": 1, "precision": "32-true",
               "seed": 0} if points else None  # fmt: skip
    settings = {"scene.name": "s", "model.name": "paper", "optim.training_seconds": budget, "optim.steps": 9}
    return Run("x", ["scale=cpu", *overrides], settings=settings, metrics=metrics, rows=rows)


def test_methods_are_what_was_asked_beside_seed_and_budget():
    runs = [run_with([(9, 0.1)], f"model={m}", f"optim.training_seconds={t}", f"seed={s}")
            for m in ("paper", "fast") for t in (5, 10) for s in (0, 1)]  # fmt: skip
    assert {name: len(of) for name, of in evidence.methods(runs, budgets=False).items()} == {
        "model=paper": 4, "model=fast": 4,
    }  # fmt: skip
    assert next(iter(evidence.methods(runs))) == "model=paper optim.training_seconds=5"
    assert list(evidence.methods(runs[:1])) == ["s, model=paper"]


def test_a_curve_is_the_median_over_seeds_where_all_were_measured():
    lines = [[(1, 1e-1), (10, 1e-2), (100, 1e-3)], [(2, 3e-2), (50, 3e-3)], [(1, 1e-2), (100, 1e-4)]]
    found = evidence.curve([run_with(points) for points in lines], "novel")
    assert found.seconds == pytest.approx([2, 10, 50])
    assert found.low[1] == pytest.approx(1e-3)  # half-way on both log axes between 1 s and 100 s
    assert found.high[1] == pytest.approx(max(1e-2, 3e-2 * math.exp(math.log(0.1) * math.log(5) / math.log(25))))
    assert np.all((found.low <= found.median) & (found.median <= found.high))
    assert evidence.curve([run_with([])], "novel") is None
    assert evidence.curve([run_with([(1, 0.1)])], "known") is None


def test_the_time_to_a_quality_is_that_of_the_first_measurement_or_not_reached():
    runs = [run_with([(5, 10**-2.4), (20, 10**-2.6), (40, 10**-2.9)], f"seed={k}") for k in range(2)]
    runs.append(run_with([(8, 10**-2.0)], "seed=2"))
    (row,) = evidence.times_to_targets(runs).rows
    assert row[1:6] == ["20 s (2 of 3)", "40 s (2 of 3)", "not reached", "not reached", "not reached"]


def test_the_pareto_front_is_what_nothing_quicker_equals():
    points = [(1, 20), (2, 25), (3, 24), (4, 25), (5, 30), (5, 29)]
    assert plots.pareto(points) == [(1, 20), (2, 25), (5, 30)]


def test_the_work_precision_diagram_has_a_point_for_each_budget_and_a_line_for_what_needs_no_training():
    runs = [run_with([(t, e)], f"model={m}", f"optim.training_seconds={t}", f"seed={s}")
            for m, t, e in (("a", 5, 1e-2), ("a", 20, 1e-3), ("b", 10, 2e-2)) for s in (0, 1)]  # fmt: skip
    figure = plots.work_precision(runs, {"blend": 25.0, "flow": 28.0})
    (axes,) = figure.axes
    drawn = {line.get_label(): list(line.get_xdata()) for line in axes.lines}
    assert drawn["Pareto front"] == [5, 20]
    assert {"blend", "flow"} <= set(drawn)
    assert [list(container.lines[0].get_xdata()) for container in axes.containers] == [[5, 20], [10]]
    plots.plt.close(figure)


def test_what_was_left_out_is_told_once_with_what_it_saved():
    runs = [run_with([(9, 0.1)], f"seed={k}") for k in range(2)]
    for k, run in enumerate(runs):
        known = {"part": "a", "reason": "r", "seconds": 1.0 + k, "megabytes": 0.0, "how": "timed"}
        run.metrics |= {"scene": "s", "omitted": [known, {**known, "part": "b", "seconds": None, "megabytes": None}]}
    assert evidence.omitted(runs).rows == [["s", "a", "r", "1.5", "0.0", "timed"], ["s", "b", "r", "-", "-", "timed"]]


# Where the time of a run goes


def test_the_parts_of_a_run_add_up_to_all_of_it(make_config, tmp_path, fake_tower):
    begin = time.perf_counter()
    values = {**WITH_TOWER, "optim.steps": 40, "evaluation.first_seconds": 0.001, "evaluation.max_share": 100.0}
    seconds = train(make_config("pair", **values), tmp_path)["seconds"]
    took = time.perf_counter() - begin
    parts = "start-up,sampling,forward,backward,optimiser,interpolation step,projection,evaluation,logging,rest"
    assert set(parts.split(",")) <= set(seconds)
    assert all(value >= 0 for value in seconds.values())
    assert 0.8 * took < sum(seconds.values()) < took


def test_without_the_interpolation_step_it_takes_no_time(make_config, tmp_path):
    assert "interpolation step" not in train(make_config("pair"), tmp_path)["seconds"]


def test_optimiser_is_the_step_without_forward_and_backward(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    times = StepTimes()

    def let(action, seconds, inner=()):
        times.start(action)
        now[0] += seconds
        for call in inner:
            let(*call)
        times.stop(action)

    let("[LightningModule]ViewInterpolator.setup", 3)
    times.start("run_training_batch")
    parts = [("[Strategy]S.backward".replace("S.", "SingleDeviceStrategy."), 4),
             ("[Strategy]SingleDeviceStrategy.training_step", 2)]  # fmt: skip
    let("[LightningModule]ViewInterpolator.optimizer_step", 1, parts)
    now[0] += 5
    times.stop("run_training_batch")
    assert times.seconds() == {"start-up": 3, "optimiser": 1, "forward": 2, "backward": 4, "rest": 5}
