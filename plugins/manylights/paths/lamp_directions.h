#pragma once

/**
 * Directions that lead past lamps, for paths that go on from a point on a segment in fog.
 *
 * The light that a segment receives grows like 1 / sin t, t the angle to a lamp as seen from
 * its start: with directions from the phase function alone its variance is unbounded. So a part
 * of them follows the clusters at the top of the tree. With c the cosine of the angle to a
 * cluster and s its extent over its distance D,
 *
 *     p(w) = sum of P pdf(c),    P in proportion to flux / D * exp(-sigma D) * emission * v
 *     pdf(c) = (sqrt(b + 1) + sqrt(b - 1)) / (8 pi sqrt(b - c)),    b = 1 + s^2 / 2
 *
 * where v = exp(-(D / L)^2 / 2) guesses what is hidden, or out of the fog: what is further away
 * than the present segment, of length L, is long. What was learnt is another factor.
 * The pole is there where a lamp has a cluster of its own. The sum over all clusters is a
 * closed form: nothing depends on which of them was chosen.
 */

#include "manylights/tree/tree_view.h"
#include <mitsuba/core/frame.h>

namespace manylights {

/// The clusters as a point sees them
template <typename Float> class LampDirections {
public:
    using UInt32   = dr::uint32_array_t<Float>;
    using F4       = Four<Float>;
    using Vector3f = mitsuba::Vector<Float, 3>;
    using Point3f  = mitsuba::Point<Float, 3>;
    using Point2f  = mitsuba::Point<Float, 2>;

    /// @param at  the segment that the point p is on
    LampDirections(const TreeView<Float> &tree, const Receiver<Float> &at,
                   const Point3f &p) {
        F4 h[kTopNodes];
        Float importance(0.f), whole(0.f);
        for (size_t i = 0; i < kTopNodes; ++i) {
            h[i] = look_at(tree, at, p, i);
            importance += sum_of<Float>(h[i]);
        }
        auto root = tree.child_visibility(at, UInt32(0));
        for (size_t i = 0; i < kTopNodes; ++i) {
            F4 weight =
                defensive_weights<Float>(tree.top.clusters[i].flux, h[i], importance);
            whole += sum_of<Float>(weight);
            weight *= m_free[i];
            if (root)
                weight *=
                    tree.top_factors(at, *root, UInt32((uint32_t) i), tree.top.node[i]);
            m_weights.append(4 * i, weight);
        }
        m_visible = m_weights.total() / whole;
    }

    /// Share of the lamps' light that is thought to get past what is between
    const Float &visible() const { return m_visible; }

    Vector3f sample(const Float &u1, const Point2f &u2) const {
        // Choose a cluster
        Float x   = u1 * m_weights.total();
        auto axis = [&](size_t i) {
            const F4 *v = m_axis[i / 4];
            return Vector3f(v[0].entry(i % 4), v[1].entry(i % 4), v[2].entry(i % 4));
        };
        auto spread     = [&](size_t i) { return Float(m_spread[i / 4].entry(i % 4)); };
        Vector3f chosen = axis(0);
        Float extent    = spread(0);
        for (size_t i = 1; i < kTopClusters; ++i) {
            auto take = x >= m_weights.end[i - 1];
            chosen    = dr::select(take, axis(i), chosen);
            extent    = dr::select(take, spread(i), extent);
        }
        // sqrt(b - c) is uniform
        Float most = dr::sqrt(2.f + extent), least = dr::sqrt(extent),
              root          = dr::fnmadd(u2.x(), 2.f / (most + least), most),
              below         = dr::clip(dr::fmsub(root, root, extent), 0.f, 2.f), // 1 - c
            sine            = dr::sqrt(below * (2.f - below));
        auto [sin_p, cos_p] = dr::sincos(dr::TwoPi<Float> * u2.y());
        return mitsuba::Frame<Float>(chosen).to_world(
            Vector3f(cos_p * sine, sin_p * sine, 1.f - below));
    }

    Float pdf(const Vector3f &d) const {
        F4 sum(0.f);
        for (size_t i = 0; i < kTopNodes; ++i) {
            const F4 *axis = m_axis[i];
            F4 x = axis[0] - d.x(), y = axis[1] - d.y(), z = axis[2] - d.z();
            // b - c, without cancellation
            F4 off = dr::fmadd(dr::fmadd(x, x, dr::fmadd(y, y, z * z)), .5f, m_spread[i]),
               ends       = dr::sqrt(2.f + m_spread[i]) + dr::sqrt(m_spread[i]);
            const auto &w = m_weights.weight;
            F4 weight(w[4 * i], w[4 * i + 1], w[4 * i + 2], w[4 * i + 3]);
            sum = dr::fmadd(weight * ends, dr::rsqrt(off), sum);
        }
        return sum_of<Float>(sum) / (8.f * dr::Pi<Float> * m_weights.total());
    }

private:
    /// Directions that are nearer to each other than this are the same to floats
    static constexpr float kLeastSpread = 1e-12f, kMostSpread = 1e6f;

    /// Directions and extents of four clusters; returns h
    F4 look_at(const TreeView<Float> &tree, const Receiver<Float> &at, const Point3f &p,
               size_t i) {
        const Clusters<Float> &c = tree.top.clusters[i];
        F4 wx = c.mean[0] - p.x(), wy = c.mean[1] - p.y(), wz = c.mean[2] - p.z();
        F4 d2  = dr::fmadd(wx, wx, dr::fmadd(wy, wy, dr::fmadd(wz, wz, 1e-30f)));
        F4 inv = dr::rsqrt(d2), inv_e = dr::rsqrt(d2 + c.variance);
        m_axis[i][0] = wx * inv;
        m_axis[i][1] = wy * inv;
        m_axis[i][2] = wz * inv;
        m_spread[i] =
            dr::minimum(.5f * c.variance * inv * inv, kMostSpread) + kLeastSpread;
        m_free[i] = dr::exp(d2 * (-.5f * dr::rcp(dr::square(at.length))));
        F4 result = c.flux * inv_e * attenuation(at, F4(d2 * inv));
        if (tree.directions != Directions::All)
            result *= emission(c, wx, wy, wz, inv_e, tree.directions);
        return result;
    }

    ClusterWeights<Float, kTopClusters> m_weights;
    /// Of each cluster: the unit vector to its centre, b - 1, and how likely it is seen
    F4 m_axis[kTopNodes][3], m_spread[kTopNodes], m_free[kTopNodes];
    Float m_visible;
};

} // namespace manylights
