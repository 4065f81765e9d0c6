#pragma once

/// A light as seen from a segment of a ray in fog.

#include "receiver.h"

namespace manylights {

/// A light as seen from a segment that starts at the origin and goes along `d`
template <typename Value, typename Float> struct SegmentView {
    /// Distance of the nearest point of the line from the segment's start; the light's
    /// distance from the line, with its own extent
    Value nearest, distance;
    Float length;

    SegmentView() = default;
    /**
     * @param off2  square of the light's distance from the line: that of a difference of vectors,
     *              since one of squares would be lost in rounding
     */
    SegmentView(const Value &nearest, const Value &off2, const Value &variance,
                const Float &length)
        : nearest(nearest), length(length) {
        distance =
            dr::sqrt(dr::fmadd(nearest * nearest, 1e-13f, off2 + variance) + 1e-30f);
    }

    /// The angle that the segment fills
    Value angle() const {
        Value beyond = length - nearest;
        return dr::atan2(length * distance,
                         dr::fnmadd(nearest, beyond, distance * distance));
    }

    /// Sine and cosine of the angle of a point of the segment, 0 at the line's nearest one
    std::pair<Value, Value> direction(const Value &t) const {
        Value off = t - nearest,
              inv = dr::rsqrt(dr::fmadd(off, off, distance * distance));
        return { off * inv, distance * inv };
    }

    /// Point of the segment that is nearest to the light
    Value closest() const { return dr::clip(nearest, 0.f, length); }
};

} // namespace manylights
