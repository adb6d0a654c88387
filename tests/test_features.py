import json
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from viinter import features
from viinter.config import FeaturesConfig, Patches, UserError
from viinter.features import FeatureTower, cut, embed_views, frame_size, interpolation_loss, reduce

DATA = Path(__file__).parents[2] / "shared" / "data"
sides = st.integers(100, 700)


def config(weights=None, **changes) -> FeaturesConfig:
    return FeaturesConfig(**{"model": "tiny-quickgelu", "weights": weights and str(weights), **changes})


@pytest.fixture(scope="session")
def open_clip(tmp_path_factory):
    """open_clip, with small architectures added to its list."""
    open_clip = pytest.importorskip("open_clip")
    vision = {"image_size": 224, "layers": 2, "width": 64, "patch_size": 32}
    text = {"context_length": 8, "vocab_size": 16, "width": 32, "heads": 1, "layers": 1}
    variants = {
        "tiny-quickgelu": ({}, True),
        "tiny": ({}, False),
        "tiny-deep": ({"layers": 3}, True),
        "tiny-64": ({"image_size": 64, "patch_size": 16}, True),
        "tiny-tokens": ({"output_tokens": True}, True),
    }
    folder = tmp_path_factory.mktemp("architectures")
    for name, (changes, quick) in variants.items():
        layout = {"embed_dim": 32, "quick_gelu": quick, "vision_cfg": {**vision, **changes}, "text_cfg": text}
        (folder / f"{name}.json").write_text(json.dumps(layout))
    open_clip.add_model_config(folder)
    return open_clip


def network(open_clip, model):
    torch.manual_seed(0)
    return open_clip.CLIP(**open_clip.get_model_config(model)).eval()


@pytest.fixture(scope="session")
def tiny(open_clip):
    return network(open_clip, "tiny-quickgelu")


@pytest.fixture
def tiny_file(tiny, tmp_path):
    torch.save(tiny.state_dict(), tmp_path / "tiny.pt")
    return tmp_path / "tiny.pt"


# ---- frame size, patches


@pytest.mark.parametrize(
    ("full", "reduced"),
    [((756, 1008), (378, 504)), ((512, 641), (256, 320)), ((511, 900), (511, 900)), ((200, 900), (200, 900)),
     ((1024, 1024), (256, 256)), ((1512, 2017), (302, 403))],
)  # fmt: skip
def test_frame_size(full, reduced):
    assert frame_size(*full) == reduced
    assert reduce(torch.rand(1, 3, *full)).shape[-2:] == reduced


@given(st.integers(256, 9000), st.integers(256, 9000))
@settings(deadline=None)
def test_frame_size_is_its_own_and_near_256(height, width):
    small = frame_size(height, width)
    assert 256 <= min(small) < 512
    assert frame_size(*small) == small


def test_reduce_averages_and_leaves_reduced_images_alone():
    rows = torch.arange(1024.0)[:, None].expand(1, 3, 1024, 1024)
    centres = torch.arange(256.0) * 4 + 1.5
    assert torch.allclose(reduce(rows)[0, 0, 2:-2, 7], centres[2:-2], atol=1e-3)
    small = torch.rand(1, 3, 300, 400)
    assert reduce(small) is small


def test_paper_patches_are_those_of_the_published_unfold():
    images = torch.rand(2, 3, 500, 700)
    cuts = cut(images, Patches.paper).reshape(2, 6, 3, 224, 224)
    for image, mine in zip(images, cuts, strict=True):
        columns = F.unfold(image[None], kernel_size=(224, 224), stride=224)
        theirs = columns.reshape(3, 224, 224, -1).permute(3, 0, 1, 2)
        assert torch.equal(mine, theirs)


def test_paper_drops_exactly_the_remainders():
    images = torch.rand(1, 3, 447, 460, requires_grad=True)
    cut(images, Patches.paper).sum().backward()
    assert torch.equal(images.grad[..., :224, :448], torch.ones(1, 3, 224, 448))
    assert images.grad.sum() == 3 * 224 * 448


@pytest.mark.parametrize(
    ("height", "width", "paper", "cover"),
    [(224, 224, 1, 1), (256, 256, 1, 4), (378, 504, 2, 6), (448, 448, 4, 4), (449, 448, 4, 6)],
)
def test_number_of_patches(height, width, paper, cover):
    images = torch.zeros(2, 3, height, width)
    assert len(cut(images, Patches.paper)) == 2 * paper
    assert len(cut(images, Patches.cover)) == 2 * cover


def test_paper_refuses_an_image_smaller_than_a_patch():
    with pytest.raises(UserError, match=r"200x300.*features\.patches=cover"):
        cut(torch.zeros(1, 3, 200, 300), Patches.paper)
    assert cut(torch.zeros(1, 3, 200, 300), Patches.cover).shape == (2, 3, 224, 224)


@given(sides, sides)
@example(224, 448)
@example(225, 449)
@example(512, 513)
@settings(max_examples=20, deadline=None)
def test_cover_reaches_every_pixel(height, width):
    images = torch.rand(1, 1, height, width, requires_grad=True)
    cuts = cut(reduce(images), Patches.cover)
    assert cuts.shape[1:] == (1, 224, 224)
    cuts.sum().backward()
    assert images.grad.min() > 0


# ---- the tower


class Average(torch.nn.Module):
    """Two features a patch: its mean red, and the mean of its left half's green."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))
        self.dropout = torch.nn.Dropout(0.5)

    def forward(self, patches):
        left = patches[:, 1, :, : patches.shape[-1] // 2]
        return self.dropout(self.weight * torch.stack([patches[:, 0].mean((1, 2)), left.mean((1, 2))], dim=1))


def average(patches=Patches.paper) -> FeatureTower:
    return FeatureTower("average", Average(), patches, (0.5, 0.25, 0.0), (0.5, 0.25, 1.0))


def test_tower_normalises_and_concatenates_patches_in_order():
    images = torch.zeros(2, 3, 224, 448)
    images[0, 0, :, 224:] = 1
    images[1, 1, :, :112] = 0.5
    found = average()(images)
    assert torch.allclose(found, torch.tensor([[-1.0, -1, 1, -1], [-1, 1, -1, -1]]), atol=1e-6)
    assert average().dim == 2
    assert average().megabytes == pytest.approx(4 / 2**20)


def test_gradient_reaches_images_and_not_weights():
    tower, images = average(Patches.cover), torch.rand(1, 3, 600, 300, requires_grad=True)
    tower(images).sum().backward()
    assert (images.grad[:, 0] > 0).all()
    assert [w.grad for w in tower.module.parameters()] == [None]


def test_features_are_float32_whatever_the_images_are():
    for dtype in (torch.float64, torch.bfloat16):
        assert average()(torch.rand(1, 3, 224, 224, dtype=dtype)).dtype == torch.float32


def test_tower_stays_out_of_a_module_that_holds_it():
    class Holder(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.tower = average()

    holder = Holder().train()
    assert holder.state_dict() == {}
    assert list(holder.parameters()) == []
    assert not holder.tower.module.training


def test_interpolation_loss_is_the_mean_square_to_the_mix():
    fi, fj = torch.tensor([0.0, 4.0]), torch.tensor([4.0, 0.0])
    assert interpolation_loss(torch.tensor([1.0, 3.0]), fi, fj, 0.25) == 0
    assert interpolation_loss(torch.tensor([3.0, 3.0]), fi, fj, torch.tensor(0.25)) == 2
    assert interpolation_loss(fj, fi, fj, 1.0) == 0


def test_embed_views_equals_single_calls_for_any_chunk():
    views = torch.rand(5, 230, 470, 3)
    tower = average()
    single = torch.cat([tower(view.permute(2, 0, 1)[None]) for view in views])
    for chunk in (1, 2, 8):
        found = embed_views(tower, views, chunk)
        assert found.shape == (5, 2 * tower.dim)
        assert torch.allclose(found, single, atol=1e-6)
    assert not embed_views(tower, views.requires_grad_(), 2).requires_grad


def test_a_tower_of_ones_own_and_an_unknown_one(monkeypatch):
    monkeypatch.setitem(features.TOWERS, "average", lambda cfg: average(cfg.patches))
    tower = features.load(config(extractor="average", patches=Patches.cover), "cpu")
    assert (tower.name, tower.patches) == ("average", Patches.cover)
    assert 0 < tower.seconds_to_load < 5
    with pytest.raises(UserError, match=r"features\.extractor=resnet.*average, clip, vgg16"):
        features.load(config(extractor="resnet"), "cpu")


# ---- CLIP


def test_clip_is_open_clips_encode_image(open_clip, tiny, tiny_file):
    tower = features.load(config(tiny_file), "cpu")
    image = torch.rand(1, 3, 224, 448)
    normalise = open_clip.image_transform(224, is_train=False).transforms[-1]
    with torch.no_grad():
        left, right = (tiny.encode_image(normalise(half)) for half in image.split(224, dim=-1))
    assert torch.allclose(tower(image), torch.cat([left, right], dim=1), atol=1e-5)
    assert tower.dim == 32
    assert tower.name == "clip tiny-quickgelu"
    assert tower.megabytes == pytest.approx(sum(w.numel() for w in tiny.visual.parameters()) * 4 / 2**20)
    image.requires_grad_()
    tower(image).square().sum().backward()
    assert image.grad.abs().amax(1).min() > 0


@pytest.mark.parametrize("kind", ["image half", "lightning", "parallel", "half precision", "safetensors"])
def test_clip_files_of_every_kind(tiny, tiny_file, tmp_path, kind):
    full, file = tiny.state_dict(), tmp_path / "weights.pt"
    if kind == "safetensors":
        file = tmp_path / "weights.safetensors"
        pytest.importorskip("safetensors.torch").save_file(full, file)
    else:
        half = {k: w.half() for k, w in full.items()}
        parallel = {f"module.{k}": w for k, w in full.items()}
        kinds = {"image half": tiny.visual.state_dict(), "lightning": {"state_dict": full, "epoch": 3}}
        torch.save({**kinds, "parallel": parallel, "half precision": half}[kind], file)
    image = torch.rand(1, 3, 224, 224)
    expected = features.clip_tower(config(tiny_file))(image)
    found = features.clip_tower(config(file))(image)
    assert torch.allclose(found, expected, atol=0.02 if kind == "half precision" else 0)


@pytest.mark.parametrize("model", ["tiny-64", "tiny-tokens"])
def test_clip_architectures_of_other_sizes_and_outputs(open_clip, tmp_path, model):
    torch.save(network(open_clip, model).state_dict(), tmp_path / "w.pt")
    tower = features.load(config(tmp_path / "w.pt", model=model, patches=Patches.cover), "cpu")
    assert tower(torch.rand(2, 3, 256, 300)).shape == (2, 4 * 32)


def test_clip_refuses_openai_weights_without_quick_gelu(open_clip, tiny, tmp_path):
    with pytest.raises(UserError, match=r"features\.model=ViT-B-32-quickgelu"):
        features.clip_tower(config("openai", model="ViT-B-32"))
    numbers = {k: torch.tensor(1) for k in ("input_resolution", "context_length", "vocab_size")}
    torch.save({**tiny.state_dict(), **numbers}, tmp_path / "openai.pt")
    with pytest.raises(UserError, match=r"features\.model=tiny-quickgelu"):
        features.clip_tower(config(tmp_path / "openai.pt", model="tiny"))
    assert features.clip_tower(config(tmp_path / "openai.pt")).dim == 32


def test_clip_without_weights_or_with_absent_ones(open_clip):
    with pytest.raises(UserError, match=r"features\.weights=null.*a file or openai"):
        features.clip_tower(config())
    with pytest.raises(UserError, match=r"there is no file .*/no/such\.pt.*published weights.*none"):
        features.clip_tower(config("no/such.pt"))
    with pytest.raises(UserError, match=r"features\.weights=opnai.*openai, laion"):
        features.clip_tower(config("opnai", model="ViT-L-14"))
    with pytest.raises(UserError, match=r"features\.model=ViT-B32.*ViT-B-32"):
        features.clip_tower(config("openai", model="ViT-B32"))


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("other network", r"32 missing \(class_embedding.*1 too many \(weight\).*tiny-quickgelu, or of"),
        ("deeper", r"12 too many \(transformer\.resblocks\.2\."),
        ("wider", r"1 of another shape \(proj \(64, 16\), not \(64, 32\)\)"),
        ("text", "something other than tensors"),
        ("code", "something other than tensors"),
        ("list", "something other than a state_dict"),
        ("safetensors", "SafetensorError"),
    ],
)
def test_clip_refuses_foreign_files(open_clip, tiny, tmp_path, kind, says):
    file = tmp_path / ("foreign.safetensors" if kind == "safetensors" else "foreign.pt")
    if kind in ("text", "safetensors"):
        file.write_text("no weights at all")
    else:
        state = {
            "other network": {"weight": torch.zeros(3)},
            "deeper": network(open_clip, "tiny-deep").state_dict(),
            "wider": {**tiny.visual.state_dict(), "proj": torch.zeros(64, 16)},
            "code": {"weight": Average()},
            "list": [torch.zeros(3)],
        }
        torch.save(state[kind], file)
    with pytest.raises(UserError, match=f"(?s){re.escape(str(file))}.*{says}"):
        features.clip_tower(config(file))


@pytest.mark.filterwarnings("ignore:.torch.jit", "ignore:.torch.load. received a zip file")
def test_clip_says_how_to_convert_an_archive_with_code(open_clip, tmp_path):
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), tmp_path / "ViT-B-32.pt")
    with pytest.raises(UserError, match=r"torch\.save\(torch\.jit\.load"):
        features.clip_tower(config(tmp_path / "ViT-B-32.pt"))


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """The hub's client with an empty cache and no connection."""
    hub = pytest.importorskip("huggingface_hub")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))

    def unplugged(*args, **kwargs):
        raise ConnectionError("no route to huggingface.co")

    monkeypatch.setattr(hub, "get_hf_file_metadata", unplugged)
    return hub


def test_a_download_that_cannot_work_fails_soon_and_names_the_file(open_clip, hub):
    advice = r"no route.*open_clip_model\.safetensors.*timm/vit_base.*features\.weights=FILE"
    began = time.perf_counter()
    with pytest.raises(UserError, match=advice):
        features.clip_tower(config("openai", model="ViT-B-32-quickgelu"))
    assert time.perf_counter() - began < 5


def test_published_architecture_with_cached_weights_needs_no_network(open_clip, hub, monkeypatch, tmp_path):
    """The real ViT-B/32 at random, its weights laid down as the hub's client would have."""
    architecture = open_clip.get_model_config("ViT-B-32-quickgelu")
    architecture["text_cfg"].update(vocab_size=8, width=64, layers=1)
    whole = open_clip.CLIP(**architecture).eval().half()
    repo = tmp_path / "cache" / "models--timm--vit_base_patch32_clip_224.openai"
    (repo / "snapshots" / "1a").mkdir(parents=True)
    (repo / "refs").mkdir()
    (repo / "refs" / "main").write_text("1a")
    file = repo / "snapshots" / "1a" / "open_clip_model.safetensors"
    pytest.importorskip("safetensors.torch").save_file(whole.state_dict(), file)
    whole.float()
    tower = features.load(config("openai", model="ViT-B-32-quickgelu"), "cpu")
    assert tower.dim == 512
    assert tower.megabytes == pytest.approx(335.1, abs=0.1)
    image = torch.rand(1, 3, 224, 224)
    mean, std = torch.tensor(open_clip.OPENAI_DATASET_MEAN), torch.tensor(open_clip.OPENAI_DATASET_STD)
    expected = whole.encode_image((image - mean[:, None, None]) / std[:, None, None])
    assert torch.allclose(tower(image), expected, atol=1e-5)


# ---- VGG16


@pytest.fixture(scope="session")
def vgg_file(tmp_path_factory):
    """vgg16's convolutions at random, with a stand-in for the classifier that nobody needs."""
    torchvision = pytest.importorskip("torchvision")
    with torch.device("meta"):
        layers = torchvision.models.vgg16(weights=None, init_weights=False).features
    torch.manual_seed(0)
    shapes = {f"features.{key}": w.shape for key, w in layers.state_dict().items()}
    state = {key: torch.randn(shape) * shape[1:].numel() ** -0.5 for key, shape in shapes.items()}
    file = tmp_path_factory.mktemp("vgg") / "vgg16.pth"
    torch.save({**state, "classifier.0.weight": torch.zeros(2, 2)}, file)
    return file


def test_vgg_loss_is_the_sum_of_the_blocks_mean_squares(vgg_file):
    tower = features.load(config(vgg_file, extractor="vgg16"), "cpu")
    assert tower.dim == 960 * 28 * 28
    one, two = torch.rand(2, 1, 3, 224, 224)
    seen = []
    for index in (3, 8, 15, 22):  # relu1_2, relu2_2, relu3_3, relu4_3
        tower.module.layers[index].register_forward_hook(lambda layer, ins, out: seen.append(out.detach()))
    f = tower(one)[0]
    loss = interpolation_loss(tower(two.requires_grad_())[0], f, f, 0.5)
    blocks = [F.adaptive_avg_pool2d(x, 28) for x in seen]
    assert [x.shape[1] for x in blocks] == [64, 128, 256, 512] * 2
    expected = sum(F.mse_loss(a, b) for a, b in zip(blocks[:4], blocks[4:], strict=True))
    assert loss.item() == pytest.approx(expected.item(), rel=1e-4)
    loss.backward()
    assert two.grad.abs().sum() > 0


def test_vgg_refuses_other_weights(vgg_file, tmp_path, monkeypatch):
    other = torch.load(vgg_file, weights_only=True)
    del other["features.14.weight"]
    torch.save(other, tmp_path / "vgg13.pth")
    with pytest.raises(UserError, match=r"vgg13\.pth.*1 missing \(14\.weight\).*torchvision's vgg16"):
        features.vgg16_tower(config(tmp_path / "vgg13.pth"))
    with pytest.raises(UserError, match=r"features\.weights=null.*imagenet"):
        features.vgg16_tower(config())
    with pytest.raises(UserError, match=r"features\.weights=openai.*vgg16 are: imagenet"):
        features.vgg16_tower(config("openai"))

    def unplugged(*args, **kwargs):
        raise OSError("no route to download.pytorch.org")

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", unplugged)
    with pytest.raises(UserError, match=r"no route.*https://.*vgg16.*\.pth; then set features\.weights=FILE"):
        features.vgg16_tower(config("imagenet"))


# ---- packages


@pytest.mark.parametrize(("package", "extractor"), [("open_clip", "clip"), ("torchvision", "vgg16")])
def test_a_missing_package_is_named_with_its_extra(monkeypatch, package, extractor):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=rf'{package}: pip install "viinter\[features\]"'):
        features.load(config("openai", extractor=extractor), "cpu")


def test_without_features_their_packages_are_not_imported():
    code = (
        "import viinter.features, sys; names = ('open_clip', 'torchvision', 'timm', 'huggingface_hub'); "
        "print([m for m in sys.modules if m.startswith(names)])"
    )
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root)
    assert done.stdout.strip() == "[]", done.stderr


# ---- real weights, real views


def view(name):
    """A view [256,256,3] in [0, 1]: the middle square of the image."""
    file = next((DATA / name).parent.glob((DATA / name).name), None)
    if file is None:
        pytest.skip(f"no {DATA / name}")
    image = Image.open(file).convert("RGB")
    side = min(image.size)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    image = image.crop((left, top, left + side, top + side)).resize((256, 256), Image.Resampling.BOX)
    return torch.from_numpy(np.array(image)) / 255


def test_efficientnet_recognises_what_it_sees():
    """That the tower's weights are in their places: LLFF's horns are the skull of a triceratops."""
    efficientnet_tower = pytest.importorskip("efficientnet_tower")
    horns = view("llff/horns/images_8/DJI_20200223_163016_842.png").permute(2, 0, 1)[None]
    with torch.no_grad():
        chances = efficientnet_tower.network()(cut(horns, Patches.paper) * 2 - 1).softmax(1)[0]
    assert chances.argmax() == 51  # triceratops
    assert chances[51] > 0.8


def test_real_features_tell_a_view_between_from_another_scene(monkeypatch):
    efficientnet_tower = pytest.importorskip("efficientnet_tower")
    monkeypatch.setitem(features.TOWERS, "efficientnet", efficientnet_tower.build)
    tower = features.load(config(extractor="efficientnet"), "cpu")
    knights = [view(f"stanford/knights/out_08_{column:02d}_*.jpg") for column in (4, 8, 12)]
    chess = view("stanford/chess/view_08_08.jpg")
    one, between, two, other = embed_views(tower, torch.stack([*knights, chess]), chunk=2)
    assert between.shape == (1280,)
    far = interpolation_loss(other, one, two, 0.5)
    left, near, right = (interpolation_loss(between, one, two, t) for t in (0.0, 0.5, 1.0))
    assert 0 < near < 0.1 * far
    # the mix says more of the view half way than either of its ends does
    assert near < 0.7 * min(left, right)
