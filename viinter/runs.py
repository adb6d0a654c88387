"""Run folders and sweeps as the report reads them: what was asked for, what came out, and why something is missing.

Notation: a sweep's *jobs* are the combinations of values that it should run; each has, or should have, a run folder.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from viinter import config
from viinter.config import ConfigError, UserError

EVALUATED = ("finetuned", "registered")  # what `viinter.evaluate` measures and training does not


@dataclass
class Run:
    """One run folder, or the place where a job of a sweep should have left one.

    overrides: as typed, and for a job of a sweep with its own values. experiment: of `conf/experiment`, if any.
    settings: all of them, as one level of plain values; None where no file tells. metrics: of a finished run.
    evaluation: of `viinter.evaluate`. rows: of `error_vs_time.csv`, numbers or None. missing: why there are no metrics.
    """

    folder: Path
    overrides: list[str]
    experiment: str | None = None
    settings: dict[str, Any] | None = None
    metrics: dict[str, Any] | None = None
    evaluation: dict[str, Any] | None = None
    rows: list[dict[str, float | None]] = field(default_factory=list)
    missing: str | None = None

    def setting(self, key: str) -> Any:
        return None if self.settings is None else self.settings.get(key)

    def value(self, kind: str, key: str) -> float | None:
        """The mean `key` (psnr, ssim, mse) of `kind` (known, novel, ..., `EVALUATED`); None if it was not measured."""
        found = ((self.evaluation or {}) if kind in EVALUATED else (self.metrics or {})).get(kind)
        return found[key] if found else None

    def measured_every(self, kind: str) -> int:
        """One of so many views of `kind` was measured at the end of training, all of them by `viinter.evaluate`."""
        return (self.metrics or {}).get("measured_every", {}).get(kind, 1)


def read(folders: list[str | Path]) -> list[Run]:
    """All runs in `folders`, each a run, a sweep, or a folder that holds some; a sweep's missing jobs among them.

    Raises UserError for a folder that is not there or holds no run.
    """
    found: dict[Path, Run] = {}
    for folder in map(Path, folders):
        runs = _read(folder)
        if not runs:
            raise UserError(f"{folder}: expected a folder with runs or sweeps of viinter.train; there is none in it")
        found |= {run.folder.resolve(): run for run in runs}
    return list(found.values())


def _read(folder: Path) -> list[Run]:
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder; expected runs or sweeps of viinter.train")
    if (folder / "multirun.yaml").is_file():
        return _sweep(folder)
    if (folder / ".hydra" / "config.yaml").is_file() or (folder / "metrics.json").is_file():
        return [_run(folder)]
    return [run for inner in sorted(folder.iterdir()) if inner.is_dir() for run in _read(inner)]


def jobs(sweep: dict[str, Any]) -> list[list[str]]:
    """The overrides of every job of a sweep, from its `multirun.yaml`, in the order of its folders 0, 1, ..."""
    given = [f"{key}={value}" for key, value in (sweep["hydra"]["sweeper"]["params"] or {}).items()]
    parsed = OverridesParser.create().parse_overrides([*given, *sweep["hydra"]["overrides"]["task"]])
    return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def _sweep(folder: Path) -> list[Run]:
    sweep = OmegaConf.to_container(OmegaConf.load(folder / "multirun.yaml"))
    experiment = sweep["hydra"]["runtime"]["choices"].get("experiment")
    return [_run(folder / str(k), overrides, experiment) for k, overrides in enumerate(jobs(sweep))]


def _run(folder: Path, overrides: list[str] | None = None, experiment: str | None = None) -> Run:
    hydra = folder / ".hydra"
    if overrides is None:
        overrides = list(OmegaConf.load(hydra / "overrides.yaml")) if (hydra / "overrides.yaml").is_file() else []
        chosen = [o.partition("=")[2] for o in overrides if o.startswith("experiment=")]
        experiment = chosen[-1] if chosen else None
    run = Run(folder, overrides, experiment)
    run.metrics, run.evaluation = _json(folder / "metrics.json"), _json(folder / "evaluation.json")
    if run.metrics and "settings" not in run.metrics:
        run.metrics, run.missing = None, "metrics.json is of an older version, without settings"
    if run.metrics:
        run.settings = config.flat(run.metrics["settings"])
    elif hydra.is_dir():
        try:
            run.settings = config.flat(config.plain(config.read_run(folder)))
        except ConfigError:
            run.settings = None  # the note of its failure says more
    if (table := folder / "error_vs_time.csv").is_file():
        with table.open(newline="") as lines:
            run.rows = [{k: float(v) if v else None for k, v in row.items()} for row in csv.DictReader(lines)]
    if run.metrics is None:
        run.missing = run.missing or _reason(folder)
    return run


def _reason(folder: Path) -> str:
    if not folder.is_dir():
        return "not started, or deleted"
    if (note := folder / "failure.txt").is_file():
        return f"failed: {note.read_text().splitlines()[0]}"
    return "not finished"


def _json(file: Path) -> dict[str, Any] | None:
    return json.loads(file.read_text()) if file.is_file() else None
