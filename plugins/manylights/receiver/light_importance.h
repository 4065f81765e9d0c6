#pragma once

/**
 * H: how much light a single light may send to a point. It steers the first resampling, and
 * must be positive wherever the true contribution is not zero: the only condition for an
 * unbiased image.
 */

#include "lobes.h"
#include "manylights/kinds/kinds.h"
#include "segment_distances.h"

namespace manylights {

/// Smallest cosine at the receiver that H assumes
constexpr float kCosineFloor = 1e-5f;

/// A light of the table as a receiver sees it
template <typename Float>
Appearance<Float> appearance(const Receiver<Float> &at, const Row<Float> &row,
                             KindSet kinds) {
    // What one point of a segment does not see may shine on another one
    float least = at.extent == Extent::Segment ? .05f : 0.f;
    return appearance<Float>(row, kinds, at.p, least);
}

/// Distances along a segment for a light of the table
template <typename Float>
SegmentDistances<Float> distances_to(const Receiver<Float> &at, const Row<Float> &row,
                                     KindSet kinds) {
    Appearance<Float> light = appearance(at, row, kinds);
    if (!have_beams(kinds))
        return { at, light.w, light.variance, nullptr };
    Beam<Float> shines = beam(row, kinds);
    return { at, light.w, light.variance, &shines };
}

/// H for a segment: intensity and attenuation in the middle of the angles in which it is lit,
/// times the integral of 1 / distance^2 over these
template <typename Float>
Float segment_importance(const Receiver<Float> &at, const Row<Float> &row, KindSet kinds,
                         const Float &scale) {
    auto along            = distances_to(at, row, kinds);
    Float t               = along.middle();
    Receiver<Float> moved = at;
    moved.p -= t * at.wi;
    Appearance<Float> a = appearance(moved, row, kinds);
    return row[kBrightness] * scale * a.intensity * along.integral() *
           attenuation(at, Float(t + dr::norm(a.w)));
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
    if (at.extent == Extent::Segment)
        return segment_importance(at, row, kinds, scale);
    Appearance<Float> a = appearance(at, row, kinds);
    Float d2 = dr::squared_norm(a.w) + .5f * a.variance + 1e-30f, inv_d = dr::rsqrt(d2);
    Float t = dr::dot(at.n, a.w);
    Float twice =
        twice_positive(Float(dr::select(at.transmits, dr::abs(t), t)), a.variance);
    Float reflected = max_of(.5f * twice * inv_d, kCosineFloor);
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
