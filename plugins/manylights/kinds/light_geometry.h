#pragma once

/**
 * What all kinds of light have in common where kernels look at them: a light as a shading
 * point sees it, and a point on it with its density.
 *
 * Densities use geometric normals, on both sides; Mitsuba mixes them with shading normals
 * (its issue #1952).
 */

#include "row.h"

namespace manylights {

/// Where a light is, how far it extends and how bright it shines towards x
template <typename Float> struct Appearance {
    using Vector3f = mitsuba::Vector<Float, 3>;
    /// From x to the light's centre, variance of its position
    Vector3f w;
    Float variance;
    /// Intensity towards x; 0 only if nothing of the light can reach x
    Float intensity;

    DRJIT_STRUCT(Appearance, w, variance, intensity)
};

/// All directions in which a light shines: those whose cosine with the axis is no less. Narrow ones
/// are known by their sine.
template <typename Float> struct Beam {
    using Vector3f = mitsuba::Vector<Float, 3>;
    Vector3f axis  = 0.f;
    Float cosine = -1.f, sine = 0.f;

    DRJIT_STRUCT(Beam, axis, cosine, sine)
};

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

/// A point of a surface, chosen with the density `pdf`
template <typename Float>
LightPoint<Float> surface_point(const mitsuba::Point<Float, 3> &p, const Float &pdf) {
    LightPoint<Float> result = dr::zeros<LightPoint<Float>>();
    result.p                 = p;
    result.pdf               = pdf;
    result.weight            = dr::select(pdf > 0.f, dr::rcp(pdf), 0.f);
    return result;
}

// --------------------------------------------------------------------------- Without surface

/// What kinds have in common that may shine in all directions
struct WithoutBeam {
    static constexpr bool has_beam = false;
    template <typename Float> static Beam<Float> beam(const Row<Float> &) { return {}; }
};

/// What kinds have in common of whose surface the table knows nothing
struct WithoutSurface : WithoutBeam {
    static float diameter(const LightRow &) { return 0; }

    template <typename Float>
    static mitsuba::Vector<Float, 3> normal(const Row<Float> &,
                                            const typename Row<Float>::Point3f &) {
        return 0.f;
    }

    template <typename Float>
    static Float pdf(const Row<Float> &, const typename Row<Float>::Point3f &,
                     const typename Row<Float>::Point3f &,
                     const typename Row<Float>::Vector3f &) {
        return 0.f;
    }
};

/// What kinds without extent have in common: no ray hits them
struct DeltaLight : WithoutSurface {
    static constexpr bool is_delta = true;
};

/// The place of a light, whose intensity times `weight` arrives
template <typename Float>
LightPoint<Float> delta_point(const Row<Float> &row, const Float &weight) {
    LightPoint<Float> result = dr::zeros<LightPoint<Float>>();
    result.p                 = row.vector(0);
    result.weight            = dr::select(dr::isfinite(weight), weight, 0.f);
    result.pdf               = dr::select(result.weight > 0.f, Float(1.f), 0.f);
    return result;
}

/// 0 if a light without extent is so near that what arrives is infinite: it is left out and
/// must not push others out of their reservoirs
template <typename Float, typename Vector3f> Float can_shine(const Vector3f &w) {
    return dr::select(dr::isfinite(dr::rcp(dr::squared_norm(w))), Float(1.f), 0.f);
}

// ------------------------------------------------------------------------------------- Flat

/// Unit normal of a triangle or a disk
template <typename Float> mitsuba::Vector<Float, 3> flat_normal(const Row<Float> &row) {
    return dr::normalize(dr::cross(row.vector(3), row.vector(6)));
}

/// The side to which it emits
template <typename Float>
Beam<Float> flat_beam(const Row<Float> &row, const dr::mask_t<Float> &two_sided = false) {
    return { flat_normal(row), dr::select(two_sided, Float(-1.f), Float(0.f)),
             Float(1.f) };
}

/// Density of the direction w to a uniform point of a triangle or a disk, whose area is
/// `unit_area` times that of the parallelogram of its edges or axes
template <typename Float>
Float flat_pdf(const Row<Float> &row, float unit_area,
               const typename Row<Float>::Vector3f &w,
               const dr::mask_t<Float> &two_sided = false) {
    auto normal  = dr::cross(row.vector(3), row.vector(6));
    Float length = dr::norm(normal);
    return area_to_solid_angle<Float>(length * unit_area, w, normal / length, two_sided);
}

/// The point of a triangle or a disk with the coordinates `b` along its edges or axes
template <typename Float>
LightPoint<Float> flat_point(const Row<Float> &row, const typename Row<Float>::Point3f &x,
                             const typename Row<Float>::Point2f &b, float unit_area,
                             const dr::mask_t<Float> &two_sided = false) {
    using Point3f = mitsuba::Point<Float, 3>;
    Point3f p     = row.vector(0) + b.x() * row.vector(3) + b.y() * row.vector(6);
    LightPoint<Float> result =
        surface_point<Float>(p, flat_pdf<Float>(row, unit_area, p - x, two_sided));
    result.uv = b;
    return result;
}

/// Intensity of a flat emitter of area vector `a` (length: area) seen along w
template <typename Float, typename Vector3f>
Float flat_intensity(const Vector3f &a, const Vector3f &w) {
    return max_of(-dr::dot(a, w), 0.f) * dr::rsqrt(dr::squared_norm(w) + 1e-30f);
}

} // namespace manylights
