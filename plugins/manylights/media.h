#pragma once

/**
 * Participating media: which ones a scene has, free flights along a path, and what they
 * leave of the light along a shadow ray.
 *
 * One homogeneous piece of a ray is handled in closed form. Heterogeneous media are tracked
 * against their majorant in small loops of their own, so that the rest of a path's kernel
 * does not run once for every tentative collision.
 */

#include "loop.h"
#include "scene_shapes.h"
#include <drjit/random.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/medium.h>
#include <mitsuba/render/phase.h>
#include <mitsuba/render/scene.h>

namespace manylights {

/// What kinds of media there are: code for others is not even recorded
struct MediaKinds {
    bool any = false, homogeneous = false, heterogeneous = false;

    template <typename Medium> void add(const Medium *medium) {
        if (!medium)
            return;
        any                                                      = true;
        (medium->is_homogeneous() ? homogeneous : heterogeneous) = true;
    }
};

template <typename Float, typename Spectrum> class Media {
public:
    MI_IMPORT_TYPES(Scene, Sampler, BSDFPtr, MediumPtr)
    using Rng = dr::PCG32<dr::uint32_array_t<dr::detached_t<Float>>>;

    /// The media of the scene's shapes, within groups, too, and of its sensors
    static MediaKinds find(const Scene *scene) {
        MediaKinds kinds;
        for_each_shape(scene, [&](const auto *shape) {
            kinds.add(shape->interior_medium());
            kinds.add(shape->exterior_medium());
        });
        for (const auto &sensor : scene->sensors())
            kinds.add(sensor->medium());
        return kinds;
    }

    Media(const Scene *scene, const MediaKinds &kinds) : m_scene(scene), m_kinds(kinds) {}

    const MediaKinds &kinds() const { return m_kinds; }

    /// What became of a ray within the medium that it starts in
    struct Flight {
        MediumInteraction3f mei;
        /// Did it scatter before it reached the surface?
        Mask scattered;
        /// Transmittance times scattering coefficient (if it scattered), over the density
        UnpolarizedSpectrum weight;
        DRJIT_STRUCT(Flight, mei, scattered, weight)
    };

    /// Density of a distance from the densities of the channels that may be chosen for it
    static Float channel_mean(const UnpolarizedSpectrum &density) {
        if constexpr (mitsuba::is_rgb_v<Spectrum>)
            return dr::mean(density);
        else
            return density.entry(0);
    }

    /// Sample a flight over at most `distance`; lanes that are not `active` stay put
    Flight fly(const MediumPtr &medium, const Ray3f &ray, const Float &distance,
               Sampler *sampler, Mask active) const {
        struct State {
            Mask active;
            Ray3f ray;
            Float distance;
            Flight flight;
            Sampler *sampler;
            DRJIT_STRUCT(State, active, ray, distance, flight, sampler)
        };
        State state{ active, ray, distance, dr::zeros<Flight>(), sampler };
        state.flight.weight = UnpolarizedSpectrum(1.f);
        auto step           = [&](State &s) {
            Collision c = collide(medium, s.ray, s.distance, s.sampler->next_1d(s.active),
                                  s.active);
            Float null_probability = dr::detach(dr::mean(c.null_fraction));
            Mask null = c.hit && m_kinds.heterogeneous &&
                        (m_kinds.heterogeneous ? s.sampler->next_1d(s.active)
                                               : Float(1.f)) < null_probability;
            UnpolarizedSpectrum factor =
                c.weight *
                dr::select(
                    null, c.mei.sigma_n / null_probability,
                    dr::select(c.hit, c.mei.sigma_s / (1.f - null_probability), 1.f));
            dr::masked(s.flight.weight, s.active) = s.flight.weight * factor;
            dr::masked(s.flight.mei, s.active)    = c.mei;
            s.flight.scattered |= s.active && c.hit && !null;
            s.active &= null;
            dr::masked(s.ray.o, s.active)    = c.mei.p;
            dr::masked(s.distance, s.active) = s.distance - c.mei.t;
        };
        if (m_kinds.heterogeneous)
            loop(state, [](const State &s) { return s.active; }, step, "Media: flight");
        else if (dr::any_or<true>(active))
            step(state);
        return state.flight;
    }

    /**
     * What is left of light that travels from a point to another one through media and
     * surfaces that let it pass straight on; 0 if anything else is in between.
     *
     * @param medium  medium around the origin of the ray, null for none
     */
    MI_NOINLINE Spectrum transmittance(const Ray3f &to_light, const MediumPtr &medium,
                                       const Rng &rng, Mask active) const {
        struct State {
            Mask active;
            Ray3f ray;
            MediumPtr medium;
            Spectrum result;
            Rng rng;
            DRJIT_STRUCT(State, active, ray, medium, result, rng)
        };
        State state{ active, to_light, medium, Spectrum(1.f), rng };
        loop(
            state, [](const State &s) { return s.active; },
            [&](State &s) {
                SurfaceInteraction3f si = m_scene->ray_intersect(s.ray, s.active);
                // A shadow ray ends a little before the light, its medium does not
                constexpr auto gap = mitsuba::math::ShadowEpsilon<Float>;
                Float distance =
                    dr::select(si.is_valid(), si.t, s.ray.maxt / (1.f - gap));
                Mask inside = s.active && s.medium != nullptr;
                if (dr::any_or<true>(inside))
                    dr::masked(s.result, inside) =
                        s.result *
                        within_medium(s.medium, s.ray, distance, s.rng, inside);
                s.active &= si.is_valid();
                if (dr::none_or<false>(s.active))
                    return;
                cross(s, si);
            },
            "Media: transmittance");
        return state.result;
    }

    /// The medium on the side of `si` that the direction d points to
    MediumPtr medium_beyond(const SurfaceInteraction3f &si, const MediumPtr &current,
                            const Vector3f &d, Mask active) const {
        MediumPtr result = current;
        active &= si.is_valid();
        if constexpr (!dr::is_jit_v<Float>) {
            if (!active)
                return result;
        }
        Mask border                = active && si.is_medium_transition();
        dr::masked(result, border) = si.target_medium(d);
        return result;
    }

private:
    /// A tentative collision, or a free flight to the end of the distance
    struct Collision {
        MediumInteraction3f mei;
        Mask hit;
        /// Transmittance over the density of the distance
        UnpolarizedSpectrum weight;
        UnpolarizedSpectrum null_fraction;
    };

    /**
     * One step of tracking. In RGB variants the distance follows the majorant of a random
     * channel and its density is the mean of the channels', which bounds the weight where
     * the extinction varies between them; in spectral ones it follows the first wavelength.
     * The distance is not differentiated, what is evaluated there is.
     */
    Collision collide(const MediumPtr &medium, Ray3f ray, const Float &distance, Float u,
                      Mask active) const {
        using UInt32 = dr::uint32_array_t<Float>;
        UInt32 channel(0);
        if constexpr (mitsuba::is_rgb_v<Spectrum>) {
            channel = dr::minimum(UInt32(u * 3.f), 2u);
            u       = dr::minimum(u * 3.f - Float(channel), dr::OneMinusEpsilon<Float>);
        }
        ray.maxt = distance;
        Collision c{ medium->sample_interaction(ray, u, channel, active), false, 0.f,
                     0.f };
        c.mei.t = dr::detach(c.mei.t);
        c.mei.p = dr::detach(c.mei.p);
        c.hit   = active && c.mei.is_valid() && c.mei.t <= distance;

        UnpolarizedSpectrum majorant = c.mei.combined_extinction;
        // Finite, so that no extinction over no end leaves 1
        Float length =
            dr::minimum(dr::minimum(c.mei.t, distance) - c.mei.mint, dr::Largest<Float>);
        UnpolarizedSpectrum tr = dr::exp(-length * majorant);
        Float density   = dr::detach(channel_mean(dr::select(c.hit, tr * majorant, tr)));
        c.weight        = dr::select(density > 0.f, tr / density, 0.f);
        c.null_fraction = dr::select(majorant > 0.f, c.mei.sigma_n / majorant, 0.f);
        return c;
    }

    /// Transmittance of a piece of a ray, closed form or ratio tracking
    UnpolarizedSpectrum within_medium(const MediumPtr &medium, const Ray3f &ray,
                                      const Float &distance, Rng &rng,
                                      Mask active) const {
        Mask homogeneous = active;
        if (m_kinds.heterogeneous)
            homogeneous &= medium->is_homogeneous();
        UnpolarizedSpectrum result(1.f);
        if (dr::any_or<true>(homogeneous)) {
            MediumInteraction3f mei   = dr::zeros<MediumInteraction3f>();
            mei.p                     = ray.o;
            mei.wi                    = -ray.d;
            mei.sh_frame              = Frame3f(mei.wi);
            mei.time                  = ray.time;
            mei.wavelengths           = ray.wavelengths;
            UnpolarizedSpectrum sigma = medium->get_majorant(mei, homogeneous);
            dr::masked(result, homogeneous) =
                dr::exp(-dr::minimum(distance, dr::Largest<Float>) * sigma);
        }
        Mask track = active && !homogeneous;
        if (m_kinds.heterogeneous && dr::any_or<true>(track))
            dr::masked(result, track) = track_ratio(medium, ray, distance, rng, track);
        return result;
    }

    /// Product of the fractions of null collisions along a piece of a ray
    UnpolarizedSpectrum track_ratio(const MediumPtr &medium, const Ray3f &ray,
                                    const Float &distance, Rng &rng, Mask active) const {
        struct State {
            Mask active;
            Ray3f ray;
            Float distance;
            UnpolarizedSpectrum result;
            Rng rng;
            DRJIT_STRUCT(State, active, ray, distance, result, rng)
        };
        State state{ active, ray, distance, UnpolarizedSpectrum(1.f), std::move(rng) };
        loop(
            state, [](const State &s) { return s.active; },
            [&](State &s) {
                Float u     = s.rng.template next_float<dr::detached_t<Float>>();
                Collision c = collide(medium, s.ray, s.distance, u, s.active);
                dr::masked(s.result, s.active) =
                    s.result * c.weight * dr::select(c.hit, c.mei.sigma_n, 1.f);
                s.active &= c.hit && dr::any(s.result != 0.f);
                dr::masked(s.ray.o, s.active)    = c.mei.p;
                dr::masked(s.distance, s.active) = s.distance - c.mei.t;
            },
            "Media: ratio tracking");
        rng = std::move(state.rng);
        return state.result;
    }

    /// Pass the surface that a shadow ray has reached
    template <typename State> void cross(State &s, const SurfaceInteraction3f &si) const {
        BSDFPtr bsdf                   = si.bsdf();
        Spectrum value                 = bsdf->eval_null_transmission(si, s.active);
        value                          = si.to_world_mueller(value, si.wi, si.wi);
        dr::masked(s.result, s.active) = s.result * value;
        Float left                     = s.ray.maxt - si.t;
        Ray3f next                     = si.spawn_ray(s.ray.d);
        next.maxt                      = left;
        dr::masked(s.ray, s.active)    = next;
        s.medium                       = medium_beyond(si, s.medium, s.ray.d, s.active);
        s.active &= left > 0.f && dr::any(mitsuba::unpolarized_spectrum(s.result) != 0.f);
    }

    const Scene *m_scene;
    MediaKinds m_kinds;
};

} // namespace manylights
