#pragma once

/**
 * Builds the light tree: light bounds -> binary tree -> 4-wide nodes.
 *
 * The split minimizes the surface-area-orientation cost of Conty Estevez and Kulla,
 * "Importance Sampling of Many Lights with Adaptive Tree Splitting" (2018), section 4.4,
 * over 16 bins on each axis. Two departures:
 *
 * - M_A is the area of the box plus its squared diagonal: a string of lights has no
 *   area, and every split of it would cost the same.
 * - M_Omega is 4 - 3 |mean emission axis| (in units of pi): the same values as the
 *   bounding cone's for aligned emitters and for all directions (1 and 4), and a sum
 *   over the lights, so that bins are merged without trigonometry.
 *
 * Where the cost cannot decide (coincident lights) and below a depth of 64, the range
 * is halved, so the depth is bounded. The same input gives the same tree, bit for bit,
 * with any number of threads.
 *
 * Plain C++: compiled once for all variants.
 */

#include "manylights/base/host_memory.h"
#include "manylights/kinds/light_row.h"
#include <functional>

namespace manylights {

/**
 * A node of the default tree: the moments of its four children, as a structure of
 * arrays so that one packet gather brings the same quantity of all four. Children are
 * stored behind their parents.
 */
struct WideNode {
    /// Flux-weighted mean position of each child
    float mean[3][4];
    /// Flux as a fraction of the node's, 0 in an empty slot, and flux-weighted variance of the
    /// position (trace / 3), the lights' extents included: see \ref pack_moments
    uint32_t moments[4];
    /// Index of the child node, or kLeafBit | light, or 0 in an empty slot
    uint32_t child[4];
    /// Flux-weighted mean emission axis, see \ref pack_axis
    uint32_t axis[4];
};

/// Three packets of eight floats: a fourth would take a tenth of the time of a visit
constexpr size_t kWideNodeFloats = 24;
static_assert(sizeof(WideNode) == kWideNodeFloats * sizeof(float));

/// Marks a child that is a light
constexpr uint32_t kLeafBit = 0x80000000u;

/**
 * The top of the tree: the root's grandchildren, unpacked, in four groups of four. A light
 * that hangs at the root is alone in its group.
 */
struct TreeTop {
    float mean[4][3][4], variance[4][4], axis[4][3][4];
    /// As a fraction of the whole tree's, 0 in an empty slot
    float flux[4][4];
    uint32_t child[4][4];
    /// Node that the group is in (0: the root), and its fraction of the flux
    uint32_t node[4];
    float share[4];
};

/**
 * A node of the binary tree that the method `talk` walks, in depth-first order: the left
 * child is the next node. `escape` is the node that follows this whole subtree.
 */
struct BinaryNode {
    float box_min[3], box_max[3];
    float mean[3], variance, flux;
    uint32_t axis;
    /// Right child (kNone for a leaf), the node after the subtree (kNone for the end),
    /// the light (leaf only), the first light of the subtree
    uint32_t right, escape, light, first;
};

constexpr size_t kBinaryNodeFloats = 16;
static_assert(sizeof(BinaryNode) == kBinaryNodeFloats * sizeof(float));

/// The tree, and the order of the lights that it implies
struct LightTree {
    /// Nodes of the wide tree, in the caller's memory
    uint32_t wide_count = 0;
    /// node_link[i] = 4 * parent + slot at which wide node i hangs, kNone for the root
    HostVector<uint32_t> node_link;
    std::vector<BinaryNode> binary;
    /// order[i] is the input index of light i: leaves are numbered in tree order
    HostVector<uint32_t> order;
    /// link[i] = 4 * node + slot at which light i hangs in the wide tree
    HostVector<uint32_t> link;
    /// Levels of the wide tree, 0 without lights
    uint32_t depth = 0;
};

/// Returns memory for that many nodes
using NodeMemory = std::function<WideNode *(size_t)>;

/**
 * Build the tree over `lights`, all of which must have finite bounds and a positive,
 * finite flux; their memory is used up. The wide nodes go to where `memory` says, which
 * is called if there are any. `keep_binary` also keeps the binary nodes (method `talk`).
 */
LightTree build_tree(HostVector<LightBounds> &&lights, const NodeMemory &memory,
                     bool keep_binary);

/**
 * Fill a tree from the bottom up, after building it or after a change of fluxes: leaves keep
 * their mean, variance and axis, all other slots get the moments of the nodes below them.
 * `flux` has an entry for each light, positive, in any unit.
 */
void refit_tree(WideNode *nodes, size_t count, const HostVector<float> &flux);

/// Read the top of a tree that has nodes
TreeTop read_top(const WideNode *nodes);

/// Upper halves of two floats, rounded to nearest: flux (never rounded to 0) and variance
uint32_t pack_moments(float flux, float variance);

template <typename Value> Value unpack_flux(const drjit::uint32_array_t<Value> &packed) {
    return drjit::reinterpret_array<Value>(packed & 0xffff0000u);
}
template <typename Value>
Value unpack_variance(const drjit::uint32_array_t<Value> &packed) {
    return drjit::reinterpret_array<Value>(packed << 16);
}

/// Quantize a vector of length <= 1 to three signed numbers of 10 bits, in units of 1/511
uint32_t pack_axis(const float axis[3]);

/// One of its coordinates
template <typename Value>
Value unpack_axis(const drjit::uint32_array_t<Value> &packed, int coordinate) {
    // Shifted up without a sign, where no bit is one too many, and down with it
    auto upper = drjit::reinterpret_array<drjit::int32_array_t<Value>>(
        packed << (22 - 10 * coordinate));
    return Value(upper >> 22) * (1.f / 511.f);
}

} // namespace manylights
