"""Bad input gets a message with the object, the value and what is allowed; nothing is just ignored.

Ranges and types of the parameters of `manylights_direct` are in `test_scene_updates.py`, wrong
options of the command in `test_cli.py`, variants that were not compiled in `test_builds.py`.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from manylights._plugins import PLUGINS
from manylights.errors import one_line

from tests import light_scenes
from tests.conftest import NO_INFINITY
from tests.light_scenes import rgb, transform

pytestmark = pytest.mark.usefixtures("plugin")

SOURCE = Path(__file__).parents[1]
POINTS = SOURCE / "scenes" / "points.xml"
INTEGRATORS = ["manylights_direct", "manylights_volpath"]


# -------------------------------------------------------------------------------------- parameters


def refusal(load):
    """The message with which something is refused, on one line."""
    with pytest.raises(RuntimeError) as raised:
        load()
    return one_line(raised.value)


def from_dict(plugin, parameters):
    """What is said about parameters in Python."""
    return refusal(lambda: mi.load_dict({"type": plugin, **parameters}))


def from_xml(text):
    """What is said about a scene in XML."""
    return refusal(lambda: mi.load_string(f'<scene version="3.0.0">{text}</scene>'))


FAILED = (
    'At dictionary node "root": failed to instantiate integrator plugin of type '
    '"manylights_volpath": '
)
UNKNOWN = (
    'While loading dictionary node "root": Found 1 unreferenced property in integrator plugin of '
    'type "manylights_volpath": - '
)
REFUSED = [
    (
        {"splitting_rate": -0.5},
        FAILED + 'manylights_volpath: the parameter "splitting_rate" is -0.500000, but must be a '
        'number >= 0 or "inf".',
    ),
    (
        {"reservoirs": 2**40},
        FAILED + 'manylights_volpath: the parameter "reservoirs" is 1099511627776, but must be an '
        "integer from 1 to 64.",
    ),
    (
        {"reservoirs": 3, "shadow_rays": 4},
        FAILED + 'manylights_volpath: the parameter "shadow_rays" is 4, but must be an integer '
        "from 1 to 3.",
    ),
    (
        {"reservoirs": float("nan")},
        FAILED + 'The property "reservoirs" has the wrong type (expected integer, got float)',
    ),
    (
        {"method": "tree", "shadow_rays": 2},
        FAILED + 'manylights_volpath: the parameter "shadow_rays" is given, but must be left out '
        'where "method" is "tree".',
    ),
    (
        {"split_function": "far"},
        FAILED + 'manylights_volpath: the parameter "split_function" is "far", but must be left '
        'out unless "method" is "talk".',
    ),
    (
        {"max_depth": 2.5},
        FAILED + 'The property "max_depth" has the wrong type (expected integer, got float)',
    ),
    (
        {"max_depth": 2**40},
        FAILED + 'Property "max_depth": value 1099511627776 is out of bounds, must be in the '
        "range [-2147483648, 2147483647]",
    ),
    ({"bsdf_samples": 1}, UNKNOWN + 'integer "bsdf_samples": 1'),
    ({"shading_samples": 4}, UNKNOWN + 'integer "shading_samples": 4'),
]


@pytest.mark.parametrize(
    ("parameters", "message"), REFUSED, ids=[str(parameters) for parameters, _ in REFUSED]
)
def test_message_about_a_parameter_of_paths(scalar, parameters, message):
    """The whole text: which plugin, which parameter, its value and what is allowed."""
    assert from_dict("manylights_volpath", parameters) == message


def test_most_bsdf_samples_are_named(scalar):
    """A number that would never finish is refused with the limit."""
    message = from_dict("manylights_direct", {"bsdf_samples": 2**33})
    assert message.endswith(
        'manylights_direct: the parameter "bsdf_samples" is 8589934592, but must be an integer '
        "from 0 to 1024."
    )


MISTAKES_IN_XML = [
    ('<float name="reservoirs" value="3"/>', '"reservoirs" has the wrong type (expected integer'),
    ('<string name="shadow_rays" value="3"/>', '"shadow_rays" has the wrong type (expected int'),
    ('<integer name="reservoirs" value="nan"/>', 'could not parse integer value "nan"'),
    ('<float name="splitting_rate" value="nan"/>', '"splitting_rate" is nan, but must be a number'),
    ('<integer name="reservoirs" value="0"/>', '"reservoirs" is 0, but must be an integer from 1'),
    ('<string name="method" value="fast"/>', '"method" is "fast", but must be "resampled_tree" or'),
    ('<boolean name="splits" value="true"/>', "Found 1 unreferenced property in integrator plugin"),
]


@pytest.mark.parametrize("plugin", INTEGRATORS)
@pytest.mark.parametrize(("text", "words"), MISTAKES_IN_XML)
def test_mistake_in_xml_is_refused_with_its_place(scalar, plugin, text, words):
    """The message also has the line and the column."""
    message = from_xml(f'\n<integrator type="{plugin}">{text}</integrator>')
    assert words in message
    assert "string (line 2, col " in message


@pytest.mark.parametrize("value", ["inf", "1e39"])
def test_rate_beyond_single_precision_is_infinite(scalar, value):
    """More than single precision holds means every light, as `inf` does."""
    rate = f'<float name="splitting_rate" value="{value}"/>'
    integrator = f'<integrator type="manylights_direct">{rate}</integrator>'
    scene = mi.load_string(f'<scene version="3.0.0">{integrator}</scene>')
    assert "splitting_rate = inf" in str(scene.integrator())


# ----------------------------------------------------------------- the same as Mitsuba's plugins do

NESTED = {"type": "diffuse"}
LIKE_PATH = [
    {"max_depth": -2},
    {"max_depth": "4"},
    {"rr_depth": 0},
    {"hide_emitters": 1},
    {"emitter_samples": 2},
    {"nested": NESTED},
]


@pytest.mark.parametrize("parameters", LIKE_PATH, ids=str)
def test_mistake_is_refused_as_by_path(scalar, parameters):
    """What Mitsuba's base classes check has their text, with the name of this plugin."""
    message = from_dict("manylights_volpath", parameters)
    assert message.replace("manylights_volpath", "path") == from_dict("path", parameters)
    assert any(f'"{name}"' in message for name in parameters)


PLACES_IN_XML = {
    "bsdf": '<bsdf type="{}"/>',
    "emitter": '<emitter type="{}"/>',
    "shape": '<shape type="{}"/>',
    "sensor": '<sensor type="{}"/>',
    "film": '<sensor type="perspective"><film type="{}"/></sensor>',
    "in a shape": '<shape type="sphere"><integrator type="{}"/></shape>',
    "in an emitter": '<emitter type="constant"><integrator type="{}"/></emitter>',
    "in another": '<integrator type="depth"><integrator type="{}"/></integrator>',
    "twice": '<integrator type="{0}"/><integrator type="{0}"/>',
}


@pytest.mark.parametrize("plugin", INTEGRATORS)
@pytest.mark.parametrize("text", PLACES_IN_XML.values(), ids=PLACES_IN_XML)
def test_wrong_place_in_xml_is_refused_as_for_path(scalar, plugin, text):
    """An integrator that is given out for another object, or is where none belongs."""
    message, expected = from_xml(text.format(plugin)), from_xml(text.format("path"))
    # What follows is a description of the integrator
    known = expected.partition(": PathIntegrator[")[0]
    assert message.partition(": ManyLights")[0].replace(plugin, "path") == known
    assert plugin in message or "ManyLights" in message or "one integrator" in message


def test_integrator_as_bsdf_is_named(scalar):
    """The whole text of one of these."""
    assert from_xml('<bsdf type="manylights_direct"/>').endswith(
        'Type mismatch: the instantiated plugin "manylights_direct" is of type "integrator", '
        'which does not match the expected type "bsdf".'
    )


@pytest.mark.parametrize("plugin", INTEGRATORS)
@pytest.mark.parametrize("place", ["bsdf", "emitter", "interior"])
def test_wrong_place_in_a_dictionary_is_refused(scalar, plugin, place):
    """A shape does not know what to do with an integrator."""
    ball = {"type": "sphere", place: {"type": plugin}}
    message = refusal(lambda: mi.load_dict({"type": "scene", "ball": ball}))
    assert message.startswith(
        'While loading dictionary node "ball": Found 1 unreferenced property in shape plugin of '
        f'type "sphere": - object "{place}": ManyLights'
    )


# ----------------------------------------------------------------------------- lights without sense


@pytest.fixture
def warnings():
    """The warnings of Mitsuba's log while the test runs, as a list that grows."""
    texts = []

    class Receiver(mi.Appender):
        """Keeps what is said."""

        def append(self, level, text):
            if level >= mi.LogLevel.Warn:
                texts.append(" ".join(text.split()))

        def log_progress(self, progress, name, formatted, eta, ptr=None):
            pass

    before, logger = mi.logger(), mi.Logger(mi.LogLevel.Warn)
    logger.set_formatter(before.formatter())
    logger.add_appender(Receiver())
    mi.set_logger(logger)
    yield texts
    mi.set_logger(before)


NAN, INF = float("nan"), float("inf")
TRIANGLES = np.array([[[0, 0, 5], [0, 0.3, 5], [0.3, 0, 5]], [[1, 0, 5], [1, 0.3, 5], [1.3, 0, 5]]])

FACE_COLOURS = {"type": "mesh_attribute", "name": "face_color"}


def down():
    """To above all other lights, looking down."""
    return transform().translate([0, 0, 5]).rotate([1, 0, 0], 180).scale(0.3)


def point(intensity=(1, 1, 1), position=(0, 0, 5)):
    """A point light."""
    return {"type": "point", "position": list(position), "intensity": rgb(intensity)}


def spot(intensity=(1, 1, 1), **parameters):
    """A spot light."""
    return {"type": "spot", "to_world": down(), "intensity": rgb(intensity), **parameters}


def shape(kind, radiance, to_world=None):
    """An area light."""
    emitter = light_scenes.area(rgb(radiance))
    return {"type": kind, "to_world": to_world or down(), "emitter": emitter}


def mesh(changed, value):
    """Two triangles; one coordinate of the first one, or its colour, is changed."""
    triangles, colours = TRIANGLES.copy(), np.ones((2, 3))
    if changed == "vertex":
        triangles[0, 1, 0] = value
    elif changed == "colour":
        colours[0] = value
    else:
        triangles[0] = triangles[0, 0]
    return light_scenes.make_mesh(triangles, FACE_COLOURS, colours, name="light")


def texture(value):
    """A rectangle with a bitmap of one bad texel."""
    pixels = np.ones((4, 4, 3), np.float32)
    pixels[1, 1] = value
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    return {"type": "rectangle", "to_world": down(), "emitter": light_scenes.area(radiance)}


def directional(irradiance):
    """A light from above."""
    return {"type": "directional", "direction": [0, 0, -1], "irradiance": rgb(irradiance)}


INVALID = {
    "point of nan": (lambda: point((NAN, 1, 1)), 1),
    "point of inf": (lambda: point((1, INF, 1)), 1),
    "negative point": (lambda: point((-1, -1, -1)), 1),
    "point at nan": (lambda: point(position=(0, NAN, 5)), 1),
    "point at inf": (lambda: point(position=(0, 0, INF)), 1),
    "point of too much power": (lambda: point((1e38, 1e38, 1e38)), 1),
    "spot of nan": (lambda: spot((NAN, 1, 1)), 1),
    "negative spot": (lambda: spot((-1, -1, -1)), 1),
    "spot with an angle of nan": (lambda: spot(cutoff_angle=NAN), 1),
    "rectangle of nan": (lambda: shape("rectangle", (NAN, 1, 1)), 2),
    "negative rectangle": (lambda: shape("rectangle", (-1, -1, -1)), 2),
    "sphere of inf": (lambda: shape("sphere", (INF, 1, 1)), 1),
    "disk of nan": (lambda: shape("disk", (1, NAN, 1)), 1),
    "negative cylinder": (lambda: shape("cylinder", (-1, -1, -1)), 1),
    "vertex of nan": (lambda: mesh("vertex", NAN), 1),
    "vertex of inf": (lambda: mesh("vertex", INF), 1),
    "face of nan": (lambda: mesh("colour", NAN), 1),
    "face of -1": (lambda: mesh("colour", -1), 1),
    "texel of nan": (lambda: texture(NAN), 2),
    "directional of nan": (lambda: directional((NAN, 1, 1)), 1),
}
HARMLESS = {
    "black point": lambda: point((0, 0, 0)),
    "spot of no angle": lambda: spot(cutoff_angle=0.0, beam_width=0.0),
    "black rectangle": lambda: shape("rectangle", (0, 0, 0)),
    "disk without area": lambda: shape("disk", (1, 1, 1), transform().scale([0, 1, 1])),
    "triangle without area": lambda: mesh("area", 0),
}


def lit_scene(light=None):
    """Twenty points above a floor, seen from above, with another light above them."""
    scene = light_scenes.stage(block=False)
    scene["sensor"]["film"] |= {"width": 4, "height": 4}
    del scene["ball"]
    for index in range(20):
        scene[f"point_{index}"] = point((0.1, 0.2, 0.1), (0.1 * index - 1, 0.3, 2))
    if light is not None:
        scene["light"] = light
    return mi.load_dict(scene)


def rendered(scene, plugin):
    """An image and the integrator that made it.

    Without learning: its cells are sized by the scene's box, which bad places change, too.
    """
    parameters = {"max_depth": 2} if plugin == "manylights_volpath" else {"bsdf_samples": 0}
    integrator = mi.load_dict({"type": plugin, "learn_visibility": False, **parameters})
    return np.array(mi.render(scene, integrator=integrator, spp=4, seed=3)), integrator


both_variants = pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)


def without(name):
    """The scene without the light, or with what is left of it: the mesh's second triangle."""
    in_mesh = name.startswith(("vertex", "face", "triangle"))
    rest = light_scenes.make_mesh(TRIANGLES[1:], FACE_COLOURS, np.ones((1, 3)), name="light")
    return lit_scene(rest if in_mesh else None)


@both_variants
@pytest.mark.parametrize("name", INVALID)
def test_light_without_sense_is_named(variant, warnings, name):
    """A warning counts such lights and names the first; the image is that of the others."""
    light, count = INVALID[name]
    scene = lit_scene(light())
    warnings.clear()
    image, integrator = rendered(scene, "manylights_direct")
    total = int(np.ravel(mi.traverse(integrator)["lights"])[0])
    (text,) = (text for text in warnings if "never chosen" in text)
    assert text.endswith(
        f"Lights that are never chosen: {count} of {total}. Their power must not be negative, and "
        'power and position must be finite. The first one belongs to "light".'
    )
    if name == "vertex of inf" and variant.startswith("cuda"):
        pytest.skip(NO_INFINITY)
    assert np.array_equal(image, rendered(without(name), "manylights_direct")[0])


@pytest.mark.parametrize("name", HARMLESS)
def test_dark_lights_are_no_mistake(scalar, warnings, name):
    """No power and no area are allowed, and change nothing."""
    scene = lit_scene(HARMLESS[name]())
    warnings.clear()
    image, _ = rendered(scene, "manylights_direct")
    assert warnings == []
    assert np.array_equal(image, rendered(without(name), "manylights_direct")[0])


def test_paths_warn_of_lights_without_sense(scalar, warnings):
    """The same in the path tracer."""
    image, _ = rendered(lit_scene(point((NAN, 1, 1))), "manylights_volpath")
    assert len([text for text in warnings if "never chosen: 1 of 21" in text]) == 1
    assert np.array_equal(image, rendered(lit_scene(), "manylights_volpath")[0])


# ----------------------------------------------------------------------- other Mitsubas, no libLLVM


def python(script, *arguments, **environment):
    """Run a script in a new process at the top of the sources."""
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        cwd=SOURCE,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def last_line(process):
    """What a failing process says at last."""
    assert process.returncode != 0
    return process.stderr.strip().splitlines()[-1]


IMPORT = "import sys, types; mitsuba = types.ModuleType('mitsuba'); {}; import manylights"


@pytest.mark.parametrize("version", ["3.8.0", "3.9.10", "3.10.0"])
def test_another_mitsuba_is_refused_with_the_command(version):
    """The import says which release is needed, which one is there and what to type."""
    other = f"mitsuba.__version__ = '{version}'; sys.modules['mitsuba'] = mitsuba"
    assert last_line(python(IMPORT.format(other))) == (
        f"ImportError: manylights is compiled for Mitsuba 3.9.1, but Mitsuba {version} is "
        "installed. Get the matching one with: pip install mitsuba==3.9.1"
    )


RELEASES = """
import manylights, mitsuba
for mitsuba.__version__ in ("3.9.1", "3.10.0"):
    print(manylights.plugin_dir())
mitsuba.__version__ = "3.11.0"
manylights.plugin_dir()
"""


def test_plugins_of_the_installed_mitsuba_are_chosen(tmp_path):
    """Of several releases in one package; one that is not there is refused, naming those."""
    for release in ("3.10.0", "3.9.1"):
        folder = tmp_path / f"mitsuba-{release}" / "plugins"
        folder.mkdir(parents=True)
        for name in PLUGINS:
            (folder / f"{name}.so").write_bytes(b"")
    process = python(RELEASES, MANYLIGHTS_PLUGIN_DIR=str(tmp_path))
    assert process.stdout.split() == [str(tmp_path / f"mitsuba-{r}") for r in ("3.9.1", "3.10.0")]
    assert last_line(process) == (
        "ImportError: manylights is compiled for Mitsuba 3.9.1 and 3.10.0, but Mitsuba 3.11.0 is "
        "installed. Get the matching one with: pip install mitsuba==3.10.0"
    )


EDITABLE = """
import os, sys, sysconfig, manylights
os.environ.pop("MANYLIGHTS_PLUGIN_DIR", None)
manylights.__path__ = [sys.argv[1]]
sysconfig.get_path = lambda name: sys.argv[2]
print(manylights.plugin_dir())
"""


def test_plugins_of_an_editable_installation_are_found(tmp_path):
    """Sources in one folder, plugins where packages are installed."""
    folder = tmp_path / "manylights" / f"mitsuba-{mi.__version__}"
    (folder / "plugins").mkdir(parents=True)
    for name in PLUGINS:
        (folder / "plugins" / f"{name}.so").write_bytes(b"")
    process = python(EDITABLE, str(tmp_path / "sources"), str(tmp_path))
    assert process.stdout.strip() == str(folder), process.stderr


def test_missing_mitsuba_is_refused_with_the_command():
    """The import says what to type."""
    process = python(IMPORT.format("sys.modules['mitsuba'] = None"))
    assert last_line(process) == (
        "ImportError: manylights needs Mitsuba. Install it with: pip install mitsuba==3.9.1"
    )


LOAD = """
import mitsuba, manylights
mitsuba.set_variant("scalar_rgb")
mitsuba.load_dict({"type": "manylights_direct"})
"""
OTHER_BUILD = """
#include <string>
namespace mitsuba { namespace util {
std::string info_build(int) { return BUILD; }
} }
"""


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (
            "Mitsuba version 3.9.10 (master, Linux, 64bit, 2 threads, 8-wide SIMD)",
            ("was compiled for Mitsuba 3.9.1 and", 'pip install "mitsuba==3.9.1"'),
        ),
        (
            "Mitsuba version 3.9.1 (master, Linux, 64bit, 2 threads, 18-wide SIMD)",
            ("the Mitsuba wheel, with 8-wide SIMD,", "pip install --force-reinstall --no-deps"),
        ),
    ],
    ids=["version", "SIMD"],
)
def test_plugin_refuses_a_mitsuba_of_another_build(tmp_path, build, words):
    """A library that is loaded first lets Mitsuba tell another version, or other packets."""
    compiler = shutil.which(os.environ.get("CXX", "c++")) or shutil.which("g++")
    if compiler is None or sys.platform != "linux":
        pytest.skip("needs a C++ compiler, and Linux to load a library first")
    source, library = tmp_path / "build.cpp", tmp_path / "build.so"
    source.write_text(f"#define BUILD {build!r}\n".replace("'", '"') + OTHER_BUILD)
    subprocess.run([compiler, "-shared", "-fPIC", source, "-o", library], check=True)
    process = python(LOAD, LD_PRELOAD=str(library))
    message = " ".join(process.stderr.split())
    assert process.returncode != 0
    for word in (*words, build):
        assert word in message


def test_command_does_without_libllvm(tmp_path):
    """Without it `render` takes a scalar variant, and says so."""
    output = tmp_path / "out.exr"
    process = command("render", POINTS, "-o", output, "--spp", 1, "-D", "resx=8", "-D", "resy=8")
    assert process.returncode == 0, process.stderr
    assert "variant: scalar_rgb (no usable libLLVM found)" in process.stderr
    assert output.exists()


@pytest.mark.parametrize("name", ["render", "tree"])
def test_missing_libllvm_says_what_to_install(tmp_path, name):
    """A variant that was asked for and cannot run."""
    output = ("-o", tmp_path / "out.exr") if name == "render" else ()
    process = command(name, POINTS, *output, "--variant", "llvm_ad_rgb")
    assert process.returncode == 2
    assert process.stderr.strip().splitlines()[-1] == (
        "manylights: --variant llvm_ad_rgb: needs LLVM 17 or later (on Debian: libllvm19); "
        "a scalar variant does without"
    )


def command(*arguments):
    """Run `manylights` where there is no libLLVM."""
    return subprocess.run(
        [sys.executable, "-m", "manylights", *map(str, arguments)],
        env={**os.environ, "DRJIT_LIBLLVM_PATH": "/nonexistent"},
        capture_output=True,
        text=True,
        check=False,
    )


# ----------------------------------------------------------------------------- broken installations


#: Folder of the plugins for the Mitsuba that is installed
RELEASE = f"mitsuba-{mi.__version__}"


@pytest.mark.parametrize("present", [[], *([name] for name in PLUGINS)], ids=str)
def test_incomplete_folder_of_plugins_is_named(tmp_path, present):
    """The folder, the variable that chose it, what is missing and what to type."""
    folder = tmp_path / RELEASE / "plugins"
    folder.mkdir(parents=True)
    for name in present:
        (folder / f"{name}.so").write_bytes(b"")
    missing = ", ".join(name for name in PLUGINS if name not in present)
    assert last_line(python("import manylights", MANYLIGHTS_PLUGIN_DIR=str(tmp_path))) == (
        f"ImportError: manylights: MANYLIGHTS_PLUGIN_DIR={tmp_path}: compiled plugins are missing "
        f"(no {missing} in {folder}). Build them with: pip install --force-reinstall --no-deps "
        "manylights, or in a checkout: pip install -e ."
    )


def test_file_that_is_no_plugin_is_named(tmp_path):
    """Mitsuba's message has the file and the reason."""
    folder = tmp_path / RELEASE / "plugins"
    folder.mkdir(parents=True)
    for name in PLUGINS:
        (folder / f"{name}.so").write_text("text")
    process = python(LOAD, MANYLIGHTS_PLUGIN_DIR=str(tmp_path))
    assert f'Error while loading plugin "{folder}/manylights_direct.so"' in process.stderr
    assert process.returncode == 1
