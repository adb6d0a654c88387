"""`viinter.train` with one more feature tower, EfficientNet-Lite0 with its real ImageNet weights, where those of CLIP
and VGG16 cannot be downloaded: `python -m tests.efficientnet_train features.extractor=efficientnet ...`."""

from tests import efficientnet_tower
from viinter import features, train

features.TOWERS["efficientnet"] = efficientnet_tower.build

if __name__ == "__main__":
    train.main()
