"""Renders scenes with each method, several numbers of samples and seeds, and keeps all numbers.

Of each scene: calibration, the reference, the measurements, one rendering of each method that takes
a given time, and pictures of variance and of the work of our methods. In the measurements seeds are
the outer loop and methods the inner one, so that a machine that is busy for a while slows all
methods alike. Results are written after each group of renders; what is in the file is not rendered
again.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from manylights.bench import calibration, metrics, records, reference, samplers
from manylights.bench.drawing import BrokenImage, Drawing, draw, draw_channels, draw_denoised
from manylights.bench.folder import Folder, is_skipped, series_of, skip, unskip
from manylights.bench.methods import EXHAUSTIVE_LIGHTS, Method, integrator_for, with_guides
from manylights.bench.moments import Moments
from manylights.bench.scene_source import MeasuredScene, Source
from manylights.bench.workload import Workload
from manylights.errors import UsageError, one_line
from manylights.output import channels
from manylights.power import power_sampling, power_weights
from manylights.progress import say

#: FLIP is evaluated for so many seeds only: it takes longer than many a render, and its mean over
#: the pixels hardly varies.
FLIP_SEEDS = 2

#: Seeds of renders that are not measured: between those of measurements and of references.
CALIBRATION_SEED = 2**30
EQUAL_TIME_SEED = CALIBRATION_SEED + 1

#: Renders that look for the number of samples that takes a given time, and the logarithm of the
#: ratio of times that is near enough: 15 %.
EQUAL_TIME_TRIES, EQUAL_TIME_DISTANCE = 4, 0.14

#: Samples of the render that counts the work of our methods.
MAP_SAMPLES = 4

#: Shares of a budget that one method takes at one seed, and renders at the end: before anything is
#: measured the time left is guessed with them.
GUESSED_SHARE, GUESSED_ENDING = 0.8, 4.0


@dataclass
class Task:
    """A scene to measure.

    Attributes:
        source: where it comes from.
        methods: what is compared on it.
        name, title, family: for the report; default: those of the source.
        private: numbers may be published, pictures not.
        boundary: constant along columns but for noise.
        reference: an image file. Default: rendered.
    """

    source: Source
    methods: list[Method]
    name: str = ""
    title: str = ""
    family: str = ""
    private: bool = False
    boundary: bool = False
    reference: str | None = None


@dataclass
class Settings:
    """What is rendered.

    Attributes:
        spp: numbers of samples, in rising order; None: 1, 4, 16, ... as the budget allows.
        budget: seconds of the longest render.
        seeds: number of seeds, from 1 on.
        denoise: measure denoised images, too?
    """

    spp: list[int] | None
    budget: float
    seeds: int
    denoise: bool = False


@dataclass
class Candidate:
    """A method that is measured on a scene."""

    method: Method
    integrator: Any
    series: dict[str, Any]
    times: dict[int, float]

    @property
    def sampler(self) -> str:
        """Name of the sampler; earlier results had one for all methods."""
        return self.series.get("sampler") or samplers.MITSUBAS[0]

    def sampler_of(self, spp: int) -> str:
        """Return the sampler for a number of samples: some of Mitsuba's would round 1."""
        return self.sampler if spp > 1 or self.method.is_ours else samplers.MITSUBAS[0]

    @property
    def spps(self) -> list[int]:
        """Numbers of samples that are measured."""
        return [point["spp"] for point in self.series["points"]]


def run(
    tasks: list[Task], settings: Settings, found: Folder, report: Callable[[float], None]
) -> None:
    """Measure all scenes and write the results.

    Args:
        tasks: the scenes.
        settings: what is rendered.
        found: earlier results, to which those of this run are added.
        report: called with the finished fraction, from 0 to 1.
    """
    work = Workload({task.source.text: _guess(task, settings) for task in tasks}, report)
    for task in tasks:
        entry = found.find(task.source)
        if entry is not None and _is_finished(entry, task.methods, settings):
            say(f"{entry['name']}: nothing to do")
            work.expect(task.source.text, 0.0)
            continue
        SceneRun(task, settings, found, work).run()
        # Virtual calls of later scenes would include the emitters of this one; and kernels in
        # memory would make later first renders quick.
        gc.collect()
        dr.flush_malloc_cache()
        dr.flush_kernel_cache()


class SceneRun:
    """The measurement of one scene."""

    def __init__(self, task: Task, settings: Settings, found: Folder, work: Workload) -> None:
        self.task, self.settings, self.found, self.work = task, settings, found, work
        self.loaded: MeasuredScene = task.source.load()
        self.entry = self._entry()
        self.weights = power_weights(self.loaded.scene)
        self.reference = np.zeros(0)
        # Methods whose tree would be built again by the next render.
        self.stale: set[str] = set()
        # Methods and numbers of samples that have the kernels for denoised images.
        self.warm: set[tuple[str, int]] = set()

    def run(self) -> None:
        """Do everything that is missing."""
        self.entry.pop("finished", None)
        for method in self.task.methods:
            unskip(self.entry, method)
        say(f"{self.entry['name']}: {self.entry['lights']:,} lights")
        # First, since it finds unreadable files.
        self._given_reference()
        candidates = self._calibrate_all()
        self._expect(candidates)
        self._render_reference(candidates)
        self._measure_all(candidates)
        for candidate in candidates:
            self._attempt(candidate, self._equal_time)
            self._attempt(candidate, self._draw_maps)
            self._write_variance(candidate)
        self.entry["finished"] = True
        self.found.save()
        self.work.expect(self.task.source.text, 0.0)

    def _entry(self) -> dict[str, Any]:
        task, loaded = self.task, self.loaded
        width, height = loaded.size
        return self.found.scene(
            task.source,
            name=task.name or task.source.name,
            title=task.title or task.source.text,
            family=task.family or task.source.family,
            lights=loaded.lights,
            width=width,
            height=height,
            max_depth=loaded.kind.max_depth,
            media=loaded.media,
            private=task.private,
            boundary=task.boundary,
            equal_time=self.settings.budget,
        )

    def _draw(self, candidate: Candidate, spp: int, seed: int, denoised=False) -> Drawing:
        method, render = candidate.method, draw_denoised if denoised else draw
        try:
            if method.name == "power":
                return self._draw_by_power(candidate, spp, seed, render)
            if method.spec in self.stale:
                render(self.loaded, candidate.integrator, 1, CALIBRATION_SEED, candidate.sampler)
                self.stale.discard(method.spec)
            return render(self.loaded, candidate.integrator, spp, seed, candidate.sampler_of(spp))
        except RuntimeError as error:
            where = f"{self.entry['name']}, {method.spec}"
            raise UsageError(f"{where}: {one_line(error)}") from error

    def _draw_by_power(self, candidate: Candidate, spp: int, seed: int, render) -> Drawing:
        scene = self.loaded.scene
        with power_sampling(scene, self.weights):
            sampler = candidate.sampler_of(spp)
            drawing = render(self.loaded, candidate.integrator, spp, seed, sampler)
        # Mitsuba tells environments about each change, which makes them look new to our trees.
        if scene.environment() is not None:
            self.stale = {method.spec for method in self.task.methods if method.is_ours}
        return drawing

    def _attempt(self, candidate: Candidate, step: Callable[[Candidate], Any]) -> bool:
        """Do a step with a method; if pixels are no numbers, note that and return False."""
        try:
            step(candidate)
        except BrokenImage as error:
            self._skip(candidate.method, str(error))
            return False
        return True

    def _skip(self, method: Method, why: str) -> None:
        say(f"{self.entry['name']}: {method.spec} left out: {why}")
        skip(self.entry, method, why)

    # -- calibration

    def _calibrate_all(self) -> list[Candidate]:
        candidates = []
        for method in self.task.methods:
            why = _impossible(method, self.loaded.lights, self.weights)
            if why:
                self._skip(method, why)
            else:
                description = integrator_for(method, self.loaded.kind)
                series = series_of(self.entry, method) or records.new_series(
                    method.spec,
                    method.name,
                    method.parameters,
                    description,
                    samplers.OURS if method.is_ours else samplers.MITSUBAS[0],
                )
                candidate = Candidate(method, mi.load_dict(description), series, {})
                if self._attempt(candidate, self._calibrate) and candidate.times:
                    candidates.append(candidate)
        return candidates

    def _calibrate(self, candidate: Candidate) -> None:
        """Find the numbers of samples of a method, and its times; without any it is too slow."""
        series, budget = candidate.series, self.settings.budget
        first = self._draw(candidate, 1, CALIBRATION_SEED)

        def measure(spp: int) -> float:
            return self._draw(candidate, spp, CALIBRATION_SEED).seconds

        one = measure(1)
        if one > calibration.PATIENCE * budget and not series["points"]:
            limit = f"{calibration.PATIENCE:g} times the budget of {budget:g} s"
            self._skip(candidate.method, f"one sample a pixel takes {one:.1f} s, over {limit}")
            return
        wanted = self.settings.spp or candidate.spps
        if wanted:
            times = {spp: calibration.steady_seconds(measure, spp) for spp in wanted}
            candidate.times = {1: one, **times}
        else:
            candidate.times = calibration.ladder(measure, budget, self._largest())
            wanted = list(candidate.times)
        self._check_samples(wanted)
        if not series["points"]:
            chosen = _choose_sampler(self._draw, self.loaded.sensors, candidate)
            say(f"{self.entry['name']}: {candidate.method.spec} with {chosen}")
            series["first_seconds"] = first.seconds
            series["build_seconds"] = _build_seconds(candidate)
        missing = [spp for spp in wanted if spp not in candidate.spps]
        series["points"] = sorted(
            [*series["points"], *map(records.new_point, missing)], key=lambda point: point["spp"]
        )

    def _largest(self) -> int | None:
        """Return the largest number of samples that the reference is good for, None if any."""
        spp = (self.entry["reference"] or {}).get("spp", 0)
        return spp // reference.PASSES or None

    def _check_samples(self, wanted: list[int]) -> None:
        largest = self._largest()
        if largest is not None and max(wanted) > largest:
            raise UsageError(
                f"--spp {max(wanted)}: the reference of {self.entry['name']} in --out has "
                f"{self.entry['reference']['spp']} samples, enough for {largest} at most; "
                "choose another folder"
            )

    def _expect(self, candidates: list[Candidate]) -> None:
        """Tell the progress bar how long the rest of the scene takes."""
        seconds = sum(self._group_seconds(c) for c in candidates) * self.settings.seeds
        seconds += 3.0 * self.settings.budget * len(candidates)
        if self.entry["reference"] is None and candidates:
            seconds += reference.PASSES * max(c.times[max(c.times)] for c in candidates)
        self.work.expect(self.task.source.text, seconds)

    def _group_seconds(self, candidate: Candidate) -> float:
        return sum(calibration.predict(candidate.times, spp) for spp in candidate.spps)

    # -- reference

    def _given_reference(self) -> None:
        name = self.entry["name"]
        if self.task.reference is not None:
            image, facts = reference.read(self.task.reference, self.loaded.size)
            self.found.write_image(name, "reference", image, channels.RGB)
            self.reference, self.entry["reference"] = image, facts
        elif self.entry["reference"] is not None and self.found.has_image(name, "reference"):
            self.reference = self.found.read_reference(name)

    def _render_reference(self, candidates: list[Candidate]) -> None:
        if self.reference.size or not candidates:
            return
        spp = self._largest() or max(max(candidate.spps) for candidate in candidates)
        name, part = self.entry["name"], self.task.source.text
        try:
            image, facts = reference.render(
                self.loaded, spp, lambda seconds: self.work.finish(part, seconds)
            )
        except BrokenImage as error:
            raise UsageError(f"{name}: the reference failed: {error}") from error
        self.found.write_image(name, "reference", image, channels.RGB)
        self.reference, self.entry["reference"] = image, facts
        self.found.save()
        say(
            f"{name}: reference of {facts['spp']} spp in {facts['seconds']:.1f} s, "
            f"relative mean squared error {facts['error']:.1e}"
        )

    # -- measurements

    def _measure_all(self, candidates: list[Candidate]) -> None:
        for seed in range(1, self.settings.seeds + 1):
            for candidate in list(candidates):
                if not self._attempt(candidate, lambda c, seed=seed: _measure(self, c, seed)):
                    candidates.remove(candidate)
                self.work.finish(self.task.source.text, self._group_seconds(candidate))

    def _measure(self, candidate: Candidate, seed: int) -> None:
        """Render all numbers of samples with one seed, then write the results."""
        series = candidate.series
        points = [point for point in series["points"] if seed not in point["seed"]]
        if not points:
            return
        drawings = [self._draw(candidate, point["spp"], seed) for point in points]
        for point, drawing in zip(points, drawings):
            self._note(point, seed, drawing)
        if points[-1] is series["points"][-1]:
            self._add_moments(candidate, seed, drawings[-1].image)
        if series_of(self.entry, candidate.method) is None:
            self.entry["series"].append(series)
        self.found.save()

    def _note(self, point: dict[str, Any], seed: int, drawing: Drawing) -> None:
        errors = metrics.relative_errors(drawing.image, self.reference)
        point["seed"].append(seed)
        point["seconds"].append(drawing.seconds)
        point["cpu_seconds"].append(drawing.cpu_seconds)
        point["error"].append(float(errors.mean()))
        point["error_trimmed"].append(metrics.trimmed_mean(errors))
        point["mean"].append(float(drawing.image.mean(dtype=float)))
        if len(point["flip"]) < FLIP_SEEDS:
            point["flip"].append(metrics.flip_error(drawing.image, self.reference))

    def _moments_path(self, candidate: Candidate):
        name = f"{candidate.method.key}.moments-{max(candidate.spps)}.npz"
        return self.found.folder / self.entry["name"] / name

    def _add_moments(self, candidate: Candidate, seed: int, image: np.ndarray) -> None:
        path = self._moments_path(candidate)
        moments = Moments.load(path)
        moments.add(seed, image)
        moments.save(path)

    def _write_variance(self, candidate: Candidate) -> None:
        moments = Moments.load(self._moments_path(candidate))
        if len(moments.seeds) > 1:
            variance = moments.variance() * max(candidate.spps)
            name = f"{candidate.method.key}.variance"
            self.found.write_image(self.entry["name"], name, variance, channels.RGB)

    # -- at the end

    def _equal_time(self, candidate: Candidate) -> None:
        """Render as many samples as take the time that all methods get, and keep the image."""
        series, target = candidate.series, self.entry["equal_time"]
        if series["equal_time"] is not None:
            return
        if candidate.times[1] > calibration.TOLERANCE * target:
            return
        if max(candidate.times) > 1:
            # Compiles the kernel for numbers that are no powers of two
            few = samplers.allowed(self.loaded.sensors[candidate.sampler].sampler(), 3)
            self._draw(candidate, few, CALIBRATION_SEED)
        spp, drawing = self._fill_time(candidate, target)
        errors = metrics.relative_errors(drawing.image, self.reference)
        series["equal_time"] = {
            "spp": spp,
            "seconds": drawing.seconds,
            "error": float(errors.mean()),
            "error_trimmed": metrics.trimmed_mean(errors),
            "flip": metrics.flip_error(drawing.image, self.reference),
        }
        self.found.write_image(
            self.entry["name"], candidate.method.key, drawing.image, channels.RGB
        )
        self.found.save()
        self.work.finish(self.task.source.text, 3.0 * target)

    def _fill_time(self, candidate: Candidate, target: float) -> tuple[int, Drawing]:
        """Render until a number of samples takes about ``target`` seconds; return the best."""
        times, tries = candidate.times, []
        for _ in range(EQUAL_TIME_TRIES):
            spp = calibration.samples_in(times, target)
            spp = samplers.allowed(self.loaded.sensors[candidate.sampler].sampler(), spp)
            drawing = self._draw(candidate, spp, EQUAL_TIME_SEED)
            distance = abs(np.log(drawing.seconds / target))
            tries.append((distance, spp, drawing))
            if distance < EQUAL_TIME_DISTANCE or spp == 1:
                break
            times = {1: min(times[1], drawing.seconds), spp: drawing.seconds}
        _, spp, drawing = min(tries, key=lambda item: item[0])
        return spp, drawing

    def _draw_maps(self, candidate: Candidate) -> None:
        """Write how much work our methods do at each pixel."""
        name = f"{candidate.method.key}.maps"
        if not candidate.method.is_ours or self.found.has_image(self.entry["name"], name):
            return
        description = integrator_for(candidate.method, self.loaded.kind)
        counting = mi.load_dict({**description, "counts": True})
        maps = draw_channels(self.loaded, counting, MAP_SAMPLES, CALIBRATION_SEED, channels.WORK)
        self.found.write_image(self.entry["name"], name, maps, channels.WORK)


def _impossible(method: Method, lights: int, weights: np.ndarray) -> str | None:
    """Return why a method makes no sense for a scene, None if it does."""
    if method.name == "exhaustive" and lights > EXHAUSTIVE_LIGHTS:
        return f"{lights:,} lights: more than {EXHAUSTIVE_LIGHTS:,}"
    if method.name == "power" and np.ptp(weights) < 1e-4:
        return "all emitters have the same power: the same as uniform"
    return None


def _choose_sampler(
    draw: Callable[[Candidate, int, int], Drawing], sensors: dict[str, Any], candidate: Candidate
) -> str:
    """Give Mitsuba's integrators the best of Mitsuba's samplers; return the name of the sampler."""
    if candidate.method.is_ours:
        return candidate.sampler

    def render(sampler: str, spp: int, number: int) -> Drawing:
        candidate.series["sampler"] = sampler
        return draw(candidate, spp, CALIBRATION_SEED + 2 + number)

    chosen = samplers.choose(sensors, list(candidate.times), render)
    candidate.series["sampler"] = chosen
    candidate.times = {
        spp: draw(candidate, spp, CALIBRATION_SEED).seconds for spp in candidate.times
    }
    return chosen


def _measure(run: SceneRun, candidate: Candidate, seed: int) -> None:
    """Measure the images of a seed, and denoised ones if that is wanted."""
    run._measure(candidate, seed)
    if run.settings.denoise:
        _measure_denoised(run, candidate, seed)


def _measure_denoised(run: SceneRun, candidate: Candidate, seed: int) -> None:
    """Do the same with denoised images, the renders of which have albedo and normals, too."""
    points = candidate.series.setdefault("denoised", [])
    known = {point["spp"] for point in points}
    points += [records.new_point(spp) for spp in candidate.spps if spp not in known]
    points.sort(key=lambda point: point["spp"])
    missing = [point for point in points if seed not in point["seed"]]
    if not missing:
        return
    description = with_guides(integrator_for(candidate.method, run.loaded.kind))
    guided = replace(candidate, integrator=mi.load_dict(description))
    for point in missing:
        key = candidate.method.spec, point["spp"]
        if key not in run.warm:
            run._draw(guided, point["spp"], CALIBRATION_SEED, denoised=True)
            run.warm.add(key)
        run._note(point, seed, run._draw(guided, point["spp"], seed, denoised=True))
    run.found.save()


def _build_seconds(candidate: Candidate) -> float:
    """Return the seconds in which our integrator built its tree, 0 for Mitsuba's."""
    if not candidate.method.is_ours:
        return 0.0
    value: Any = mi.traverse(candidate.integrator)["build_ms"]
    return 1e-3 * float(value if isinstance(value, (int, float)) else value[0])


def _guess(task: Task, settings: Settings) -> float:
    groups = settings.seeds * GUESSED_SHARE + GUESSED_ENDING
    return settings.budget * (len(task.methods) * groups + GUESSED_SHARE * reference.PASSES)


def _is_finished(entry: dict[str, Any], methods: list[Method], settings: Settings) -> bool:
    """Has the scene nothing left to render for these methods?"""
    if not entry.get("finished"):
        return False
    for method in methods:
        series = series_of(entry, method)
        if is_skipped(entry, method):
            continue
        if series is None:
            return False
        counts = {point["spp"]: len(point["seed"]) for point in series["points"]}
        if min(counts.values()) < settings.seeds or set(settings.spp or ()) - set(counts):
            return False
        denoised = {point["spp"]: len(point["seed"]) for point in series.get("denoised") or ()}
        if settings.denoise and min(denoised.get(spp, 0) for spp in counts) < settings.seeds:
            return False
    return True
