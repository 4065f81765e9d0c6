#pragma once

/**
 * Direct light at a shading point: candidates -> reservoirs -> shadow rays.
 *
 * Stage 1, candidates.h: N' lights, each with its inclusion probability p.
 * Stage 2, reservoirs.h: at most m lights, resampled by the heuristic H. If there cannot be
 *   more than m candidates, all are kept with C = 1 / p and nothing is resampled.
 * Stage 3: a point on each kept light, F = BSDF * emission * geometry * MIS weight without
 *   visibility; s of them are chosen by threshold-systematic sampling with target
 *   |C F| and traced. (The talk draws s reservoirs; here the items of large
 *   target are taken for sure, the rest at equidistant points: half the variance at s = 4.)
 *
 * Lights at infinity never enter the tree: they join stage 3 with C = 1.
 *
 * Estimate = sum over the chosen of V C F max(1, tau / g), g the target, tau the step.
 *
 * MIS against BSDF sampling uses p(light) p(point | light) as the density of the whole
 * light side (balance heuristic): p is the probability of being a candidate, a closed form
 * for any light, so it is evaluated alike for a chosen light and for one that was hit.
 */

#include "manylights/choice/parameters.h"
#include "manylights/receiver/light_importance.h"
#include "manylights/scene/scene_emission.h"
#include "vertex.h"
#include <array>
#include <cfloat>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sampler.h>
#include <variant>

namespace manylights {

/// weight_a of the balance heuristic, 0 where neither strategy can produce the sample
template <typename Float> Float mis_weight(const Float &pdf_a, const Float &pdf_b) {
    Float w = pdf_a / (pdf_a + pdf_b);
    return dr::select(dr::isfinite(w), w, 0.f);
}

/// A light sample without visibility: F / p, and where the shadow ray leads
template <typename Float, typename Spectrum, bool Polarized> struct RaySample {
    using Point3f = mitsuba::Point<Float, 3>;
    Spectrum value;
    Point3f p;
    /// Where the ray starts, if that is a choice of the sample (segments)
    Point3f from;
    DRJIT_STRUCT(RaySample, value, p, from)

    static RaySample make(const Spectrum &f, const Spectrum &emission, const Point3f &p,
                          const Point3f &from) {
        return { f * emission, p, from };
    }
    Spectrum unoccluded() const { return value; }
    Spectrum through(const Spectrum &transmittance) const {
        return value * transmittance;
    }
};

/// With polarization what is on the way acts on the emission E first: f T E
template <typename Float, typename Spectrum> struct RaySample<Float, Spectrum, true> {
    using Point3f = mitsuba::Point<Float, 3>;
    /// f / p
    Spectrum value;
    Spectrum emission;
    Point3f p, from;
    DRJIT_STRUCT(RaySample, value, emission, p, from)

    static RaySample make(const Spectrum &f, const Spectrum &emission, const Point3f &p,
                          const Point3f &from) {
        return { f, emission, p, from };
    }
    Spectrum unoccluded() const { return value * emission; }
    Spectrum through(const Spectrum &transmittance) const {
        return value * transmittance * emission;
    }
};

template <typename Float, typename Spectrum> class DirectLight {
public:
    MI_IMPORT_TYPES(Scene, Sampler, Emitter, EmitterPtr, BSDF, BSDFPtr, ShapePtr)
    using Lights   = SceneLights<Float, Spectrum>;
    using FloatD   = typename Lights::FloatD;
    using UInt32D  = typename Lights::UInt32D;
    using MaskD    = typename Lights::MaskD;
    using Point2fD = mitsuba::Point<FloatD, 2>;
    using Rng      = dr::PCG32<UInt32D>;
    using Reader   = ReceiverReader<Float, Spectrum>;
    using Media    = manylights::Media<Float, Spectrum>;
    using Vertex   = manylights::Vertex<Float, Spectrum>;

    DirectLight(const Scene *scene, const Lights &lights,
                const SamplingParameters &params, const MediaKinds &media = {})
        : m_scene(scene), m_lights(lights), m_emission(scene, lights),
          m_media(scene, media), m_params(params),
          m_learns(lights.tree().visibility != nullptr) {
        uint32_t count = lights.tree().light_count;
        // N <= m: no tree, every light is a candidate
        m_all      = params.considers_all(count);
        float most = m_all ? (float) count : params.most_candidates();
        m_keep_all = most <= (float) params.reservoirs;
        m_slots    = m_keep_all ? std::min((uint32_t) most, count) : params.reservoirs;
        m_items    = m_slots + infinite_items();
        m_choose   = !params.traces_all() && m_items > params.shadow_rays_deeper();
        m_keeps_samples = !dr::is_jit_v<Float> && m_choose && !media.any &&
                          !lights.needs_emitter_eval() &&
                          !lights.tree().kinds.has(LightKind::Other);
    }

    const SceneEmission<Float, Spectrum> &emission() const { return m_emission; }
    const Media &media() const { return m_media; }

    /// Which random numbers are needed besides points on lights?
    bool uses_tree() const { return !m_all; }
    bool selects() const { return m_choose; }

    /// Can BSDF sampling find light at all?
    bool needs_bsdf_samples() const {
        return m_params.bsdf_samples > 0 &&
               (m_lights.can_be_hit() || m_scene->environment() != nullptr);
    }

    /// A vertex with its random numbers; `inside` is null in scenes without media
    Vertex prepare(const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                   const typename Vertex::InMedium *inside, const LightSample<Float> &u,
                   const MaskD &first, Mask active) const {
        Vertex vertex{
            si, bsdf, inside, u, effort(first), traits(Extent::Point), active
        };
        look_at_tree(vertex, active);
        return vertex;
    }

    /// All of a segment in a homogeneous medium
    Vertex prepare_segment(const SurfaceInteraction3f &behind, const BSDFPtr &no_bsdf,
                           const typename Vertex::InMedium &inside,
                           const LightSample<Float> &u, const MaskD &first,
                           Mask active) const {
        Vertex vertex{ behind, no_bsdf,       &inside,
                       u,      effort(first), traits(Extent::Segment),
                       active };
        look_at_tree(vertex, active);
        return vertex;
    }

    /// What of receivers is in use
    ReceiverTraits traits(Extent extent) const {
        const MediaKinds &media = m_media.kinds();
        bool surface            = extent != Extent::Segment;
        bool lobes              = surface && !(m_all && m_keep_all);
        ReceiverTraits result;
        result.lobes    = lobes ? m_lights.lobes() : Lobes::None;
        result.media    = media.any;
        result.extent   = extent;
        result.channels = media.chromatic ? dr::size_v<UnpolarizedSpectrum> : 0;
        return result;
    }

    /// Radiance that arrives from sampled lights, reflected towards -si.wi
    Spectrum sample_lights(const Vertex &vertex, Counts<Float> &counts,
                           Mask active) const {
        if (m_items == 0)
            return Spectrum(0.f);
        if (m_params.traces_all() || rays_for_all(vertex))
            return trace_candidates(vertex, counts, active);
        return trace_kept(vertex, keep_lights(vertex, counts, active), active);
    }

    /// Radiance that arrives along rays sampled from the BSDF
    Spectrum sample_bsdf(const Vertex &vertex, Sampler *sampler, Mask active) const {
        Spectrum result(0.f);
        if (m_params.bsdf_samples <= kUnrolledRays) {
            for (uint32_t i = 0; i < m_params.bsdf_samples; ++i)
                add_bsdf_sample(vertex, sampler, result, active);
            return result;
        }
        struct State {
            UInt32 ray;
            Spectrum result;
            Sampler *sampler;
            DRJIT_STRUCT(State, ray, result, sampler)
        };
        State state{ UInt32(0), result, sampler };
        UInt32 rays = dr::opaque<UInt32>(m_params.bsdf_samples);
        loop(
            state, [&](const State &s) { return active && s.ray < rays; },
            [&](State &s) {
                add_bsdf_sample(vertex, s.sampler, s.result, active);
                s.ray += 1u;
            },
            "Direct light: rays from the BSDF");
        return state.result;
    }

    /**
     * Density with which \ref sample_lights chooses the direction that hit `light` or the
     * environment, seen from the receiver of a vertex and for its random number of the tree
     */
    MI_NOINLINE Float hit_density(const Receiver<FloatD> &at, const Float &u_tree,
                                  const MaskD &first, const SurfaceInteraction3f &hit,
                                  const UInt32D &light, Mask active) const {
        auto p = at.p;
        if (at.extent == Extent::Either)
            p -= at.distance * at.wi;
        Interaction3f from(0.f, hit.time, hit.wavelengths, Point3f(p));
        Float result(0.f);
        Mask found = active && light < kOnlyHit;
        if (m_lights.can_be_hit() && dr::any_or<true>(found)) {
            dr::suspend_grad<Float> detached;
            const auto &tree = m_lights.tree();
            Row<FloatD> row  = tree.row(light, plain(found));
            FloatD pdf =
                by_kind<FloatD>(row, m_lights.table_kinds(), [&](LightKind kind) {
                    return light_pdf<FloatD>(row, kind, p, plain(hit.p),
                                             plain(Vector3f(hit.n)));
                });
            result = Float(pdf);
            if (tree.kinds.has(LightKind::Other)) {
                Mask other = found && row.is(LightKind::Other);
                if (dr::any_or<true>(other)) {
                    DirectionSample3f ds(m_scene, hit, from);
                    dr::masked(result, other) =
                        m_emission.emitter_of(row)->pdf_direction(from, ds, other);
                }
            }
            if (at.extent == Extent::Either)
                result *= Float(dr::select(at.length > 0.f,
                                           distances(at, row).pdf(at.distance), 1.f));
            result *= Float(
                inclusion_probability(at, light, plain(u_tree), first, plain(found)));
            result = dr::select(found, result, 0.f);
        }
        Mask missed = active && !hit.is_valid();
        if (const Emitter *environment = m_scene->environment();
            environment && environment->sampling_weight() > 0 &&
            dr::any_or<true>(missed)) {
            DirectionSample3f ds(m_scene, hit, from);
            dr::masked(result, missed) =
                infinite_probability() * environment->pdf_direction(from, ds, missed);
            if (at.extent == Extent::Either)
                dr::masked(result, missed && Mask(at.length > 0.f)) =
                    result * Float(Distances::transmittance_pdf(at, at.distance));
        }
        return result;
    }

private:
    /// More rays from the BSDF are a recorded loop
    static constexpr uint32_t kUnrolledRays = 4;

    void add_bsdf_sample(const Vertex &vertex, Sampler *sampler, Spectrum &result,
                         Mask active) const {
        const SurfaceInteraction3f &si = vertex.si;
        mitsuba::BSDFContext ctx;
        // In this order with all compilers
        Point2f u2       = sampler->next_2d(active);
        Float u1         = sampler->next_1d(active);
        auto [bs, value] = vertex.bsdf->sample(ctx, si, u1, u2, active);
        value            = si.to_world_mueller(value, -bs.wo, si.wi);
        Mask reflected   = active && dr::any(mitsuba::unpolarized_spectrum(value) != 0.f);
        SurfaceInteraction3f hit;
        auto [light, emits] =
            m_emission.find_light(si.spawn_ray(si.to_world(bs.wo)), hit, reflected);
        if (dr::none_or<false>(emits))
            return;
        Spectrum radiance = m_emission.emitted(hit, light, reflected);

        Mask delta      = has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta);
        Float light_pdf = dr::select(
            delta, 0.f,
            hit_density(vertex.at, vertex.u.tree, true, hit, light, reflected && !delta));
        Float pdf = bs.pdf * (float) m_params.bsdf_samples;
        result[reflected] += value * radiance * mis_weight<Float>(pdf, light_pdf) /
                             (float) m_params.bsdf_samples;
    }

    using Sample          = RaySample<Float, Spectrum, mitsuba::is_polarized_v<Spectrum>>;
    using InfiniteSamples = std::array<Sample, kMaxInfinite>;
    using KeptSamples =
        std::conditional_t<dr::is_jit_v<Float>, std::monostate, FixedArray<Sample>>;

    /// The lights that reach stage 3, at most one in each slot
    struct Kept {
        Slots<UInt32D> light;
        /// Contribution weight C (0: empty), inclusion probability, target g
        Slots<FloatD> weight, probability, target;
        /// What the targets are of, see \ref m_keeps_samples
        KeptSamples sample;
        DRJIT_STRUCT(Kept, light, weight, probability, target)

        explicit Kept(size_t slots, size_t items, bool keeps_samples)
            : light(make_slots<UInt32D>(slots, 0u)),
              weight(make_slots<FloatD>(slots, 0.f)),
              probability(make_slots<FloatD>(slots, 1.f)),
              target(make_slots<FloatD>(items, 0.f)) {
            if constexpr (!dr::is_jit_v<Float>)
                if (keeps_samples)
                    sample = KeptSamples(slots, dr::zeros<Sample>());
        }
    };

    // --------------------------------------------------------------- Stages 1 and 2

    /// Choices are not differentiated: no gradient passes through here
    MI_NOINLINE Kept keep_lights(const Vertex &vertex, Counts<Float> &counts,
                                 Mask active) const {
        dr::suspend_grad<Float> detached;
        LightSample<FloatD> u = plain_sample(vertex.u);
        auto keep             = [&](const auto &cursor) {
            return m_keep_all
                       ? keep_candidates(vertex, cursor, u, counts, active)
                       : keep_resampled(vertex,
                                        resample(vertex.at, cursor, u, counts, active),
                                        counts, active);
        };
        if (m_all)
            return keep(AllLights<FloatD>(dr::opaque<UInt32D>(light_count())));
        if (m_params.splits_nodes())
            return keep(splitting_cursor(vertex.at, u.tree));
        return keep(
            SystematicCursor<FloatD>(vertex.top, vertex.effort.candidates, u.tree));
    }

    uint32_t light_count() const { return m_lights.tree().light_count; }

    SplittingCursor<FloatD> splitting_cursor(const Receiver<FloatD> &at,
                                             const FloatD &u) const {
        return { m_lights.tree(), at, dr::opaque<FloatD>(m_params.splitting_rate), u,
                 m_params.method == Method::Talk ? m_params.split_function
                                                 : SplitFunction::Variance };
    }

    /// No more candidates than slots: keep each with C = 1 / p
    template <typename Cursor>
    Kept keep_candidates(const Vertex &vertex, const Cursor &cursor,
                         const LightSample<FloatD> &u, Counts<Float> &counts,
                         Mask active) const {
        struct State {
            Cursor cursor;
            Kept kept;
            Rng rng;
            UInt32D slot;
            FloatD expected;
            DRJIT_STRUCT(State, cursor, kept, rng, slot, expected)
            State(const Cursor &cursor, Kept &&kept, Rng &&rng)
                : cursor(cursor), kept(std::move(kept)), rng(std::move(rng)), slot(0),
                  expected(0.f) {}
        };
        State state(cursor, Kept(m_slots, m_items, m_keeps_samples), make_rng(u));
        MaskD on = plain(active);
        loop(
            state,
            [&](const State &s) { return on && s.cursor.has_next() && s.slot < m_slots; },
            [&](State &s) {
                auto candidate = s.cursor.next(m_lights.tree(), vertex.at, s.rng);
                FloatD p = candidate.probability, weight = dr::rcp(p);
                MaskD valid = candidate.valid;
                Kept &kept  = s.kept;
                write_slot<UInt32D>(kept.light, s.slot, candidate.light, m_slots, valid);
                write_slot<FloatD>(kept.weight, s.slot, weight, m_slots, valid);
                write_slot<FloatD>(kept.probability, s.slot, p, m_slots, valid);
                if (m_choose) {
                    FloatD g = light_target(vertex, candidate.light, p, s.slot, kept,
                                            active && valid) *
                               candidate.visibility;
                    if (m_params.counts)
                        s.expected +=
                            expected_light(weight * g, candidate.visibility, valid);
                    write_slot<FloatD>(kept.target, s.slot, weight * g, m_items, valid);
                }
                s.slot += dr::select(valid, UInt32D(1), UInt32D(0));
            },
            "Direct light: candidates");
        counts.add(state.slot, state.cursor.visits, active);
        counts.expected += state.expected;
        return std::move(state.kept);
    }

    /// For film channels: the light of a weighted target F f that should arrive, F f^2 = F v
    FloatD expected_light(const FloatD &target, const FloatD &visibility,
                          const MaskD &active) const {
        return dr::select(active, target * visibility * m_lights.tree().unit, 0.f);
    }

    /// Stage 2: deal the candidates to m reservoirs
    template <typename Cursor>
    Reservoirs<FloatD> resample(const Receiver<FloatD> &at, const Cursor &cursor,
                                const LightSample<FloatD> &u, Counts<Float> &counts,
                                Mask active) const {
        struct State {
            Cursor cursor;
            Reservoirs<FloatD> reservoirs;
            Rng rng;
            UInt32D candidates;
            DRJIT_STRUCT(State, cursor, reservoirs, rng, candidates)
            State(const Cursor &cursor, size_t count, Rng &&rng)
                : cursor(cursor), reservoirs(count), rng(std::move(rng)), candidates(0) {}
        };
        const auto &tree = m_lights.tree();
        Dealing dealing =
            m_params.method == Method::Talk ? Dealing::Random : Dealing::Greedy;
        State state(cursor, m_slots, make_rng(u));
        MaskD on = plain(active);
        loop(
            state, [&](const State &s) { return on && s.cursor.has_next(); },
            [&](State &s) {
                auto candidate = s.cursor.next(tree, at, s.rng);
                FloatD h = light_importance(at, tree.row(candidate.light), tree.kinds,
                                            tree.scale) *
                           candidate.visibility;
                s.reservoirs.add(candidate, h, m_slots, dealing, s.rng);
                s.candidates += 1u;
            },
            "Direct light: resampled candidates");
        counts.add(state.candidates, state.cursor.visits, active);
        return std::move(state.reservoirs);
    }

    /// C = W / H, and the targets
    Kept keep_resampled(const Vertex &vertex, const Reservoirs<FloatD> &reservoirs,
                        Counts<Float> &counts, Mask active) const {
        struct State {
            UInt32D slot;
            Slots<FloatD> target;
            FloatD expected;
            DRJIT_STRUCT(State, slot, target, expected)
        };
        Kept kept(m_slots, m_items, m_keeps_samples);
        kept.light       = reservoirs.light;
        kept.probability = reservoirs.probability;
        for (size_t i = 0; i < m_slots; ++i)
            kept.weight[i] = reservoirs.weight[i] / reservoirs.importance[i];
        if (!m_choose)
            return kept;

        State state{ UInt32D(0), kept.target, FloatD(0.f) };
        MaskD on = plain(active);
        loop(
            state, [&](const State &s) { return on && s.slot < m_slots; },
            [&](State &s) {
                FloatD weight = read_slot<FloatD>(kept.weight, s.slot, m_slots);
                FloatD target =
                    light_target(vertex, read_slot<UInt32D>(kept.light, s.slot, m_slots),
                                 read_slot<FloatD>(kept.probability, s.slot, m_slots),
                                 s.slot, kept, active && weight > 0.f);
                FloatD visibility =
                    read_slot<FloatD>(reservoirs.visibility, s.slot, m_slots);
                target *= visibility;
                if (m_params.counts)
                    s.expected +=
                        expected_light(weight * target, visibility, weight > 0.f);
                write_slot<FloatD>(s.target, s.slot, weight * target, m_items, true);
                s.slot += 1u;
            },
            "Direct light: targets");
        kept.target = state.target;
        counts.expected += state.expected;
        return kept;
    }

    static LightSample<FloatD> plain_sample(const LightSample<Float> &u) {
        return { plain(u.tree), plain(u.selection),
                 Point2fD(plain(u.point.x()), plain(u.point.y())) };
    }

    /// All the bits of a vertex' numbers, in two
    static std::pair<UInt32D, UInt32D> seed_bits(const LightSample<FloatD> &u) {
        auto bits = [](const FloatD &x) { return dr::reinterpret_array<UInt32D>(x); };
        return { bits(u.point.x()) ^ (bits(u.tree) * 0x9e3779b9u),
                 bits(u.point.y()) + bits(u.selection) };
    }

    /// Numbers that need no stratification, seeded with the bits of those that have it
    static Rng make_rng(const LightSample<FloatD> &u, uint64_t stream = 1) {
        auto bits     = seed_bits(u);
        auto [a, b]   = mitsuba::sample_tea_32(bits.first, bits.second);
        using UInt64D = dr::uint64_array_t<UInt32D>;
        return Rng(1, UInt64D(a) + dr::sl<32>(UInt64D(b)), UInt64D(stream));
    }

    /// Numbers for shadow rays through heterogeneous media, each ray with those after the last
    Rng media_rng(const Vertex &vertex) const {
        return m_media.kinds().heterogeneous ? make_rng(plain_sample(vertex.u), 2)
                                             : Rng();
    }

    // ------------------------------------------------------------------------ Stage 3

    MI_NOINLINE Spectrum trace_kept(const Vertex &vertex, Kept kept, Mask active) const {
        InfiniteSamples infinite = sample_infinite(vertex, active);
        FloatD offset            = plain(vertex.u.selection);
        FloatD tau(0.f);
        if (m_choose) {
            for (size_t i = 0; i < infinite_items(); ++i)
                kept.target[m_slots + i] = target(infinite[i].unoccluded());
            tau = selection_threshold<FloatD>(kept.target, m_items, m_params.shadow_rays,
                                              FloatD(vertex.effort.shadow_rays));
        }

        struct State {
            UInt32D ray;
            Spectrum result;
            Rng rng;
            DRJIT_STRUCT(State, ray, result, rng)
        };
        State state{ UInt32D(0), Spectrum(0.f), media_rng(vertex) };
        UInt32D rays = dr::minimum(vertex.effort.shadow_rays, m_items);
        MaskD on     = plain(active);
        loop(
            state, [&](const State &s) { return on && s.ray < rays; },
            [&](State &s) {
                Selected<FloatD> chosen{ s.ray, FloatD(1.f), MaskD(true) };
                FloatD boost(1.f);
                if (m_choose) {
                    chosen = select_item<FloatD>(kept.target, m_items, tau,
                                                 (FloatD(s.ray) + offset) * tau);
                    boost  = dr::maximum(1.f, tau / chosen.target);
                }
                s.result +=
                    trace(vertex, kept, infinite, chosen, s.rng, active) * Float(boost);
                s.ray += 1u;
            },
            "Direct light: shadow rays");
        return state.result;
    }

    /// Are there enough shadow rays for all lights? Nothing has to be chosen then. Kernels
    /// are the same for all vertices
    bool rays_for_all(const Vertex &vertex) const {
        if constexpr (dr::is_jit_v<Float>)
            return m_all && !m_choose;
        else
            return m_all && m_items <= vertex.effort.shadow_rays;
    }

    /// No resampling, a shadow ray for every candidate: few lights, or the method
    /// `adaptive_splitting`
    Spectrum trace_candidates(const Vertex &vertex, Counts<Float> &counts,
                              Mask active) const {
        Spectrum result(0.f);
        Rng rng = m_all ? media_rng(vertex) : make_rng(plain_sample(vertex.u));
        if (m_all && m_slots > 0)
            result = trace_candidates(
                vertex, AllLights<FloatD>(dr::opaque<UInt32D>(light_count())), rng,
                counts, active);
        else if (!m_all)
            result = trace_candidates(vertex,
                                      splitting_cursor(vertex.at, plain(vertex.u.tree)),
                                      rng, counts, active);
        if (infinite_items() == 0)
            return result;
        InfiniteSamples infinite = sample_infinite(vertex, active);
        for (size_t i = 0; i < infinite_items(); ++i)
            result += trace_sample(vertex, infinite[i], rng, active);
        return result;
    }

    template <typename Cursor>
    Spectrum trace_candidates(const Vertex &vertex, const Cursor &cursor, Rng &rng,
                              Counts<Float> &counts, Mask active) const {
        struct State {
            Cursor cursor;
            UInt32D slot;
            Spectrum result;
            Rng rng;
            DRJIT_STRUCT(State, cursor, slot, result, rng)
            State(const Cursor &cursor, Rng &&rng)
                : cursor(cursor), slot(0), result(0.f), rng(std::move(rng)) {}
        };
        State state(cursor, std::move(rng));
        MaskD on = plain(active);
        loop(
            state, [&](const State &s) { return on && s.cursor.has_next(); },
            [&](State &s) {
                auto candidate = s.cursor.next(m_lights.tree(), vertex.at, s.rng);
                FloatD p       = candidate.probability;
                Mask valid     = active && candidate.valid;
                Sample sample  = sample_light_point(vertex, candidate.light, p, s.slot,
                                                    /* target_only = */ false, valid);
                sample.value *= Float(dr::rcp(p));
                s.result += trace_sample(vertex, sample, s.rng, valid);
                s.slot += 1u;
            },
            "Direct light: rays to all candidates");
        counts.add(state.slot, state.cursor.visits, active);
        rng = std::move(state.rng);
        return state.result;
    }

    /// The chosen item's contribution, with visibility
    Spectrum trace(const Vertex &vertex, const Kept &kept,
                   const InfiniteSamples &infinite, const Selected<FloatD> &chosen,
                   Rng &rng, Mask active) const {
        active &= chosen.valid;
        Sample sample = dr::zeros<Sample>();
        if (m_slots > 0) {
            UInt32D slot  = dr::minimum(chosen.item, m_slots - 1u);
            FloatD weight = read_slot<FloatD>(kept.weight, slot, m_slots);
            Mask finite   = active && chosen.item < m_slots && weight > 0.f;
            sample        = kept_sample(vertex, kept, slot, finite);
            sample.value  = sample.value * Float(weight) & finite;
        }
        for (size_t i = 0; i < infinite_items(); ++i)
            sample = dr::select(active && chosen.item == (uint32_t) (m_slots + i),
                                infinite[i], sample);

        Spectrum result = trace_sample(vertex, sample, rng, active);
        if (m_learns) {
            // Far from the smallest floats, which some threads round to zero
            constexpr float least = 1e-30f;
            MaskD traced          = plain(active) && chosen.item < m_slots &&
                                    target(sample.unoccluded()) > least;
            UInt32D slot          = dr::minimum(chosen.item, m_slots - 1u);
            count_ray(m_lights.tree(), vertex.at.cell,
                      read_slot<UInt32D>(kept.light, slot, m_slots),
                      target(result) > least, traced);
        }
        return result;
    }

    /// F / p of what is in a slot
    Sample kept_sample(const Vertex &vertex, const Kept &kept, const UInt32D &slot,
                       Mask active) const {
        if constexpr (!dr::is_jit_v<Float>)
            if (m_keeps_samples)
                return kept.sample[slot];
        return sample_light_point(vertex, read_slot<UInt32D>(kept.light, slot, m_slots),
                                  read_slot<FloatD>(kept.probability, slot, m_slots),
                                  slot, /* target_only = */ false, active);
    }

    /// What all traversals for a vertex have in common: the cell where visibility is learnt and
    /// looked up (\ref VisibilityTable::cell), and the weights at the top
    void look_at_tree(Vertex &vertex, Mask active) const {
        bool top = !m_all && !m_params.splits_nodes();
        if ((!top && !m_learns) || dr::none_or<false>(vertex.is_lit(active)))
            return;
        const auto &tree = m_lights.tree();
        if (m_learns) {
            auto bits      = seed_bits(plain_sample(vertex.u));
            vertex.at.cell = tree.visibility->cell(vertex.at, bits.first, bits.second);
        }
        if (top)
            vertex.top = TopWeights<FloatD>(tree, vertex.at);
    }

    Spectrum trace_sample(const Vertex &vertex, const Sample &sample, Rng &rng,
                          Mask active) const {
        // Drops invalid values as well
        active &= Mask(Reader::target(sample.unoccluded()) > 0.f);
        if (dr::none_or<false>(active))
            return Spectrum(0.f);
        return visible(vertex, sample, rng, active);
    }

    /// What arrives of a sample: all or nothing without media
    Spectrum visible(const Vertex &vertex, const Sample &sample, Rng &rng,
                     Mask active) const {
        if (!vertex.inside) {
            Mask occluded = m_scene->ray_test(vertex.si.spawn_ray_to(sample.p), active);
            return sample.unoccluded() & (active && !occluded);
        }
        Interaction3f origin = vertex.origin();
        if (vertex.at.extent == Extent::Segment)
            origin.p = sample.from;
        auto medium =
            m_media.medium_beyond(vertex.si, vertex.inside->medium, sample.p - origin.p,
                                  vertex.on_surface(active));
        return sample.through(
                   m_media.transmittance(origin, sample.p, medium, rng, active)) &
               active;
    }

    /// What values are compared by: in units of the scene's brightest light
    FloatD target(const Spectrum &value) const {
        return Reader::target(value, m_lights.tree().scale);
    }

    /// |F| of a light's point
    FloatD light_target(const Vertex &vertex, const UInt32D &light,
                        const FloatD &inclusion, const UInt32D &slot, Kept &kept,
                        Mask active) const {
        Sample sample = sample_light_point(vertex, light, inclusion, slot,
                                           /* target_only = */ true, active);
        if constexpr (!dr::is_jit_v<Float>)
            if (m_keeps_samples)
                kept.sample[slot] = sample;
        FloatD g = target(sample.unoccluded());
        if (vertex.at.media) {
            bool segment = vertex.at.extent == Extent::Segment;
            auto from    = segment ? plain(sample.from) : vertex.at.p;
            auto far     = attenuation(vertex.at, dr::norm(plain(sample.p) - from));
            g            = dr::select(g > 0.f, g * far, 0.f); // else p is undefined
        }
        return g;
    }

    using Distances = typename Vertex::Distances;

    /// Distances along a segment for a light of the table
    Distances distances(const Receiver<FloatD> &at, const Row<FloatD> &row) const {
        using Look = Appearance<FloatD>;
        Look light = by_kind<Look>(row, m_lights.tree().kinds, [&](LightKind kind) {
            return appearance(at, row, kind);
        });
        return { at, light.w, light.variance };
    }

    /**
     * f(vertex), a sample of a light. For a segment the vertex is moved to the distance t,
     * of density pdf, and the sample has the factor sigma_s exp(-sigma_t t) / pdf (for the
     * target, sigma_t in place of sigma_s).
     */
    template <typename F>
    MI_NOINLINE Sample at_distance(const Vertex &vertex, const FloatD &t,
                                   const FloatD &pdf, bool target_only, Mask active,
                                   const F &f) const {
        Mask segment                    = active && Mask(vertex.at.length > 0.f);
        typename Vertex::InMedium here  = *vertex.inside;
        dr::masked(here.mei.p, segment) = here.start - Float(t) * here.mei.wi;
        Vertex moved(vertex);
        moved.inside                           = &here;
        dr::masked(moved.at.p, plain(segment)) = plain(here.mei.p);
        moved.at.extent                        = Extent::Point;

        UnpolarizedSpectrum sigma = here.mei.combined_extinction,
                            tr    = dr::exp(-Float(t) * sigma);
        Float density             = dr::detach(dr::mean(tr * sigma));
        moved.flight_ratio        = dr::select(segment, density / Float(pdf), 1.f);
        if (!target_only && dr::any_or<true>(segment))
            sigma =
                std::get<0>(here.medium->get_scattering_coefficients(here.mei, segment));
        Sample sample                     = f(moved);
        dr::masked(sample.value, segment) = sample.value * (tr * sigma / Float(pdf));
        sample.from                       = here.mei.p;
        return sample;
    }

    /// Each slot gets its own shift of the number that the distance is chosen with
    static FloatD slot_distance(const Vertex &vertex, const UInt32D &slot) {
        return shift(plain(vertex.u.distance), slot * 0x9e3779b9u);
    }

    /// The random channel that the distance of a slot follows
    static UInt32D slot_channel(const Vertex &vertex, const UInt32D &slot) {
        if (vertex.at.channels == 0)
            return 0u;
        LightSample<FloatD> u = plain_sample(vertex.u);
        u.selection           = plain(vertex.u.distance);
        auto bits             = seed_bits(u);
        UInt32D hash = mitsuba::sample_tea_32(bits.first + slot, bits.second).first;
        return dr::mul_hi(hash, vertex.at.channels);
    }

    /// x + number / 2^32, modulo 1: exact however many slots there are
    template <typename F>
    static F shift(const F &x, const dr::uint32_array_t<F> &number) {
        F shifted = x + F(number >> 8u) * 0x1p-24f;
        return shifted - dr::floor(shifted);
    }

    /**
     * F / p for a point on a light. Lights that need their plugin get a guess of the same
     * sign if only the target is wanted: their H times a typical BSDF value. The plugin is
     * then called for the chosen lights only.
     */
    Sample sample_light_point(const Vertex &vertex, const UInt32D &light,
                              const FloatD &inclusion, const UInt32D &slot,
                              bool target_only, Mask active) const {
        Row<FloatD> row = m_lights.tree().row(light, plain(active));
        if (vertex.at.extent == Extent::Point)
            return sample_row_point(vertex, row, inclusion, slot, target_only, active);
        Distances along = distances(vertex.at, row);
        FloatD t = along.sample(slot_distance(vertex, slot), slot_channel(vertex, slot));
        return at_distance(
            vertex, t, along.pdf(t), target_only, active, [&](const Vertex &v) {
                return sample_row_point(v, row, inclusion, slot, target_only, active);
            });
    }

    Sample sample_row_point(const Vertex &vertex, const Row<FloatD> &row,
                            const FloatD &inclusion, const UInt32D &slot,
                            bool target_only, Mask active) const {
        KindSet kinds = m_lights.tree().kinds;
        Sample result = dr::zeros<Sample>();

        bool others = kinds.has(LightKind::Other);
        Mask other  = others ? Mask(row.is(LightKind::Other)) : Mask(false);
        Mask table  = active && !other;
        Point2f u   = slot_point(vertex.u.point, slot);
        if (dr::any_or<true>(table) && !kinds.only(LightKind::Other))
            result = sample_row(vertex, row, u, inclusion, target_only, table);
        if (others) {
            other &= active;
            if (target_only) {
                float bsdf       = vertex.at.lobes == Lobes::None ? kTypicalBsdf : 1.f;
                const auto &tree = m_lights.tree();
                FloatD h         = light_importance(vertex.at, row, kinds, tree.scale);
                // Not rounded to zero in units of the scene
                Float guess(
                    dr::select(h > 0.f, dr::maximum(h * tree.unit * bsdf, FLT_MIN), 0.f));
                dr::masked(result, other) = Sample::make(
                    Spectrum(1.f),
                    mitsuba::depolarizer<Spectrum>(UnpolarizedSpectrum(guess)),
                    Point3f(0.f), Point3f(0.f));
            } else if (dr::any_or<true>(other)) {
                Sample sample = sample_emitter(vertex, m_emission.emitter_of(row), u,
                                               Float(inclusion), other);
                dr::masked(result, other) = sample;
            }
        }
        return result;
    }

    /// Each slot gets its own shift of the sampler's point (R2 sequence): stratified over
    /// the samples of a pixel and over the slots
    static Point2f slot_point(const Point2f &u, const UInt32D &slot) {
        dr::uint32_array_t<Float> number(slot);
        return { shift(u.x(), number * 0xc13fa9a9u), shift(u.y(), number * 0x91e10da6u) };
    }

    /// A sample of a light of the table
    Sample sample_row(const Vertex &vertex, const Row<FloatD> &row, const Point2f &u,
                      const FloatD &inclusion, bool target_only, Mask active) const {
        using LightPointD = LightPoint<FloatD>;
        mitsuba::Point<FloatD, 2> ud(plain(u.x()), plain(u.y()));
        LightPointD point =
            by_kind<LightPointD>(row, m_lights.table_kinds(), [&](LightKind kind) {
                return sample_light<FloatD>(row, kind, vertex.at.p, ud);
            });
        active &= point.pdf > 0.f;

        Interaction3f from = vertex.origin();
        Vector3f d         = dr::normalize(Point3f(point.p) - from.p);
        Spectrum emission  = mitsuba::depolarizer<Spectrum>(
            m_emission.color(row, from.wavelengths) & Mask(row.tabulated()));
        if (m_lights.needs_emitter_eval()) {
            Mask eval = active && !row.tabulated();
            if (target_only)
                dr::masked(emission, eval) = mitsuba::depolarizer<Spectrum>(
                    UnpolarizedSpectrum(Float(row[kBrightness])));
            else
                m_emission.add_masked(emission, eval, [&](Mask m) {
                    return m_emission.emission_by_emitter(from, row, point, d, m);
                });
        }
        bool delta_only = !m_lights.can_be_hit();
        Float light_pdf = delta_only ? Float(0.f) : Float(inclusion * point.pdf);
        Mask delta      = row.kind() <= (uint32_t) LightKind::Spot;
        Spectrum f      = scatter(vertex, d, light_pdf, delta, active);
        return Sample::make(f & active, emission * Float(point.weight) & active,
                            Point3f(point.p), from.p);
    }

    /// What the vertex scatters times the MIS weight of the light side
    Spectrum scatter(const Vertex &vertex, const Vector3f &d, const Float &light_pdf,
                     const Mask &delta, Mask active) const {
        bool mis          = needs_bsdf_samples();
        auto [value, pdf] = vertex.eval_pdf(d, mis, active);
        if (!mis)
            return value;
        Float weight = mis_weight<Float>(light_pdf, pdf * (float) m_params.bsdf_samples);
        return value * dr::detach(dr::select(delta, 1.f, weight));
    }

    /// A sample from the emitter's own plugin
    template <typename Ptr>
    Sample sample_emitter(const Vertex &vertex, const Ptr &emitter, const Point2f &u,
                          const Float &inclusion, Mask active) const {
        auto [ds, weight] = emitter->sample_direction(vertex.origin(), u, active);
        active &= ds.pdf != 0.f;
        Spectrum f = scatter(vertex, ds.d, inclusion * ds.pdf, ds.delta, active);
        return Sample::make(f & active, weight & active, ds.p, ds.p);
    }

    /// Lights at infinity in stage 3: all of them, or one chosen at random if there are many
    uint32_t infinite_items() const {
        uint32_t count = (uint32_t) m_lights.infinite().size();
        return count <= kMaxInfinite ? count : 1;
    }

    /// Probability with which a light at infinity is an item
    float infinite_probability() const {
        uint32_t count = (uint32_t) m_lights.infinite().size();
        return count <= kMaxInfinite ? 1.f : 1.f / count;
    }

    MI_NOINLINE InfiniteSamples sample_infinite(const Vertex &vertex, Mask active) const {
        InfiniteSamples samples;
        float p = infinite_probability();
        for (uint32_t i = 0; i < infinite_items(); ++i) {
            Point2f u   = slot_point(vertex.u.point, UInt32D(m_slots + i));
            auto sample = [&](const Vertex &v) {
                if (p == 1.f)
                    return sample_emitter(v, m_lights.infinite()[i], u, Float(1.f),
                                          active);
                return sample_some_infinite(v, u, active);
            };
            if (vertex.at.extent == Extent::Point) {
                samples[i] = sample(vertex);
                continue;
            }
            UInt32D slot(m_slots + i);
            FloatD t = Distances::sample_transmittance(
                vertex.at, slot_distance(vertex, slot), slot_channel(vertex, slot));
            samples[i] =
                at_distance(vertex, t, Distances::transmittance_pdf(vertex.at, t),
                            /* target_only = */ false, active, sample);
        }
        return samples;
    }

    /// One of many lights at infinity, chosen at random
    Sample sample_some_infinite(const Vertex &vertex, Point2f u, Mask active) const {
        using UInt32   = dr::uint32_array_t<Float>;
        uint32_t count = (uint32_t) m_lights.infinite().size();
        UInt32 index   = dr::minimum(UInt32(u.x() * (float) count), count - 1u);
        u.x()          = u.x() * (float) count - Float(index);
        EmitterPtr emitter =
            dr::gather<EmitterPtr>(m_lights.infinite_dr(), index, active);
        Sample sample =
            sample_emitter(vertex, emitter, u, Float(infinite_probability()), active);
        sample.value *= (float) count;
        return sample;
    }

    /// Probability that `light` is a candidate at this shading point
    FloatD inclusion_probability(const Receiver<FloatD> &at, const UInt32D &light,
                                 const FloatD &u_tree, const MaskD &first,
                                 const MaskD &active) const {
        if (m_all)
            return FloatD(1.f);
        if (m_params.splits_nodes())
            return splitting_cursor(at, u_tree)
                .inclusion_probability(m_lights.tree(), at, light, active);
        return dr::minimum(1.f, effort(first).candidates *
                                    leaf_probability(m_lights.tree(), at, light, active));
    }

    /// What is spent on the first vertex of a path, and on the others
    Effort<FloatD> effort(const MaskD &first) const {
        return { dr::select(first, dr::opaque<FloatD>(m_params.expected_candidates()),
                            dr::opaque<FloatD>(m_params.expected_deeper())),
                 dr::select(first, dr::opaque<UInt32D>(m_params.shadow_rays),
                            dr::opaque<UInt32D>(m_params.shadow_rays_deeper())) };
    }

    const Scene *m_scene;
    const Lights &m_lights;
    SceneEmission<Float, Spectrum> m_emission;
    Media m_media;
    const SamplingParameters &m_params;
    /// Is every light a candidate? Is every candidate kept? Are there more than shadow rays?
    bool m_all, m_keep_all, m_choose;
    /**
     * Are samples kept for the rays that their targets choose, instead of being computed again?
     * In scalar variants this takes .84 to .95 of the time of a sample (cities, rooms, a house), in
     * LLVM variants, where slots are written with a selection each, .96 to 1.04.
     */
    bool m_keeps_samples;
    /// Is something known of the lights' visibility, or to be learnt?
    bool m_learns;
    /// Places for kept lights, and these together with the lights at infinity
    uint32_t m_slots, m_items;
};

} // namespace manylights
