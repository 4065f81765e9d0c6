#pragma once

#include "light_bounds.h"
#include "light_geometry.h"
#include "manylights/emission/emission_reader.h"
#include <mitsuba/render/emitter.h>
#include <optional>

namespace manylights {

/// A point that shines in all directions alike. Its row: position[3]
struct PointLight : DeltaLight {
    static constexpr LightKind kind = LightKind::Point;

    /// None if a row cannot hold what it emits
    template <typename Float, typename Spectrum>
    static std::optional<HostLight>
    read(const mitsuba::Emitter<Float, Spectrum> *emitter) {
        Emission e = EmissionReader<Float, Spectrum>::read(emitter);
        if (!e.tabulated)
            return {};
        LightRow row = make_row(kind, e);
        // The emitter keeps its position on the host, too
        auto position = emitter->bbox().min;
        for (int i = 0; i < 3; ++i)
            row.geometry[i] = (float) position[i];
        return HostLight{ row, point_bounds(row.geometry) };
    }

    static double power(const LightRow &row) {
        double brightness = row.brightness;
        return 4 * kPi * brightness;
    }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x, float) {
        auto w = row.vector(0) - x;
        return { w, Float(0.f), can_shine<Float>(w) };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &row,
                                    const typename Row<Float>::Point3f &x,
                                    const typename Row<Float>::Point2f &) {
        auto w = row.vector(0) - x;
        return delta_point<Float>(row, dr::rcp(dr::squared_norm(w)));
    }
};

} // namespace manylights
