#include "tree_builder.h"

#include <algorithm>
#include <array>
#include <cfloat>
#include <cmath>
#include <drjit/packet.h>
#include <limits>
#include <nanothread/nanothread.h>

namespace manylights {

namespace dr = drjit;

namespace {

/// One SIMD register
using Float4 = dr::Packet<float, 4>;
using Int4   = dr::Packet<int32_t, 4>;

constexpr uint32_t kBins = 16;
/// Below this depth ranges are halved; it bounds the recursion of degenerate inputs
constexpr uint32_t kMaxCostDepth = 64;
/// Subtrees of more lights are built by tasks of their own
constexpr uint32_t kTaskLights = 1 << 14;

/// Threads differ in what they do with denormals: the result must not
float to_float(double x) { return std::abs(x) < (double) FLT_MIN ? 0.f : (float) x; }

/// Factor of the flux while it is summed up: far from the denormals
constexpr float kFluxScale = 0x1p60f;

/// A light while it is sorted: one cache line
struct alignas(64) Item {
    /// Box, with flux and variance in the fourth lanes
    Float4 low, high;
    /// Mean position, and the bits of the light's index
    Float4 mean;
    /// Scaled flux times axis, and scaled flux
    Float4 weight;

    float flux() const { return low[3]; }
    float variance() const { return high[3]; }
    uint32_t light() const { return dr::reinterpret_array<uint32_t>(mean[3]); }
};

/// flux * M_A * M_Omega, the cost of a cluster (see the header for both measures)
template <typename Box>
double cluster_cost(const Box &low, const Box &high, double flux, double axis_length) {
    double x    = std::max(0.0, (double) high[0] - low[0]),
           y    = std::max(0.0, (double) high[1] - low[1]),
           z    = std::max(0.0, (double) high[2] - low[2]);
    double area = 2 * (x * y + y * z + z * x) + x * x + y * y + z * z;
    return area * (4 * flux - 3 * axis_length);
}

/// All that the cost of a set of lights depends on
struct Bin {
    Float4 low    = std::numeric_limits<float>::infinity();
    Float4 high   = -std::numeric_limits<float>::infinity();
    Float4 weight = 0.f;

    template <typename Other> void add(const Other &other) {
        low  = dr::minimum(low, other.low);
        high = dr::maximum(high, other.high);
        weight += other.weight;
    }
    bool empty() const { return !(weight[3] > 0); }
    double cost() const {
        if (empty())
            return 0;
        double x = weight[0], y = weight[1], z = weight[2];
        return cluster_cost(low, high, weight[3], std::sqrt(x * x + y * y + z * z));
    }
};

/// Box of the lights' mean positions
struct Centroids {
    Float4 low  = std::numeric_limits<float>::infinity();
    Float4 high = -std::numeric_limits<float>::infinity();

    void add(const Item &item) {
        low  = dr::minimum(low, item.mean);
        high = dr::maximum(high, item.mean);
    }
};

/// Everything that a cluster contributes to the node above it
struct Cluster {
    float box_min[3], box_max[3];
    float mean[3], variance, flux, axis[3];
    float cost;
};

/// Two clusters as one: flux-weighted means, and the variance of the union
Cluster join(const Cluster &a, const Cluster &b) {
    Cluster c;
    double flux = (double) a.flux + b.flux, share = b.flux / flux, distance2 = 0,
           length2 = 0;
    auto mix       = [share](float x, float y) { return x + share * ((double) y - x); };
    for (int i = 0; i < 3; ++i) {
        c.box_min[i] = std::min(a.box_min[i], b.box_min[i]);
        c.box_max[i] = std::max(a.box_max[i], b.box_max[i]);
        c.mean[i]    = to_float(mix(a.mean[i], b.mean[i]));
        c.axis[i]    = to_float(mix(a.axis[i], b.axis[i]));
        double step  = (double) b.mean[i] - a.mean[i];
        distance2 += step * step;
        length2 += (double) c.axis[i] * c.axis[i];
    }
    c.flux     = (float) flux;
    c.variance = to_float(mix(a.variance, b.variance) +
                          share * (1 - share) * distance2 * (1.0 / 3));
    c.cost =
        to_float(cluster_cost(c.box_min, c.box_max, flux, flux * std::sqrt(length2)));
    return c;
}

/// The lights [begin, end) and, if there are two or more, the node above them
struct Subtree {
    uint32_t begin, end, node;

    uint32_t count() const { return end - begin; }
    bool is_leaf() const { return count() == 1; }
    /// A subtree of n lights has n - 1 nodes, in depth-first order
    Subtree left(uint32_t middle) const { return { begin, middle, node + 1 }; }
    Subtree right(uint32_t middle) const {
        return { middle, end, node + middle - begin };
    }
};

/// Interior node of the binary tree
struct Node {
    Cluster cluster;
    /// First light of the right child
    uint32_t middle;
};

class Builder {
public:
    explicit Builder(const std::vector<LightBounds> &lights) : m_items(lights.size()) {
        double flux = 0;
        for (uint32_t i = 0; i < (uint32_t) lights.size(); ++i) {
            m_items[i] = make_item(lights[i], i);
            m_centroids.add(m_items[i]);
            flux += lights[i].flux;
        }
        for (size_t i = 0; i < lights.size(); ++i) {
            Item &item = m_items[i];
            // A positive weight is a promise that the light can be chosen
            item.low[3]  = std::max((float) (lights[i].flux / flux), FLT_MIN);
            item.high[3] = lights[i].variance;
            item.weight =
                Float4(lights[i].axis[0], lights[i].axis[1], lights[i].axis[2], 1.f) *
                (item.low[3] * kFluxScale);
        }
        m_nodes.resize(lights.empty() ? 0 : lights.size() - 1);
    }

    LightTree build(bool keep_binary) {
        LightTree tree;
        uint32_t count = (uint32_t) m_items.size();
        if (count == 0)
            return tree;
        Subtree root{ 0, count, 0 };
        split(root, m_centroids, 0);
        tree.order.resize(count);
        for (uint32_t i = 0; i < count; ++i)
            tree.order[i] = m_items[i].light();
        tree.link.assign(count, kNone);
        tree.wide.reserve(count / 2 + 1);
        collapse(tree, root, kNone, 1);
        if (keep_binary) {
            tree.binary.reserve(2 * (size_t) count - 1);
            write_binary(tree.binary, root);
        }
        return tree;
    }

private:
    static Item make_item(const LightBounds &light, uint32_t index) {
        auto three = [](const float *v, float w) { return Float4(v[0], v[1], v[2], w); };
        return { three(light.box_min, 0.f), three(light.box_max, 0.f),
                 three(light.mean, dr::reinterpret_array<float>(index)), Float4(0.f) };
    }

    static Cluster leaf_cluster(const Item &item) {
        Cluster c;
        for (int i = 0; i < 3; ++i) {
            c.box_min[i] = item.low[i];
            c.box_max[i] = item.high[i];
            c.mean[i]    = item.mean[i];
            c.axis[i]    = item.weight[i] / item.weight[3];
        }
        c.variance = item.variance();
        c.flux     = item.flux();
        c.cost     = 0;
        return c;
    }

    Cluster cluster(const Subtree &tree) const {
        return tree.is_leaf() ? leaf_cluster(m_items[tree.begin])
                              : m_nodes[tree.node].cluster;
    }

    // ---------------------------------------------------------------------- Binary tree

    /// Sort the lights of a subtree and fill its nodes
    void split(const Subtree &tree, const Centroids &centroids, uint32_t depth) {
        if (tree.is_leaf())
            return;
        Centroids left_centroids, right_centroids;
        uint32_t middle = tree.begin;
        if (tree.count() == 2)
            sort_pair(m_items[tree.begin], m_items[tree.begin + 1]);
        else if (depth < kMaxCostDepth)
            middle = partition(tree, centroids, left_centroids, right_centroids);
        if (middle == tree.begin || middle == tree.end) {
            middle         = tree.begin + tree.count() / 2;
            left_centroids = right_centroids = centroids;
        }

        Subtree left = tree.left(middle), right = tree.right(middle);
        auto split_left = [&] { split(left, left_centroids, depth + 1); };
        // Both halves write to places of their own: the result does not depend on threads
        if (left.count() > kTaskLights && right.count() > kTaskLights) {
            Task *task = drjit::do_async(split_left);
            split(right, right_centroids, depth + 1);
            task_wait_and_release(task);
        } else {
            split_left();
            split(right, right_centroids, depth + 1);
        }
        m_nodes[tree.node] = { join(cluster(left), cluster(right)), middle };
    }

    /// Two lights lie in the order of their coordinates, whatever the input's order was
    static void sort_pair(Item &a, Item &b) {
        for (int axis = 0; axis < 3; ++axis) {
            if (a.mean[axis] != b.mean[axis]) {
                if (a.mean[axis] > b.mean[axis])
                    std::swap(a, b);
                return;
            }
        }
    }

    /// A plane between two bins: lights in bins below `bin` lie to its left
    struct Plane {
        int axis    = -1;
        int32_t bin = 0;
        double cost = std::numeric_limits<double>::infinity();
    };

    /// How mean positions are mapped to bins; an axis without extent has scale 0
    struct Grid {
        Float4 low, scale;
        uint32_t bins;

        /// Few lights need few bins: most subtrees are small
        Grid(const Centroids &centroids, uint32_t lights)
            : low(centroids.low), scale(0.f), bins(std::clamp(lights, 4u, kBins)) {
            Float4 extent = centroids.high - centroids.low;
            float longest = std::max({ extent[0], extent[1], extent[2] });
            for (int i = 0; i < 3; ++i)
                if (extent[i] > 1e-6f * longest && extent[i] > 1e-30f)
                    scale[i] = (float) bins / extent[i];
        }
        Int4 bin(const Item &item) const {
            return dr::minimum(Int4((item.mean - low) * scale), (int32_t) bins - 1);
        }
    };

    /// Reorder a subtree's lights along the cheapest plane; its begin if there is none
    uint32_t partition(const Subtree &tree, const Centroids &centroids,
                       Centroids &left_centroids, Centroids &right_centroids) {
        Grid grid(centroids, tree.count());
        Plane plane = cheapest_plane(tree, grid);
        if (plane.axis < 0)
            return tree.begin;
        uint32_t left = tree.begin, right = tree.end;
        while (left < right) {
            Item &item = m_items[left];
            if (grid.bin(item)[plane.axis] < plane.bin) {
                left_centroids.add(item);
                ++left;
            } else {
                right_centroids.add(item);
                std::swap(item, m_items[--right]);
            }
        }
        return left;
    }

    Plane cheapest_plane(const Subtree &tree, const Grid &grid) const {
        Bin bins[3][kBins];
        for (uint32_t i = tree.begin; i < tree.end; ++i) {
            Int4 bin = grid.bin(m_items[i]);
            for (int axis = 0; axis < 3; ++axis)
                bins[axis][bin[axis]].add(m_items[i]);
        }

        float widest = dr::max(grid.scale);
        for (int axis = 0; axis < 3; ++axis)
            if (grid.scale[axis] > 0)
                widest = std::min(widest, grid.scale[axis]);
        Plane best;
        for (int axis = 0; axis < 3; ++axis) {
            if (grid.scale[axis] == 0)
                continue;
            // Conty and Kulla's factor against thin slabs: longest extent / this extent
            sweep(bins[axis], grid.bins, (double) grid.scale[axis] / widest, axis, best);
        }
        return best;
    }

    /// Lowest sum of the two sides' costs
    static void sweep(const Bin *bins, uint32_t count, double factor, int axis,
                      Plane &best) {
        std::array<double, kBins> right_cost;
        Bin side;
        for (uint32_t i = count - 1; i > 0; --i) {
            side.add(bins[i]);
            right_cost[i] = side.cost();
        }
        side = Bin();
        for (uint32_t i = 1; i < count; ++i) {
            if (bins[i - 1].empty())
                continue;
            side.add(bins[i - 1]);
            double cost = factor * (side.cost() + right_cost[i]);
            if (cost < best.cost)
                best = { axis, (int32_t) i, cost };
        }
    }

    // ------------------------------------------------------------------------ Wide tree

    /// Write the wide node of a subtree; returns its index
    uint32_t collapse(LightTree &tree, const Subtree &root, uint32_t link,
                      uint32_t depth) const {
        std::array<Subtree, 4> children{ root };
        uint32_t count = open_children(children);

        uint32_t index = (uint32_t) tree.wide.size();
        tree.wide.emplace_back();
        tree.node_link.push_back(link);
        WideNode node;
        double flux = 0;
        for (uint32_t slot = 0; slot < count; ++slot)
            flux += cluster(children[slot]).flux;
        tree.depth = std::max(tree.depth, depth);
        for (uint32_t slot = 0; slot < count; ++slot) {
            const Subtree &child = children[slot];
            write_child(node, slot, cluster(child), flux);
            if (child.is_leaf()) {
                node.child[slot]       = kLeafBit | child.begin;
                tree.link[child.begin] = 4 * index + slot;
            } else {
                node.child[slot] = collapse(tree, child, 4 * index + slot, depth + 1);
            }
        }
        for (uint32_t slot = count; slot < 4; ++slot)
            write_empty(node, slot);
        tree.wide[index] = node;
        return index;
    }

    /// Replace the costliest interior entry by its two children until there are four
    uint32_t open_children(std::array<Subtree, 4> &children) const {
        uint32_t count = 1;
        while (count < 4) {
            int worst = -1;
            for (uint32_t i = 0; i < count; ++i)
                if (!children[i].is_leaf() &&
                    (worst < 0 || costlier(children[i], children[worst])))
                    worst = (int) i;
            if (worst < 0)
                break;
            // Keep the leaves' order: the right child goes directly behind the left one
            Subtree opened = children[worst];
            for (uint32_t i = count; i > (uint32_t) worst + 1; --i)
                children[i] = children[i - 1];
            uint32_t middle     = m_nodes[opened.node].middle;
            children[worst]     = opened.left(middle);
            children[worst + 1] = opened.right(middle);
            ++count;
        }
        return count;
    }

    /// By cost; coincident lights cost nothing and are opened by flux
    bool costlier(const Subtree &a, const Subtree &b) const {
        const Cluster &x = m_nodes[a.node].cluster, &y = m_nodes[b.node].cluster;
        return x.cost != y.cost ? x.cost > y.cost : x.flux > y.flux;
    }

    static void write_child(WideNode &node, uint32_t slot, const Cluster &cluster,
                            double node_flux) {
        for (int i = 0; i < 3; ++i)
            node.mean[i][slot] = cluster.mean[i];
        node.moments[slot] =
            pack_moments((float) (cluster.flux / node_flux), cluster.variance);
        node.axis[slot] = pack_axis(cluster.axis);
    }

    /// As far away as another child, and without flux
    static void write_empty(WideNode &node, uint32_t slot) {
        for (int i = 0; i < 3; ++i)
            node.mean[i][slot] = node.mean[i][0];
        node.moments[slot] = node.moments[0] & 0xffffu;
        node.child[slot]   = node.child[0];
        node.axis[slot]    = node.axis[0];
    }

    /// Append the nodes of a subtree, leaves included
    void write_binary(std::vector<BinaryNode> &nodes, const Subtree &tree) const {
        Cluster c = cluster(tree);
        BinaryNode node{};
        std::copy_n(c.box_min, 3, node.box_min);
        std::copy_n(c.box_max, 3, node.box_max);
        std::copy_n(c.mean, 3, node.mean);
        node.variance  = c.variance;
        node.flux      = c.flux;
        node.axis      = pack_axis(c.axis);
        node.first     = tree.begin;
        node.right     = kNone;
        node.light     = tree.is_leaf() ? tree.begin : kNone;
        uint32_t index = (uint32_t) nodes.size(),
                 most  = 2 * (uint32_t) m_items.size() - 1;
        node.escape    = index + 2 * tree.count() - 1;
        if (node.escape == most)
            node.escape = kNone;
        if (!tree.is_leaf()) {
            uint32_t middle = m_nodes[tree.node].middle;
            Subtree left    = tree.left(middle);
            node.right      = index + 2 * left.count();
            nodes.push_back(node);
            write_binary(nodes, left);
            write_binary(nodes, tree.right(middle));
        } else {
            nodes.push_back(node);
        }
    }

    std::vector<Item> m_items;
    std::vector<Node> m_nodes;
    Centroids m_centroids;
};

} // namespace

LightTree build_tree(const std::vector<LightBounds> &lights, bool keep_binary) {
    return Builder(lights).build(keep_binary);
}

uint32_t pack_moments(float flux, float variance) {
    auto upper = [](float x) { // no overflow: up to the largest such number
        uint32_t bits = dr::reinterpret_array<uint32_t>(std::min(x, 0x1.fep127f));
        return (bits + 0x8000u) >> 16;
    };
    return upper(flux > 0 ? std::max(flux, FLT_MIN) : 0.f) << 16 | upper(variance);
}

uint32_t pack_axis(const float axis[3]) {
    uint32_t result = 0;
    for (int i = 0; i < 3; ++i) {
        float clamped = std::clamp(axis[i], -1.f, 1.f);
        result |= ((uint32_t) std::lround(clamped * 511.f) & 1023u) << (10 * i);
    }
    return result;
}

} // namespace manylights
