"""A file imports only from lower floors; floors 0 and 1 know nothing of Lightning and Hydra."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "viinter"
FLOORS = [
    ["config", "files", "image", "video", "codes", "features", "memory", "metrics", "optical_flow", "replay",
     "fields.field", "fields.maps", "fields.paper", "fields.fast", "fields.charts"],
    ["scenes"],
    ["data", "module", "views", "peers"],
    ["callbacks", "checkpoints", "guard", "pictures", "step_times", "page", "runs", "comparisons", "evidence", "plots",
     "races", "twin"],
    ["command", "train", "evaluate", "render", "download", "bench", "report", "stability"],
]
# the few steps within a floor, each from the plainer to the one that uses it
WITHIN = {
    ("files", "config"), ("image", "config"), ("image", "files"), ("video", "config"), ("video", "files"),
    ("optical_flow", "config"), ("optical_flow", "metrics"),
    ("features", "config"), ("fields.paper", "fields.field"), ("fields.fast", "fields.field"),
    ("fields.fast", "fields.maps"), ("fields.charts", "fields.fast"), ("fields.charts", "fields.field"),
    ("fields.charts", "fields.maps"),
    ("module", "data"), ("checkpoints", "callbacks"), ("train", "command"),
    ("evaluate", "command"), ("render", "command"),
    ("download", "command"), ("bench", "command"), ("evaluate", "train"), ("bench", "train"),
    ("comparisons", "page"), ("evidence", "comparisons"), ("evidence", "page"), ("evidence", "runs"),
    ("plots", "evidence"), ("races", "runs"), ("races", "evidence"),
    ("comparisons", "runs"), ("plots", "pictures"), ("plots", "runs"), ("report", "command"),
    ("stability", "command"), ("stability", "train"),
}  # fmt: skip
FLOOR = {name: k for k, names in enumerate(FLOORS) for name in names}


def modules() -> dict[str, Path]:
    files = [f for f in PACKAGE.rglob("*.py") if f.name != "__init__.py"]
    return {".".join(f.relative_to(PACKAGE).with_suffix("").parts): f for f in files}


def imports(file: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


def test_every_file_stands_on_a_floor():
    assert set(modules()) == set(FLOOR)


@pytest.mark.parametrize("name", sorted(FLOOR))
def test_a_file_imports_only_from_lower_floors(name):
    ours = {n.removeprefix("viinter.") for n in imports(modules()[name]) if n.startswith("viinter.")} & set(FLOOR)
    wrong = {other for other in ours if FLOOR[other] >= FLOOR[name] and (name, other) not in WITHIN}
    assert not wrong


@pytest.mark.parametrize("name", FLOORS[0] + FLOORS[1])
def test_the_lower_floors_know_nothing_of_lightning_and_hydra(name):
    assert not {n for n in imports(modules()[name]) if n.split(".")[0] in ("lightning", "hydra")}
