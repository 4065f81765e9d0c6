#pragma once

/**
 * Samples of shuffled and scrambled Sobol' sequences, by index and without tables.
 *
 * Brent Burley, Practical Hash-based Owen Scrambling, JCGT 9(4), 2020. Each request for a
 * number or a pair has a sequence of its own ("padding"), which is shuffled and scrambled by
 * hashes: both are Owen scramblings, one of the index and one of the value, so that all
 * aligned blocks of 2^k samples are (0, k, 2)-nets, and so are those that begin with sample 0.
 *
 * Values are binary fractions of 32 digits.
 */

#include <drjit/array.h>
#include <drjit/jit.h>
#include <utility>

namespace manylights {

namespace dr = drjit;

template <typename UInt32> UInt32 reverse_bits(UInt32 x) {
    if constexpr (dr::is_jit_v<UInt32>)
        return dr::brev(x);
    x = ((x >> 1) & 0x55555555u) | ((x & 0x55555555u) << 1);
    x = ((x >> 2) & 0x33333333u) | ((x & 0x33333333u) << 2);
    x = ((x >> 4) & 0x0f0f0f0fu) | ((x & 0x0f0f0f0fu) << 4);
    x = ((x >> 8) & 0x00ff00ffu) | ((x & 0x00ff00ffu) << 8);
    return (x >> 16) | (x << 16);
}

/// A bijection whose every bit depends on all others (C. Wellons, hash-prospector)
template <typename UInt32> UInt32 mix_bits(UInt32 x) {
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    return x ^ (x >> 16);
}

/**
 * Owen scrambling of a number whose first digit is its lowest bit: whether a bit is flipped
 * depends on the seed and on the bits below it. The form is that of Laine and Karras (2011),
 * the constants are those that N. Vegdahl found (Building a Better LK Hash, 2021).
 */
template <typename UInt32> UInt32 scramble_reversed(UInt32 x, const UInt32 &seed) {
    x ^= x * 0x3d20adeau;
    x += seed;
    x *= (seed >> 16) | 1u;
    x ^= x * 0x05526c56u;
    return x ^ (x * 0x53a22864u);
}

/// The second dimension's value, digits reversed: the first one's is the index, and digits are
/// multiplied by Pascal's triangle modulo 2, which is a product of five matrices
template <typename UInt32> UInt32 second_dimension(UInt32 index) {
    index ^= index >> 16;
    index ^= (index >> 8) & 0x00ff00ffu;
    index ^= (index >> 4) & 0x0f0f0f0fu;
    index ^= (index >> 2) & 0x33333333u;
    return index ^ ((index >> 1) & 0x55555555u);
}

/// One of many sequences of pairs, or of numbers, which are the pairs' first ones
template <typename UInt32> class SobolSequence {
public:
    /// `key` is any number of 32 random bits
    explicit SobolSequence(const UInt32 &key) : m_key(key) {}

    UInt32 number(const UInt32 &index) const { return first(shuffle(index)); }

    std::pair<UInt32, UInt32> pair(const UInt32 &index) const {
        UInt32 shuffled = shuffle(index);
        return { first(shuffled),
                 reverse_bits(scramble_reversed(second_dimension(shuffled),
                                                mix_bits(m_key ^ 0xc2b2ae35u))) };
    }

private:
    UInt32 shuffle(const UInt32 &index) const {
        return reverse_bits(scramble_reversed(reverse_bits(index), m_key));
    }

    /// An index is the first dimension's value with its digits reversed
    UInt32 first(const UInt32 &shuffled) const {
        return reverse_bits(scramble_reversed(shuffled, mix_bits(m_key ^ 0x85ebca6bu)));
    }

    UInt32 m_key;
};

} // namespace manylights
