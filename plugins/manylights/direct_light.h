#pragma once

/**
 * Direct light at a shading point: candidates -> reservoirs -> shadow rays.
 *
 * Stage 1, candidates.h: N' lights, each with its inclusion probability p.
 * Stage 2, reservoirs.h: at most m lights, resampled by the heuristic H.
 * Stage 3: a point on each kept light, F = BSDF * emission * geometry * MIS weight without
 *   visibility; s of them are chosen by threshold-systematic sampling with target
 *   luminance(C F) and traced. (The talk draws s reservoirs; here the items of large
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

#include "parameters.h"
#include "scene_lights.h"
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/sampler.h>

namespace manylights {

/// Random numbers of one shading point; the first two profit most from stratification
template <typename Float> struct LightSample {
    using Point2f = mitsuba::Point<Float, 2>;
    Float tree, selection;
    Point2f point;
};

/// weight_a of the balance heuristic, 0 where neither strategy can produce the sample
template <typename Float> Float mis_weight(const Float &pdf_a, const Float &pdf_b) {
    Float w = pdf_a / (pdf_a + pdf_b);
    return dr::select(dr::isfinite(w), w, 0.f);
}

template <typename Float, typename Spectrum> class DirectLight {
public:
    MI_IMPORT_TYPES(Scene, Sampler, Emitter, EmitterPtr, BSDF, BSDFPtr, ShapePtr)
    using Lights = SceneLights<Float, Spectrum>;
    using FloatD = typename Lights::FloatD;
    using UInt32D = typename Lights::UInt32D;
    using MaskD = typename Lights::MaskD;
    using Point2fD = mitsuba::Point<FloatD, 2>;
    using Rng = dr::PCG32<UInt32D>;

    DirectLight(const Scene *scene, const Lights &lights, const SamplingParameters &params)
        : m_scene(scene), m_lights(lights), m_params(params) {
        // N <= m: no tree, every light is kept
        m_all = lights.tree().light_count <= params.reservoirs;
        m_slots = std::min(params.reservoirs, lights.tree().light_count);
        if (!m_all && params.method == Method::ResampledTree)
            m_slots = std::min(m_slots, (uint32_t) std::ceil(std::min(m_params.expected_candidates(), (float) kMaxReservoirs)));
        m_items = m_slots + (uint32_t) lights.infinite().size();
    }

    /// Can BSDF sampling find light at all?
    bool needs_bsdf_samples() const {
        return m_params.bsdf_samples > 0 &&
               (m_lights.can_be_hit() || m_scene->environment() != nullptr);
    }

    /// Radiance that arrives from sampled lights, reflected towards -si.wi
    Spectrum sample_lights(const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                           const LightSample<Float> &u, Mask active) const {
        if (m_items == 0)
            return Spectrum(0.f);
        Shading shading{ si, bsdf, receiver(si, bsdf, active), u.point };
        LightSample<FloatD> ud{ plain(u.tree), plain(u.selection),
                                Point2fD(plain(u.point.x()), plain(u.point.y())) };
        Reservoirs<FloatD> kept = keep_lights(shading.at, ud, plain(active));
        return trace_kept(shading, kept, ud.selection, active);
    }

    /// Radiance that arrives along rays sampled from the BSDF
    Spectrum sample_bsdf(Sampler *sampler, const SurfaceInteraction3f &si,
                         const BSDFPtr &bsdf, const LightSample<Float> &u,
                         Mask active) const {
        mitsuba::BSDFContext ctx;
        Spectrum result(0.f);
        for (uint32_t i = 0; i < m_params.bsdf_samples; ++i) {
            auto [bs, value] = bsdf->sample(ctx, si, sampler->next_1d(active),
                                            sampler->next_2d(active), active);
            value = si.to_world_mueller(value, -bs.wo, si.wi);
            Mask active_b =
                active && dr::any(mitsuba::unpolarized_spectrum(value) != 0.f);
            SurfaceInteraction3f hit =
                m_scene->ray_intersect(si.spawn_ray(si.to_world(bs.wo)), active_b);
            auto [radiance, light] = emitted(hit, active_b);

            Mask delta = has_flag(bs.sampled_type, mitsuba::BSDFFlags::Delta);
            Float light_pdf = dr::select(
                delta, 0.f, hit_density(si, bsdf, hit, light, u, active_b && !delta));
            Float pdf = bs.pdf * (float) m_params.bsdf_samples;
            result[active_b] += value * radiance * mis_weight<Float>(pdf, light_pdf) /
                                (float) m_params.bsdf_samples;
        }
        return result;
    }

    /**
     * Radiance emitted from a surface (or the environment, without a hit) against the ray
     * that found it, and the surface's light in the table.
     */
    std::pair<Spectrum, UInt32D> emitted(const SurfaceInteraction3f &si, Mask active) const {
        Spectrum result(0.f);
        UInt32D light(kNone);
        Mask valid = active && si.is_valid();
        if (m_lights.can_be_hit()) {
            light = m_lights.find(si.shape, plain(si.prim_index), plain(valid));
            Mask found = light != kNone;
            if (dr::any_or<true>(found)) {
                Row<FloatD> row = m_lights.tree().row(light, plain(found));
                Mask tabulated = found && Mask(row.tabulated());
                Mask front = Frame3f::cos_theta(si.wi) > 0.f;
                if (dr::any_or<true>(tabulated))
                    result = mitsuba::depolarizer<Spectrum>(
                        color(row, si.wavelengths) & (tabulated && front));
                if (m_lights.needs_emitter_eval())
                    add_masked(result, found && !tabulated,
                               [&](Mask m) { return emitter_of(row)->eval(si, m); });
            }
        }
        if (const Emitter *environment = m_scene->environment())
            add_masked(result, active && !si.is_valid(),
                       [&](Mask m) { return environment->eval(si, m); });
        return { result, light };
    }

private:
    /// The shading point, as BSDFs and as the tree want it
    struct Shading {
        const SurfaceInteraction3f &si;
        const BSDFPtr &bsdf;
        Receiver<FloatD> at;
        Point2f point;
    };

    /// A light sample without visibility: F / p, and where the shadow ray leads
    struct Sample {
        Spectrum value;
        Point3f p;
        DRJIT_STRUCT(Sample, value, p)
    };

    // --------------------------------------------------------------- Stages 1 and 2

    static Receiver<FloatD> receiver(const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                                     Mask active) {
        auto flags = bsdf->flags(active);
        Vector3f n = dr::mulsign(Vector3f(si.sh_frame.n), Frame3f::cos_theta(si.wi));
        return { plain(si.p), plain(n),
                 plain(Mask(has_flag(flags, mitsuba::BSDFFlags::Transmission))) };
    }

    Reservoirs<FloatD> keep_lights(const Receiver<FloatD> &at, const LightSample<FloatD> &u,
                                   const MaskD &active) const {
        Reservoirs<FloatD> kept(m_slots);
        if (m_all) { // weight = importance = probability = 1
            for (uint32_t i = 0; i < m_slots; ++i) {
                kept.light[i] = i;
                kept.weight[i] = 1.f;
            }
            return kept;
        }
        dr::suspend_grad<Float> detached;
        if (m_params.visits_all())
            fill(kept, AllLights<FloatD>{ UInt32D(0), dr::opaque<UInt32D>(light_count()) }, at, u,
                 active);
        else if (m_params.method == Method::Talk)
            fill(kept, talk_cursor(u.tree), at, u, active);
        else
            fill(kept, SystematicCursor<FloatD>(dr::opaque<FloatD>(m_params.expected_candidates()), u.tree), at, u,
                 active);
        return kept;
    }

    uint32_t light_count() const { return m_lights.tree().light_count; }

    StochasticCursor<FloatD> talk_cursor(const FloatD &xi) const {
        return { dr::opaque<FloatD>(m_params.splitting_rate), xi, m_params.split_function };
    }

    /// Deal the candidates of a cursor to the reservoirs
    template <typename Cursor>
    void fill(Reservoirs<FloatD> &kept, const Cursor &cursor, const Receiver<FloatD> &at,
              const LightSample<FloatD> &u, const MaskD &active) const {
        struct State {
            Cursor cursor;
            Reservoirs<FloatD> kept;
            Rng rng;
            DRJIT_STRUCT(State, cursor, kept, rng)
            State(const Cursor &c, Reservoirs<FloatD> &&k, Rng &&r)
                : cursor(c), kept(std::move(k)), rng(std::move(r)) {}
        };
        const auto &tree = m_lights.tree();
        Dealing dealing =
            m_params.method == Method::Talk ? Dealing::Random : Dealing::Greedy;
        State state(cursor, std::move(kept), make_rng(u));
        loop(
            state, [&](const State &s) { return active && s.cursor.has_next(); },
            [&](State &s) {
                auto candidate = s.cursor.next(tree, at, s.rng);
                FloatD h = light_importance(at, tree.row(candidate.light), tree.kinds);
                s.kept.add(candidate, h, m_slots, dealing, s.rng);
            },
            "Light tree: candidates");
        kept = std::move(state.kept);
    }

    /// Numbers that need no stratification, seeded with the bits of those that have it
    static Rng make_rng(const LightSample<FloatD> &u) {
        auto bits = [](const FloatD &x) { return dr::reinterpret_array<UInt32D>(x); };
        auto [a, b] = mitsuba::sample_tea_32(bits(u.point.x()) ^ (bits(u.tree) * 0x9e3779b9u),
                                             bits(u.point.y()) + bits(u.selection));
        using UInt64D = dr::uint64_array_t<UInt32D>;
        return Rng(1, UInt64D(a) + dr::sl<32>(UInt64D(b)));
    }

    // ------------------------------------------------------------------------ Stage 3

    Spectrum trace_kept(const Shading &shading, const Reservoirs<FloatD> &kept,
                        const FloatD &offset, Mask active) const {
        std::vector<Sample> infinite = sample_infinite(shading, active);
        bool choose = m_items > m_params.shadow_rays;
        Slots<FloatD> targets = make_slots<FloatD>(m_items, 0.f);
        FloatD tau(0.f);
        if (choose) {
            targets = stage3_targets(shading, kept, infinite, active);
            tau = selection_threshold<FloatD>(targets, m_items, m_params.shadow_rays);
        }

        struct State {
            UInt32D ray;
            Spectrum result;
            DRJIT_STRUCT(State, ray, result)
        };
        State state{ UInt32D(0), Spectrum(0.f) };
        uint32_t rays = std::min(m_params.shadow_rays, m_items);
        loop(
            state,
            [&](const State &s) { return plain(active) && s.ray < dr::opaque<UInt32D>(rays); },
            [&](State &s) {
                Selected<FloatD> chosen{ s.ray, FloatD(1.f), MaskD(true) };
                FloatD boost(1.f);
                if (choose) {
                    chosen = select_item<FloatD>(targets, m_items, tau, (FloatD(s.ray) + offset) * tau);
                    boost = dr::maximum(1.f, tau / chosen.target);
                }
                s.result += trace(shading, kept, infinite, chosen, active) * Float(boost);
                s.ray += 1u;
            },
            "Direct light: shadow rays");
        return state.result;
    }

    /// The chosen item's contribution, with visibility
    Spectrum trace(const Shading &shading, const Reservoirs<FloatD> &kept,
                   const std::vector<Sample> &infinite, const Selected<FloatD> &chosen,
                   Mask active) const {
        active &= chosen.valid;
        Sample sample = dr::zeros<Sample>();
        if (m_slots > 0) {
            UInt32D slot = dr::minimum(chosen.item, m_slots - 1u);
            Mask finite = active && chosen.item < m_slots;
            FloatD weight = slot_weight(kept, slot);
            finite &= weight > 0.f;
            sample = sample_slot(shading, kept, slot, /* target_only = */ false, finite);
            sample.value = sample.value * Float(weight) & finite;
        }
        for (size_t i = 0; i < infinite.size(); ++i)
            sample = dr::select(active && chosen.item == (uint32_t) (m_slots + i), infinite[i], sample);

        active &= dr::any(mitsuba::unpolarized_spectrum(sample.value) != 0.f);
        if (dr::none_or<false>(active))
            return Spectrum(0.f);
        Mask occluded = m_scene->ray_test(shading.si.spawn_ray_to(sample.p), active);
        return sample.value & (active && !occluded);
    }

    /// C = W / H of a reservoir, 0 if it is empty
    FloatD slot_weight(const Reservoirs<FloatD> &kept, const UInt32D &slot) const {
        return read_slot<FloatD>(kept.weight, slot, m_slots) /
               read_slot<FloatD>(kept.importance, slot, m_slots);
    }

    /// g = luminance(C F) of every item
    Slots<FloatD> stage3_targets(const Shading &shading, const Reservoirs<FloatD> &kept,
                                 const std::vector<Sample> &infinite, Mask active) const {
        dr::suspend_grad<Float> detached;
        struct State {
            UInt32D slot;
            Slots<FloatD> targets;
            DRJIT_STRUCT(State, slot, targets)
        };
        State state{ UInt32D(0), make_slots<FloatD>(m_items, 0.f) };
        loop(
            state,
            [&](const State &s) { return plain(active) && s.slot < dr::opaque<UInt32D>(m_slots); },
            [&](State &s) {
                FloatD weight = slot_weight(kept, s.slot);
                Mask filled = active && weight > 0.f;
                Sample sample = sample_slot(shading, kept, s.slot, /* target_only = */ true, filled);
                write_slot<FloatD>(s.targets, s.slot, weight * target(sample.value), m_items, true);
                s.slot += 1u;
            },
            "Direct light: targets");
        for (size_t i = 0; i < infinite.size(); ++i)
            state.targets[m_slots + i] = target(infinite[i].value);
        return state.targets;
    }

    /// Positive wherever the value is not zero; invalid values are never chosen
    static FloatD target(const Spectrum &value) {
        UnpolarizedSpectrum v = mitsuba::unpolarized_spectrum(value);
        Float result;
        if constexpr (mitsuba::is_rgb_v<Spectrum>)
            result = mitsuba::luminance(v);
        else
            result = dr::mean(v);
        FloatD g = plain(result);
        return dr::select(g > 0.f && dr::isfinite(g), g, 0.f);
    }

    /**
     * F / p for the light of a reservoir. Lights that need their plugin get a guess of the
     * same sign if only the target is wanted: their H times a typical BSDF value. The
     * plugin is then called for the chosen lights only.
     */
    Sample sample_slot(const Shading &shading, const Reservoirs<FloatD> &kept,
                       const UInt32D &slot, bool target_only, Mask active) const {
        UInt32D light = read_slot<UInt32D>(kept.light, slot, m_slots);
        FloatD inclusion = read_slot<FloatD>(kept.probability, slot, m_slots);
        const auto &tree = m_lights.tree();
        Row<FloatD> row = tree.row(light, plain(active));
        KindSet kinds = tree.kinds;
        Sample result = dr::zeros<Sample>();

        bool others = kinds.has(LightKind::Other);
        Mask other = others ? Mask(row.is(LightKind::Other)) : Mask(false);
        Mask table = active && !other;
        Point2f u = slot_point(shading.point, slot);
        if (dr::any_or<true>(table) && !kinds.only(LightKind::Other))
            result = sample_row(shading, row, u, inclusion, target_only, table);
        if (others) {
            other &= active;
            if (target_only) {
                constexpr float typical_bsdf = .2f;
                Float guess = Float(light_importance(shading.at, row, kinds)) * typical_bsdf;
                dr::masked(result.value, other) = mitsuba::depolarizer<Spectrum>(UnpolarizedSpectrum(guess));
            } else if (dr::any_or<true>(other)) {
                Sample sample = sample_emitter(shading, emitter_of(row), u, Float(inclusion), other);
                dr::masked(result, other) = sample;
            }
        }
        return result;
    }

    /// Each slot gets its own shift of the sampler's point (R2 sequence): stratified over
    /// the samples of a pixel and over the slots
    static Point2f slot_point(const Point2f &u, const UInt32D &slot) {
        Point2f shifted(dr::fmadd(Float(slot), .7548776662f, u.x()),
                        dr::fmadd(Float(slot), .5698402910f, u.y()));
        return shifted - dr::floor(shifted);
    }

    /// A sample of a light of the table
    Sample sample_row(const Shading &shading, const Row<FloatD> &row, const Point2f &u,
                      const FloatD &inclusion, bool target_only, Mask active) const {
        using LightPointD = LightPoint<FloatD>;
        mitsuba::Point<FloatD, 2> ud(plain(u.x()), plain(u.y()));
        LightPointD point = by_kind<LightPointD>(row, table_kinds(), [&](LightKind kind) {
            return sample_light<FloatD>(row, kind, shading.at.p, ud);
        });
        active &= point.pdf > 0.f;

        const SurfaceInteraction3f &si = shading.si;
        Vector3f d = dr::normalize(Point3f(point.p) - si.p);
        Spectrum emission =
            mitsuba::depolarizer<Spectrum>(color(row, si.wavelengths) & Mask(row.tabulated()));
        if (m_lights.needs_emitter_eval()) {
            Mask eval = active && !row.tabulated();
            if (target_only)
                dr::masked(emission, eval) = mitsuba::depolarizer<Spectrum>(
                    UnpolarizedSpectrum(Float(row[kLuminance])));
            else
                add_masked(emission, eval,
                           [&](Mask m) { return triangle_emission(si, row, point, d, m); });
        }
        bool delta_only = !m_lights.can_be_hit();
        Float light_pdf = delta_only ? Float(0.f) : Float(inclusion * point.pdf);
        Mask delta = row.kind() <= (uint32_t) LightKind::Spot;
        Spectrum f = scatter(shading, d, light_pdf, delta, active);
        return { f * emission * Float(point.weight) & active, Point3f(point.p) };
    }

    KindSet table_kinds() const {
        return { m_lights.tree().kinds.bits & ~(1u << (uint32_t) LightKind::Other) };
    }

    /// BSDF (with its cosine) times the MIS weight of the light side
    Spectrum scatter(const Shading &shading, const Vector3f &d, const Float &light_pdf,
                     const Mask &delta, Mask active) const {
        mitsuba::BSDFContext ctx;
        const SurfaceInteraction3f &si = shading.si;
        Vector3f wo = si.to_local(d);
        if (!needs_bsdf_samples())
            return si.to_world_mueller(shading.bsdf->eval(ctx, si, wo, active), -wo, si.wi);
        auto [value, pdf] = shading.bsdf->eval_pdf(ctx, si, wo, active);
        value = si.to_world_mueller(value, -wo, si.wi);
        Float weight = mis_weight<Float>(light_pdf, pdf * (float) m_params.bsdf_samples);
        return value * dr::detach(dr::select(delta, 1.f, weight));
    }

    /// A sample from the emitter's own plugin
    template <typename Ptr>
    Sample sample_emitter(const Shading &shading, const Ptr &emitter, const Point2f &u,
                          const Float &inclusion, Mask active) const {
        auto [ds, weight] = emitter->sample_direction(shading.si, u, active);
        active &= ds.pdf != 0.f;
        Spectrum f = scatter(shading, ds.d, inclusion * ds.pdf, ds.delta, active);
        return { f * weight & active, ds.p };
    }

    std::vector<Sample> sample_infinite(const Shading &shading, Mask active) const {
        std::vector<Sample> samples;
        for (const Emitter *emitter : m_lights.infinite()) {
            Point2f u = slot_point(shading.point, UInt32D(m_slots + (uint32_t) samples.size()));
            samples.push_back(sample_emitter(shading, emitter, u, Float(1.f), active));
        }
        return samples;
    }

    // ------------------------------------------------------------------------ Emission

    EmitterPtr emitter_of(const Row<FloatD> &row) const {
        using UInt32 = dr::uint32_array_t<Float>;
        return dr::gather<EmitterPtr>(m_scene->emitters_dr(), UInt32(row.emitter()), Mask(true));
    }

    /// Add f(mask) where the mask is set; scalar variants do not call f otherwise
    template <typename F> static void add_masked(Spectrum &result, Mask mask, const F &f) {
        if (dr::any_or<true>(mask))
            dr::masked(result, mask) = result + f(mask);
    }

    /// Radiance or intensity of a tabulated row
    static UnpolarizedSpectrum color(const Row<FloatD> &row, const Wavelength &wavelengths) {
        if constexpr (mitsuba::is_spectral_v<Spectrum>) {
            dr::Array<Float, 3> coefficients(row[kColor], row[kColor + 1], row[kColor + 2]);
            return Float(row[kScale]) * mitsuba::cie_d65<UnpolarizedSpectrum>(wavelengths) *
                   mitsuba::srgb_model_eval<UnpolarizedSpectrum>(coefficients, wavelengths);
        } else {
            UnpolarizedSpectrum result;
            for (size_t i = 0; i < result.size(); ++i)
                result.entry(i) = row[kColor + i];
            return result;
        }
    }

    /// Radiance of a triangle whose emission varies, from its emitter
    Spectrum triangle_emission(const SurfaceInteraction3f &from, const Row<FloatD> &row,
                               const LightPoint<FloatD> &point, const Vector3f &d,
                               Mask active) const {
        EmitterPtr emitter = emitter_of(row);
        PreliminaryIntersection3f pi = dr::zeros<PreliminaryIntersection3f>();
        MaskD flipped = row[kColor + 1] > 0.f;
        pi.valid = active;
        pi.t = dr::norm(Point3f(point.p) - from.p);
        pi.prim_uv = Point2f(dr::select(flipped, point.uv.y(), point.uv.x()),
                             dr::select(flipped, point.uv.x(), point.uv.y()));
        pi.prim_index = row.bits(kColor);
        pi.shape = emitter->shape();
        Ray3f ray(from.p, d, from.time, from.wavelengths);
        SurfaceInteraction3f si =
            pi.compute_surface_interaction(ray, +mitsuba::RayFlags::All, active);
        return emitter->eval(si, active);
    }

    // ------------------------------------------------------------------------- Density

    /// Density of the light side for the direction that hit `light` or the environment
    Float hit_density(const SurfaceInteraction3f &si, const BSDFPtr &bsdf,
                      const SurfaceInteraction3f &hit, const UInt32D &light,
                      const LightSample<Float> &u, Mask active) const {
        Float result(0.f);
        Mask found = active && light != kNone;
        if (m_lights.can_be_hit() && dr::any_or<true>(found)) {
            dr::suspend_grad<Float> detached;
            const auto &tree = m_lights.tree();
            Row<FloatD> row = tree.row(light, plain(found));
            Receiver<FloatD> at = receiver(si, bsdf, active);
            FloatD pdf = by_kind<FloatD>(row, table_kinds(), [&](LightKind kind) {
                return light_pdf<FloatD>(row, kind, at.p, plain(hit.p), plain(Vector3f(hit.n)));
            });
            result = Float(pdf);
            if (tree.kinds.has(LightKind::Other)) {
                Mask other = found && row.is(LightKind::Other);
                if (dr::any_or<true>(other)) {
                    DirectionSample3f ds(m_scene, hit, si);
                    dr::masked(result, other) = emitter_of(row)->pdf_direction(si, ds, other);
                }
            }
            result *= Float(inclusion_probability(at, light, plain(u.tree), plain(found)));
            result = dr::select(found, result, 0.f);
        }
        Mask missed = active && !hit.is_valid();
        if (const Emitter *environment = m_scene->environment();
            environment && dr::any_or<true>(missed)) {
            DirectionSample3f ds(m_scene, hit, si);
            dr::masked(result, missed) = environment->pdf_direction(si, ds, missed);
        }
        return result;
    }

    /// Probability that `light` is a candidate at this shading point
    FloatD inclusion_probability(const Receiver<FloatD> &at, const UInt32D &light,
                                 const FloatD &u_tree, const MaskD &active) const {
        if (m_all || m_params.visits_all())
            return FloatD(1.f);
        if (m_params.method == Method::Talk)
            return talk_cursor(u_tree).inclusion_probability(m_lights.tree(), at, light, active);
        return dr::minimum(
            1.f, dr::opaque<FloatD>(m_params.expected_candidates()) * leaf_probability(m_lights.tree(), at, light, active));
    }

    const Scene *m_scene;
    const Lights &m_lights;
    const SamplingParameters &m_params;
    bool m_all;
    uint32_t m_slots, m_items;
};

} // namespace manylights
