"""How much memory the process has taken."""

from __future__ import annotations

import re
import resource
import sys
from pathlib import Path


def peak_mb() -> float:
    """Megabytes of the process at its height so far.

    Linux's `ru_maxrss` begins at the height of whatever started the process, a notebook with gigabytes perhaps, so that
    what /proc says comes first.
    """
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text())):
        return int(found[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)
