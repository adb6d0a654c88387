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


@pytest.mark.parametrize(
    ("seconds", "labels"), [((27.0, 119.0), ["30", "40", "60", "100"]), ((0.5, 1800.0), ["1", "10", "100", "1000"])]
)
def test_seconds_are_said_as_people_say_them(seconds, labels):
    figure, axes = pictures.plt.subplots()
    axes.plot(seconds, (1.0, 2.0))
    pictures.plain_log_x(axes)
    axes.set_xlim(*seconds)
    figure.canvas.draw()
    low, high = seconds
    ticks = axes.xaxis.get_major_ticks() + axes.xaxis.get_minor_ticks()
    shown = [(tick.get_loc(), tick.label1.get_text()) for tick in ticks]
    assert [text for at, text in sorted(shown) if low <= at <= high and text] == labels
    pictures.plt.close(figure)
