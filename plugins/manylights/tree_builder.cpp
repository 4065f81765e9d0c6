#include "tree_builder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>

namespace manylights {

namespace {

constexpr uint32_t kBins = 16;
/// Below this depth ranges are halved; it bounds the recursion of degenerate inputs
constexpr uint32_t kMaxCostDepth = 64;
/// Variance that coincident lights are given, as a fraction of the squared diagonal of
/// the scene's lights: keeps 1/distance^2 finite whatever the unit of length
constexpr double kMinVariance = 1e-12;

/// Running sums over a set of lights: box, flux, first and second moments, axis
struct Moments {
    float box_min[3], box_max[3];
    /// Moments are taken about this point: accurate far from the world's origin
    std::array<double, 3> origin{};
    double flux = 0, second = 0;
    std::array<double, 3> first{}, axis{};

    Moments() {
        std::fill_n(box_min, 3, std::numeric_limits<float>::infinity());
        std::fill_n(box_max, 3, -std::numeric_limits<float>::infinity());
    }

    void add(const LightBounds &light) {
        double square = 3 * (double) light.variance;
        for (int i = 0; i < 3; ++i) {
            double mean = light.mean[i] - origin[i];
            box_min[i]  = std::min(box_min[i], light.box_min[i]);
            box_max[i]  = std::max(box_max[i], light.box_max[i]);
            first[i] += light.flux * mean;
            axis[i] += (double) light.flux * light.axis[i];
            square += mean * mean;
        }
        flux += light.flux;
        second += light.flux * square;
    }

    /// Both must have the same origin
    void add(const Moments &other) {
        for (int i = 0; i < 3; ++i) {
            box_min[i] = std::min(box_min[i], other.box_min[i]);
            box_max[i] = std::max(box_max[i], other.box_max[i]);
            first[i] += other.first[i];
            axis[i] += other.axis[i];
        }
        flux += other.flux;
        second += other.second;
    }

    double extent(int i) const { return std::max(0.0, (double) box_max[i] - box_min[i]); }

    double squared_diagonal() const {
        return extent(0) * extent(0) + extent(1) * extent(1) + extent(2) * extent(2);
    }

    /// flux * M_A * M_Omega, the cost of a cluster (see the header for both measures)
    double cost() const {
        if (flux <= 0)
            return 0;
        double x = extent(0), y = extent(1), z = extent(2);
        double area = 2 * (x * y + y * z + z * x) + squared_diagonal();
        double length =
            std::sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
        return area * (4 * flux - 3 * length);
    }
};

/// Everything that a cluster contributes to the node above it
struct Cluster {
    float box_min[3], box_max[3];
    float mean[3], variance, flux, axis[3];
    double cost;
};

/// Binary node under construction, in depth-first order
struct Node {
    Cluster cluster;
    uint32_t right = kNone, escape = kNone;
    uint32_t light = kNone, first = 0;
};

class Builder {
public:
    explicit Builder(const std::vector<LightBounds> &lights) : m_lights(lights) {
        m_tree.order.resize(lights.size());
        std::iota(m_tree.order.begin(), m_tree.order.end(), 0u);
        m_nodes.reserve(2 * lights.size());

        Moments all    = sums(0, (uint32_t) lights.size());
        m_total_flux   = all.flux;
        m_min_variance = std::max(kMinVariance * all.squared_diagonal(), (double) 1e-20f);
    }

    LightTree build(bool keep_binary) {
        uint32_t count = (uint32_t) m_lights.size();
        if (count == 0)
            return std::move(m_tree);
        split(0, count, 0);
        m_tree.link.assign(count, kNone);
        collapse(0, kNone, 1);
        if (keep_binary)
            write_binary();
        return std::move(m_tree);
    }

private:
    const LightBounds &light(uint32_t i) const { return m_lights[m_tree.order[i]]; }

    Moments sums(uint32_t begin, uint32_t end) const {
        Moments result;
        if (begin == end)
            return result;
        for (int i = 0; i < 3; ++i)
            result.origin[i] = light(begin).mean[i];
        for (uint32_t i = begin; i < end; ++i)
            result.add(light(i));
        return result;
    }

    Cluster summarize(const Moments &m) const {
        Cluster c;
        double square = m.second / m.flux;
        for (int i = 0; i < 3; ++i) {
            double mean  = m.first[i] / m.flux;
            c.box_min[i] = m.box_min[i];
            c.box_max[i] = m.box_max[i];
            c.mean[i]    = (float) (mean + m.origin[i]);
            c.axis[i]    = (float) (m.axis[i] / m.flux);
            square -= mean * mean;
        }
        c.variance = (float) std::max(square / 3, m_min_variance);
        // A positive weight is a promise that the light can be chosen
        c.flux =
            std::max((float) (m.flux / m_total_flux), std::numeric_limits<float>::min());
        c.cost = m.cost();
        return c;
    }

    /// Build the subtree over lights [begin, end) and return its root
    uint32_t split(uint32_t begin, uint32_t end, uint32_t depth) {
        uint32_t index = (uint32_t) m_nodes.size();
        m_nodes.emplace_back();
        Moments moments        = sums(begin, end);
        m_nodes[index].cluster = summarize(moments);
        m_nodes[index].first   = begin;
        if (end - begin == 1) {
            m_nodes[index].light = begin;
        } else {
            uint32_t middle = depth < kMaxCostDepth ? partition(begin, end) : begin;
            if (middle == begin || middle == end)
                middle = begin + (end - begin) / 2;
            split(begin, middle, depth + 1);
            uint32_t right       = split(middle, end, depth + 1);
            m_nodes[index].right = right;
        }
        m_nodes[index].escape = (uint32_t) m_nodes.size();
        return index;
    }

    /// Reorder [begin, end) along the cheapest plane; `begin` when there is none
    uint32_t partition(uint32_t begin, uint32_t end) {
        float low[3], high[3];
        centroid_bounds(begin, end, low, high);
        double longest = 0;
        for (int i = 0; i < 3; ++i)
            longest = std::max(longest, (double) high[i] - low[i]);

        double best       = std::numeric_limits<double>::infinity();
        int best_axis     = -1;
        uint32_t best_bin = 0;
        for (int axis = 0; axis < 3; ++axis) {
            double extent = (double) high[axis] - low[axis];
            if (!(extent > 1e-6 * longest))
                continue;
            // Conty and Kulla's factor against thin slabs
            auto [cost, bin] =
                cheapest_plane(begin, end, axis, low[axis], kBins / extent);
            cost *= longest / extent;
            if (cost < best) {
                best      = cost;
                best_axis = axis;
                best_bin  = bin;
            }
        }
        if (best_axis < 0)
            return begin;

        double scale = kBins / ((double) high[best_axis] - low[best_axis]);
        auto first   = m_tree.order.begin();
        auto middle  = std::stable_partition(first + begin, first + end, [&](uint32_t i) {
            return bin_of(m_lights[i], best_axis, low[best_axis], scale) < best_bin;
        });
        return (uint32_t) (middle - first);
    }

    void centroid_bounds(uint32_t begin, uint32_t end, float low[3],
                         float high[3]) const {
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = high[axis] = light(begin).mean[axis];
            for (uint32_t i = begin; i < end; ++i) {
                low[axis]  = std::min(low[axis], light(i).mean[axis]);
                high[axis] = std::max(high[axis], light(i).mean[axis]);
            }
        }
    }

    static uint32_t bin_of(const LightBounds &light, int axis, float low, double scale) {
        return std::min((uint32_t) ((light.mean[axis] - low) * scale), kBins - 1);
    }

    /// Lowest sum of the two sides' costs, and the first bin of the right side
    std::pair<double, uint32_t> cheapest_plane(uint32_t begin, uint32_t end, int axis,
                                               float low, double scale) const {
        std::array<Moments, kBins> bins;
        for (uint32_t i = begin; i < end; ++i)
            bins[bin_of(light(i), axis, low, scale)].add(light(i));

        std::array<double, kBins> right_cost;
        Moments side;
        for (uint32_t i = kBins - 1; i > 0; --i) {
            side.add(bins[i]);
            right_cost[i] = side.cost();
        }

        double best       = std::numeric_limits<double>::infinity();
        uint32_t best_bin = 0;
        side              = Moments();
        for (uint32_t i = 1; i < kBins; ++i) {
            side.add(bins[i - 1]);
            double cost = side.cost() + right_cost[i];
            if (side.flux > 0 && cost < best) {
                best     = cost;
                best_bin = i;
            }
        }
        return { best, best_bin };
    }

    /// Write the wide node of the binary subtree `root`; returns its index
    uint32_t collapse(uint32_t root, uint32_t link, uint32_t depth) {
        std::array<uint32_t, 4> children{ root, kNone, kNone, kNone };
        uint32_t count = open_children(children);

        uint32_t index = (uint32_t) m_tree.wide.size();
        m_tree.wide.emplace_back();
        WideNode node{};
        node.link    = link;
        m_tree.depth = std::max(m_tree.depth, depth);
        for (uint32_t slot = 0; slot < count; ++slot) {
            const Node &child = m_nodes[children[slot]];
            write_child(node, slot, child.cluster);
            if (child.light != kNone) {
                node.child[slot]         = kLeafBit | child.light;
                m_tree.link[child.light] = 4 * index + slot;
            } else {
                node.child[slot] = collapse(children[slot], 4 * index + slot, depth + 1);
            }
        }
        m_tree.wide[index] = node;
        return index;
    }

    /// Replace the costliest interior entry by its two children until there are four
    uint32_t open_children(std::array<uint32_t, 4> &children) const {
        uint32_t count = 1;
        while (count < 4) {
            int worst = -1;
            for (uint32_t i = 0; i < count; ++i) {
                const Node &node = m_nodes[children[i]];
                if (node.light == kNone &&
                    (worst < 0 || costlier(node, m_nodes[children[worst]])))
                    worst = (int) i;
            }
            if (worst < 0)
                break;
            // Keep the leaves' order: the right child goes directly behind the left one
            uint32_t opened = children[worst];
            for (uint32_t i = count; i > (uint32_t) worst + 1; --i)
                children[i] = children[i - 1];
            children[worst]     = opened + 1;
            children[worst + 1] = m_nodes[opened].right;
            ++count;
        }
        return count;
    }

    /// By cost; coincident lights cost nothing and are opened by flux
    static bool costlier(const Node &a, const Node &b) {
        return a.cluster.cost != b.cluster.cost ? a.cluster.cost > b.cluster.cost
                                                : a.cluster.flux > b.cluster.flux;
    }

    static void write_child(WideNode &node, uint32_t slot, const Cluster &cluster) {
        for (int i = 0; i < 3; ++i)
            node.mean[i][slot] = cluster.mean[i];
        node.variance[slot] = cluster.variance;
        node.flux[slot]     = cluster.flux;
        node.axis[slot]     = pack_axis(cluster.axis);
    }

    void write_binary() {
        m_tree.binary.reserve(m_nodes.size());
        for (const Node &from : m_nodes) {
            BinaryNode node{};
            const Cluster &c = from.cluster;
            std::copy_n(c.box_min, 3, node.box_min);
            std::copy_n(c.box_max, 3, node.box_max);
            std::copy_n(c.mean, 3, node.mean);
            node.variance = c.variance;
            node.flux     = c.flux;
            node.axis     = pack_axis(c.axis);
            node.right    = from.right;
            node.escape   = from.escape < m_nodes.size() ? from.escape : kNone;
            node.light    = from.light;
            node.first    = from.first;
            m_tree.binary.push_back(node);
        }
    }

    const std::vector<LightBounds> &m_lights;
    LightTree m_tree;
    std::vector<Node> m_nodes;
    double m_total_flux   = 0;
    double m_min_variance = 0;
};

} // namespace

uint32_t pack_axis(const float axis[3]) {
    uint32_t result = 0;
    for (int i = 0; i < 3; ++i) {
        float clamped = std::clamp(axis[i], -1.f, 1.f);
        result |= ((uint32_t) std::lround(clamped * 511.f) & 1023u) << (10 * i);
    }
    return result;
}

LightTree build_tree(const std::vector<LightBounds> &lights, bool keep_binary) {
    return Builder(lights).build(keep_binary);
}

} // namespace manylights
