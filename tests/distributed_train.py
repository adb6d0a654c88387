"""`viinter.train` with a small tower for L_inter, called "tiny": `python -m tests.distributed_train ...`.

Each of the processes that train together leaves what it has trained in `rank<k>.pt` in the current folder.
"""

import torch

from viinter import checkpoints, features, train


def tiny(cfg):
    tower = torch.nn.Sequential(torch.nn.AvgPool2d(32), torch.nn.Flatten(), torch.nn.Linear(147, 8))
    with torch.no_grad():
        tower[2].weight.copy_(torch.randn(8, 147, generator=torch.Generator().manual_seed(1)))
    return features.FeatureTower("tiny", tower, cfg.patches, (0.5,) * 3, (0.5,) * 3)


class Saving(checkpoints.SaveCheckpoint):
    def on_train_end(self, trainer, module):
        torch.save(module.state_dict(), f"rank{trainer.global_rank}.pt")
        super().on_train_end(trainer, module)


features.TOWERS["tiny"] = tiny
train.SaveCheckpoint = Saving

if __name__ == "__main__":
    train.main()
