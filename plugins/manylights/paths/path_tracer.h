#pragma once

/**
 * Paths from the camera, with the direct light of direct_light.h at every vertex.
 *
 * One step of the loop follows one piece of a path: a flight through the medium (if there
 * is one), the emission of what it ended on, the direct light of the vertex, the choice of
 * the next direction, Russian roulette, and the next intersection.
 *
 * With media, or surfaces that let light pass straight on, a path is that of Mitsuba's
 * `volpath`: such surfaces do not count as vertices, and shadow rays pass them, too. In other
 * scenes it is that of `path`.
 */

#include "manylights/direct/direct_light.h"
#include "manylights/scene/hidden_emitters.h"
#include "manylights/scene/lamps_in_view.h"
#include "scattering.h"

namespace manylights {

template <typename Float, typename Spectrum> class PathTracer {
public:
    MI_IMPORT_TYPES(Scene, Sampler, Medium, MediumPtr, BSDF, BSDFPtr)
    using DirectLight = manylights::DirectLight<Float, Spectrum>;
    using Lights      = SceneLights<Float, Spectrum>;
    using Vertex      = manylights::Vertex<Float, Spectrum>;
    using InMedium    = manylights::InMedium<Float, Spectrum>;
    using State       = PathState<Float, Spectrum>;
    using Piece       = manylights::Piece<Float, Spectrum>;
    using Direction   = manylights::Direction<Float, Spectrum>;
    using GroupLight  = manylights::GroupLight<Float, Spectrum>;
    using GroupSums   = typename GroupLight::Sums;
    using FloatD      = dr::detached_t<Float>;
    using Lamps       = LampsInView<Float, Spectrum>;

    /// @param lamps  that are put on the film otherwise, too; may be null
    PathTracer(const Scene *scene, const Lights &lights, const MediaKinds &media,
               const SamplingParameters &params, const PathLimits &limits,
               const Lamps *lamps)
        : m_scene(scene), m_direct(scene, lights, params, media), m_limits(limits),
          m_lamps(lamps), m_media(media.any),
          m_segments(media.homogeneous && media.scattering),
          m_sees_lights(lights.can_be_hit() || scene->environment() != nullptr),
          m_flights(m_direct.media(), m_limits, m_segments),
          m_scattering(m_limits, m_segments, lights.tree()) {}

    /// Radiance along a ray from the camera, and whether it met anything. Light of groups is
    /// added to their sums.
    std::pair<Spectrum, Mask> trace(Sampler *sampler, const Ray3f &ray,
                                    const Medium *medium, Counts<Float> &counts,
                                    GroupSums &groups, Mask active) const {
        if (m_limits.max_depth == 0)
            return { Spectrum(0.f), Mask(false) };
        State state{ sampler, ray, medium, active };
        state.groups = std::move(groups);
        if (m_sees_lights)
            state.from.traits() =
                m_direct.traits(m_segments ? Extent::Either : Extent::Point);
        state.valid = !m_limits.hide_emitters && m_scene->environment() != nullptr;
        intersect(state, /* coherent = */ true);
        loop(
            state, [](const State &s) { return s.active; }, [&](State &s) { step(s); },
            "Paths");
        counts = state.counts;
        groups = std::move(state.groups);
        for (size_t i = 0; i < groups.size() && !m_media; ++i)
            groups[i] = dr::select(state.valid, groups[i], 0.f);
        // Light along a segment counts even if the path then leaves it unscattered
        return { m_media ? state.result : state.result & state.valid, state.valid };
    }

private:
    /**
     * One piece of a path and the vertex at its end:
     *
     *     case               shows the light of         factor of it          goes on from
     *     no medium          the surface                1                     the surface
     *     flew through       the surface                flight weight         the surface
     *     point in medium    the point                  flight weight         the point
     *     on a segment       segment; surface behind    its own; exp(-s t)    surface or point
     *
     * A segment's light does not depend on how its flight ended; the path goes on from there.
     */
    void step(State &s) const {
        Piece piece;
        if (m_media)
            m_flights.fly(s, piece);
        Mask surface = s.active && (!piece.scattered || piece.segment);
        SurfaceInteraction3f si =
            s.pi.compute_surface_interaction(s.ray, +mitsuba::RayFlags::All, surface);
        if (m_segments)
            add_segment_light(s, si, piece);
        if (m_media && m_limits.hide_emitters)
            piece.hidden = is_hidden(s, si, surface);
        if (m_sees_lights)
            add_emission(s, si, piece, surface && !piece.hidden);
        surface &= si.is_valid();
        Mask ends_there = surface && !piece.scattered;

        BSDFPtr bsdf = bsdf_of(si, surface);
        Mask goes_on = ends_there && (!m_limits.is_last(s.depth) ||
                                      can_pass(bsdf, ends_there) || piece.hidden);
        s.valid |= ends_there && !goes_on && !s.ended;
        s.active &= piece.scattered || goes_on;
        if (dr::none_or<false>(s.active))
            return;
        surface &= s.active;

        Vertex vertex =
            m_direct.prepare(si, bsdf, m_media ? &piece.inside : nullptr, draw_sample(s),
                             s.depth, m_media ? surface || piece.inside.here : surface);
        add_direct_light(s, vertex, piece, surface && !piece.hidden);
        play_roulette(s, scatter(s, vertex, piece));
        intersect(s, /* coherent = */ false);
        if (m_media)
            start_at(s, si.p, !piece.scattered);
    }

    // ------------------------------------------------------------------- Light of a vertex

    LightSample<Float> draw_sample(State &s, bool distance = false) const {
        Float tree = m_direct.uses_tree() ? s.sampler->next_1d(s.active) : Float(0.f),
              selection = m_direct.selects() ? s.sampler->next_1d(s.active) : Float(0.f);
        return { tree, selection, s.sampler->next_2d(s.active),
                 distance ? s.sampler->next_1d(s.active) : Float(0.f) };
    }

    /// Emission of the surface (or the environment) that the path has come to
    void add_emission(State &s, const SurfaceInteraction3f &si, const Piece &piece,
                      Mask active) const {
        if (m_limits.hide_emitters) // area emitters were skipped, the environment not
            active &= s.depth > 0u || si.is_valid();
        const auto &emission = m_direct.emission();
        auto light           = emission.light_at(si, active);
        if (dr::none_or<false>(emission.may_emit(light, si.is_valid())))
            return;
        Spectrum radiance = emission.emitted(si, light, active);
        Float light_pdf = m_direct.hit_density(s.from, plain(s.depth) - 1u, s.u_tree, si,
                                               light, active && !s.specular);
        Float weight = dr::select(s.specular, 1.f, mis_weight<Float>(s.pdf, light_pdf));
        Spectrum arrives = radiance * dr::detach(weight);
        if (m_lamps) {
            Mask first = active && s.depth == 0u;
            arrives    = weigh_lamp<Float>(
                arrives,
                dr::select(first, m_lamps->weight(si, s.ray.d, light, first), 1.f));
        }
        add(s, arrives, piece, active);
        GroupLight group_light = light_through(s, piece);
        if (group_light.is_wanted())
            group_light.add(arrives, m_direct.groups().of_hit(si), active);
        s.valid |= active && light != kNone && !s.ended;
    }

    /// Single scattering along a whole piece of the path, whatever its flight
    MI_NOINLINE void add_segment_light(State &s, const SurfaceInteraction3f &behind,
                                       Piece &piece) const {
        Mask active = s.active && piece.segment;
        if (dr::none_or<false>(active))
            return;
        InMedium along        = piece.inside;
        along.here            = active;
        along.length          = dr::select(active, s.pi.t, 0.f);
        const BSDFPtr no_bsdf = nullptr;
        Vertex vertex = m_direct.prepare_segment(behind, no_bsdf, along,
                                                 draw_sample(s, true), s.depth, active);
        piece.along   = vertex.at;
        piece.u_tree  = vertex.u.tree;
        piece.along.distance = plain(piece.inside.mei.t);
        GroupLight light(s.groups);
        if (light.is_wanted())
            light.set_factor(s.throughput);
        dr::masked(s.result, active) =
            s.result +
            s.throughput * m_direct.sample_lights(vertex, s.counts, light, active);
    }

    void add_direct_light(State &s, const Vertex &vertex, const Piece &piece,
                          Mask surface) const {
        Mask lit = vertex.is_lit_surface(surface);
        if (m_media) {
            lit &= !m_limits.is_last(s.depth) && dr::any(piece.seen != 0.f);
            Mask here = s.active && vertex.inside->here;
            if (dr::any_or<true>(here))
                lit |= here && vertex.inside->medium->use_emitter_sampling();
        }
        if (dr::any_or<true>(lit)) {
            GroupLight light = light_through(s, piece);
            add(s, m_direct.sample_lights(vertex, s.counts, light, lit), piece, lit);
        }
    }

    /// Adds light of the vertex at the end of a piece to the sums of groups
    GroupLight light_through(State &s, const Piece &piece) const {
        GroupLight light(s.groups);
        if (light.is_wanted()) {
            Spectrum factor = s.throughput;
            if (m_media)
                factor *= piece.seen;
            light.set_factor(factor);
        }
        return light;
    }

    /// Add radiance of the vertex at the end of a piece, as the camera sees it
    void add(State &s, const Spectrum &radiance, const Piece &piece, Mask active) const {
        Spectrum value = s.throughput * radiance;
        if (m_media)
            value *= piece.seen;
        dr::masked(s.result, active) = s.result + value;
    }

    // ----------------------------------------------------------------------- Scattering

    /// Continue in a direction sampled from the BSDF or the phase function
    Roulette<Float> scatter(State &s, const Vertex &vertex, const Piece &piece) const {
        Float u1 = s.sampler->next_1d(s.active);
        Roulette<Float> roulette;
        // Drawn here: a vertex has eight numbers, and manylights_sobol has sequences of four
        if (m_limits.rr_depth < m_limits.max_depth)
            roulette.u = s.sampler->next_1d(s.active);
        Point2f u2     = s.sampler->next_2d(s.active);
        Mask surface   = s.active && !piece.scattered;
        Direction next = m_media ? m_scattering.sample_either(s, vertex, piece, u1, u2)
                                 : m_scattering.sample_bsdf(vertex, u1, u2, surface);

        s.throughput *= next.weight;
        if (m_media)
            s.throughput *= piece.weight;
        s.eta *= next.eta;
        s.valid |= s.active && !next.null && !s.ended;
        // Where null surfaces are no vertices, what light sampling knows is left in place
        remember(s, vertex, piece, next, m_media ? !next.null : Mask(true));
        if (m_media) {
            s.active &= s.depth < m_limits.max_depth;
            s.medium =
                m_direct.media().medium_beyond(vertex.si, s.medium, next.ray.d, surface);
        }
        roulette.factor = next.past_lamps;
        s.ray           = next.ray;
        return roulette;
    }

    /// Rays start a little off their surface, pieces in media do not
    void start_at(State &s, const Point3f &p, Mask surface) const {
        Float lead = dr::detach(dr::dot(s.ray.o - p, s.ray.d));
        lead       = dr::select(s.active && surface, lead, 0.f);
        s.ray.o -= lead * s.ray.d;
        s.pi.t += lead;
    }

    /// What the density of finding a light by chance needs of the vertex that a path leaves
    void remember(State &s, const Vertex &vertex, const Piece &piece,
                  const Direction &next, Mask leaves) const {
        dr::masked(s.depth, leaves) = s.depth + 1u;
        if (!m_sees_lights)
            return;
        // Scalar variants assign what is in use, too
        ReceiverTraits traits             = s.from.traits();
        dr::masked(s.from, plain(leaves)) = vertex.at;
        dr::masked(s.u_tree, leaves)      = vertex.u.tree;
        dr::masked(s.pdf, leaves)         = dr::detach(next.pdf);
        dr::masked(s.specular, leaves)    = next.specular;
        if (m_segments) {
            Mask along                       = leaves && piece.scattered && piece.segment;
            dr::masked(s.from, plain(along)) = piece.along;
            dr::masked(s.u_tree, along)      = piece.u_tree;
        }
        s.from.traits() = traits;
    }

    // --------------------------------------------------------------------------- Ending

    /// Can a path that may not scatter any more go straight on through a surface?
    Mask can_pass(const BSDFPtr &bsdf, Mask surface) const {
        return m_media ? surface && has_flag(bsdf->flags(), mitsuba::BSDFFlags::Null)
                       : Mask(false);
    }

    /// Emitters that the camera does not see may still be borders of media
    Mask is_hidden(const State &s, const SurfaceInteraction3f &si, Mask surface) const {
        surface &= s.depth == 0u && si.is_valid();
        if (dr::any_or<true>(surface))
            surface &= si.shape->emitter() != nullptr;
        return surface;
    }

    void play_roulette(State &s, const Roulette<Float> &roulette) const {
        Float most = roulette_brightness<Float>(s.throughput);
        s.active &= most != 0.f;
        Float go_on =
            dr::detach(dr::minimum(most * roulette.factor * dr::square(s.eta), .95f));
        Mask plays = s.depth >= m_limits.rr_depth;
        s.active &= !plays || roulette.u < go_on;
        dr::masked(s.throughput, plays) = s.throughput * dr::rcp(go_on);
    }

    void intersect(State &s, bool coherent) const {
        // GPUs sort scattered rays by the shapes that they meet, as `path` has it
        bool sort = !coherent && jit_flag(JitFlag::SymbolicLoops);
        s.pi = m_scene->ray_intersect_preliminary(s.ray, coherent, sort, 0, 0, s.active);
        if (m_limits.hide_emitters && coherent && !m_media)
            skip_emitters(m_scene, s.ray, s.pi, s.active);
    }

    BSDFPtr bsdf_of(const SurfaceInteraction3f &si, Mask active) const {
        return dr::none_or<false>(active) ? BSDFPtr(nullptr) : si.bsdf();
    }

    const Scene *m_scene;
    DirectLight m_direct;
    PathLimits m_limits;
    const Lamps *m_lamps;
    /// Are there media, and those whose single scattering is estimated along whole segments?
    /// Can a path find light by chance?
    bool m_media, m_segments, m_sees_lights;
    Flights<Float, Spectrum> m_flights;
    Scattering<Float, Spectrum> m_scattering;
};

} // namespace manylights
