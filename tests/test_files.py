"""Files that are whole or not there, and the note of a failed run."""

from pathlib import Path

import pytest

from viinter.config import ConfigError, UserError
from viinter.files import failure_noted, whole


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    file = tmp_path / "new" / "a.txt"
    with whole(file) as part:
        part.write_text("first")
        assert not file.exists()
    with pytest.raises(ZeroDivisionError), whole(file) as part:
        part.write_text(str(1 / 0))
    assert file.read_text() == "first"
    assert list(file.parent.iterdir()) == [file]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    for place in (tmp_path / "file" / "a.txt", tmp_path / "new"):
        with pytest.raises(UserError, match=rf"{place}: .*; expected a place that can"), whole(place) as part:
            Path("/dev/full").write_text(part.name)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_the_note_of_a_failure_gives_the_reason_and_goes_when_the_run_ends_well(tmp_path):
    note = tmp_path / "failure.txt"
    with pytest.raises(ConfigError), failure_noted(tmp_path):
        raise ConfigError("optim.lr=0: expected a number above 0")
    assert note.read_text() == "ConfigError: optim.lr=0: expected a number above 0\n"
    with pytest.raises(ZeroDivisionError), failure_noted(tmp_path):
        1 / 0  # noqa: B018
    assert note.read_text().startswith("ZeroDivisionError: division by zero\n\nTraceback")
    assert "1 / 0" in note.read_text()
    with failure_noted(tmp_path):
        assert not note.exists()
    assert not list(tmp_path.iterdir())


def test_a_failure_that_cannot_be_noted_is_still_the_one_that_is_raised(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ZeroDivisionError), failure_noted(tmp_path / "file"):
        1 / 0  # noqa: B018
