"""Renders a job with the workers of Dask, an optional dependency.

The client has the scene, the sums and the checkpoint. It gives each worker one run of consecutive
steps at a time, and adds the films that come back; the sums are exact (``rendering.sums``), so the
image is that of one machine, bit for bit, whatever came when. Which steps there are is the job's
matter (``Course.open_steps``).

- ``shares``: which steps nobody has yet, and how many a worker gets; numbers only;
- ``task``: what workers do, in their processes: load and compare the scene, render, forget;
- ``connection``: a client of Dask for an address, a file or this machine alone;
- ``team``: which workers there are, what each does and what it gives back;
- ``run``: renders the job.

What goes over the network: an order (the arguments of the command and the hashes of the files, some
kB) to each worker once, with ``--ship`` the files; then for each run of up to a minute the numbers
of its steps to the worker, and one film per sequence back: 16 bytes a pixel for each sum in four
channels, of one step in single precision, of more as the two or three numbers of an exact sum. Each
worker learns visibility itself from the same training passes, a second of work, so that none waits
for another and nothing more travels.

A thousand workers, on paper: each sends one film in half a minute, 33 in a second. At 1920 x 1080
these are 33 MB each, or 66 to 100 MB as exact sums, 1 to 3 GB/s in all: beyond one client. What the
scheduler does is little: 33 tasks and some hundred events in a second, and 40 kB of addresses each
second to the client. But films pass through its process unless the client takes them from the
workers (``Client(..., direct_to_workers=True)``). Two ways lead on, both without loss of a bit,
since sums of sums are exact, too:

- longer runs: the time between two films of a worker may grow with the number of workers, to ten
  minutes for a thousand, at the price of more that a lost worker loses;
- merging in a tree: ``--part k/32`` gives each of 32 clients its own steps, workers and file, all
  with the same scheduler or with their own; ``manylights merge`` adds the 32 files, in groups and
  in any order. A client that adds 33 MB films in 30 ms keeps up with about 30 workers.
"""

from manylights.rendering.workers.connection import Connection
from manylights.rendering.workers.run import run

__all__ = ["Connection", "run"]
