#pragma once

/**
 * Single scattering along a segment of a ray in a homogeneous medium: distances that suit a
 * light.
 *
 * The light that a segment receives from a point at the distance D of the ray grows like
 * 1 / (D^2 + t^2), which free-flight sampling does not see: with a light next to the ray its
 * variance is unbounded. So lights are chosen for the whole segment, and a distance for each
 * of them, half of the time with equal angles as seen from the light (Kulla and Fajardo,
 * "Importance Sampling Techniques for Path Tracing in Participating Media", 2012), half
 * of the time in proportion to the transmittance: that of a random channel or wavelength
 * where these differ. The angles are those of the light's beam.
 */

#include "manylights/kinds/light_geometry.h"
#include "segment_view.h"

namespace manylights {

/// Distances along a segment for one light
template <typename Float> class SegmentDistances {
public:
    using Receiver = manylights::Receiver<Float>;
    using UInt32   = dr::uint32_array_t<Float>;
    using Vector3f = mitsuba::Vector<Float, 3>;

    /**
     * @param w     from the start of the segment to the light's centre
     * @param beam  where the light shines, null if everywhere
     */
    SegmentDistances(const Receiver &at, const Vector3f &w, const Float &variance,
                     const Beam<Float> *beam)
        : m_at(at), m_start(0.f) {
        Float nearest = -dr::dot(at.wi, w);
        Vector3f off  = dr::fnmadd(at.wi, nearest, -w);
        m_view        = { nearest, dr::squared_norm(off), variance, at.nearby() };
        if (beam)
            restrict(off, *beam);
        m_angle = m_view.angle();
    }

    /// @param channel  random, below \ref Receiver::channels
    Float sample(const Float &u, const UInt32 &channel) const {
        Float v = 2.f * u;
        return dr::select(v < 1.f, sample_equiangular(v),
                          sample_transmittance(m_at, v - 1.f, channel));
    }

    Float pdf(const Float &t) const {
        Float on_view = t - m_start, offset = on_view - m_view.nearest,
              d2          = dr::square(m_view.distance);
        Float equiangular = m_view.distance / (m_angle * dr::fmadd(offset, offset, d2));
        equiangular =
            dr::select(on_view >= 0.f && on_view <= m_view.length, equiangular, 0.f);
        return .5f * (equiangular + transmittance_pdf(m_at, t));
    }

    /// Distance in the middle of the angles
    Float middle() const { return sample_equiangular(.5f); }

    /// Integral of 1 / distance^2 over the angles
    Float integral() const { return m_angle / m_view.distance; }

    /// Density proportional to a channel's transmittance, or constant if that hardly changes
    static Float sample_transmittance(const Receiver &at, const Float &u,
                                      const UInt32 &channel) {
        Float extinction = at.extinction;
        for (uint32_t i = 0; i < at.channels; ++i)
            extinction = dr::select(channel == i, at.extinctions.entry(i), extinction);
        Float depth = extinction * at.length;
        Float t     = -dr::log(1.f - u * (1.f - dr::exp(-depth))) / extinction;
        return dr::minimum(dr::select(depth < kThin, u * at.length, t), at.length);
    }
    static Float transmittance_pdf(const Receiver &at, const Float &t) {
        if (at.channels == 0)
            return exponential_pdf(at.extinction, at.length, t);
        Float sum(0.f);
        for (uint32_t i = 0; i < at.channels; ++i)
            sum += exponential_pdf(at.extinctions.entry(i), at.length, t);
        return sum * (1.f / at.channels);
    }

private:
    static constexpr float kThin = .02f;

    static Float exponential_pdf(const Float &extinction, const Float &length,
                                 const Float &t) {
        Float depth = extinction * length;
        Float pdf   = extinction * dr::exp(-extinction * t) / (1.f - dr::exp(-depth));
        return dr::select(depth < kThin, dr::rcp(length), pdf);
    }

    /**
     * Let the view be of the part of the segment that is in a beam, if there is any. With the light's
     * true distance D from the line the cosine of its axis with the direction to nearest + D x is
     * (across + along x) / sqrt(1 + x^2): that of the beam's border at the roots of a quadratic.
     * More than half a sphere is no beam.
     * @param off  from the light to the line's nearest point
     */
    void restrict(const Vector3f &off, const Beam<Float> &beam) {
        Vector3f d       = -m_at.wi;
        Float distance   = dr::norm(off) + 1e-30f;
        Vector3f to_line = off / distance, normal = dr::cross(d, to_line);
        Float along = dr::dot(beam.axis, d), across = dr::dot(beam.axis, to_line);
        // along^2 - cos^2, and across^2 more: of narrow beams by what is left of 1
        Float s2 = dr::square(beam.sine), c2 = dr::square(beam.cosine);
        auto narrow  = beam.cosine > .7f;
        Float a      = dr::select(narrow, s2 - dr::squared_norm(dr::cross(d, beam.axis)),
                                  dr::fmsub(along, along, c2)),
              rest   = dr::select(narrow, s2 - dr::square(dr::dot(beam.axis, normal)),
                                  dr::fmadd(across, across, a)),
              root   = beam.cosine * dr::sqrt(dr::maximum(rest, 0.f)),
              middle = -across * along;
        Float one = (middle - root) / a, two = (middle + root) / a;
        auto open = a > 0.f, met = open || (rest > 0.f && across > 0.f);
        Float low = dr::minimum(one, two), high = dr::maximum(one, two);
        Float from = dr::select(open, dr::select(along > 0.f, high, -dr::Infinity<Float>),
                                low),
              to   = dr::select(open, dr::select(along > 0.f, dr::Infinity<Float>, low),
                                high);
        from = dr::clip(dr::fmadd(distance, from, m_view.nearest), 0.f, m_view.length);
        to   = dr::clip(dr::fmadd(distance, to, m_view.nearest), 0.f, m_view.length);
        auto cut = beam.cosine >= 0.f && met && to > from;
        m_start  = dr::select(cut, from, 0.f);
        m_view.nearest -= m_start;
        m_view.length = dr::select(cut, to - from, m_view.length);
    }

    /// n^2 sin / (D cos + nearest sin) with the angle from the view's start, at a distance
    /// n from the light: no difference of large numbers
    Float sample_equiangular(const Float &v) const {
        auto [sin, cos] = dr::sincos(v * m_angle);
        Float n2        = dr::square(m_view.nearest) + dr::square(m_view.distance);
        Float t = n2 * sin / dr::fmadd(m_view.distance, cos, m_view.nearest * sin);
        return m_start + dr::clip(t, 0.f, m_view.length);
    }

    const Receiver &m_at;
    /// Where the angles begin
    Float m_start;
    SegmentView<Float, Float> m_view;
    Float m_angle;
};

} // namespace manylights
