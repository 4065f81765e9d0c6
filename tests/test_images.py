"""Files that renders leave: channels and attributes, as other programs read them, too."""

import pathlib
import subprocess
import sys
import types

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import cli, files
from manylights.errors import UsageError
from manylights.output import exr, images
from manylights.rendering import metadata
from manylights.rendering.parts import Part

from tests.conftest import require_variant

pytestmark = pytest.mark.usefixtures("plugin", "scalar")


@pytest.fixture
def scalar():
    return require_variant("scalar_rgb")


@pytest.fixture
def planes():
    """Channels of all number formats; rows and columns differ in number."""
    generator = np.random.default_rng(1)
    values = {name: generator.random((5, 7)) for name in ("R", "G", "B", "Z", "normal.X")}
    halves = {name: values[name].astype(np.float16) for name in ("R", "G", "B")}
    data = {name: values[name].astype(np.float32) for name in ("Z", "normal.X")}
    return {**halves, **data, "samples": np.full((5, 7), 4096, np.uint32)}


def scene(**camera):
    """A lamp above a floor, with a film whose format is that of `camera`."""
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0.2, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 12, "component_format": "float16"}
    return {
        "type": "scene",
        "floor": {"type": "rectangle"},
        "lamp": {"type": "point", "position": [0, 0, 1], "intensity": camera.pop("intensity", 1.0)},
        "camera": {"type": "perspective", "fov": 50, "to_world": to_world, "film": film, **camera},
    }


# --------------------------------------------------------------------------------- channels


def test_channels_and_attributes_come_back(planes, tmp_path):
    path = tmp_path / "a.exr"
    told = {"manylights.noise": 0.25, "manylights.seed": 3, "manylights.files": {"a": "1"}}
    exr.write(path, planes, {**told, "chromaticities": metadata.CHROMATICITIES})
    found, attributes = exr.read(path)
    assert set(found) == set(planes)
    for name, plane in planes.items():
        assert found[name].dtype == plane.dtype and (found[name] == plane).all(), name
    assert attributes["manylights.noise"] == 0.25 and attributes["manylights.seed"] == 3
    assert attributes["manylights.files"] == '{"a": "1"}'
    assert attributes["chromaticities"] == pytest.approx(metadata.CHROMATICITIES)
    names, size, header = exr.read_header(path)
    assert set(names) == set(planes) and size == (7, 5) and header["manylights.seed"] == 3


def test_mitsuba_reads_the_channels(planes, tmp_path):
    bitmap = mi.Bitmap(str(exr.write(tmp_path / "a.exr", planes, {"manylights.seed": 3})))
    pixels = np.array(bitmap)
    for index, field in enumerate(bitmap.struct_()):
        # Mitsuba reads all channels in the number format of the first one
        assert pixels[..., index] == pytest.approx(planes[field.name].astype(float), rel=1e-3)


def test_openimageio_reads_the_channels(planes, tmp_path):
    oiio = pytest.importorskip("OpenImageIO")
    path = exr.write(tmp_path / "a.exr", planes, {"manylights.noise": 0.25})
    image = oiio.ImageBuf(str(path))
    assert image.spec().getattribute("manylights.noise") == 0.25
    pixels = image.get_pixels(oiio.FLOAT)
    for index, name in enumerate(image.spec().channelnames):
        # It takes the largest integer for 1
        scale = 2**32 - 1 if planes[name].dtype == np.uint32 else 1
        assert pixels[..., index] * scale == pytest.approx(planes[name].astype(float)), name


@pytest.mark.parametrize("content", [b"", b"no image", "half"])
def test_files_that_are_no_images_are_named(content, planes, tmp_path):
    path = tmp_path / "a.exr"
    if content == "half":
        exr.write(path, planes, {})
        content = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(content)
    reason = "its end is missing|it has no part" if b"channels" in content else "it does not begin"
    with pytest.raises(UsageError, match=rf"a\.exr: not a whole OpenEXR image \(({reason})"):
        exr.read(path)


def test_a_file_that_cannot_be_written_leaves_the_one_before(planes, tmp_path, monkeypatch):
    path = exr.write(tmp_path / "a.exr", planes, {})
    before = path.read_bytes()

    def no_space(partial):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "_flush", no_space)
    with pytest.raises(UsageError, match="No space left"):
        exr.write(path, planes, {"manylights.seed": 1})
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


# ----------------------------------------------------------------------------------- renders


def test_a_render_says_how_it_was_made(tmp_path, capsys):
    path = tmp_path / "a.exr"
    result = manylights.render(scene(), spp=256, until_noise=0.5, output=path, seed=2**32 - 1)
    planes, attributes = exr.read(path)
    assert attributes["manylights.samples"] == result.samples
    assert attributes["manylights.noise"] == pytest.approx(result.noise)
    assert exr.fact(attributes["manylights.seed"]) == 2**32 - 1
    assert "shadow_rays = 16" in attributes["manylights.parameters"]
    for index, name in enumerate("RGB"):
        assert planes[name].dtype == np.float16
        assert (planes[f"variance.{name}"] == result.variance[..., index]).all()
    assert cli.main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    for text in ("16 x 12", "variance.R", "shadow_rays = 16", "scalar_rgb", "worldToNDC"):
        assert text in told


def test_info_of_a_part_is_short(tmp_path, capsys):
    """Without sums and what was learnt, and with the command as it is typed."""
    part = Part(1, 2, command=("render", "a.xml", "-D", "x=1 2"))
    manylights.render(scene(), spp=4, part=part, output=tmp_path / "a.exr")
    assert cli.main(["info", str(tmp_path / "a.part-01-of-02.exr")]) == 0
    told = capsys.readouterr().out
    assert "B, G, R and their sums" in told and "checkpoint_" not in told
    assert "manylights render a.xml -D 'x=1 2'" in told
    assert all(len(line) < 200 for line in told.splitlines())


@pytest.mark.parametrize("pixels", ["rgb", "luminance", "xyz"])
def test_preview_does_not_mind_channels_without_a_dot(tmp_path, pixels):
    """Those of `counts` are in one list with the colours."""
    pictures = []
    for counts in (False, True):
        described = scene()
        described["camera"]["film"]["pixel_format"] = pixels
        integrator = {"type": "manylights_direct", "counts": counts}
        path = tmp_path / f"{counts}.exr"
        manylights.render(described, spp=2, output=path, integrator=integrator)
        pictures.append(np.array(mi.Bitmap(str(path.with_suffix(".png")))))
    assert pictures[0].max() > 0 and (pictures[0] == pictures[1]).all()


@pytest.mark.parametrize("option", ["render", "merge"])
def test_the_preview_alone_gets_brighter(tmp_path, option):
    paths = [tmp_path / "a.exr", tmp_path / "b.exr"]
    for path, stops in zip(paths, (0.0, 2.0)):
        if option == "render":
            manylights.render(scene(), spp=4, output=path, exposure=stops)
        else:
            part = manylights.render(scene(), spp=4, output=path, part=(1, 1)).files
            manylights.merge(part, path, exposure=stops)
    planes = [exr.read(path)[0] for path in paths]
    assert all((planes[0][name] == planes[1][name]).all() for name in planes[0])
    dark, bright = (np.array(mi.Bitmap(str(path.with_suffix(".png")))) for path in paths)
    assert bright.mean() > 1.2 * dark.mean()
    with pytest.raises(UsageError, match=r"exposure 1.0: must be left out with part"):
        manylights.render(scene(), spp=1, exposure=1.0, part=(1, 2))


@pytest.mark.parametrize("kind", ["perspective", "thinlens"])
def test_ndc_of_a_point_is_where_the_camera_sees_it(kind):
    crop = {"crop_width": 8, "crop_height": 5, "crop_offset_x": 3, "crop_offset_y": 2}
    film = {"type": "hdrfilm", "width": 16, "height": 12, **crop}
    lens = {"aperture_radius": 1e-6, "focus_distance": 3.0}
    only = {"perspective": {"principal_point_offset_x": 0.1}, "thinlens": lens}[kind]
    sensor = mi.load_dict(scene(type=kind, film=film, **only)).sensors()[0]
    matrix = metadata.camera_matrices(sensor)["worldToNDC"]
    place = np.array([0.1, 0.3, -0.2])
    x, y, _, w = np.append(place, 1) @ matrix
    ray, _ = sensor.sample_ray(0, 0.5, [x / w, y / w], [0.5, 0.5])
    towards = place - np.array(ray.o).ravel()
    assert np.array(ray.d).ravel() == pytest.approx(towards / np.linalg.norm(towards), abs=1e-5)


def test_halves_that_overflow_are_reported(tmp_path):
    bright = manylights.render(scene(intensity=1e7), spp=1, output=tmp_path / "a.exr")
    assert any("65504" in note and "component_format" in note for note in bright.notes)
    film = {"type": "hdrfilm", "width": 16, "height": 12, "component_format": "float32"}
    fine = manylights.render(scene(intensity=1e7, film=film), spp=1, output=tmp_path / "a.exr")
    assert not any("65504" in note for note in fine.notes)


def test_info_names_files_of_others(tmp_path, capsys):
    path = tmp_path / "other.exr"
    mi.Bitmap(np.zeros((4, 4, 3), np.float32)).write(str(path))
    assert cli.main(["info", str(path)]) == 2
    assert cli.main(["info", str(tmp_path / "none.exr")]) == 2
    told = capsys.readouterr().err
    assert "other.exr: no render of manylights" in told and "none.exr: no such file" in told


@pytest.mark.parametrize("by", ["name", "folder", "link"])
@pytest.mark.parametrize(
    "command",
    [
        ("merge", "a.exr", "b.exr", "-o", "OUT"),
        ("merge", "b.exr", "a.exr", "-o", "OUT", "--partial"),
        ("mix", "a.exr", "key=2", "-o", "OUT"),
        ("compare", "a.exr", "b.exr", "-o", "OUT"),
        ("compare", "b.exr", "b.exr", "--reference", "a.exr", "-o", "OUT"),
        ("report", ".", "-o", "OUT"),
    ],
)
def test_a_file_that_is_read_is_not_written_over(command, by, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (name,) = {"compare": ["a.png"], "report": ["results.json"]}.get(command[0], ["a.exr"])
    content = '{"manylights_bench": 1}' if name == "results.json" else "mine"
    for path in (name, "b.exr"):
        (tmp_path / path).write_text(content)
    out = {"name": name, "folder": f"../{tmp_path.name}/{name}", "link": f"link{name[1:]}"}[by]
    (tmp_path / f"link{name[1:]}").symlink_to(name)
    words = [out if word == "OUT" else word.replace("a.exr", name) for word in command]
    monkeypatch.setattr("manylights.bench.records.load", _nothing_measured)
    assert cli.main(words) == 2
    message = capsys.readouterr().err
    assert f"-o {out}: would overwrite a file that is read" in message
    assert (by == "name") == (f"({name})" not in message) or command[0] == "report"
    assert (tmp_path / name).read_text() == content


def _nothing_measured(folder):
    return types.SimpleNamespace(folder=pathlib.Path(folder))


@pytest.mark.parametrize("name", ["wood.exr", "wood.png"])
def test_a_render_does_not_write_over_a_file_of_its_scene(name, tmp_path):
    texture = tmp_path / name
    pixels = mi.Bitmap(np.full((2, 2, 3), 128, np.uint8 if name[-1] == "g" else np.float32))
    pixels.write(str(texture))
    before = texture.read_bytes()
    path = tmp_path / "scene.xml"
    path.write_text(
        f"""<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/>
        <shape type="rectangle"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
        <string name="filename" value="{name}"/></texture></bsdf></shape></scene>"""
    )
    with pytest.raises(UsageError, match=rf"wood.{name[-3:]}'?: would overwrite a file"):
        manylights.render(str(path), spp=1, output=tmp_path / "wood.exr")
    assert texture.read_bytes() == before


def test_an_image_that_is_its_own_checkpoint_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    manylights.render(scene(), spp=1, output="a.exr", checkpoint=tmp_path / "a.exr")
    assert (tmp_path / "a.exr").is_file()


def test_images_without_a_name_for_layers_are_as_before(tmp_path):
    bitmap = mi.Bitmap(np.ones((4, 4, 3), np.float32))
    written, notes = images.write_images(bitmap, tmp_path / "a.exr")
    assert [path.name for path in written] == ["a.exr", "a.png"] and not notes
    assert (np.array(mi.Bitmap(str(written[0]))) == 1).all()


# ----------------------------------------------------------------------------------- memory

LARGE = """
import resource, sys
import mitsuba as mi, numpy as np
mi.set_variant("scalar_rgb")
from pathlib import Path
from manylights.output import channels, images

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

height, width, count = 2160, 3840, 20
names = ["R", "G", "B"] + [f"layer{number}.X" for number in range(count - 3)]
row = np.linspace(0, 1, width, dtype=np.float32)
bitmap = channels.join(names, np.broadcast_to(row[None, :, None], (height, width, count)))
before = peak()
images.write_images(bitmap, Path(sys.argv[1]), number=np.float16, samples=4)
print((peak() - before) / (4 * height * width * count))
"""


@pytest.mark.slow
def test_large_files_take_two_copies_of_their_pixels(tmp_path):
    """3840 x 2160 pixels with 20 layers: beside the image, as the documentation says."""
    path = tmp_path / "large.exr"
    command = [sys.executable, "-c", LARGE, str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert float(done.stdout) < 2.2
    names, size, _ = exr.read_header(path)
    assert size == (3840, 2160) and len(names) == 21
