"""Progress bars, with the estimated time left, and a render that Ctrl-C ends at once."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from manylights import files

#: Seconds between two looks at the state of the work.
REFRESH = 0.1

#: Seconds after which work whose length nobody knows gets a bar.
PATIENCE = 1.0

#: Lines below a bar, at most.
MOST_LINES = 16

#: Exit status of a command that Ctrl-C ended, as shells have it: 128 + SIGINT.
INTERRUPTED = 130

#: What such a command says if it leaves nothing.
NOTHING_WRITTEN = "interrupted, nothing written"


class Estimate:
    """Estimates the finished fraction between two reports, and the seconds left.

    Work done in few large passes reports rarely. Between reports the estimate advances at the mean
    speed so far, but never beyond the next report.

    Args:
        clock: returns the time in seconds.
        begin: the fraction that was finished before, by an earlier process.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, begin: float = 0.0) -> None:
        self.clock, self.start, self.begin = clock, clock(), begin
        self.last, self.step, self.reported_at = begin, 0.0, self.start

    def report(self, fraction: float) -> None:
        """Take note that ``fraction`` of the work, from 0 to 1, is done now."""
        if fraction > self.last:
            self.step = fraction - self.last
            self.last, self.reported_at = fraction, self.clock()

    def fraction(self) -> float:
        """Return the estimated finished fraction, from 0 to 1."""
        ahead = min(self._speed() * (self.clock() - self.reported_at), self.step)
        return min(self.last + ahead, 1.0)

    def seconds_left(self) -> float | None:
        """Return the estimated seconds to the end, None before the first report."""
        if self.last == self.begin:
            return None
        return (1.0 - self.fraction()) / self._speed()

    def _speed(self) -> float:
        return (self.last - self.begin) / max(self.reported_at - self.start, 1e-6)


def format_seconds(seconds: float | None) -> str:
    """Return seconds as "1:02:03" or "2:03", "-:--" for None."""
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def say(text: str) -> None:
    """Print a line on stderr, above the progress bar if there is one."""
    print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def waiting(title: str) -> Iterator[None]:
    """Context of work of unknown length: above :data:`PATIENCE` a bar on stderr shows the seconds.

    The work stays in its thread, so Ctrl-C works as ever. Without a terminal there is no bar.

    Args:
        title: what the bar is labelled with.
    """
    done = threading.Event()
    watcher = threading.Thread(target=_show_waiting, args=(title, done), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def _show_waiting(title: str, done: threading.Event) -> None:
    if done.wait(PATIENCE):
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    silent = not console.is_terminal
    with Progress(*columns, console=console, disable=silent, transient=True) as bar:
        task = bar.add_task(title, total=None)
        bar.tasks[task].start_time = bar.get_time() - PATIENCE
        done.wait()


class Bar:
    """What the work of ``run_with_bar`` tells about itself, from any thread.

    Attributes:
        text: shown beside the bar.
        lines: shown below it.
        interrupted: was there a Ctrl-C that the work is to end at?
    """

    def __init__(self) -> None:
        self.estimate, self.text = Estimate(), ""
        self.lines: list[str] = []
        self.interrupted = threading.Event()

    def begin(self, fraction: float) -> None:
        """Begin with a fraction, from 0 to 1, that was finished before, by an earlier process."""
        self.estimate = Estimate(begin=fraction)

    def report(self, fraction: float) -> None:
        """Take note that ``fraction`` of the work, from 0 to 1, is done now."""
        self.estimate.report(fraction)


def run_with_bar(
    title: str,
    work: Callable[[Bar], Any],
    farewell: Callable[[], str] = lambda: NOTHING_WRITTEN,
    patient: bool = False,
) -> Any:
    """Run ``work(bar)`` with a progress bar on stderr and return its result.

    The work runs in a thread of its own: a compiled renderer cannot be interrupted, but the thread
    that waits for it can. On Ctrl-C the process ends with status 130, without waiting for the work
    and so without anything that would come after it; only a file that is being written is written
    to its end. Without a terminal there is no bar.

    Args:
        title: what the bar is labelled with.
        work: is given the bar, to tell how far it is.
        farewell: returns what to print after Ctrl-C.
        patient: let the work end itself at the first Ctrl-C, once it sees ``bar.interrupted``.
    """
    bar = Bar()
    outcome: dict[str, Any] = {}
    # Not the thread's own end: Python takes it for ended when Ctrl-C interrupts its join().
    done = threading.Event()

    def run() -> None:
        try:
            outcome["result"] = work(bar)
        except BaseException as error:
            outcome["error"] = error
        done.set()

    threading.Thread(target=run, name="manylights-render", daemon=True).start()
    try:
        if patient:
            _show_patiently(title, bar, done)
        else:
            _show(title, bar, done)
    except KeyboardInterrupt:
        # Never released: nothing is written any more.
        files.writing.acquire()
        say(farewell())
        os._exit(INTERRUPTED)
    if bar.interrupted.is_set() and "error" in outcome:
        say(farewell())
        sys.exit(INTERRUPTED)
    if "error" in outcome:
        raise outcome["error"]
    return outcome["result"]


def _show_patiently(title: str, bar: Bar, done: threading.Event) -> None:
    try:
        _show(title, bar, done)
    except KeyboardInterrupt:
        bar.interrupted.set()
        _show("ending", bar, done)


def _show(title: str, state: Bar, done: threading.Event) -> None:
    # Commands without a bar start without it.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
    from rich.text import Text

    class BarWithLines(Progress):
        def get_renderables(self):
            yield from super().get_renderables()
            lines = state.lines
            yield from (Text(f"  {line}") for line in lines[:MOST_LINES])
            if len(lines) > MOST_LINES:
                yield Text(f"  and {len(lines) - MOST_LINES} others")

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TextColumn("{task.fields[left]} left {task.fields[text]}"),
    )
    with BarWithLines(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=1.0, left=format_seconds(None), text="")
        while not done.wait(REFRESH):
            left = format_seconds(state.estimate.seconds_left())
            bar.update(task, completed=state.estimate.fraction(), left=left, text=state.text)
        bar.update(task, completed=1.0, left=format_seconds(0.0))
