#pragma once

/**
 * Direct light at a shading point: candidates -> reservoirs -> shadow rays.
 *
 * Stage 1, choice/candidate.h: N' lights, each with its inclusion probability p.
 * Stage 2, kept_lights.h: at most m lights, resampled by the heuristic H. If there cannot be
 *   more than m candidates, all are kept with C = 1 / p and nothing is resampled.
 * Stage 3, light_samples.h and shadow_rays.h: a point on each kept light, and a ray to some.
 *
 * Lights at infinity never enter the tree: they join stage 3 with C = 1. What of all this a
 * rendering needs is decided in strategy.h; multiple importance sampling against the BSDF
 * takes the density of hit_density.h.
 */

#include "hit_density.h"
#include "shadow_rays.h"
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sampler.h>

namespace manylights {

template <typename Float, typename Spectrum> class DirectLight {
public:
    MI_IMPORT_TYPES(Scene, Sampler, BSDF, BSDFPtr)
    using Lights     = SceneLights<Float, Spectrum>;
    using FloatD     = typename Lights::FloatD;
    using UInt32D    = typename Lights::UInt32D;
    using MaskD      = typename Lights::MaskD;
    using Media      = manylights::Media<Float, Spectrum>;
    using Vertex     = manylights::Vertex<Float, Spectrum>;
    using GroupLight = manylights::GroupLight<Float, Spectrum>;
    using GroupSums  = typename GroupLight::Sums;

    DirectLight(const Scene *scene, const Lights &lights,
                const SamplingParameters &params, const MediaKinds &media = {})
        : m_lights(lights), m_emission(scene, lights), m_media(scene, media),
          m_strategy(
              params, lights.tree().light_count, (uint32_t) lights.infinite().size(),
              media.scattering || media.heterogeneous, has_exact_targets(lights, media)),
          m_mis(params.bsdf_samples > 0 &&
                (lights.can_be_hit() || scene->environment() != nullptr)),
          m_samples(lights, m_emission, m_strategy, m_mis),
          m_kept(lights, m_strategy, m_samples),
          m_rays(scene, lights, m_media, m_strategy, m_samples),
          m_density(scene, lights, m_emission, m_strategy) {}

    /// Its pieces know each other by address
    DirectLight(const DirectLight &) = delete;

    const SceneEmission<Float, Spectrum> &emission() const { return m_emission; }
    const Media &media() const { return m_media; }
    const LightGroups<Float, Spectrum> &groups() const { return m_lights.groups(); }

    /// Which random numbers are needed besides points on lights?
    bool uses_tree() const { return m_strategy.source != Source::AllLights; }
    bool selects() const { return m_strategy.chooses; }

    /// Can BSDF sampling find light at all?
    bool needs_bsdf_samples() const { return m_mis; }

    /// A vertex after `depth` others, with its random numbers; `inside` is null in scenes without
    /// media
    Vertex prepare(const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                   const typename Vertex::InMedium *inside, const LightSample<Float> &u,
                   const UInt32 &depth, Mask active) const {
        Vertex vertex{ si, bsdf, inside, u, depth, traits(Extent::Point), active };
        look_at_tree(vertex, active);
        return vertex;
    }

    /// All of a segment in a homogeneous medium
    Vertex prepare_segment(const SurfaceInteraction3f &behind, const BSDFPtr &no_bsdf,
                           const typename Vertex::InMedium &inside,
                           const LightSample<Float> &u, const UInt32 &depth,
                           Mask active) const {
        Vertex vertex{
            behind, no_bsdf, &inside, u, depth, traits(Extent::Segment), active
        };
        look_at_tree(vertex, active);
        return vertex;
    }

    /// What of receivers is in use
    ReceiverTraits traits(Extent extent) const {
        const MediaKinds &media = m_media.kinds();
        bool surface            = extent != Extent::Segment;
        bool lobes              = surface && m_strategy.compares;
        ReceiverTraits result;
        result.lobes    = lobes ? m_lights.lobes() : Lobes::None;
        result.media    = media.any;
        result.extent   = extent;
        result.channels = media.chromatic ? dr::size_v<UnpolarizedSpectrum> : 0;
        return result;
    }

    /// Radiance that arrives from sampled lights, reflected towards -si.wi
    Spectrum sample_lights(const Vertex &vertex, Counts<Float> &counts, GroupLight &light,
                           Mask active) const {
        if (m_strategy.items == 0)
            return Spectrum(0.f);
        if (m_strategy.fate == Fate::TraceAll)
            return m_rays.trace_candidates(vertex, counts, light, active);
        return m_rays.trace_kept(vertex, m_kept.keep(vertex, counts, active), light,
                                 active);
    }

    /// Radiance that arrives along rays sampled from the BSDF
    Spectrum sample_bsdf(const Vertex &vertex, Sampler *sampler, GroupLight &light,
                         Mask active) const {
        struct State {
            UInt32 ray;
            Spectrum result;
            Sampler *sampler;
            GroupSums groups;
            DRJIT_STRUCT(State, ray, result, sampler, groups)
        };
        State state{ UInt32(0), Spectrum(0.f), sampler, light.take() };
        if (m_strategy.params.bsdf_samples <= kUnrolledRays) {
            for (uint32_t i = 0; i < m_strategy.params.bsdf_samples; ++i)
                add_bsdf_sample(vertex, state, light, active);
            light.give(std::move(state.groups));
            return state.result;
        }
        UInt32 rays = dr::opaque<UInt32>(m_strategy.params.bsdf_samples);
        loop(
            state, [&](const State &s) { return active && s.ray < rays; },
            [&](State &s) {
                add_bsdf_sample(vertex, s, light, active);
                s.ray += 1u;
            },
            "Direct light: rays from the BSDF");
        light.give(std::move(state.groups));
        return state.result;
    }

    /// Density with which \ref sample_lights chooses the direction that hit `light` or the
    /// environment, see \ref HitDensity
    Float hit_density(const Receiver<FloatD> &at, const UInt32D &depth,
                      const Float &u_tree, const SurfaceInteraction3f &hit,
                      const UInt32D &light, Mask active) const {
        return m_density.density(at, depth, u_tree, hit, light, active);
    }

private:
    /// More rays from the BSDF are a recorded loop
    static constexpr uint32_t kUnrolledRays = 4;

    /// Do targets come from the very samples that rays would get? Scalar variants only
    static bool has_exact_targets(const Lights &lights, const MediaKinds &media) {
        return !dr::is_jit_v<Float> && !media.any && !lights.needs_emitter_eval() &&
               !lights.tree().kinds.has(LightKind::Other);
    }

    /// What all traversals for a vertex have in common: the cell where visibility is learnt and
    /// looked up (\ref VisibilityTable::cell), and the weights at the top
    void look_at_tree(Vertex &vertex, Mask active) const {
        const auto &tree = m_lights.tree();
        bool top         = m_strategy.source == Source::Systematic;
        if ((!top && !tree.visibility) || dr::none_or<false>(vertex.is_lit(active)))
            return;
        if (tree.visibility) {
            auto bits      = seed_bits(plain_sample(vertex.u));
            vertex.at.cell = tree.visibility->cell(vertex.at, bits.first, bits.second);
        }
        if (top)
            vertex.top = TopWeights<FloatD>(tree, vertex.at);
    }

    template <typename State>
    void add_bsdf_sample(const Vertex &vertex, State &s, const GroupLight &groups,
                         Mask active) const {
        const SurfaceInteraction3f &si = vertex.si;
        mitsuba::BSDFContext ctx;
        // In this order with all compilers
        Point2f u2       = s.sampler->next_2d(active);
        Float u1         = s.sampler->next_1d(active);
        auto [bs, value] = vertex.bsdf->sample(ctx, si, u1, u2, active);
        value            = si.to_world_mueller(value, -bs.wo, si.wi);
        Mask reflected =
            active && (dr::any(mitsuba::unpolarized_spectrum(value) != 0.f) ||
                       has_derivatives(value));
        SurfaceInteraction3f hit;
        auto [light, emits] =
            m_emission.find_light(si.spawn_ray(si.to_world(bs.wo)), hit, reflected);
        if (dr::none_or<false>(emits))
            return;
        Spectrum radiance = m_emission.emitted(hit, light, reflected);

        Mask delta       = has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta);
        Float light_pdf  = dr::select(delta, 0.f,
                                      hit_density(vertex.at, vertex.depth, vertex.u.tree,
                                                  hit, light, reflected && !delta));
        Float pdf        = bs.pdf * (float) m_strategy.params.bsdf_samples;
        Spectrum arrives = value * radiance * mis_weight<Float>(pdf, light_pdf) /
                           (float) m_strategy.params.bsdf_samples;
        s.result[reflected] += arrives;
        if (s.groups.size() > 0)
            groups.add(s.groups, arrives, Float(1.f), m_lights.groups().of_hit(hit),
                       reflected);
    }

    const Lights &m_lights;
    SceneEmission<Float, Spectrum> m_emission;
    Media m_media;
    Strategy m_strategy;
    bool m_mis;
    LightSamples<Float, Spectrum> m_samples;
    KeptLights<Float, Spectrum> m_kept;
    ShadowRays<Float, Spectrum> m_rays;
    HitDensity<Float, Spectrum> m_density;
};

} // namespace manylights
