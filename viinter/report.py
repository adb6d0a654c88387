"""`python -m viinter.report DIR...`: sweeps and runs as tables, plots and panels, the paper's numbers beside ours."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from viinter import command, comparisons, config, evidence, page, peers, plots, runs, scenes
from viinter.comparisons import grouped
from viinter.config import ConfigError, TrainConfig, UserError
from viinter.page import Picture, Section, Table
from viinter.runs import Run

ABOUT = """
Turns sweeps and runs into a report: Markdown with CSV and PNG beside it, and one HTML file with everything in it.
A job of a sweep that is missing or has failed keeps its place, with the reason.

  python -m viinter.report DIR               a sweep, a run, or a folder that holds some: into DIR/report
  python -m viinter.report DIR DIR out=DIR   several together

The tables of the paper's experiments (experiment=p_norm, ...) stand beside the published numbers, data/published.yaml.
"""


def report(folders: list[str | Path], out: Path) -> list[Path]:
    """Writes the report of all runs in `folders` to `out`; returns its files, `report.md` and `report.html` last.

    Raises UserError for a folder without runs, or an `out` that cannot be written.
    """
    found = runs.read(folders)
    for run in found:
        if run.settings is None:
            run.settings = asked_for(run.overrides)
    paper = comparisons.published()
    sections = []
    for experiment in dict.fromkeys(run.experiment for run in found):
        of = [run for run in found if run.experiment == experiment]
        title, items = EXPERIMENTS.get(experiment, ("Runs", lambda *_: []))
        section = Section(experiment or "runs", title, items(of, paper))
        section.items += against_time(of)
        if codes := comparisons.probe_codes(of, paper):
            section.items.append(codes)
        section.items.append(comparisons.every_run(of, varied(of)))
        missing = [f"`{run.folder}` ({' '.join(run.overrides)}): {run.missing}" for run in of if run.missing]
        section.items += [f"Missing and failed: {len(missing)} of {len(of)}.", *missing] if missing else []
        sections.append(section)
    return page.write(out, "viinter: " + ", ".join(dict.fromkeys(Path(f).name for f in folders)), sections)


def asked_for(overrides: list[str]) -> dict[str, Any] | None:
    """The settings, on one level, that a job with these overrides would have; None if they no longer compose."""
    groups = tuple(o for o in overrides if (command.CONF / o.partition("=")[0]).is_dir())
    values = [o for o in overrides if o not in groups and not o.startswith("hydra")]
    try:
        cfg = OmegaConf.merge(composed(groups), OmegaConf.from_dotlist(values))
        return config.flat(config.plain(config.typed(cfg, TrainConfig)))
    except (HydraException, OmegaConfBaseException, ConfigError):
        return None


@functools.cache
def composed(groups: tuple[str, ...]) -> DictConfig:
    """`viinter.train`'s configuration under these choices; composing takes Hydra half a second."""
    command.register(TrainConfig, "train")
    with initialize_config_dir(str(command.CONF), version_base="1.3"):
        return compose("train", list(groups))


def varied(of: list[Run]) -> list[str]:
    """The settings in which the runs differ, but for where files lie and what is shown meanwhile."""
    keys = dict.fromkeys(key for run in of for key in run.settings or {})
    values = {key: {str(run.setting(key)) for run in of if run.settings} for key in keys}
    keys = [key for key in keys if all(key in run.settings for run in of if run.settings)]
    passed_over = ("scene.root", "scene.url", "scene.archive_root", "scene.published.", "paths.", "logging.", "resume")
    return [key for key in keys if len(values[key]) > 1 and not key.startswith(passed_over)]


def against_time(of: list[Run]) -> list[Table | Picture | str]:
    """Error against run time, beside what needs no training."""
    if not any(run.metrics for run in of):
        return []
    named = untrained(of)
    peer_rows = [[name, peer, _text(found, "psnr"), _text(found, "ssim"), _registered(found)]
                 for name, peers_found in named.items() for peer, found in peers_found.items()]  # fmt: skip
    # a line in a plot of one scene alone
    one = next(iter(named.values())) if len(named) == 1 else {}
    mse, psnr = ({k: f[key] for k, f in one.items() if not isinstance(f, str)} for key in ("mse", "psnr"))
    below = "Median over seeds, range shaded, down to the error of 8 bits."
    curves = Picture("Error against time", lambda: plots.error_curves(of, mse), below)
    work = Picture("Work and precision", lambda: plots.work_precision(of, psnr), "Each budget had its own schedule.")
    budgets = {tuple(run.setting(key) for key in evidence.BUDGET[1:]) for run in of}
    return [
        curves,
        *([work] if len(budgets) > 1 else []),
        evidence.times_to_targets(of),
        Table("Without training", ["scene", "peer", "novel PSNR", "novel SSIM", "registered PSNR"], peer_rows,
              ["`blend`: cross-fade of a probe's known views. `flow`: both warped to it along DIS optical flow.",
               comparisons.REGISTERED_NOTE]),
        *([evidence.where_time_goes(of)] if any("seconds" in (run.metrics or {}) for run in of) else []),
        evidence.omitted(of),
    ]  # fmt: skip


def untrained(of: list[Run]) -> dict[str, dict[str, Any]]:
    """`peers.measure` of every scene that the finished runs have, by name and size; the reason if it cannot be read."""
    found = {}
    for run in of:
        if run.metrics:
            name = f"{run.metrics['scene']}, {run.metrics['width']} x {run.metrics['height']}"
            if name not in found:
                try:
                    with Console().status(f"{name}: cross-fade and optical flow at the probes"):
                        found[name] = peers.measure(scenes.load(config.from_plain(run.metrics["settings"]).scene))
                except UserError as error:
                    found[name] = dict.fromkeys(peers.PEERS, str(error))
    return found


def _text(found: dict[str, Any] | str, key: str) -> str:
    return f"- [{found}]" if isinstance(found, str) else comparisons.number(found[key], comparisons.DIGITS[key])


def _registered(found: dict[str, Any] | str) -> str:
    return "-" if isinstance(found, str) else _text(found["registered"], "psnr")


# What the report shows of each experiment: (runs, the paper's numbers) -> items


def p_norm(of: list[Run], paper: dict[str, Any]) -> list[Table | Picture | str]:
    return _ablation(of, "codes.p", paper["table_1_top"], "p")


def code_dim(of: list[Run], paper: dict[str, Any]) -> list[Table | Picture | str]:
    return _ablation(of, "model.code_dim", paper["table_1_bottom"], "M")


def _ablation(of: list[Run], key: str, table: dict[str, Any], name: str) -> list[Table | Picture | str]:
    groups = grouped(of, key, table[key])
    printed = {k: dict(zip(map(str, table[key]), table[k]["psnr"], strict=True)) for k in ("known", "novel")}
    rows = {f"{name} = {value}": runs for value, runs in groups.items()}
    return [
        comparisons.across(f"PSNR and SSIM by {name}", key, of, table),
        Picture(f"PSNR by {name}", lambda: plots.psnr_across(groups, name, printed), comparisons.marked(of)),
        Picture(f"Panel by {name}", lambda: plots.panel(rows, [0, 2, 4]), "Right: the middle of the frame, zoomed in."),
    ]


def equal_radius(of: list[Run], paper: dict[str, Any]) -> list[Table | Picture | str]:
    lines = {
        f"p = {p}": list(grouped(runs, "codes.length").values())
        for p, runs in grouped(of, "codes.p", comparisons.P_ORDER).items() if runs
    }  # fmt: skip
    label = "mean Euclidean length of the codes, measured at the end"
    rows = {f"p = {p}, {at}": runs for p, by in grouped(of, "codes.p", comparisons.P_ORDER).items()
            for at, runs in grouped(by, "codes.length").items()}  # fmt: skip

    def length(run: Run) -> float:
        return run.metrics["code_length"]

    def plot(kind: str) -> Picture:
        draw = functools.partial(plots.psnr_against, lines, length, label, kind)
        return Picture(f"{kind} PSNR against Euclidean length", draw, comparisons.marked(of))

    panel = Picture("Panel by p and length", lambda: plots.panel(rows, [0, 2, 4]))
    tables = [comparisons.lengths(of, kind) for kind in ("novel", "known")]
    return [*tables, plot("novel"), plot("known"), panel]


def features(of: list[Run], paper: dict[str, Any]) -> list[Table | Picture | str]:
    rows = {name: [run for run in of if comparisons.tower(run) == name] for name in map(comparisons.tower, of)}
    return [comparisons.towers(of, paper), Picture("Panel by tower", lambda: plots.panel(rows, [1, 2, 3]))]


def of_scenes(layout: str) -> Callable[[list[Run], dict[str, Any]], list[Table | Picture | str]]:
    def items(of: list[Run], paper: dict[str, Any]) -> list[Table | Picture | str]:
        tables = [comparisons.scenes(f"{kind} views", layout, kind, of, paper) for kind in ("known", "novel")]
        return [*tables, *pairs(of, paper)]

    return items


def pairs(of: list[Run], paper: dict[str, Any]) -> list[Table | Picture | str]:
    return [Picture("From view to view", lambda: plots.panel(grouped(of, "scene.name"), [0, 1, 2, 3, 4]))]


EXPERIMENTS: dict[str | None, tuple[str, Callable[[list[Run], dict[str, Any]], list[Table | Picture | str]]]] = {
    "p_norm": ("The norm of the codes (Table 1, top; Figure 2)", p_norm),
    "code_dim": ("The length of a code (Table 1, bottom; Figure 3)", code_dim),
    "p_norm_equal_radius": ("The norm at equal Euclidean length", equal_radius),
    "features": ("Features of the interpolation loss (Figure 4)", features),
    "planar": ("Planar light fields (Table 2)", of_scenes("planar")),
    "unstructured": ("Unstructured light fields (Table 2)", of_scenes("unstructured")),
    "pairs": ("Two images (frame interpolation)", pairs),
    "error_vs_time": ("Error against run time", lambda *_: []),
}


def main() -> None:
    """The door: folders, and perhaps `out=DIR`."""
    arguments = sys.argv[1:]
    if not arguments or {"--help", "-h"} & set(arguments):
        print(ABOUT.strip())
        return
    outs = [a.partition("=")[2] for a in arguments if a.startswith("out=")]
    folders = [a for a in arguments if not a.startswith("out=")]
    try:
        if not folders:
            raise ConfigError("no folder: expected python -m viinter.report DIR...")
        if wrong := [a for a in folders if a.startswith("-") or ("=" in a and not Path(a).exists())]:
            raise ConfigError(f"{wrong[0]}: expected folders, and perhaps out=DIR")
        here = Path(folders[0]) if len(folders) == 1 else Path("outputs") / f"report_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        out = Path(outs[-1]) if outs else here / "report" if len(folders) == 1 else here
        written = report(folders, out)
    except UserError as error:
        sys.exit(f"{type(error).__name__}: {error}")
    Console().print(f"{len(written)} files: {written[-2]}, {written[-1]}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
