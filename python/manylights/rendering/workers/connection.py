"""A client of Dask: for workers on this machine alone, or for a scheduler that runs already."""

from __future__ import annotations

import ipaddress
import json
import logging
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import drjit as dr

from manylights import files
from manylights.errors import UsageError, one_line
from manylights.progress import say

REMEDY = "needs Dask distributed. Install it with: pip install 'manylights[dask]'"

WHAT = "local:N, tcp://HOST:PORT, tls://HOST:PORT or a scheduler file (.json)"

#: Seconds to wait for a scheduler.
PATIENCE = 15.0

#: Dask's configuration of workers on this machine, which share its processors with the render.
LOCAL = {
    # Whoever was killed is started again, however long that takes.
    "distributed.deploy.lost-worker-timeout": "1 hour",
    # No pages about it all.
    "distributed.scheduler.http.routes": ["distributed.http.health"],
    # Dask looks many times a second what its own code does, and who could do whose work.
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.work-stealing": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "10s",
}


class Connection:
    """Workers that the command line asked for. They start while the scene is loaded.

    Args:
        address: ``local:N`` starts N workers here; ``tcp://HOST:PORT``, ``tls://HOST:PORT`` or a
            scheduler's file (.json) has some already.
        threads: of each local worker. Default: the processors, shared out evenly.

    Raises:
        UsageError: another address, no such file, or Dask is missing.
    """

    def __init__(self, address: str, threads: int | None = None) -> None:
        self.address, self._stack = address, ExitStack()
        count = local_count(address)
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise UsageError(f"--workers {REMEDY}") from error
        if count is None:
            warn_of(scheduler_address(address))
        starter = ThreadPoolExecutor(1, thread_name_prefix="manylights-workers")
        self._client: Future = starter.submit(self._start, count, threads)
        starter.shutdown(wait=False)

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_) -> None:
        with suppress(Exception):
            self._client.result()
        self._stack.close()

    def client(self) -> Any:
        """Return the ``distributed.Client``, once it is there.

        Raises:
            UsageError: nobody answers, or not in the way that was asked for.
        """
        try:
            return self._client.result()
        except Exception as error:
            raise UsageError(f"--workers {self.address}: {one_line(error)}") from error

    def _start(self, count: int | None, threads: int | None):
        from distributed import Client

        # What becomes of workers is told by the render.
        for name in ("distributed", "asyncio", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        enter = self._stack.enter_context
        if count is None:
            where = {"address": self.address}
            if self.address.endswith(".json"):
                where = {"scheduler_file": self.address}
            return enter(Client(**where, timeout=PATIENCE, set_as_default=False))
        folder = enter(tempfile.TemporaryDirectory(prefix="manylights-workers-"))
        cluster = enter(_local_cluster(count, threads, folder))
        return enter(Client(cluster, set_as_default=False, direct_to_workers=True))


def _local_cluster(count: int, threads: int | None, folder: str):
    """Return workers that only this machine can reach.

    Without a limit of Dask's own on memory: a render by itself has none.
    """
    import dask
    from distributed import LocalCluster

    dask.config.set(LOCAL)  # pyright: ignore[reportPrivateImportUsage]
    return LocalCluster(
        n_workers=count,
        threads_per_worker=threads or max(dr.thread_count() // count, 1),
        processes=True,
        host="127.0.0.1",
        protocol="tcp://",
        dashboard_address=None,
        worker_dashboard_address=None,
        # Dask has a port for them all the same, on the same interface.
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        memory_limit=0,
        local_directory=folder,
        silence_logs=logging.CRITICAL,
        preload=["manylights.rendering.workers.task"],
    )


def local_count(address: str) -> int | None:
    """Return N of ``local:N``, None for other addresses.

    Raises:
        UsageError: neither that nor any other.
    """
    name, _, rest = address.partition(":")
    if name == "local":
        if not rest.isdecimal() or not 1 <= int(rest) <= 1024:
            raise UsageError(f"--workers {address}: must be local:N, 1 <= N <= 1024")
        return int(rest)
    if not (address.endswith(".json") or address.startswith(("tcp://", "tls://"))):
        raise UsageError(f"--workers {address}: must be {WHAT}")
    return None


def scheduler_address(address: str) -> str:
    """Return the address itself, or the one that a scheduler's file has.

    Raises:
        UsageError: no such file, or another one.
    """
    if not address.endswith(".json"):
        return address
    files.require(address, "--workers ")
    try:
        return str(json.loads(Path(address).read_text())["address"])
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"--workers {address}: not a scheduler's file of Dask") from error


def warn_of(address: str) -> None:
    """Say what an address means that is not encrypted and leads to another machine."""
    if not address.startswith("tcp://") or is_here(urlsplit(address).hostname or ""):
        return
    say(
        f"workers: {address} is neither encrypted nor authenticated. Whoever reaches scheduler or "
        "workers can run code there and here (they exchange pickles); tls:// keeps others out"
    )


def is_here(host: str) -> bool:
    """Is it the loopback interface of this machine?"""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
