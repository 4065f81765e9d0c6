#pragma once

#include "light_bounds.h"
#include "light_geometry.h"
#include "manylights/emission/emission_reader.h"
#include <mitsuba/render/emitter.h>
#include <optional>

namespace manylights {

/// Spot of a hard edge: 1 / (cutoff - beam width), which would be infinite
constexpr float kHardEdge = 1e10f;
/// Spots up to this angle are narrow: wider ones resemble a cosine
constexpr float kWidestBeam = .5f;

/// A point that sends a cone of light about an axis. Its row: position[3], axis[3], cutoff
/// angle (rad), 1 / (cutoff - beam width)
struct SpotLight : DeltaLight {
    static constexpr LightKind kind = LightKind::Spot;
    static constexpr bool has_beam  = true;

    /// None if a row cannot hold it: of another shape than a cone, or with a texture
    template <typename Float, typename Spectrum>
    static std::optional<HostLight> read(const mitsuba::Emitter<Float, Spectrum> *emitter,
                                         bool textured) {
        ParameterReader params(emitter);
        Emission e              = EmissionReader<Float, Spectrum>::read(emitter);
        const Float *cutoff_deg = params.find<Float>("cutoff_angle"),
                    *beam_deg   = params.find<Float>("beam_width");
        float matrix[3][4];
        if (!e.tabulated || textured || !cutoff_deg || !beam_deg ||
            !read_similarity(emitter->world_transform(), matrix))
            return {};

        float cutoff = dr::deg_to_rad(read_scalar(*cutoff_deg)),
              beam   = dr::deg_to_rad(read_scalar(*beam_deg));
        LightRow row = make_row(kind, e);
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
        return HostLight{ row, bounds };
    }

    static double power(const LightRow &row) {
        double brightness = row.brightness;
        return unit_power(row.geometry[6], row.geometry[7]) * brightness;
    }

    static bool is_narrow(const LightRow &row) { return row.geometry[6] < kWidestBeam; }

    template <typename Float> static Beam<Float> beam(const Row<Float> &row) {
        auto [sine, cosine] = dr::sincos(row[6]);
        return { row.vector(3), cosine, sine };
    }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x,
                                        float least) {
        auto w          = row.vector(0) - x;
        Float cos_theta = -dr::dot(row.vector(3), w) * dr::rsqrt(dr::squared_norm(w));
        return { w, Float(0.f),
                 dr::maximum(falloff(row, cos_theta), least) * can_shine<Float>(w) };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &row,
                                    const typename Row<Float>::Point3f &x,
                                    const typename Row<Float>::Point2f &) {
        auto w       = row.vector(0) - x;
        Float inv_d2 = dr::rcp(dr::squared_norm(w)), weight = inv_d2;
        weight *= falloff<Float>(row, -dr::dot(row.vector(3), w) * dr::sqrt(inv_d2));
        return delta_point<Float>(row, weight);
    }

private:
    /// Power of a spot of intensity 1, uniform up to the middle of the transition
    static float unit_power(float cutoff, float inverse_transition) {
        float beam =
            inverse_transition < kHardEdge ? cutoff - 1 / inverse_transition : cutoff;
        // (1 - cos) as 2 sin^2, without cancellation
        float sin_beam = std::sin(.5f * beam), sin_cutoff = std::sin(.5f * cutoff);
        return 2 * kPi * (sin_beam * sin_beam + sin_cutoff * sin_cutoff);
    }

    /// Fraction of the beam that is sent at `cos_theta` from the axis (as Mitsuba's)
    template <typename Float>
    static Float falloff(const Row<Float> &row, const Float &cos_theta) {
        Float angle = dr::acos(dr::clip(cos_theta, -1.f, 1.f));
        return dr::clip((row[6] - angle) * row[7], 0.f, 1.f);
    }

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
};

} // namespace manylights
