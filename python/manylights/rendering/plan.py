"""The passes of a render: how many samples each has, and which seed. Numbers only, no Mitsuba.

What an image is made of depends only on the scene, the variant, the number of samples and the seed,
and in scalar variants on whether checkpoints are kept, never on time:

- scalar variants without checkpoints render all samples in one pass;
- all others render long jobs in passes of ``pass_sizes()`` samples. Each has a seed of its own. The
  film's sums of all passes are added before the division by the filter weights, so each sample has
  the same weight, whatever its pass.

A stratified sampler stratifies within a pass; that is why there are few passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Samples of one pass in JIT variants, at most: they bound the memory for the samplers' states
#: (16 bytes and more for each sample) and the wait for the next step of the bar.
MAX_SAMPLES_PER_PASS = 2**24

#: The same in scalar variants, where they take ten seconds to a minute on two cores. Where that is
#: too little for samplers to stratify, passes have a few samples per pixel.
MAX_SAMPLES_PER_SCALAR_PASS, MIN_SCALAR_SPP = 2**22, 4

#: Renders up to this many samples take seconds and are one pass, the same as ``mi.render``.
SINGLE_PASS_SAMPLES = 2**22

#: Passes of a longer render, at least: enough for a bar, few enough for stratification.
MIN_PASSES = 4


@dataclass(frozen=True)
class Pass:
    """A part of a render.

    Attributes:
        index: its number, from 0.
        seed: of its random numbers, 32 bits.
        spp: samples per pixel.
        begin: samples per pixel of all passes before it.
    """

    index: int
    seed: int
    spp: int
    begin: int


@dataclass(frozen=True)
class Plan:
    """The passes of a render, in their order."""

    passes: tuple[Pass, ...]

    @staticmethod
    def of(sizes: list[int], seed: int) -> Plan:
        """Return the plan with these samples per pixel for each pass."""
        begins = np.cumsum([0, *sizes[:-1]]).tolist()
        passes = (
            Pass(index, pass_seed(seed, index), spp, begin)
            for index, (spp, begin) in enumerate(zip(sizes, begins))
        )
        return Plan(tuple(passes))

    @property
    def spp(self) -> int:
        """Samples per pixel of all passes."""
        return self.samples_after(len(self.passes))

    @property
    def samples_per_pass(self) -> int:
        """Samples per pixel of all passes but the last, which may have fewer."""
        return self.passes[0].spp

    def samples_after(self, passes: int) -> int:
        """Return the samples per pixel of the first passes."""
        return sum(one.spp for one in self.passes[:passes])


def whole(spp: int, seed: int) -> Plan:
    """Return the plan of a render in one pass."""
    return Plan.of([spp], seed)


def split(spp: int, pixels: int, seed: int, scalar: bool) -> Plan:
    """Return the plan of a render whose passes are short enough.

    Args:
        spp: samples per pixel.
        pixels: of the image.
        seed: of the render, 0 to 2^32 - 1.
        scalar: for a scalar variant?
    """
    most = MAX_SAMPLES_PER_PASS
    if scalar:
        most = max(MAX_SAMPLES_PER_SCALAR_PASS, MIN_SCALAR_SPP * pixels)
    return Plan.of(pass_sizes(spp, pixels, most), seed)


def pass_sizes(spp: int, pixels: int, most: int = MAX_SAMPLES_PER_PASS) -> list[int]:
    """Split ``spp`` samples per pixel into passes of ``most`` samples of the whole image, at most.

    Up to ``SINGLE_PASS_SAMPLES`` samples of the whole image are one pass. Above, all passes have
    the same power of two and the last one takes the rest: equal passes share one compiled kernel,
    and powers of two suit the stratified samplers.

    >>> pass_sizes(16, 640 * 360)
    [16]
    >>> pass_sizes(72, 640 * 360)
    [16, 16, 16, 16, 8]
    """
    if spp * pixels <= SINGLE_PASS_SAMPLES:
        return [spp]
    largest = max(1, min(spp // MIN_PASSES, most // pixels))
    size = 1 << (largest.bit_length() - 1)
    sizes = [size] * (spp // size)
    rest = spp - sum(sizes)
    return [*sizes, rest] if rest else sizes


def pass_seed(seed: int, index: int) -> int:
    """Return the seed of pass ``index``, 32 bits: ``seed`` for pass 0.

    They are an odd number apart. Scalar variants use the product with the number of pixels, modulo
    2^32, which is one of 4096 numbers for 1024 x 1024 pixels: seeds drawn at random would repeat a
    pass there. The distance depends on the seed, so that two renders share no passes.
    """
    distance = int(np.random.SeedSequence(seed).generate_state(1)[0]) | 1
    return (seed + index * distance) % 2**32
