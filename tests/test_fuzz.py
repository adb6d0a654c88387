"""Any bytes and any settings are accepted or answered with a UserError, never with another one.

Image files have such tests of their own in `test_image.py`, and one that is guided here.
"""

import contextlib
import copy
import io
import resource

import numpy as np
import pytest
import torch
from conftest import typed
from hypothesis import HealthCheck, example, given
from hypothesis import settings as effort
from hypothesis import strategies as st

from viinter import config, scenes
from viinter.config import UserError
from viinter.module import read_checkpoint


def test_mutated_pictures_are_read_or_refused(tmp_path):
    pytest.importorskip("atheris", reason="atheris has wheels for Linux on x86_64 and Python 3.11 to 3.13")
    (tmp_path / "seeds").mkdir()
    started_at = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024  # what libFuzzer counts begins there
    limit = f"-rss_limit_mb={started_at + 2048}"
    found = typed("-m", "tests.fuzz_images", "seeds", "-runs=3000", "-seed=1", limit, cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    assert "Done 3000 runs" in found.stderr


quick = effort(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def accepted_or_answered(use):
    with contextlib.suppress(UserError):
        use()


KEYS = [key for model in config.MODELS.values() for key, *_ in config.describe(config.TrainConfig(model=model()))]
VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text(max_size=12),
    st.sampled_from(["none", "inf", "paper", "fast", "${seed}", "${nowhere}", "???", "[1,2", "{a: 1}", "1e400"]),
    st.lists(st.one_of(st.integers(-9, 9), st.floats(), st.text(max_size=3)), max_size=5),
)  # fmt: skip
PLAIN = config.plain(config.TrainConfig(
    scene=config.SceneConfig(name="a", layout=config.Layout.folder, root="b"), model=config.PaperModel(name="paper")
))  # fmt: skip


@quick
@given(st.dictionaries(st.sampled_from(KEYS), VALUES, min_size=1, max_size=3))
@example({"model.width": 0})
@example({"scene.name": "${0}"})
@example({"scene.name": "${"})
def test_any_settings_are_run_or_refused(values):
    plain = copy.deepcopy(PLAIN)
    for key, value in values.items():
        *groups, last = key.split(".")
        node = plain
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = value
    accepted_or_answered(lambda: config.check(config.from_plain(plain)))


@quick
@given(st.lists(st.text(max_size=30), max_size=3))
def test_any_words_of_a_resumed_run_are_run_or_refused(words):
    accepted_or_answered(lambda: config.check(config.from_plain(copy.deepcopy(PLAIN), words)))


@st.composite
def damaged(draw, whole: bytes):
    """The bytes of a good file, cut, with bytes changed, or any bytes at all."""
    if draw(st.booleans()):
        return draw(st.binary(max_size=400))
    data = bytearray(whole[: draw(st.integers(0, len(whole)))])
    for place in draw(st.lists(st.integers(0, max(0, len(data) - 1)), max_size=4)):
        if data:
            data[place] = draw(st.integers(0, 255))
    return bytes(data)


def saved(save, value) -> bytes:
    file = io.BytesIO()
    save(file, value)
    return file.getvalue()


@quick
@given(damaged(saved(np.save, np.zeros((3, 17)))))
def test_any_bytes_are_poses_or_refused(tmp_path, data):
    file = tmp_path / "poses_bounds.npy"
    file.write_bytes(data)
    accepted_or_answered(lambda: scenes._cameras(file, 3))


CHECKPOINT = {"config": {}, "about": {}, "state_dict": {"a": torch.zeros(2)}, "global_step": 1}


@quick
@given(damaged(saved(lambda file, value: torch.save(value, file), CHECKPOINT)))
@example(data=b"X")
@pytest.mark.filterwarnings("ignore")
def test_any_bytes_are_a_checkpoint_or_refused(tmp_path, data):
    file = tmp_path / "last.ckpt"
    file.write_bytes(data)
    accepted_or_answered(lambda: read_checkpoint(file))
