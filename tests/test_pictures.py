"""Pictures that a person reads numbers from."""

import pytest

from viinter import pictures


@pytest.mark.parametrize(("least", "bottom"), [(1e-5, None), (1e-12, pictures.ROUNDING)])
def test_errors_smaller_than_those_of_8_bits_leave_the_plot(tmp_path, monkeypatch, least, bottom):
    kept = []
    monkeypatch.setattr(pictures.plt, "close", kept.append)
    rows = [{"training_seconds": s, "known_mse": e, "novel_mse": 1e-3} for s, e in ((1.0, 1e-2), (60.0, least))]
    pictures.plot_error(tmp_path / "error.png", rows, "a run")
    monkeypatch.undo()
    low, high = kept[0].axes[0].get_ylim()
    assert low == pytest.approx(bottom) if bottom else low < least
    assert high > 1e-2
    pictures.plt.close(kept[0])


def test_the_right_axis_has_the_decibels_of_the_error_beside_it(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(pictures.plt, "close", kept.append)
    rows = [{"training_seconds": s, "known_mse": e, "novel_mse": 2 * e} for s, e in ((1.0, 1e-2), (60.0, 1e-5))]
    pictures.plot_error(tmp_path / "error.png", rows, "a run")
    monkeypatch.undo()
    axes = kept[0].axes[0]
    right = axes.child_axes[0]
    ticks = zip(right.get_yticks(), right.get_yticklabels(), strict=True)
    heights = {label.get_text(): right.transData.transform((0, at))[1] for at, label in ticks}
    for mse, label in ((1e-2, "20"), (1e-3, "30"), (1e-5, "50")):
        assert heights[label] == pytest.approx(axes.transData.transform((1, mse))[1], abs=0.1)
    pictures.plt.close(kept[0])
