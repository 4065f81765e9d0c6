#pragma once

#include "candidate.h"

namespace manylights {

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

        // Start at a remembered node, or at the top: by rounding, a remembered one may miss the
        // point by a hair
        Mask remembered = holds(trail0, k);
        Descent d{ dr::select(remembered, trail0, below_top(tree, at)),
                   dr::select(remembered, trail1, nowhere()),
                   nowhere(),
                   Float(0.f),
                   rng.template next_float<Float>(),
                   visits };
        d.x =
            min_of(max_of((k + offset - d.place.begin) / d.place.width, 0.f), kBelowOne);

        // Descend to the leaf on which the point falls
        loop(
            d, [](const Descent &s) { return (s.place.node & kLeafBit) == 0u; },
            [&](Descent &s) { descend(tree, at, s); }, "Light tree: descent");

        // Move on to the first point beyond that leaf
        visits = d.visits;
        trail0 = d.trail0;
        trail1 = d.trail1;
        k      = next_point(d.place.begin + d.place.width);
        Mask same =
            d.place.node == last_leaf; // two points on the same border, by rounding
        last_leaf = d.place.node;
        return { d.place.node & ~kLeafBit, min_of(1.f, d.place.width), !same,
                 d.place.visibility };
    }

    /// Probability that `light` is one of `expected` candidates, whatever their offset
    static Float inclusion_probability(const TreeView<Float> &tree,
                                       const Receiver<Float> &at, const UInt32 &light,
                                       const Float &expected, const Mask &active) {
        return min_of(1.f, expected * leaf_probability(tree, at, light, active));
    }

private:
    static Place nowhere() { return { UInt32(0), Float(0.f), Float(0.f), Float(1.f) }; }

    /// The grandchild of the root on which the point falls
    Place below_top(const TreeView<Float> &tree, const Receiver<Float> &at) const {
        Float x = min_of((k + offset) / expected, kBelowOne) * top.total();
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
        return max_of(k + 1.f, dr::ceil(end - offset));
    }

    template <typename Descent>
    void descend(const TreeView<Float> &tree, const Receiver<Float> &at,
                 Descent &s) const {
        // Choose the child on which the point falls, x in units of the weights
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

        // Remember this node if it holds a point beyond the child; the oldest one is forgotten
        Mask push = holds(s.place, next_point(child.begin + child.width));
        s.trail1  = dr::select(push, s.trail0, s.trail1);
        s.trail0  = dr::select(push, s.place, s.trail0);

        // Bring x to [0, 1) of the child
        s.x = (x - choice.begin) / choice.weight;
        /* A descent magnifies the rounding of x. Where the interval becomes too small for a
           second point, x is uniform in it, so low-order digits may be added. */
        Mask single = s.place.width >= 1.f && child.width <= 1.f;
        Float y     = dr::fmadd(s.dither, 1.f / 256.f, s.x);
        s.x         = min_of(dr::select(single, y - dr::floor(y), s.x), kBelowOne);
        s.place     = child;
        s.visits += 1u;
    }
};

} // namespace manylights
