"""An integrator for direct light that visits every emitter at every shading point.

It shares no sampling decision with the light tree nor with Mitsuba's choice of one emitter: each
emitter is asked for a sample and weighed against BSDF sampling on its own. Its noise is that of
positions on emitters and of visibility only. It runs in JIT variants, where the loop over the
emitters is one symbolic loop.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def make_exhaustive(emitter_samples=True, bsdf_samples=True):
    """An exhaustive integrator of the current variant."""
    return exhaustive_class()(emitter_samples, bsdf_samples)


def multiply(*factors):
    """Product of spectra or, in polarized variants, of Mueller matrices; numbers are allowed."""
    product = mi.Spectrum(factors[0])
    for factor in factors[1:]:
        factor = mi.Spectrum(factor)
        product = product @ factor if mi.is_polarized else product * factor
    return product


def shadow_ray(si, to):
    """A ray that ends as far before a light as rays start from a surface there.

    Mitsuba's ``spawn_ray_to`` leaves out a share of its length: far lamps shine through shades.
    """
    ray = si.spawn_ray_to(to)
    epsilon = dr.epsilon(mi.Float) * 1500
    gap = (1 + dr.max(dr.abs(to))) * epsilon
    ray.maxt = dr.maximum(ray.maxt, ray.maxt / (1 - 10 * epsilon) - gap)
    return ray


def exhaustive_class():
    """The integrator's class; its base class depends on the current variant."""

    class Exhaustive(mi.SamplingIntegrator):
        """Sum over the emitters, each with multiple importance sampling against the BSDF."""

        def __init__(self, emitter_samples, bsdf_samples):
            super().__init__(mi.Properties())
            self.emitter_samples = emitter_samples
            self.bsdf_samples = bsdf_samples

        def sample(self, scene, sampler, ray, medium=None, active=True):
            """Radiance along the camera ray."""
            si = scene.ray_intersect(ray, mi.RayFlags.All, True, active)
            value = si.emitter(scene, active).eval(si, active)
            hit = active & si.is_valid()
            if self.emitter_samples:
                value += self.sum_over_emitters(scene, sampler, si, ray, hit)
            if self.bsdf_samples:
                value += self.bsdf_part(scene, sampler, si, ray, hit)
            return value, hit, []

        def weight(self, own, other):
            """Balance heuristic, or 1 if only one of the two strategies is in use."""
            if not (self.emitter_samples and self.bsdf_samples):
                return mi.Float(1)
            return dr.select(own > 0, own / (own + other), 0)

        def sum_over_emitters(self, scene, sampler, si, ray, active):
            """One sample of each emitter."""
            bsdf = si.bsdf(ray)
            active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            emitters = scene.emitters_dr()

            def add_emitter(index, value, sampler):
                emitter = dr.gather(mi.EmitterPtr, emitters, index, active)
                ds, light = emitter.sample_direction(si, sampler.next_2d(active), active)
                lit = active & (ds.pdf != 0)
                lit &= ~scene.ray_test(shadow_ray(si, ds.p), lit)
                wo = si.to_local(ds.d)
                scattered, bsdf_pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, lit)
                scattered = si.to_world_mueller(scattered, -wo, si.wi)
                weight = dr.select(ds.delta, 1, self.weight(ds.pdf, bsdf_pdf))
                added = multiply(weight, scattered, light)
                return index + 1, value + (added & lit), sampler

            def more(index, value, sampler):
                return index < len(emitters)

            start = (mi.UInt32(0), mi.Spectrum(0), sampler)
            return dr.while_loop(start, more, add_emitter)[1]

        def bsdf_part(self, scene, sampler, si, ray, active):
            """Emission that one BSDF sample finds."""
            bsdf = si.bsdf(ray)
            sample, scattered = bsdf.sample(
                mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active
            )
            scattered = si.to_world_mueller(scattered, -sample.wo, si.wi)
            light_si = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), active)
            emitter = light_si.emitter(scene, active)
            light = emitter.eval(light_si, active)
            weight = 1
            if self.emitter_samples:
                ds = mi.DirectionSample3f(scene, light_si, si)
                delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
                light_pdf = dr.select(delta, 0, emitter.pdf_direction(si, ds, active))
                weight = self.weight(sample.pdf, light_pdf)
            return multiply(weight, scattered, light) & active

    return Exhaustive
