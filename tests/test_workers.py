"""`manylights render --workers`: the bits of one render, whatever becomes of the workers."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import cli
from manylights.errors import UsageError
from manylights.rendering import state_file

from tests import worker_faults
from tests.conftest import heed_ctrl_c, require_variant
from tests.test_parts import content, write_scene

dask = pytest.importorskip("dask", reason="needs Dask: pip install distributed")
distributed = pytest.importorskip("distributed", reason="needs Dask: pip install distributed")

from manylights.rendering.workers import connection, task  # noqa: E402
from manylights.rendering.workers.connection import Connection  # noqa: E402

pytestmark = pytest.mark.usefixtures("plugin")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def faults(tmp_path_factory):
    """The file of what goes wrong in workers."""
    path = tmp_path_factory.mktemp("faults") / "faults.json"
    os.environ[worker_faults.FAULTS] = str(path)
    yield path
    del os.environ[worker_faults.FAULTS]


def start_cluster(count=2, **options):
    """Workers with short steps, on this machine."""
    return distributed.LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=None,
        memory_limit=0,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        silence_logs=50,
        preload=[str(ROOT / "tests" / "worker_faults.py")],
        **options,
    )


@pytest.fixture(scope="module")
def shared_client(faults):
    """A client with two workers."""
    dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})
    with start_cluster() as cluster, distributed.Client(cluster, set_as_default=False) as made:
        yield made


@pytest.fixture
def client(shared_client, faults):
    """The client, with workers that have no faults yet."""
    faults.unlink(missing_ok=True)
    shared_client.wait_for_workers(2, timeout=120)
    yield shared_client
    faults.unlink(missing_ok=True)


@pytest.fixture(autouse=True)
def short_steps(monkeypatch):
    """Here, too, small images are rendered in many steps."""
    worker_faults.shorten_steps(monkeypatch.setattr)


@pytest.fixture
def scene(tmp_path):
    """A scene with a filter that is wider than a pixel, in 28 x 18 pixels."""
    path = write_scene(tmp_path / "scene.xml")
    text = path.read_text()
    for name, value in (("resx", 28), ("resy", 18)):
        before = text.partition(f'name="{name}" value="')[2].partition('"')[0]
        text = text.replace(f'name="{name}" value="{before}"', f'name="{name}" value="{value}"')
    path.write_text(text)
    return path


def pixels(result):
    """The bytes of an image."""
    return np.asarray(result.image).tobytes()


def set_faults(path, **found):
    """Have the workers fail from now on."""
    path.write_text(json.dumps(found))


class once:
    """Calls a function with a worker's address as soon as it renders, for `progress`."""

    def __init__(self, client, function, after=0):
        self.client, self.function, self.after = client, function, after
        self.did = []

    def __call__(self, progress):
        busy = [line for line in progress.workers if ": step" in line]
        if busy and not self.did and progress.samples >= self.after:
            self.did.append(busy[0])
            self.function()


# ---------------------------------------------------------------------------------- the same bits


@pytest.mark.parametrize(
    ("variant", "filter_type"),
    [("scalar_rgb", "gaussian"), ("scalar_rgb", "box"), ("llvm_ad_rgb", "gaussian")],
)
def test_workers_give_the_bits_of_one_render(client, scene, variant, filter_type):
    require_variant(variant)
    scene.write_text(scene.read_text().replace("gaussian", filter_type))
    whole = manylights.render(scene, spp=37, seed=5)
    seen = []
    shared = manylights.render(scene, spp=37, seed=5, client=client, progress=seen.append)
    assert pixels(shared) == pixels(whole) and shared.samples == 37
    fractions = [one.fraction for one in seen]
    assert min(fractions) >= 0.0 and fractions[-1] == 1.0
    lines = [line for one in seen for line in one.workers]
    assert any(": step" in line for line in lines) and seen[-1].samples == 37


def test_noise_as_the_target_gives_the_same_bits(client, scene, scalar):
    wanted = {"spp": 256, "until_noise": 0.3, "seed": 3}
    whole = manylights.render(scene, **wanted)
    shared = manylights.render(scene, **wanted, client=client)
    assert pixels(shared) == pixels(whole)
    assert (shared.samples, shared.noise) == (whole.samples, whole.noise) and whole.samples < 256
    assert shared.variance.tobytes() == whole.variance.tobytes()


@pytest.mark.parametrize("sampler", ["keep", "multijitter"])
def test_parts_and_other_samplers_can_be_shared_out(client, scene, tmp_path, sampler, scalar):
    def load():
        return manylights.loading.load(str(scene), sampler=sampler)

    whole = manylights.render(load(), spp=37, output=tmp_path / "whole.exr")
    for number in (1, 2):
        part = manylights.render(
            load(), spp=37, output=tmp_path / "a.exr", part=(number, 2), client=client
        )
        assert 0 < part.samples < 37
    merged = manylights.merge(tmp_path.glob("a.part-*.exr"), tmp_path / "merged.exr")
    assert merged.samples == whole.samples
    assert content(tmp_path / "merged.exr") == content(tmp_path / "whole.exr")


def test_renders_of_fewer_steps_than_workers_say_so(client, scene, monkeypatch, capsys, scalar):
    whole = manylights.render(scene, spp=2)
    shared = manylights.render(scene, spp=2, client=client)
    assert pixels(shared) == pixels(whole)
    log = capsys.readouterr().err
    assert "workers: this render has 1 step, at most 1 share the work" in log


# ------------------------------------------------------------------------------ workers that fail


def kill(client):
    """Kill a worker, whatever it does."""
    victim = random.choice(sorted(client.run(os.getpid).values()))
    os.kill(victim, signal.SIGKILL)


@pytest.mark.parametrize(
    "variant", ["scalar_rgb", pytest.param("llvm_ad_rgb", marks=pytest.mark.slow)]
)
def test_a_killed_worker_leaves_its_steps_to_others(client, scene, variant, faults, capsys):
    require_variant(variant)
    whole = manylights.render(scene, spp=37, seed=5)
    set_faults(faults, step="all", fault="slow")
    killing = once(client, lambda: kill(client), after=4)
    shared = manylights.render(scene, spp=37, seed=5, client=client, progress=killing)
    assert killing.did and pixels(shared) == pixels(whole) and shared.samples == 37
    assert "is gone, others render its step" in capsys.readouterr().err


@pytest.mark.slow
def test_a_step_that_ends_three_workers_is_named_and_the_rest_kept(
    client, scene, faults, tmp_path, capsys, scalar
):
    whole = manylights.render(scene, spp=37, seed=5)
    set_faults(faults, step=7, fault="killed")
    wanted = {"spp": 37, "seed": 5, "checkpoint": tmp_path / "c.exr", "output": tmp_path / "a.exr"}
    with pytest.raises(RuntimeError, match=r"step 8 ended 3 workers, the last one was .* on "):
        manylights.render(scene, **wanted, client=client)
    assert "the same command goes on from there" in capsys.readouterr().err
    state = state_file.read(tmp_path / "c.exr", "", "")[0].state
    assert state.history.steps == 7 and 7 not in state.history.ahead
    faults.unlink()
    # What is there is a part of the whole, too.
    merged = manylights.merge([tmp_path / "c.exr"], partial=True)
    assert merged.samples == state.history.spp and "part" in merged.missing
    resumed = manylights.render(scene, **wanted)
    assert pixels(resumed) == pixels(whole) and resumed.samples == 37


@pytest.mark.parametrize(
    ("fault", "words"),
    [("memory", "out of memory, cannot allocate 123 GB"), ("disk", "No space left on device")],
)
def test_what_a_worker_raises_is_told_with_its_name(
    client, scene, faults, tmp_path, fault, words, scalar
):
    whole = manylights.render(scene, spp=37)
    set_faults(faults, step=3, fault=fault)
    wanted = {"spp": 37, "checkpoint": tmp_path / "c.exr"}
    with pytest.raises(RuntimeError, match=rf"worker \d on \S+, steps? .*: .*{words}"):
        manylights.render(scene, **wanted, client=client)
    faults.unlink()
    resumed = manylights.render(scene, **wanted, client=client)
    assert pixels(resumed) == pixels(whole) and not (tmp_path / "c.exr").exists()


@pytest.mark.slow
def test_a_scene_that_ends_whoever_loads_it_is_told(client, scene, faults, scalar):
    set_faults(faults, load="killed")
    with pytest.raises(RuntimeError, match="loading the scene ended 3 workers: "):
        manylights.render(scene, spp=37, client=client)


def test_damaged_films_are_rendered_again(client, scene, monkeypatch, capsys, scalar):
    whole = manylights.render(scene, spp=37)
    checksum, damaged = task.checksum, [3]
    monkeypatch.setattr(
        task,
        "checksum",
        lambda films: checksum(films) + damaged.pop() if damaged else checksum(films),
    )
    shared = manylights.render(scene, spp=37, client=client)
    assert pixels(shared) == pixels(whole) and shared.samples == 37
    assert "a film was damaged on its way" in capsys.readouterr().err


def test_forgotten_jobs_are_loaded_again(client, scene, scalar):
    """A new process may have the address of an old one."""
    whole = manylights.render(scene, spp=37)
    forget = once(client, lambda: client.run(forget_all), after=4)
    shared = manylights.render(scene, spp=37, client=client, progress=forget)
    assert forget.did and pixels(shared) == pixels(whole)


def forget_all():
    """Forget the jobs of this process."""
    task.engagements.clear()


def test_a_render_that_is_ended_keeps_what_has_arrived(client, scene, tmp_path, scalar):
    whole = manylights.render(scene, spp=37)

    def end(progress):
        if progress.samples >= 8:
            raise KeyboardInterrupt

    wanted = {"spp": 37, "checkpoint": tmp_path / "c.exr"}
    with pytest.raises(KeyboardInterrupt):
        manylights.render(scene, **wanted, client=client, progress=end)
    state = state_file.read(tmp_path / "c.exr", "", "")[0].state
    assert 8 <= state.history.spp < 37
    resumed = manylights.render(scene, **wanted, client=client)
    assert pixels(resumed) == pixels(whole)
    deadline = time.monotonic() + 60.0
    while any(client.run(lambda: len(task.engagements)).values()):
        assert time.monotonic() < deadline, "workers forget the scene"
        time.sleep(0.1)


# ----------------------------------------------------------------------- the same version and files


def other_version(dask_worker=None, version="99"):
    """Pretend to be another version."""
    manylights.__version__ = version


def test_other_versions_take_no_part(client, scene, capsys, scalar):
    whole = manylights.render(scene, spp=37)
    first, *others = sorted(client.nthreads())
    try:
        client.run(other_version, workers=[first])
        shared = manylights.render(scene, spp=37, client=client)
        log = capsys.readouterr().err
        assert pixels(shared) == pixels(whole)
        assert " is not used: it has version manylights 99, Mitsuba" in log and "worker " in log
        client.run(other_version, workers=others)
        with pytest.raises(UsageError, match=r"version manylights 99.*; worker .*manylights 99"):
            manylights.render(scene, spp=37, client=client)
    finally:
        client.run(other_version, version=manylights.__version__)


@pytest.mark.parametrize("name", ["scene.xml", "data/bulbs.ply"])
def test_other_files_are_named_with_the_host(client, faults, tmp_path, name, scalar):
    elsewhere = tmp_path / "elsewhere"
    mine = tmp_path / "mine"
    mine.mkdir()
    scene = write_scene(mine / "scene.xml")
    worker_faults.copy_scene(mine, elsewhere)
    changed = elsewhere / name
    changed.write_bytes(changed.read_bytes() + b"\n")
    set_faults(faults, folder=[str(mine), str(elsewhere)])
    with pytest.raises(UsageError, match=rf"worker \d on \S+: it has another content of {name}"):
        manylights.render(scene, spp=37, client=client)
    set_faults(faults, folder=[str(mine), str(tmp_path / "nowhere")])
    with pytest.raises(UsageError, match=r"worker \d on .*nowhere/scene.xml: no such file"):
        manylights.render(scene, spp=37, client=client)


def test_files_are_sent_to_workers_without_them(client, scene, faults, tmp_path, scalar):
    whole = manylights.render(scene, spp=37)
    set_faults(faults, folder=[str(tmp_path), "/nowhere"])
    seen = []

    def look(progress):
        if progress.samples:
            seen.append(client.run(worker_faults.kept_files))

    shared = manylights.render(scene, spp=37, client=client, ship=True, progress=look)
    assert pixels(shared) == pixels(whole)
    assert any(name.endswith("/scene.xml") for name in next(iter(seen[0].values())))
    assert not any(client.run(worker_faults.kept_files).values()), "deleted at the end"


def test_absolute_names_cannot_be_sent(client, scene, tmp_path, scalar):
    mesh = tmp_path / "data" / "bulbs.ply"
    text = scene.read_text()
    assert '"data/bulbs.ply"' in text
    scene.write_text(text.replace("data/bulbs.ply", str(mesh)))
    with pytest.raises(UsageError, match=rf"^ship: .*scene.xml names {mesh}, which is elsewhere"):
        manylights.render(scene, spp=37, client=client, ship=True)


@pytest.mark.parametrize("name", ["../evil.xml", "/tmp/evil.xml"])
def test_files_stay_in_their_folder(name, tmp_path):
    with pytest.raises(UsageError, match="not a name within"):
        task._unpack([name], [np.zeros(3, np.uint8)], str(tmp_path))
    assert not list(tmp_path.iterdir())


# --------------------------------------------------------------------------------- what is refused


def test_what_cannot_be_shared_out_is_told(client, scene, scalar):
    with pytest.raises(UsageError, match="workers: need a number of samples or a noise"):
        manylights.render(scene, seconds=1.0, client=client)
    with pytest.raises(UsageError, match="workers: load the scene themselves"):
        manylights.render(mi.load_file(str(scene)), spp=37, client=client)
    with pytest.raises(UsageError, match="workers: load the scene themselves"):
        own = mi.load_dict({"type": "path"})
        manylights.render(scene, spp=37, client=client, integrator=own)
    with pytest.raises(UsageError, match="ship True: must be given with client"):
        manylights.render(scene, spp=37, ship=True)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("local", "must be local:N"),
        ("local:0", "must be local:N"),
        ("local:-1", "must be local:N"),
        ("local:x", "must be local:N"),
        ("http://a:8786", "must be local:N, tcp://HOST:PORT, tls://HOST:PORT or a scheduler file"),
        ("host:8786", "must be local:N, tcp://"),
        ("nothing.json", "no such file"),
        (str(ROOT / "pyproject.json"), "no such file"),
    ],
)
def test_addresses_that_are_none_are_refused(scene, tmp_path, capsys, address, words):
    assert (
        cli.main(["render", str(scene), "-o", str(tmp_path / "a.exr"), "--workers", address]) == 2
    )
    log = capsys.readouterr().err
    assert f"--workers {address}: " in log and words in log


def test_other_json_is_no_file_of_a_scheduler(tmp_path):
    path = tmp_path / "s.json"
    for text in ("{}", "[]", "no json"):
        path.write_text(text)
        with pytest.raises(UsageError, match="not a scheduler's file of Dask"):
            Connection(str(path))


def test_nobody_at_an_address_is_told(monkeypatch):
    monkeypatch.setattr(connection, "PATIENCE", 0.3)
    with (
        Connection("tcp://127.0.0.1:9") as nobody,
        pytest.raises(UsageError, match="--workers tcp"),
    ):
        nobody.client()


def test_without_dask_the_error_says_what_to_type(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    options = ["render", str(scene), "-o", str(tmp_path / "a.exr"), "--workers", "local:2"]
    assert cli.main(options) == 2
    assert "Install it with: pip install 'manylights[dask]'" in capsys.readouterr().err


def test_ship_needs_workers(scene, tmp_path, capsys):
    assert cli.main(["render", str(scene), "-o", str(tmp_path / "a.exr"), "--ship"]) == 2
    assert "--ship: must be given with --workers" in capsys.readouterr().err


# -------------------------------------------------------------------------------------- who listens


@pytest.mark.parametrize(
    ("address", "is_told"),
    [
        ("tcp://192.0.2.7:8786", True),
        ("tcp://render.example:8786", True),
        ("tcp://127.0.0.1:8786", False),
        ("tcp://[::1]:8786", False),
        ("tcp://localhost:8786", False),
        ("tls://192.0.2.7:8786", False),
    ],
)
def test_tcp_to_other_hosts_says_what_it_means(capsys, tmp_path, address, is_told):
    path = tmp_path / "scheduler.json"
    path.write_text(json.dumps({"address": address}))
    connection.warn_of(connection.scheduler_address(str(path)))
    log = capsys.readouterr().err
    assert ("neither encrypted nor authenticated" in log) == is_told and log.count("\n") == is_told


def test_local_workers_listen_to_this_machine_alone(faults):
    import psutil

    with Connection("local:1", threads=1) as here:
        made = here.client()
        assert made.scheduler.address.startswith("tcp://127.0.0.1:")
        processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
        listening = [
            one.laddr.ip
            for process in processes
            for one in process.net_connections("inet")
            if one.status == psutil.CONN_LISTEN
        ]
        assert listening and set(listening) == {"127.0.0.1"}
        workers = made.scheduler_info()["workers"].values()
        assert [worker["nthreads"] for worker in workers] == [1]


@pytest.fixture
def certificate(tmp_path):
    """Dask's configuration of a certificate that everybody here has."""
    key, cert = tmp_path / "key.pem", tmp_path / "cert.pem"
    kind = ["ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    command = ["openssl", "req", "-x509", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    command += ["-newkey", *kind, "-keyout", str(key), "-out", str(cert)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("openssl makes the certificate (on Debian: apt install openssl)")
    files = {"ca-file": str(cert)}
    for role in ("scheduler", "worker", "client"):
        files |= {f"{role}.key": str(key), f"{role}.cert": str(cert)}
    return {f"distributed.comm.tls.{name}": value for name, value in files.items()}


def test_tls_takes_the_configuration_of_dask(
    certificate, faults, scene, tmp_path, monkeypatch, capsys, scalar
):
    faults.unlink(missing_ok=True)
    whole = manylights.render(scene, spp=37, seed=5)
    options = ["--spp", "37", "--seed", "5", "--variant", scalar]
    command = ["render", str(scene), "-o", str(tmp_path / "a.exr"), *options]
    with dask.config.set({**certificate, "distributed.comm.require-encryption": True}):
        security = distributed.Security()
        with start_cluster(1, protocol="tls://", security=security) as cluster:
            address = cluster.scheduler_address
            assert address.startswith("tls://")
            assert cli.main([*command, "--workers", address]) == 0
            with dask.config.set(dict.fromkeys(certificate)):
                assert cli.main([*command, "--workers", address]) == 2
            monkeypatch.setattr(connection, "PATIENCE", 2.0)
            plain = address.replace("tls", "tcp")
            with dask.config.set({"distributed.comm.require-encryption": False}):
                assert cli.main([*command, "--workers", plain]) == 2
    log = capsys.readouterr().err
    assert f"--workers {address}: " in log and f"--workers {plain}: " in log
    assert np.array(mi.Bitmap(str(tmp_path / "a.exr"))).tobytes() == pixels(whole)


# ------------------------------------------------------------------------- processes of their own

#: A program whose renders have short steps, as the processes have that it starts.
CHILD = """
import sys
from tests import worker_faults
worker_faults.dask_setup(None)
if __name__ == "__main__":
    from manylights import cli
    sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.fixture
def start(scene, tmp_path, faults):
    """A function that starts a render with a seed, and workers if arguments say so."""
    set_faults(faults, step="all", fault="slow")
    program, started = tmp_path / "program.py", []
    program.write_text(CHILD)

    def run(*arguments):
        options = ["-o", tmp_path / "a.exr", "--spp", 37, "--seed", 5, "--variant", "scalar_rgb"]
        command = [sys.executable, program, "render", scene, *options, *arguments]
        process = subprocess.Popen(
            list(map(str, command)),
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=heed_ctrl_c,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()


def wait_for(path, process, seconds=240):
    """Wait until a file is there, while a process runs."""
    begin = time.monotonic()
    while not path.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() - begin < seconds
        time.sleep(0.1)


def finish(process):
    """Wait for the end of a process; return its exit status and log."""
    log = process.communicate(timeout=300)[1]
    return process.returncode, log


@pytest.mark.slow
def test_ctrl_c_keeps_what_has_arrived(start, scene, tmp_path, faults, scalar):
    kept = tmp_path / "a.checkpoint.exr"
    process = start("--workers", "local:2", "--checkpoint", 1e-6)
    wait_for(kept, process)
    os.kill(process.pid, signal.SIGINT)
    status, log = finish(process)
    assert status == 130 and f"{kept} has " in log and "the same command goes on" in log, log
    assert "Traceback" not in log
    assert state_file.read(kept, "", "")[0].state.history.spp > 0
    faults.unlink()
    status, log = finish(start("--checkpoint", 60))
    assert status == 0 and "the render goes on from there" in log, log
    whole = manylights.render(scene, spp=37, seed=5)
    assert np.array(mi.Bitmap(str(tmp_path / "a.exr"))).tobytes() == pixels(whole)


@pytest.mark.slow
def test_a_lost_scheduler_and_a_lost_client_cost_nothing(start, scene, tmp_path, faults, scalar):
    kept, found = tmp_path / "a.checkpoint.exr", tmp_path / "scheduler.json"
    preload = str(ROOT / "tests" / "worker_faults.py")

    def serve():
        found.unlink(missing_ok=True)
        program = [sys.executable, "-m", "dask"]
        common = ["--scheduler-file", str(found), "--no-dashboard"]
        scheduler = subprocess.Popen(
            [*program, "scheduler", "--host", "127.0.0.1", "--port", "0", *common],
            stderr=subprocess.DEVNULL,
        )
        wait_for(found, scheduler)
        worker = subprocess.Popen(
            [*program, "worker", "--nthreads", "1", "--preload", preload, *common],
            stderr=subprocess.DEVNULL,
        )
        return scheduler, worker

    started = []
    try:
        started += (pair := serve())
        process = start("--workers", found, "--checkpoint", 1e-6)
        wait_for(kept, process)
        pair[0].kill()
        status, log = finish(process)
        assert status == 2 and "workers: the scheduler tcp://127.0.0.1:" in log, log
        assert " is gone" in log and "the same command goes on from there" in log
        before = state_file.read(kept, "", "")[0].state.history.spp
        assert before > 0
        started += (pair := serve())
        process = start("--workers", found, "--checkpoint", 1e-6)
        while state_file.read(kept, "", "")[0].state.history.spp == before:
            assert process.poll() is None, process.communicate()[1]
            time.sleep(0.2)
        process.kill()
        process.wait()
        faults.unlink()
        status, log = finish(start("--workers", found, "--checkpoint", 1e-6))
        assert status == 0 and "the render goes on from there" in log, log
    finally:
        for process in started:
            process.kill()
    whole = manylights.render(scene, spp=37, seed=5)
    assert np.array(mi.Bitmap(str(tmp_path / "a.exr"))).tobytes() == pixels(whole)
