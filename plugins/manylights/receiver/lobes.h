#pragma once

/**
 * Glossy lobes of a receiver as h and H see them: GGX, measured by receiver_reader.h.
 */

#include "receiver.h"

namespace manylights {

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
    return min_of(c * ((1.f / kMasking) * dr::rsqrt(alpha2)), 1.f);
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
 * with the cosine c on the other side.
 */
template <typename Float, typename Value>
Value transmitted_lobe(const Receiver<Float> &at, const LobeView<Value> &view) {
    Value b      = dr::fmadd(view.spread2, 2.f, at.beta2),
          chord2 = max_of(dr::fnmadd(view.dot_through, 2.f, 2.f), 0.f),
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
 * cos_o, and the angle that a cluster fills is magnified in its half vector at grazing angles:
 * so the lobe does not fall with c, and the variance is divided by |wi + w / e|^2.
 */
template <typename Float, typename Value>
Value lobe(const Receiver<Float> &at, const LobeView<Value> &view, const Value &c) {
    Float cos_i   = dr::dot(at.n, at.wi);
    Value length2 = dr::fmadd(view.dot_wi, 2.f, 2.001f),
          cos2    = min_of(dr::square(view.cos_o + cos_i), length2);
    // All over |wi + w / e|^2: one division
    Value a = min_of(dr::fmadd(length2, at.alpha2, 2.f * view.spread2), length2);
    Value r = dr::rcp(dr::fmadd(cos2, a - length2, dr::square(length2)));
    Value d = a * length2 * dr::square(length2 * r);
    if (at.lobes == Lobes::Reflected)
        return dr::fmadd(at.specular * masking(c, at.alpha2), d, at.diffuse * c);
    Value front = .5f * twice_positive(view.cos_o, view.spread2);
    return dr::fmadd(at.specular * masking(front, at.alpha2), d,
                     dr::fmadd(at.diffuse, c, transmitted_lobe(at, view)));
}

} // namespace manylights
