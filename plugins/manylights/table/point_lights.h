#pragma once

/**
 * Readers of point lights and spots.
 */

#include "table_builder.h"

namespace manylights {

template <typename Float, typename Spectrum> class PointLights {
public:
    MI_IMPORT_TYPES(Emitter)
    using Builder = TableBuilder<Float, Spectrum>;

    explicit PointLights(Builder &builder) : m_builder(builder) {}

    /// False if a row cannot hold what it emits
    bool add_point(const Emitter *emitter) {
        Emission e = EmissionReader<Float, Spectrum>::read(emitter);
        if (!e.tabulated)
            return false;
        LightRow row = m_builder.make_row(LightKind::Point, e);
        // The emitter keeps its position on the host, too
        auto position = emitter->bbox().min;
        for (int i = 0; i < 3; ++i)
            row.geometry[i] = (float) position[i];
        m_builder.add_light(row, point_bounds(row.geometry));
        return true;
    }

    /// False if a row cannot hold it: of another shape than a cone, or with a texture
    bool add_spot(const Emitter *emitter) {
        ParameterReader params(emitter);
        Emission e              = EmissionReader<Float, Spectrum>::read(emitter);
        const Float *cutoff_deg = params.find<Float>("cutoff_angle"),
                    *beam_deg   = params.find<Float>("beam_width");
        float matrix[3][4];
        bool textured = m_builder.has(mitsuba::EmitterFlags::SpatiallyVarying);
        if (!e.tabulated || textured || !cutoff_deg || !beam_deg ||
            !read_similarity(emitter->world_transform(), matrix))
            return false;

        float cutoff = dr::deg_to_rad(read_scalar(*cutoff_deg)),
              beam   = dr::deg_to_rad(read_scalar(*beam_deg));
        LightRow row = m_builder.make_row(LightKind::Spot, e);
        float length = norm(matrix[0][2], matrix[1][2], matrix[2][2]);
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = matrix[i][3];
            row.geometry[3 + i] = matrix[i][2] / length;
        }
        row.geometry[6] = cutoff;
        // Without a transition (or an inverted one) the edge is hard
        row.geometry[7] =
            cutoff > beam ? std::min(1.f / (cutoff - beam), kHardEdge) : kHardEdge;

        LightBounds bounds = point_bounds(row.geometry);
        // Uniform up to the middle of the transition
        float mean_cosine = .5f + .5f * std::cos(.5f * (std::min(beam, cutoff) + cutoff));
        for (int i = 0; i < 3; ++i)
            bounds.axis[i] = mean_cosine * row.geometry[3 + i];
        m_builder.add_light(row, bounds);
        return true;
    }

private:
    /// The upper 3x4 part of a transform, if it keeps angles
    template <typename Transform>
    static bool read_similarity(const Transform &transform, float matrix[3][4]) {
        for (size_t i = 0; i < 3; ++i)
            for (size_t j = 0; j < 4; ++j)
                matrix[i][j] = read_scalar(transform.matrix.entry(i, j));
        float dots[6], scale = 0;
        const int pairs[6][2] = { { 0, 0 }, { 1, 1 }, { 2, 2 },
                                  { 0, 1 }, { 0, 2 }, { 1, 2 } };
        for (int k = 0; k < 6; ++k) {
            dots[k] = 0;
            for (int i = 0; i < 3; ++i)
                dots[k] += matrix[i][pairs[k][0]] * matrix[i][pairs[k][1]];
            scale = std::max(scale, std::abs(dots[k]));
        }
        float error =
            std::max({ std::abs(dots[0] - dots[1]), std::abs(dots[0] - dots[2]),
                       std::abs(dots[3]), std::abs(dots[4]), std::abs(dots[5]) });
        return scale > 0 && error < 1e-5f * scale;
    }

    Builder &m_builder;
};

} // namespace manylights
