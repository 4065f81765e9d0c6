#pragma once

/// Rows of the light table as kernels read them.

#include "light_row.h"
#include "manylights/base/loop.h"
#include "manylights/base/min_max.h"
#include <mitsuba/core/vector.h>

namespace manylights {

/// A row of the table
template <typename Float> struct Row {
    using UInt32   = dr::uint32_array_t<Float>;
    using Mask     = dr::mask_t<Float>;
    using Vector3f = mitsuba::Vector<Float, 3>;
    using Point3f  = mitsuba::Point<Float, 3>;
    using Point2f  = mitsuba::Point<Float, 2>;

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

} // namespace manylights
