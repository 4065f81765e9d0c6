#pragma once

/**
 * A light as it is read on the host: its row of the table and its bounds for the tree.
 *
 * Plain C++, no Dr.Jit and no Mitsuba types.
 */

#include "light_row.h"
#include "manylights/base/host_vector.h"
#include "manylights/emission/emission.h"
#include <algorithm>
#include <cstring>

namespace manylights {

/// What is read of a light. The table adds its emitter, and its weight in the tree.
struct HostLight {
    LightRow row;
    LightBounds bounds;
};

/// A row without a place
inline LightRow make_row(LightKind kind, const Emission &e) {
    LightRow row{};
    std::copy_n(e.color, 3, row.color);
    row.brightness = e.brightness;
    row.scale      = e.scale;
    row.tag        = (uint32_t) kind | (e.tabulated ? kTagTabulated : 0);
    return row;
}

/// For lights that their emitter evaluates: which primitive, and are its edges swapped?
inline void set_primitive(LightRow &row, uint32_t index, bool swapped) {
    std::memcpy(&row.color[0], &index, sizeof(float));
    row.color[1] = swapped ? 1.f : 0.f;
}

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

} // namespace manylights
