#pragma once

/**
 * Stand-in for the one header that Mitsuba's own headers include and its wheel lacks.
 *
 * mitsuba/core/struct.h and tensor.h name a type, a trait and a value of that trait. They
 * are declared here and nothing more: the trait has no general definition, so code that
 * would depend on the numbering of the real library does not compile, instead of reading
 * wrong data. mitsuba/core/bitmap.h holds further types of that library by value and
 * cannot be included.
 */

#include <cstdint>

namespace struct_jit {

/// Type of a scalar in a record; Mitsuba's headers name this one enumerator only
enum class Type : uint32_t { Float16 };

/// The enumerator of Type that belongs to the C++ type T
template <typename T> struct type_id;

template <typename T> constexpr Type type_v = type_id<T>::value;

} // namespace struct_jit
