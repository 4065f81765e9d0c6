#pragma once

/// Arithmetic of three-dimensional vectors on the host. Plain C++, no Dr.Jit and no Mitsuba types.

#include <cmath>

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

} // namespace manylights
