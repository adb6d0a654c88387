"""What needs no training: cross-fade and optical flow at the probes."""

import sys

import pytest
import torch

from viinter import peers
from viinter.config import UserError
from viinter.scenes import Probe, Scene


def texture(right):
    """Blobs [64, 64, 3] of some pixels' size, moved by so many pixels to the right."""
    blobs = torch.rand(1, 3, 16, 32, generator=torch.Generator().manual_seed(0))
    wide = torch.nn.functional.interpolate(blobs, (64, 128), mode="bicubic").clamp(0, 1)
    return wide[0, :, :, 32 - right : 96 - right].permute(1, 2, 0).contiguous()


def scene(*probes):
    """Two views of a texture that moves by 4 pixels, and these probes."""
    views = torch.stack([texture(0), texture(4)])
    return Scene("s", None, views, ["a", "b"], {"novel": list(probes)}, {}, 1.0, (0, 1), [])


def moved(share):
    """The probe at this share of the way from the first view to the second."""
    return Probe(texture(round(4 * share)), ((0, 1 - share), (1, share)), f"at {share}")


def test_a_cross_fade_is_the_weighted_mean():
    views = torch.stack([torch.zeros(2, 2, 3), torch.ones(2, 2, 3)])
    probe = Probe(views[0], ((0, 0.75), (1, 0.25)), "x")
    assert torch.equal(peers.blend(views, probe), torch.full((2, 2, 3), 0.25))


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_flow_finds_the_view_between_where_a_cross_fade_does_not(share):
    pytest.importorskip("cv2")
    found = peers.measure(scene(moved(share)))
    assert found["flow"]["psnr"] > found["blend"]["psnr"] + 5
    assert set(found["flow"]["per_view"]) == {f"at {share}"}
    assert found["flow"]["registered"]["psnr"] > found["blend"]["registered"]["psnr"] + 5


def test_flow_of_a_still_scene_is_the_view_itself():
    pytest.importorskip("cv2")
    still = torch.stack([texture(0)] * 2)
    assert (peers.flow(still, Probe(still[0], ((0, 0.5), (1, 0.5)), "x")) - still[0]).abs().max() < 1 / 255


def test_without_opencv_or_probes_the_reason_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    found = peers.measure(scene(moved(0.5)))
    assert found["blend"]["psnr"] > 10
    assert 'pip install "viinter[peers]"' in found["blend"]["registered"]
    assert 'pip install "viinter[peers]"' in found["flow"]
    assert peers.measure(scene()) == dict.fromkeys(("blend", "flow"), "the scene has no probes")


def test_flow_refuses_a_probe_of_four_views():
    pytest.importorskip("cv2")
    corners = Probe(torch.zeros(8, 8, 3), tuple((k, 0.25) for k in range(4)), "cell")
    with pytest.raises(UserError, match="cell has 4"):
        peers.flow(torch.zeros(4, 8, 8, 3), corners)
