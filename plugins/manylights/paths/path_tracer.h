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

#include "manylights/direct/direct_light.h"
#include "manylights/scene/hidden_emitters.h"

namespace manylights {

/// Parameters of the paths, as Mitsuba's
struct PathLimits {
    uint32_t max_depth, rr_depth;
    bool hide_emitters;
};

/// `max_depth` of paths that only roulette ends
constexpr uint32_t kUnlimited = (uint32_t) -1;

template <typename Float, typename Spectrum> class PathTracer {
public:
    MI_IMPORT_TYPES(Scene, Sampler, Medium, MediumPtr, BSDF, BSDFPtr)
    using DirectLight = manylights::DirectLight<Float, Spectrum>;
    using Lights      = SceneLights<Float, Spectrum>;
    using Vertex      = manylights::Vertex<Float, Spectrum>;
    using InMedium    = manylights::InMedium<Float, Spectrum>;
    using Media       = manylights::Media<Float, Spectrum>;
    using FloatD      = dr::detached_t<Float>;

    PathTracer(const Scene *scene, const Lights &lights, const MediaKinds &media,
               const SamplingParameters &params, const PathLimits &limits)
        : m_scene(scene), m_direct(scene, lights, params, media), m_limits(limits),
          m_media(media.any), m_homogeneous(media.homogeneous),
          m_segments(media.homogeneous && media.scattering),
          m_sees_lights(lights.can_be_hit() || scene->environment() != nullptr) {}

    /// Radiance along a ray from the camera, and whether it met anything
    std::pair<Spectrum, Mask> trace(Sampler *sampler, const Ray3f &ray,
                                    const Medium *medium, Counts<Float> &counts,
                                    Mask active) const {
        if (m_limits.max_depth == 0)
            return { Spectrum(0.f), Mask(false) };
        State state{ sampler, ray, medium, active };
        if (m_sees_lights)
            state.from.traits() =
                m_direct.traits(m_segments ? Extent::Either : Extent::Point);
        state.valid = !m_limits.hide_emitters && m_scene->environment() != nullptr;
        intersect(state, /* coherent = */ true);
        loop(
            state, [](const State &s) { return s.active; }, [&](State &s) { step(s); },
            "Paths");
        counts = state.counts;
        // Light along a segment counts even if the path then leaves it unscattered
        return { m_media ? state.result : state.result & state.valid, state.valid };
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
        Counts<Float> counts;
        Sampler *sampler;
        DRJIT_STRUCT(State, active, valid, depth, ray, pi, medium, throughput, result,
                     eta, from, u_tree, pdf, specular, counts, sampler)

        State(Sampler *sampler, const Ray3f &ray, const Medium *medium, Mask active)
            : active(active), valid(false), depth(0), ray(ray), medium(medium),
              throughput(1.f), result(0.f), eta(1.f), from(dr::zeros<Receiver<FloatD>>()),
              u_tree(0.f), pdf(1.f), specular(true), sampler(sampler) {}
    };

    /// Where a path goes on
    struct Direction {
        Ray3f ray;
        Spectrum weight;
        Float pdf, eta;
        Mask specular, null;
    };

    void step(State &s) const {
        Piece piece;
        if (m_media)
            fly(s, piece);
        // A segment's light is done, whatever the flight: so the surface behind is seen, too
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
        Mask goes_on =
            ends_there && (!is_last(s) || can_pass(bsdf, ends_there) || piece.hidden);
        s.valid |= ends_there && !goes_on;
        s.active &= piece.scattered || goes_on;
        if (dr::none_or<false>(s.active))
            return;
        surface &= s.active;

        Vertex vertex = m_direct.prepare(
            si, bsdf, m_media ? &piece.inside : nullptr, draw_sample(s),
            plain(s.depth == 0u), m_media ? surface || piece.inside.here : surface);
        add_direct_light(s, vertex, piece, surface && !piece.hidden);
        scatter(s, vertex, piece);
        play_roulette(s);
        intersect(s, /* coherent = */ false);
        if (m_media)
            start_at(s, si.p, !piece.scattered);
    }

    // --------------------------------------------------------------------- Medium event

    /// What became of a piece of the path
    struct Piece {
        /// The medium, where the path is in one; `here` if its vertex is a point in it
        InMedium inside;
        /// Was it scattered before it reached the surface?
        Mask scattered = false;
        /// Is single scattering estimated along all of it? Factor of the light of its vertex
        Mask segment             = false;
        UnpolarizedSpectrum seen = 1.f;
        /// Factor of the path that goes on
        UnpolarizedSpectrum weight = 1.f;
        /// Does it end on an emitter that the camera does not see, but what is behind it?
        Mask hidden = false;
        /// The segment as the tree sees it, and its random number
        Receiver<FloatD> along;
        Float u_tree;
    };

    /// Move through the medium that the path is in
    MI_NOINLINE void fly(State &s, Piece &piece) const {
        InMedium &inside = piece.inside;
        inside      = { s.medium, dr::zeros<MediumInteraction3f>(), false, s.ray.o, 0.f };
        piece.along = dr::zeros<Receiver<FloatD>>();
        piece.u_tree = 0.f;
        Mask within  = s.active && s.medium != nullptr;
        if (dr::any_or<true>(within)) {
            auto flight =
                m_direct.media().fly(s.medium, s.ray, s.pi.t, s.sampler, within);
            inside.mei      = flight.mei;
            piece.scattered = within && flight.scattered && !is_last(s);
            piece.weight    = dr::select(within, flight.weight, 1.f);
            Mask exact      = within && passes_exactly(s, within);
            s.active &= !(flight.scattered && within) || piece.scattered || exact;
            if (m_homogeneous)
                take_exact(s, piece, exact);
            s.valid |= piece.scattered;
            piece.seen = piece.weight;
            if (m_segments)
                find_segment(s, piece, within);
            inside.here = piece.scattered && !piece.segment;
        }
        inside.mei.time        = s.ray.time;
        inside.mei.wavelengths = s.ray.wavelengths;
    }

    /// Where nothing that is scattered counts, what goes on has the known transmittance, and
    /// not that of a flight which may end
    Mask passes_exactly(const State &s, Mask within) const {
        if (!m_homogeneous || (m_segments && m_limits.max_depth == kUnlimited))
            return false;
        Mask exact = within && s.medium->is_homogeneous();
        return m_segments ? Mask(exact && is_last(s)) : exact;
    }

    void take_exact(const State &s, Piece &piece, Mask exact) const {
        piece.scattered &= !exact;
        dr::masked(piece.weight, exact) = Media::transmittance(piece.inside.mei, s.pi.t);
    }

    /// Is this a piece whose single scattering is estimated as a whole?
    void find_segment(const State &s, Piece &piece, Mask within) const {
        piece.segment = within && s.medium->is_homogeneous() &&
                        s.medium->use_emitter_sampling() && !is_last(s) && s.pi.t > 0.f;
        dr::masked(piece.seen, piece.segment) =
            Media::transmittance(piece.inside.mei, s.pi.t);
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
        Float light_pdf = m_direct.hit_density(s.from, s.u_tree, plain(s.depth == 1u), si,
                                               light, active && !s.specular);
        Float weight = dr::select(s.specular, 1.f, mis_weight<Float>(s.pdf, light_pdf));
        add(s, radiance * dr::detach(weight), piece, active);
        s.valid |= active && light != kNone;
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
        Vertex vertex         = m_direct.prepare_segment(
            behind, no_bsdf, along, draw_sample(s, true), plain(s.depth == 0u), active);
        piece.along          = vertex.at;
        piece.u_tree         = vertex.u.tree;
        piece.along.distance = plain(piece.inside.mei.t);
        dr::masked(s.result, active) =
            s.result + s.throughput * m_direct.sample_lights(vertex, s.counts, active);
    }

    void add_direct_light(State &s, const Vertex &vertex, const Piece &piece,
                          Mask surface) const {
        Mask lit = vertex.is_lit_surface(surface);
        if (m_media) {
            lit &= !is_last(s) && dr::any(piece.seen != 0.f);
            Mask here = s.active && vertex.inside->here;
            if (dr::any_or<true>(here))
                lit |= here && vertex.inside->medium->use_emitter_sampling();
        }
        if (dr::any_or<true>(lit))
            add(s, m_direct.sample_lights(vertex, s.counts, lit), piece, lit);
    }

    /// Add radiance of the vertex at the end of a piece
    void add(State &s, const Spectrum &radiance, const Piece &piece, Mask active) const {
        Spectrum value = s.throughput * radiance;
        if (m_media)
            value *= piece.seen;
        dr::masked(s.result, active) = s.result + value;
    }

    // ----------------------------------------------------------------------- Scattering

    /// Continue in a direction sampled from the BSDF or the phase function
    void scatter(State &s, const Vertex &vertex, const Piece &piece) const {
        Float u1       = s.sampler->next_1d(s.active);
        Point2f u2     = s.sampler->next_2d(s.active);
        Mask surface   = s.active && !piece.scattered;
        Direction next = m_media ? sample_either(s, vertex, piece, u1, u2)
                                 : sample_bsdf(vertex, u1, u2, surface);

        s.throughput *= next.weight;
        if (m_media)
            s.throughput *= piece.weight;
        s.eta *= next.eta;
        Mask counts = !next.null;
        s.valid |= s.active && counts;
        // Where null surfaces are no vertices, what light sampling knows is left in place
        remember(s, vertex, piece, next, m_media ? counts : Mask(true));
        if (m_media) {
            s.active &= s.depth < m_limits.max_depth;
            s.medium =
                m_direct.media().medium_beyond(vertex.si, s.medium, next.ray.d, surface);
        }
        s.ray = next.ray;
    }

    /// Rays start a little off their surface, pieces in media do not
    void start_at(State &s, const Point3f &p, Mask surface) const {
        Float lead = dr::detach(dr::dot(s.ray.o - p, s.ray.d));
        lead       = dr::select(s.active && surface, lead, 0.f);
        s.ray.o -= lead * s.ray.d;
        s.pi.t += lead;
    }

    /// A direction from the BSDF or the phase function, whichever a lane has come to
    MI_NOINLINE Direction sample_either(const State &s, const Vertex &vertex,
                                        const Piece &piece, const Float &u1,
                                        const Point2f &u2) const {
        Direction next = dr::zeros<Direction>();
        Mask surface   = s.active && !piece.scattered;
        if (dr::any_or<true>(surface))
            next = sample_bsdf(vertex, u1, u2, surface);
        if (m_limits.hide_emitters) {
            next.null |= piece.hidden;
            dr::masked(next.ray, piece.hidden)    = vertex.si.spawn_ray(s.ray.d);
            dr::masked(next.weight, piece.hidden) = Spectrum(1.f);
            dr::masked(next.eta, piece.hidden)    = 1.f;
        }
        Mask scattered = s.active && piece.scattered;
        if (dr::any_or<true>(scattered))
            next = merge(next, sample_phase(s, piece, u1, u2, scattered), scattered);
        return next;
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

    Direction sample_bsdf(const Vertex &vertex, const Float &u1, const Point2f &u2,
                          Mask active) const {
        const SurfaceInteraction3f &si = vertex.si;
        mitsuba::BSDFContext ctx;
        auto [bs, weight] = vertex.bsdf->sample(ctx, si, u1, u2, active);
        weight            = si.to_world_mueller(weight, -bs.wo, si.wi);
        Ray3f ray         = si.spawn_ray(si.to_world(bs.wo));
        if (dr::grad_enabled(ray)) {
            // Directions are not differentiated: evaluate again what depends on them
            ray                           = dr::detach<true>(ray);
            Vector3f wo                   = si.to_local(ray.d);
            auto [value, pdf]             = vertex.bsdf->eval_pdf(ctx, si, wo, active);
            value                         = si.to_world_mueller(value, -wo, si.wi);
            dr::masked(weight, pdf > 0.f) = value / dr::detach(pdf);
        }
        return { ray,
                 weight & active,
                 bs.pdf,
                 bs.eta,
                 has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta),
                 has_flag(bs.sampled_type, mitsuba::BSDFFlags::Null) };
    }

    Direction sample_phase(const State &s, const Piece &piece, const Float &u1,
                           const Point2f &u2, Mask active) const {
        const MediumInteraction3f &mei = piece.inside.mei;
        mitsuba::PhaseFunctionContext<Float, Spectrum> ctx(s.sampler);
        auto phase             = phase_of(mei, active);
        auto [wo, weight, pdf] = phase->sample(ctx, mei, u1, u2, active);
        Ray3f ray              = mei.spawn_ray(wo);
        if (dr::grad_enabled(ray)) {
            ray                = dr::detach<true>(ray);
            auto [value, pdf2] = phase->eval_pdf(ctx, mei, ray.d, active);
            weight             = value / dr::detach(pdf2);
        }
        if (m_segments) { // a density of distance and direction, as that of light sampling
            const UnpolarizedSpectrum &sigma = mei.combined_extinction;
            Float density                    = dr::mean(sigma * dr::exp(-mei.t * sigma));
            dr::masked(pdf, piece.segment)   = pdf * density;
        }
        return { ray,        weight & (active && pdf > 0.f),      pdf,
                 Float(1.f), !mei.medium->use_emitter_sampling(), Mask(false) };
    }

    static Direction merge(const Direction &a, const Direction &b, Mask use_b) {
        return { dr::select(use_b, b.ray, a.ray),
                 dr::select(use_b, b.weight, a.weight),
                 dr::select(use_b, b.pdf, a.pdf),
                 dr::select(use_b, b.eta, a.eta),
                 dr::select(use_b, b.specular, a.specular),
                 dr::select(use_b, b.null, a.null) };
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

    /// Emitters that the camera does not see may still be borders of media
    Mask is_hidden(const State &s, const SurfaceInteraction3f &si, Mask surface) const {
        surface &= s.depth == 0u && si.is_valid();
        if (dr::any_or<true>(surface))
            surface &= si.shape->emitter() != nullptr;
        return surface;
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
        if (m_limits.hide_emitters && coherent && !m_media)
            skip_emitters(m_scene, s.ray, s.pi, s.active);
    }

    BSDFPtr bsdf_of(const SurfaceInteraction3f &si, Mask active) const {
        if (dr::none_or<false>(active))
            return nullptr;
        return si.bsdf();
    }

    const Scene *m_scene;
    DirectLight m_direct;
    PathLimits m_limits;
    /// Are there media, homogeneous ones, and those whose single scattering is estimated along
    /// whole segments? Can a path find light by chance?
    bool m_media, m_homogeneous, m_segments, m_sees_lights;
};

} // namespace manylights
