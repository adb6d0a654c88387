"""The benches at a size of seconds: what they count and tell."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from conftest import WITH_TOWER

from viinter import bench


def test_alpha_is_timed_with_and_without(make_config, tmp_path, capsys, fake_tower, monkeypatch):
    here = SimpleNamespace(submit=lambda function, cfg: SimpleNamespace(result=lambda: function(cfg)))
    monkeypatch.setattr(bench, "ProcessPoolExecutor", lambda *_: nullcontext(here))  # another process has no fake tower
    monkeypatch.setattr(bench, "random_tower", lambda model, folder: folder / "random.pt")
    steps = bench.WARM_UP + 4
    found = bench.alpha(make_config("pair", **{**WITH_TOWER, "optim.steps": steps}), tmp_path)
    assert found.keys() == {"seconds a step", "seconds before the first step", "peak MB"}
    for row in found.values():
        assert row["saved"] == pytest.approx(row["with"] - row["without"])
    assert steps // 2 < fake_tower.calls < steps  # every second step of one of the two runs, and its views
    assert "L_inter every 2 steps" in capsys.readouterr().out


def test_a_step_is_timed_beside_its_bare_twin_for_both_models(make_config, tmp_path):
    for values in ({}, {"model": "fast"}):
        found = bench.step(make_config(**{"optim.steps": bench.WARM_UP + 3, **values}), tmp_path)
        assert found["steps"] == 3
        assert found["ratio"] > 0
        assert {"forward", "backward", "optimiser", "callback DivergenceGuard"} <= found["parts"].keys()
    assert "model.width=128" in bench.presets("step", [])
    assert "model.width=128" not in bench.presets("step", ["model=fast"])
