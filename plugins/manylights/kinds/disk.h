#pragma once

#include "light_geometry.h"
#include "quadric.h"
#include <mitsuba/core/warp.h>

namespace manylights {

/// A disk or ellipse, sampled uniformly by area. Its row: centre[3], u[3], v[3], which make it
/// of the unit disk; it emits along u x v
struct DiskLight {
    static constexpr LightKind kind = LightKind::Disk;
    static constexpr bool is_delta  = false;
    static constexpr bool has_beam  = true;

    /// `e`: what was read of its emission
    template <typename Float, typename Spectrum>
    static HostLight read(const mitsuba::Emitter<Float, Spectrum> *emitter,
                          const mitsuba::Shape<Float, Spectrum> *shape, const Emission &e,
                          ShownImages<Float, Spectrum> &images) {
        ToWorld to_world(shape);
        const auto &m = to_world.m;
        // A mirrored disk keeps its normal: swap the axes instead
        int u        = to_world.determinant() < 0 ? 1 : 0;
        LightRow row = make_quadric<DiskLight>(emitter, shape, e, to_world, images);
        if (!e.tabulated)
            set_primitive(row, 0, u == 1);
        for (int i = 0; i < 3; ++i) {
            row.geometry[i]     = m[i][3];
            row.geometry[3 + i] = m[i][u];
            row.geometry[6 + i] = m[i][1 - u];
        }
        LightBounds bounds = point_bounds(row.geometry);
        set_axis(bounds, row.geometry + 3, row.geometry + 6);
        float radius = std::max(to_world.column_length(0), to_world.column_length(1));
        grow(bounds, radius);
        bounds.variance = radius * radius / 6;
        return { row, bounds };
    }

    /// A point of the unit disk, uniform by area
    static std::array<double, 3> unit_point(double a, double b) {
        double angle = 2 * kPi * b, radius = std::sqrt(a);
        return { radius * std::cos(angle), radius * std::sin(angle), 0 };
    }

    /// Rings of the image, weighted with their area: u is the radius
    template <typename Image> static float mean_of_image(const Image &image) {
        constexpr int rings = 32;
        double sum          = 0;
        for (int i = 0; i < rings; ++i) {
            double low = i / (double) rings, high = (i + 1) / (double) rings;
            sum += (high * high - low * low) * image.mean(low, 0, high, 1);
        }
        return (float) sum;
    }

    static double power(const LightRow &row) {
        double brightness = row.brightness;
        return edge_area(row.geometry + 3, row.geometry + 6) * kPi * kPi * brightness;
    }

    static float diameter(const LightRow &row) {
        return 2 * std::max(norm(row.geometry + 3), norm(row.geometry + 6));
    }

    template <typename Float> static Beam<Float> beam(const Row<Float> &row) {
        return flat_beam(row);
    }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x,
                                        float least) {
        using Vector3f = mitsuba::Vector<Float, 3>;
        Vector3f w     = row.vector(0) - x,
                 a     = dr::Pi<Float> * dr::cross(row.vector(3), row.vector(6));
        return { w, .16f * dr::norm(a),
                 max_of(flat_intensity<Float>(a, w), least * dr::norm(a)) };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &row,
                                    const typename Row<Float>::Point3f &x,
                                    const typename Row<Float>::Point2f &u) {
        return flat_point<Float>(
            row, x, mitsuba::warp::square_to_uniform_disk_concentric(u), dr::Pi<float>);
    }

    template <typename Float>
    static mitsuba::Vector<Float, 3> normal(const Row<Float> &row,
                                            const typename Row<Float>::Point3f &) {
        return flat_normal(row);
    }

    template <typename Float>
    static Float pdf(const Row<Float> &row, const typename Row<Float>::Point3f &x,
                     const typename Row<Float>::Point3f &p,
                     const typename Row<Float>::Vector3f &) {
        return flat_pdf<Float>(row, dr::Pi<float>, p - x);
    }
};

} // namespace manylights
