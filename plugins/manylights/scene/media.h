#pragma once

/**
 * Participating media: free flights along a path, and what is left of the light along a
 * shadow ray.
 *
 * One homogeneous piece of a ray is handled in closed form. Heterogeneous media are tracked
 * against their majorant in small loops of their own, so that the rest of a path's kernel
 * does not run once for every tentative collision.
 */

#include "manylights/base/loop.h"
#include "media_kinds.h"
#include <drjit/random.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/medium.h>
#include <mitsuba/render/phase.h>
#include <mitsuba/render/scene.h>

namespace manylights {

template <typename Float, typename Spectrum> class Media {
public:
    MI_IMPORT_TYPES(Scene, Sampler, BSDFPtr, MediumPtr)
    using Rng = dr::PCG32<dr::uint32_array_t<dr::detached_t<Float>>>;

    Media(const Scene *scene, const MediaKinds &kinds) : m_scene(scene), m_kinds(kinds) {}

    const MediaKinds &kinds() const { return m_kinds; }

    /// What became of a ray within the medium that it starts in
    struct Flight {
        MediumInteraction3f mei;
        /// Did it scatter before it reached the surface?
        Mask scattered;
        /// Transmittance times scattering coefficient (if it scattered), over the density
        UnpolarizedSpectrum weight;
        /// \ref collide
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
            Collision c = collide(medium, s.ray, s.distance, s.flight.densities,
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
     * @param medium  medium around the first point, null for none
     */
    MI_NOINLINE Spectrum transmittance(const Interaction3f &from, const Point3f &to,
                                       const MediumPtr &medium, Rng &rng,
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
        State state{ active, from.spawn_ray_to(to), Float(0.f),
                     medium, Spectrum(1.f),         std::move(rng) };
        loop(
            state, [](const State &s) { return s.active; },
            [&](State &s) {
                auto pi = m_scene->ray_intersect_preliminary(s.ray, false, s.active);
                SurfaceInteraction3f si              = dr::zeros<SurfaceInteraction3f>();
                Mask hit                             = s.active && pi.is_valid();
                Mask passes                          = find_border(s.ray, pi, si, hit);
                dr::masked(s.result, hit && !passes) = Spectrum(0.f);
                s.active &= !hit || passes;

                Float end   = dr::select(passes, dr::dot(si.p - from.p, d), distance);
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
                cross(s, si, pi.t);
            },
            "Media: transmittance");
        rng = std::move(state.rng);
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
        UnpolarizedSpectrum densities;
    };

    /**
     * One step of tracking. Where the extinction varies between wavelengths or channels, a
     * random one is followed, its majorant and its chance of a null collision. The density of
     * a path is the mean of those that each of them would have given *all* of it (spectral
     * MIS), so that no weight exceeds their number, however many collisions there are.
     *
     * @param densities  of the path so far, for each channel, over their mean: the chances of
     *                   channels to be followed. They are not differentiated, nor is the
     *                   distance; what is evaluated there is.
     */
    Collision collide(const MediumPtr &medium, Ray3f ray, const Float &distance,
                      const UnpolarizedSpectrum &densities, Float u, Mask active) const {
        UInt32 channel(0);
        if (m_kinds.chromatic_majorants)
            std::tie(channel, u) = choose_channel(densities, u);
        ray.maxt = distance;
        Collision c{ medium->sample_interaction(ray, u, channel, active), false, 0.f, 0.f,
                     densities };
        Float end = distance;
        if (m_kinds.heterogeneous) {
            // The medium may end before the surface does, or be missed
            auto [met, near, far] = medium->intersect_aabb(ray);
            met &= dr::isfinite(near) || dr::isfinite(far);
            end = dr::select(met, dr::minimum(distance, far), c.mei.mint);
        }
        if constexpr (mitsuba::is_spectral_v<Spectrum>)
            if (m_kinds.chromatic_majorants)
                follow_channel(c.mei, medium, ray, end, u, channel, active);
        c.mei.t = dr::detach(c.mei.t);
        c.mei.p = dr::detach(c.mei.p);
        c.hit   = active && c.mei.is_valid() && c.mei.t <= end;

        UnpolarizedSpectrum majorant = c.mei.combined_extinction;
        // Finite, so that no extinction over no end leaves 1
        Float length =
            dr::clip(dr::minimum(c.mei.t, end) - c.mei.mint, 0.f, dr::Largest<Float>);
        UnpolarizedSpectrum tr = dr::exp(-length * majorant);
        c.densities   = dr::detach(densities * dr::select(c.hit, tr * majorant, tr));
        Float density = dr::mean(c.densities);
        Mask possible = density > 0.f;
        c.weight      = dr::select(possible, tr / density, 0.f);
        c.densities   = dr::select(possible, c.densities / density, 1.f);
        // Extinctions may exceed a grid's majorant by rounding
        c.null_fraction = dr::detach(dr::clip(
            dr::select(majorant > 0.f, c.mei.sigma_n / majorant, 0.f), 0.f, 1.f));
        return c;
    }

    /// A channel, chosen by its density, and the number u used again
    static std::pair<UInt32, Float> choose_channel(const UnpolarizedSpectrum &densities,
                                                   const Float &u) {
        Float target = u * dr::sum(densities), below(0.f), begin(0.f), share(1.f);
        UInt32 channel(0);
        for (uint32_t i = 0; i < dr::size_v<UnpolarizedSpectrum>; ++i) {
            Float density                = densities.entry(i);
            Mask reached                 = target >= below && density > 0.f;
            dr::masked(channel, reached) = i;
            dr::masked(begin, reached)   = below;
            dr::masked(share, reached)   = density;
            below += density;
        }
        return { channel,
                 dr::clip((target - begin) / share, 0.f, dr::OneMinusEpsilon<Float>) };
    }

    /// A collision at the distance that a wavelength chooses: Mitsuba takes the first one
    void follow_channel(MediumInteraction3f &mei, const MediumPtr &medium,
                        const Ray3f &ray, const Float &end, const Float &u,
                        const UInt32 &channel, Mask active) const {
        Float sigma = mei.combined_extinction.entry(0);
        for (uint32_t i = 1; i < dr::size_v<UnpolarizedSpectrum>; ++i)
            sigma = dr::select(channel == i, mei.combined_extinction.entry(i), sigma);
        Float t = mei.mint - dr::log(1.f - u) / sigma;
        active &= t <= end;
        mei.t = dr::select(active, t, dr::Infinity<Float>);
        mei.p = ray(t);
        std::tie(mei.sigma_s, mei.sigma_n, mei.sigma_t) =
            medium->get_scattering_coefficients(mei, active);
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
                Float u = s.rng.template next_float<dr::detached_t<Float>>();
                Collision c =
                    collide(medium, s.ray, s.distance, s.densities, u, s.active);
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

    /// Pass the surface that a shadow ray has reached after the distance t
    template <typename State>
    void cross(State &s, const SurfaceInteraction3f &si, const Float &t) const {
        BSDFPtr bsdf                   = si.bsdf();
        Spectrum value                 = bsdf->eval_null_transmission(si, s.active);
        value                          = si.to_world_mueller(value, si.wi, si.wi);
        dr::masked(s.result, s.active) = s.result * value;
        Float left                     = s.ray.maxt - t;
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
