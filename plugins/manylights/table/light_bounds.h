#pragma once

/**
 * Helpers that fill the bounds of a light, and the power that decides whether it can be chosen.
 *
 * Plain C++, no Dr.Jit and no Mitsuba types.
 */

#include "light_flux.h"

namespace manylights {

/// Bounds of a light without extent, which shines in all directions
inline LightBounds point_bounds(const float position[3]) {
    LightBounds bounds{};
    std::copy_n(position, 3, bounds.box_min);
    std::copy_n(position, 3, bounds.box_max);
    std::copy_n(position, 3, bounds.mean);
    return bounds;
}

inline void grow(LightBounds &bounds, float radius) {
    for (int i = 0; i < 3; ++i) {
        bounds.box_min[i] -= radius;
        bounds.box_max[i] += radius;
    }
}

/// Set the emission axis to the direction of u x v
inline void set_axis(LightBounds &bounds, const float u[3], const float v[3]) {
    float n[3];
    cross(u, v, n);
    float length                = norm(n);
    constexpr float mean_cosine = 2.f / 3.f;
    for (int i = 0; i < 3; ++i)
        bounds.axis[i] = length > 0 ? mean_cosine * n[i] / length : 0;
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
