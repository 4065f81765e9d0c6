#pragma once

#include <drjit/array.h>

namespace manylights {

namespace dr = drjit;

/**
 * The smaller and the larger of two numbers; the second one if any is not a number. In LLVM
 * variants they are one instruction. Dr.Jit's own take six, to be exact for signed zeros and NaNs.
 */
template <typename A, typename B> auto min_of(const A &a, const B &b) {
    using T = decltype(a + b);
    T x(a), y(b);
    if constexpr (dr::is_llvm_v<T>)
        return T(dr::select(x < y, x, y));
    else
        return T(dr::minimum(x, y));
}

template <typename A, typename B> auto max_of(const A &a, const B &b) {
    using T = decltype(a + b);
    T x(a), y(b);
    if constexpr (dr::is_llvm_v<T>)
        return T(dr::select(x > y, x, y));
    else
        return T(dr::maximum(x, y));
}

} // namespace manylights
