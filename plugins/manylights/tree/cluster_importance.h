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

/**
 * Emission in the direction -w / |w|, where inv_norm is 1 / e, relative to its mean.
 *
 * Broad: the first harmonics, the last one with 3/4 in place of the 5/8 of a cosine, so that less
 * is left where all lights of a cluster are seen edge-on.
 *
 * Beams: a von Mises-Fisher lobe about the axis whose concentration k follows from the axis'
 * length r (Banerjee et al. 2005) and from the angle that the cluster fills:
 *
 *     1 / k = (1 - r^2) / (r (3 - r^2)) + variance / e^2
 *     2 k / (1 - exp(-2 k)) exp(k (o / r - 1))
 */
template <typename Float>
Four<Float> emission(const Clusters<Float> &c, const Four<Float> &wx,
                     const Four<Float> &wy, const Four<Float> &wz,
                     const Four<Float> &inv_norm, Directions directions) {
    using F4 = Four<Float>;
    F4 o = -dr::fmadd(wx, c.axis[0], dr::fmadd(wy, c.axis[1], wz * c.axis[2])) * inv_norm;
    F4 r2 = dr::fmadd(c.axis[0], c.axis[0],
                      dr::fmadd(c.axis[1], c.axis[1], c.axis[2] * c.axis[2]));
    if (directions == Directions::Broad)
        return max_of(1.f + 2.f * o + .75f * (3.f * o * o - r2), kEmissionFloor);
    F4 inv_r = dr::rsqrt(r2 + 1e-8f),
       spread =
           (1.f - r2) * inv_r * dr::rcp(3.f - r2) + c.variance * dr::square(inv_norm),
       k    = dr::rcp(max_of(spread, kNarrowestBeam));
    F4 peak = 2.f * k * dr::rcp(1.f - dr::exp(-2.f * k));
    return max_of(peak * dr::exp(k * (o * inv_r - 1.f)), kEmissionFloor);
}

/**
 * h of four clusters for a segment: flux * angle / D, which is the integral of
 * flux / distance^2, times emission and attenuation at the nearest point.
 */
template <typename Float>
Four<Float> segment_importance(const Receiver<Float> &at, const Clusters<Float> &c,
                               Directions directions) {
    using F4 = Four<Float>;
    F4 wx = c.mean[0] - at.p.x(), wy = c.mean[1] - at.p.y(), wz = c.mean[2] - at.p.z();
    F4 along =
        -dr::fmadd(wx, F4(at.wi.x()), dr::fmadd(wy, F4(at.wi.y()), wz * at.wi.z()));
    F4 norm2     = dr::fmadd(wx, wx, dr::fmadd(wy, wy, wz * wz));
    Float length = at.nearby();
    SegmentView<F4, Float> view(along, norm2, c.variance, length);
    F4 t = view.closest(), off = along - t;
    F4 e          = dr::sqrt(dr::fmadd(off, off, dr::square(view.distance)));
    F4 importance = c.flux * view.angle() / view.distance * attenuation(at, F4(t + e));
    if (directions != Directions::All)
        importance *= emission(
            c, F4(dr::fmadd(t, F4(at.wi.x()), wx)), F4(dr::fmadd(t, F4(at.wi.y()), wy)),
            F4(dr::fmadd(t, F4(at.wi.z()), wz)), F4(dr::rcp(e)), directions);
    return importance;
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
