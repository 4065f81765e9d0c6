#pragma once

/**
 * The tree as the kernels see it, and the weights that both sampling and its density use:
 * those of the root's grandchildren, and below them those of a node's four children.
 *
 * Conty Estevez, Hellmuth and Lecocq, "A Resampled Tree for Many Lights Rendering",
 * SIGGRAPH Talks 2024, section 2. Candidates are drawn in choice/.
 *
 * All of this works on detached numbers: choices carry no derivative.
 */

#include "cluster_importance.h"
#include "manylights/kinds/row.h"
#include "manylights/learning/visibility.h"
#include "tree_builder.h"
#include <array>
#include <drjit/dynamic.h>
#include <optional>

namespace manylights {

/// Share of a child's probability that follows its flux alone: a light that h
/// over-estimates can then not starve its neighbours
constexpr float kDefensiveShare = .05f;

/// Nodes that \ref TopWeights looks at, and their children
constexpr uint32_t kTopNodes  = 4;
constexpr size_t kTopClusters = 4 * kTopNodes;

/// \ref TreeTop as kernels see it: the same for all receivers
template <typename Float> struct TopView {
    using UInt32 = dr::uint32_array_t<Float>;

    Clusters<Float> clusters[4];
    dr::Array<UInt32, kTopClusters> child;
    UInt32 node[4];
    Float share[4];

    MANYLIGHTS_TRAVERSE(clusters, child, node, share)

    TopView() = default;
    explicit TopView(const TreeTop &top) {
        // Not as literals, which would be compiled anew for each scene
        auto four = [](const float *values) {
            Four<Float> result;
            for (size_t i = 0; i < 4; ++i)
                result.entry(i) = dr::opaque<Float>(values[i]);
            return result;
        };
        for (size_t group = 0; group < 4; ++group) {
            Clusters<Float> &c = clusters[group];
            for (int i = 0; i < 3; ++i) {
                c.mean[i] = four(top.mean[group][i]);
                c.axis[i] = four(top.axis[group][i]);
            }
            c.variance = four(top.variance[group]);
            c.flux     = four(top.flux[group]);
            for (size_t slot = 0; slot < 4; ++slot)
                child.entry(4 * group + slot) =
                    dr::opaque<UInt32>(top.child[group][slot]);
            node[group]  = dr::opaque<UInt32>(top.node[group]);
            share[group] = dr::opaque<Float>(top.share[group]);
        }
    }
};

template <typename Float> struct TreeView {
    using UInt32   = dr::uint32_array_t<Float>;
    using Mask     = dr::mask_t<Float>;
    using FBuffer  = dr::DynamicArray<Float>;
    using Storage  = std::conditional_t<dr::is_jit_v<Float>, Float, FBuffer>;
    using Receiver = manylights::Receiver<Float>;
    using IndexStorage =
        std::conditional_t<dr::is_jit_v<Float>, UInt32, dr::DynamicArray<UInt32>>;

    /// Wide nodes, binary nodes (method `talk` only) and rows of the table
    Storage nodes, binary, rows;
    /// 4 * parent + slot of the wide nodes
    IndexStorage node_links;
    /// How many there are: no literal, so that scenes have one kernel
    UInt32 node_count = 0;
    TopView<Float> top;
    uint32_t light_count = 0;
    /// A power of two that brings the largest flux to [1, 2), and its inverse: importances and
    /// targets are in these units, so that images do not depend on the unit of emission
    Float scale = 1.f, unit = 1.f;
    void set_scale(float value) {
        scale = dr::opaque<Float>(value);
        unit  = dr::opaque<Float>(1.f / value);
    }
    KindSet kinds;
    Directions directions = Directions::All;
    /// What has been learnt of the lights' visibility, null if that is not wanted
    const VisibilityTable<Float> *visibility = nullptr;

    MANYLIGHTS_TRAVERSE(nodes, binary, rows, node_links, node_count, top, scale, unit)

    /// Gather the `Count` floats of entry `index`
    template <size_t Count>
    static dr::Array<Float, Count> fetch(const Storage &buffer, const UInt32 &index,
                                         const Mask &active) {
        if constexpr (dr::is_jit_v<Float>)
            return dr::gather<dr::Array<Float, Count>>(buffer, index, active);
        else
            return dr::load<dr::Array<Float, Count>>(buffer.data() + index * Count);
    }

    UInt32 parent_link(const UInt32 &node) const {
        if constexpr (dr::is_jit_v<Float>)
            return dr::gather<UInt32>(node_links, node);
        else
            return node_links.data()[node];
    }

    /// What has been learnt of a wide node, if anything is learnt at all
    std::optional<ChildVisibility<Float>> child_visibility(const Receiver &at,
                                                           const UInt32 &node) const {
        if (!visibility)
            return {};
        return visibility->children(at.cell, node);
    }

    /// The same for a group at the top (\ref TreeTop), which is in that node: comparable with
    /// those of others, since what is not known of it is that of the `root`'s child
    Four<Float> top_factors(const Receiver &at, const ChildVisibility<Float> &root,
                            const UInt32 &group, const UInt32 &node) const {
        Float above = root.factor(group, Float(1.f));
        return dr::select(node != 0u, visibility->children(at.cell, node).factors(above),
                          Four<Float>(above));
    }

    Row<Float> row(const UInt32 &light, const Mask &active = true) const {
        if constexpr (dr::is_jit_v<Float>)
            return { fetch<kRowFloats>(rows, light, active) };
        else
            return { rows.data() + light * kRowFloats };
    }

    /// The emitter that a row belongs to, without the rest of it
    UInt32 emitter(const UInt32 &light, const Mask &active) const {
        if constexpr (dr::is_jit_v<Float>) {
            UInt32 index = light * (uint32_t) kRowFloats + (uint32_t) kTag;
            return dr::reinterpret_array<UInt32>(
                       dr::gather<Float>(rows, index, active)) >>
                   kTagEmitterShift;
        } else {
            return active ? row(light).emitter() : 0u;
        }
    }
};

/// A wide node, gathered
template <typename Float> struct WideNodeView {
    using UInt32 = dr::uint32_array_t<Float>;

    Clusters<Float> clusters;
    dr::Array<UInt32, 4> child;

    WideNodeView(const TreeView<Float> &tree, const UInt32 &node,
                 const dr::mask_t<Float> &active) {
        if constexpr (dr::is_jit_v<Float>) {
            // What a scene does not need is not read
            auto part = [&](uint32_t i) {
                return tree.template fetch<8>(tree.nodes, 3u * node + i, active);
            };
            dr::Array<Float, 8> data[3] = { part(0), part(1), part(2) };
            unpack(tree, [&](size_t i) { return data[i / 8].entry(i % 8); });
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
        U4 moments        = dr::reinterpret_array<U4>(four(12));
        clusters.flux     = unpack_flux<Four<Float>>(moments);
        clusters.variance = unpack_variance<Four<Float>>(moments);
        for (size_t i = 0; i < 4; ++i)
            child.entry(i) = dr::reinterpret_array<UInt32>(read(16 + i));
        if (tree.directions != Directions::All) {
            U4 axis = dr::reinterpret_array<U4>(four(20));
            for (int i = 0; i < 3; ++i)
                clusters.axis[i] = unpack_axis<Four<Float>>(axis, i);
        }
    }
};

/// Weights of N clusters that are compared with each other: their probabilities are
/// proportional to them
template <typename Float, size_t N> struct ClusterWeights {
    std::array<Float, N> weight;
    /// [0, end[0]) belongs to the first cluster, [end[0], end[1]) to the second, ...
    std::array<Float, N> end;

    Float total() const { return end[N - 1]; }

    /// Put the next four behind the first `count`
    void append(size_t count, const Four<Float> &four) {
        Float sum = count > 0 ? end[count - 1] : Float(0.f);
        for (size_t i = 0; i < 4; ++i) {
            weight[count + i] = four.entry(i);
            sum += four.entry(i);
            end[count + i] = sum;
        }
    }
};

/**
 * Weight h with a defensive share of the flux, where all weights that are compared have a sum
 * of h of `importance`. They are positive for every child, and 0 for an empty slot.
 */
template <typename Float>
Four<Float> defensive_weights(const Four<Float> &flux, const Four<Float> &h,
                              const Float &importance) {
    /* On top of a light h overflows, very far away it vanishes: then the flux alone decides.
       A least variance for all clusters would do the same, but blur lights that are near. */
    auto usable = importance > 1e-30f && importance < 1e30f;
    // A power of two brings the sum to [1, 2): small shares of the flux would vanish
    using UInt32 = dr::uint32_array_t<Float>;
    Float scale  = dr::reinterpret_array<Float>(
        0x7f000000u - (dr::reinterpret_array<UInt32>(importance) & 0x7f800000u));
    Float share = dr::select(
        usable, importance * scale * (kDefensiveShare / (1.f - kDefensiveShare)),
        Float(1.f));
    return dr::fmadd(flux, Four<Float>(share), dr::select(usable, h * scale, 0.f));
}

/// The entry of that number
template <typename Float>
Float pick(const Four<Float> &v, const dr::uint32_array_t<Float> &slot) {
    Float result = v.entry(0);
    for (uint32_t i = 1; i < 4; ++i)
        result = dr::select(slot == i, Float(v.entry(i)), result);
    return result;
}

/// Of all four entries
template <typename Float> Float sum_of(const Four<Float> &v) {
    return (v.entry(0) + v.entry(1)) + (v.entry(2) + v.entry(3));
}

/// The weights of a node's children
template <typename Float>
ClusterWeights<Float, 4>
child_weights(const TreeView<Float> &tree, const Receiver<Float> &at,
              const Clusters<Float> &clusters,
              const std::optional<ChildVisibility<Float>> &visibility) {
    Four<Float> h      = cluster_importance(at, clusters, tree.directions);
    Four<Float> weight = defensive_weights<Float>(clusters.flux, h, sum_of<Float>(h));
    if (visibility)
        weight *= visibility->factors();
    ClusterWeights<Float, 4> result;
    result.append(0, weight);
    return result;
}

/// The child on which a number falls
template <typename Float> struct ChildChoice {
    dr::uint32_array_t<Float> child, slot;
    Float begin, weight;
};

/// The last child that starts at or below `x` < total: never an empty slot, where both its
/// ends are the total or those of the child before it
template <typename Float, size_t N>
ChildChoice<Float> choose_child(const ClusterWeights<Float, N> &weights,
                                const dr::Array<dr::uint32_array_t<Float>, N> &child,
                                const Float &x) {
    using UInt32 = dr::uint32_array_t<Float>;
    ChildChoice<Float> choice{ child.entry(0), 0u, Float(0.f), weights.weight[0] };
    for (size_t i = 1; i < N; ++i) {
        auto take     = x >= weights.end[i - 1];
        choice.child  = dr::select(take, child.entry(i), choice.child);
        choice.slot   = dr::select(take, UInt32((uint32_t) i), choice.slot);
        choice.begin  = dr::select(take, weights.end[i - 1], choice.begin);
        choice.weight = dr::select(take, weights.weight[i], choice.weight);
    }
    return choice;
}

/**
 * Weights of the root's grandchildren, all compared with each other, once for each receiver:
 * descents begin below them. The sums are written into the receiver, for the density.
 *
 * Large clusters are those of which h knows least: a root of four children like all other nodes
 * has more variance, and a sample takes longer.
 */
template <typename Float> struct TopWeights : ClusterWeights<Float, kTopClusters> {
    using UInt32 = dr::uint32_array_t<Float>;

    /// What has been learnt of the root's children
    std::optional<ChildVisibility<Float>> root;

    TopWeights() = default;
    TopWeights(const TreeView<Float> &tree, Receiver<Float> &at)
        : root(tree.child_visibility(at, UInt32(0))) {
        Four<Float> h[4];
        Float importance(0.f);
        for (size_t group = 0; group < 4; ++group) {
            h[group] = cluster_importance(at, tree.top.clusters[group], tree.directions);
            importance += sum_of<Float>(h[group]);
        }
        for (size_t group = 0; group < 4; ++group) {
            Four<Float> w = defensive_weights<Float>(tree.top.clusters[group].flux,
                                                     h[group], importance);
            if (root)
                w *= tree.top_factors(at, *root, UInt32((uint32_t) group),
                                      tree.top.node[group]);
            this->append(4 * group, w);
        }
        at.top_importance = importance;
        at.top_total      = this->total();
    }
};

/// Probability that a single random descent from the root ends at `light`
template <typename Float>
Float leaf_probability(const TreeView<Float> &tree, const Receiver<Float> &at,
                       const dr::uint32_array_t<Float> &light,
                       const dr::mask_t<Float> &active) {
    using UInt32 = dr::uint32_array_t<Float>;
    using Mask   = dr::mask_t<Float>;
    struct State {
        /// Where the light or a node above it hangs, and the same of that node
        UInt32 link, above;
        Float probability;
        Mask active;
        DRJIT_STRUCT(State, link, above, probability, active)
    };

    // Upwards: the product does not care about the order, and parents are stored
    UInt32 link = dr::select(active, tree.row(light, active).bits(kLink), 0u);
    State state{ link, tree.parent_link(link >> 2u), Float(1.f), active };
    auto root_visibility = tree.child_visibility(at, UInt32(0));
    loop(
        state, [](const State &s) { return s.active; },
        [&](State &s) {
            // Look at the node where the light, or the node below, hangs
            UInt32 index = s.link >> 2u, slot = s.link & 3u;
            WideNodeView<Float> node(tree, index, true);
            // The root's grandchildren are compared with each other: their fluxes are parts of
            // that of the whole tree
            Mask root = index == 0u, top = root || s.above < 4u;
            Float share(1.f);
            for (uint32_t i = 0; i < 4; ++i)
                share = dr::select(!root && s.above == i, tree.top.share[i], share);
            node.clusters.flux *= share;
            // Weigh the children as the descent does
            Four<Float> h      = cluster_importance(at, node.clusters, tree.directions);
            Four<Float> weight = defensive_weights<Float>(
                node.clusters.flux, h,
                dr::select(top, at.top_importance, sum_of<Float>(h)));
            if (root_visibility)
                weight *= tree.top_factors(at, *root_visibility,
                                           dr::select(root, slot, s.above & 3u), index);
            // Multiply with the probability of this child, and go up
            Float total = dr::select(top, at.top_total, sum_of<Float>(weight));
            s.probability *= pick<Float>(weight, slot) / total;
            s.active &= !top;
            s.link  = s.above;
            s.above = tree.parent_link(dr::select(s.active, s.above >> 2u, 0u));
        },
        "Light tree: probability of a leaf");
    return state.probability;
}

/// Count a shadow ray to `light` in the records of all nodes above it
template <typename Float>
void count_ray(const TreeView<Float> &tree, const dr::uint32_array_t<Float> &cell,
               const dr::uint32_array_t<Float> &light, const dr::mask_t<Float> &arrived,
               const dr::mask_t<Float> &traced) {
    using UInt32 = dr::uint32_array_t<Float>;
    struct State {
        UInt32 link;
        DRJIT_STRUCT(State, link)
    };

    auto active = traced && tree.visibility->counting();
    UInt32 link = tree.row(light, active).bits(kLink);
    State state{ dr::select(active, link, kNone) };
    loop(
        state, [](const State &s) { return s.link != kNone; },
        [&](State &s) {
            UInt32 node = s.link >> 2u;
            tree.visibility->count(cell, node, s.link & 3u, arrived, s.link != kNone);
            s.link = tree.parent_link(node);
        },
        "Light tree: visibility");
}

} // namespace manylights
