"""`viinter.train` twice at the same moment: `python -m tests.two_trains ...`."""

import os
import sys

from viinter import train

if __name__ == "__main__":
    other = os.fork()
    train.main()
    if other:
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(other, 0)[1]))
