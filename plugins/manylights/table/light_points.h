#pragma once

/**
 * A point on a light, the density with which it was chosen, and the light's emission,
 * from the flat table and without virtual calls.
 *
 * Triangles, disks and cylinders are sampled uniformly by area, spheres by the cone that
 * they fill (the whole sphere from inside). \ref area_to_solid_angle and \ref sphere_pdf
 * are used by sampling and by the density of a hit alike. Densities use geometric normals,
 * on both sides; Mitsuba mixes them with shading normals (its issue #1952).
 */

#include "row.h"
#include <mitsuba/core/frame.h>
#include <mitsuba/core/warp.h>

namespace manylights {

/// A point on a light as seen from a reference point
template <typename Float> struct LightPoint {
    using Vector3f = mitsuba::Vector<Float, 3>;
    using Point2f  = mitsuba::Point<Float, 2>;
    using Point3f  = mitsuba::Point<Float, 3>;

    Point3f p;
    /// Density in solid angle; 1 for points and spots; 0 if nothing can arrive
    Float pdf;
    /// The radiance or intensity times this, over the density, is what arrives
    Float weight;
    /// Barycentric coordinates (triangles only)
    Point2f uv;

    DRJIT_STRUCT(LightPoint, p, pdf, weight, uv)
};

/// Density in solid angle of a uniform density on `area`, 0 behind a one-sided emitter
template <typename Float>
Float area_to_solid_angle(const Float &area, const mitsuba::Vector<Float, 3> &w,
                          const mitsuba::Vector<Float, 3> &n,
                          const dr::mask_t<Float> &two_sided = false) {
    Float d2 = dr::squared_norm(w), cosine = -dr::dot(w, n) * dr::rsqrt(d2);
    cosine    = dr::select(two_sided, dr::abs(cosine), cosine);
    Float pdf = d2 / (area * cosine);
    return dr::select(cosine > 0.f && dr::isfinite(pdf), pdf, 0.f);
}

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

/// Density of `w`, which leads to a point of normal `n` on the sphere
template <typename Float>
Float sphere_pdf(const SphereCone<Float> &cone, const Float &radius,
                 const mitsuba::Vector<Float, 3> &w, const mitsuba::Vector<Float, 3> &n) {
    Float area    = 4.f * dr::Pi<Float> * dr::square(radius);
    Float by_area = area_to_solid_angle(area, w, n);
    return dr::select(cone.outside && dr::dot(w, n) < 0.f, cone.pdf(),
                      dr::select(cone.outside, 0.f, by_area));
}

template <typename Float>
LightPoint<Float> sample_sphere(const Row<Float> &row, const mitsuba::Point<Float, 3> &x,
                                const mitsuba::Point<Float, 2> &u) {
    using Vector3f     = mitsuba::Vector<Float, 3>;
    using Frame3f      = mitsuba::Frame<Float>;
    Vector3f to_center = row.vector(0) - x;
    Float radius       = row[3];
    SphereCone<Float> cone(to_center, radius);

    // Angle at the centre of the point where a direction of the cone enters; where it leaves,
    // on the far side, if the sphere emits inwards
    Float cos_theta   = 1.f - u.x() * cone.one_minus_cos,
          sin2        = u.x() * cone.one_minus_cos * (1.f + cos_theta);
    Float inv_sin_max = dr::rsqrt(cone.sin2);
    Float cos_alpha = dr::fmadd(row[4], cos_theta * dr::safe_sqrt(1.f - sin2 / cone.sin2),
                                sin2 * inv_sin_max);
    Float sin_alpha = dr::safe_sqrt(1.f - dr::square(cos_alpha));
    auto [sin_p, cos_p] = dr::sincos(dr::TwoPi<Float> * u.y());
    Vector3f d = Frame3f(-dr::normalize(to_center))
                     .to_world(Vector3f(cos_p * sin_alpha, sin_p * sin_alpha, cos_alpha));
    if (dr::any_or<true>(!cone.outside))
        dr::masked(d, !cone.outside) = mitsuba::warp::square_to_uniform_sphere(u);

    LightPoint<Float> result = dr::zeros<LightPoint<Float>>();
    Vector3f n               = d * row[4];
    result.p                 = row.vector(0) + radius * d;
    result.pdf               = sphere_pdf<Float>(cone, radius, result.p - x, n);
    return result;
}

/// Density of the direction w to a uniform point of a triangle or a disk
template <typename Float>
Float flat_pdf(const Row<Float> &row, LightKind kind,
               const mitsuba::Vector<Float, 3> &w) {
    auto normal   = dr::cross(row.vector(3), row.vector(6));
    Float length  = dr::norm(normal);
    bool triangle = kind == LightKind::Triangle;
    return area_to_solid_angle<Float>(length * (triangle ? .5f : dr::Pi<float>), w,
                                      normal / length, triangle && row.two_sided());
}

template <typename Float>
LightPoint<Float> sample_flat(const Row<Float> &row, LightKind kind,
                              const mitsuba::Point<Float, 3> &x,
                              const mitsuba::Point<Float, 2> &u) {
    namespace warp = mitsuba::warp;
    auto b = kind == LightKind::Triangle ? warp::square_to_uniform_triangle(u)
                                         : warp::square_to_uniform_disk_concentric(u);
    LightPoint<Float> result = dr::zeros<LightPoint<Float>>();
    result.p   = row.vector(0) + b.x() * row.vector(3) + b.y() * row.vector(6);
    result.uv  = b;
    result.pdf = flat_pdf<Float>(row, kind, result.p - x);
    return result;
}

template <typename Float>
LightPoint<Float> sample_cylinder(const Row<Float> &row,
                                  const mitsuba::Point<Float, 3> &x,
                                  const mitsuba::Point<Float, 2> &u) {
    using Vector3f = mitsuba::Vector<Float, 3>;
    Vector3f axis  = row.vector(3);
    Float length = dr::norm(axis), radius = row[6];
    auto [sin_p, cos_p] = dr::sincos(dr::TwoPi<Float> * u.y());
    Vector3f radial =
        mitsuba::Frame<Float>(axis / length).to_world(Vector3f(cos_p, sin_p, 0.f));

    LightPoint<Float> result = dr::zeros<LightPoint<Float>>();
    result.p                 = row.vector(0) + u.x() * axis + radius * radial;
    result.pdf = area_to_solid_angle<Float>(dr::TwoPi<Float> * radius * length,
                                            result.p - x, radial * row[7]);
    return result;
}

/// Choose a point on a light of the table (any kind but `Other`)
template <typename Float>
LightPoint<Float> sample_light(const Row<Float> &row, LightKind kind,
                               const mitsuba::Point<Float, 3> &x,
                               const mitsuba::Point<Float, 2> &u) {
    LightPoint<Float> result = dr::zeros<LightPoint<Float>>();
    switch (kind) {
        case LightKind::Point:
        case LightKind::Spot: {
            auto w        = row.vector(0) - x;
            Float inv_d2  = dr::rcp(dr::squared_norm(w));
            result.p      = row.vector(0);
            result.weight = inv_d2;
            if (kind == LightKind::Spot)
                result.weight *=
                    spot_falloff(row, -dr::dot(row.vector(3), w) * dr::sqrt(inv_d2));
            result.weight = dr::select(dr::isfinite(result.weight), result.weight, 0.f);
            result.pdf    = dr::select(result.weight > 0.f, Float(1.f), 0.f);
            return result;
        }
        case LightKind::Triangle:
        case LightKind::Disk:
            result = sample_flat(row, kind, x, u);
            break;
        case LightKind::Sphere:
            result = sample_sphere(row, x, u);
            break;
        case LightKind::Cylinder:
            result = sample_cylinder(row, x, u);
            break;
        case LightKind::Other:
            return result;
    }
    result.weight = dr::select(result.pdf > 0.f, dr::rcp(result.pdf), 0.f);
    return result;
}

/// Unit normal of a light at its point `p`, on the side that emits (any kind but `Other`)
template <typename Float>
mitsuba::Vector<Float, 3> light_normal(const Row<Float> &row, LightKind kind,
                                       const mitsuba::Point<Float, 3> &p) {
    using Vector3f = mitsuba::Vector<Float, 3>;
    switch (kind) {
        case LightKind::Triangle:
        case LightKind::Disk:
            return dr::normalize(dr::cross(row.vector(3), row.vector(6)));
        case LightKind::Sphere:
            return dr::normalize(Vector3f(p - row.vector(0))) * row[4];
        case LightKind::Cylinder: {
            Vector3f axis = row.vector(3), w(p - row.vector(0));
            return dr::normalize(w - axis * (dr::dot(w, axis) / dr::squared_norm(axis))) *
                   row[7];
        }
        case LightKind::Point:
        case LightKind::Spot:
        case LightKind::Other:
            break;
    }
    return Vector3f(0.f);
}

/// Density with which \ref sample_light would choose the point `p` of geometric normal `n`
template <typename Float>
Float light_pdf(const Row<Float> &row, LightKind kind, const mitsuba::Point<Float, 3> &x,
                const mitsuba::Point<Float, 3> &p, const mitsuba::Vector<Float, 3> &n) {
    using Vector3f = mitsuba::Vector<Float, 3>;
    Vector3f w     = p - x;
    switch (kind) {
        case LightKind::Triangle:
        case LightKind::Disk:
            return flat_pdf<Float>(row, kind, w);
        case LightKind::Sphere: {
            SphereCone<Float> cone(row.vector(0) - x, row[3]);
            return sphere_pdf<Float>(cone, row[3], w, n);
        }
        case LightKind::Cylinder:
            return area_to_solid_angle<Float>(
                dr::TwoPi<Float> * row[6] * dr::norm(row.vector(3)), w, n);
        case LightKind::Point:
        case LightKind::Spot:
        case LightKind::Other:
            break;
    }
    return Float(0.f);
}

} // namespace manylights
