"""The command line of the doors: settings from Hydra, help that explains itself, errors in one line.

Each door hands its schema, its root configuration in `conf/` and a plain function to `main`.
"""

from __future__ import annotations

import ctypes
import dataclasses
import errno
import os
import platform
import signal
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from viinter.config import MODELS, REPOSITORY, ConfigError, TrainConfig, UserError, describe, several, typed
from viinter.files import failure_noted

CONF = REPOSITORY / "conf"
GROUPS = ("scene", "model", "scale", "tower", "experiment")  # folders of `conf` that a user chooses from


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


def prepare() -> None:
    """SIGTERM ends this process as Ctrl-C does, and glibc keeps freed blocks.

    On the CPU every large tensor is otherwise mapped and cleared anew at each step, a fifth of a training step's time.
    Elsewhere than on Linux with glibc nothing is done about memory.
    """
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    if sys.platform == "linux" and platform.libc_ver()[0] == "glibc":
        libc, mmap_threshold, trim_threshold = ctypes.CDLL(None), -3, -1
        libc.mallopt(mmap_threshold, 2**30)
        libc.mallopt(trim_threshold, 2**31 - 1)


def show_help(schema: Any, module: str, about: str) -> None:
    """Prints what the command does, examples, and every setting with its default and meaning."""
    console = Console(width=max(100, min(Console().width, 140)), soft_wrap=False)
    console.print(about.strip(), markup=False, highlight=False, soft_wrap=True)
    if hasattr(schema, "scene"):
        for group in GROUPS if hasattr(schema, "model") else GROUPS[:1]:
            if choices(group):
                console.print(f"\n{group}= one of: {', '.join(choices(group))}", markup=False, highlight=False)
    table = Table(box=None, header_style="bold", padding=(0, 1))
    table.add_column("setting", no_wrap=True)
    table.add_column("default")
    table.add_column("meaning")
    for key, default, text in describe(schema):
        table.add_row(key, default, text)
    if hasattr(schema, "model"):
        for name, model in MODELS.items():
            for key, default, text in describe(model(), "model."):
                if key not in ("model.name", "model.code_dim"):
                    table.add_row(key, default, f"model={name}: {text}")
    console.print("\nSettings, given as key=value:", markup=False)
    console.print(table, markup=False)
    console.print(f"\nThe composed settings of a call, without running it: python -m viinter.{module} ... --cfg job")


def check_keys(schema: type, arguments: list[str]) -> None:
    """Raises ConfigError for a `scene=`, `model=`, ... that does not exist or a key that no dataclass has, with those
    that do.

    Hydra refuses them too, but does not say what it would accept.
    """
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or key.startswith(("-", "+", "~", "hydra")):
            continue
        known = choices(key) if key in GROUPS else []
        if known and not set(",(") & set(value) and value not in [*known, "null"]:
            raise ConfigError(f"{argument}: there is no such {key}. There are: {', '.join(known)}")
        nodes: list[Any] = [schema()]
        for depth, part in enumerate(key.split(".")):
            fields = {f.name for node in nodes if dataclasses.is_dataclass(node) for f in dataclasses.fields(node)}
            groups = {folder.name for folder in CONF.iterdir() if folder.is_dir()} - {"hydra"} if depth == 0 else set()
            if part not in fields | groups:
                accepted = ", ".join(sorted(fields | groups)) or "nothing"
                raise ConfigError(f"{argument}: there is no {key}. Accepted there: {accepted}")
            nodes = [getattr(node, part) for node in nodes if hasattr(node, part)]
            if part == "model":
                nodes = [model() for model in MODELS.values()]


def check_run_dir(arguments: list[str]) -> None:
    """Raises ConfigError if `hydra.run.dir=` names a run that is there: Hydra would write over its settings."""
    for argument in arguments:
        key, _, value = argument.partition("=")
        # the other processes of a run on several devices share its folder
        if key == "hydra.run.dir" and (Path(value) / ".hydra").exists() and "hydra.output_subdir=null" not in arguments:
            raise ConfigError(f"{value} holds a run already. Go on with it: python -m viinter.train resume={value}")


def quoted(argument: str) -> str:
    """`key=value` with quotes round a value that has other letters than ASCII's, which Hydra takes in quotes alone."""
    key, equals, value = argument.partition("=")
    if not equals or value.isascii() or value[0] in "'\"[{":
        return argument
    escaped = value.replace("'", "\\'")
    return f"{key}='{escaped}'"


def one_device(devices: Any) -> None:
    """Raises ConfigError for more than one device in a job of a sweep: Lightning would start the whole sweep again for
    each of them."""
    if several(devices):
        raise ConfigError(f"trainer.devices={devices}: a job of a sweep takes one device, 1 or a list of one")


def main(
    schema: type,
    name: str,
    function: Callable[[Any, Path], Any],
    about: str,
) -> None:
    """Runs `function(settings, run_dir)` with the settings of the command line.

    Args:
        schema: dataclass of the settings.
        name: root configuration `conf/<name>.yaml`, and the door's name.
        function: the plain function behind the door.
        about: the text at the top of `--help`.

    A `UserError` ends the process with its message on standard error and exit code 1, without a traceback; so does a
    key, type or choice that Hydra refuses, and an output folder that cannot be written. A run that fails leaves the
    reason in its folder, in `failure.txt`.
    """
    if {"--help", "-h"} & set(sys.argv[1:]):
        show_help(schema(), name, about)
        return
    prepare()
    register(schema, name)
    try:
        check_keys(schema, sys.argv[1:])
        check_run_dir(sys.argv[1:])
    except ConfigError as error:
        sys.exit(f"ConfigError: {error}")

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)
    def job(cfg: DictConfig) -> None:
        hydra_cfg = HydraConfig.get()
        run_dir = Path(hydra_cfg.runtime.output_dir)
        alone = hydra_cfg.mode is not RunMode.MULTIRUN
        try:
            # of the doors only train makes a run folder
            with failure_noted(run_dir) if hydra_cfg.output_subdir else nullcontext():
                if not alone and "trainer" in cfg:
                    one_device(cfg.trainer.devices)
                function(typed(cfg, schema), run_dir)
        except UserError as error:
            if not alone:  # the other jobs go on
                raise
            sys.exit(f"{type(error).__name__}: {error}")

    sys.argv[1:] = [quoted(argument) for argument in sys.argv[1:]]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then passes errors on instead of printing a part of their traceback
    try:
        job()
    except KeyboardInterrupt as interrupt:
        sys.exit(str(interrupt) or "interrupted")
    except UserError as error:
        sys.exit(f"{type(error).__name__}: {error}")
    except OverrideParseException as error:
        sys.exit(f"{error.override}: {error}")
    except CompactHydraException as error:
        sys.exit("\n".join(str(e) for e in (error, error.__cause__) if e))
    except OSError as error:  # of Hydra, which writes the settings before the job begins
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        place = error.filename or f"the run folder below {Path.cwd()}"
        sys.exit(f"UserError: {place}: {error.strerror}; expected a place that can be written")


def one_of(
    functions: dict[str, Callable[[Any, Path], Any]], presets: Callable[[str, list[str]], list[str]], about: str
) -> None:
    """A door with several functions over the settings of training: `python -m viinter.DOOR WHAT key=value ...`.

    `presets(WHAT, arguments)` are settings that come before those of the command line. Without arguments the help is
    shown; an unknown WHAT ends the process with those that there are.
    """
    asked = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if asked in functions:
        sys.argv = [sys.argv[0], *presets(asked, sys.argv[2:]), *sys.argv[2:]]
    elif asked in ("--help", "-h"):
        sys.argv = [sys.argv[0], "--help"]
    else:
        sys.exit(f"{asked}: there is no such thing here. There are: {', '.join(functions)}")
    main(TrainConfig, "train", lambda cfg, folder: functions[asked](cfg, folder), about)
