#pragma once

#include "candidate.h"

namespace manylights {

/// Every light, with probability 1 (few lights, or infinite rate)
template <typename Float> struct AllLights {
    using UInt32 = dr::uint32_array_t<Float>;

    UInt32 index, count, visits;
    DRJIT_STRUCT(AllLights, index, count, visits)

    explicit AllLights(const UInt32 &count) : index(0), count(count), visits(0) {}

    auto has_next() const { return index < count; }

    template <typename Rng>
    Candidate<Float> next(const TreeView<Float> &, const Receiver<Float> &, Rng &) {
        Candidate<Float> result{ index, Float(1.f), true };
        index += 1u;
        return result;
    }

    static Float inclusion_probability() { return Float(1.f); }
};

} // namespace manylights
