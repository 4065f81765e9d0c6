#include "tree_builder.h"

#include <algorithm>
#include <array>
#include <cfloat>
#include <cmath>
#include <drjit/packet.h>
#include <limits>

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
/// Subtrees of no more lights get the wide nodes of the least price
constexpr uint32_t kPackedLights = 16;

/// Threads differ in what they do with denormals: the result must not
float to_float(double x) { return std::abs(x) < (double) FLT_MIN ? 0.f : (float) x; }

/// Flux as a fraction of the sum. A positive weight is a promise that a light can be chosen
float flux_share(float flux, double sum) {
    return std::max((float) (flux / sum), FLT_MIN);
}

/// Factor of the flux while it is summed up: far from the denormals
constexpr float kFluxScale = 0x1p60f;

/// Four numbers of a light at once; the fourth lane is whatever lies there
Float4 four(const float *numbers) { return dr::load_aligned<Float4>(numbers); }

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
    Float4 low, high, weight;

    void clear() {
        low    = std::numeric_limits<float>::infinity();
        high   = -std::numeric_limits<float>::infinity();
        weight = 0.f;
    }
    void add(const Float4 &other_low, const Float4 &other_high,
             const Float4 &other_weight) {
        low  = dr::minimum(low, other_low);
        high = dr::maximum(high, other_high);
        weight += other_weight;
    }
    void add(const Bin &other) { add(other.low, other.high, other.weight); }
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

    void add(const Float4 &other_low, const Float4 &other_high) {
        low  = dr::minimum(low, other_low);
        high = dr::maximum(high, other_high);
    }
    void add(const LightBounds &light) { add(four(light.mean), four(light.mean)); }
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

/// Interior node of the binary tree: what decides how it is collapsed
struct Node {
    float cost, flux;
    /// First light of the right child
    uint32_t middle;
    /// Wide nodes of this subtree, if one begins here
    uint32_t wide_count;
    /// Least price of the wide nodes of a small subtree that fills at most 1, 2 or 3 slots
    std::array<float, 3> price;
};

/// What of a subtree decides how its wide nodes are chosen; that of a leaf is 0
struct Prices {
    std::array<float, 3> left, right;

    /// The least one if its halves together fill at most `slots`, and how many the left one
    std::pair<float, uint32_t> open(uint32_t slots) const {
        std::pair<float, uint32_t> best{ std::numeric_limits<float>::infinity(), 0 };
        for (uint32_t i = 1; i < slots; ++i)
            if (float sum = left[i - 1] + right[slots - i - 1]; sum < best.first)
                best = { sum, i };
        return best;
    }
};

/// Prices of both halves of a subtree
Prices halves_of(const Subtree &tree, uint32_t middle, const HostVector<Node> &nodes) {
    auto of = [&](const Subtree &half) {
        return half.is_leaf() ? std::array<float, 3>{} : nodes[half.node].price;
    };
    return { of(tree.left(middle)), of(tree.right(middle)) };
}

/// The cluster of one light
Cluster leaf_cluster(const LightBounds &light) {
    Cluster c;
    for (int i = 0; i < 3; ++i) {
        c.box_min[i] = light.box_min[i];
        c.box_max[i] = light.box_max[i];
        c.mean[i]    = light.mean[i];
        c.axis[i]    = light.axis[i] / light.weight;
    }
    c.variance = light.variance;
    c.flux     = light.weight / kFluxScale;
    c.cost     = 0;
    return c;
}

/// Sorts lights into a binary tree
class BinaryTree {
public:
    explicit BinaryTree(HostVector<LightBounds> &&lights) : m_lights(std::move(lights)) {
        size_t chunks = chunk_count(m_lights.size());
        std::vector<double> flux(chunks, 0.0);
        std::vector<Centroids> centroids(chunks);
        for_chunks(m_lights.size(), [&](size_t chunk, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i) {
                m_lights[i].light = (uint32_t) i;
                centroids[chunk].add(m_lights[i]);
                flux[chunk] += m_lights[i].flux;
            }
        });
        double sum = 0;
        for (size_t i = 0; i < chunks; ++i) {
            sum += flux[i];
            m_centroids.add(centroids[i].low, centroids[i].high);
        }
        for_chunks(m_lights.size(), [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i)
                normalize(m_lights[i], sum);
        });
        m_nodes.resize(m_lights.empty() ? 0 : m_lights.size() - 1);
    }

    const HostVector<LightBounds> &lights() const { return m_lights; }
    HostVector<Node> &nodes() { return m_nodes; }

    /// Sort all lights and fill the nodes
    void split(const Subtree &root) { split(root, m_centroids, 0); }

    /// Fluxes in the order of the leaves; the rest of the lights is given back
    HostVector<float> take_flux() {
        HostVector<float> flux(m_lights.size());
        for_chunks(flux.size(), [&](size_t, size_t begin, size_t end) {
            for (size_t i = begin; i < end; ++i)
                flux[i] = m_lights[i].flux;
        });
        HostVector<LightBounds>().swap(m_lights);
        HostVector<Node>().swap(m_nodes);
        return flux;
    }

private:
    /// Weight the axis with the flux as a fraction of the sum
    static void normalize(LightBounds &light, double sum) {
        light.weight = flux_share(light.flux, sum) * kFluxScale;
        for (float &coordinate : light.axis)
            coordinate *= light.weight;
    }

    /// Sort the lights of a subtree and fill its nodes; returns its cluster
    Cluster split(const Subtree &tree, const Centroids &centroids, uint32_t depth) {
        if (tree.is_leaf())
            return leaf_cluster(m_lights[tree.begin]);
        Centroids left_centroids, right_centroids;
        uint32_t middle = tree.begin;
        if (tree.count() == 2)
            sort_pair(m_lights[tree.begin], m_lights[tree.begin + 1]);
        else if (depth < kMaxCostDepth)
            middle = partition(tree, centroids, left_centroids, right_centroids);
        if (middle == tree.begin || middle == tree.end) {
            middle         = tree.begin + tree.count() / 2;
            left_centroids = right_centroids = centroids;
        }

        Subtree left = tree.left(middle), right = tree.right(middle);
        Cluster left_cluster, right_cluster;
        auto split_left = [&] { left_cluster = split(left, left_centroids, depth + 1); };
        // Both halves write to places of their own: the result does not depend on threads
        Tasks tasks;
        if (left.count() > kTaskLights && right.count() > kTaskLights)
            tasks.start(split_left);
        else
            split_left();
        right_cluster = split(right, right_centroids, depth + 1);
        tasks.wait();
        Cluster c          = join(left_cluster, right_cluster);
        m_nodes[tree.node] = { c.cost, c.flux, middle, 0, prices(tree, middle, c.flux) };
        return c;
    }

    /**
     * That of a wide node is how often descents come to it where lights are chosen by flux, and
     * a little for itself: the memory that it takes pushes others out of caches.
     */
    std::array<float, 3> prices(const Subtree &tree, uint32_t middle, float flux) const {
        if (tree.count() > kPackedLights)
            return {};
        Prices halves = halves_of(tree, middle, m_nodes);
        float node    = flux + 1.f / (float) m_lights.size() + halves.open(4).first;
        return { node, std::min(node, halves.open(2).first),
                 std::min(node, halves.open(3).first) };
    }

    /// Two lights lie in the order of their coordinates, whatever the input's order was
    static void sort_pair(LightBounds &a, LightBounds &b) {
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
        Int4 bin(const LightBounds &light) const {
            return dr::minimum(Int4((four(light.mean) - low) * scale),
                               (int32_t) bins - 1);
        }
        /// Is its bin on the axis of the plane one of those on its left?
        bool is_left(const LightBounds &light, const Plane &plane) const {
            int axis = plane.axis;
            return (light.mean[axis] - low[axis]) * scale[axis] < (float) plane.bin;
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
            LightBounds &light = m_lights[left];
            if (grid.is_left(light, plane)) {
                left_centroids.add(light);
                ++left;
            } else {
                right_centroids.add(light);
                std::swap(light, m_lights[--right]);
            }
        }
        return left;
    }

    Plane cheapest_plane(const Subtree &tree, const Grid &grid) const {
        Bin bins[3][kBins];
        for (int axis = 0; axis < 3; ++axis)
            for (uint32_t i = 0; i < grid.bins; ++i)
                bins[axis][i].clear();
        for (uint32_t i = tree.begin; i < tree.end; ++i) {
            const LightBounds &light = m_lights[i];
            Int4 bin                 = grid.bin(light);
            Float4 low = four(light.box_min), high = four(light.box_max),
                   weight = four(light.axis);
            for (int axis = 0; axis < 3; ++axis)
                bins[axis][bin[axis]].add(low, high, weight);
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
        side.clear();
        double cost = 0;
        for (uint32_t i = count - 1; i > 0; --i) {
            if (!bins[i].empty()) {
                side.add(bins[i]);
                cost = side.cost();
            }
            right_cost[i] = cost;
        }
        side.clear();
        for (uint32_t i = 1; i < count; ++i) {
            if (bins[i - 1].empty())
                continue;
            side.add(bins[i - 1]);
            cost = factor * (side.cost() + right_cost[i]);
            if (cost < best.cost)
                best = { axis, (int32_t) i, cost };
        }
    }

    HostVector<LightBounds> m_lights;
    HostVector<Node> m_nodes;
    Centroids m_centroids;
};

// --------------------------------------------------------------------------- Wide tree

/// Size of a wide tree
struct Extent {
    uint32_t count, depth;
};

/// Writes the nodes of a finished binary tree as kernels read them
class NodeWriter {
public:
    NodeWriter(const HostVector<LightBounds> &lights, HostVector<Node> &nodes)
        : m_lights(lights), m_nodes(nodes) {}

    /// Note how many wide nodes there are in each subtree at which one begins
    Extent measure(const Subtree &root) {
        std::array<Subtree, 4> children{ root };
        uint32_t count  = open_children(children);
        Extent below[4] = {}, sum{ 1, 0 };
        for_interior(children, count,
                     [&](uint32_t slot) { below[slot] = measure(children[slot]); });
        for (const Extent &extent : below) {
            sum.count += extent.count;
            sum.depth = std::max(sum.depth, extent.depth);
        }
        ++sum.depth;
        if (!root.is_leaf())
            m_nodes[root.node].wide_count = sum.count;
        return sum;
    }

    /// All wide nodes, to `nodes`, and where lights and nodes hang, to `tree`
    void write_wide(const Subtree &root, WideNode *nodes, LightTree &tree) {
        m_wide      = nodes;
        m_link      = tree.link.data();
        m_node_link = tree.node_link.data();
        collapse(root, 0, kNone);
    }

    /// Append the nodes of a subtree, leaves included; returns its cluster
    Cluster write_binary(std::vector<BinaryNode> &nodes, const Subtree &tree) const {
        uint32_t index = (uint32_t) nodes.size(),
                 most  = 2 * (uint32_t) m_lights.size() - 1;
        nodes.emplace_back();
        BinaryNode node{};
        node.first  = tree.begin;
        node.right  = kNone;
        node.light  = tree.is_leaf() ? tree.begin : kNone;
        node.escape = index + 2 * tree.count() - 1;
        if (node.escape == most)
            node.escape = kNone;
        Cluster c;
        if (tree.is_leaf()) {
            c = leaf_cluster(m_lights[tree.begin]);
        } else {
            uint32_t middle = m_nodes[tree.node].middle;
            Subtree left    = tree.left(middle);
            node.right      = index + 2 * left.count();
            c               = write_binary(nodes, left);
            c               = join(c, write_binary(nodes, tree.right(middle)));
        }
        std::copy_n(c.box_min, 3, node.box_min);
        std::copy_n(c.box_max, 3, node.box_max);
        std::copy_n(c.mean, 3, node.mean);
        node.variance = c.variance;
        node.flux     = c.flux;
        node.axis     = pack_axis(c.axis);
        nodes[index]  = node;
        return c;
    }

private:
    /// Call f(slot) for the interior ones of the children of a wide node
    template <typename F>
    static void for_interior(const std::array<Subtree, 4> &children, uint32_t count,
                             const F &f) {
        Tasks tasks;
        for (uint32_t slot = 0; slot < count; ++slot) {
            if (children[slot].count() > kTaskLights)
                tasks.start([&f, slot] { f(slot); });
            else if (!children[slot].is_leaf())
                f(slot);
        }
    }

    /// Write the wide nodes of a subtree, parents first, with the moments of leaves alone
    void collapse(const Subtree &root, uint32_t index, uint32_t link) const {
        std::array<Subtree, 4> children{ root };
        uint32_t count = open_children(children);
        WideNode node{};
        m_node_link[index] = link;
        uint32_t next      = index + 1;
        for (uint32_t slot = 0; slot < count; ++slot) {
            const Subtree &child = children[slot];
            if (child.is_leaf()) {
                write_leaf(node, slot, m_lights[child.begin]);
                node.child[slot]    = kLeafBit | child.begin;
                m_link[child.begin] = 4 * index + slot;
            } else {
                node.child[slot] = next;
                next += m_nodes[child.node].wide_count;
            }
        }
        m_wide[index] = node;
        for_interior(children, count, [&](uint32_t slot) {
            collapse(children[slot], node.child[slot], 4 * index + slot);
        });
    }

    static void write_leaf(WideNode &node, uint32_t slot, const LightBounds &light) {
        for (int i = 0; i < 3; ++i)
            node.mean[i][slot] = light.mean[i];
        node.moments[slot] = pack_moments(0.f, light.variance);
        node.axis[slot]    = pack_axis(leaf_cluster(light).axis);
    }

    /// Replace the root of a wide node by its children, at most four; returns how many
    uint32_t open_children(std::array<Subtree, 4> &children) const {
        Subtree root = children[0];
        if (root.count() > kPackedLights)
            return open_costliest(children);
        if (root.is_leaf())
            return 1;
        uint32_t count = 0;
        open(root, 4, children, count);
        return count;
    }

    /// The way of the least price to fill at most so many slots with the halves of a subtree
    void open(const Subtree &tree, uint32_t slots, std::array<Subtree, 4> &children,
              uint32_t &count) const {
        uint32_t middle = m_nodes[tree.node].middle;
        uint32_t left   = halves_of(tree, middle, m_nodes).open(slots).second;
        fill(tree.left(middle), left, children, count);
        fill(tree.right(middle), slots - left, children, count);
    }

    /// The same with the subtree itself or its halves
    void fill(const Subtree &tree, uint32_t slots, std::array<Subtree, 4> &children,
              uint32_t &count) const {
        bool whole = tree.is_leaf() || slots == 1;
        if (!whole) {
            const Node &node = m_nodes[tree.node];
            whole =
                node.price[0] <= halves_of(tree, node.middle, m_nodes).open(slots).first;
        }
        if (whole)
            children[count++] = tree;
        else
            open(tree, slots, children, count);
    }

    /// Replace the costliest interior entry by its two children until there are four
    uint32_t open_costliest(std::array<Subtree, 4> &children) const {
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

    /// By cost, and by how often descents come there; coincident lights cost nothing
    bool costlier(const Subtree &a, const Subtree &b) const {
        const Node &x = m_nodes[a.node], &y = m_nodes[b.node];
        double p = (double) x.cost * x.flux, q = (double) y.cost * y.flux;
        return p != q ? p > q : x.flux > y.flux;
    }

    const HostVector<LightBounds> &m_lights;
    HostVector<Node> &m_nodes;
    /// Where the wide nodes, the lights' links and the nodes' links are written to
    WideNode *m_wide = nullptr;
    uint32_t *m_link = nullptr, *m_node_link = nullptr;
};

/// See \ref build_tree
LightTree build(HostVector<LightBounds> &&lights, const NodeMemory &memory,
                bool keep_binary) {
    LightTree tree;
    BinaryTree binary(std::move(lights));
    uint32_t count = (uint32_t) binary.lights().size();
    if (count == 0)
        return tree;
    Subtree root{ 0, count, 0 };
    binary.split(root);

    NodeWriter writer(binary.lights(), binary.nodes());
    Extent extent   = writer.measure(root);
    tree.wide_count = extent.count;
    tree.depth      = extent.depth;
    tree.link.resize(count);
    tree.node_link.resize(tree.wide_count);
    WideNode *wide = memory(tree.wide_count);
    writer.write_wide(root, wide, tree);
    if (keep_binary) {
        tree.binary.reserve(2 * (size_t) count - 1);
        writer.write_binary(tree.binary, root);
    }

    tree.order.resize(count);
    for_chunks(count, [&](size_t, size_t begin, size_t end) {
        for (size_t i = begin; i < end; ++i)
            tree.order[i] = binary.lights()[i].light;
    });
    refit_tree(wide, tree.wide_count, binary.take_flux());
    return tree;
}

// ------------------------------------------------------------------------------- Refit

/// What a wide node is to its parent
struct Moments {
    double flux;
    float mean[3], variance, axis[3];
};

class Refit {
public:
    Refit(WideNode *nodes, size_t count, const HostVector<float> &flux)
        : m_nodes(nodes), m_flux(flux), m_moments(count) {}

    /// All nodes of a subtree, children first
    void run(size_t begin, size_t end) {
        if (end - begin <= kTaskLights) {
            for (size_t i = end; i-- > begin;)
                m_moments[i] = fill(m_nodes[i]);
            return;
        }
        {
            Tasks tasks;
            size_t after = end;
            for (int slot = 3; slot >= 0; --slot) {
                uint32_t child = m_nodes[begin].child[slot];
                if (child == 0 || child & kLeafBit)
                    continue;
                tasks.start([=] { run(child, after); });
                after = child;
            }
        }
        m_moments[begin] = fill(m_nodes[begin]);
    }

private:
    /// The child in a slot; an empty one has no flux
    Moments child(const WideNode &node, int slot) const {
        uint32_t child = node.child[slot];
        if (child != 0 && !(child & kLeafBit))
            return m_moments[child];
        Moments leaf;
        leaf.flux = child == 0 ? 0 : (double) m_flux[child & ~kLeafBit];
        for (int i = 0; i < 3; ++i) {
            leaf.mean[i] = node.mean[i][slot];
            leaf.axis[i] = unpack_axis<float>(node.axis[slot], i);
        }
        leaf.variance = unpack_variance<float>(node.moments[slot]);
        return leaf;
    }

    /// Write the slots of a node whose children are done
    Moments fill(WideNode &node) const {
        Moments children[4];
        double flux = 0, mean[3] = {}, axis[3] = {}, variance = 0;
        for (int slot = 0; slot < 4; ++slot) {
            const Moments &c = children[slot] = child(node, slot);
            flux += c.flux;
            for (int i = 0; i < 3; ++i) {
                // From the first child, so that nothing is rounded if all are at one place
                mean[i] += c.flux * ((double) c.mean[i] - children[0].mean[i]);
                axis[i] += c.flux * c.axis[i];
            }
        }
        for (int i = 0; i < 3; ++i)
            mean[i] = children[0].mean[i] + mean[i] / flux;
        for (int slot = 0; slot < 4; ++slot) {
            const Moments &c = children[slot];
            double distance2 = 0;
            for (int i = 0; i < 3; ++i)
                distance2 += (c.mean[i] - mean[i]) * (c.mean[i] - mean[i]);
            variance += c.flux * (c.variance + distance2 * (1.0 / 3));
            // An empty slot is as far away as another one
            write(node, slot, node.child[slot] == 0 ? children[0] : c, c.flux / flux);
        }
        Moments result;
        result.flux     = flux;
        result.variance = to_float(variance / flux);
        for (int i = 0; i < 3; ++i) {
            result.mean[i] = to_float(mean[i]);
            result.axis[i] = (float) (axis[i] / flux);
        }
        return result;
    }

    static void write(WideNode &node, int slot, const Moments &child, double share) {
        for (int i = 0; i < 3; ++i)
            node.mean[i][slot] = child.mean[i];
        node.moments[slot] = pack_moments((float) share, child.variance);
        node.axis[slot]    = pack_axis(child.axis);
    }

    WideNode *m_nodes;
    const HostVector<float> &m_flux;
    HostVector<Moments> m_moments;
};

} // namespace

LightTree build_tree(HostVector<LightBounds> &&lights, const NodeMemory &memory,
                     bool keep_binary) {
    LightTree tree;
    run_with_denormals([&] { tree = build(std::move(lights), memory, keep_binary); });
    return tree;
}

void refit_tree(WideNode *nodes, size_t count, const HostVector<float> &flux) {
    run_with_denormals([&] { Refit(nodes, count, flux).run(0, count); });
}

TreeTop read_top(const WideNode *nodes) {
    TreeTop top{};
    const WideNode &root = nodes[0];
    for (uint32_t group = 0; group < 4; ++group) {
        uint32_t child       = root.child[group];
        bool single          = child == 0 || child & kLeafBit;
        top.node[group]      = single ? 0 : child;
        const WideNode &node = nodes[top.node[group]];
        top.share[group]     = single ? 1.f : unpack_flux<float>(root.moments[group]);
        for (uint32_t slot = 0; slot < 4; ++slot) {
            // Empty slots are as far away as the first one
            uint32_t from = single ? group : slot;
            bool empty    = child == 0 || (single && slot > 0);
            for (int i = 0; i < 3; ++i) {
                top.mean[group][i][slot] = node.mean[i][from];
                top.axis[group][i][slot] = unpack_axis<float>(node.axis[from], i);
            }
            top.variance[group][slot] = unpack_variance<float>(node.moments[from]);
            top.flux[group][slot] =
                empty ? 0.f : unpack_flux<float>(node.moments[from]) * top.share[group];
            top.child[group][slot] = empty ? 0 : node.child[from];
        }
    }
    return top;
}

uint32_t pack_moments(float flux, float variance) {
    auto upper = [](float x) { // does not round up to infinity
        uint32_t bits = dr::reinterpret_array<uint32_t>(std::min(x, 0x1.fep127f));
        return (bits + 0x8000u) >> 16;
    };
    return upper(flux > 0 ? std::max(flux, FLT_MIN) : 0.f) << 16 | upper(variance);
}

uint32_t pack_axis(const float axis[3]) {
    uint32_t result = 0;
    for (int i = 0; i < 3; ++i) {
        float scaled = std::clamp(axis[i], -1.f, 1.f) * 511.f;
        // std::lround, which is a call
        int32_t rounded = (int32_t) (scaled + std::copysign(.5f, scaled));
        result |= ((uint32_t) rounded & 1023u) << (10 * i);
    }
    return result;
}

} // namespace manylights
