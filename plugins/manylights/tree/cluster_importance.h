#pragma once

/**
 * h: how much light a cluster may send to a point. It steers the descent of the tree, and
 * must be positive wherever the true contribution is not zero: the only condition for an
 * unbiased image.
 *
 * Departure from the talk, which keeps h purely spatial: h also has the receiver's cosine and
 * the first terms of the emission's spherical harmonics.
 */

#include "manylights/base/recording.h"
#include "manylights/receiver/lobes.h"
#include "manylights/receiver/segment_view.h"

namespace manylights {

/// The part of a wide node that the importance needs, for its four children
template <typename Float> struct Clusters {
    Four<Float> mean[3], variance, flux, axis[3];

    MANYLIGHTS_TRAVERSE(mean, variance, flux, axis)
};

/// Smallest factor by which the direction of emission may lower h
constexpr float kEmissionFloor = .05f;

/// What the lights' directions of emission allow, the same for the whole tree
enum class Directions {
    /// All lights shine in all directions
    All,
    /// The axis `a` is the mean normal: cosine lobes and wide spots
    Broad,
    /// The axis `a` is the mean direction of emission: there are narrow spots
    Beams
};

/// Narrowest beam, as 1 / concentration: what the packed axis can tell
constexpr float kNarrowestBeam = 1e-3f;

/// |a|^2
template <typename Float> Four<Float> squared_axis(const Clusters<Float> &c) {
    return dr::fmadd(c.axis[0], c.axis[0],
                     dr::fmadd(c.axis[1], c.axis[1], c.axis[2] * c.axis[2]));
}

/**
 * The von Mises-Fisher lobe of a cluster with beams. Its concentration k follows from the axis'
 * length r (Banerjee et al. 2005) and from the angle that the cluster fills:
 *
 *     1 / k = (1 - r^2) / (r (3 - r^2)) + variance / e^2
 */
template <typename Float> struct BeamLobe {
    using F4 = Four<Float>;
    F4 inv_r, k, peak;

    /// @param extent  variance / e^2
    BeamLobe(const F4 &r2, const F4 &extent) {
        inv_r     = dr::rsqrt(r2 + 1e-8f);
        F4 spread = (1.f - r2) * inv_r * dr::rcp(3.f - r2) + extent;
        k         = dr::rcp(max_of(spread, kNarrowestBeam));
        peak      = 2.f * k * dr::rcp(1.f - dr::exp(-2.f * k));
    }
};

/**
 * Emission in the direction -w / |w|, where inv_norm is 1 / e, relative to its mean.
 *
 * Broad: the first harmonics, the last one with 3/4 in place of the 5/8 of a cosine, so that less
 * is left where all lights of a cluster are seen edge-on.
 *
 * Beams: the \ref BeamLobe about the axis,
 *
 *     2 k / (1 - exp(-2 k)) exp(k (o / r - 1))
 */
template <typename Float>
Four<Float> emission(const Clusters<Float> &c, const Four<Float> &wx,
                     const Four<Float> &wy, const Four<Float> &wz,
                     const Four<Float> &inv_norm, Directions directions) {
    using F4 = Four<Float>;
    F4 o = -dr::fmadd(wx, c.axis[0], dr::fmadd(wy, c.axis[1], wz * c.axis[2])) * inv_norm;
    F4 r2 = squared_axis(c);
    if (directions == Directions::Broad)
        return max_of(1.f + 2.f * o + .75f * (3.f * o * o - r2), kEmissionFloor);
    BeamLobe<Float> lobe(r2, c.variance * dr::square(inv_norm));
    return max_of(lobe.peak * dr::exp(lobe.k * (o * lobe.inv_r - 1.f)), kEmissionFloor);
}

/**
 * Emission towards a segment, integrated over the angle phi that it fills as seen from the light,
 * which is 0 at the nearest point of the line: `along` and `across` are the mean axis in the
 * segment's direction and in that of the nearest point. A beam may cross it far from there.
 *
 * With o = across cos(phi) + along sin(phi) = m cos(phi - psi) the harmonics have an integral, and
 * so has the lobe with 1 - (phi - psi)^2 / 2 in place of the cosine.
 */
template <typename Float>
Four<Float> segment_emission(const Clusters<Float> &c,
                             const SegmentView<Four<Float>, Float> &view,
                             const Four<Float> &along, const Four<Float> &across,
                             const Four<Float> &extent, Directions directions) {
    using F4 = Four<Float>;
    F4 angle = view.angle(), a2 = dr::square(across), b2 = dr::square(along),
       r2 = squared_axis(c);
    if (directions == Directions::Broad) {
        auto [sin_a, cos_a] = view.direction(F4(0.f));
        auto [sin_b, cos_b] = view.direction(F4(view.length));
        F4 o                = across * (sin_b - sin_a) + along * (cos_a - cos_b),
           o2 = .5f * ((a2 + b2) * angle + (a2 - b2) * (sin_b * cos_b - sin_a * cos_a)) +
                across * along * (sin_b * sin_b - sin_a * sin_a);
        return max_of((1.f - .75f * r2) * angle + 2.f * o + 2.25f * o2,
                      kEmissionFloor * angle);
    }
    F4 first = dr::atan2(-view.nearest, view.distance) - dr::atan2(along, across);
    // The turn whose middle is nearest to the axis
    first -= dr::TwoPi<Float> * dr::round((first + .5f * angle) * dr::InvTwoPi<Float>);
    BeamLobe<Float> lobe(r2, extent);
    F4 o = dr::sqrt(a2 + b2) * lobe.inv_r, s = dr::sqrt(.5f * max_of(lobe.k * o, 1e-3f)),
       mean = .5f * dr::sqrt(dr::Pi<Float>) / s;
    return max_of(lobe.peak * dr::exp(lobe.k * (o - 1.f)) * mean *
                      (dr::erf(s * (first + angle)) - dr::erf(s * first)),
                  kEmissionFloor * angle);
}

/**
 * h of four clusters for a segment: flux / D times the angle that it fills, which is the integral
 * of flux / distance^2, or times the emission over that angle; times the attenuation at its
 * nearest point.
 */
template <typename Float>
Four<Float> segment_importance(const Receiver<Float> &at, const Clusters<Float> &c,
                               Directions directions) {
    using F4 = Four<Float>;
    auto dot = [](const auto &x, const auto &y) {
        return dr::fmadd(x[0], y[0], dr::fmadd(x[1], y[1], x[2] * y[2]));
    };
    F4 w[3]  = { c.mean[0] - at.p.x(), c.mean[1] - at.p.y(), c.mean[2] - at.p.z() },
       d[3]  = { -at.wi.x(), -at.wi.y(), -at.wi.z() };
    F4 start = dot(w, d), from[3];
    for (size_t i = 0; i < 3; ++i)
        from[i] = dr::fmsub(start, d[i], w[i]);
    SegmentView<F4, Float> view(start, dot(from, from), c.variance, at.nearby());
    F4 t = view.closest(), off = start - t,
       e2    = dr::fmadd(off, off, dr::square(view.distance)),
       inv_d = dr::rcp(view.distance), seen;
    if (directions == Directions::All) {
        seen = view.angle();
    } else {
        F4 along = dot(c.axis, d), across = dot(c.axis, from) * inv_d;
        seen = segment_emission(c, view, along, across, F4(c.variance * dr::rcp(e2)),
                                directions);
    }
    return c.flux * inv_d * seen * attenuation(at, F4(t + dr::sqrt(e2)));
}

/**
 * h of four clusters at once:
 *
 *     w = mean - x,  e^2 = |w|^2 + variance
 *     h = flux / e^2 * c / e * max(1 + 2 o + 3/4 (3 o^2 - |a|^2), floor)
 *     c = n.w + sqrt((n.w)^2 + variance)      2 max(n.w, 0), smoothed
 *     o = -a.w / e                            a: mean emission axis
 *
 * The variance rounds the cosine: a cluster that straddles the horizon keeps what is
 * above it. Siblings are compared, so that constant factors do not matter. The last factor
 * is that of \ref emission. In scenes with glossy surfaces the receiver's \ref lobe takes the
 * place of c / e. In a medium there is no cosine, and h has the \ref attenuation. For segments
 * see \ref segment_importance.
 */
template <typename Float>
Four<Float> cluster_importance(const Receiver<Float> &at, const Clusters<Float> &c,
                               Directions directions) {
    using F4 = Four<Float>;
    if (at.extent == Extent::Segment)
        return segment_importance(at, c, directions);
    F4 wx = c.mean[0] - at.p.x(), wy = c.mean[1] - at.p.y(), wz = c.mean[2] - at.p.z();
    F4 e2 = dr::fmadd(wx, wx, dr::fmadd(wy, wy, dr::fmadd(wz, wz, c.variance)));
    F4 ie = dr::rsqrt(e2), ie2 = ie * ie;

    auto dot = [&](const auto &d) {
        return dr::fmadd(wx, F4(d.x()), dr::fmadd(wy, F4(d.y()), wz * d.z()));
    };
    F4 t = dot(at.n);
    F4 projected =
        twice_positive(F4(dr::select(at.transmits, dr::abs(t), t)), c.variance) * ie;
    if (at.media)
        projected = dr::select(at.in_medium, F4(1.f), projected);
    if (at.lobes != Lobes::None) {
        LobeView<F4> view{ t * ie, dot(at.wi) * ie, F4(0.f), c.variance * ie2 };
        if (at.lobes == Lobes::Transmitted)
            view.dot_through = dot(at.through) * ie;
        projected = lobe(at, view, F4(.5f * projected));
    }
    F4 importance = c.flux * ie2 * projected;
    if (at.media)
        importance *= attenuation(at, F4(e2 * ie));
    if (directions != Directions::All)
        importance *= emission(c, wx, wy, wz, ie, directions);
    if (at.extent == Extent::Either)
        importance = dr::select(at.length > 0.f, segment_importance(at, c, directions),
                                importance);
    return importance;
}

} // namespace manylights
