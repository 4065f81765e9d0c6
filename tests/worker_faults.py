"""What goes wrong in workers of Dask: they load this file first, tests call it in their processes.

The file that the environment variable names has the faults, as JSON: ``{"step": 5, "fault":
"killed"}``. It is read before each step.
"""

import json
import os
import shutil
import signal
import time
from pathlib import Path

from manylights import loading
from manylights.rendering import plan
from manylights.rendering.driver import Driver

#: Names the file with the faults.
FAULTS = "MANYLIGHTS_TEST_FAULTS"

#: Also small images are rendered in many steps: of so many samples at most.
STEP_SAMPLES = 2**10


def shorten_steps(patch=setattr):
    """Have this process render in short steps."""
    patch(plan, "SINGLE_STEP_SAMPLES", 0)
    patch(plan, "MOST_SAMPLES", dict.fromkeys(plan.MOST_SAMPLES, STEP_SAMPLES))
    patch(plan, "PILOT_SAMPLES", 2 * STEP_SAMPLES)


def fail(fault):
    """Do what the fault is called."""
    if fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "memory":
        raise MemoryError("cannot allocate 123 GB")
    if fault == "disk":
        raise OSError(28, "No space left on device")
    if fault == "slow":
        time.sleep(0.5)


def dask_setup(worker):
    """Dask calls this in each worker that has the file as ``--preload``."""
    shorten_steps()
    render, load = Driver.render, loading.load

    def render_or_fail(driver, step, *others):
        found = known_faults()
        is_lesson = step.passes and all(one.role == plan.TRAIN for one in step.passes)
        if found.get("step") in ("all", step.index) and not is_lesson:
            fail(found["fault"])
        return render(driver, step, *others)

    def load_or_fail(path, *others, **named):
        found = known_faults()
        fail(found.get("load"))
        if found.get("folder") and worker.name == found.get("worker", worker.name):
            path = path.replace(*found["folder"])
        return load(path, *others, **named)

    Driver.render, loading.load = render_or_fail, load_or_fail


def known_faults():
    """What the file of faults says."""
    path = Path(os.environ[FAULTS])
    return json.loads(path.read_text()) if path.exists() else {}


def kept_files(dask_worker):
    """Names of files that were sent to a worker."""
    folder = Path(dask_worker.local_directory)
    return [str(path.relative_to(folder)) for path in folder.rglob("manylights-*/**/*.xml")]


def copy_scene(source, target):
    """Copy the folder of a scene with what its links lead to."""
    shutil.copytree(source, target, symlinks=False)
