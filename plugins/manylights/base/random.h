#pragma once

/// Random numbers that need no stratification.

#include <drjit/random.h>
#include <mitsuba/core/random.h>

namespace manylights {

namespace dr = drjit;

/// A generator seeded with the bits of two numbers; streams are independent of each other
template <typename UInt32>
dr::PCG32<UInt32> seeded_rng(const UInt32 &bits0, const UInt32 &bits1, uint64_t stream) {
    using UInt64 = dr::uint64_array_t<UInt32>;
    auto [a, b]  = mitsuba::sample_tea_32(bits0, bits1);
    return dr::PCG32<UInt32>(1, UInt64(a) + dr::sl<32>(UInt64(b)), UInt64(stream));
}

} // namespace manylights
