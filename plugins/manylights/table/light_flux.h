#pragma once

/**
 * Weights of lights in the tree, from their rows: the same when the table is read and when
 * emitters have only become brighter or darker. Doubles, which hold the products of all floats.
 */

#include "manylights/kinds/kinds.h"
#include <algorithm>
#include <cmath>
#include <limits>

namespace manylights {

/// Weight in the tree (see LightBounds); `beams`: do narrow spots matter in the scene?
inline double light_flux(const LightRow &row, bool beams) {
    double power = light_power(row);
    if (!beams && kind_of(row) == LightKind::Spot)
        return std::sqrt(power * 4 * kPi * row.brightness);
    return power;
}

/// The power of two that brings the largest flux of a scene to [1, 2): weights relative to it
/// are the same in any unit, and exact
inline float flux_scale(double largest) {
    bool usable = largest > 0 && std::isfinite(largest);
    return std::ldexp(1.f, usable ? -std::clamp(std::ilogb(largest), -126, 126) : 0);
}

/// A flux in these units. The tree needs it to be positive
inline float scaled_flux(double flux, float scale) {
    return std::max((float) (flux * scale), std::numeric_limits<float>::min());
}

/// Power that decides whether a light can be chosen; infinite without a finite place
inline double usable_power(const LightRow &row, const LightBounds &bounds) {
    double power = light_power(row);
    bool finite  = std::isfinite(power) && std::isfinite(bounds.variance);
    for (int i = 0; i < 3; ++i)
        finite &= std::isfinite(bounds.box_min[i]) && std::isfinite(bounds.box_max[i]);
    return finite ? power : std::numeric_limits<double>::infinity();
}

inline bool is_valid_power(double power) {
    return std::isfinite((float) power) && power >= 0;
}

} // namespace manylights
