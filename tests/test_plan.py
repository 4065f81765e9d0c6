"""Which steps a render has, and how many samples a noise needs: numbers alone, nothing rendered."""

import doctest
import math
import random

import pytest
from manylights.rendering import plan, targets
from manylights.rendering.plan import ALL, OTHERS, TRAIN, Limits, Step
from manylights.rendering.targets import Course, History, PowerLaw
from manylights.rendering.workers.shares import Shares

SIZES = [1, 640 * 360, 1920 * 1080, 3840 * 2160]


def all_limits():
    """Every kind of sampler, integrator and variant, for several sizes of images."""
    return [
        Limits(pixels, backend, indexed, learns)
        for pixels in SIZES
        for backend in plan.MOST_SAMPLES
        for indexed in (True, False)
        for learns in (True, False)
    ]


def follow(course, noise_of=lambda samples: 1.0, seconds_of=lambda step: 0.0):
    """The history of a render whose noises and seconds are made up."""
    done, steps = History([0] * course.sequences), []
    while (step := course.next_step(done)) is not None:
        steps.append(step)
        done.add(step, seconds_of(step))
        if course.round_is_complete(done):
            done.noises.append(noise_of(min(done.samples)))
    return done, steps


@pytest.mark.parametrize("module", [plan, targets])
def test_examples_in_the_text_are_right(module):
    assert doctest.testmod(module).failed == 0


@pytest.mark.parametrize("spp", [1, 3, 16, 100, 1000])
def test_steps_add_up_and_are_bounded(spp):
    for limits in all_limits():
        steps = list(plan.steps(spp, limits))
        sizes = [step.spp for step in steps]
        assert sum(sizes) == spp and min(sizes) >= 1
        assert [step.index for step in steps] == list(range(len(steps)))
        if len(steps) > 1:
            assert max(sizes) == limits.largest() or not limits.indexed
            assert max(sizes) * limits.pixels <= max(plan.MOST_SAMPLES[limits.backend], 2**25)
            assert len(set(sizes[:-1])) == 1


@pytest.mark.parametrize("spp", [1, 3, 16, 100, 1000])
def test_passes_have_every_sample_of_every_pixel_once(spp):
    for limits in all_limits():
        if spp * limits.pixels <= plan.SINGLE_STEP_SAMPLES or not limits.indexed:
            continue
        covered = {kind: [] for kind in ("sixteenth", "others")}
        for step in plan.steps(spp, limits):
            for one in step.passes:
                samples = range(one.first, one.first + one.count)
                if one.role in (ALL, TRAIN):
                    covered["sixteenth"] += samples
                if one.role in (ALL, OTHERS):
                    covered["others"] += samples
        assert covered == {"sixteenth": list(range(spp)), "others": list(range(spp))}


@pytest.mark.parametrize("spp", [1, 2, 3, 16, 100, 1000])
@pytest.mark.parametrize("pixels", [*SIZES, 15, 16, 17, 1000, 2**21, 2**21 + 16])
def test_integrators_make_the_same_passes(spp, pixels):
    """What they train with where there is no plan, and what plans train with, is one rule."""
    core = pytest.importorskip("manylights._core")
    expected = [(one.first, one.count, one.role) for one in plan.passes(0, spp, Limits(pixels))]
    assert core.learning_passes(spp, pixels) == expected


def test_training_comes_first_and_once():
    for limits in all_limits():
        roles = [one.role for step in plan.steps(64, limits) for one in step.passes]
        others = roles.index(OTHERS) if OTHERS in roles else 0
        assert (others in (1, 2)) == bool(limits.learns and roles)
        assert set(roles[:others]) <= {TRAIN} and set(roles[others + 1 :]) <= {ALL}


def test_samplers_without_samples_by_index_begin_a_sequence_in_each_step():
    for limits in all_limits():
        if not limits.indexed:
            steps = list(plan.steps(1000, limits))
            assert all(one.first == 0 for step in steps[1:] for one in step.passes)


@pytest.mark.parametrize(
    ("backend", "pixels", "size"),
    [
        ("scalar", 640 * 360, 16),
        ("scalar", 1920 * 1080, 2),
        ("scalar", 3840 * 2160, 1),
        ("llvm", 640 * 360, 128),
        ("llvm", 3840 * 2160, 4),
        ("cuda", 3840 * 2160, 32),
    ],
)
def test_steps_take_seconds(backend, pixels, size):
    assert Limits(pixels, backend).largest() == size


@pytest.mark.parametrize(("pixels", "size"), [(640 * 360, 16), (1920 * 1080, 4), (3840 * 2160, 4)])
def test_steps_of_other_samplers_stratify_in_scalar_variants(pixels, size):
    assert Limits(pixels, "scalar", indexed=False).largest() == size


def test_seeds_of_sequences_differ_and_the_first_is_the_seed():
    seeds = [plan.seed_of(seed, number) for seed in range(20) for number in range(20)]
    assert len(set(seeds)) == 400
    assert plan.seed_of(7, 0) == 7


@pytest.mark.parametrize("pixels", [1024 * 1024, 1024 * 768, 1920 * 1080])
def test_no_sequence_repeats_another_in_scalar_variants(pixels):
    """Mitsuba multiplies the seed by the number of pixels, in 32 bits."""
    for seed in range(5):
        seeds = {plan.seed_of(seed, number) * pixels % 2**32 for number in range(4096)}
        assert len(seeds) == 4096


@pytest.mark.parametrize("exponent", [0.8, 1.0, 1.3, 2.0])
@pytest.mark.parametrize("target", [0.2, 0.05, 0.03])
@pytest.mark.parametrize("pixels", SIZES[1:])
def test_noise_that_follows_the_law_is_met(exponent, target, pixels):
    """At the smallest number of samples in the grain of the last round where the law says so."""
    law = PowerLaw(2**30, 2.0**-30, exponent)

    def noise_of(samples):
        return 0.7 * law.noise(samples * 2**10) / law.noise(2**10)

    course = Course(2**20, Limits(pixels), noise=target)
    done, _ = follow(course, noise_of)
    assert len(set(done.samples)) == 1
    rounds = [course.goal(done.noises[:index])[0] for index in range(len(done.noises))]
    assert done.noises[-1] <= target * 1.0001
    if len(rounds) > 2:
        grain = max(rounds[-2] // targets.GRAIN, 1)
        assert noise_of(rounds[-1] - grain) > target


def test_nobody_looks_again_after_the_last_round():
    """Not even if the noise is then far from what was predicted."""
    course = Course(2**20, Limits(640 * 360), noise=0.03)
    last = follow(course, lambda samples: 0.5 / math.sqrt(samples))[0].samples[0]

    def noise_with(surprise):
        return lambda samples: 0.5 / math.sqrt(samples) * (surprise if samples == last else 1.0)

    good, bad = (follow(course, noise_with(factor)) for factor in (0.1, 3.0))
    assert good[0].samples == bad[0].samples == [last] * 4 and good[1] == bad[1]


@pytest.mark.parametrize("spp", [1, 2, 3, 7, 100])
def test_limit_of_samples_ends_what_cannot_be_reached(spp):
    course = Course(spp, Limits(640 * 360), noise=1e-6)
    done, _ = follow(course, lambda samples: 0.5)
    assert spp - course.sequences < done.spp <= spp
    assert follow(Course(64, Limits(100), noise=0.1), lambda _: math.nan)[0].spp == 64


def test_black_images_have_no_noise_and_end():
    done, _ = follow(Course(2**16, Limits(640 * 360), noise=0.1), lambda samples: 0.0)
    assert len(done.noises) == 2


@pytest.mark.parametrize("speed", [1e5, 3e6, 1e8])
@pytest.mark.parametrize("asked", [1.0, 60.0, 3600.0])
@pytest.mark.parametrize("pixels", SIZES[1:])
def test_time_is_kept_to_five_percent_or_a_step(speed, asked, pixels):
    """The first step takes longer: kernels are compiled."""

    def seconds_of(step):
        return 0.02 + step.spp * pixels / speed + (0.3 if step.index == 0 else 0.0)

    course = Course(2**24, Limits(pixels), seconds=asked)
    done, steps = follow(course, lambda samples: 0.1, seconds_of)
    shortest = seconds_of(Step((), 1, 0, 1))
    assert abs(done.seconds - asked) <= max(0.05 * asked, shortest, seconds_of(steps[0]))


def test_sequences_take_turns():
    course = Course(640, Limits(640 * 360), noise=1e-9)
    _, steps = follow(course)
    done = History([0] * 4)
    for step in steps:
        done.add(step, 0.0)
        assert max(done.samples) - min(done.samples) <= step.spp
    assert len(set(done.samples)) == 1


# -------------------------------------------------------------------------- steps out of their turn


def courses():
    """Renders with and without a noise as the target, of all kinds of samplers."""
    limits = [Limits(640 * 360, indexed=indexed) for indexed in (True, False)]
    return [
        *(Course(spp, one) for spp in (1, 300, 3000) for one in limits),
        *(Course(5000, one, noise=0.01) for one in limits),
        *(Course(3000, one, part=targets.Part(2, 3)) for one in limits),
    ]


@pytest.mark.parametrize("course", courses(), ids=str)
def test_open_steps_are_those_in_turn(course):
    """Whoever takes all that can be rendered now, in any order, renders the same steps."""

    def noise_of(samples):
        return samples**-0.7

    expected, steps = follow(course, noise_of)
    done, found, chance = History([0] * course.sequences), [], random.Random(4)
    while current := list(course.open_steps(done)):
        # Some are left for the next question, as of a render that was interrupted.
        for number, step in chance.sample(current, max(len(current) * 2 // 3, 1)):
            done.add(step, 0.0, number)
            found.append((number, step))
        if course.round_is_complete(done):
            done.noises.append(noise_of(min(done.samples)))
        first = course.next_step(done)
        assert first is None or done.steps == steps.index(first)
    assert [step for _, step in sorted(found, key=lambda one: one[0])] == steps
    assert [number for number, _ in sorted(found, key=lambda one: one[0])] == list(
        range(len(steps))
    )
    assert (done.samples, done.noises, done.steps) == (
        expected.samples,
        expected.noises,
        expected.steps,
    )
    assert done.ahead == [] and course.next_step(done) is None


def test_times_have_no_open_steps():
    assert not list(Course(100, Limits(500), seconds=9.0).open_steps(History([0] * 4)))


@pytest.mark.parametrize("course", courses(), ids=str)
def test_lesson_is_what_the_first_step_begins_with(course):
    first = Course(course.spp, course.limits, course.noise).next_step(History([0] * 4))
    lesson = course.lesson()
    assert (lesson is None) == (not first.trains)
    if lesson is not None:
        assert lesson.passes == first.passes[: len(lesson.passes)]
        assert all(one.role == TRAIN for one in lesson.passes)
        assert not any(one.role == TRAIN for one in first.passes[len(lesson.passes) :])


# ---------------------------------------------------------------------- what workers get at a time


def shares_of(count):
    """The steps of a render with nobody at work yet."""
    return Shares((number, Step((), 1, 0, number)) for number in range(count))


def test_runs_take_half_a_minute_and_shrink_to_the_end():
    shares, sizes = shares_of(100), []
    assert shares.take(None, 4).numbers == [0]
    while len(shares):
        sizes.append(len(shares.take(4.0, 4).steps))
    assert sizes[0] == 7 and sizes == sorted(sizes, reverse=True) and sizes[-8:] == [1] * 8
    assert sum(sizes) == 99
    assert shares_of(10).take(1e-9, 1).numbers == [0, 1, 2, 3, 4]
    assert shares_of(10).take(70.0, 1).numbers == [0]


def test_what_comes_back_is_given_out_again():
    shares = shares_of(40)
    first, second = shares.take(5.0, 1), shares.take(5.0, 1)
    assert (first.numbers, second.numbers) == ([0, 1, 2, 3, 4, 5], [6, 7, 8, 9, 10, 11])
    assert second.words() == "steps 7 to 12" and second.spp == 6
    shares.give_back(second)
    assert shares.take(5.0, 1).numbers == second.numbers
    shares.give_back(first)
    assert shares.take(1.0, 1).numbers == first.numbers, "consecutive steps only"


def test_steps_that_end_workers_are_found():
    """Alone, so that those beside it are not blamed."""
    shares = shares_of(40)
    assert not shares.lose(shares.take(5.0, 1))
    for _ in range(2):
        runs = [shares.take(5.0, 1) for _ in range(6)]
        assert [run.numbers for run in runs] == [[number] for number in range(6)]
        fatal = [shares.lose(run) for run in runs if run.numbers == [3]]
        for run in runs:
            if run.numbers != [3]:
                shares.give_back(run)
    assert fatal == [True] and runs[3].words() == "step 4"
