"""The peak of the process's memory: it counts what was taken and given back, and nothing of the process's parent."""

import numpy as np
import pytest
from conftest import typed

PRINTED = "from viinter import memory; print(memory.peak_mb())"


@pytest.mark.parametrize(("before", "least", "most"), [("", 1, 150), ("b'1' * (300 << 20); ", 300, 450)])
def test_the_peak_is_the_processs_own(before, least, most, tmp_path):
    taken = np.ones(600 << 17)  # 600 MB, of the parent
    found = typed("-c", before + PRINTED, cwd=tmp_path)
    assert least < float(found.stdout) < most
    assert taken.all()
