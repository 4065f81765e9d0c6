"""Mean and variance of images over seeds, kept in a file so that a later run can go on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from manylights import files


class Moments:
    """Running mean and sum of squared deviations (Welford), each seed counted once.

    Attributes:
        seeds: those that are in.
        mean, squares: arrays of the shape of the images.
    """

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.mean: Any = 0.0
        self.squares: Any = 0.0

    def add(self, seed: int, image: np.ndarray) -> None:
        """Add the image of a seed, unless that is in already."""
        if seed in self.seeds:
            return
        self.seeds.append(seed)
        difference = np.asarray(image, dtype=float) - self.mean
        self.mean = self.mean + difference / len(self.seeds)
        self.squares = self.squares + difference * (image - self.mean)

    def variance(self) -> np.ndarray:
        """Return the variance of one image, unbiased; needs two images."""
        return self.squares / (len(self.seeds) - 1)

    def save(self, path: Path) -> None:
        """Write to an ``npz`` file, whole or not at all."""
        with files.written_whole(path) as partial, open(partial, "wb") as file:
            np.savez(file, seeds=self.seeds, mean=self.mean, squares=self.squares)

    @staticmethod
    def load(path: Path) -> Moments:
        """Read what ``save`` wrote; nothing where there is no such file."""
        moments = Moments()
        if path.is_file():
            with np.load(path) as data:
                moments.seeds = [int(seed) for seed in data["seeds"]]
                moments.mean, moments.squares = data["mean"], data["squares"]
        return moments
