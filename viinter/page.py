"""A page of text, tables and pictures, as Markdown with its pictures and tables beside it and as one HTML file."""

from __future__ import annotations

import base64
import csv
import html
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from viinter.files import whole

matplotlib.use("Agg")
from matplotlib import pyplot as plt


@dataclass
class Table:
    """Rows of cells, all strings, under `columns`; `notes` stand below it. The title names its files."""

    title: str
    columns: list[str]
    rows: list[list[str]]
    notes: list[str] = field(default_factory=list)


@dataclass
class Picture:
    """A picture, by a function that draws it; `text` stands below it. The title names its file."""

    title: str
    draw: Callable[[], Figure]
    text: str = ""


@dataclass
class Section:
    """A heading, and what stands under it; a string is a paragraph. Its files' names begin with `name`."""

    name: str
    title: str
    items: list[str | Table | Picture] = field(default_factory=list)


def write(folder: Path, title: str, sections: list[Section]) -> list[Path]:
    """Writes `report.md`, `report.html`, and a PNG (and for a table a CSV) for each table and picture; returns all.

    The HTML file holds its pictures and can be sent alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    markdown, body, files = [f"# {title}"], [f"<h1>{html.escape(title)}</h1>"], []
    for section in sections:
        markdown.append(f"## {section.title}")
        body.append(f"<h2>{html.escape(section.title)}</h2>")
        for item in section.items:
            if isinstance(item, str):
                markdown.append(item)
                body.append(f"<p>{_inline(item)}</p>")
                continue
            stem = re.sub(r"[^a-z0-9]+", "_", f"{section.name} {item.title}".lower()).strip("_")
            picture = folder / f"{stem}.png"
            if isinstance(item, Table):
                _write_csv(folder / f"{stem}.csv", item)
                files.append(folder / f"{stem}.csv")
                figure = _figure_of(item)
            else:
                figure = item.draw()
            with whole(picture) as part:
                figure.savefig(part, dpi=110)
            plt.close(figure)
            files.append(picture)
            if isinstance(item, Table):
                markdown += [f"**{item.title}** ([CSV]({stem}.csv), [PNG]({stem}.png))", as_markdown(item)]
                markdown += item.notes
                body += [f"<h3>{html.escape(item.title)}</h3>", _as_html(item)]
                body += [f"<p class=note>{_inline(note)}</p>" for note in item.notes]
            else:
                markdown += [f"![{item.title}]({stem}.png)", f"*{item.title}.* {item.text}"]
                data = base64.b64encode(picture.read_bytes()).decode()
                caption = f"<figcaption><b>{html.escape(item.title)}.</b> {_inline(item.text)}</figcaption>"
                body.append(f'<figure><img src="data:image/png;base64,{data}">{caption}</figure>')
    for name, text in (("report.md", "\n\n".join(markdown) + "\n"), ("report.html", HTML % ("\n".join(body)))):
        with whole(folder / name) as part:
            part.write_text(text)
        files.append(folder / name)
    return files


def as_markdown(table: Table) -> str:
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _as_html(table: Table) -> str:
    def row(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{_inline(cell)}</{tag}>" for cell in cells) + "</tr>"

    return "<table>" + "\n".join([row(table.columns, "th"), *(row(cells, "td") for cells in table.rows)]) + "</table>"


def _write_csv(file: Path, table: Table) -> None:
    with whole(file) as part, part.open("w", newline="") as out:
        csv.writer(out).writerows([table.columns, *table.rows])


def _figure_of(table: Table) -> Figure:
    """The table as monospaced text: quick to draw, whatever its size."""
    lines = [table.columns, *table.rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(table.columns))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
    text.insert(1, "-" * len(text[0]))
    figure = plt.figure(figsize=(0.0715 * len(text[0]) + 0.4, 0.15 * (len(text) + 2) + 0.2))
    figure.text(0.2 / figure.get_figwidth(), 1, "\n".join(["", table.title, *text]), va="top", fontsize=8,
                fontfamily="monospace")  # fmt: skip
    return figure


def _inline(text: str) -> str:
    """HTML of a text with `code` and **bold** in it."""
    text = re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text, quote=False))
    return re.sub(r"\*\*([^*]*)\*\*", r"<b>\1</b>", text)


HTML = """<!doctype html>
<meta charset="utf-8">
<style>
body { font: 15px/1.5 sans-serif; max-width: 75em; margin: 2em auto; padding: 0 1em }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px }
th, td { border: 1px solid #bbb; padding: .2em .6em; text-align: left }
th { background: #eee }
img { max-width: 100%% }
figure { margin: 1em 0 }
.note, figcaption { color: #555; font-size: 13px }
</style>
%s
"""
