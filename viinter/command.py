"""The command line of the doors: settings from Hydra, help that explains itself, errors in one line.

Each door hands its schema, its root configuration in `conf/` and a plain function to `main`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from viinter.config import MODELS, REPOSITORY, UserError, describe, typed

CONF = REPOSITORY / "conf"


def register(schema: type, name: str) -> None:
    """Makes the schemas known to Hydra: `schema` for the root `name`, and one for each model."""
    store = ConfigStore.instance()
    store.store(name="schema" if name == "train" else f"{name}_schema", node=schema)
    for model, node in MODELS.items():
        store.store(group="model", name=f"{model}_schema", node=node)


def choices(group: str) -> list[str]:
    """The names that `group=NAME` accepts, such as `stanford/knights` for `scene`."""
    folder = CONF / group
    return sorted(str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.yaml"))


def show_help(schema: Any, module: str, about: str) -> None:
    """Prints what the command does, examples, and every setting with its default and meaning."""
    console = Console(width=max(100, min(Console().width, 140)), soft_wrap=False)
    console.print(about.strip(), markup=False)
    if hasattr(schema, "scene"):
        for group in ("scene", "model", "scale", "experiment") if hasattr(schema, "model") else ("scene",):
            if choices(group):
                console.print(f"\n{group}= one of: {', '.join(choices(group))}", markup=False, highlight=False)
    table = Table(box=None, header_style="bold", padding=(0, 1))
    table.add_column("setting", no_wrap=True)
    table.add_column("default")
    table.add_column("meaning")
    for key, default, text in describe(schema):
        table.add_row(key, default, text)
    console.print("\nSettings, given as key=value:", markup=False)
    console.print(table, markup=False)
    console.print(f"\nThe composed settings of a call, without running it: python -m viinter.{module} ... --cfg job")


def main(
    schema: type,
    name: str,
    function: Callable[[Any, Path], Any],
    about: str,
    example: Any = None,
) -> None:
    """Runs `function(settings, run_dir)` with the settings of the command line.

    Args:
        schema: dataclass of the settings.
        name: root configuration `conf/<name>.yaml`, and the door's name.
        function: the plain function behind the door.
        about: the text at the top of `--help`.
        example: settings whose defaults `--help` shows; those of `schema` if None.

    A `UserError` ends the process with its message on standard error and exit code 1, without a traceback; so does a
    key, type or choice that Hydra refuses.
    """
    if {"--help", "-h"} & set(sys.argv[1:]):
        show_help(example or schema(), name, about)
        return
    register(schema, name)
    scene = next((a.removeprefix("scene=") for a in sys.argv[1:] if a.startswith("scene=")), None)
    if scene and "," not in scene and "(" not in scene and scene not in choices("scene"):
        sys.exit(f"scene={scene}: there is no such scene. There are: {', '.join(choices('scene'))}")

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)
    def job(cfg: DictConfig) -> None:
        try:
            function(typed(cfg, schema), Path(HydraConfig.get().runtime.output_dir))
        except UserError as error:
            if HydraConfig.get().mode is RunMode.MULTIRUN:  # the other jobs go on
                raise CompactHydraException(str(error)) from None
            sys.exit(f"{type(error).__name__}: {error}")

    try:
        job()
    except KeyboardInterrupt:
        sys.exit("interrupted")
