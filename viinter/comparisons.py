"""Runs beside the paper's numbers: what a table's cell says of several seeds, and the tables of each experiment.

Every job that should be there has its place: a cell without a number says why. Notation: "here" are our runs, "paper"
the printed numbers of `data/published.yaml`.
"""

from __future__ import annotations

import statistics
from typing import Any

import yaml

from viinter.config import REPOSITORY
from viinter.page import Table
from viinter.runs import Run

DIGITS = {"psnr": 2, "ssim": 3}
UNITS = {"psnr": "PSNR", "ssim": "SSIM"}
P_ORDER = ["none", "inf", "2", "1.5", "1"]
SSIM_NOTE = "SSIM here has data_range = 1 and an 11 x 11 Gaussian window; how the paper's was computed is not said."
REGISTERED_NOTE = "Registered: what is drawn at a probe's mix, moved onto the photograph by optical flow first."


def published() -> dict[str, Any]:
    """`data/published.yaml`."""
    return yaml.safe_load((REPOSITORY / "data" / "published.yaml").read_text())


def cell(runs: list[Run], kind: str, key: str) -> str:
    """The mean over runs of one setting and its range; for runs without the number, how many and why."""
    values = [v for run in runs if (v := run.value(kind, key)) is not None]
    digits = DIGITS[key]
    text = f"{statistics.fmean(values):.{digits}f}" if values else "-"
    if len(values) > 1:
        text += f" ({min(values):.{digits}f} to {max(values):.{digits}f})"
    if (every := max((run.measured_every(kind) for run in runs), default=1)) > 1:
        text += f" [one view of {every}]"
    missing = [run.missing for run in runs if run.missing]
    if not runs:
        return "- (no such job)"
    if not values and not missing:
        return "- (not measured)"
    for reason in dict.fromkeys(missing):
        count = f"{missing.count(reason)} of {len(runs)} " if len(runs) > 1 else ""
        text += f" [{count}{reason if len(reason) <= 60 else reason[:57] + '...'}]"
    return text


def marked(runs: list[Run]) -> str:
    """What stands behind "here": scenes, sizes, network, budget, seeds, alpha, of all the runs together."""
    there = [run for run in runs if run.settings]
    done = [run.metrics for run in there if run.metrics]
    parts = [_listed({run.setting("scene.name") for run in there})]
    parts.append(_listed({f"{m['views']} views of {m['width']} x {m['height']}" for m in done}))
    parts.append(_listed({_network(run) for run in there}))
    parts.append(_listed({_budget(run) for run in there}))
    parts.append("seed " + _listed({run.setting("seed") for run in there}))
    parts.append("alpha " + _listed({run.setting("interpolation.alpha") for run in there}))
    return "; ".join(part for part in parts if part.strip())


def _network(run: Run) -> str:
    name = run.setting("model.name")
    return f"{name} {run.setting('model.width')} x {run.setting('model.depth')}" if name == "paper" else f"model={name}"


def _budget(run: Run) -> str:
    seconds, pixels = run.setting("optim.training_seconds"), run.setting("optim.batch_pixels")
    return f"{f'{seconds:g} s' if seconds else str(run.setting('optim.steps')) + ' steps'} of {pixels} pixels"


def _listed(values: set) -> str:
    return ", ".join(map(str, sorted(values, key=lambda v: (str(type(v)), v))))


def grouped(runs: list[Run], key: str, first: list[Any] = ()) -> dict[str, list[Run]]:
    """Runs by the value of `key` as text: those of `first` in their order (perhaps with no run), then the others."""
    found: dict[str, list[Run]] = {str(value): [] for value in first}
    for run in runs:
        found.setdefault(str(run.setting(key)), []).append(run)
    return found


def across(title: str, key: str, runs: list[Run], paper: dict[str, Any]) -> Table:
    """A table as the paper's Table 1: a column for each value of `key`, for each number a row of paper and of here."""
    groups = grouped(runs, key, paper[key])
    rows = []
    for kind in ("known", "novel"):
        for number in ("ssim", "psnr"):
            printed = dict(zip(map(str, paper[key]), paper[kind][number], strict=True))
            name = f"{kind} {UNITS[number]}"
            rows.append([name, "paper", *(f"{printed[v]:.{DIGITS[number]}f}" if v in printed else "" for v in groups)])
            rows.append([name, "here", *(cell(of, kind, number) for of in groups.values())])
    notes = [f"Paper: {paper['source']}. Here: {marked(runs)}. Mean over seeds, and the range.", SSIM_NOTE]
    return Table(title, ["", "", *(f"{key.split('.')[1]} = {v}" for v in groups)], rows, notes)


def lengths(runs: list[Run], kind: str) -> Table:
    """PSNR of `kind` for every p (rows) at every Euclidean length (columns)."""
    columns = sorted(grouped(runs, "codes.length"), key=lambda v: float(v.replace("None", "0")))
    rows = []
    for p, of in grouped(runs, "codes.p", P_ORDER).items():
        rows.append([f"p = {p}"] + [cell([r for r in of if str(r.setting("codes.length")) == v], kind, "psnr")
                                    for v in columns])  # fmt: skip
    notes = [f"Here: {marked(runs)}. Mean over seeds, and the range. The paper has no such table."]
    return Table(f"{kind} PSNR by p and Euclidean length", ["", *(f"length {v}" for v in columns)], rows, notes)


def scenes(title: str, layout: str, kind: str, runs: list[Run], paper: dict[str, Any]) -> Table:
    """The supplement's table of single scenes, `layout` planar or unstructured, with our runs and the means."""
    table = paper[f"{layout}_{kind}"]
    ours = grouped(runs, "scene.name")
    rows = []
    for name in [*table["scenes"], *(n for n in ours if n not in table["scenes"])]:
        if name not in ours:
            continue
        printed = [f"{v:.{3 if k < 3 else 2}f}" for k, v in enumerate(table["scenes"].get(name, []))] or ["-"] * 6
        here = [cell(ours[name], kind, "ssim"), cell(ours[name], kind, "psnr")]
        rows.append([name, *printed[:3], here[0], *printed[3:], here[1]])
    both = [name for name in ours if name in table["scenes"] and any(r.value(kind, "psnr") for r in ours[name])]
    if both:
        of_paper = [statistics.fmean(table["scenes"][name][k] for name in both) for k in (0, 1, 2, 3, 4, 5)]
        printed = [f"{v:.{3 if k < 3 else 2}f}" for k, v in enumerate(of_paper)]
        here = [_mean_of_means([ours[name] for name in both], kind, number) for number in ("ssim", "psnr")]
        rows.append([f"mean of {', '.join(both)}", *printed[:3], here[0], *printed[3:], here[1]])
    whole = paper["table_2"][layout][kind]
    rows.append(["all scenes (Table 2)"] + [f"{whole[m]['ssim']:.3f}" for m in ("nerf", "lfn", "ours")] + [""]
                + [f"{whole[m]['psnr']:.2f}" for m in ("nerf", "lfn", "ours")] + [""])  # fmt: skip
    columns = ["scene"] + [f"{UNITS[n]} {m}" for n in ("ssim", "psnr") for m in ("NeRF", "LFN", "paper", "here")]
    notes = [f"Paper: {table['source']}. Here: {marked(runs)}.", SSIM_NOTE]
    return Table(title, columns, rows, notes)


def _mean_of_means(groups: list[list[Run]], kind: str, key: str) -> str:
    means = [statistics.fmean(v for run in of if (v := run.value(kind, key)) is not None) for of in groups]
    return f"{statistics.fmean(means):.{DIGITS[key]}f}"


def tower(run: Run) -> str:
    """The feature tower of a run's L_inter; none without it."""
    return run.setting("features.extractor") if run.setting("interpolation.alpha") else "none"


def towers(runs: list[Run], paper: dict[str, Any]) -> Table:
    """L_inter by tower: what it does at probes, and what it costs at known views."""
    rows = []
    for name in dict.fromkeys(tower(run) for run in runs):
        of = [run for run in runs if tower(run) == name]
        alpha = _listed({run.setting("interpolation.alpha") for run in of})
        numbers = [cell(of, kind, number) for kind in ("known", "novel") for number in ("ssim", "psnr")]
        seconds = [run.metrics["training_seconds"] for run in of if run.metrics]
        rows.append([name, alpha, *numbers, f"{statistics.fmean(seconds):.0f}" if seconds else "-"])
    cost = paper["clip_cost"]
    rows.append(["paper, without", "", "", f"{cost['known']['without']:.2f}", "", "", ""])
    rows.append(["paper, with CLIP", "", "", f"{cost['known']['with']:.2f}", "", "", ""])
    columns = ["tower", "alpha", "known SSIM", "known PSNR", "novel SSIM", "novel PSNR", "training s"]
    return Table("L_inter by tower", columns, rows, [f"Paper: {cost['source']}. Here: {marked(runs)}."])


# how a probe's picture came about: what gave its code, and whether it was moved
CODES = {"novel": "interpolated", "registered": "registered", "novel_posed": "posed", "finetuned": "finetuned"}


def probe_codes(runs: list[Run], paper: dict[str, Any]) -> Table | None:
    """The same probes under interpolated codes, as they are and registered by `viinter.evaluate`, under codes placed by
    all cameras' poses, and under codes finetuned by `viinter.evaluate`, for runs that have more than the first; None if
    there are none."""
    measured = [run for run in runs if any(run.value(kind, "psnr") is not None for kind in list(CODES)[1:])]
    if not measured:
        return None
    kinds = [kind for kind in CODES if any(run.value(kind, "psnr") is not None for run in measured)]
    both = [(number, kind) for number in ("ssim", "psnr") for kind in kinds]
    rows = []
    for name, of in grouped(measured, "scene.name").items():
        gains = [
            found - run.value("novel", "psnr") for run in of if (found := run.value("finetuned", "psnr")) is not None
        ]
        gain = f"{statistics.fmean(gains):+.2f}" if gains else "-"
        rows.append([name, *(cell(of, kind, number) for number, kind in both), gain])
    for layout in ("planar", "unstructured"):
        printed = paper["table_3"][layout]
        of = {"novel": printed["ours"], "finetuned": printed["finetuned"]}
        line = [f"{of[kind][number]:.{DIGITS[number]}f}" if kind in of else "" for number, kind in both]
        rows.append([f"paper, {layout}", *line, f"{of['finetuned']['psnr'] - of['novel']['psnr']:+.2f}"])
    columns = ["scene", *(f"{UNITS[number]} {CODES[kind]}" for number, kind in both), "finetuned gains dB"]
    notes = [f"Paper: {paper['table_3']['source']}. Here: {marked(measured)}.", SSIM_NOTE]
    if "registered" in kinds:
        notes.append(REGISTERED_NOTE)
    return Table("Codes of the probes", columns, rows, notes)


def every_run(runs: list[Run], keys: list[str]) -> Table:
    """A line for each run, with its settings `keys`, its numbers, or why there are none."""
    columns = ["run", *keys, "known PSNR", "known SSIM", "novel PSNR", "novel SSIM", "code length", "steps",
               "training s", "wall s", "peak MB", "missing"]  # fmt: skip
    rows = []
    for run in runs:
        line = [f"{run.folder.parent.name}/{run.folder.name}", *(str(run.setting(key)) for key in keys)]
        for kind in ("known", "novel"):
            line += [number(run.value(kind, key), DIGITS[key]) for key in ("psnr", "ssim")]
        facts = run.metrics or {}
        line += [number(facts.get("code_length"), 3), str(facts.get("steps", "-"))]
        line += [number(facts.get(k), 0) for k in ("training_seconds", "wall_seconds", "peak_memory_mb")]
        rows.append([*line, run.missing or ""])
    some = [f"{run.folder.parent.name}/{run.folder.name} measured one view of {every} at its end"
            for run in runs if (every := max(run.measured_every(kind) for kind in ("known", "novel"))) > 1]  # fmt: skip
    return Table("Every run", columns, rows, some)


def number(value: float | None, digits: int) -> str:
    """A number as a cell shows it."""
    return "-" if value is None else f"{value:.{digits}f}"
