"""Files that are whole or not there at all, and the note that a failed run leaves."""

from __future__ import annotations

import json
import os
import traceback
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from viinter.config import UserError


@contextmanager
def whole(path: str | os.PathLike) -> Iterator[Path]:
    """A name beside `path` to write to, with the same ending; its folder is created.

    At the end the file gets the name `path`, so that neither a killed process nor a full disk leaves half a file
    there. On any error it is removed and `path` is as it was.

    Raises UserError, naming `path`, for a place that cannot be written.
    """
    target = Path(path)
    part = target.with_name(f".{uuid.uuid4().hex}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield part
        os.replace(part, target)
    except OSError as error:
        raise UserError(f"{path}: {error}; expected a place that can be written") from error
    finally:
        with suppress(OSError):  # it is gone already where all went well
            part.unlink()


def write_json(path: str | os.PathLike, values: dict[str, Any]) -> None:
    """Writes the file whole; NaN and infinity are refused (ValueError)."""
    with whole(path) as part:
        part.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n")


@contextmanager
def failure_noted(run_dir: Path) -> Iterator[None]:
    """Leaves `run_dir/failure.txt` if what is inside does not end well: the reason in the first line, and for an error
    that nobody foresaw the traceback below. An older note is removed first."""
    note = run_dir / "failure.txt"
    with suppress(OSError):
        note.unlink()
    try:
        yield
    except BaseException as error:
        text = f"{type(error).__name__}: {error}\n"
        if not isinstance(error, UserError | KeyboardInterrupt):
            text += "\n" + traceback.format_exc()
        with suppress(UserError), whole(note) as part:  # the disk may be what failed
            part.write_text(text)
        raise
