#pragma once

#include "light_geometry.h"
#include "quadric.h"
#include <mitsuba/core/frame.h>
#include <optional>

namespace manylights {

/// The side of a cylinder, sampled uniformly by area. Its row: base[3], axis[3] (of the
/// cylinder's length), radius, +1 (emits outwards) or -1 (inwards)
struct CylinderLight : WithoutBeam {
    static constexpr LightKind kind = LightKind::Cylinder;
    static constexpr bool is_delta  = false;

    /// None if it is not circular and upright, of which Mitsuba warns; `e`: what was read of
    /// its emission
    template <typename Float, typename Spectrum>
    static std::optional<HostLight> read(const mitsuba::Emitter<Float, Spectrum> *emitter,
                                         const mitsuba::Shape<Float, Spectrum> *shape,
                                         const Emission &e,
                                         ShownImages<Float, Spectrum> &images) {
        ToWorld to_world(shape);
        const auto &m = to_world.m;
        if (!is_round(m))
            return {};
        LightRow row = make_quadric<CylinderLight>(emitter, shape, e, to_world, images);
        float radius = to_world.column_length(0), length = to_world.column_length(2),
              center[3];
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = m[i][3];
            row.geometry[3 + i] = m[i][2];
            center[i]           = m[i][3] + .5f * m[i][2];
        }
        row.geometry[6] = radius;
        // A mirror turns normals over once, and Mitsuba's mark of it once more
        bool inwards    = shape->has_flipped_normals() != (to_world.determinant() < 0);
        row.geometry[7] = inwards ? -1.f : 1.f;

        LightBounds bounds = point_bounds(center);
        for (int i = 0; i < 3; ++i) {
            bounds.box_min[i] = std::min(m[i][3], m[i][3] + m[i][2]);
            bounds.box_max[i] = std::max(m[i][3], m[i][3] + m[i][2]);
        }
        grow(bounds, radius);
        bounds.variance = (length * length / 12 + radius * radius) / 3;
        return HostLight{ row, bounds };
    }

    /// A point of the unit cylinder's side, uniform by area
    static std::array<double, 3> unit_point(double a, double b) {
        double angle = 2 * kPi * b;
        return { std::cos(angle), std::sin(angle), a };
    }

    template <typename Image> static float mean_of_image(const Image &image) {
        return image.mean(0, 0, 1, 1);
    }

    static double power(const LightRow &row) {
        const float *g    = row.geometry;
        double brightness = row.brightness;
        return 2 * kPi * g[6] * norm(g + 3) * kPi * brightness;
    }

    static float diameter(const LightRow &row) {
        return norm(row.geometry + 3) + 2 * row.geometry[6];
    }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x, float) {
        using Vector3f = mitsuba::Vector<Float, 3>;
        Vector3f axis = row.vector(3), w = row.vector(0) - x + .5f * axis;
        Float length2 = dr::squared_norm(axis), radius2 = dr::square(row[6]);
        // Silhouette: between the end's disk and the side's rectangle
        return { w, length2 * (1.f / 12.f) + .5f * radius2,
                 2.f * dr::sqrt(radius2 * length2) + dr::Pi<Float> * radius2 };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &row,
                                    const typename Row<Float>::Point3f &x,
                                    const typename Row<Float>::Point2f &u) {
        using Vector3f = mitsuba::Vector<Float, 3>;
        using Point3f  = mitsuba::Point<Float, 3>;
        Vector3f axis  = row.vector(3);
        Float length = dr::norm(axis), radius = row[6];
        auto [sin_p, cos_p] = dr::sincos(dr::TwoPi<Float> * u.y());
        Vector3f radial =
            mitsuba::Frame<Float>(axis / length).to_world(Vector3f(cos_p, sin_p, 0.f));
        Point3f p = row.vector(0) + u.x() * axis + radius * radial;
        return surface_point<Float>(
            p, area_to_solid_angle<Float>(dr::TwoPi<Float> * radius * length, p - x,
                                          radial * row[7]));
    }

    /// Is the point p, which shines inwards, behind its outside, seen from x? Where the line
    /// between them enters the cylinder is closer to x, and between the ends.
    template <typename Float>
    static dr::mask_t<Float> hides(const Row<Float> &row,
                                   const typename Row<Float>::Point3f &p,
                                   const typename Row<Float>::Point3f &x) {
        using Vector3f  = mitsuba::Vector<Float, 3>;
        Vector3f axis   = row.vector(3), to_p(p - row.vector(0)), back(x - p);
        Float scale     = dr::rcp(dr::squared_norm(axis)),
              height_p  = dr::dot(to_p, axis) * scale,
              height_d  = dr::dot(back, axis) * scale;
        Vector3f radial = to_p - height_p * axis, across = back - height_d * axis;
        Float share  = -2.f * dr::dot(radial, across) / dr::squared_norm(across),
              height = dr::fmadd(share, height_d, height_p);
        return row[7] < 0.f && share < 1.f && height > 0.f && height < 1.f;
    }

    template <typename Float>
    static mitsuba::Vector<Float, 3> normal(const Row<Float> &row,
                                            const typename Row<Float>::Point3f &p) {
        using Vector3f = mitsuba::Vector<Float, 3>;
        Vector3f axis  = row.vector(3), w(p - row.vector(0));
        return dr::normalize(w - axis * (dr::dot(w, axis) / dr::squared_norm(axis))) *
               row[7];
    }

    template <typename Float>
    static Float pdf(const Row<Float> &row, const typename Row<Float>::Point3f &x,
                     const typename Row<Float>::Point3f &p,
                     const typename Row<Float>::Vector3f &n) {
        return area_to_solid_angle<Float>(
            dr::TwoPi<Float> * row[6] * dr::norm(row.vector(3)), p - x, n);
    }

private:
    /// Is a cylinder, whose rays hit what its matrix says, a circular and upright one?
    static bool is_round(const float (&m)[3][4]) {
        auto dot = [&](int i, int j) {
            return m[0][i] * m[0][j] + m[1][i] * m[1][j] + m[2][i] * m[2][j];
        };
        constexpr float tolerance = 1e-3f;
        float square = dot(0, 0), along = std::sqrt(square * dot(2, 2));
        return std::abs(dot(1, 1) - square) <= tolerance * square &&
               std::abs(dot(0, 1)) <= tolerance * square &&
               std::max(std::abs(dot(0, 2)), std::abs(dot(1, 2))) <= tolerance * along;
    }
};

} // namespace manylights
