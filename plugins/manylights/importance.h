#pragma once

/**
 * How much light a cluster (h) or a single light (H) may send to a point.
 *
 * h steers the descent of the tree; H steers the first resampling. Neither has to be
 * right, but both must be positive wherever the true contribution is not zero: this is
 * the only condition for an unbiased image.
 *
 * Departure from the talk, which keeps h purely spatial: h also has the receiver's
 * cosine and the first terms of the emission's spherical harmonics. At one descent a
 * prototype measured a relative variance of 2.7 against 47 for flux / distance^2 (1,000
 * lights, diffuse), for less than twice the time per node.
 */

#include "light.h"
#include "loop.h"
#include <mitsuba/core/vector.h>

namespace manylights {

/// What a receiver is: known when kernels are recorded, except where paths look back
enum class Extent { Point, Segment, Either };

/// Wavelengths of a sample in spectral variants, colour channels in others
constexpr uint32_t kMostChannels = 4;

/// The lobes that BSDFs of a scene have
enum class Lobes { None, Reflected, Transmitted /* as well */ };

/// What of a receiver is in use, the same for all of a rendering. What is not costs nothing.
struct ReceiverTraits {
    Lobes lobes   = Lobes::None;
    bool media    = false;
    Extent extent = Extent::Point;
    /// Entries of \ref Receiver::extinctions, 0 if the extinction does not vary
    uint32_t channels = 0;
};

/// What a shading point shows to the tree
template <typename Float> struct Receiver : ReceiverTraits {
    using Vector3f = mitsuba::Vector<Float, 3>;
    using Point3f  = mitsuba::Point<Float, 3>;
    using Mask     = dr::mask_t<Float>;

    Point3f p;
    /// Unit normal on the side from which the point is seen, and the direction back
    Vector3f n, wi;
    /// Can light arrive from behind as well?
    Mask transmits;
    /// BSDF off the lobe; BSDF times cosine at its peak, times alpha^2; and alpha^2 (GGX)
    Float diffuse, specular, alpha2;
    /// Direction from where most light comes through a rough surface; BSDF times cosine there,
    /// times beta^2; and beta^2, where pi beta^2 is the lobe's solid angle
    Vector3f through;
    Float transmitted, beta2;
    /// Is this a point in a medium, without a cosine? Its extinction, where that is constant
    Mask in_medium;
    Float extinction;
    /// The same of each wavelength or channel; `extinction` is then the smallest
    dr::Array<Float, kMostChannels> extinctions;
    /// A segment from p along -wi of this length (0: a point), and where a path went on
    Float length, distance;
    /// Where visibility is learnt (visibility.h)
    dr::uint32_array_t<Float> cell;
    /// Sum of h, and of all weights, at the top of the tree (\ref TopWeights)
    Float top_importance, top_total;

    DRJIT_STRUCT(Receiver, p, n, wi, transmits, diffuse, specular, alpha2, through,
                 transmitted, beta2, in_medium, extinction, extinctions, length, distance,
                 cell, top_importance, top_total)

    const ReceiverTraits &traits() const { return *this; }
    ReceiverTraits &traits() { return *this; }

    /// The part of a segment that may receive much light: some mean free paths
    Float nearby() const { return dr::minimum(length, 6.f / extinction); }
};

/// Smallest transmittance that is assumed: how far the medium extends is not known
constexpr float kTransmittanceFloor = .02f;

/// exp(-extinction * distance), the largest plausible effect of a medium up to a light
template <typename Float, typename Value>
Value attenuation(const Receiver<Float> &at, const Value &distance) {
    return dr::maximum(dr::exp(-distance * at.extinction), kTransmittanceFloor);
}

/// What a BSDF without a lobe is taken to be
constexpr float kTypicalBsdf = .2f;
/// Share of its peak that a lobe has everywhere: for what one lobe does not tell of a BSDF
constexpr float kLobeFloor = .0003f;
/// The same of a lobe of transmission, whose peak can be much higher: times beta^2
constexpr float kThroughFloor = .003f;
/// How a lobe vanishes at grazing angles: sine of the angle up to which masking matters,
/// over alpha
constexpr float kMasking = .5f;

/// Masking of a lobe towards a direction with the cosine c
template <typename Float, typename Value>
Value masking(const Value &c, const Float &alpha2) {
    return dr::minimum(c * ((1.f / kMasking) * dr::rsqrt(alpha2)), 1.f);
}

/// c + sqrt(c^2 + s^2): 2 max(c, 0), smoothed by a variance s^2
template <typename Value> Value twice_positive(const Value &c, const Value &variance) {
    // Below the horizon the root may be less than -c: CUDA's is approximate, and the square of
    // a tiny c is rounded to zero
    return dr::maximum(c + dr::sqrt(dr::fmadd(c, c, variance)), 0.f);
}

/// What an observer of a lobe has to know of a light or a cluster at w, of variance s^2
template <typename Value> struct LobeView {
    /// n.w, wi.w and (with transmission) through.w, over e; s^2 / e^2
    Value cos_o, dot_wi, dot_through, spread2;
};

/**
 * Light that comes through a rough surface, whose lobe falls as GGX with the angle to its peak t:
 *
 *     transmitted b min(2 c / alpha, 1) / (b + |t - w / e|^2)^2,  b = beta^2 + 2 (s / e)^2
 *
 * with the cosine c on the other side. Without it, 1,000 points behind or around rough glass
 * (alpha .03 to .3) had 30 times the variance in the geometric mean (7 to 190).
 */
template <typename Float, typename Value>
Value transmitted_lobe(const Receiver<Float> &at, const LobeView<Value> &view) {
    Value b      = dr::fmadd(view.spread2, 2.f, at.beta2),
          chord2 = dr::maximum(dr::fnmadd(view.dot_through, 2.f, 2.f), 0.f),
          c      = twice_positive(Value(-view.cos_o), view.spread2);
    return at.transmitted * masking(Value(.5f * c), at.alpha2) * b *
           dr::square(dr::rcp(b + chord2));
}

/**
 * The measured BSDF times the cosine c towards the direction w / |w|, which is a cluster's
 * of variance s^2:
 *
 *     diffuse c + specular min(2 c / alpha, 1) a / ((n.h)^2 (a - 1) + 1)^2
 *     a = alpha^2 + 2 (s / e)^2 / |wi + w / e|^2
 *
 * with h the half vector, (n.h)^2 = (n.w / e + n.wi)^2 / |wi + w / e|^2.
 *
 * A microfacet lobe D F G / (4 cos_i cos_o) has no cosine left once it is multiplied with
 * cos_o, and the angle that a cluster fills is magnified in its half vector at grazing angles.
 * With the lobe times c, a = alpha^2 + (s / e)^2 / 2 and a floor of .01, `city` had 1.8
 * (1,000 points) and 1.6 times the variance (1,000 triangles), twelve materials under 1,000
 * points 1.6 times in the geometric mean (.88 to 4.2).
 */
template <typename Float, typename Value>
Value lobe(const Receiver<Float> &at, const LobeView<Value> &view, const Value &c) {
    Float cos_i   = dr::dot(at.n, at.wi);
    Value length2 = dr::fmadd(view.dot_wi, 2.f, 2.001f),
          cos2    = dr::minimum(dr::square(view.cos_o + cos_i), length2);
    // All over |wi + w / e|^2: one division
    Value a = dr::minimum(dr::fmadd(length2, at.alpha2, 2.f * view.spread2), length2);
    Value r = dr::rcp(dr::fmadd(cos2, a - length2, dr::square(length2)));
    Value d = a * length2 * dr::square(length2 * r);
    if (at.lobes == Lobes::Reflected)
        return dr::fmadd(at.specular * masking(c, at.alpha2), d, at.diffuse * c);
    Value front = .5f * twice_positive(view.cos_o, view.spread2);
    return dr::fmadd(at.specular * masking(front, at.alpha2), d,
                     dr::fmadd(at.diffuse, c, transmitted_lobe(at, view)));
}

/// The part of a wide node that the importance needs, for its four children
template <typename Float> struct Clusters {
    Four<Float> mean[3], variance, flux, axis[3];
};

/// A light as seen from a segment that starts at the origin and goes along `d`
template <typename Value, typename Float> struct SegmentView {
    /// Distance of the nearest point of the line from the segment's start; the light's
    /// distance from the line, with its own extent
    Value nearest, distance;
    Float length;

    SegmentView(const Value &along, const Value &norm2, const Value &variance,
                const Float &length)
        : nearest(along), length(length) {
        Value off2 = dr::maximum(dr::fnmadd(along, along, norm2), 0.f);
        distance   = dr::sqrt(dr::fmadd(norm2, 1e-7f, off2 + variance) + 1e-30f);
    }

    /// The angle that the segment fills
    Value angle() const {
        Value beyond = length - nearest;
        return dr::atan2(length * distance,
                         dr::fnmadd(nearest, beyond, distance * distance));
    }

    /// Point of the segment that is nearest to the light
    Value closest() const { return dr::clip(nearest, 0.f, length); }
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
 * is left where all lights of a cluster are seen edge-on: 60 lamps in the plane of the receiver
 * have .008 in place of .016 of relative variance, 1,000 and 10,000 triangles of a city .98 and
 * 1.02 times that of 5/8 (with 1: 1.05 and 1.15 times).
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
        return dr::maximum(1.f + 2.f * o + .75f * (3.f * o * o - r2), kEmissionFloor);
    F4 inv_r = dr::rsqrt(r2 + 1e-8f),
       spread =
           (1.f - r2) * inv_r * dr::rcp(3.f - r2) + c.variance * dr::square(inv_norm),
       k    = dr::rcp(dr::maximum(spread, kNarrowestBeam));
    F4 peak = 2.f * k * dr::rcp(1.f - dr::exp(-2.f * k));
    return dr::maximum(peak * dr::exp(k * (o * inv_r - 1.f)), kEmissionFloor);
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

/// A row of the table
template <typename Float> struct Row {
    using UInt32   = dr::uint32_array_t<Float>;
    using Mask     = dr::mask_t<Float>;
    using Vector3f = mitsuba::Vector<Float, 3>;

    /// Scalar variants read the table in place
    std::conditional_t<dr::is_jit_v<Float>, dr::Array<Float, kRowFloats>, const Float *>
        data;

    Float operator[](size_t i) const { return data[i]; }
    Vector3f vector(size_t i) const { return { data[i], data[i + 1], data[i + 2] }; }
    UInt32 bits(size_t i) const { return dr::reinterpret_array<UInt32>(data[i]); }
    UInt32 kind() const { return bits(kTag) & kTagKindMask; }
    Mask is(LightKind k) const { return kind() == (uint32_t) k; }
    Mask tabulated() const { return (bits(kTag) & kTagTabulated) != 0u; }
    Mask two_sided() const { return (bits(kTag) & kTagTwoSided) != 0u; }
    UInt32 emitter() const { return bits(kTag) >> kTagEmitterShift; }
};

/// The kinds of light that a scene has, as bits: what is absent is not even compiled
struct KindSet {
    uint32_t bits = 0;
    bool has(LightKind kind) const { return (bits >> (uint32_t) kind) & 1; }
    void insert(LightKind kind) { bits |= 1u << (uint32_t) kind; }
    bool only(LightKind kind) const { return bits == 1u << (uint32_t) kind; }
};

/**
 * Evaluate `f(kind)` for the kinds that occur and merge the results by the kind of the
 * row. With one kind in the scene nothing is selected.
 */
template <typename Value, typename Float, typename F>
Value by_kind(const Row<Float> &row, KindSet kinds, const F &f) {
    Value result = dr::zeros<Value>();
    for (uint32_t i = 0; i < kLightKinds; ++i) {
        LightKind kind = (LightKind) i;
        if (!kinds.has(kind))
            continue;
        if (kinds.only(kind))
            return f(kind);
        if constexpr (dr::is_jit_v<Float>)
            result = dr::select(row.is(kind), f(kind), result);
        else if (row.kind() == i)
            return f(kind);
    }
    return result;
}

/// Fraction of the beam that a spot sends at `cos_theta` from its axis (as Mitsuba's)
template <typename Float>
Float spot_falloff(const Row<Float> &row, const Float &cos_theta) {
    Float angle = dr::acos(dr::clip(cos_theta, -1.f, 1.f));
    return dr::clip((row[6] - angle) * row[7], 0.f, 1.f);
}

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
/// (emission.h) and must not push others out of their reservoirs
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
        default:
            return { origin, row[3], Float(1.f) };
    }
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
