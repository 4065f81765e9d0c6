#pragma once

/**
 * Samples of shuffled and scrambled digital sequences, by index and without tables.
 *
 * Brent Burley, Practical Hash-based Owen Scrambling, JCGT 9(4), 2020: four dimensions belong to
 * one sequence, the next four to another one ("padding"), which is shuffled and scrambled by
 * hashes. Both are Owen scramblings, one of the index and one of the value, so that aligned
 * blocks of 2^k samples stay as even as they are.
 *
 * The four dimensions are not those of Sobol' but those of Faure and Niederreiter over the field
 * GF(4): with 4^k samples each elementary interval of base 4, in all four of them, has one. The
 * first pair of dimensions is that of Sobol', the second is alike: (0, 2)-sequences in base 2.
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

/// Every digit of two bits with number i, times the i-th power of the field's generator w (its
/// polynomial is x^2 + x + 1), whose third power is 1: times w where `once`, w^2 where `twice`
template <typename UInt32>
UInt32 scale_digits(const UInt32 &x, const UInt32 &once, const UInt32 &twice) {
    UInt32 high = (x >> 1) & 0x55555555u, low = x & 0x55555555u, sum = high ^ low;
    // w x + x = w^2 x, and w^2 x + x = w x
    return x ^ (((low << 1) | sum) & once) ^ (((sum << 1) | high) & twice);
}

/// Digits of two bits times Pascal's triangle modulo 2, which is a product of four matrices
template <typename UInt32> UInt32 multiply_pascal(UInt32 x) {
    x ^= x >> 16;
    x ^= (x >> 8) & 0x00ff00ffu;
    x ^= (x >> 4) & 0x0f0f0f0fu;
    return x ^ ((x >> 2) & 0x33333333u);
}

/**
 * The value of a dimension, 0 to 3, at an index; digits reversed. Dimension 0 reverses the
 * digits of the index, dimension k has the matrix D^-1 P D with Pascal's P and the powers of
 * w^(k - 1) in D. The last line changes digits of base 4 within themselves: it makes the
 * dimensions 0 and 1, and 2 and 3, (0, 2)-sequences in base 2.
 */
template <typename UInt32>
UInt32 digital_value(const UInt32 &index, const UInt32 &dimension) {
    // Digits 1, 4, 7... and 2, 5, 8...
    UInt32 ones  = dr::select(dimension >= 2u, UInt32(0x0c30c30cu), UInt32(0u)),
           twos  = dr::select(dimension >= 2u, UInt32(0x30c30c30u), UInt32(0u)),
           once  = dr::select(dimension == 2u, ones, twos),
           twice = dr::select(dimension == 2u, twos, ones);
    UInt32 x     = multiply_pascal(scale_digits(index, once, twice));
    x            = scale_digits(x, twice, once);
    x ^= (x >> 1) & dr::select(dimension <= 2u, UInt32(0x55555555u), UInt32(0u));
    return dr::select(dimension == 0u, index, x);
}

/// Numbers and pairs of one sample: a function of a key of 32 random bits, the sample's index and
/// the dimension
template <typename UInt32> class SobolSample {
public:
    static constexpr uint32_t kTogether = 4;

    SobolSample(const UInt32 &key, const UInt32 &index, const UInt32 &dimension)
        : m_seed(mix_bits<UInt32>(key + dimension * 0x9e3779b9u)),
          m_dimension(dimension % kTogether) {
        UInt32 group =
            mix_bits<UInt32>((key ^ 0xc2b2ae35u) + (dimension / kTogether) * 0x85ebca6bu);
        m_index = reverse_bits(scramble_reversed(reverse_bits(index), group));
    }

    UInt32 number() const { return value(m_dimension, m_seed); }

    /// Dimensions 0 and 1, or 2 and 3
    std::pair<UInt32, UInt32> pair() const {
        return { number(),
                 value(m_dimension + 1u, mix_bits<UInt32>(m_seed ^ 0x5bd1e995u)) };
    }

private:
    UInt32 value(const UInt32 &dimension, const UInt32 &seed) const {
        return reverse_bits(scramble_reversed(digital_value(m_index, dimension), seed));
    }

    UInt32 m_seed, m_dimension, m_index;
};

} // namespace manylights
