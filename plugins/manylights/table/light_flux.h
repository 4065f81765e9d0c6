#pragma once

/**
 * Emitted power of a light, and its weight in the tree, from its row of the table: the
 * same when the table is read and when emitters have only become brighter or darker. Doubles,
 * which hold the products of all floats.
 *
 * Plain C++, no Dr.Jit and no Mitsuba types.
 */

#include "light_row.h"
#include <algorithm>
#include <cmath>
#include <limits>

namespace manylights {

constexpr float kPi = 3.14159265358979f;

/// Euclidean norm; no square of a float leaves the range of a double
inline float norm(float x, float y, float z) {
    return (float) std::sqrt((double) x * x + (double) y * y + (double) z * z);
}
inline float norm(const float v[3]) { return norm(v[0], v[1], v[2]); }

inline void cross(const float u[3], const float v[3], float out[3]) {
    for (int i = 0; i < 3; ++i) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        out[i] = u[j] * v[k] - u[k] * v[j];
    }
}

/// Area of the parallelogram of two edges
inline float edge_area(const float u[3], const float v[3]) {
    float normal[3];
    cross(u, v, normal);
    return norm(normal);
}

/// Power of a spot of intensity 1, uniform up to the middle of the transition
inline float spot_power(float cutoff, float inverse_transition) {
    float beam =
        inverse_transition < kHardEdge ? cutoff - 1 / inverse_transition : cutoff;
    // (1 - cos) as 2 sin^2, without cancellation
    float sin_beam = std::sin(.5f * beam), sin_cutoff = std::sin(.5f * cutoff);
    return 2 * kPi * (sin_beam * sin_beam + sin_cutoff * sin_cutoff);
}

inline double light_power(const LightRow &row) {
    const float *g    = row.geometry;
    double brightness = row.brightness;
    switch (kind_of(row)) {
        case LightKind::Point:
        case LightKind::Other:
            return 4 * kPi * brightness;
        case LightKind::Spot:
            return spot_power(g[6], g[7]) * brightness;
        case LightKind::Triangle:
            return edge_area(g + 3, g + 6) * .5f * kPi * brightness;
        case LightKind::Disk:
            return edge_area(g + 3, g + 6) * kPi * kPi * brightness;
        case LightKind::Sphere:
            return 4 * kPi * g[3] * g[3] * kPi * brightness;
        case LightKind::Cylinder:
            return 2 * kPi * g[6] * norm(g + 3) * kPi * brightness;
    }
    return 0;
}

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

} // namespace manylights
