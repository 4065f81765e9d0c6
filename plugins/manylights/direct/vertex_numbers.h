#pragma once

/**
 * What is derived from the random numbers of a vertex: one stratified number for each slot,
 * and a generator for all that needs no stratification.
 */

#include "manylights/base/random.h"
#include "vertex.h"
#include <utility>

namespace manylights {

/// Independent numbers, seeded from those of a vertex
template <typename FloatD> using VertexRng = dr::PCG32<dr::uint32_array_t<FloatD>>;

template <typename Float>
LightSample<dr::detached_t<Float>> plain_sample(const LightSample<Float> &u) {
    return { plain(u.tree),
             plain(u.selection),
             { plain(u.point.x()), plain(u.point.y()) } };
}

/// All the bits of a vertex' numbers, in two
template <typename FloatD> auto seed_bits(const LightSample<FloatD> &u) {
    using UInt32D = dr::uint32_array_t<FloatD>;
    auto bits     = [](const FloatD &x) { return dr::reinterpret_array<UInt32D>(x); };
    return std::pair<UInt32D, UInt32D>(bits(u.point.x()) ^ (bits(u.tree) * 0x9e3779b9u),
                                       bits(u.point.y()) + bits(u.selection));
}

/// Numbers that need no stratification, seeded with the bits of those that have it
template <typename FloatD>
VertexRng<FloatD> make_rng(const LightSample<FloatD> &u, uint64_t stream = 1) {
    auto bits = seed_bits(u);
    return seeded_rng(bits.first, bits.second, stream);
}

/// x + number / 2^32, modulo 1: exact however many slots there are
template <typename Float>
Float shift(const Float &x, const dr::uint32_array_t<Float> &number) {
    Float shifted = x + Float(number >> 8u) * 0x1p-24f;
    return shifted - dr::floor(shifted);
}

/// Each slot gets its own shift of the sampler's point (R2 sequence): stratified over the
/// samples of a pixel and over the slots
template <typename Float>
mitsuba::Point<Float, 2>
slot_point(const mitsuba::Point<Float, 2> &u,
           const dr::uint32_array_t<dr::detached_t<Float>> &slot) {
    dr::uint32_array_t<Float> number(slot);
    return { shift(u.x(), number * 0xc13fa9a9u), shift(u.y(), number * 0x91e10da6u) };
}

/// Each slot gets its own shift of the number that the distance is chosen with
template <typename Vertex, typename UInt32D>
auto slot_distance(const Vertex &vertex, const UInt32D &slot) {
    return shift(plain(vertex.u.distance), slot * 0x9e3779b9u);
}

/// The random channel that the distance of a slot follows
template <typename Vertex, typename UInt32D>
UInt32D slot_channel(const Vertex &vertex, const UInt32D &slot) {
    if (vertex.at.channels == 0)
        return 0u;
    auto u       = plain_sample(vertex.u);
    u.selection  = plain(vertex.u.distance);
    auto bits    = seed_bits(u);
    UInt32D hash = mitsuba::sample_tea_32(bits.first + slot, bits.second).first;
    return dr::mul_hi(hash, vertex.at.channels);
}

} // namespace manylights
