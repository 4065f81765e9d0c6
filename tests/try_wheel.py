"""Tries a wheel out where there is neither a compiler nor a copy of the repository.

    python tests/try_wheel.py dist/manylights-*.whl

Makes a virtual environment of the Python that runs it, installs the wheel, and lets its commands
render. Also looks into the wheel. Needs nothing but Python.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import venv
import zipfile
from pathlib import Path

#: What the package index may be asked to store
MOST_BYTES = 10_000_000

#: A string in a library that names a place on the machine that built it
PLACE = re.compile(rb"\0((?:/[\w.+-]+){2,}[^\0]*)")

SCENE = """<scene version="3.0.0">
    <integrator type="manylights_direct"/>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="16"/> <integer name="height" value="8"/>
        </film>
        <sampler type="manylights_sobol"/>
        <transform name="to_world">
            <lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
    </sensor>
    <shape type="rectangle"/>
    <emitter type="point"><point name="position" x="0" y="0" z="2"/></emitter>
    <emitter type="point"><point name="position" x="1" y="0" z="2"/></emitter>
</scene>
"""

# Prints the brightest pixel and whether all are numbers
LOOK = """
import sys
import mitsuba as mi
import numpy as np
mi.set_variant("scalar_rgb")
pixels = np.array(mi.Bitmap(sys.argv[1]).convert(mi.Bitmap.PixelFormat.RGB))
print(bool(np.isfinite(pixels).all()) and float(pixels.max()))
"""

VARIANTS = """
import mitsuba as mi
from manylights.cli.version import compiled_variants
assert compiled_variants() == [v for v in mi.variants() if not v.startswith("metal")]
"""

OTHER_MITSUBA = """
import mitsuba
mitsuba.__version__ = "3.8.0"
import manylights
"""


def look_into(wheel: Path) -> None:
    """Check the size of the wheel, the names of its files, and the strings in its libraries."""
    size = wheel.stat().st_size
    print(f"{wheel.name}: {size / 1e6:.2f} MB")
    check(size <= MOST_BYTES, f"it has more than {MOST_BYTES / 1e6:.0f} MB")
    check("-py3-none-" in wheel.name, "its tag names a version of Python")
    with zipfile.ZipFile(wheel) as archive:
        libraries = [name for name in archive.namelist() if name.endswith((".so", ".dylib"))]
        for name in libraries:
            check(re.match(r"manylights/mitsuba-[\d.]+/plugins/", name), f"{name} is in it")
            places = {text.decode(errors="replace") for text in PLACE.findall(archive.read(name))}
            check(not places, f"{name} names {sorted(places)[:5]}")
        names = {Path(name).stem.removeprefix("lib") for name in libraries}
    wanted = {"manylights", "manylights_direct", "manylights_volpath", "manylights_sobol"}
    check(names == wanted, f"its libraries are {sorted(names)}")


class Environment:
    """A virtual environment whose commands find nothing outside of it."""

    def __init__(self, folder: Path):
        self.bin = folder / "environment" / "bin"
        self.folder = folder
        venv.create(self.bin.parent, with_pip=True)

    def run(self, *command: str | Path, path: str = "", fails: bool = False) -> str:
        """Run one of its commands in an empty folder and return what it prints."""
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("MANYL", "PYTHON"))}
        environment["PATH"] = os.pathsep.join(filter(None, [str(self.bin), path]))
        words = [str(self.bin / command[0]), *map(str, command[1:])]
        done = subprocess.run(
            words, cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        shown = f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}"
        check((done.returncode != 0) == fails, shown)
        return done.stderr if fails else done.stdout

    def check_image(self, name: str) -> None:
        """Check that an image has light, and numbers only."""
        answer = self.run("python", "-c", LOOK, name).split()[-1]
        check(answer != "False" and float(answer) > 0.0, f"{name}: brightest pixel {answer}")


def check(holds, otherwise: str) -> None:
    """End with a message unless something holds."""
    if not holds:
        sys.exit(f"try_wheel: {otherwise}")


def main() -> None:
    """Do as the arguments say; ends with status 1 at the first thing that is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument(
        "--variants",
        default="scalar_rgb,llvm_ad_rgb",
        help="those to render with (default: scalar_rgb,llvm_ad_rgb)",
    )
    options = parser.parse_args()
    look_into(options.wheel)
    with tempfile.TemporaryDirectory() as folder:
        here = Environment(Path(folder))
        # pip itself may need programs, as git
        begin = time.perf_counter()
        here.run("pip", "install", options.wheel.resolve(), path=os.environ["PATH"])
        print(f"installed with all that it needs in {time.perf_counter() - begin:.0f} s")
        print(here.run("manylights", "--version", "--verbose").strip())
        plugins = here.run("manylights", "plugin-dir").strip()
        (here.folder / "scene.xml").write_text(SCENE)
        for variant in options.variants.split(","):
            size = ("--width", "64", "--height", "36", "--spp", "4")
            here.run("manylights", "demo", "--lights", "100", *size, "--variant", variant)
            here.check_image("city.exr")
            here.run("mitsuba", "-m", variant, "-a", plugins, "-o", "out.exr", "scene.xml")
            here.check_image("out.exr")
            print(f"{variant}: renders")
        here.run("python", "-c", VARIANTS)
        said = here.run("python", "-c", OTHER_MITSUBA, fails=True).strip().splitlines()[-1]
        check("compiled for Mitsuba" in said and "pip install mitsuba==" in said, said)


if __name__ == "__main__":
    main()
