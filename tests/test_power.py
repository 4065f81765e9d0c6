"""Power sampling of Mitsuba's emitters: weights from closed forms, probabilities that follow."""

import manylights
import mitsuba as mi
import numpy as np
import pytest
from manylights import power


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def square(radiance, size=1.0):
    """A square of side 2 `size` that emits to one side."""
    to_world = mi.ScalarTransform4f().translate([0, 0, 5]).scale(size)
    emitter = {"type": "area", "radiance": radiance}
    return {"type": "rectangle", "to_world": to_world, "emitter": emitter}


def point(*intensity):
    return {"type": "point", "position": [0, 0, 3], "intensity": rgb(*intensity)}


def load(**emitters):
    """A floor with emitters; Mitsuba orders emitters in its own way."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)}
    return mi.load_dict({"type": "scene", "floor": floor, **emitters})


@pytest.fixture(params=["scalar_rgb", "llvm_ad_rgb"])
def each_variant(request):
    from tests.conftest import require_variant

    return require_variant(request.param)


@pytest.fixture
def probabilities():
    """A function that returns the probability of each emitter of a scene."""

    def run(scene):
        return np.array([np.ravel(scene.pdf_emitter(i))[0] for i in range(len(scene.emitters()))])

    return run


def test_powers_of_points_and_squares_are_those_of_the_textbook(each_variant):
    scene = load(a=point(1, 2, 3), b=point(10, 10, 10), c=square(rgb(1, 1, 4), 0.5))
    powers = sorted(power._emitter_powers(scene))
    expected = [np.pi * 2.0, 4 * np.pi * 2.0, 4 * np.pi * 10.0]
    np.testing.assert_allclose(powers, expected, rtol=1e-4)


def test_power_of_a_spot_is_the_integral_over_its_cone(each_variant):
    cutoff, beam = np.radians(40.0), np.radians(20.0)
    spot = {"type": "spot", "intensity": rgb(2, 2, 2), "cutoff_angle": 40.0, "beam_width": 20.0}
    angle = (np.arange(4000) + 0.5) / 4000 * cutoff
    falloff = np.clip((cutoff - angle) / (cutoff - beam), 0.0, 1.0)
    expected = np.sum(2.0 * falloff * 2 * np.pi * np.sin(angle)) * cutoff / 4000
    assert power._emitter_powers(load(a=spot))[0] == pytest.approx(expected, rel=0.03)


def test_texture_counts_with_its_mean(each_variant):
    pixels = np.zeros((4, 4, 3), dtype=np.float32)
    pixels[0, 0] = 16.0
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}
    powers = power._emitter_powers(load(a=square(texture)))
    assert powers[0] == pytest.approx(4 * np.pi, rel=0.1)


def test_environment_counts_with_what_enters_the_bounding_sphere(each_variant):
    scene = load(a=point(1, 1, 1), b={"type": "constant", "radiance": rgb(2, 2, 2)})
    radius_squared = 2.0**2 + 2.0**2
    expected = [4 * np.pi, 4 * np.pi**2 * radius_squared * 2.0]
    np.testing.assert_allclose(sorted(power._emitter_powers(scene)), expected, rtol=0.01)


def test_mitsuba_follows_the_weights_and_gets_its_own_back(each_variant, probabilities):
    lights = {f"p{i}": point(i + 1, i + 1, i + 1) for i in range(4)}
    scene = load(**lights)
    with manylights.power_sampling(scene):
        inside = probabilities(scene)
    np.testing.assert_allclose(sorted(inside), np.array([1, 2, 3, 4]) / 10, rtol=1e-4)
    np.testing.assert_allclose(probabilities(scene), 0.25, rtol=1e-6)


def test_samples_of_emitters_have_the_frequencies(llvm):
    scene = load(a=point(1, 1, 1), b=point(9, 9, 9))
    with manylights.power_sampling(scene):
        numbers = (mi.Float(np.arange(1000)) + 0.5) / 1000
        index, _, _ = scene.sample_emitter(numbers)
        expected = np.array(scene.pdf_emitter(mi.UInt32([0, 1])))
    found = np.bincount(np.array(index), minlength=2) / 1000
    np.testing.assert_allclose(found, expected, atol=2e-3)
    np.testing.assert_allclose(sorted(expected), [0.1, 0.9], rtol=1e-4)


def test_weights_of_the_scene_are_restored_after_an_error(each_variant, probabilities):
    scene = load(a={**point(1, 1, 1), "sampling_weight": 3.0}, b=point(5, 5, 5))
    before = probabilities(scene)
    with pytest.raises(ZeroDivisionError), manylights.power_sampling(scene):
        raise ZeroDivisionError
    np.testing.assert_allclose(probabilities(scene), before)
    assert sorted(before) == pytest.approx([0.25, 0.75])


@pytest.mark.parametrize(
    "weights", [[1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], [1.0, np.nan], [-1.0, 2.0], [0, 0], "ab", 1.0]
)
def test_weights_of_other_scenes_are_refused(scalar, probabilities, weights):
    scene = load(a=point(1, 1, 1), b=point(2, 2, 2))
    before = probabilities(scene)
    words = "must be 2 finite numbers of at least 0, one for each emitter, not all of them 0"
    with pytest.raises(ValueError, match=words), manylights.power_sampling(scene, weights):
        pass
    np.testing.assert_array_equal(probabilities(scene), before)


def test_weights_may_be_a_list(scalar, probabilities):
    scene = load(a=point(1, 1, 1), b=point(2, 2, 2))
    with manylights.power_sampling(scene, [1, 3]):
        assert sorted(probabilities(scene)) == pytest.approx([0.25, 0.75])


def test_what_is_no_scene_is_named(scalar):
    for wrong in (None, "scene.xml", {"type": "scene"}):
        with pytest.raises(ValueError, match=r"must be an mi\.Scene of the variant scalar_rgb"):
            manylights.power_weights(wrong)
        with pytest.raises(ValueError, match=r"must be an mi\.Scene"):
            manylights.power_sampling(wrong).__enter__()


def test_no_emitter_is_never_chosen(each_variant, probabilities):
    scene = load(a=point(1e9, 1e9, 1e9), b=point(1e-9, 1e-9, 1e-9), c=point(0, 0, 0))
    assert (manylights.power_weights(scene) >= power.FLOOR).all()
    with manylights.power_sampling(scene):
        assert (probabilities(scene) > 0).all()


def test_unknown_power_counts_as_the_mean(each_variant, monkeypatch):
    scene = load(a=point(1, 1, 1), b=point(3, 3, 3), c=point(7, 7, 7))
    monkeypatch.setattr(power, "_emitter_powers", lambda scene: np.array([1.0, np.nan, 3.0]))
    np.testing.assert_allclose(manylights.power_weights(scene), [0.5, 1.0, 1.5])


def test_equal_emitters_get_equal_weights(each_variant):
    scene = load(a=square(rgb(1, 1, 1)), b=square(rgb(1, 1, 1)))
    assert np.ptp(manylights.power_weights(scene)) == 0.0


def test_a_scene_without_light_has_weights_of_one(each_variant):
    np.testing.assert_array_equal(manylights.power_weights(load(a=point(0, 0, 0))), [1.0])
    assert len(manylights.power_weights(load())) == 0


def test_weights_that_mitsuba_does_not_follow_are_reported(each_variant, monkeypatch):
    scene = load(a=point(1, 1, 1), b=point(3, 3, 3))
    monkeypatch.setattr(power, "_set_weights", lambda scene, weights: None)
    with pytest.raises(RuntimeError, match="its share of the power"), power.power_sampling(scene):
        pass


def test_power_sampling_has_the_same_mean_and_less_noise(llvm):
    lights = {f"p{i}": point(*(3 * [0.1])) for i in range(20)}
    scene = load(**lights, bright=point(100, 100, 100), sensor=overhead_camera())
    integrator = mi.load_dict({"type": "direct"})

    def images():
        shape = [mi.render(scene, integrator=integrator, spp=64, seed=seed) for seed in range(8)]
        return np.array([np.array(image).mean() for image in shape])

    uniform = images()
    with manylights.power_sampling(scene):
        by_power = images()
    assert by_power.mean() == pytest.approx(uniform.mean(), rel=0.05)
    assert by_power.std() < 0.3 * uniform.std()


def overhead_camera():
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
    return {"type": "perspective", "film": film, "to_world": to_world}
