#pragma once

#include "light_geometry.h"
#include "quadric.h"
#include <mitsuba/core/frame.h>
#include <mitsuba/core/warp.h>

namespace manylights {

/// From outside, the cone that a sphere fills; from within (or close to it), its area
template <typename Float> struct SphereCone {
    dr::mask_t<Float> outside;
    Float one_minus_cos, sin2;

    SphereCone(const mitsuba::Vector<Float, 3> &to_center, const Float &radius)
        : outside(dr::squared_norm(to_center) > dr::square(radius) * 1.0002f) {
        sin2 = dr::square(radius) / dr::squared_norm(to_center);
        // 1 - cos without cancellation
        one_minus_cos = sin2 / (1.f + dr::safe_sqrt(1.f - sin2));
    }

    Float pdf() const { return dr::rcp(dr::TwoPi<Float> * one_minus_cos); }
};

/// A sphere, sampled by the cone that it fills, and uniformly by area from within. Its row:
/// centre[3], radius, +1 (emits outwards) or -1 (inwards)
struct SphereLight : WithoutBeam {
    static constexpr LightKind kind = LightKind::Sphere;
    static constexpr bool is_delta  = false;

    /// `e`: what was read of its emission
    template <typename Float, typename Spectrum>
    static HostLight read(const mitsuba::Emitter<Float, Spectrum> *emitter,
                          const mitsuba::Shape<Float, Spectrum> *shape, const Emission &e,
                          ShownImages<Float, Spectrum> &images) {
        ToWorld to_world(shape);
        LightRow row = make_quadric<SphereLight>(emitter, shape, e, to_world, images);
        float radius = to_world.column_length(0);
        for (int i = 0; i < 3; ++i)
            row.geometry[i] = to_world.m[i][3];
        row.geometry[3] = radius;
        row.geometry[4] = shape->has_flipped_normals() ? -1.f : 1.f;

        LightBounds bounds = point_bounds(row.geometry);
        grow(bounds, radius);
        bounds.variance = radius * radius / 3;
        return { row, bounds };
    }

    /// A point of the unit sphere, uniform by area
    static std::array<double, 3> unit_point(double a, double b) {
        double angle = 2 * kPi * b, height = 1 - 2 * a,
               radius = std::sqrt(1 - height * height);
        return { radius * std::cos(angle), radius * std::sin(angle), height };
    }

    /// Rings of the image, weighted with their area: v is the angle from the pole, over pi
    template <typename Image> static float mean_of_image(const Image &image) {
        constexpr int rings = 32;
        double sum          = 0;
        for (int i = 0; i < rings; ++i) {
            double low = i / (double) rings, high = (i + 1) / (double) rings;
            sum += .5 * (std::cos(kPi * low) - std::cos(kPi * high)) *
                   image.mean(0, low, 1, high);
        }
        return (float) sum;
    }

    static double power(const LightRow &row) {
        const float *g    = row.geometry;
        double brightness = row.brightness;
        return 4 * kPi * g[3] * g[3] * kPi * brightness;
    }

    static float diameter(const LightRow &row) { return 2 * row.geometry[3]; }

    template <typename Float>
    static Appearance<Float> appearance(const Row<Float> &row,
                                        const typename Row<Float>::Point3f &x, float) {
        return { row.vector(0) - x, dr::square(row[3]),
                 dr::Pi<Float> * dr::square(row[3]) };
    }

    template <typename Float>
    static LightPoint<Float> sample(const Row<Float> &row,
                                    const typename Row<Float>::Point3f &x,
                                    const typename Row<Float>::Point2f &u) {
        using Vector3f     = mitsuba::Vector<Float, 3>;
        using Point3f      = mitsuba::Point<Float, 3>;
        using Frame3f      = mitsuba::Frame<Float>;
        Vector3f to_center = row.vector(0) - x;
        Float radius       = row[3];
        SphereCone<Float> cone(to_center, radius);

        // Angle at the centre of the point where a direction of the cone enters; where it
        // leaves, on the far side, if the sphere emits inwards
        Float cos_theta   = 1.f - u.x() * cone.one_minus_cos,
              sin2        = u.x() * cone.one_minus_cos * (1.f + cos_theta);
        Float inv_sin_max = dr::rsqrt(cone.sin2);
        Float cos_alpha =
            dr::fmadd(row[4], cos_theta * dr::safe_sqrt(1.f - sin2 / cone.sin2),
                      sin2 * inv_sin_max);
        Float sin_alpha     = dr::safe_sqrt(1.f - dr::square(cos_alpha));
        auto [sin_p, cos_p] = dr::sincos(dr::TwoPi<Float> * u.y());
        Vector3f d =
            Frame3f(-dr::normalize(to_center))
                .to_world(Vector3f(cos_p * sin_alpha, sin_p * sin_alpha, cos_alpha));
        // From within, uniformly by area
        if (dr::any_or<true>(!cone.outside))
            dr::masked(d, !cone.outside) = mitsuba::warp::square_to_uniform_sphere(u);

        Vector3f n = d * row[4];
        Point3f p  = row.vector(0) + radius * d;
        return surface_point<Float>(p, direction_pdf<Float>(cone, radius, p - x, n));
    }

    template <typename Float>
    static mitsuba::Vector<Float, 3> normal(const Row<Float> &row,
                                            const typename Row<Float>::Point3f &p) {
        using Vector3f = mitsuba::Vector<Float, 3>;
        return dr::normalize(Vector3f(p - row.vector(0))) * row[4];
    }

    /// Are points that shine inwards behind its outside, seen from x?
    template <typename Float>
    static dr::mask_t<Float> hides(const Row<Float> &row,
                                   const typename Row<Float>::Point3f &x) {
        return row[4] < 0.f && SphereCone<Float>(row.vector(0) - x, row[3]).outside;
    }

    template <typename Float>
    static Float pdf(const Row<Float> &row, const typename Row<Float>::Point3f &x,
                     const typename Row<Float>::Point3f &p,
                     const typename Row<Float>::Vector3f &n) {
        SphereCone<Float> cone(row.vector(0) - x, row[3]);
        return direction_pdf<Float>(cone, row[3], p - x, n);
    }

private:
    /// Density of `w`, which leads to a point of normal `n` on the sphere
    template <typename Float>
    static Float direction_pdf(const SphereCone<Float> &cone, const Float &radius,
                               const mitsuba::Vector<Float, 3> &w,
                               const mitsuba::Vector<Float, 3> &n) {
        Float area    = 4.f * dr::Pi<Float> * dr::square(radius);
        Float by_area = area_to_solid_angle(area, w, n);
        return dr::select(cone.outside && dr::dot(w, n) < 0.f, cone.pdf(),
                          dr::select(cone.outside, 0.f, by_area));
    }
};

} // namespace manylights
