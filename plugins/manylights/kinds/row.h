#pragma once

/// Rows of the light table as kernels read them.

#include "light_row.h"
#include "manylights/base/loop.h"
#include <mitsuba/core/vector.h>

namespace manylights {

/// A row of the table
template <typename Float> struct Row {
    using UInt32   = dr::uint32_array_t<Float>;
    using Mask     = dr::mask_t<Float>;
    using Vector3f = mitsuba::Vector<Float, 3>;

    /// Scalar variants read the table in place
    std::conditional_t<dr::is_jit_v<Float>, dr::Array<Float, kRowFloats>, const Float *>
        data;

    Float operator[](size_t i) const { return data[i]; }
    Vector3f vector(size_t i) const { return { data[i], data[i + 1], data[i + 2] }; }
    UInt32 bits(size_t i) const { return dr::reinterpret_array<UInt32>(data[i]); }
    UInt32 kind() const { return bits(kTag) & kTagKindMask; }
    Mask is(LightKind k) const { return kind() == (uint32_t) k; }
    /// Is it a point, which no ray hits?
    Mask is_delta() const {
        Mask result(false);
        for (uint32_t i = 0; i < kLightKinds; ++i)
            if (manylights::is_delta((LightKind) i))
                result |= is((LightKind) i);
        return result;
    }
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

/**
 * Evaluate `f(kind)` for the kinds that occur and merge the results by the kind of the
 * row. With one kind in the scene nothing is selected.
 */
template <typename Value, typename Float, typename F>
Value by_kind(const Row<Float> &row, KindSet kinds, const F &f) {
    Value result = dr::zeros<Value>();
    for (uint32_t i = 0; i < kLightKinds; ++i) {
        LightKind kind = (LightKind) i;
        if (!kinds.has(kind))
            continue;
        if (kinds.only(kind))
            return f(kind);
        if constexpr (dr::is_jit_v<Float>)
            result = dr::select(row.is(kind), f(kind), result);
        else if (row.kind() == i)
            return f(kind);
    }
    return result;
}

/// Fraction of the beam that a spot sends at `cos_theta` from its axis (as Mitsuba's)
template <typename Float>
Float spot_falloff(const Row<Float> &row, const Float &cos_theta) {
    Float angle = dr::acos(dr::clip(cos_theta, -1.f, 1.f));
    return dr::clip((row[6] - angle) * row[7], 0.f, 1.f);
}

} // namespace manylights
