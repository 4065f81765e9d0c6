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
one is 33 MB, or 66 to 100 MB as an exact sum: 1 to 3 GB/s in all, and adding one takes the client
some tenths of a second. So one client keeps up with fifty workers or so. The scheduler has little
to do: 33 tasks and some hundred events in a second, and each second its addresses to the
client, 40 kB. But films pass through its process, unless the client fetches them from the workers
(``Client(..., direct_to_workers=True)``). Two ways lead on, neither costs a bit, since sums of sums
are exact, too:

- merging in a tree: ``--part k/32`` gives each of 32 clients steps, workers and a file of its own,
  with one scheduler for each; ``manylights merge`` adds the 32 files, in groups and in any order;
- longer runs (``shares.RUN_SECONDS``): ten minutes for a thousand workers are as many films for the
  client as half a minute for fifty, at the price of more that a lost worker loses.
"""

from manylights.rendering.workers.connection import Connection
from manylights.rendering.workers.run import run

__all__ = ["Connection", "run"]
