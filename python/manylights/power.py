"""Makes Mitsuba's own integrators choose emitters in proportion to their power.

Mitsuba chooses each emitter of a scene equally often unless ``sampling_weight`` says otherwise.
``power_sampling`` sets these weights for a while::

    with manylights.power_sampling(scene):
        image = mi.render(scene, integrator=mi.load_dict({"type": "path"}))

The power of an emitter is the mean weight of the rays that it sends out itself
(``Emitter.sample_ray``): 4 pi I of a point light, the integral over the cone of a spot light,
pi A times the mean radiance of a surface. Lights that surround the scene (``constant``, ``envmap``,
``directional``) count with what enters the scene's bounding sphere, as in Mitsuba's light tracers.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from manylights.errors import check
from manylights.threads import require_variant

#: Rays for each emitter: a textured one needs some, all others are exact with one.
SAMPLES = 64

#: The smallest weight, as a share of the mean one. An estimate can miss the bright part of a
#: texture: no emitter may be chosen never, and a thousandth of the samples is a small price.
FLOOR = 1e-3


def power_weights(scene) -> np.ndarray:
    """Return a sampling weight for each emitter of ``scene``, in the order of its emitters.

    The weights are the powers, averaged over channels, divided by their mean, and at least
    ``FLOOR``. Emitters of unknown power, those that cannot send out rays, get the weight 1.
    Without any power all weights are 1.

    Raises:
        UsageError: (a ``ValueError``) it is no ``mi.Scene`` of the current variant.
    """
    _check_scene(scene)
    powers = _emitter_powers(scene)
    known = np.isfinite(powers)
    mean = powers[known].mean() if known.any() else 0.0
    if not mean > 0.0:
        return np.ones(len(powers))
    return np.maximum(np.where(known, powers / mean, 1.0), FLOOR)


@contextmanager
def power_sampling(scene, weights: np.ndarray | None = None):
    """Context in which Mitsuba chooses the emitters of ``scene`` in proportion to their power.

    Afterwards the weights are what they were before.

    Args:
        scene: what ``mi.load_dict`` or ``mi.load_file`` returned.
        weights: what ``power_weights`` returned for this scene. Default: computed here.

    Raises:
        UsageError: (a ``ValueError``) the scene is none, or the weights are not those of its
            emitters.
        RuntimeError: Mitsuba's probabilities do not follow the weights.
    """
    weights = power_weights(scene) if weights is None else _checked(scene, weights)
    before = np.array([emitter.sampling_weight() for emitter in scene.emitters()])
    try:
        _set_weights(scene, weights)
        _check_probabilities(scene, weights)
        yield
    finally:
        _set_weights(scene, before)


def _check_scene(scene) -> None:
    require_variant()
    what = f"an mi.Scene of the variant {mi.variant()}"
    check("scene", scene, isinstance(scene, mi.Scene), what)


def _checked(scene, weights) -> np.ndarray:
    """Return weights that a user gave, if there is one for each emitter."""
    _check_scene(scene)
    count = len(scene.emitters())
    try:
        found = np.asarray(weights, float)
    except (TypeError, ValueError):
        found = np.full(count, np.nan)
    fits = found.shape == (count,) and np.isfinite(found).all() and (found >= 0.0).all()
    what = f"{count} finite numbers of at least 0, one for each emitter, not all of them 0"
    check("weights", weights, bool(fits and (found.any() or not count)), what)
    return found


def _set_weights(scene, weights: np.ndarray) -> None:
    for emitter, weight in zip(scene.emitters(), weights):
        parameters = mi.traverse(emitter)
        parameters["sampling_weight"] = float(weight)
        parameters.update()
    scene.parameters_changed()


def _check_probabilities(scene, weights: np.ndarray) -> None:
    """Raise RuntimeError unless the scene chooses emitters with these weights."""
    count = len(weights)
    if mi.variant().startswith("scalar"):
        found = np.array([scene.pdf_emitter(index) for index in range(count)])
    else:
        found = np.array(scene.pdf_emitter(dr.arange(mi.UInt32, count)))
    expected = weights / weights.sum()
    # Without weights Mitsuba returns one number for all.
    found = np.broadcast_to(found, count)
    # Single precision, and sums of as many numbers as there are emitters.
    if not np.allclose(found, expected, rtol=1e-3, atol=1e-7):
        worst = int(np.argmax(np.abs(found - expected)))
        raise RuntimeError(
            f"power sampling: Mitsuba chooses emitter {worst} with probability {found[worst]:g}, "
            f"its share of the power is {expected[worst]:g}"
        )


def _emitter_powers(scene) -> np.ndarray:
    """Return the power of each emitter, NaN where it is unknown."""
    numbers = _numbers()
    if not len(scene.emitters()):
        return np.zeros(0)
    if mi.variant().startswith("scalar"):
        return np.array([_power_or_nan(emitter, numbers) for emitter in scene.emitters()])
    try:
        return _powers_at_once(scene, numbers)
    except RuntimeError:
        # One emitter that cannot send out rays makes the call fail for all of them.
        return np.array([_power_or_nan(emitter, numbers) for emitter in scene.emitters()])


def _numbers() -> np.ndarray:
    """Return the random numbers of ``SAMPLES`` rays, shape (5, SAMPLES).

    They are the same for every emitter, so that equal emitters get equal weights, and evenly
    spread: multiples of the powers of the root of x^6 = x + 1, modulo 1 (Roberts' sequence).
    """
    root = 1.1347241384015195
    steps = root ** -np.arange(1.0, 6.0)
    return (0.5 + np.outer(steps, np.arange(1, SAMPLES + 1))) % 1.0


def _powers_at_once(scene, numbers: np.ndarray) -> np.ndarray:
    count = len(scene.emitters())
    which = dr.arange(mi.UInt32, count * SAMPLES) // SAMPLES
    emitters = dr.gather(mi.EmitterPtr, scene.emitters_dr(), which)
    weights = _ray_weight(emitters, [mi.Float(np.tile(row, count)) for row in numbers])
    return np.array(weights, dtype=float).reshape(count, SAMPLES).mean(axis=1)


def _power_or_nan(emitter, numbers: np.ndarray) -> float:
    scalar = mi.variant().startswith("scalar")
    try:
        if not scalar:
            weights: Any = _ray_weight(emitter, [mi.Float(row) for row in numbers])
        else:
            weights = [_ray_weight(emitter, list(column)) for column in numbers.T]
        return float(np.mean(weights))
    except RuntimeError:
        return float("nan")


def _ray_weight(emitter, numbers):
    """Return the power, averaged over channels, that one ray of an emitter carries."""
    position, direction = mi.Point2f(numbers[1:3]), mi.Point2f(numbers[3:5])
    _, weight = emitter.sample_ray(0.0, numbers[0], position, direction)
    return dr.mean(mi.unpolarized_spectrum(weight))
