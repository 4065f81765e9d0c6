"""The passes of a render: which samples of which pixels. Numbers only, no Mitsuba.

What an image is made of depends only on the scene, the variant, the number of samples and the seed,
never on time, memory, threads or interruptions:

- a pass renders a range of the samples of each pixel;
- a step is what is rendered at one go and then added to the sums of all: a pass, or a few;
- a sequence is all samples of a pixel that belong together. Samplers that can be asked for any
  sample have one for all steps with the same seed. All others begin a sequence in each step, and
  stratify within it only: they get as few steps as memory allows.

The film's sums of all steps are added before the division by the filter's weights, so each sample
counts the same, whatever its step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

#: Roles of passes: all pixels; the sixteenth of them from which visibility is learnt; all others.
ALL, TRAIN, OTHERS = range(3)

#: Samples of one step, by the first word of the variant's name. On two cores they take some seconds
#: to half a minute, on a GPU a second: long enough that adding films costs little, short enough for
#: the progress bar and checkpoints. They need no memory.
MOST_SAMPLES = {"scalar": 2**22, "llvm": 2**25, "cuda": 2**28}

#: The same for samplers that have no samples by index: their states take memory, 16 bytes and more
#: each, in JIT variants. In scalar variants steps have a few samples per pixel, so that they can
#: stratify.
MOST_STATES, LEAST_SCALAR_SPP = 2**24, 4

#: Renders of up to this many samples take seconds and are one step, the same as ``mi.render``.
SINGLE_STEP_SAMPLES = 2**22

#: Steps of a longer render by samplers without samples by index, at least: enough for a bar.
LEAST_STEPS = 4

#: One of so many pixels trains, and so many samples of all of them together are enough: the image
#: has their noise, too.
TRAINED_PIXELS, TRAINING_SAMPLES = 16, 2**17

#: Number of independent sequences from which the variance of the image is found, if it is asked
#: for. More of them would stratify less.
SEQUENCES = 4

#: Samples of the whole image with which such renders begin, at least; and of each sequence.
PILOT_SAMPLES, LEAST_PILOT_SPP = 2**19, 1


@dataclass(frozen=True)
class Pass:
    """Consecutive samples of each pixel.

    Attributes:
        first: number of the first sample, from 0.
        count: how many.
        role: ``ALL`` pixels, ``TRAIN`` on the sixteenth, or all ``OTHERS``.
    """

    first: int
    count: int
    role: int = ALL


@dataclass(frozen=True)
class Step:
    """What is rendered at one go.

    Attributes:
        passes: in their order; none for an integrator that makes its own.
        spp: samples per pixel of all of them.
        scramble: number of the sequence, from 0.
        index: number of the step, from 0.
    """

    passes: tuple[Pass, ...]
    spp: int
    scramble: int
    index: int

    @property
    def trains(self) -> bool:
        """Does it begin with training passes?"""
        return any(one.role == TRAIN for one in self.passes)

    @staticmethod
    def of(passes: list[Pass], scramble: int = 0, index: int = 0) -> Step:
        """Return the step of these passes; training and what it leaves count once."""
        spp = sum(one.count for one in passes if one.role != TRAIN)
        return Step(tuple(passes), spp, scramble, index)


@dataclass(frozen=True)
class Limits:
    """What the sizes of steps depend on.

    Attributes:
        pixels: of the image.
        backend: first word of the variant's name, "scalar", "llvm" or "cuda".
        indexed: can the sampler be asked for any sample?
        learns: does the integrator learn from training passes?
    """

    pixels: int
    backend: str = "llvm"
    indexed: bool = True
    learns: bool = True

    def largest(self) -> int:
        """Return the samples per pixel of the largest step, a power of two."""
        most = MOST_SAMPLES[self.backend]
        if not self.indexed and self.backend == "scalar":
            most = max(most, LEAST_SCALAR_SPP * self.pixels)
        elif not self.indexed:
            most = MOST_STATES
        return power_of_two(most // self.pixels)


def power_of_two(number: int) -> int:
    """Return the largest power of two up to ``number``, at least 1."""
    return 1 << (max(number, 1).bit_length() - 1)


def steps(spp: int, limits: Limits) -> Iterator[Step]:
    """Yield the steps of a render of ``spp`` samples per pixel.

    Up to ``SINGLE_STEP_SAMPLES`` samples of the whole image are one step, whose passes the
    integrator makes. Above, the first step trains, if the integrator learns, and all have the same
    power of two of samples, but the last one, which takes the rest.

    >>> limits = Limits(640 * 360)
    >>> [step.spp for step in steps(16, limits)]
    [16]
    >>> [step.spp for step in steps(300, limits)]
    [128, 128, 44]
    >>> [(one.first, one.count, one.role) for one in next(steps(300, limits)).passes]
    [(0, 5, 1), (5, 5, 1), (0, 10, 2), (10, 118, 0)]
    """
    return (step_at(index, spp, limits) for index in range(step_count(spp, limits)))


def step_at(index: int, spp: int, limits: Limits) -> Step | None:
    """Return step ``index`` of those of :func:`steps`, None after the last one."""
    if not 0 <= index < step_count(spp, limits):
        return None
    if is_single(spp, limits):
        return Step((), spp, 0, 0)
    size = step_size(spp, limits)
    first = index * size
    return Step.of(passes(first, min(size, spp - first), limits), 0, index)


def step_count(spp: int, limits: Limits) -> int:
    """Return how many steps there are."""
    return -(-spp // step_size(spp, limits))


def step_size(spp: int, limits: Limits) -> int:
    """Return the samples per pixel of all steps but the last."""
    if is_single(spp, limits):
        return spp
    size = limits.largest()
    return size if limits.indexed else min(size, power_of_two(spp // LEAST_STEPS))


def is_single(spp: int, limits: Limits) -> bool:
    """Is it one step, whose passes the integrator makes?"""
    return spp * limits.pixels <= SINGLE_STEP_SAMPLES


def passes(first: int, count: int, limits: Limits) -> list[Pass]:
    """Return the passes of a step: those at the beginning of a render train, too.

    Other samplers than indexed ones begin at 0 in every step.
    """
    if first > 0 or not limits.learns:
        return [Pass(first if limits.indexed else 0, count)]
    trained = max(limits.pixels // TRAINED_PIXELS, 1)
    training = min(-(-TRAINING_SAMPLES // trained), count)
    # The second half has the noise of what the first has taught.
    half = training // 2
    result = [Pass(0, half, TRAIN)] if half else []
    result += [Pass(half, training - half, TRAIN), Pass(0, training, OTHERS)]
    return result + ([Pass(training, count - training)] if count > training else [])


def seed_of(seed: int, number: int) -> int:
    """Return the seed of sequence ``number``, 32 bits: ``seed`` itself for 0.

    They are an odd number apart. Scalar variants use the product with the number of pixels, modulo
    2^32, which is one of 4096 numbers for 1024 x 1024 pixels: seeds drawn at random would repeat a
    sequence there. The distance depends on the seed, so that two renders share none.
    """
    distance = int(np.random.SeedSequence(seed).generate_state(1)[0]) | 1
    return (seed + number * distance) % 2**32
