#pragma once

/**
 * Candidates: the N' lights that a shading point considers, one after the other. Candidates of
 * one point are always distinct lights.
 *
 * Three sources with one interface, each in a file beside this one: \ref AllLights,
 * \ref SystematicCursor (default), \ref SplittingCursor.
 *
 *     Mask has_next() const;                 is there another candidate?
 *     Candidate next(tree, receiver, rng);   find it and move on
 *     Float inclusion_probability(...);      with which a light is one of the candidates
 *     UInt32 visits;                         nodes visited so far (drops out if unused)
 */

#include "manylights/tree/tree_view.h"
#include <drjit/random.h>

namespace manylights {

/// A light and the probability with which it became a candidate
template <typename Float> struct Candidate {
    using UInt32 = dr::uint32_array_t<Float>;
    using Mask   = dr::mask_t<Float>;
    UInt32 light;
    Float probability;
    Mask valid;
    /// Factor of H and of the targets of stage 3
    Float visibility = Float(1.f);
};

/// Largest float below 1
constexpr float kBelowOne = 0x1.fffffep-1f;

} // namespace manylights
