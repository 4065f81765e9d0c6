"""A file with layers in four readers: OpenEXR, OpenImageIO, Mitsuba and Blender.

Blender is tested where bpy can be imported, or where the environment variable
MANYLIGHTS_TEST_BLENDER names a Python that can.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import manylights
import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import require_variant
from tests.test_aovs import objects

pytestmark = pytest.mark.usefixtures("plugin")

NAMES = "albedo,normal,position,depth,uv,shape_index"
LAYERS = {"albedo": "RGB", "normal": "XYZ", "P": "XYZ", "uv": "UV", "shape_index": "I"}
CHANNELS = ["R", "G", "B", "Z", "samples"]
CHANNELS += [f"{name}.{letter}" for name, letters in LAYERS.items() for letter in letters]


@pytest.fixture(scope="module", params=["float16", "float32"])
def written(request, tmp_path_factory):
    """A file, and the image in memory by the names of its channels."""
    require_variant("scalar_rgb")
    description = objects()
    description["camera"]["film"] |= {"component_format": request.param}
    path = tmp_path_factory.mktemp(request.param) / "a.exr"
    result = manylights.render(description, output=path, spp=3, aovs=NAMES)
    names = [field.name.replace("Z.T", "Z") for field in result.bitmap.struct_()]
    planes = dict(zip(names, np.moveaxis(result.image, 2, 0)))
    planes["samples"] = np.full(result.image.shape[:2], 3.0)
    assert set(planes) == set(CHANNELS)
    return path, planes


def assert_same(found, planes, halves=("R", "G", "B")):
    """Colours to the precision of 16 bits, all else to that of 32."""
    assert set(found) == set(planes)
    for name, plane in planes.items():
        limits = {"rtol": 1e-3, "atol": 1e-6} if name in halves else {"rtol": 1e-6}
        np.testing.assert_allclose(found[name], plane, err_msg=name, **limits)


def test_openexr(written):
    import OpenEXR

    path, planes = written
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert len(file.parts) == 1
        header = file.header()
        assert header["type"] == OpenEXR.scanlineimage
        assert header["compression"] == OpenEXR.ZIP_COMPRESSION
        found = {name: channel.pixels for name, channel in file.channels().items()}
        assert "aovs = albedo:albedo, normal:sh_normal" in header["manylights.parameters"]
        assert header["manylights.samples"] == 3
    assert_same(found, planes)
    colors = (path.parent.name.startswith("float16") and np.float16) or np.float32
    assert {found[name].dtype.type for name in "RGB"} == {colors}
    assert all(found[name].dtype == np.float32 for name in CHANNELS[3:])


def test_openimageio(written):
    oiio = pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed")
    path, planes = written
    image = oiio.ImageBuf(str(path))
    assert image.nsubimages == 1 and image.spec().getattribute("manylights.samples") == 3
    pixels = image.get_pixels(oiio.FLOAT)
    assert_same(dict(zip(image.spec().channelnames, np.moveaxis(pixels, 2, 0))), planes)


def test_mitsuba(written):
    path, planes = written
    bitmap = mi.Bitmap(str(path))
    pixels = np.moveaxis(np.array(bitmap), 2, 0)
    # It reads all channels in the number format of the first
    halves = CHANNELS if path.parent.name.startswith("float16") else ()
    assert_same(dict(zip([field.name for field in bitmap.struct_()], pixels)), planes, halves)
    assert bitmap.metadata()["manylights.samples"] == 3


def blender():
    """A Python that has bpy."""
    named = os.environ.get("MANYLIGHTS_TEST_BLENDER")
    if named or importlib.util.find_spec("bpy"):
        return named or sys.executable
    return pytest.skip("bpy is not installed, and MANYLIGHTS_TEST_BLENDER is not set")


def test_blender(written, tmp_path):
    import OpenEXR

    python, (path, planes) = blender(), written
    script = Path(__file__).with_name("blender_layers.py")
    height, width = planes["R"].shape
    command = [python, script, path, tmp_path, width, height]
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run(list(map(str, command)), check=True, env=env, timeout=300, capture_output=True)
    found = {}
    for name, letters in {**LAYERS, "Combined": "RGB", "Depth": "Z", "samples": "s"}.items():
        with OpenEXR.File(str(tmp_path / f"{name}.exr"), separate_channels=True) as file:
            channels = file.channels()
            for letter, slot in zip(letters, "RGB"):
                known = {"Combined": letter, "Depth": "Z", "samples": "samples"}
                found[known.get(name, f"{name}.{letter}")] = channels[slot].pixels
    assert_same(found, planes)
