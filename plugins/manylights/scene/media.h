#pragma once

/**
 * Participating media: free flights along a path, and what is left of the light along a
 * shadow ray.
 *
 * One homogeneous piece of a ray is handled in closed form. Heterogeneous media are tracked
 * against their majorant in small loops of their own, so that the rest of a path's kernel
 * does not run once for every tentative collision.
 */

#include "collisions.h"
#include "manylights/base/loop.h"
#include "shadow_ray.h"
#include <drjit/random.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/medium.h>
#include <mitsuba/render/phase.h>
#include <mitsuba/render/scene.h>

namespace manylights {

template <typename Float, typename Spectrum> class Media {
public:
    MI_IMPORT_TYPES(Scene, Sampler, BSDFPtr, MediumPtr)
    using Collision = manylights::Collision<Float, Spectrum>;
    using Rng       = dr::PCG32<dr::uint32_array_t<dr::detached_t<Float>>>;

    Media(const Scene *scene, const MediaKinds &kinds)
        : m_scene(scene), m_kinds(kinds), m_collisions(kinds) {}

    const MediaKinds &kinds() const { return m_kinds; }

    /// What became of a ray within the medium that it starts in
    struct Flight {
        MediumInteraction3f mei;
        /// Did it scatter before it reached the surface?
        Mask scattered;
        /// Transmittance times scattering coefficient (if it scattered), over the density
        UnpolarizedSpectrum weight;
        /// \ref Collisions::next
        UnpolarizedSpectrum densities;
        DRJIT_STRUCT(Flight, mei, scattered, weight, densities)
    };

    /// Sample a flight over at most `distance`; lanes that are not `active` stay put
    Flight fly(const MediumPtr &medium, const Ray3f &ray, const Float &distance,
               const UnpolarizedSpectrum &densities, Sampler *sampler,
               Mask active) const {
        struct State {
            Mask active;
            Ray3f ray;
            Float distance;
            Flight flight;
            Sampler *sampler;
            DRJIT_STRUCT(State, active, ray, distance, flight, sampler)
        };
        State state{ active, ray, distance, dr::zeros<Flight>(), sampler };
        state.flight.weight    = UnpolarizedSpectrum(1.f);
        state.flight.densities = densities;
        auto step              = [&](State &s) {
            Collision c = m_collisions.next(medium, s.ray, s.distance, s.flight.densities,
                                            s.sampler->next_1d(s.active), s.active);
            Float null_probability = dr::mean(c.densities * c.null_fraction);
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
            if (m_kinds.chromatic) {
                UnpolarizedSpectrum event = dr::select(
                    null, c.null_fraction / null_probability,
                    dr::select(c.hit, (1.f - c.null_fraction) / (1.f - null_probability),
                               1.f));
                dr::masked(s.flight.densities, s.active) = c.densities * event;
            }
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

    /// Transmittance of a piece of a ray in a homogeneous medium
    static UnpolarizedSpectrum transmittance(const MediumInteraction3f &mei,
                                             const Float &distance) {
        return dr::exp(-dr::minimum(distance, dr::Largest<Float>) *
                       mei.combined_extinction);
    }

    /**
     * What is left of light that travels from a point to another one through media and
     * surfaces that let it pass straight on; 0 if anything else is in between.
     *
     * Rays start a little off a surface and end a little before the light; pieces in media are
     * measured along the line between the points themselves.
     *
     * @param close   may rays end close to the second point?
     * @param medium  medium around the first point, null for none
     */
    MI_NOINLINE Spectrum transmittance(const Interaction3f &from, const Point3f &to,
                                       const Mask &close, const MediumPtr &medium,
                                       Rng &rng, Mask active) const {
        Ray3f ray    = shadow_ray(from, to, close);
        Mask blocked = m_scene->ray_test(ray, active), clear = active && !blocked;
        Spectrum result(0.f);
        // Most rays meet nothing: cheaper to find out than what they meet, and where
        if (dr::any_or<true>(clear)) {
            result      = Spectrum(1.f) & clear;
            Mask inside = clear && medium != nullptr;
            if (dr::any_or<true>(inside)) {
                Float distance = dr::norm(to - from.p);
                ray.o          = from.p;
                ray.d          = (to - from.p) / distance;
                dr::masked(result, inside) =
                    within_medium(medium, ray, distance, rng, inside);
            }
        }
        if (m_kinds.borders && dr::any_or<true>(blocked))
            dr::masked(result, blocked) =
                through_borders(from, to, close, medium, rng, blocked);
        return result;
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
    /// The same, piece by piece
    Spectrum through_borders(const Interaction3f &from, const Point3f &to,
                             const Mask &close, const MediumPtr &medium, Rng &rng,
                             Mask active) const {
        struct State {
            Mask active;
            Ray3f ray;
            /// Distance of the last border from the first point
            Float reached;
            MediumPtr medium;
            Spectrum result;
            Rng rng;
            DRJIT_STRUCT(State, active, ray, reached, medium, result, rng)
        };
        Float distance = dr::norm(to - from.p);
        Vector3f d     = (to - from.p) / distance;
        State state{ active,        shadow_ray(from, to, close),
                     Float(0.f),    medium,
                     Spectrum(1.f), std::move(rng) };
        loop(
            state, [](const State &s) { return s.active; },
            [&](State &s) {
                auto pi = m_scene->ray_intersect_preliminary(s.ray, false, s.active);
                SurfaceInteraction3f si              = dr::zeros<SurfaceInteraction3f>();
                Mask hit                             = s.active && pi.is_valid();
                Mask passes                          = find_border(s.ray, pi, si, hit);
                dr::masked(s.result, hit && !passes) = Spectrum(0.f);
                s.active &= !hit || passes;

                Float end   = dr::select(passes, crossing(from.p, d, si), distance);
                Mask inside = s.active && s.medium != nullptr;
                if (dr::any_or<true>(inside)) {
                    Ray3f piece = s.ray;
                    piece.o     = dr::fmadd(d, s.reached, from.p);
                    piece.d     = d;
                    dr::masked(s.result, inside) =
                        s.result * within_medium(s.medium, piece,
                                                 dr::maximum(end - s.reached, 0.f), s.rng,
                                                 inside);
                }
                s.reached = end;
                s.active &= passes;
                if (dr::none_or<false>(s.active))
                    return;
                cross(s, si, to, close);
            },
            "Media: transmittance");
        rng = std::move(state.rng);
        return state.result;
    }

    /// Where the straight line meets a border: rays behind others start aside of it, and would
    /// leave a slanted slab early
    static Float crossing(const Point3f &from, const Vector3f &d,
                          const SurfaceInteraction3f &si) {
        Float slope = dr::dot(d, si.n), along = dr::dot(si.p - from, d);
        return dr::select(dr::abs(slope) > .05f, dr::dot(si.p - from, si.n) / slope,
                          along);
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
            MediumInteraction3f mei         = dr::zeros<MediumInteraction3f>();
            mei.p                           = ray.o;
            mei.wi                          = -ray.d;
            mei.sh_frame                    = Frame3f(mei.wi);
            mei.time                        = ray.time;
            mei.wavelengths                 = ray.wavelengths;
            mei.combined_extinction         = medium->get_majorant(mei, homogeneous);
            dr::masked(result, homogeneous) = transmittance(mei, distance);
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
            UnpolarizedSpectrum result, densities;
            Rng rng;
            DRJIT_STRUCT(State, active, ray, distance, result, densities, rng)
        };
        State state{ active,
                     ray,
                     distance,
                     UnpolarizedSpectrum(1.f),
                     UnpolarizedSpectrum(1.f),
                     std::move(rng) };
        loop(
            state, [](const State &s) { return s.active; },
            [&](State &s) {
                Float u     = s.rng.template next_float<dr::detached_t<Float>>();
                Collision c = m_collisions.next(medium, s.ray, s.distance, s.densities, u,
                                                s.active);
                dr::masked(s.result, s.active) =
                    s.result * c.weight * dr::select(c.hit, c.mei.sigma_n, 1.f);
                if (m_kinds.chromatic)
                    dr::masked(s.densities, s.active) = c.densities;
                s.active &= c.hit && dr::any(s.result != 0.f);
                dr::masked(s.ray.o, s.active)    = c.mei.p;
                dr::masked(s.distance, s.active) = s.distance - c.mei.t;
            },
            "Media: ratio tracking");
        rng = std::move(state.rng);
        return state.result;
    }

    /// Fills `si` where a surface lets light pass straight on, and returns where that is
    Mask find_border(const Ray3f &ray, PreliminaryIntersection3f &pi,
                     SurfaceInteraction3f &si, Mask hit) const {
        constexpr auto null = mitsuba::BSDFFlags::Null;
        // Which shape of an instance was hit is not known yet
        Mask instance = false, passes = false;
        if (!m_scene->shapegroups().empty())
            instance = hit && pi.shape == nullptr;
        Mask known = hit && !instance;
        if (dr::any_or<true>(known))
            passes = known && has_flag(pi.shape->bsdf()->flags(), null);
        passes |= instance;
        if (dr::any_or<true>(passes))
            si = pi.compute_surface_interaction(ray, +mitsuba::RayFlags::All, passes);
        if (dr::any_or<true>(instance))
            passes &= !instance || has_flag(si.bsdf()->flags(), null);
        return passes;
    }

    /// Pass the surface that a shadow ray to a point has reached
    template <typename State>
    void cross(State &s, const SurfaceInteraction3f &si, const Point3f &to,
               const Mask &close) const {
        BSDFPtr bsdf                   = si.bsdf();
        Spectrum value                 = bsdf->eval_null_transmission(si, s.active);
        value                          = si.to_world_mueller(value, si.wi, si.wi);
        dr::masked(s.result, s.active) = s.result * value;
        // It starts a little aside, so it has to be aimed again
        Ray3f next = shadow_ray<Float, Spectrum>(si, to, close);
        // Curved borders near its end, and points beside these, would be met for ever
        Float missing = ray_epsilon<Float>(next.o) - dr::dot(next.o - s.ray.o, s.ray.d);
        missing       = dr::detach(dr::maximum(missing, 0.f));
        next.o += missing * next.d;
        next.maxt -= missing;
        Mask ahead                  = next.maxt > 0.f && dr::dot(next.d, s.ray.d) > 0.f;
        s.medium                    = medium_beyond(si, s.medium, s.ray.d, s.active);
        dr::masked(s.ray, s.active) = next;
        s.active &= ahead && dr::any(mitsuba::unpolarized_spectrum(s.result) != 0.f);
    }

    const Scene *m_scene;
    MediaKinds m_kinds;
    Collisions<Float, Spectrum> m_collisions;
};

} // namespace manylights
