#pragma once

/**
 * H: how much light a single light may send to a point. It steers the first resampling, and
 * must be positive wherever the true contribution is not zero: the only condition for an
 * unbiased image.
 */

#include "lobes.h"
#include "manylights/table/row.h"
#include "segment_view.h"

namespace manylights {

/// Smallest cosine at the receiver that H assumes
constexpr float kCosineFloor = 1e-5f;

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

/// Intensity of a flat emitter of area vector `a` (length: area) seen along w
template <typename Float, typename Vector3f>
Float flat_intensity(const Vector3f &a, const Vector3f &w) {
    return dr::maximum(-dr::dot(a, w), 0.f) * dr::rsqrt(dr::squared_norm(w) + 1e-30f);
}

/// 0 if a light without extent is so near that what arrives is infinite: it is left out
/// (light_points.h) and must not push others out of their reservoirs
template <typename Float, typename Vector3f> Float can_shine(const Vector3f &w) {
    return dr::select(dr::isfinite(dr::rcp(dr::squared_norm(w))), Float(1.f), 0.f);
}

template <typename Float>
Appearance<Float> appearance(const Receiver<Float> &at, const Row<Float> &row,
                             LightKind kind) {
    using Vector3f  = mitsuba::Vector<Float, 3>;
    Vector3f origin = row.vector(0) - at.p;
    // What one point of a segment does not see may shine on another one
    float least = at.extent == Extent::Segment ? .05f : 0.f;
    switch (kind) {
        case LightKind::Point:
            return { origin, Float(0.f), can_shine<Float>(origin) };
        case LightKind::Spot: {
            Float cos_theta =
                -dr::dot(row.vector(3), origin) * dr::rsqrt(dr::squared_norm(origin));
            return { origin, Float(0.f),
                     dr::maximum(spot_falloff(row, cos_theta), least) *
                         can_shine<Float>(origin) };
        }
        case LightKind::Triangle: {
            Vector3f e1 = row.vector(3), e2 = row.vector(6), a = .5f * dr::cross(e1, e2),
                     w  = origin + (e1 + e2) * (1.f / 3.f);
            Float front = flat_intensity<Float>(a, w),
                  back  = flat_intensity<Float>(-a, w);
            // Edge-on to a smooth triangle some normals may still face x: leave a floor
            Float both = dr::maximum(front + back, .05f * dr::norm(a));
            front      = dr::maximum(front, least * dr::norm(a));
            return { w, .16f * dr::norm(a), dr::select(row.two_sided(), both, front) };
        }
        case LightKind::Disk: {
            Vector3f a = dr::Pi<Float> * dr::cross(row.vector(3), row.vector(6));
            return { origin, .16f * dr::norm(a),
                     dr::maximum(flat_intensity<Float>(a, origin), least * dr::norm(a)) };
        }
        case LightKind::Sphere:
            return { origin, dr::square(row[3]), dr::Pi<Float> * dr::square(row[3]) };
        case LightKind::Cylinder: {
            Vector3f axis = row.vector(3), w = origin + .5f * axis;
            Float length2 = dr::squared_norm(axis), radius2 = dr::square(row[6]);
            // Silhouette: between the end's disk and the side's rectangle
            return { w, length2 * (1.f / 12.f) + .5f * radius2,
                     2.f * dr::sqrt(radius2 * length2) + dr::Pi<Float> * radius2 };
        }
        case LightKind::Other:
            break;
    }
    return { origin, row[3], Float(1.f) };
}

/**
 * H of one light: intensity towards x times the receiver's smooth cosine over distance^2,
 * with the light's own extent instead of a cluster's.
 *
 * For a flat emitter of area A the distance^2 is d^2 + .08 A, half of its variance; a point
 * on the surface then has no pole. It is zero only behind a one-sided flat emitter and
 * outside of a spot's cone. `scale` brings it into the units of targets.
 */
template <typename Float>
Float light_importance(const Receiver<Float> &at, const Row<Float> &row, KindSet kinds,
                       const Float &scale) {
    auto look = [&](const Receiver<Float> &from) {
        return by_kind<Appearance<Float>>(
            row, kinds, [&](LightKind kind) { return appearance(from, row, kind); });
    };
    Appearance<Float> a = look(at);
    if (at.extent == Extent::Segment) {
        Float along             = -dr::dot(at.wi, a.w);
        Receiver<Float> nearest = at;
        nearest.p -= dr::clip(along, 0.f, at.nearby()) * at.wi;
        a = look(nearest);
    }
    Float d2 = dr::squared_norm(a.w) + .5f * a.variance + 1e-30f, inv_d = dr::rsqrt(d2);
    Float t = dr::dot(at.n, a.w);
    Float twice =
        twice_positive(Float(dr::select(at.transmits, dr::abs(t), t)), a.variance);
    Float reflected = dr::maximum(.5f * twice * inv_d, kCosineFloor);
    if (at.media)
        reflected = dr::select(at.in_medium, 1.f, reflected);
    if (at.lobes != Lobes::None) {
        LobeView<Float> view{ t * inv_d, dr::dot(at.wi, a.w) * inv_d, Float(0.f),
                              a.variance * inv_d * inv_d };
        if (at.lobes == Lobes::Transmitted)
            view.dot_through = dr::dot(at.through, a.w) * inv_d;
        reflected = lobe(at, view, reflected);
    }
    if (at.media)
        reflected *= attenuation(at, Float(d2 * inv_d));
    return row[kBrightness] * scale * a.intensity * reflected * inv_d * inv_d;
}

} // namespace manylights
