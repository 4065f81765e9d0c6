#pragma once

/// Division of lane numbers of JIT variants by a number that kernels do not know

#include <drjit/jit.h>
#include <utility>

namespace manylights {

namespace dr = drjit;

/// Quotient and remainder: exact, and faster than a division of integers
template <typename UInt32>
std::pair<UInt32, UInt32> divide(const UInt32 &x, uint32_t divisor) {
    using Double    = dr::float64_array_t<UInt32>;
    UInt32 quotient = UInt32((Double(x) + .5) * dr::opaque<Double>(1. / divisor));
    return { quotient, dr::fnmadd(quotient, dr::opaque<UInt32>(divisor), x) };
}

} // namespace manylights
