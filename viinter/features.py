"""Frozen feature towers and the interpolation loss (paper Section 3.4; supplement, CLIP-based features).

Notation: `B` images or `n` views of `H x W` pixels, rgb in [0, 1]; `K` patches of 224 x 224 an image, in
reading order; `D` features a patch; `E(I)` [K*D] the features of an image I: those of its patches, one after
another. An image is first *reduced* to a short side of 256 to 511 pixels, then *cut* into patches, and each
patch is embedded. `t` in [0, 1] is the weight of view j in a mix of the views i and j.

A tower is chosen by name in `TOWERS`; a new one is a function `FeaturesConfig -> FeatureTower` put into that
dict. open_clip and torchvision are imported inside the builders, so that a run with alpha = 0 needs neither.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import importlib
import pickle
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from viinter.config import FeaturesConfig, Patches, UserError

PATCH = 224  # pixels a side
REDUCED = 256  # pixels; the short side is divided by the whole number of times that this goes into it
VGG_GRID = 28  # cells a side that VGG16's activations are averaged to


def frame_size(height: int, width: int) -> tuple[int, int]:
    """The (height, width) in pixels to which an image of `height x width` is reduced before it is cut.

    Interpolated frames are to be drawn at this size. As published, both sides are divided by the whole number
    of times that 256 goes into the shorter one, which brings that one to 256 to 511; images with a side under
    256 stay as they are. The frame size of a frame size is itself: `reduce` leaves a frame so drawn alone.

    As published, a frame drawn on the reduced grid shows the field at the first pixel of each block, while a
    known view is averaged over its blocks: the two are (ratio - 1) / 2 pixels of the full image apart.
    """
    ratio = max(1, min(height, width) // REDUCED)
    return height // ratio, width // ratio


def reduce(images: Tensor) -> Tensor:
    """Images [B,3,H,W] brought to `frame_size(H, W)` by antialiased bilinear interpolation."""
    return _resize(images, frame_size(*images.shape[-2:]))


def cut(images: Tensor, patches: Patches) -> Tensor:
    """Patches [B*K,3,224,224] of reduced images [B,3,H,W], image by image, each in reading order.

    `paper`: stride 224 from the top left corner; what is left over at the right and at the bottom is dropped
    (supplement, Training with CLIP-based Features). `cover`: ceil(side / 224) positions a side, spread evenly
    and overlapping, so that each pixel is in some patch; an image with a side under 224 is first enlarged as
    a whole until its short side is 224.

    Raises UserError if `paper` finds no whole patch in the image.
    """
    height, width = images.shape[-2:]
    if min(height, width) < PATCH:
        if patches is Patches.paper:
            raise UserError(
                f"features.patches=paper: images of {height}x{width} pixels hold no whole patch of 224x224; "
                "set features.patches=cover, which enlarges them, or interpolation.alpha=0"
            )
        grow = PATCH / min(height, width)
        height, width = max(PATCH, round(height * grow)), max(PATCH, round(width * grow))
        images = _resize(images, (height, width))
    tops, lefts = _starts(height, patches), _starts(width, patches)
    pieces = [images[..., y : y + PATCH, x : x + PATCH] for y in tops for x in lefts]
    return torch.stack(pieces, dim=1).flatten(0, 1)


def _starts(side: int, patches: Patches) -> Sequence[int]:
    """Where the patches begin along a side of `side >= 224` pixels."""
    if patches is Patches.paper:
        return range(0, side - PATCH + 1, PATCH)
    count = -(-side // PATCH)
    # the exact distance of two neighbours is at most 224, and rounding down cannot take it above that
    return [(side - PATCH) * k // max(1, count - 1) for k in range(count)]


def _resize(images: Tensor, size: tuple[int, int]) -> Tensor:
    if images.shape[-2:] == size:
        return images
    # antialiasing does nothing for enlarging, and its gradient has no deterministic form on CUDA
    smaller = size[0] < images.shape[-2]
    return F.interpolate(images, size, mode="bilinear", align_corners=False, antialias=smaller)


class FeatureTower:
    """A frozen network E that turns images into features; differentiable with respect to the images.

    It wraps an `nn.Module` but is none: a LightningModule or a callback can hold it without its weights
    getting into `state_dict`, the optimiser, `train()` or a checkpoint.

    Args:
        name: what the tower is, for the log: extractor and architecture.
        module: maps normalised patches [P,3,size,size] to features [P,D]; is put into eval mode and frozen.
        patches: how images are cut.
        mean, std: of the rgb channels, in [0, 1], that the network was trained with.
        size: pixels a side that `module` wants; the patches of 224 are resized to it.

    Attributes: `name`; `dim`, which is D, found by embedding one patch; `megabytes` of weights, in 2**20
    bytes; `seconds_to_load`, wall seconds, set by `load`.
    """

    def __init__(
        self,
        name: str,
        module: nn.Module,
        patches: Patches,
        mean: Sequence[float],
        std: Sequence[float],
        size: int = PATCH,
    ):
        self.name, self.patches, self.size, self.seconds_to_load = name, patches, size, 0.0
        self.module = module.eval().requires_grad_(False).float()
        self.mean = torch.tensor(mean, dtype=torch.float32).view(3, 1, 1)
        self.std = torch.tensor(std, dtype=torch.float32).view(3, 1, 1)
        held = [*module.parameters(), *module.buffers()]
        self.megabytes = sum(w.numel() * w.element_size() for w in held) / 2**20
        with torch.no_grad():
            self.dim = module(torch.zeros(1, 3, size, size)).shape[1]

    def to(self, device: torch.device | str) -> FeatureTower:
        """Moves the tower to `device`; returns itself."""
        self.module.to(device)
        self.mean, self.std = self.mean.to(device), self.std.to(device)
        return self

    def __call__(self, images: Tensor) -> Tensor:
        """Features [B, K*D] float32 of images [B,3,H,W], in [0, 1], on the tower's device.

        Values a little outside [0, 1], as an unfinished field gives, are let through as published: clamping
        would take their gradient away. Raises UserError as `cut` does.
        """
        pieces = _resize(cut(reduce(images.float()), self.patches), (self.size, self.size))
        features = self.module((pieces - self.mean) / self.std)
        return features.float().reshape(len(images), -1)


def interpolation_loss(features: Tensor, fi: Tensor, fj: Tensor, t: float | Tensor) -> Tensor:
    """L_inter, a scalar >= 0: mean squared distance of a frame's features [K*D] to (1 - t) fi + t fj.

    The paper (Section 3.4) writes the squared norm, the sum over all features; its published code takes the
    mean, and its values of alpha belong to that. With the sum, alpha would have to be divided by K*D.
    """
    return (features - ((1 - t) * fi + t * fj)).square().mean()


def embed_views(tower: FeatureTower, views: Tensor, chunk: int = 1) -> Tensor:
    """E(I) [n, K*D] float32 of the views [n,H,W,3] in [0, 1], without gradients, on the tower's device.

    `chunk` views are embedded at a time, which bounds the memory; the views themselves may stay on the CPU.
    Raises UserError as `cut` does.
    """
    device = tower.mean.device
    with torch.no_grad():
        return torch.cat([tower(part.to(device).permute(0, 3, 1, 2)) for part in views.split(chunk)])


def clip_tower(cfg: FeaturesConfig) -> FeatureTower:
    """The image half of a CLIP network from open_clip; its embedding is not normalised, as published.

    `features.weights` is a file with the state_dict of the whole network or of its image half (.safetensors,
    or `torch.save`), or the name of published weights, which are downloaded once. The text half's weights
    are left in the file.

    Raises UserError for an unknown architecture, absent or foreign weights, a failed download, and weights
    trained with QuickGELU (OpenAI's) in an architecture without it.
    """
    weights = _given(cfg, "openai")
    open_clip = _imported("open_clip")
    models = open_clip.list_models()
    if cfg.model not in models:
        near = ", ".join(difflib.get_close_matches(cfg.model, models, 4, 0.4)) or "none"
        raise UserError(
            f"features.model={cfg.model}: open_clip has no such architecture; nearest: {near}; all of them: "
            "open_clip.list_models()"
        )
    architecture = open_clip.get_model_config(cfg.model)
    quick = architecture.get("quick_gelu", False)
    published = open_clip.get_pretrained_cfg(cfg.model, weights)
    if Path(weights).is_file():
        file, statistics = Path(weights), _statistics(open_clip, cfg.model)
    elif published:
        _want_quick_gelu(cfg, published.get("quick_gelu", False), quick)
        file, statistics = _download(cfg, published["hf_hub"]), (published["mean"], published["std"])
    else:
        tags = ", ".join(open_clip.list_pretrained_tags_by_model(cfg.model)) or "none"
        raise _absent(cfg, f"the published weights of {cfg.model} are: {tags}")
    state = _read(file)
    # OpenAI's own files are known by these three numbers among the weights
    _want_quick_gelu(cfg, {"input_resolution", "context_length", "vocab_size"} <= state.keys(), quick)

    visual = open_clip.CLIP(
        embed_dim=architecture["embed_dim"],
        vision_cfg={**architecture["vision_cfg"], "timm_model_pretrained": False},
        # thrown away at once, so it is made as small as it gets
        text_cfg={"context_length": 1, "vocab_size": 1, "width": 8, "heads": 1, "layers": 1},
        quick_gelu=quick,
    ).visual
    half = {key.removeprefix("visual."): w for key, w in state.items() if key.startswith("visual.")}
    _fill(visual, half or state, file, f"open_clip's {cfg.model}, or of its image half")
    size = visual.image_size if isinstance(visual.image_size, int) else visual.image_size[0]
    return FeatureTower(f"clip {cfg.model}", _FirstOutput(visual), cfg.patches, *statistics, size)


class _FirstOutput(nn.Module):
    """Some of open_clip's image halves (CoCa) return their tokens beside the embedding."""

    def __init__(self, visual: nn.Module):
        super().__init__()
        self.visual = visual

    def forward(self, patches: Tensor) -> Tensor:
        out = self.visual(patches)
        return out[0] if isinstance(out, tuple) else out


def _statistics(open_clip: ModuleType, model: str) -> tuple[Sequence[float], Sequence[float]]:
    """Mean and std of rgb for a file, which does not say: those of the architecture's published weights where
    they agree, else OpenAI's, which most CLIP networks use."""
    tags = open_clip.list_pretrained_tags_by_model(model)
    published = [open_clip.get_pretrained_cfg(model, tag) for tag in tags]
    found = {(tuple(p["mean"]), tuple(p["std"])) for p in published}
    return found.pop() if len(found) == 1 else (open_clip.OPENAI_DATASET_MEAN, open_clip.OPENAI_DATASET_STD)


def _want_quick_gelu(cfg: FeaturesConfig, wanted: bool, has: bool) -> None:
    """The same weights fit both GELUs, so nothing else would tell that the embeddings are wrong."""
    if wanted and not has:
        raise UserError(
            f"features.model={cfg.model}: the weights {cfg.weights} were trained with QuickGELU, which this "
            f"architecture lacks; set features.model={cfg.model}-quickgelu"
        )


def _download(cfg: FeaturesConfig, address: str) -> Path:
    """The file of published weights at `address`, OWNER/NAME/ or OWNER/NAME/FILE on the Hugging Face hub.

    What is in the local cache needs no network. Otherwise one question first tells whether a download can
    work at all, without the minute of retries that the hub's client would take over it.
    """
    hub, errors = _imported("huggingface_hub"), _imported("huggingface_hub.errors")
    repo, _, name = address.rpartition("/")
    name = name or "open_clip_pytorch_model.bin"
    names = [name.replace("open_clip_pytorch_", "open_clip_").replace(".bin", ".safetensors"), name]
    for name in names:
        with contextlib.suppress(errors.LocalEntryNotFoundError):
            return Path(hub.hf_hub_download(repo, name, local_files_only=True))
    try:
        for name in names:
            try:
                hub.get_hf_file_metadata(hub.hf_hub_url(repo, name), timeout=5)
            except errors.EntryNotFoundError:
                continue
            return Path(hub.hf_hub_download(repo, name))
        raise FileNotFoundError(f"{repo} has neither of its usual files")
    except Exception as error:  # the client's errors have no base class that holds across its versions
        raise UserError(
            f"features.weights={cfg.weights}: the download failed ({_brief(error)}). Where there is a "
            f"connection, fetch {' or '.join(names)} from https://huggingface.co/{repo}; then set "
            "features.weights=FILE"
        ) from error


class _VGGBlocks(nn.Module):
    """Four blocks of VGG16: patches [P,3,224,224] to their averaged, weighted activations [P, 960*28*28]."""

    ends = (4, 9, 16, 23)  # in torchvision's `features`: after relu1_2, relu2_2, relu3_3, relu4_3
    channels = (64, 128, 256, 512)

    def __init__(self, layers: nn.Sequential):
        super().__init__()
        self.layers = layers

    def forward(self, patches: Tensor) -> Tensor:
        x, begin, found = patches, 0, []
        for end, channels in zip(self.ends, self.channels, strict=True):
            x = self.layers[begin:end](x)
            weight = (sum(self.channels) / channels) ** 0.5
            found.append(F.avg_pool2d(x, x.shape[-1] // VGG_GRID).flatten(1) * weight)
            begin = end
        return torch.cat(found, dim=1)


def vgg16_tower(cfg: FeaturesConfig) -> FeatureTower:
    """VGG16 from torchvision: the perceptual features that the paper sets CLIP against (Section 3.4).

    The implementation that the supplement names compares relu1_2, relu2_2, relu3_3 and relu4_3: 6.0 million
    numbers or 24 MB a patch, too much to keep for all known views. Here each block is averaged to relu4_3's
    grid of 28 x 28: 752,640 numbers, 3 MB. That leaves relu4_3 whole and takes fine detail from the earlier
    blocks. The blocks are weighted so that the mean square over all features is the sum of the four blocks'
    own mean squares, as in that implementation, and not dominated by the block with most channels.

    `features.weights` is a file with the state_dict of torchvision's vgg16, or `imagenet`, which is
    downloaded once; `features.model` plays no part. Raises UserError for absent or foreign weights or a
    failed download.
    """
    weights = _given(cfg, "imagenet")
    torchvision = _imported("torchvision")
    if Path(weights).is_file():
        state = _read(Path(weights))
    elif weights == "imagenet":
        published = torchvision.models.VGG16_Weights.IMAGENET1K_V1
        try:
            state = published.get_state_dict(progress=False, check_hash=True, weights_only=True)
        except (OSError, RuntimeError) as error:
            raise UserError(
                f"features.weights=imagenet: the download failed ({_brief(error)}). Where there is a "
                f"connection, fetch {published.url}; then set features.weights=FILE"
            ) from error
    else:
        raise _absent(cfg, "the published weights of vgg16 are: imagenet")
    with torch.device("meta"):  # its unused classifier alone would be 470 MB
        network = torchvision.models.vgg16(weights=None, init_weights=False)
    layers = network.features[: _VGGBlocks.ends[-1]].to_empty(device="cpu")
    wanted = layers.state_dict().keys()  # without the last block and the classifier
    state = {key.removeprefix("features."): w for key, w in state.items()}
    _fill(layers, {k: w for k, w in state.items() if k in wanted}, Path(weights), "torchvision's vgg16")
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet
    return FeatureTower("vgg16", _VGGBlocks(layers), cfg.patches, mean, std)


TOWERS: dict[str, Callable[[FeaturesConfig], FeatureTower]] = {"clip": clip_tower, "vgg16": vgg16_tower}


def load(cfg: FeaturesConfig, device: torch.device | str) -> FeatureTower:
    """The tower that `cfg` asks for, on `device`. Raises UserError for an unknown name, or as its builder."""
    if cfg.extractor not in TOWERS:
        raise UserError(f"features.extractor={cfg.extractor}: expected one of {', '.join(sorted(TOWERS))}")
    began = time.perf_counter()
    tower = TOWERS[cfg.extractor](cfg).to(device)
    tower.seconds_to_load = time.perf_counter() - began
    return tower


def _imported(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UserError(
            f'interpolation.alpha > 0 needs the package {name}: pip install "viinter[features]" ({error})'
        ) from error


def _given(cfg: FeaturesConfig, published: str) -> str:
    if not cfg.weights:
        raise UserError(
            "features.weights=null: interpolation.alpha > 0 needs features.weights, the path of a file or "
            f"{published}; the features of an untrained network would mean nothing"
        )
    return cfg.weights


def _absent(cfg: FeaturesConfig, published: str) -> UserError:
    return UserError(
        f"features.weights={cfg.weights}: there is no file {Path(cfg.weights).absolute()}, and {published}. "
        "Give the path of a file or one of these names, or set interpolation.alpha=0"
    )


def _read(file: Path) -> dict[str, Tensor]:
    """The state_dict in `file`, without running code that it may hold. Raises UserError if it is none."""
    read = functools.partial(torch.load, map_location="cpu", weights_only=True)
    if file.suffix == ".safetensors":
        read = _imported("safetensors.torch").load_file
    try:
        state = read(file)
    except Exception as error:  # pickle's, zip's, safetensors' and the system's have no common base class
        hint = ""
        if "TorchScript" in str(error):
            hint = (
                ". It is an archive with code, as OpenAI gives its weights out; if you trust it, take the "
                "weights out once: torch.save(torch.jit.load(FILE, 'cpu').state_dict(), NEW_FILE)"
            )
        raise _unfit(file, _brief(error) + hint) from error
    if isinstance(state, dict) and isinstance(state.get("state_dict"), dict):
        state = state["state_dict"]
    if not isinstance(state, dict) or not all(isinstance(w, Tensor) for w in state.values()):
        raise _unfit(file, "it holds something other than a state_dict")
    return {str(key).removeprefix("module."): w for key, w in state.items()}


def _fill(module: nn.Module, state: dict[str, Tensor], file: Path, what: str) -> None:
    """Copies `state` into `module`; raises UserError unless names and shapes agree one to one."""
    mine = module.state_dict()
    both = [key for key in mine if key in state]
    shapes = [(key, tuple(state[key].shape), tuple(mine[key].shape)) for key in both]
    differences = {
        "missing": [key for key in mine if key not in state],
        "of another shape": [f"{key} {has}, not {want}" for key, has, want in shapes if has != want],
        "too many": [key for key in state if key not in mine],
    }
    found = [f"{len(keys)} {word} ({', '.join(keys[:3])})" for word, keys in differences.items() if keys]
    if found:
        raise _unfit(file, f"of its weights are {'; '.join(found)}; expected the state_dict of {what}")
    module.load_state_dict(state)


def _unfit(file: Path, why: str) -> UserError:
    return UserError(f"features.weights: cannot use {file}: {why}")


def _brief(error: Exception) -> str:
    if isinstance(error, pickle.UnpicklingError):  # PyTorch's own words advise to run what the file holds
        return "it holds something other than tensors, or is no file of weights"
    first = (str(error).strip() or "no further word").splitlines()[0]
    return f"{type(error).__name__}: {first[:200]}"
