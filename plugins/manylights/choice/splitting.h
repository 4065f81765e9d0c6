#pragma once

#include "candidate.h"
#include "parameters.h"

namespace manylights {

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
        // Of all the light, which has a flux of 1, about 1 / distance^2 arrives. A node is split
        // where 1 / (8 rate) of that is in doubt.
        BinaryView root(tree, UInt32(0));
        Float d2(root.data.entry(9));
        for (size_t i = 0; i < 3; ++i)
            d2 += dr::square(root.data.entry(6 + i) - at.p.entry(i));
        this->rate = 8.f * rate * d2;
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
                // Cut where a node is not split, and remember where the traversal goes on
                BinaryView view(tree, s.node);
                Mask leaf = view.right == kNone,
                     stop = !s.cut && !(xi < split_probability(view, at));
                // A leaf or a cut node: the traversal goes on behind it
                s.resume = dr::select(!s.cut && (leaf || stop), view.escape, s.resume);
                s.cut |= stop;

                // Above the cut go left; below it choose a child at random, and use x again
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
