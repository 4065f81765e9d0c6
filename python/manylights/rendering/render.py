"""Renders a job, and keeps its state in a file if asked to."""

from __future__ import annotations

from manylights.rendering.checkpoint import Checkpoint
from manylights.rendering.job import Job
from manylights.rendering.passes import Report, develop, render_passes
from manylights.rendering.sums import Sums
from manylights.threads import thread_count


def render(
    job: Job,
    report: Report = lambda fraction: None,
    threads: int | None = None,
    checkpoint: Checkpoint | None = None,
):
    """Render and return the film's ``mi.Bitmap`` with all its channels, weights divided out.

    Args:
        job: what to render.
        report: called with the finished fraction, from 0 to 1; may come from another thread.
        threads: CPU threads of the render, >= 1, or ``None`` for what Mitsuba has set.
        checkpoint: what to go on from, and where to keep the state. Default: nothing is kept.
    """
    sums = Sums() if checkpoint is None else checkpoint.sums
    with thread_count(threads):
        for so_far in render_passes(job, sums, report):
            if checkpoint is not None and so_far.passes < len(job.plan.passes):
                checkpoint.keep()
    return develop(job.film, sums)
