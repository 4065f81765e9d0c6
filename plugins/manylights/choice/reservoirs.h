#pragma once

/**
 * Stage 2: candidates -> at most m reservoirs, resampled by H.
 *
 * The talk (section 2, "Reservoir Set") deals the candidates at random to m weighted
 * reservoirs of one item. Every dealing that does not look at which item a reservoir
 * holds is unbiased, so the default deals greedily: to the reservoir with the smallest
 * sum of weights so far, which has less variance. With no more candidates than reservoirs all
 * are kept.
 *
 * The estimate is the sum over the reservoirs of C F(light) with C = W / H.
 */

#include "candidate.h"
#include "manylights/base/slots.h"

namespace manylights {

/// How candidates are dealt to reservoirs: greedily, or at random as in the talk
enum class Dealing { Greedy, Random };

template <typename T, typename UInt32>
T read_slot(const Slots<T> &slots, const UInt32 &i, size_t count) {
    if constexpr (dr::is_jit_v<T>) {
        T result = slots.entry(0);
        for (size_t k = 1; k < count; ++k)
            result = dr::select(i == (uint32_t) k, slots.entry(k), result);
        return result;
    } else {
        (void) count;
        return slots[i];
    }
}

template <typename T, typename UInt32>
void write_slot(Slots<T> &slots, const UInt32 &i, const T &value, size_t count,
                const dr::mask_t<T> &active) {
    if constexpr (dr::is_jit_v<T>) {
        for (size_t k = 0; k < count; ++k)
            slots.entry(k) =
                dr::select(active && i == (uint32_t) k, value, slots.entry(k));
    } else {
        (void) count;
        if (active)
            slots[i] = value;
    }
}

template <typename Float> struct Reservoirs {
    using UInt32 = dr::uint32_array_t<Float>;
    using Mask   = dr::mask_t<Float>;

    /// Sum of the weights H / p that were dealt to the reservoir
    Slots<Float> weight;
    /// H and inclusion probability of the light that it holds, and the light
    Slots<Float> importance, probability;
    Slots<UInt32> light;
    Slots<Float> visibility;
    DRJIT_STRUCT(Reservoirs, weight, importance, probability, light, visibility)

    explicit Reservoirs(size_t count)
        : weight(make_slots<Float>(count, 0.f)),
          importance(make_slots<Float>(count, 1.f)),
          probability(make_slots<Float>(count, 1.f)),
          light(make_slots<UInt32>(count, 0u)),
          visibility(make_slots<Float>(count, 1.f)) {}

    /// Deal a candidate of importance H; weights that are not positive and finite are ignored
    template <typename Rng>
    void add(const Candidate<Float> &candidate, const Float &h, size_t count,
             Dealing dealing, Rng &rng) {
        Float w     = h / candidate.probability;
        Mask active = candidate.valid && w > 0.f && w < dr::Infinity<Float>;
        UInt32 k = dealing == Dealing::Greedy
                       ? lightest(count)
                       : min_of(UInt32(rng.template next_float<Float>() * (float) count),
                                (uint32_t) count - 1u);
        Float total = read_slot<Float>(weight, k, count) + w;
        Mask take   = active && rng.template next_float<Float>() * total < w;
        write_slot<Float>(weight, k, total, count, active);
        write_slot<Float>(importance, k, h, count, take);
        write_slot<Float>(probability, k, candidate.probability, count, take);
        write_slot<UInt32>(light, k, candidate.light, count, take);
        write_slot<Float>(visibility, k, candidate.visibility, count, take);
    }

private:
    UInt32 lightest(size_t count) const {
        UInt32 best(0);
        Float smallest = weight[0];
        for (uint32_t k = 1; k < count; ++k) {
            Mask less = weight[k] < smallest;
            best      = dr::select(less, k, best);
            smallest  = min_of(smallest, weight[k]);
        }
        return best;
    }
};

/**
 * Threshold of systematic sampling: the tau for which sum_k min(g_k, tau) <= s tau, with
 * equality unless fewer than s items are positive. An item is then chosen with probability
 * min(1, g / tau), so that its weight is max(1, tau / g).
 *
 * Each step lowers tau towards the fixed point and keeps the inequality, so stopping after
 * any number of steps is unbiased; s steps always reach it.
 */
template <typename Float>
Float selection_threshold(const Slots<Float> &targets, size_t count, uint32_t picks) {
    Float sum(0.f);
    for (size_t i = 0; i < count; ++i)
        sum += targets[i];
    Float tau = sum / (float) picks;
    for (uint32_t step = 1; step < picks; ++step) {
        Float small(0.f), free((float) picks);
        for (size_t i = 0; i < count; ++i) {
            auto big = targets[i] >= tau;
            small += dr::select(big, 0.f, targets[i]);
            free -= dr::select(big, Float(1.f), 0.f);
        }
        tau = dr::select(small > 0.f && free > 0.f, min_of(tau, small / free), tau);
    }
    return tau;
}

/// The item that contains the point `x` of the cumulated clipped targets
template <typename Float> struct Selected {
    dr::uint32_array_t<Float> item;
    Float target;
    dr::mask_t<Float> valid;
};

template <typename Float>
Selected<Float> select_item(const Slots<Float> &targets, size_t count, const Float &tau,
                            const Float &x) {
    Selected<Float> result{ 0u, Float(1.f), false };
    Float begin(0.f);
    for (uint32_t i = 0; i < count; ++i) {
        Float end     = begin + min_of(targets[i], tau);
        auto here     = x >= begin && x < end;
        result.item   = dr::select(here, i, result.item);
        result.target = dr::select(here, targets[i], result.target);
        result.valid |= here;
        begin = end;
    }
    return result;
}

} // namespace manylights
