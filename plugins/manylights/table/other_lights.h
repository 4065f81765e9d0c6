#pragma once

/**
 * Readers of all other emitters: those that their own plugin samples (projectors, exotic
 * shapes), those without a place, and those that only rays can find.
 */

#include "table_builder.h"

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
        if (!can_sample(emitter))
            return m_builder.add_only_hit();
        auto box = OtherLight::find_box(
            emitter, m_builder.has(mitsuba::EmitterFlags::DeltaPosition));
        if (!box) {
            if (m_builder.has(mitsuba::EmitterFlags::Surface))
                return m_builder.add_only_hit();
            // Without a place it cannot be in the tree: always a candidate
            return m_builder.add_infinite(emitter);
        }
        float power = OtherLight::emitted_power(emitter);
        m_builder.add_light(OtherLight::read(
            *box, power > 0 ? power / (4 * kPi) : m_builder.unknown_brightness()));
    }

private:
    /// Some shapes of Mitsuba (curves) have no way to choose a point on them. With a texture
    /// B-spline curves pretend that they have: they read behind their last segment.
    bool can_sample(const Emitter *emitter) const {
        const auto *shape = emitter->shape();
        if (shape && shape->shape_type() == +mitsuba::ShapeType::BSplineCurve)
            return false;
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

    Builder &m_builder;
};

} // namespace manylights
