#pragma once

/**
 * The tree as the kernels see it, and the one function that both sampling and its
 * density use: the probabilities of a node's four children.
 *
 * Conty Estevez, Hellmuth and Lecocq, "A Resampled Tree for Many Lights Rendering",
 * SIGGRAPH Talks 2024, section 2. Candidates are drawn in candidates.h.
 *
 * All of this works on detached numbers: choices carry no derivative.
 */

#include "importance.h"
#include "tree_builder.h"
#include <drjit/dynamic.h>

namespace manylights {

/// Share of a child's probability that follows its flux alone: a light that h
/// over-estimates can then not starve its neighbours
constexpr float kDefensiveShare = .05f;

template <typename Float> struct TreeView {
    using UInt32   = dr::uint32_array_t<Float>;
    using Mask     = dr::mask_t<Float>;
    using FBuffer  = dr::DynamicArray<Float>;
    using Storage  = std::conditional_t<dr::is_jit_v<Float>, Float, FBuffer>;
    using Receiver = manylights::Receiver<Float>;

    /// Wide nodes, binary nodes (method `talk` only) and rows of the table
    Storage nodes, binary, rows;
    uint32_t light_count = 0;
    KindSet kinds;
    Directions directions = Directions::All;

    /// Gather the `Count` floats of entry `index`
    template <size_t Count>
    static dr::Array<Float, Count> fetch(const Storage &buffer, const UInt32 &index,
                                         const Mask &active) {
        if constexpr (dr::is_jit_v<Float>)
            return dr::gather<dr::Array<Float, Count>>(buffer, index, active);
        else
            return dr::load<dr::Array<Float, Count>>(buffer.data() + index * Count);
    }

    Row<Float> row(const UInt32 &light, const Mask &active = true) const {
        return { fetch<kRowFloats>(rows, light, active) };
    }
};

/// One coordinate of an axis that \ref pack_axis packed into signed fields of 10 bits
template <typename Value>
Value unpack_axis(const dr::uint32_array_t<Value> &packed, int coordinate) {
    // Shifted up without a sign, where no bit is one too many, and down with it
    auto upper =
        dr::reinterpret_array<dr::int32_array_t<Value>>(packed << (22 - 10 * coordinate));
    return Value(upper >> 22) * (1.f / 511.f);
}

/// A wide node, gathered
template <typename Float> struct WideNodeView {
    using UInt32 = dr::uint32_array_t<Float>;

    Clusters<Float> clusters;
    dr::Array<UInt32, 4> child;
    UInt32 link;

    WideNodeView(const TreeView<Float> &tree, const UInt32 &node,
                 const dr::mask_t<Float> &active) {
        if constexpr (dr::is_jit_v<Float>) {
            auto lower = tree.template fetch<16>(tree.nodes, 2u * node, active),
                 upper = tree.template fetch<16>(tree.nodes, 2u * node + 1u, active);
            unpack(tree, [&](size_t i) {
                return i < 16 ? lower.entry(i) : upper.entry(i - 16);
            });
        } else {
            const float *data = tree.nodes.data() + kWideNodeFloats * node;
            unpack(tree, [data](size_t i) { return data[i]; });
        }
    }

private:
    template <typename Read> void unpack(const TreeView<Float> &tree, const Read &read) {
        auto four = [&](size_t i) {
            return Four<Float>(read(i), read(i + 1), read(i + 2), read(i + 3));
        };
        using U4 = dr::uint32_array_t<Four<Float>>;
        for (int i = 0; i < 3; ++i)
            clusters.mean[i] = four(4 * i);
        clusters.variance = four(12);
        clusters.flux     = four(16);
        if (tree.directions != Directions::All) {
            U4 axis = dr::reinterpret_array<U4>(four(20));
            for (int i = 0; i < 3; ++i)
                clusters.axis[i] = unpack_axis<Four<Float>>(axis, i);
        }
        for (size_t i = 0; i < 4; ++i)
            child.entry(i) = dr::reinterpret_array<UInt32>(read(24 + i));
        link = dr::reinterpret_array<UInt32>(read(28));
    }
};

/**
 * Probabilities of the four children, proportional to h with a defensive share of the
 * flux. They are positive for every child and sum to 1; an empty slot has 0.
 */
template <typename Float>
dr::Array<Float, 4> child_probabilities(const TreeView<Float> &tree,
                                        const Receiver<Float> &at,
                                        const Clusters<Float> &clusters) {
    Four<Float> h  = cluster_importance(at, clusters, tree.directions);
    Float sum_h    = (h.entry(0) + h.entry(1)) + (h.entry(2) + h.entry(3));
    Float sum_flux = (clusters.flux.entry(0) + clusters.flux.entry(1)) +
                     (clusters.flux.entry(2) + clusters.flux.entry(3));
    /* On top of a light h overflows, very far away it vanishes: then the flux alone decides.
       (A least variance for all clusters, 1e-6 of the scene's extent squared, would do the
       same, but blurs lights: .055 in place of .012 of relative variance where some of them
       are 1e6 times as far away as others, 1.5 in place of .025 at 1e-6 units from one.) */
    auto usable   = sum_h > 1e-30f && sum_h < 1e30f;
    Float share   = dr::select(usable, Float(kDefensiveShare), 1.f);
    Float scale_h = dr::select(usable, (1.f - kDefensiveShare) / sum_h, 0.f);
    Four<Float> q = dr::fmadd(dr::select(usable, h, 0.f), Four<Float>(scale_h),
                              clusters.flux * (share / sum_flux));
    return { q.entry(0), q.entry(1), q.entry(2), q.entry(3) };
}

/// Which child a number in [0, 1) falls on, and the child's interval
template <typename Float> struct ChildChoice {
    dr::uint32_array_t<Float> child;
    Float lower, probability;
};

/// The last child whose interval starts at or below `x` (empty slots are never it)
template <typename Float>
ChildChoice<Float> choose_child(const dr::Array<Float, 4> &q,
                                const dr::Array<dr::uint32_array_t<Float>, 4> &child,
                                const Float &x) {
    ChildChoice<Float> choice{ child.entry(0), Float(0.f), q.entry(0) };
    Float lower = q.entry(0);
    for (size_t i = 1; i < 4; ++i) {
        auto take          = x >= lower && q.entry(i) > 0.f;
        choice.child       = dr::select(take, child.entry(i), choice.child);
        choice.lower       = dr::select(take, lower, choice.lower);
        choice.probability = dr::select(take, q.entry(i), choice.probability);
        lower += q.entry(i);
    }
    return choice;
}

/// Probability that a single random descent from the root ends at `light`
template <typename Float>
Float leaf_probability(const TreeView<Float> &tree, const Receiver<Float> &at,
                       const dr::uint32_array_t<Float> &light,
                       const dr::mask_t<Float> &active) {
    using UInt32 = dr::uint32_array_t<Float>;
    struct State {
        UInt32 link;
        Float probability;
        DRJIT_STRUCT(State, link, probability)
    };

    // Upwards: the product does not care about the order, and parents are stored
    UInt32 link = tree.row(light, active).bits(kLink);
    State state{ dr::select(active, link, kNone), Float(1.f) };
    loop(
        state, [](const State &s) { return s.link != kNone; },
        [&](State &s) {
            WideNodeView<Float> node(tree, s.link >> 2u, true);
            auto q      = child_probabilities(tree, at, node.clusters);
            UInt32 slot = s.link & 3u;
            Float p     = q.entry(0);
            for (uint32_t i = 1; i < 4; ++i)
                p = dr::select(slot == i, q.entry(i), p);
            s.probability *= p;
            s.link = node.link;
        },
        "Light tree: probability of a leaf");
    return state.probability;
}

} // namespace manylights
