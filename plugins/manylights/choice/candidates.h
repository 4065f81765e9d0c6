#pragma once

/**
 * Candidates: the N' lights that a shading point considers, one after the other.
 *
 * Three sources with one interface, used by the loops in kept_lights.h and shadow_rays.h:
 *
 *     Mask has_next() const;                 is there another candidate?
 *     Candidate next(tree, receiver, rng);   find it and move on
 *     UInt32 visits;                         nodes visited so far (drops out if unused)
 *
 * - \ref AllLights: every light, with probability 1 (few lights, or infinite rate).
 * - \ref SystematicCursor: systematic sampling of the tree (default).
 * - \ref SplittingCursor: splitting of a binary tree's nodes (methods `talk` and
 *   `adaptive_splitting`).
 *
 * Candidates of one point are always distinct lights.
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
/// K above which systematic sampling would lose the fraction of a float: visit all lights
constexpr float kMaxExpectedCandidates = 1 << 14;
/// K for a splitting rate of 1
constexpr float kCandidatesPerRate = 8.f;

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
};

/**
 * Systematic sampling of the leaves, in the order of the tree.
 *
 * The leaves tile [0, 1) by their probability w of a single descent. K equidistant points
 * x_k = (k + u) / K with one random number u select those that they fall on: a leaf is
 * reached with probability A = min(1, K w), exactly, and A is continuous in x. A node is
 * thereby split whenever more than one point falls on it: one random number drives the
 * whole traversal and the probability of splitting decreases with depth, as in the talk,
 * but N' <= K always.
 *
 * Every point descends from the top of the tree, which has been compared once for all of
 * them, or from one of two remembered nodes known to hold the next point ("trail"): no
 * stack, and all SIMD lanes stay alike. A trail that overflows costs time only.
 */
template <typename Float> struct SystematicCursor {
    using UInt32 = dr::uint32_array_t<Float>;
    using Mask   = dr::mask_t<Float>;

    /// A node and the interval [begin, begin + width) of the leaves below it, in points
    struct Place {
        UInt32 node;
        Float begin, width;
        /// Learnt for the place, or for one above it
        Float visibility;
        DRJIT_STRUCT(Place, node, begin, width, visibility)
    };

    /// Expected candidates K, offset u of the points, next point k
    Float expected, offset, k;
    /// Remembered nodes, the deepest first; width 0 marks an empty entry
    Place trail0, trail1;
    UInt32 last_leaf, visits;
    DRJIT_STRUCT(SystematicCursor, expected, offset, k, trail0, trail1, last_leaf, visits)

    /// The same for all points; and points for a unit of its weights
    TopWeights<Float> top;
    Float scale;

    SystematicCursor(const TopWeights<Float> &top, const Float &expected, const Float &u)
        : expected(expected), offset(u), k(0.f), trail0(nowhere()), trail1(nowhere()),
          last_leaf(kNone), visits(kTopNodes), top(top), scale(expected / top.total()) {}

    Mask has_next() const { return k + offset < expected; }

    template <typename Rng>
    Candidate<Float> next(const TreeView<Float> &tree, const Receiver<Float> &at,
                          Rng &rng) {
        struct Descent {
            Place place, trail0, trail1;
            Float x, dither;
            UInt32 visits;
            DRJIT_STRUCT(Descent, place, trail0, trail1, x, dither, visits)
        };

        // By rounding, a remembered node may miss the point by a hair: then start at the top
        Mask remembered = holds(trail0, k);
        Descent d{ dr::select(remembered, trail0, below_top(tree, at)),
                   dr::select(remembered, trail1, nowhere()),
                   nowhere(),
                   Float(0.f),
                   rng.template next_float<Float>(),
                   visits };
        d.x = dr::clip((k + offset - d.place.begin) / d.place.width, 0.f, kBelowOne);

        loop(
            d, [](const Descent &s) { return (s.place.node & kLeafBit) == 0u; },
            [&](Descent &s) { descend(tree, at, s); }, "Light tree: descent");

        visits = d.visits;
        trail0 = d.trail0;
        trail1 = d.trail1;
        k      = next_point(d.place.begin + d.place.width);
        Mask same =
            d.place.node == last_leaf; // two points on the same border, by rounding
        last_leaf = d.place.node;
        return { d.place.node & ~kLeafBit, dr::minimum(1.f, d.place.width), !same,
                 d.place.visibility };
    }

private:
    static Place nowhere() { return { UInt32(0), Float(0.f), Float(0.f), Float(1.f) }; }

    /// The grandchild of the root on which the point falls
    Place below_top(const TreeView<Float> &tree, const Receiver<Float> &at) const {
        Float x = dr::minimum((k + offset) / expected, kBelowOne) * top.total();
        ChildChoice<Float> choice =
            choose_child<Float, kTopClusters>(top, tree.top.child, x);
        Place place{ choice.child, choice.begin * scale, choice.weight * scale,
                     Float(1.f) };
        if (top.root) {
            UInt32 group = choice.slot >> 2u, node = tree.top.node[0];
            for (uint32_t i = 1; i < 4; ++i)
                node = dr::select(group == i, tree.top.node[i], node);
            place.visibility = pick<Float>(tree.top_factors(at, *top.root, group, node),
                                           choice.slot & 3u);
        }
        return place;
    }

    /// Does point k, which is not in front of a place, lie in its interval?
    Mask holds(const Place &place, const Float &k) const {
        return k + offset < place.begin + place.width;
    }

    /// First point at or beyond `end`, and at least one further than the current one
    Float next_point(const Float &end) const {
        return dr::maximum(k + 1.f, dr::ceil(end - offset));
    }

    template <typename Descent>
    void descend(const TreeView<Float> &tree, const Receiver<Float> &at,
                 Descent &s) const {
        WideNodeView<Float> node(tree, s.place.node, true);
        auto visibility = tree.child_visibility(at, s.place.node);
        ClusterWeights<Float, 4> weights =
            child_weights(tree, at, node.clusters, visibility);
        Float x                   = s.x * weights.total();
        ChildChoice<Float> choice = choose_child(weights, node.child, x);
        Float scale               = s.place.width / weights.total();
        Place child{ choice.child, dr::fmadd(choice.begin, scale, s.place.begin),
                     choice.weight * scale, s.place.visibility };
        if (visibility)
            child.visibility = visibility->factor(choice.slot, s.place.visibility);

        // Remember this node if it holds a point beyond the child
        Mask push = holds(s.place, next_point(child.begin + child.width));
        s.trail1  = dr::select(push, s.trail0, s.trail1);
        s.trail0  = dr::select(push, s.place, s.trail0);

        s.x = (x - choice.begin) / choice.weight;
        /* A descent magnifies the rounding of x. Where the interval becomes too small for a
           second point, x is uniform in it, so low-order digits may be added. */
        Mask single = s.place.width >= 1.f && child.width <= 1.f;
        Float y     = dr::fmadd(s.dither, 1.f / 256.f, s.x);
        s.x         = dr::minimum(dr::select(single, y - dr::floor(y), s.x), kBelowOne);
        s.place     = child;
        s.visits += 1u;
    }
};

/// What decides whether a node is split: the talk's two functions, or the variance
enum class SplitFunction { Near, Far, Variance };

/// Lower limit of r/d: coincident lights (r = 0) can still be told apart
constexpr float kMinSpread = 1e-3f;

/**
 * Splitting of the nodes of a binary tree, one by one: a node is split if xi < P(node),
 * and below a node that is not split one light is chosen at random. The number xi is the
 * same for the whole traversal.
 *
 * The talk splits stochastically. With r half the diagonal of a node's box, d its distance
 * and g the rate,
 *
 *     near: P = g (r/d)^2 / (1 + g (r/d)^2),    far: P = g (r/d) / (1 + g (r/d)),
 *
 * readings of section 3, whose supplement is not public. The second extends further away.
 *
 * Adaptive tree splitting (Conty Estevez and Kulla 2018, section 5) splits where the
 * light of a cluster varies too much, so P is 0 or 1. For distances spread evenly over
 * [a, b] the squared falloff has the standard deviation (b - a) / (ab sqrt(3 ab)); times
 * the cluster's flux this must be below 1 / (8 g) of all light that arrives. (Published
 * is an absolute limit in the scene's units, and a term for lights of unequal flux.)
 *
 * The traversal is stackless: a cut node's `escape` is where it goes on.
 */
template <typename Float> struct SplittingCursor {
    using UInt32 = dr::uint32_array_t<Float>;
    using Mask   = dr::mask_t<Float>;

    Float rate, xi;
    UInt32 node, visits;
    DRJIT_STRUCT(SplittingCursor, rate, xi, node, visits)

    SplitFunction function = SplitFunction::Near;

    /// `u` is the random number of the traversal; with the variance it does not matter
    SplittingCursor(const TreeView<Float> &tree, const Receiver<Float> &at,
                    const Float &rate, const Float &u, SplitFunction function)
        : rate(rate), xi(u), node(0), visits(0), function(function) {
        if (function != SplitFunction::Variance)
            return;
        // Of all the light, which has a flux of 1, about 1 / distance^2 arrives
        BinaryView root(tree, UInt32(0));
        Float d2(root.data.entry(9));
        for (size_t i = 0; i < 3; ++i)
            d2 += dr::square(root.data.entry(6 + i) - at.p.entry(i));
        this->rate = kCandidatesPerRate * rate * d2;
    }

    Mask has_next() const { return node != kNone; }

    template <typename Rng>
    Candidate<Float> next(const TreeView<Float> &tree, const Receiver<Float> &at,
                          Rng &rng) {
        struct Descent {
            UInt32 node, resume, visits;
            Float x, probability;
            Mask cut;
            DRJIT_STRUCT(Descent, node, resume, visits, x, probability, cut)
        };
        Descent d{ node,       node,       visits, rng.template next_float<Float>(),
                   Float(1.f), Mask(false) };
        loop(
            d, [](const Descent &s) { return (s.node & kLeafBit) == 0u; },
            [&](Descent &s) {
                BinaryView view(tree, s.node);
                Mask leaf = view.right == kNone,
                     stop = !s.cut && !(xi < split_probability(view, at));
                // A leaf or a cut node: the traversal goes on behind it
                s.resume = dr::select(!s.cut && (leaf || stop), view.escape, s.resume);
                s.cut |= stop;

                Float q_left  = left_probability(tree, at, s.node, view.right, !leaf);
                Mask left     = !s.cut || s.x < q_left;
                Float q       = dr::select(left, q_left, 1.f - q_left);
                Float x       = dr::select(left, s.x, s.x - q_left) / q;
                Mask step     = s.cut && !leaf;
                s.x           = dr::select(step, dr::clip(x, 0.f, kBelowOne), s.x);
                s.probability = dr::select(step, s.probability * q, s.probability);
                s.node        = dr::select(leaf, view.light | kLeafBit,
                                           dr::select(left, s.node + 1u, view.right));
                s.visits += 1u;
            },
            "Light tree: splitting");
        node   = d.resume;
        visits = d.visits;
        return { d.node & ~kLeafBit, d.probability, d.probability > 0.f };
    }

    /// Probability that `light` is a candidate, given this traversal's xi
    Float inclusion_probability(const TreeView<Float> &tree, const Receiver<Float> &at,
                                const UInt32 &light, const Mask &active) const {
        struct Descent {
            UInt32 node;
            Float probability;
            Mask cut;
            DRJIT_STRUCT(Descent, node, probability, cut)
        };
        Descent d{ dr::select(active, UInt32(0), kLeafBit), Float(1.f), Mask(false) };
        loop(
            d, [](const Descent &s) { return (s.node & kLeafBit) == 0u; },
            [&](Descent &s) {
                BinaryView view(tree, s.node);
                Mask leaf = view.right == kNone;
                s.cut |= !(xi < split_probability(view, at));
                // Lights are numbered in the order of the leaves
                Mask left =
                    light < BinaryView(tree, dr::select(leaf, 0u, view.right)).first;
                Float q_left = left_probability(tree, at, s.node, view.right, !leaf);
                Float q      = dr::select(left, q_left, 1.f - q_left);
                s.probability =
                    dr::select(s.cut && !leaf, s.probability * q, s.probability);
                s.node =
                    dr::select(leaf, kLeafBit, dr::select(left, s.node + 1u, view.right));
            },
            "Light tree: inclusion");
        return d.probability;
    }

private:
    /// A binary node, gathered
    struct BinaryView {
        dr::Array<Float, kBinaryNodeFloats> data;
        UInt32 right, escape, light, first;

        BinaryView(const TreeView<Float> &tree, const UInt32 &node)
            : data(tree.template fetch<kBinaryNodeFloats>(tree.binary, node, true)),
              right(bits(12)), escape(bits(13)), light(bits(14)), first(bits(15)) {}

        UInt32 bits(size_t i) const {
            return dr::reinterpret_array<UInt32>(data.entry(i));
        }
    };

    Float split_probability(const BinaryView &view, const Receiver<Float> &at) const {
        Float d2(0.f), r2(0.f);
        for (size_t i = 0; i < 3; ++i) {
            Float low = view.data.entry(i), high = view.data.entry(3 + i);
            d2 += dr::square(at.p.entry(i) - dr::clip(at.p.entry(i), low, high));
            r2 += .25f * dr::square(high - low);
        }
        Float spread2 = dr::clip(r2 / d2, kMinSpread * kMinSpread, 1e12f), g;
        if (function == SplitFunction::Variance) {
            // a = d, b = d + 2 r
            Float b_a     = 1.f + 2.f * dr::sqrt(spread2), // b / a
                deviation = (b_a - 1.f) * dr::rsqrt(3.f * b_a) / (b_a * d2);
            Mask split =
                rate * view.data.entry(10) * deviation > 1.f || (rate > 0.f && d2 <= 0.f);
            return dr::select(split, Float(1.f), 0.f);
        }
        g = rate * (function == SplitFunction::Near ? spread2 : dr::sqrt(spread2));
        // The root's box holds all others, so P decreases with depth on every path
        return dr::select(d2 > 0.f, 1.f - dr::rcp(1.f + g),
                          dr::select(rate > 0.f, Float(1.f), 0.f));
    }

    /// Probability of the left child, from the same h as the wide tree
    Float left_probability(const TreeView<Float> &tree, const Receiver<Float> &at,
                           const UInt32 &node, const UInt32 &right,
                           const Mask &interior) const {
        Clusters<Float> clusters;
        for (int i = 0; i < 3; ++i)
            clusters.mean[i] = clusters.axis[i] = Four<Float>(0.f);
        clusters.flux     = Four<Float>(0.f);
        clusters.variance = Four<Float>(1.f); // two slots are empty, not at distance 0
        const UInt32 child[2] = { node + 1u, right };
        for (size_t slot = 0; slot < 2; ++slot) {
            BinaryView view(tree, dr::select(interior, child[slot], 0u));
            for (size_t i = 0; i < 3; ++i)
                clusters.mean[i].entry(slot) = view.data.entry(6 + i);
            clusters.variance.entry(slot) = view.data.entry(9);
            clusters.flux.entry(slot)     = view.data.entry(10);
            auto axis = dr::reinterpret_array<UInt32>(view.data.entry(11));
            for (int i = 0; i < 3; ++i)
                clusters.axis[i].entry(slot) = unpack_axis<Float>(axis, i);
        }
        clusters.flux /= clusters.flux.entry(0) + clusters.flux.entry(1);
        ClusterWeights<Float, 4> weights = child_weights(tree, at, clusters, {});
        return weights.weight[0] / weights.total();
    }
};

} // namespace manylights
