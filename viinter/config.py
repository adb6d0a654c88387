"""Every setting of the framework, with its unit, its default and where the default comes from.

Notation: `n` known views, `M` the length of a code, `H, W` the size of a view in pixels. "paper" is VIINTER
(SIGGRAPH Asia 2022), "supplement" its Supplementary Information, "code" the authors' published code.

The dataclasses below are both the schema that Hydra holds a configuration against (an unknown key or a wrong type
stops the run) and the typed objects that the rest of the program reads. `check` holds one setting against another.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf


class UserError(ValueError):
    """Something that the person at the keyboard can put right; its message says what, and what is accepted."""


class ConfigError(UserError):
    """A setting, or two settings together, that cannot be run."""


def setting(default: Any, text: str) -> Any:
    """A dataclass field with a help text; mutable defaults are copied for each instance."""
    if isinstance(default, list) or dataclasses.is_dataclass(default):
        return field(default_factory=lambda: copy.deepcopy(default), metadata={"help": text})
    return field(default=default, metadata={"help": text})


class Layout(Enum):
    """How the views of a scene lie, and so which of them are known and which are probes (see `scenes.py`)."""

    planar = "planar"
    llff = "llff"
    studio = "studio"
    pair = "pair"
    folder = "folder"


class Holdout(Enum):
    """Which views are kept from training as probes."""

    standard = "standard"
    none = "none"


class OutOfRange(Enum):
    """What to do with float images whose values leave [0, 1]."""

    refuse = "refuse"
    clamp = "clamp"
    scale = "scale"


class Patches(Enum):
    """How an image is cut into the 224 x 224 patches that a feature tower sees."""

    paper = "paper"
    cover = "cover"


class PixelsFrom(Enum):
    """Where the pixels of one batch come from."""

    one_view = "one_view"
    all_views = "all_views"
    rows = "rows"


@dataclass
class Paths:
    data: str = setting("data", "folder that holds the scenes: DIR/stanford/knights, DIR/llff/fern, ...")


@dataclass
class Published:
    """What the paper gives for a scene (supplement, Training Details); other groups refer to these."""

    alpha: float = setting(0.0, "weight of the interpolation loss")
    width: int = setting(512, "hidden width of the paper's network")
    steps: int = setting(300_000, "training steps")


@dataclass
class SceneConfig:
    name: str = setting(MISSING, "name shown in tables and pictures")
    layout: Layout = setting(MISSING, "how the views lie; decides known views and probes")
    root: str = setting(MISSING, "folder of the scene's images (llff, studio: of the scene)")
    images: str | None = setting(None, "llff: the sub-folder with the images, such as images_4")
    downsample: int = setting(1, "area reduction by this whole factor, before cropping")
    max_pixels: int | None = setting(
        None, "most pixels of a view: reduce by the smallest whole factor, from downsample on, that brings it there"
    )
    crop: list[int] | None = setting(None, "[x0,y0,x1,y1] in pixels after downsampling, x1 and y1 excluded")
    holdout: Holdout = setting(Holdout.standard, "standard: the layout's probes are held out; none: train on all")
    max_views: int = setting(30, "most views trained on with holdout=none (30 in the paper)")
    background: list[float] = setting([1.0, 1.0, 1.0], "rgb in [0,1] under transparent pixels")
    out_of_range: OutOfRange = setting(
        OutOfRange.refuse, "float images outside [0,1]: refuse, clamp, or scale the scene by its largest value"
    )
    endpoints: list[int] | None = setting(None, "[i,j] known views of the demonstration; null: first and last")
    url: list[str] | None = setting(None, "addresses of the archive, tried in order (viinter.download)")
    archive_root: str | None = setting(None, "folder inside the archive that holds the scene")
    published: Published = setting(Published(), "what the paper gives this scene")


@dataclass
class CodesConfig:
    p: str = setting("1", "norm that codes are kept at: none, inf, or a number >= 1 (paper Section 3.3: 1)")
    radius: float = setting(1.0, "that norm's value (paper Section 3.3: 1)")
    length: float | None = setting(
        None, "ours, in place of radius: the norm of a random code of this Euclidean length; p=none: codes start at it"
    )


@dataclass
class ModelConfig:
    """What all fields share; `conf/model/NAME.yaml` chooses one of the classes below."""

    name: str = setting(MISSING, "paper or fast")
    code_dim: int = setting(128, "M, the length of a code (supplement: 128)")


@dataclass
class PaperModel(ModelConfig):
    """The published network: a SIREN with a LayerNorm after each sine."""

    width: int = setting(512, "hidden width (supplement: 512, volumetric scenes 256)")
    depth: int = setting(8, "sine layers (supplement: 8)")
    first_omega: float = setting(30.0, "sine frequency of the first layer (SIREN: 30)")
    hidden_omega: float = setting(30.0, "sine frequency of the other layers (SIREN: 30)")
    layer_norm: bool = setting(True, "LayerNorm after each sine (code; the paper does not speak of it)")


@dataclass
class FastModel(ModelConfig):
    """Layers of texture carried by a learned motion (`fields/fast.py`)."""

    layers: int | None = setting(
        None,
        "surfaces of the scene, in each set, down to 4 in the shortest budgets; null: 8 for more than 4 photographs by "
        "hand (llff, folder), else 4",
    )
    sets: int | None = setting(
        None,
        "sets of layers, each right by itself, fewer in short budgets; their mean is drawn; null: 2 for more than 4 "
        "photographs by hand, else 4",
    )
    motion: int = setting(6, "motion polynomials: 1 shifts, 3 adds turns and zooms, 6 adds perspective")
    margin: float = setting(1.1, "size of a texture in views, for what moves in from outside")
    texture_pixels: int = setting(
        2**18, "textures have the size of a view up to this; of larger views half of it, or a quarter, and so on"
    )
    sharpness: float = setting(5.0, "scale of the layers' weights in their softmax")
    entropy: float = setting(1e-3, "weight of the penalty on pixels that mix layers")
    smooth: float = setting(2e-3, "weight of the penalty on disparities that differ between pixels of one colour")
    consistency: float = setting(1.0, "weight of the penalty on pixels that a known view nearby does not have there")
    window: int | None = setting(
        None, "views in a row, as files are sorted, that have layers of their own; null: 3 in a studio ring, else all"
    )
    remainder: bool = setting(True, "keep what the layers leave over of each known view, and share it out")


@dataclass
class OptimConfig:
    steps: int = setting(300_000, "training steps, unless training_seconds is given")
    training_seconds: float | None = setting(None, "budget in seconds, in place of steps; model=fast may end sooner")
    lr: float = setting(1e-5, "learning rate of Adam at the start (supplement: 1e-5)")
    lr_decay: float = setting(0.1, "rate at the end, as a share of the first; cosine between (supplement: 0.1)")
    beta2: float = setting(0.999, "Adam's decay of squared gradients (PyTorch's default)")
    batch_pixels: int = setting(8192, "pixels a step, of all devices together (supplement: 8192)")
    pixels_from: PixelsFrom = setting(PixelsFrom.one_view, "one random view (code), all views, or pieces of rows")


@dataclass
class InterpolationConfig:
    alpha: float = setting(0.0, "weight of L_inter (supplement: by scene); 0 leaves all of it out")
    every: int = setting(2, "steps between two interpolation steps (supplement: 2)")
    chunk_pixels: int = setting(
        65_536, "pixels drawn at a time in the interpolation step; activations of one chunk are held at once"
    )


@dataclass
class FeaturesConfig:
    extractor: str = setting("clip", "feature tower of L_inter: clip or vgg16")
    model: str = setting("ViT-B-32-quickgelu", "open_clip architecture (OpenAI's weights want a -quickgelu one)")
    weights: str | None = setting(None, "weights: a file, or for clip the name of published ones, such as openai")
    patches: Patches = setting(Patches.paper, "paper: whole 224-patches only; cover: patches reach every pixel")


@dataclass
class EvaluationConfig:
    first_seconds: float = setting(5.0, "training seconds before the first evaluation")
    factor: float = setting(1.5, "each next evaluation comes after this times the training seconds of the last")
    max_share: float = setting(0.1, "most of the training seconds that evaluations may take, but 30 s for the last one")
    chunk_pixels: int = setting(131_072, "pixels drawn at a time; lower it if memory runs out")


@dataclass
class CheckpointConfig:
    every_seconds: float = setting(120.0, "wall seconds between two checkpoints; one is always kept at the end")


@dataclass
class LoggingConfig:
    every_seconds: float = setting(1.0, "training seconds between two rows of scalars in TensorBoard")
    progress: bool = setting(True, "show a progress bar")
    pictures: bool = setting(True, "TensorBoard pictures, strip.png, interpolation.mp4")
    frames: int = setting(60, "frames of interpolation.mp4; fewer, shown longer, where drawing them takes long")


@dataclass
class TrainerConfig:
    """Passed to `lightning.Trainer` as they are."""

    accelerator: str = setting("auto", "auto, cpu, gpu, mps, ...")
    devices: Any = setting(1, "number of devices, or a list of their numbers")
    strategy: str = setting("auto", "auto, ddp, ...")
    precision: str = setting("32-true", "32-true, bf16-mixed, 16-mixed, bf16-true, 64-true")
    gradient_clip_val: float | None = setting(None, "clip gradients at this norm")
    deterministic: bool = setting(False, "only deterministic algorithms")


@dataclass
class TrainConfig:
    """`python -m viinter.train`."""

    scene: SceneConfig = setting(SceneConfig(), "what is trained on")
    model: ModelConfig = setting(ModelConfig(), "the field")
    codes: CodesConfig = setting(CodesConfig(), "the codes' sphere")
    optim: OptimConfig = setting(OptimConfig(), "optimiser and budget")
    interpolation: InterpolationConfig = setting(InterpolationConfig(), "L_inter")
    features: FeaturesConfig = setting(FeaturesConfig(), "the feature tower of L_inter; not used with alpha = 0")
    evaluation: EvaluationConfig = setting(EvaluationConfig(), "when and how known views and probes are measured")
    checkpoint: CheckpointConfig = setting(CheckpointConfig(), "checkpoints")
    logging: LoggingConfig = setting(LoggingConfig(), "TensorBoard, bar, pictures")
    trainer: TrainerConfig = setting(TrainerConfig(), "Lightning's Trainer")
    paths: Paths = setting(Paths(), "folders")
    seed: int = setting(0, "seed of everything random")
    threads: int | None = setting(None, "CPU threads of PyTorch; null leaves PyTorch's own choice")
    resume: str | None = setting(None, "a run folder to go on with; its own settings are used")


@dataclass
class EvaluateConfig:
    """`python -m viinter.evaluate`."""

    run: str = setting(MISSING, "run folder")
    finetune_steps: int = setting(400, "steps of each probe's code against its target; 0 leaves finetuned codes out")
    finetune_lr: float = setting(0.05, "step size of Adam at the start, as a share of the code book's rms entry")
    finetune_pixels: int = setting(2048, "random pixels of a probe in a step")
    data: str | None = setting(None, "folder of the scenes, if they have moved since training (paths.data)")
    accelerator: str = setting("auto", "auto, cpu, cuda, mps")
    threads: int | None = setting(None, "CPU threads of PyTorch; null leaves PyTorch's own choice")
    chunk_pixels: int = setting(131_072, "pixels drawn at a time; lower it if memory runs out")


class Easing(Enum):
    linear = "linear"
    smooth = "smooth"


class FrameFormat(Enum):
    png = "png"
    exr = "exr"
    none = "none"


@dataclass
class RenderConfig:
    """`python -m viinter.render`."""

    run: str = setting(MISSING, "run folder")
    path: list[int] | None = setting(
        None, "known views to pass through, such as [0,4,24]; null: the endpoints, in a studio scene those between too"
    )
    corners: list[int] | None = setting(
        None, "four known views [top left, top right, bottom left, bottom right]: their mixes, in place of a path"
    )
    side: int = setting(5, "with corners: mixes along a side of sheet.png")
    frames: int = setting(60, "frames from one view of the path to the next; with corners, of one round")
    size: list[int] | None = setting(None, "[height,width] of the output; null: as trained")
    easing: Easing = setting(Easing.linear, "linear, or smooth: slow at each view")
    loop: bool = setting(False, "come back to the first view")
    fps: float = setting(30.0, "frames a second")
    format: FrameFormat = setting(FrameFormat.png, "single frames as png or exr files; none: film only")
    out: str | None = setting(None, "output folder; null: RUN/render/<date_time>")
    accelerator: str = setting("auto", "auto, cpu, cuda, mps")
    threads: int | None = setting(None, "CPU threads of PyTorch; null leaves PyTorch's own choice")
    chunk_pixels: int = setting(131_072, "pixels drawn at a time; lower it if memory runs out")


@dataclass
class DownloadConfig:
    """`python -m viinter.download`."""

    scene: SceneConfig = setting(SceneConfig(), "which scene")
    paths: Paths = setting(Paths(), "folders")


MODELS = {"paper": PaperModel, "fast": FastModel}

REPOSITORY = Path(__file__).resolve().parents[1]
# for conf/scene/demo.yaml, and for conf/train.yaml's folder of a sweep
OmegaConf.register_new_resolver("repository", lambda: str(REPOSITORY), replace=True)
OmegaConf.register_new_resolver("either", lambda first, otherwise: first or otherwise, replace=True)


def norm_order(p: str | float) -> float | None:
    """The order p of the codes' norm as a number: None for no projection, `math.inf`, or p >= 1.

    Raises ConfigError for anything else; for p < 1 the "norm" is none (its ball is not convex, so that mixes of codes
    would leave it outwards).
    """
    text = str(p).strip().lower()
    if text in ("none", "null"):
        return None
    try:
        order = float(text)
    except ValueError:
        order = math.nan
    if not order >= 1:
        raise ConfigError(f"codes.p={p}: expected none, inf or a number >= 1")
    return order


def check(cfg: TrainConfig) -> None:
    """Holds the settings against their ranges and against each other; raises ConfigError with the key to change."""
    norm_order(cfg.codes.p)

    def want(ok: bool, key: str, value: object, expected: str) -> None:
        if not ok:
            raise ConfigError(f"{key}={value}: expected {expected}")

    positive = {
        "model.code_dim": cfg.model.code_dim, "codes.radius": cfg.codes.radius, "optim.lr": cfg.optim.lr,
        "optim.batch_pixels": cfg.optim.batch_pixels, "interpolation.every": cfg.interpolation.every,
        "interpolation.chunk_pixels": cfg.interpolation.chunk_pixels, "scene.downsample": cfg.scene.downsample,
        "scene.max_views": cfg.scene.max_views, "evaluation.first_seconds": cfg.evaluation.first_seconds,
        "evaluation.chunk_pixels": cfg.evaluation.chunk_pixels, "logging.every_seconds": cfg.logging.every_seconds,
        "checkpoint.every_seconds": cfg.checkpoint.every_seconds,
    }  # fmt: skip
    for key in ("width", "depth", "first_omega", "hidden_omega", "margin", "texture_pixels", "sharpness"):
        if hasattr(cfg.model, key):
            positive[f"model.{key}"] = getattr(cfg.model, key)
    for key, value in positive.items():
        want(value > 0 and math.isfinite(value), key, value, "a number above 0")
    if isinstance(cfg.model, FastModel):
        want(cfg.model.motion in (1, 3, 6), "model.motion", cfg.model.motion, "1, 3 or 6")
        for key in ("entropy", "smooth", "consistency"):
            value = getattr(cfg.model, key)
            want(value >= 0, f"model.{key}", value, "0 or more")
        for key in ("layers", "sets"):
            value = getattr(cfg.model, key)
            want(value is None or value > 0, f"model.{key}", value, "a number above 0, or null")
        window = cfg.model.window
        want(window is None or window >= 2, "model.window", window, "2 or more, or null")
        want(cfg.trainer.precision not in ("16-true", "bf16-true"), "trainer.precision", cfg.trainer.precision,
             "32-true, 64-true or a mixed one with model=fast: its motions are finer than 16 bits")  # fmt: skip
    want(cfg.interpolation.alpha >= 0, "interpolation.alpha", cfg.interpolation.alpha, "0 or more")
    want(0 < cfg.optim.lr_decay <= 1, "optim.lr_decay", cfg.optim.lr_decay, "above 0, at most 1")
    want(0 <= cfg.optim.beta2 < 1, "optim.beta2", cfg.optim.beta2, "0 or more, below 1")
    want(cfg.evaluation.factor > 1, "evaluation.factor", cfg.evaluation.factor, "above 1")
    want(cfg.evaluation.max_share >= 0, "evaluation.max_share", cfg.evaluation.max_share, "0 or more")
    want(cfg.logging.frames >= 2, "logging.frames", cfg.logging.frames, "2 or more")
    for key, value in {"scene.max_pixels": cfg.scene.max_pixels, "codes.length": cfg.codes.length}.items():
        want(value is None or (value > 0 and math.isfinite(value)), key, value, "a number above 0, or null")
    want(cfg.threads is None or cfg.threads > 0, "threads", cfg.threads, "a number above 0, or null")
    if cfg.optim.training_seconds is None:
        want(cfg.optim.steps > 0, "optim.steps", cfg.optim.steps, "a number above 0")
    else:
        seconds = cfg.optim.training_seconds
        want(seconds > 0 and math.isfinite(seconds), "optim.training_seconds", seconds, "a number above 0")
    background = cfg.scene.background
    want(len(background) == 3 and all(0 <= b <= 1 for b in background), "scene.background", background,
         "three numbers in [0,1]")  # fmt: skip
    if cfg.scene.crop is not None:
        c = cfg.scene.crop
        want(len(c) == 4 and 0 <= c[0] < c[2] and 0 <= c[1] < c[3], "scene.crop", c, "[x0,y0,x1,y1], x0<x1, y0<y1")
    if cfg.scene.endpoints is not None:
        want(len(cfg.scene.endpoints) == 2, "scene.endpoints", cfg.scene.endpoints, "two known views [i,j]")


def several(devices: Any) -> bool:
    """Whether `trainer.devices` may be more than one."""
    return str(devices) != "1" and not (isinstance(devices, list | ListConfig) and len(devices) == 1)


def typed(cfg: DictConfig, schema: type) -> Any:
    """Turns a composed configuration into objects of `schema`'s dataclasses; a missing value raises ConfigError."""
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        raise ConfigError(f"no value for {', '.join(missing)}: give it on the command line as {missing[0]}=VALUE")
    made = OmegaConf.to_object(cfg)
    if not isinstance(made, schema):
        raise ConfigError(f"expected a {schema.__name__}, got {type(made).__name__}")
    return made


def plain(cfg: Any) -> dict[str, Any]:
    """A config object as nested plain Python values (strings, numbers, lists), safe to store in a checkpoint."""

    def simple(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {f.name: simple(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if isinstance(value, Enum):
            return value.value
        if isinstance(value, list | tuple | ListConfig):
            return [simple(v) for v in value]
        return value

    return simple(cfg)


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested plain settings as one level: {"optim.lr": 1e-5, ...}."""
    found = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found


def from_plain(values: dict[str, Any] | DictConfig, overrides: list[str] = ()) -> TrainConfig:
    """The TrainConfig of a finished run, from `plain` values or its `.hydra/config.yaml`, with `a.b=c` overrides."""
    try:
        values = OmegaConf.create(values)
        name = values.get("model", {}).get("name")
        if name not in MODELS:
            raise ConfigError(f"model.name={name}: expected one of {', '.join(sorted(MODELS))}")
        schema = OmegaConf.structured(TrainConfig(model=MODELS[name]()))
        return typed(OmegaConf.merge(schema, values, OmegaConf.from_dotlist(list(overrides))), TrainConfig)
    except UserError:
        raise
    except Exception as error:  # omegaconf's own message names the key and the type, or the broken ${...}
        raise ConfigError(str(error)) from error


def read_run(run: str | Path, overrides: list[str] = ()) -> TrainConfig:
    """The configuration of the run folder `run`; raises ConfigError if it is none."""
    file = Path(run) / ".hydra" / "config.yaml"
    if not file.is_file():
        raise ConfigError(f"{run} is no run folder: there is no {file}")
    return from_plain(OmegaConf.load(file), overrides)


def describe(schema: Any, prefix: str = "") -> list[tuple[str, str, str]]:
    """Rows (key, default, help) of every setting of a dataclass, depth first; for `--help` and the documentation."""
    rows = []
    for f in dataclasses.fields(schema):
        value = getattr(schema, f.name)
        if dataclasses.is_dataclass(value):
            rows += describe(value, f"{prefix}{f.name}.")
        else:
            shown = "required" if value == MISSING else plain(value)
            rows.append((prefix + f.name, "null" if shown is None else str(shown), f.metadata.get("help", "")))
    return rows
