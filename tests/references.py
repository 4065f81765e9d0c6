"""Independent estimates of direct light that the plugin's images are compared with.

- `uniform`: Mitsuba's `direct`, which picks one emitter with equal probabilities.
- `power`: the same with probabilities from the emitters' power.
- `exhaustive`: every emitter at every shading point, see `exhaustive.py`.
- `bsdf`: BSDF sampling alone, for emitters that Mitsuba samples wrongly.

References are rendered in an LLVM variant where there is one, since it is much faster; the
expectation is that of the scalar variant. All processes of a run share them.
"""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
from manylights.loading import has_backend

from tests import light_scenes
from tests import statistics_tools as tools
from tests.shared_results import shared

SEEDS = 24
"""Renderings of the integrator under test where pixels depend on each other: in JIT variants each
records its kernels again."""

SCALAR_SEEDS = 64
"""The same in scalar variants, where many small renderings take as long as few large ones."""

SCALAR_ERROR = 0.9
"""What the error of these is multiplied with: more would do for so many."""

DEPENDENT_ERROR = 0.7
"""The same in JIT variants."""

FEW_SEEDS = 8
"""Renderings where pixels are independent, so that each tells of the variance."""

REFERENCE_SEEDS = 64
"""Images of a reference, which are rendered together; they keep the t test's far tail short."""

PILOTS = 4
"""Short renderings that tell how many samples are needed; twice as many of dependent pixels.

The fewer there are, the more samples are rendered to be safe."""

LONG_PILOTS = 32
"""As many where few pixels have nearly all of the variance of these."""

REFERENCE_PILOTS = 16
"""Pilots of references, all in one wavefront."""

FEW_DEGREES = 30
"""Degrees of freedom of a variance that is not known well: its upper end is half more."""

ENOUGH_DEGREES = 64
"""Those that the images under test have where so many renderings give them."""

ERROR = {
    "uniform": 1.6e-3,
    "power": 1.6e-3,
    "bsdf": 1.6e-3,
    "exhaustive": 1.5e-3,
    "tested": 1.9e-3,
    "tested alone": 2.4e-3,
}
"""Relative standard error of the image mean that the number of samples is chosen for.

To find a bias of 2 % with `tools.SIGNIFICANCE` and `tools.POWER` the difference may have one of
0.27 % (7.4 standard errors with some 150 degrees of freedom). The noisiest pair here has 0.25 %;
what is compared with a closed form may have nearly as much alone.
"""

LLVM_TWIN = {
    "scalar_rgb": "llvm_ad_rgb",
    "scalar_spectral": "llvm_ad_spectral",
}


def reference_variant(variant):
    """The variant that renders the references of `variant`."""
    twin = LLVM_TWIN.get(variant, variant)
    has_llvm = twin in mi.variants() and has_backend(dr.JitBackend.LLVM)
    return twin if has_llvm else variant


def planned_images(scene, integrator, error, first_seed, sensor=0, known=False):
    """Render as many images and samples as the relative `error` of their mean needs.

    `known` integrators are not under test: they need not render as users do. Numbers of samples are
    odd: LLVM variants compile one kernel for powers of two and another one for all other numbers.
    """
    independent = has_independent_pixels(scene.sensors()[sensor])

    def render(spp, first, count):
        how = render_at_once if known else tools.render_seeds
        return how(scene, integrator, spp, range(first, first + count), sensor)

    pilots, pilot_spp = pilot_count(independent, known), 9
    pilot = render(pilot_spp, first_seed, pilots)
    if not known and independent and degrees_of_freedom(pilot) < FEW_DEGREES:
        longer = render(pilot_spp, first_seed + pilots, LONG_PILOTS - pilots)
        pilot = np.concatenate([pilot, longer])
    count = REFERENCE_SEEDS
    if not known:
        count, share = few_images(pilot) if independent else many_images()
        error = share * error
    spp = tools.samples_for_precision(
        pilot, pilot_spp, count, error, independent_pixels=independent
    )
    return render(max(5, spp | 1), first_seed + 1000, count)


def pilot_count(independent, known):
    """How many short renderings: more where one wavefront traces them all."""
    if known and independent and not mi.variant().startswith("scalar"):
        return REFERENCE_PILOTS
    return PILOTS if independent and not known else 2 * PILOTS


def degrees_of_freedom(pilot):
    """Those of the variance of the image mean, of the channel that has the fewest."""
    return tools.variance_of_image_mean(pilot)[1].min()


def few_images(pilot):
    """How many images of independent pixels, and the share of the error that they may have.

    More where few pixels have nearly all of the variance, so that it is known.
    """
    degrees = degrees_of_freedom(pilot) / (len(pilot) - 1)
    count = int(np.clip(1 + np.ceil(ENOUGH_DEGREES / degrees), FEW_SEEDS, SEEDS))
    return count, tools.visible_errors(np.inf) / tools.visible_errors(degrees * (count - 1))


def many_images():
    """The same where pixels depend on each other."""
    if mi.variant().startswith("scalar"):
        return SCALAR_SEEDS, SCALAR_ERROR
    return SEEDS, DEPENDENT_ERROR


assert_same_mean = functools.partial(tools.assert_same_mean, independent_pixels=True)
compare_means = functools.partial(tools.compare_means, independent_pixels=True)


def has_independent_pixels(sensor):
    """True if each sample counts in one pixel."""
    return sensor.film().rfilter().radius() < 0.51


WAVEFRONT = 1 << 21
"""Most samples that are traced at once: 100 MB of random numbers and what an integrator keeps."""


def render_at_once(scene, integrator, spp, seeds, sensor=0):
    """Images as `tools.render_seeds` makes them, in JIT variants in few wavefronts.

    For integrators of Mitsuba and in Python, most of whose time goes into recording small renders.
    Each sample has random numbers of its own, so images are independent as those of seeds are. The
    first seed of a wavefront stands for all. Its film has a box filter: with wider ones, and in
    scalar variants, images are rendered one by one with the scene's own sampler.
    """
    if mi.variant().startswith("scalar") or not has_independent_pixels(scene.sensors()[sensor]):
        return tools.render_seeds(scene, integrator, spp, seeds, sensor)
    sensor = scene.sensors()[sensor]
    width, height = sensor.film().crop_size()
    share = min(REFERENCE_SEEDS, max(1, int(WAVEFRONT // (width * height * spp))))
    parts = [seeds[start : start + share] for start in range(0, len(seeds), share)]
    images = [wavefront(scene, integrator, spp, part[0], len(part), sensor) for part in parts]
    return np.concatenate(images)


def wavefront(scene, integrator, spp, seed, count, sensor):
    """`count` images whose samples are traced together, on a film that has one below the other.

    One kernel serves any number of samples and images: its numbers are opaque, its film has a size.
    """
    width, height = (int(value) for value in sensor.film().crop_size())
    samples = width * height * spp * count
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), samples)
    pixel = dr.arange(mi.UInt32, samples) // dr.opaque(mi.UInt32, spp)
    place = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
    top = mi.Float(pixel // (width * height) * height)
    on_film = mi.Point2f(place.x / width, (place.y - top) / height)
    ray, weight = sensor.sample_ray_differential(0.0, sampler.next_1d(), on_film, sampler.next_2d())
    value, valid, _ = integrator.sample(scene, sampler, ray, sensor.get_medium())
    box = mi.load_dict({"type": "box"})
    block = mi.ImageBlock((width, height * REFERENCE_SEEDS), (0, 0), 5, rfilter=box)
    block.put(place, ray.wavelengths, weight * value, dr.select(valid, mi.Float(1), 0))
    sums = np.array(block.tensor(), dtype=np.float64).reshape(-1, height, width, 5)[:count]
    return sums[..., : 1 if mi.is_monochromatic else 3] / spp


def set_power_weights(scene, samples=64):
    """Give each emitter a sampling weight from its power, estimated with emitted rays.

    A tenth of the average is added, so that no emitter is starved.
    """
    powers = emitter_powers(scene, samples)
    weights = powers / (powers.mean() or 1) + 0.1  # black scenes have no power
    for emitter, weight in zip(scene.emitters(), weights):
        parameters = mi.traverse(emitter)
        parameters["sampling_weight"] = float(weight)
        parameters.update()
    scene.parameters_changed()


def emitter_powers(scene, samples):
    """Rough power of each emitter of the scene."""
    count = len(scene.emitters())
    numbers = np.random.default_rng(0).random((5, count * samples))
    if mi.variant().startswith("scalar"):
        powers = [
            ray_weight(emitter, numbers[:, index])
            for index, emitter in enumerate(np.repeat(scene.emitters(), samples))
        ]
    else:
        which = dr.arange(mi.UInt32, count * samples) // samples
        emitters = dr.gather(mi.EmitterPtr, scene.emitters_dr(), which)
        powers = ray_weight(emitters, [mi.Float(row) for row in numbers])
    return np.array(powers, dtype=float).reshape(count, samples).mean(axis=1)


def ray_weight(emitter, numbers):
    """Power carried by one random emitted ray."""
    position, direction = mi.Point2f(numbers[1:3]), mi.Point2f(numbers[3:5])
    weight = emitter.sample_ray(0, numbers[0], position, direction)[1]
    return dr.mean(mi.unpolarized_spectrum(weight))


def make_reference(kind, bsdf_samples=1, hide_emitters=False):
    """The integrator of a kind of reference in the current variant."""
    if kind == "exhaustive" and "scalar" not in mi.variant():
        if hide_emitters:
            raise ValueError("the exhaustive integrator always shows emitters")
        from tests.exhaustive import make_exhaustive

        return make_exhaustive(bsdf_samples=bsdf_samples > 0)
    return mi.load_dict(
        {
            "type": "direct",
            # More than one sample of delta lights is too bright in Mitsuba 3.9.1.
            "emitter_samples": 0 if kind == "bsdf" else 1,
            "bsdf_samples": bsdf_samples,
            "hide_emitters": hide_emitters,
        }
    )


@shared
def reference_images(name, kind, variant, bsdf_samples=1, hide_emitters=False):
    """Images (seeds, height, width, channels) of the scene `name`; restores the variant."""
    before = mi.variant()
    mi.set_variant(variant)
    try:
        scene = light_scenes.load_reference(name)
        if kind == "power":
            set_power_weights(scene)
        integrator = make_reference(kind, bsdf_samples, hide_emitters)
        return planned_images(scene, integrator, ERROR[kind], first_seed=100_000, known=True)
    finally:
        mi.set_variant(before)
