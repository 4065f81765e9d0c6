#pragma once

/// Small arrays whose entries are JIT variables, or plain memory in scalar variants.

#include <drjit/dynamic.h>
#include <drjit/jit.h>

namespace manylights {

namespace dr = drjit;

/// Hard limit on the number of reservoirs: their state lives in registers
constexpr uint32_t kMaxReservoirs = 64;
/// Lights at infinity that all take part in stage 3; of more, one is chosen at random
constexpr uint32_t kMaxInfinite = 8;

/// A small array whose length is set at run time, in place of a heap allocation per sample
template <typename T> class FixedArray {
public:
    FixedArray() = default;
    FixedArray(size_t size, const T &value) : m_size(size) {
        for (size_t i = 0; i < size; ++i)
            m_data[i] = value;
    }
    FixedArray(const FixedArray &other) { *this = other; }
    FixedArray &operator=(const FixedArray &other) {
        m_size = other.m_size;
        for (size_t i = 0; i < m_size; ++i)
            m_data[i] = other.m_data[i];
        return *this;
    }
    size_t size() const { return m_size; }
    T &operator[](size_t i) { return m_data[i]; }
    const T &operator[](size_t i) const { return m_data[i]; }

private:
    T m_data[kMaxReservoirs + kMaxInfinite];
    size_t m_size = 0;
};

/// The reservoirs' fields: an array of JIT variables, or plain memory
template <typename T>
using Slots = std::conditional_t<dr::is_jit_v<T>, dr::DynamicArray<T>, FixedArray<T>>;

template <typename T> Slots<T> make_slots(size_t count, const T &value) {
    if constexpr (dr::is_jit_v<T>)
        return dr::full<Slots<T>>(value, count);
    else
        return Slots<T>(count, value);
}

} // namespace manylights
