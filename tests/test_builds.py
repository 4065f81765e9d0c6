"""The build: variants, their names, architectures, and what a missing variant says."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from tests import statistics_tools as tools
from tests import try_wheel

SOURCE = Path(__file__).parents[1]
PLUGINS = sorted(path.stem for path in (SOURCE / "plugins").glob("manylights_*.cpp"))


# ----------------------------------------------------------------- variants that were not compiled

TRY_VARIANTS = """
import json
import drjit as dr
import mitsuba as mi
import manylights

available = {"scalar": True, "llvm": dr.has_backend(dr.JitBackend.LLVM),
             "cuda": dr.has_backend(dr.JitBackend.CUDA)}
messages = {}
for variant in mi.variants():
    if not available[variant.split("_")[0]]:
        continue
    mi.set_variant(variant)
    try:
        mi.load_dict({"type": "manylights_direct"})
        messages[variant] = None
    except RuntimeError as error:
        messages[variant] = str(error)
print(json.dumps(messages))
"""


def run_python(script, *arguments, **environment):
    """Run a script in another process and return the JSON of its last line."""
    process = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    # Mitsuba's log may leave a colour code at the beginning of the line, or on one of its own
    text = re.sub("\x1b\\[[0-9;]*m", "", process.stdout)
    return json.loads(text.strip().splitlines()[-1])


@pytest.mark.usefixtures("plugin")
def test_missing_variant_says_what_to_type():
    """Every variant that was left out is refused with the command that adds it."""
    messages = run_python(TRY_VARIANTS)
    compiled = {variant for variant, message in messages.items() if message is None}
    if len(compiled) == len(messages):
        pytest.skip("every variant that this machine can run was compiled")
    assert "scalar_rgb" in compiled
    for variant in messages.keys() - compiled:
        assert f"not for {variant}. " in messages[variant]
        command = messages[variant].splitlines()[-1].strip()
        assert command.startswith("MANYLIGHTS_VARIANTS=")
        assert command.endswith(f",{variant} pip install .")
        assert compiled <= set(command.split()[0].split("=")[1].split(","))


# ----------------------------------------------------------------------------------- configuration


@pytest.fixture
def cmake():
    """CMake's program, or a skip if a build is not possible here."""
    program = shutil.which("cmake", path=os.pathsep.join([str(bin_folder()), os.environ["PATH"]]))
    if program is None:
        pytest.skip("there is no cmake: type pip install cmake")
    if not any(shutil.which(name) for name in (os.environ.get("CXX", "c++"), "g++", "clang++")):
        pytest.skip("there is no C++ compiler (on Debian: apt install g++)")
    try:
        version("nanobind")
    except PackageNotFoundError:
        pytest.skip("the headers of nanobind are missing: type pip install nanobind==2.14.0")
    return program


def bin_folder():
    """Where pip puts programs: beside Python."""
    return Path(sys.executable).parent


def configure(cmake, folder, *options):
    """Configure the project in a new folder; returns the finished process."""
    ninja = shutil.which("ninja", path=os.pathsep.join([str(bin_folder()), os.environ["PATH"]]))
    generator = ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={ninja}"] if ninja else []
    python = f"-DPython_EXECUTABLE={sys.executable}"
    # The choice of whoever runs the tests must not leak in
    environment = {k: v for k, v in os.environ.items() if k != "MANYLIGHTS_VARIANTS"}
    return subprocess.run(
        [cmake, "-S", SOURCE, "-B", folder, *generator, python, *options],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def configured(cmake, folder, *options):
    """Configure and return CMake's messages and the commands that would compile each file."""
    process = configure(cmake, folder, *options)
    assert process.returncode == 0, process.stdout + process.stderr
    commands = json.loads((Path(folder) / "compile_commands.json").read_text())
    return process.stdout, [entry["command"] for entry in commands]


def test_unknown_variant_is_refused(cmake, tmp_path):
    """The message names the wrong one and all that are allowed."""
    process = configure(cmake, tmp_path, "-DMANYLIGHTS_VARIANTS=scalar_rgb,scalar_rbg")
    assert process.returncode != 0
    message = " ".join(process.stderr.split())
    assert "'scalar_rbg'" in message
    for variant in mi.variants():
        assert variant in message
    assert "'all'" in message


@pytest.mark.parametrize("separator", [",", ";"])
def test_variants_are_compiled_one_by_one(cmake, tmp_path, separator):
    """One translation unit with all plugins for each variant, and no other variant."""
    names = ["scalar_spectral", "llvm_ad_mono"]
    text, commands = configured(cmake, tmp_path, f"-DMANYLIGHTS_VARIANTS={separator.join(names)}")
    assert f"Variants: {', '.join(names)}" in text
    for variant in mi.variants():
        units = [c for c in commands if f"-DMANYLIGHTS_VARIANT={variant} " in c]
        assert len(units) == (variant in names)
    unit = (tmp_path / "all_plugins.cpp").read_text()
    assert sorted(re.findall(r"#include <(manylights_\w+)\.cpp>", unit)) == PLUGINS


def test_flags_on_x86_64(cmake, tmp_path):
    """The instruction set is a part of the wheel's interface between binaries."""
    toolchain = write_toolchain(tmp_path, "x86_64")
    _, commands = configured(cmake, tmp_path / "build", toolchain)
    plugins = [command for command in commands if "-DMANYLIGHTS_VARIANT=" in command]
    assert plugins
    assert all(" -march=haswell " in command for command in plugins)
    assert all(" -Wall " in command and " -Wextra " in command for command in plugins)


def test_flags_on_aarch64(cmake, tmp_path):
    """Another architecture has one baseline: no instruction set is named."""
    toolchain = write_toolchain(tmp_path, "aarch64")
    _, commands = configured(cmake, tmp_path / "build", toolchain)
    assert any("-DMANYLIGHTS_VARIANT=" in command for command in commands)
    assert not any("-march" in command for command in commands)


def write_toolchain(folder, processor):
    """An option for CMake that makes it believe in another processor."""
    path = folder / "toolchain.cmake"
    path.write_text(
        "set(CMAKE_SYSTEM_NAME Linux)\n"
        f"set(CMAKE_SYSTEM_PROCESSOR {processor})\n"
        # Nothing can be run or linked for it: configuring has to do without
        "set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)\n"
    )
    return f"-DCMAKE_TOOLCHAIN_FILE={path}"


# ------------------------------------------------------------------------------------------ wheel

LIBRARIES = ["libmanylights", *PLUGINS]


@pytest.mark.parametrize(
    ("tag", "names", "content", "said"),
    [
        ("py3-none", LIBRARIES, b"\0$ORIGIN\0/s\0 /a/b\0", None),
        ("py3-none", LIBRARIES, b"\0/home/me/site-packages\0", "names ['/home/me/site-packages']"),
        ("cp311-cp311", LIBRARIES, b"", "names a version of Python"),
        ("py3-none", LIBRARIES[1:], b"", "its libraries are"),
        ("py3-none", [*LIBRARIES, "../../_core"], b"", "_core.so is in it"),
        ("py3-none", LIBRARIES, os.urandom(try_wheel.MOST_BYTES), "more than 10 MB"),
    ],
    ids=["good", "place", "tag", "missing", "core", "size"],
)
def test_faults_of_a_wheel_are_found(tmp_path, tag, names, content, said):
    wheel = tmp_path / f"manylights-0.1.0-{tag}-linux_x86_64.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in names:
            folder = "manylights/mitsuba-3.9.1/plugins"
            archive.writestr(os.path.normpath(f"{folder}/{name}.so"), content)
            content = content[:100]
    if said is None:
        try_wheel.look_into(wheel)
        return
    with pytest.raises(SystemExit, match=re.escape(said)):
        try_wheel.look_into(wheel)


# ------------------------------------------------------------------------------------ full builds

RENDER = '''
import json, sys
import drjit as dr
import mitsuba as mi
import manylights
import numpy as np

variant = sys.argv[1]
backend = {"llvm": dr.JitBackend.LLVM, "cuda": dr.JitBackend.CUDA}.get(variant.split("_")[0])
if backend is not None and not dr.has_backend(backend):
    print(json.dumps(None))
    sys.exit()
mi.set_variant(variant)
lights = {f"light_{i}": {"type": "point", "position": [0.1 * i, 0.2, 1 + 0.03 * i]}
          for i in range(30)}
scene = mi.load_dict({
    "type": "scene",
    "floor": {"type": "rectangle"},
    "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(
        [0, -1, 3], [0, 0, 0], [0, 0, 1]), "film": {"type": "hdrfilm", "width": 8, "height": 8}},
    **lights,
})

def means(integrator, seeds):
    """Mean of the first channel for each seed."""
    integrator = mi.load_dict({"type": integrator})
    images = (mi.render(scene, integrator=integrator, spp=64, seed=seed) for seed in seeds)
    return [float(np.array(image)[..., 0].mean()) for image in images]

print(json.dumps({"folder": manylights.plugin_dir(), "ours": means("manylights_direct", range(16)),
                  "reference": means("direct", range(100, 164))}))
'''


@pytest.fixture(scope="module")
def all_variants(tmp_path_factory):
    """A build folder with all variants, compiled once for all of the tests below."""
    folder = tmp_path_factory.mktemp("all-variants")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_all_variants_compile(cmake, all_variants):
    """Thirteen variants, without a warning from this project's code."""
    configured(cmake, all_variants, "-DMANYLIGHTS_VARIANTS=all")
    jobs = os.environ.get("CMAKE_BUILD_PARALLEL_LEVEL", "2")
    process = subprocess.run(
        [cmake, "--build", all_variants, "--parallel", jobs],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stdout[-5000:]
    own = [line for line in process.stdout.splitlines() if f"{SOURCE}{os.sep}" in line]
    assert not [line for line in own if "warning:" in line]


@pytest.mark.slow
@pytest.mark.parametrize("variant", mi.variants())
def test_compiled_variant_renders(all_variants, variant):
    """Each variant that the machine can run renders what Mitsuba does, in a process of its own."""
    package = all_variants / "manylights"
    if not any(package.glob("mitsuba-*/plugins/manylights_direct.*")):
        pytest.skip("the build of all variants has failed or was not selected")
    answer = run_python(RENDER, variant, MANYLIGHTS_PLUGIN_DIR=str(package))
    if answer is None:
        pytest.skip(f"this machine cannot run {variant}")
    assert Path(answer["folder"]) == package.resolve() / f"mitsuba-{mi.__version__}"
    ours, expected = (np.array(answer[key]).reshape(-1, 1, 1, 1) for key in ("ours", "reference"))
    tools.assert_same_mean(ours, expected, bias=0.1, label=variant)
