#pragma once

/**
 * Points on lights, as samples without visibility: F / p with F = BSDF * emission * geometry
 * * MIS weight. Lights at infinity never enter the tree, and have samples of their own.
 */

#include "manylights/receiver/light_importance.h"
#include "manylights/scene/scene_emission.h"
#include "mis_weight.h"
#include "ray_sample.h"
#include "strategy.h"
#include "vertex_numbers.h"
#include <array>
#include <cfloat>

namespace manylights {

template <typename Float, typename Spectrum> class LightSamples {
public:
    MI_IMPORT_TYPES(Scene, Emitter, EmitterPtr)
    using Lights          = SceneLights<Float, Spectrum>;
    using Emission        = SceneEmission<Float, Spectrum>;
    using FloatD          = typename Lights::FloatD;
    using UInt32D         = typename Lights::UInt32D;
    using MaskD           = typename Lights::MaskD;
    using Reader          = ReceiverReader<Float, Spectrum>;
    using Vertex          = manylights::Vertex<Float, Spectrum>;
    using Distances       = typename Vertex::Distances;
    using Sample          = RaySample<Float, Spectrum>;
    using InfiniteSamples = std::array<Sample, kMaxInfinite>;

    /// @param mis  are directions sampled from the BSDF, too?
    LightSamples(const Lights &lights, const Emission &emission, const Strategy &strategy,
                 bool mis)
        : m_lights(lights), m_emission(emission), m_strategy(strategy), m_mis(mis) {}

    /// What values are compared by: in units of the scene's brightest light
    FloatD target(const Spectrum &value) const {
        return Reader::target(value, m_lights.tree().scale);
    }

    /// For film channels: the light of a weighted target F f that should arrive, F f^2 = F v
    FloatD expected(const FloatD &target, const FloatD &visibility,
                    const MaskD &active) const {
        return dr::select(active, target * visibility * m_lights.tree().unit, 0.f);
    }

    /**
     * F / p for a point on a light. Lights that need their plugin get a guess of the same
     * sign if only the target is wanted: their H times a typical BSDF value. The plugin is
     * then called for the chosen lights only.
     */
    Sample sample(const Vertex &vertex, const UInt32D &light, const FloatD &inclusion,
                  const UInt32D &slot, bool target_only, Mask active) const {
        Row<FloatD> row = m_lights.tree().row(light, plain(active));
        if (vertex.at.extent == Extent::Point)
            return sample_row_point(vertex, row, inclusion, slot, target_only, active);
        auto along = distances_to(vertex.at, row, m_lights.tree().kinds);
        FloatD t = along.sample(slot_distance(vertex, slot), slot_channel(vertex, slot));
        return at_distance(
            vertex, t, along.pdf(t), target_only, active, [&](const Vertex &v) {
                return sample_row_point(v, row, inclusion, slot, target_only, active);
            });
    }

    /// Lights at infinity: all of them, or one chosen at random if there are many
    MI_NOINLINE InfiniteSamples sample_infinite(const Vertex &vertex, Mask active) const {
        InfiniteSamples samples;
        float p = m_strategy.infinite_probability;
        for (uint32_t i = 0; i < m_strategy.infinite; ++i) {
            Point2f u   = infinite_point(vertex, i);
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
            UInt32D slot(m_strategy.slots + i);
            FloatD t = Distances::sample_transmittance(
                vertex.at, slot_distance(vertex, slot), slot_channel(vertex, slot));
            samples[i] =
                at_distance(vertex, t, Distances::transmittance_pdf(vertex.at, t),
                            /* target_only = */ false, active, sample);
        }
        return samples;
    }

    /// The group of light number i of \ref sample_infinite
    UInt32D infinite_group(const Vertex &vertex, uint32_t i, Mask active) const {
        UInt32D index(i);
        if (m_strategy.infinite_probability != 1.f) {
            Point2f u = infinite_point(vertex, i);
            index     = plain(choose_infinite(u));
        }
        return m_lights.groups().of_infinite(index, plain(active));
    }

private:
    Point2f infinite_point(const Vertex &vertex, uint32_t i) const {
        return slot_point(vertex.u.point, UInt32D(m_strategy.slots + i));
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
                // H is attenuated already: no distance
                Point3f here(vertex.at.p);
                dr::masked(result, other) = Sample::make(
                    Spectrum(1.f),
                    mitsuba::depolarizer<Spectrum>(UnpolarizedSpectrum(guess)), here,
                    here, Mask(false));
            } else if (dr::any_or<true>(other)) {
                Sample sample = sample_emitter(vertex, m_emission.emitter_of(row), u,
                                               Float(inclusion), other);
                dr::masked(result, other) = sample;
            }
        }
        return result;
    }

    /// A sample of a light of the table
    Sample sample_row(const Vertex &vertex, const Row<FloatD> &row, const Point2f &u,
                      const FloatD &inclusion, bool target_only, Mask active) const {
        using LightPointD = LightPoint<FloatD>;
        mitsuba::Point<FloatD, 2> ud(plain(u.x()), plain(u.y()));
        LightPointD point =
            by_kind<LightPointD>(row, m_lights.table_kinds(), [&](auto kind) {
                return kind.sample(row, vertex.at.p, ud);
            });
        active &= point.pdf > 0.f;

        Interaction3f from = vertex.origin();
        Vector3f d         = dr::normalize(Point3f(point.p) - from.p);
        Spectrum emission  = target_only
                                 ? m_emission.tabulated(row, from.wavelengths)
                                 : m_emission.of_point(from, row, point, d, active);
        if (target_only && m_lights.needs_emitter_eval())
            dr::masked(emission, active && !row.tabulated()) =
                mitsuba::depolarizer<Spectrum>(
                    UnpolarizedSpectrum(Float(row[kBrightness])));
        bool delta_only = !m_lights.can_be_hit();
        Float light_pdf = delta_only ? Float(0.f) : Float(inclusion * point.pdf);
        Mask delta      = is_delta(row, m_lights.table_kinds());
        Spectrum f      = scatter(vertex, d, light_pdf, delta, active);
        return Sample::make(f & active, emission * Float(point.weight) & active,
                            Point3f(point.p), from.p,
                            Mask(may_end_close(row, m_lights.table_kinds())));
    }

    /// What the vertex scatters times the MIS weight of the light side
    Spectrum scatter(const Vertex &vertex, const Vector3f &d, const Float &light_pdf,
                     const Mask &delta, Mask active) const {
        auto [value, pdf] = vertex.eval_pdf(d, m_mis, active);
        if (!m_mis)
            return value;
        Float weight =
            mis_weight<Float>(light_pdf, pdf * (float) m_strategy.params.bsdf_samples);
        return value * dr::detach(dr::select(delta, 1.f, weight));
    }

    /// A sample from the emitter's own plugin
    template <typename Ptr>
    Sample sample_emitter(const Vertex &vertex, const Ptr &emitter, const Point2f &u,
                          const Float &inclusion, Mask active) const {
        auto [ds, weight] = emitter->sample_direction(vertex.origin(), u, active);
        active &= ds.pdf != 0.f;
        Spectrum f = scatter(vertex, ds.d, inclusion * ds.pdf, ds.delta, active);
        return Sample::make(f & active, weight & active, ds.p, ds.p, Mask(false));
    }

    /// Which of many lights at infinity a number chooses; it can be used again then
    dr::uint32_array_t<Float> choose_infinite(Point2f &u) const {
        using UInt32   = dr::uint32_array_t<Float>;
        uint32_t count = (uint32_t) m_lights.infinite().size();
        UInt32 index   = dr::minimum(UInt32(u.x() * (float) count), count - 1u);
        u.x()          = u.x() * (float) count - Float(index);
        return index;
    }

    /// One of many lights at infinity, chosen at random
    Sample sample_some_infinite(const Vertex &vertex, Point2f u, Mask active) const {
        uint32_t count = (uint32_t) m_lights.infinite().size();
        auto index     = choose_infinite(u);
        EmitterPtr emitter =
            dr::gather<EmitterPtr>(m_lights.infinite_dr(), index, active);
        Sample sample = sample_emitter(vertex, emitter, u,
                                       Float(m_strategy.infinite_probability), active);
        sample.value *= (float) count;
        return sample;
    }

    const Lights &m_lights;
    const Emission &m_emission;
    const Strategy &m_strategy;
    bool m_mis;
};

} // namespace manylights
