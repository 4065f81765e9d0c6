#pragma once

/**
 * Readers of all other emitters: those that their own plugin samples (projectors, exotic
 * shapes), those without a place, and those that only rays can find.
 */

#include "table_builder.h"
#include <mitsuba/core/qmc.h>

namespace manylights {

template <typename Float, typename Spectrum> class OtherLights {
public:
    MI_IMPORT_TYPES(Emitter)
    using Builder = TableBuilder<Float, Spectrum>;

    explicit OtherLights(Builder &builder) : m_builder(builder) {}

    /// Environments, suns and directional lights: always candidates
    void add_infinite(const Emitter *emitter) {
        m_builder.add_infinite(emitter, EmissionReader<Float, Spectrum>::read(emitter));
    }

    /// Mitsuba's sampling never chooses an emitter of weight 0, so that rays alone find it
    void add_unsampled(const Emitter *emitter) {
        if (!m_builder.has(mitsuba::EmitterFlags::Surface))
            return m_builder.count_unreachable();
        m_builder.count_hit_able();
        m_builder.push_only_hit(emitter);
    }

    /// Some shapes (ellipsoidsmesh) do not tell their emitter about themselves
    void add_unattached(const Emitter *emitter) {
        m_builder.add_only_hit();
        m_builder.push_only_hit(emitter);
    }

    /// One light for the whole emitter, sampled by its plugin
    void add(const Emitter *emitter) {
        ScalarPoint3f low, high;
        if (!can_sample(emitter))
            return m_builder.add_only_hit();
        if (!find_bounds(emitter, low, high)) {
            if (m_builder.has(mitsuba::EmitterFlags::Surface))
                return m_builder.add_only_hit();
            // Without a place it cannot be in the tree: always a candidate
            return m_builder.add_infinite(emitter);
        }
        float power = emitted_power(emitter);
        Emission e;
        e.brightness = power > 0 ? power / (4 * kPi) : m_builder.unknown_brightness();
        LightRow row = m_builder.make_row(LightKind::Other, e);
        LightBounds bounds = {};
        double square      = 0;
        for (int i = 0; i < 3; ++i) {
            bounds.box_min[i] = (float) low[i];
            bounds.box_max[i] = (float) high[i];
            bounds.mean[i]    = .5f * ((float) low[i] + (float) high[i]);
            double extent     = (double) high[i] - low[i];
            square += extent * extent / 12;
        }
        bounds.variance = (float) (square / 3);
        std::copy_n(bounds.mean, 3, row.geometry);
        row.geometry[3] = bounds.variance;
        m_builder.add_light(row, bounds);
    }

private:
    /// Some shapes of Mitsuba (curves) have no way to choose a point on them
    bool can_sample(const Emitter *emitter) const {
        try {
            SurfaceInteraction3f si = dr::zeros<SurfaceInteraction3f>();
            auto [ds, weight]       = emitter->sample_direction(si, Point2f(.5f), true);
            (void) ds;
            (void) weight;
            return true;
        } catch (const std::exception &e) {
            if (m_builder.has(mitsuba::EmitterFlags::Surface))
                return false;
            throw std::runtime_error("manylights: the emitter \"" +
                                     Builder::name_of(emitter) +
                                     "\" cannot be sampled: " + e.what());
        }
    }

    bool find_bounds(const Emitter *emitter, ScalarPoint3f &low,
                     ScalarPoint3f &high) const {
        decltype(emitter->bbox()) box;
        try {
            box = emitter->shape() ? emitter->shape()->bbox() : emitter->bbox();
        } catch (const std::exception &) { // written in Python, without one
            return false;
        }
        low        = box.min;
        high       = box.max;
        bool delta = m_builder.has(mitsuba::EmitterFlags::DeltaPosition);
        if (!box.valid() && delta) { // projectors have no box, only a transformation
            auto position = emitter->world_transform().translation();
            for (int i = 0; i < 3; ++i)
                low[i] = high[i] = read_scalar(position.entry(i));
        }
        return dr::all(dr::isfinite(low) && dr::isfinite(high) && low <= high);
    }

    /// Mean weight of rays that the emitter sends out; 0 if that is not known: it may not be
    /// able to send any, or a narrow beam was missed
    static float emitted_power(const Emitter *emitter) {
        MI_IMPORT_CORE_TYPES()
        constexpr uint32_t count = 1024;
        float power              = 0;
        try {
            auto weight = [&](const auto &i) {
                using UInt = std::decay_t<decltype(i)>;
                Float a    = Float(mitsuba::radical_inverse_2(UInt(i), UInt(0)));
                Point2f u((Float(i) + .5f) / (float) count, a);
                Point2f v(a, dr::fmadd(Float(i), .6180339887f, 0.f));
                v.y() -= dr::floor(v.y());
                auto [ray, spectrum] = emitter->sample_ray(0.f, .5f, u, v, true);
                (void) ray;
                return dr::mean(mitsuba::unpolarized_spectrum(spectrum));
            };
            if constexpr (dr::is_jit_v<Float>) {
                power = read_scalar(dr::mean(weight(dr::arange<UInt32>(count)) +
                                             dr::zeros<Float>(count)));
            } else {
                for (uint32_t i = 0; i < count; ++i)
                    power += weight(i) / count;
            }
            if constexpr (mitsuba::is_spectral_v<Spectrum>)
                power /= MI_CIE_MAX - MI_CIE_MIN;
        } catch (const std::exception &) {
        }
        return std::isfinite(power) ? power : 0.f;
    }

    Builder &m_builder;
};

} // namespace manylights
