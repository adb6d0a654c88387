"""`viinter.train` as a process that is killed at a chosen moment: `python -m tests.watched_train ...`.

It writes a letter to the file `moments` in the current folder before and after a step (s), a view that is measured (e),
each call that brings a checkpoint to the disk (c), and what follows the last step (f). If there is a file `plan` with a
letter, a count and seconds, another process kills it with SIGKILL so many seconds after that letter came so many times.

Time is what the steps make it, 1/128 s each: then two runs can be compared to the last bit in their clocks, schedules
and times of evaluation too.
"""

import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

from viinter import callbacks, checkpoints, train
from viinter.module import ViewInterpolator

moments = os.open("moments", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
wanted, count, delay = Path("plan").read_text().split() if Path("plan").exists() else ("none", 0, 0)
come = 0
listening, now = os.pipe()
if wanted != "none" and not os.fork():
    os.close(now)
    if os.read(listening, 1):
        time.sleep(float(delay))
        os.kill(os.getppid(), signal.SIGKILL)
    os._exit(0)
os.close(listening)

clock = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)
callbacks.time = checkpoints.time = clock


def mark(letter):
    global come
    os.write(moments, letter.encode())
    come += letter == wanted
    if wanted != "none" and come == int(count):
        os.write(now, b"!")


def marked(letter, owner, name):
    inner = getattr(owner, name)

    def call(*args, **kwargs):
        mark(letter)
        found = inner(*args, **kwargs)
        mark(letter)
        return found

    setattr(owner, name, call)


def slow(self, *args, inner=ViewInterpolator.training_step):
    clock.now += 1 / 128
    return inner(self, *args)


ViewInterpolator.training_step = slow
marked("s", ViewInterpolator, "training_step")
marked("e", callbacks.ErrorClock, "_seen")
for owner, name in ((callbacks.L.Trainer, "save_checkpoint"), (os, "fsync"), (os, "replace")):
    marked("c", owner, name)
for owner, name in ((callbacks.Budget, "on_train_end"), (train, "write_json")):
    marked("f", owner, name)

if __name__ == "__main__":
    train.main()
    if wanted != "none" and come >= int(count):
        time.sleep(10)  # what was left to do took less than the plan's delay: the kill is on its way
