#pragma once

/**
 * Paths from the camera, with the direct light of direct_light.h at every vertex.
 *
 * One step of the loop follows one piece of a path: a flight through the medium (if there
 * is one), the emission of what it ended on, the direct light of the vertex, the choice of
 * the next direction, Russian roulette, and the next intersection.
 *
 * Without media a path is that of Mitsuba's `path`; with media it is that of `volpath`:
 * surfaces that let light pass straight on do not count as vertices, and shadow rays pass
 * them, too.
 */

#include "direct_light.h"

namespace manylights {

/// Parameters of the paths, as Mitsuba's
struct PathLimits {
    uint32_t max_depth, rr_depth;
    bool hide_emitters;
};

/**
 * Go past the area emitters that are hit first along a ray. `pi` is the first intersection
 * and becomes the first one that is no emitter, with its distance from the ray's origin.
 */
template <typename Scene, typename Ray3f, typename Intersection, typename Mask>
void skip_emitters(const Scene *scene, const Ray3f &ray, Intersection &pi, Mask active) {
    using Float = typename Intersection::Float;
    struct State {
        Intersection pi;
        Float passed;
        Mask active;
        DRJIT_STRUCT(State, pi, passed, active)
    };
    State state{ pi, Float(0.f), active };
    auto on_emitter = [](const State &s) {
        Mask result = s.active && s.pi.is_valid();
        if constexpr (!dr::is_jit_v<Float>) // a null shape has no virtual functions
            return result && s.pi.shape->emitter() != nullptr;
        else
            return result && s.pi.shape->emitter() != nullptr;
    };
    loop(
        state, on_emitter,
        [&](State &s) {
            Ray3f rest = ray;
            rest.o     = ray(s.passed);
            auto si    = s.pi.compute_surface_interaction(
                rest, +mitsuba::RayFlags::Minimal, s.active);
            Ray3f next = si.spawn_ray(ray.d);
            s.passed   = dr::dot(next.o - ray.o, ray.d);
            s.pi       = scene->ray_intersect_preliminary(next, true, s.active);
        },
        "Paths: hidden emitters");
    pi = state.pi;
    pi.t += state.passed;
}

template <typename Float, typename Spectrum> class PathTracer {
public:
    MI_IMPORT_TYPES(Scene, Sampler, Medium, MediumPtr, BSDF, BSDFPtr)
    using DirectLight = manylights::DirectLight<Float, Spectrum>;
    using Lights      = SceneLights<Float, Spectrum>;
    using Vertex      = manylights::Vertex<Float, Spectrum>;
    using InMedium    = manylights::InMedium<Float, Spectrum>;
    using FloatD      = dr::detached_t<Float>;

    PathTracer(const Scene *scene, const Lights &lights, const MediaKinds &media,
               const SamplingParameters &params, const PathLimits &limits)
        : m_scene(scene), m_direct(scene, lights, params, media), m_limits(limits),
          m_media(media.any),
          m_sees_lights(lights.can_be_hit() || scene->environment() != nullptr) {}

    /// Radiance along a ray from the camera, and whether it met anything
    std::pair<Spectrum, Mask> trace(Sampler *sampler, const Ray3f &ray,
                                    const Medium *medium, Mask active) const {
        if (m_limits.max_depth == 0)
            return { Spectrum(0.f), Mask(false) };
        State state{ sampler, ray, medium, active };
        state.valid = !m_limits.hide_emitters && m_scene->environment() != nullptr;
        intersect(state, /* coherent = */ true);
        loop(
            state, [](const State &s) { return s.active; }, [&](State &s) { step(s); },
            "Paths");
        return { state.result & state.valid, state.valid };
    }

private:
    struct State {
        Mask active, valid;
        UInt32 depth;
        Ray3f ray;
        PreliminaryIntersection3f pi;
        MediumPtr medium;
        Spectrum throughput, result;
        Float eta;
        /// The vertex before, for the density of finding its lights by chance
        Receiver<FloatD> from;
        Float u_tree, pdf;
        /// Did the path leave it by a direction that light sampling cannot find?
        Mask specular;
        Sampler *sampler;
        DRJIT_STRUCT(State, active, valid, depth, ray, pi, medium, throughput, result,
                     eta, from, u_tree, pdf, specular, sampler)

        State(Sampler *sampler, const Ray3f &ray, const Medium *medium, Mask active)
            : active(active), valid(false), depth(0), ray(ray),
              pi(dr::zeros<PreliminaryIntersection3f>()), medium(medium),
              throughput(1.f), result(0.f), eta(1.f),
              from(dr::zeros<Receiver<FloatD>>()), u_tree(0.f), pdf(1.f), specular(true),
              sampler(sampler) {}
    };

    /// Where a path goes on
    struct Direction {
        Ray3f ray;
        Spectrum weight;
        Float pdf, eta;
        Mask specular, null;
    };

    void step(State &s) const {
        InMedium inside = fly(s);
        Mask surface    = s.active && !inside.scattered;
        SurfaceInteraction3f si =
            s.pi.compute_surface_interaction(s.ray, +mitsuba::RayFlags::All, surface);
        if (m_sees_lights)
            add_emission(s, si, surface);
        surface &= si.is_valid();
        s.active = surface || (s.active && inside.scattered);

        BSDFPtr bsdf = bsdf_of(si, surface);
        s.active &= !is_last(s) || can_pass(bsdf, surface);
        if (dr::none_or<false>(s.active))
            return;
        surface &= s.active;

        Vertex vertex = m_direct.prepare(si, bsdf, m_media ? &inside : nullptr,
                                         draw_sample(s), s.active);
        add_direct_light(s, vertex, surface);
        scatter(s, vertex, surface);
        play_roulette(s);
        intersect(s, /* coherent = */ false);
    }

    // --------------------------------------------------------------------- Medium event

    /// Move through the medium that the path is in
    InMedium fly(State &s) const {
        InMedium inside{ s.medium, dr::zeros<MediumInteraction3f>(), Mask(false) };
        if (!m_media)
            return inside;
        Mask within = s.active && s.medium != nullptr;
        if (dr::any_or<true>(within)) {
            auto flight =
                m_direct.media().fly(s.medium, s.ray, s.pi.t, s.sampler, within);
            inside.mei       = flight.mei;
            inside.scattered = within && flight.scattered;
            dr::masked(s.throughput, within) = s.throughput * flight.weight;
            s.active &= !(inside.scattered && is_last(s));
            inside.scattered &= s.active;
            s.valid |= inside.scattered;
        }
        inside.mei.time        = s.ray.time;
        inside.mei.wavelengths = s.ray.wavelengths;
        return inside;
    }

    // ---------------------------------------------------------------------- Emitter hit

    /// Emission of the surface (or the environment) that the path has come to
    void add_emission(State &s, const SurfaceInteraction3f &si, Mask active) const {
        if (m_limits.hide_emitters) // area emitters were skipped, the environment not
            active &= s.depth > 0u || si.is_valid();
        auto [radiance, light] = m_direct.emission().emitted(si, active);
        Float light_pdf        = m_direct.hit_density(s.from, s.u_tree, si, light,
                                                      active && !s.specular);
        Float weight =
            dr::select(s.specular, 1.f, mis_weight<Float>(s.pdf, light_pdf));
        dr::masked(s.result, active) =
            s.result + s.throughput * radiance * dr::detach(weight);
        s.valid |= active && light != kNone;
    }

    // --------------------------------------------------------------------- Direct light

    LightSample<Float> draw_sample(State &s) const {
        Float tree      = m_direct.uses_tree() ? s.sampler->next_1d(s.active) : Float(0.f),
              selection = m_direct.selects() ? s.sampler->next_1d(s.active) : Float(0.f);
        return { tree, selection, s.sampler->next_2d(s.active) };
    }

    void add_direct_light(State &s, const Vertex &vertex, Mask surface) const {
        Mask lit = surface && has_flag(vertex.bsdf->flags(), mitsuba::BSDFFlags::Smooth);
        if (m_media) {
            lit &= !is_last(s);
            Mask scattered = s.active && vertex.inside->scattered;
            if (dr::any_or<true>(scattered))
                lit |= scattered && vertex.inside->mei.medium->use_emitter_sampling();
        }
        if (dr::any_or<true>(lit))
            dr::masked(s.result, lit) =
                s.result + s.throughput * m_direct.sample_lights(vertex, lit);
    }

    // ----------------------------------------------------------------------- Scattering

    /// Continue in a direction sampled from the BSDF or the phase function
    void scatter(State &s, const Vertex &vertex, Mask surface) const {
        Direction next = dr::zeros<Direction>();
        Float u1       = s.sampler->next_1d(s.active);
        Point2f u2     = s.sampler->next_2d(s.active);
        if (dr::any_or<true>(surface))
            next = sample_bsdf(vertex, u1, u2, surface);
        if (m_media) {
            Mask scattered = s.active && vertex.inside->scattered;
            if (dr::any_or<true>(scattered))
                merge(next, sample_phase(s, vertex, u1, u2, scattered), scattered);
        }

        s.throughput *= next.weight;
        s.eta *= next.eta;
        Mask counts = !next.null;
        s.valid |= s.active && counts;
        // Where null surfaces are no vertices, what light sampling knows is left in place
        Mask leaves = m_media ? counts : Mask(true);
        s.from      = dr::select(plain(leaves), vertex.at, s.from);
        set_flags(s.from, vertex.at);
        s.u_tree   = dr::select(leaves, vertex.u.tree, s.u_tree);
        s.pdf      = dr::select(leaves, dr::detach(next.pdf), s.pdf);
        s.specular = dr::select(leaves, next.specular, s.specular);
        dr::masked(s.depth, leaves) = s.depth + 1u;
        if (m_media) {
            s.active &= s.depth < m_limits.max_depth;
            s.medium = m_direct.media().medium_beyond(vertex.si, s.medium, next.ray.d,
                                                      surface);
        }
        s.ray = next.ray;
    }

    Direction sample_bsdf(const Vertex &vertex, const Float &u1, const Point2f &u2,
                          Mask active) const {
        const SurfaceInteraction3f &si = vertex.si;
        mitsuba::BSDFContext ctx;
        auto [bs, weight] = vertex.bsdf->sample(ctx, si, u1, u2, active);
        weight            = si.to_world_mueller(weight, -bs.wo, si.wi);
        Ray3f ray         = si.spawn_ray(si.to_world(bs.wo));
        if (dr::grad_enabled(ray)) {
            // Directions are not differentiated: evaluate again what depends on them
            ray               = dr::detach<true>(ray);
            Vector3f wo       = si.to_local(ray.d);
            auto [value, pdf] = vertex.bsdf->eval_pdf(ctx, si, wo, active);
            value             = si.to_world_mueller(value, -wo, si.wi);
            dr::masked(weight, pdf > 0.f) = value / dr::detach(pdf);
        }
        return { ray,
                 weight & active,
                 bs.pdf,
                 bs.eta,
                 has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta),
                 has_flag(bs.sampled_type, mitsuba::BSDFFlags::Null) };
    }

    Direction sample_phase(const State &s, const Vertex &vertex, const Float &u1,
                           const Point2f &u2, Mask active) const {
        const MediumInteraction3f &mei = vertex.inside->mei;
        mitsuba::PhaseFunctionContext<Float, Spectrum> ctx(s.sampler);
        auto phase             = vertex.phase(active);
        auto [wo, weight, pdf] = phase->sample(ctx, mei, u1, u2, active);
        Ray3f ray              = mei.spawn_ray(wo);
        if (dr::grad_enabled(ray)) {
            ray                = dr::detach<true>(ray);
            auto [value, pdf2] = phase->eval_pdf(ctx, mei, ray.d, active);
            weight             = value / dr::detach(pdf2);
        }
        return { ray,
                 weight & (active && pdf > 0.f),
                 pdf,
                 Float(1.f),
                 !mei.medium->use_emitter_sampling(),
                 Mask(false) };
    }

    static void merge(Direction &a, const Direction &b, Mask use_b) {
        a.ray      = dr::select(use_b, b.ray, a.ray);
        a.weight   = dr::select(use_b, b.weight, a.weight);
        a.pdf      = dr::select(use_b, b.pdf, a.pdf);
        a.eta      = dr::select(use_b, b.eta, a.eta);
        a.specular = dr::select(use_b, b.specular, a.specular);
        a.null     = dr::select(use_b, b.null, a.null);
    }

    // --------------------------------------------------------------------------- Ending

    /// Is this the last vertex that counts? Nothing can be scattered there any more.
    Mask is_last(const State &s) const { return s.depth + 1u >= m_limits.max_depth; }

    /// Can a path that may not scatter any more go straight on through a surface?
    Mask can_pass(const BSDFPtr &bsdf, Mask surface) const {
        if (!m_media)
            return false;
        return surface && has_flag(bsdf->flags(), mitsuba::BSDFFlags::Null);
    }

    void play_roulette(State &s) const {
        Float most = dr::max(mitsuba::unpolarized_spectrum(s.throughput));
        s.active &= most != 0.f;
        Float go_on = dr::detach(dr::minimum(most * dr::square(s.eta), .95f));
        Mask plays  = s.depth >= m_limits.rr_depth;
        s.active &= !plays || s.sampler->next_1d(s.active) < go_on;
        dr::masked(s.throughput, plays) = s.throughput * dr::rcp(go_on);
    }

    void intersect(State &s, bool coherent) const {
        s.pi = m_scene->ray_intersect_preliminary(s.ray, coherent, s.active);
        if (m_limits.hide_emitters && (coherent || m_media))
            skip_emitters(m_scene, s.ray, s.pi, s.active && s.depth == 0u);
    }

    BSDFPtr bsdf_of(const SurfaceInteraction3f &si, Mask active) const {
        if (dr::none_or<false>(active))
            return nullptr;
        return si.bsdf();
    }

    static void set_flags(Receiver<FloatD> &to, const Receiver<FloatD> &from) {
        to.glossy = from.glossy;
        to.media  = from.media;
    }

    const Scene *m_scene;
    DirectLight m_direct;
    PathLimits m_limits;
    bool m_media, m_sees_lights;
};

} // namespace manylights
