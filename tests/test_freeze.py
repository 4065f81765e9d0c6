"""Functions that `dr.freeze` records: replays have the bits of renders that are not recorded.

Between two calls lamps and cameras change. An image of what a lamp was before would be a stale one:
the tests show that images differ from the one before, and that a change which cannot be followed is
refused.
"""

import gc

import drjit as dr
import manylights
import mitsuba as mi
import numpy as np
import pytest

from tests import light_scenes
from tests.conftest import require_variant

pytestmark = pytest.mark.usefixtures("llvm", "own_threads")

PLUGINS = ("manylights_direct", "manylights_volpath")


def load(kind="points", **more):
    """A small scene by the name of its lights, with whatever else is given."""
    scene = {**light_scenes.SCENES[kind](), **more}
    scene["sensor"]["film"] |= {"width": 32, "height": 24}
    return mi.load_dict(scene)


def in_fog(kind="points"):
    """A scene within a ball of fog."""
    air = {"type": "homogeneous", "sigma_t": 0.05, "albedo": 0.8}
    ball = {"type": "sphere", "radius": 50.0, "bsdf": {"type": "null"}, "interior": air}
    return load(kind, fog=ball)


def hidden():
    """299 point lights behind a wall, 3 in front of it: visibility is worth to be learnt."""
    return mi.load_dict(manylights.scenes.behind_wall(302, width=64, height=36, spp=64))


def load_integrator(plugin_name, **parameters):
    return mi.load_dict({"type": plugin_name, "learn_visibility": False, **parameters})


def render_function(integrator, spp=8):
    """What is to be recorded."""

    def render(scene, seed):
        return mi.render(scene, integrator=integrator, seed=seed, spp=spp)

    return render


def parameter(scene, name):
    """The first parameter with a name that ends like this."""
    keys = mi.traverse(scene).keys()
    return next(key for key in keys if key.endswith(name))


def change(scene, name, value):
    parameters = mi.traverse(scene)
    parameters[parameter(scene, name)] = value
    parameters.update()


def look_from(height):
    return mi.Transform4f().look_at([0.5, -6.0, height], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0])


def changes(names):
    """Functions that change a scene: one after the other all of the parameters, three times."""
    values = {
        "intensity.value": [mi.Color3f(30.0, 4.0, 1.0), mi.Color3f(1.0, 2.0, 50.0)],
        "radiance.value": [mi.Color3f(90.0, 4.0, 1.0), mi.Color3f(1.0, 2.0, 150.0)],
        ".position": [mi.Point3f(0.0, 0.2, 0.9), mi.Point3f(0.4, -0.5, 1.1)],
        "sensor.to_world": [look_from(3.0), look_from(3.5)],
    }
    for i in (0, 1, 0):
        for name in names:
            yield lambda scene, n=name, i=i: change(scene, n, values[n][i])


def assert_replays(scene, render, names):
    """Frozen and other images are the same after each change, and differ from each other.

    Dr.Jit records anew when a number changes for the first time, and when there are more points
    on lamps in the picture than before, but at last it has all recordings.
    """
    frozen = dr.freeze(render)
    render(scene, mi.UInt32(0))  # builds the tree
    before = np.array(frozen(scene, mi.UInt32(0)))
    for number, apply in enumerate(changes(names), start=1):
        apply(scene)
        found = np.array(frozen(scene, mi.UInt32(number)))
        assert np.array_equal(found, np.array(render(scene, mi.UInt32(number))))
        assert not np.array_equal(found, before)
        assert np.isfinite(found).all() and found.mean() > 0
        before = found
        if number == 2 * len(names):
            recordings = frozen.n_recordings
    assert frozen.n_recordings == recordings


@pytest.mark.parametrize("plugin_name", PLUGINS)
@pytest.mark.parametrize(
    ("make", "names"),
    [
        (load, ["intensity.value", ".position", "sensor.to_world"]),
        (in_fog, ["intensity.value", ".position", "sensor.to_world"]),
        (lambda: load("spheres"), ["radiance.value", "sensor.to_world"]),
        (hidden, ["intensity.value", ".position"]),
    ],
    ids=["points", "fog", "spheres", "hidden"],
)
def test_replays_follow_lamps_and_cameras(plugin_name, make, names):
    assert_replays(make(), render_function(load_integrator(plugin_name)), names)


@pytest.mark.parametrize("plugin_name", PLUGINS)
def test_what_is_learnt_is_recorded(plugin_name):
    integrator = load_integrator(plugin_name, learn_visibility=True)
    assert_replays(hidden(), render_function(integrator, spp=64), ["intensity.value", ".position"])


def test_what_is_not_worth_it_is_as_good_as_forgotten():
    """Nothing is hidden: other images look nothing up, and differ by rounding and its choices."""
    scene, integrator = load(), load_integrator("manylights_direct", learn_visibility=True)
    render = render_function(integrator, spp=128)
    expected = np.array(render(scene, mi.UInt32(1)))
    found = np.array(dr.freeze(render)(scene, mi.UInt32(1)))
    assert (found == expected).mean() > 0.9
    np.testing.assert_allclose(found.mean(), expected.mean(), rtol=1e-3)


@pytest.mark.parametrize("plugin_name", PLUGINS)
def test_the_integrator_of_the_scene(plugin_name):
    """Dr.Jit finds it in the scene."""
    scene = load(integrator={"type": plugin_name, "learn_visibility": False})

    def render(scene, seed):
        return mi.render(scene, seed=seed, spp=8)

    assert_replays(scene, render, ["intensity.value", "sensor.to_world"])


def test_nested_in_another_integrator():
    inner = {"type": "manylights_direct", "learn_visibility": False}
    integrator = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": inner})
    assert_replays(load(), render_function(integrator), ["intensity.value", "sensor.to_world"])


def test_channels_of_surfaces_and_groups():
    integrator = load_integrator(
        "manylights_direct", aovs="a:albedo,i:shape_index", light_groups="all=*"
    )
    assert_replays(load(), render_function(integrator), ["intensity.value", ".position"])


@pytest.mark.parametrize("sampler", ["manylights_sobol", "multijitter"])
def test_samplers(sampler):
    scene = light_scenes.SCENES["points"]()
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": 4}
    integrator = load_integrator("manylights_direct")
    names = ["intensity.value", "sensor.to_world"]
    assert_replays(mi.load_dict(scene), render_function(integrator, spp=4), names)


@pytest.mark.parametrize("plugin_name", PLUGINS)
def test_spectral_variants(plugin_name):
    """Mitsuba's own integrators cannot be recorded there."""
    require_variant("llvm_ad_spectral")
    render = render_function(load_integrator(plugin_name))
    assert_replays(load(), render, [".position", "sensor.to_world"])


@pytest.mark.parametrize("opaque", [False, True])
def test_all_arguments_become_arrays(opaque):
    """Whether Dr.Jit makes arrays of all literals at once or of those that change."""
    scene, render = load("rectangles"), render_function(load_integrator("manylights_direct"))
    frozen = dr.freeze(render, auto_opaque=opaque)
    lamp = parameter(scene, "radiance.value").split(".")[0] + ".to_world"
    render(scene, mi.UInt32(0))
    for number in range(4):
        place = mi.Transform4f().translate([0.1 * number, 0.0, 1.5]).rotate([1, 0, 0], 180)
        change(scene, "radiance.value", mi.Color3f(1.0 + 30.0 * number))
        change(scene, lamp, place.scale(0.2))
        found = np.array(frozen(scene, mi.UInt32(number)))
        assert np.array_equal(found, np.array(render(scene, mi.UInt32(number))))


def test_scenes_in_turn():
    """A recording belongs to the lights of its scene; a scene that is gone does no harm."""
    scenes = [load("points"), load("spots")]
    render = render_function(load_integrator("manylights_direct"))
    frozen = dr.freeze(render)
    expected = [np.array(render(scene, mi.UInt32(1))) for scene in scenes]
    for i in (0, 1, 0, 1, 1, 0):
        assert np.array_equal(np.array(frozen(scenes[i], mi.UInt32(1))), expected[i])
    del scenes[0]
    gc.collect()
    assert np.array_equal(np.array(frozen(scenes[0], mi.UInt32(1))), expected[1])
    scenes.append(load("points"))
    again = np.array(render(scenes[1], mi.UInt32(1)))
    assert np.array_equal(np.array(frozen(scenes[1], mi.UInt32(1))), again)


@pytest.mark.parametrize("plugin_name", PLUGINS)
@pytest.mark.parametrize("name", ["reflectance.value", "intensity.value"])
def test_gradients(plugin_name, name):
    """Of a surface and of a light: those of functions that are not recorded.

    Up to rounding, by which roulette might end other paths: there is none. Derivatives compile a
    kernel for each shadow ray, two are enough.
    """
    depth = {"max_depth": 5} if plugin_name == "manylights_volpath" else {}
    scene, integrator = load(), load_integrator(plugin_name, shadow_rays=2, **depth)
    key = parameter(scene, name)

    def gradient(scene, seed):
        parameters = mi.traverse(scene)
        dr.enable_grad(parameters[key])
        parameters.update()
        image = mi.render(scene, parameters, integrator=integrator, spp=8, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        return dr.grad(parameters[key])

    def prepared(function, value, seed):
        change(scene, name, mi.Color3f(value))
        parameters = mi.traverse(scene)
        dr.enable_grad(parameters[key])
        parameters.update()
        mi.render(scene, integrator=integrator, spp=1)
        return np.array(function(scene, mi.UInt32(seed)))

    frozen = dr.freeze(gradient)
    for number in range(3):
        value = 0.3 + 0.2 * number
        found, expected = (prepared(each, value, number) for each in (frozen, gradient))
        assert np.all(np.abs(expected) > 0)
        np.testing.assert_allclose(found, expected, rtol=1e-4)


# ------------------------------------------------------------------------------- what is refused


def messages(error):
    """The messages of an exception and of its causes."""
    texts = []
    while error is not None:
        texts.append(str(error))
        error = error.__cause__ or error.__context__
    return "\n".join(texts)


def refusal(function, *arguments):
    with pytest.raises(RuntimeError) as raised:
        function(*arguments)
    return messages(raised.value)


@pytest.mark.parametrize("plugin_name", PLUGINS)
def test_a_scene_without_a_tree_is_refused(plugin_name):
    """The message says what to do, and that helps."""
    scene, render = load(), render_function(load_integrator(plugin_name))
    frozen = dr.freeze(render)
    text = refusal(frozen, scene, mi.UInt32(0))
    assert "dr.freeze" in text
    assert "mi.render outside of the frozen function" in text
    expected = np.array(render(scene, mi.UInt32(0)))
    assert np.array_equal(np.array(frozen(scene, mi.UInt32(0))), expected)


def test_lamps_that_change_within_the_function_are_refused():
    """Mitsuba itself refuses to move one there."""
    scene, render = load(), render_function(load_integrator("manylights_direct"))

    def brighten(scene, seed, value):
        change(scene, "intensity.value", mi.Color3f(value))
        return render(scene, seed)

    render(scene, mi.UInt32(0))
    text = refusal(dr.freeze(brighten), scene, mi.UInt32(0), dr.opaque(mi.Float, 3.0))
    assert "lights of the scene have changed within the function" in text
    assert np.isfinite(np.array(render(scene, mi.UInt32(0)))).all()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"learn_visibility": "keep"}, '"learn_visibility" = "keep"'),
        ({"learn_visibility": True, "light_groups": "all=*"}, '"light_groups"'),
    ],
)
def test_learning_that_the_host_reads_is_refused(parameters, words):
    scene = hidden()
    render = render_function(load_integrator("manylights_direct", **parameters), spp=64)
    render(scene, mi.UInt32(0))
    text = refusal(dr.freeze(render), scene, mi.UInt32(0))
    assert words in text
    assert '"learn_visibility" = false' in text
