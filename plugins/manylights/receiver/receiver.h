#pragma once

/// The shading point as the tree sees it, and how a medium attenuates light on its way there.

#include "manylights/base/loop.h"
#include "manylights/base/min_max.h"
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
    Float nearby() const { return min_of(length, 6.f / extinction); }
};

/// Smallest transmittance that is assumed: how far the medium extends is not known
constexpr float kTransmittanceFloor = .02f;

/// exp(-extinction * distance), the largest plausible effect of a medium up to a light
template <typename Float, typename Value>
Value attenuation(const Receiver<Float> &at, const Value &distance) {
    return max_of(dr::exp(-distance * at.extinction), kTransmittanceFloor);
}

/// c + sqrt(c^2 + s^2): 2 max(c, 0), smoothed by a variance s^2
template <typename Value> Value twice_positive(const Value &c, const Value &variance) {
    // Below the horizon the root may be less than -c: CUDA's is approximate, and the square of
    // a tiny c is rounded to zero
    return max_of(c + dr::sqrt(dr::fmadd(c, c, variance)), 0.f);
}

} // namespace manylights
